"""What every avatar promises, held against every recipe; a new method joins by a recipe of its own."""

import copy
from dataclasses import is_dataclass, replace

import pytest
import torch
from little_body import moved_pose
from small_recipes import CASES, LATE

from twofold.errors import TwofoldError
from twofold.geometry.cameras import Camera, pixel_grid, pixel_rays
from twofold.geometry.rotations import axis_angle_to_matrix, rigid_inverse, rigid_transform
from twofold.losses import total
from twofold.methods.base import Mode, Rendering
from twofold.methods.boxed_avatar import BoxedAvatar
from twofold.methods.monohuman import MonoHumanAvatar
from twofold.methods.skeletal import SkeletalAvatar
from twofold.methods.subject import Subject
from twofold.methods.table import RECIPES
from twofold.outputs.views import render_image
from twofold.sampling.error_bounded import ErrorBoundedSampler
from twofold.training.pixels import PixelSource
from twofold.training.run import load_state


@pytest.fixture(scope="module")
def subject(person):
    return Subject.of(person)


@pytest.fixture(scope="module", params=list(RECIPES))
def recipe(request):
    return CASES[request.param]


@pytest.fixture(scope="module")
def avatar(recipe, subject):
    """A new avatar of the tiny person with a density that is not all haze; tests leave it as it is."""
    return opaque(recipe.method.build(subject, 0))


def opaque(avatar):
    with torch.no_grad():
        if isinstance(avatar, BoxedAvatar):
            getattr(avatar, "local", avatar).radiance.density.layers[-1].bias += 30
        elif isinstance(avatar, SkeletalAvatar):
            make_dense(avatar)
        else:
            avatar.raw_beta.fill_(0.02)
    return avatar.eval()


def make_dense(avatar):
    """Raises the density everywhere, which the likelihood then bounds to the person."""
    network, column = (avatar.canonical.network, 3) if hasattr(avatar, "canonical") else (avatar.field.geometry, 35)
    network.layers[-1].bias[column] += 30


@pytest.fixture
def posed(avatar, person):
    frame = person.train[1]
    return avatar.pose(frame.pose, frame.translation)


@pytest.fixture(scope="module")
def camera(person):
    return person.train[1].camera.resized(12, 12)


@pytest.fixture(scope="module")
def rays(camera):
    return pixel_rays(camera, pixel_grid(camera).flatten(0, 1))


BACKGROUND = torch.tensor([0.2, 0.9, 0.4])


def parts(rendering: Rendering) -> dict[str, torch.Tensor]:
    own = {name: getattr(rendering, name) for name in ("color", "opacity", "depth", "normal")}
    base = {} if rendering.base is None else {f"base.{name}": t for name, t in parts(rendering.base).items()}
    return own | base


def test_rendering_is_finite_and_opacity_a_share(avatar, posed, rays):
    with torch.no_grad():
        found = parts(avatar.render(rays, posed, BACKGROUND))
    assert all(tensor.isfinite().all() for tensor in found.values())
    for name in ("opacity", "base.opacity"):
        if name in found:
            assert found[name].min() >= 0
            assert found[name].max() <= 1 + 1e-5
            assert found[name].max() > 0.3, "the person is not to be seen"
    assert found["normal"].norm(dim=-1).max() <= 1 + 1e-4


def test_background_shows_through_by_what_opacity_leaves(avatar, posed, rays):
    with torch.no_grad():
        lit, dark = (avatar.render(rays, posed, background) for background in (BACKGROUND, torch.zeros(3)))
    torch.testing.assert_close(lit.color - dark.color, (1 - dark.opacity)[:, None] * BACKGROUND, rtol=0, atol=1e-5)


def test_rendering_without_a_generator_is_the_same_each_time(avatar, posed, rays):
    with torch.no_grad():
        first, second = (parts(avatar.render(rays, posed, BACKGROUND)) for _ in range(2))
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_rendering_with_a_generator_depends_on_its_seed_alone(avatar, posed, rays):
    seeds = (3, 3, 4)
    with torch.no_grad():
        one, same, other = (
            avatar.render(rays, posed, BACKGROUND, Mode(5), torch.Generator().manual_seed(seed)).color for seed in seeds
        )
    assert torch.equal(one, same)
    assert not torch.equal(one, other)


def test_rays_that_see_nobody_are_background_and_keep_a_gradient(avatar, recipe, posed, rays):
    away = type(rays)(rays.origins, -rays.directions, rays.near, rays.far)
    found = avatar.render(away, posed, BACKGROUND, Mode(5), torch.Generator().manual_seed(0))
    assert (found.base is None) == (avatar.render(rays, posed, BACKGROUND).base is None)
    # Samples of rays with bounds of a method's own may lie anywhere, where a density is small but not zero.
    own_bounds = recipe.name in ("vid2avatar", "vid2avatar_mask")
    allowed = 1e-6 if own_bounds else 0.0
    for part in (found, found.base or found):
        torch.testing.assert_close(part.color, BACKGROUND.expand_as(part.color), rtol=0, atol=allowed)
        assert part.opacity.max() <= allowed
    found.color.sum().backward()
    gradients = [p.grad.abs().max() for p in avatar.parameters() if p.grad is not None]
    assert all(g < 1e-4 if own_bounds else g == 0 for g in gradients)
    avatar.zero_grad(set_to_none=True)


def test_every_trainable_parameter_is_in_one_group_with_a_rate(avatar, recipe):
    groups = avatar.parameter_groups()
    listed = [id(p) for group in groups for p in group.parameters]
    assert sorted(listed) == sorted(id(p) for p in avatar.parameters() if p.requires_grad)
    assert all(group.rate > 0 for group in groups)


@pytest.mark.parametrize("name", CASES)
def test_losses_are_finite_and_every_parameter_learns(name, subject, person):
    """Of every ablation, too."""
    recipe = CASES[name]
    avatar = opaque(recipe.method.build(subject, 0)).train()
    if isinstance(avatar, MonoHumanAvatar):  # Nothing can be learned from key frames that are black.
        avatar.prepare_training(person, 0, torch.Generator())
    source = PixelSource(person.train, person.body, person.betas, recipe.training.pixels)
    for which in (0, 3):
        generator = torch.Generator().manual_seed(which)
        frame, batch = person.train[which], source.draw(which, generator)
        behind = avatar.background(torch.tensor(person.background), len(batch.rays), generator)
        batch, mode = batch.against(behind), Mode(LATE, LATE // 5)
        posed = avatar.pose(frame.pose, frame.translation, frame.frame_index, mode)
        rendering = avatar.render(batch.rays, posed, batch.background, mode, generator)
        terms = avatar.losses(rendering, batch, posed, mode, generator)
        assert "reconstruction" in terms
        assert all(term.isfinite() and term.ndim == 0 for term in terms.values())
        total(terms).backward()
    idle = set()
    for parameter_name, parameter in avatar.named_parameters():
        if not parameter.requires_grad:
            continue
        if parameter.grad is None or not parameter.grad.any():
            idle.add(parameter_name)
        else:
            assert parameter.grad.isfinite().all(), parameter_name
    assert idle <= NOTHING_TO_LEARN.get(name, set())


NOTHING_TO_LEARN = {"fast wo_comm": {f"field.low.color.layers.2.{part}" for part in ("bias", "gain", "direction")}}
"""Parameters without a gradient, and rightly so: colours of a base branch that is not shown."""


def test_level_is_the_distance_that_marching_cubes_want(avatar, posed, recipe):
    vertices = posed.body.vertices if avatar.level_space == "posed" else posed.body.canonical_vertices
    inside, outside = vertices.mean(0, keepdim=True), torch.tensor([[0.0, 2.5, 0.0]])
    with torch.no_grad():
        level = avatar.level(torch.cat([inside, outside]), posed)
        base = avatar.level(vertices, posed, "base")
    assert level[0] < 0 < level[1]
    assert base.shape == vertices.shape[:1]
    assert base.isfinite().all()
    with pytest.raises(ValueError, match="bottom"):
        avatar.level(inside, posed, "bottom")


def test_state_of_one_avatar_makes_another_the_same(avatar, recipe, subject, posed, person, rays, tmp_path):
    other = recipe.method.build(subject, 1).eval()
    frame = person.train[1]
    with torch.no_grad():
        before = avatar.render(rays, posed, BACKGROUND)
        assert not torch.equal(other.render(rays, posed, BACKGROUND).color, before.color)
        load_state(other, {name: t.clone() for name, t in avatar.state_dict().items()}, tmp_path)
        again = parts(other.render(rays, other.pose(frame.pose, frame.translation), BACKGROUND))
    assert all(torch.equal(again[name], tensor) for name, tensor in parts(before).items())


def test_the_same_seed_builds_the_same_avatar(recipe, subject):
    torch.manual_seed(1)
    first = recipe.method.build(subject, 3).state_dict()
    torch.manual_seed(2)
    second = recipe.method.build(subject, 3).state_dict()
    assert all(torch.equal(first[name], tensor) for name, tensor in second.items())


def test_size_of_the_chunks_does_not_change_the_image(avatar, recipe, posed, camera):
    whole, pieces = (render_image(avatar, posed, camera, BACKGROUND, size) for size in (None, 37))
    # As released, the error-bounded sampler goes on until all rays of a call are well enough known; depths of rays that
    # see next to nothing tell that most.
    shell = not isinstance(getattr(recipe.method, "sampler", None), ErrorBoundedSampler)
    for name in vars(whole) if shell else ("color", "opacity", "base"):
        allowed = 2e-5 if shell else 5e-3
        torch.testing.assert_close(getattr(pieces, name), getattr(whole, name), rtol=0, atol=allowed)


def change_by_moving(avatar, person, camera, turn: torch.Tensor, shift: torch.Tensor) -> torch.Tensor:
    """What changes in an image when camera and body are turned and shifted together, computed in the type of `turn`."""
    frame, dtype = in_type(person.train[1], turn.dtype), turn.dtype
    camera, background = in_type(camera, dtype), BACKGROUND.to(dtype)
    pelvis = (person.body.joints + person.body.joint_basis @ person.betas)[0].to(dtype)
    pose, translation = moved_pose(frame.pose, frame.translation, pelvis, turn, shift)
    world = rigid_transform(axis_angle_to_matrix(turn), shift)
    moved_camera = Camera(camera.world_to_camera @ rigid_inverse(world), camera.intrinsics, camera.height, camera.width)
    still = render_image(avatar, avatar.pose(frame.pose, frame.translation), camera, background)
    moved = render_image(avatar, avatar.pose(pose, translation), moved_camera, background)
    assert still.opacity.mean() > 0.1
    return (moved.color - still.color).abs()


def in_type(record, dtype):
    """A dataclass with its floating-point tensors, and those of the dataclasses in it, in another type."""
    values = {}
    for name, value in vars(record).items():
        if isinstance(value, torch.Tensor) and value.is_floating_point():
            values[name] = value.to(dtype)
        elif is_dataclass(value):
            values[name] = in_type(value, dtype)
    return replace(record, **values)


def test_shifting_camera_and_body_together_changes_no_pixel(avatar, person, camera):
    # Bone boxes have hard edges: in single precision rounding alone moves samples in and out of them.
    dtype = torch.float64 if isinstance(avatar, BoxedAvatar) else torch.float32
    if dtype == torch.float64:
        avatar = copy.deepcopy(avatar).double()
        avatar.subject = in_type(avatar.subject, dtype)
    shift = torch.tensor([0.5, -1.0, 0.25], dtype=dtype)
    change = change_by_moving(avatar, person, camera, torch.zeros(3, dtype=dtype), shift)
    assert change.max() < 1e-4


def test_turning_camera_and_body_together_changes_next_to_nothing(subject, person, camera):
    """Samples start at a box along the world's axes, so they are not the very same ones."""
    avatar = opaque(CASES["quick"].method.build(subject, 0))
    change = change_by_moving(avatar, person, camera, torch.tensor([0.3, -0.8, 0.5]), torch.tensor([0.5, -1.0, 0.25]))
    assert change.mean() < 1e-3


def test_query_agrees_with_level_and_gives_colours(avatar, posed):
    if avatar.level_space == "posed":
        with pytest.raises(TwofoldError, match="has no field that can be queried"):
            avatar.query(posed.body.canonical_vertices, posed)
        return
    x = posed.body.canonical_vertices[::9] + 0.004
    with torch.no_grad():
        for branch in ("full", "base"):
            answer = avatar.query(x, posed, branch=branch)
            assert torch.allclose(answer.sdf, avatar.level(x, posed, branch), atol=1e-6)
            assert answer.color.shape == x.shape
            assert answer.color.isfinite().all()


def test_light_is_left_out_only_where_the_method_separates_it(avatar, posed):
    if avatar.level_space == "posed":
        assert not avatar.separates_light
        return
    x = posed.body.canonical_vertices[::9]
    with torch.no_grad():
        if avatar.separates_light:
            avatar.field.light.weight.fill_(0.1)
        lit, unlit = avatar.query(x, posed), avatar.query(x, posed, lit=False)
        if avatar.separates_light:
            avatar.field.light.weight.zero_()
            assert torch.allclose(unlit.color, avatar.query(x, posed).color, atol=1e-6)
    assert torch.allclose(lit.color, unlit.color) != avatar.separates_light
    assert torch.allclose(lit.sdf, unlit.sdf, atol=1e-6)


def test_points_on_the_posed_body_map_to_its_canonical_surface(avatar, posed):
    if avatar.level_space == "posed":
        with pytest.raises(TwofoldError, match="does not map points"):
            avatar.to_canonical(posed.body.vertices, posed)
        return
    x, matrix = avatar.to_canonical(posed.body.vertices[::9], posed)
    assert matrix.shape == (len(x), 3, 3)
    assert (x - posed.body.canonical_vertices[::9]).norm(dim=-1).median() < 0.02
