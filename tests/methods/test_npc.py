"""NPC: its stages, its points, and what the second stage renders and learns."""

import math
from dataclasses import replace

import pytest
import torch
import trimesh
from small_recipes import CASES

from twofold.body.skeleton import pose_body, shape_body
from twofold.errors import TwofoldError
from twofold.field.bone_boxes import RIGID_PARTS, box_coordinates, inside_boxes
from twofold.geometry.cameras import pixel_grid, pixel_rays
from twofold.losses import total
from twofold.methods.base import Mode
from twofold.methods.npc import npc
from twofold.methods.point_networks import surface_positions
from twofold.methods.subject import Subject
from twofold.outputs.mesh import posed_surface
from twofold.outputs.views import render_image
from twofold.training.loop import train
from twofold.training.pixels import PixelSource
from twofold.training.run import load_state

BACKGROUND = torch.tensor([0.2, 0.9, 0.4])
RECIPE = CASES["npc"]


@pytest.fixture(scope="module")
def subject(person):
    return Subject.of(person)


def with_points(subject, person, method=RECIPE.method, seed=0):
    """An avatar whose points lie on the faces of its boxes, as the first stage finds them where all is dense."""
    avatar = method.build(subject, seed)
    with torch.no_grad():
        avatar.local.radiance.density.layers[-1].bias += 100
    avatar.prepare_training(person, 1, torch.Generator().manual_seed(seed))
    return avatar


@pytest.fixture(scope="module")
def avatar(subject, person):
    avatar = with_points(subject, person).eval()
    with torch.no_grad():
        avatar.points.raw_beta.fill_(0.05)
    return avatar


@pytest.fixture
def posed(avatar, person):
    return avatar.pose(person.train[1].pose, person.train[1].translation)


@pytest.fixture(scope="module")
def camera(person):
    return person.train[1].camera.resized(12, 12)


@pytest.fixture(scope="module")
def rays(camera):
    return pixel_rays(camera, pixel_grid(camera).flatten(0, 1))


def test_parameters_are_those_of_the_authors_program(subject):
    avatar = npc().method.build(subject)
    frames = len(subject.times)
    assert sum(p.numel() for p in avatar.parameters()) == 2_454_852 + 128 * frames
    avatar.begin_points(torch.rand(200, 19, 3) - 0.5, torch.Generator(), 5)
    assert sum(p.numel() for p in avatar.parameters() if p.requires_grad) == 2_580_473 + 256 * frames


def test_every_trainable_parameter_of_a_stage_is_in_its_group(avatar, subject):
    for one in (avatar, RECIPE.method.build(subject)):
        listed = [id(p) for group in one.parameter_groups() for p in group.parameters]
        assert sorted(listed) == sorted(id(p) for p in one.parameters() if p.requires_grad)


def test_points_lie_on_the_first_stages_surface_in_their_boxes(subject, person):
    first = RECIPE.method.build(subject, 0)
    with torch.no_grad():
        first.local.radiance.density.layers[-1].bias += 100
    positions = first.find_positions()
    assert positions.shape == (RECIPE.method.points, len(RIGID_PARTS), 3)
    assert (positions.abs() <= 1).all()
    rest = torch.zeros(24, 3)
    posed = first.pose(rest, rest[0])
    first.begin_points(positions, torch.Generator(), 1)
    points = first.points.cloud.rest_points().flatten(0, 1)
    coordinates = box_coordinates(points, posed.own.to_frame, posed.own.half_sizes)
    deepest = (1 - coordinates[:, list(RIGID_PARTS)].abs().amax(-1)) * posed.own.half_sizes[list(RIGID_PARTS)].amax(-1)
    # All is dense in the boxes, so the surface is where no box is left: no point is deep in any.
    assert (inside_boxes(coordinates).any(-1)).all()
    assert deepest.amax(1).max() < 2 * RECIPE.method.point_voxel


def test_points_of_unseen_parts_lie_on_the_body(subject):
    first = RECIPE.method.build(subject, 0)
    with torch.no_grad():
        first.local.radiance.density.layers[-1].bias += 100
    hidden = RIGID_PARTS.index(9)
    positions, mixed = first.find_positions(), first.find_positions({hidden})
    others = [k for k in range(len(RIGID_PARTS)) if k != hidden]
    assert torch.equal(mixed[:, others], positions[:, others])
    first.begin_points(mixed, torch.Generator(), 1)
    rest = torch.zeros(24, 3)
    surface = pose_body(shape_body(subject.body, subject.betas), rest, rest[0])
    mesh = trimesh.Trimesh(surface.vertices.numpy(), surface.faces.numpy(), process=False)
    points = first.points.cloud.rest_points()[:, hidden].detach().numpy()
    assert trimesh.proximity.closest_point_naive(mesh, points)[1].max() < 1e-4


def test_a_first_stage_without_a_surface_is_told(subject, person):
    avatar = RECIPE.method.build(subject, 0)
    with torch.no_grad():
        avatar.local.radiance.density.layers[-1].bias -= 100
    with pytest.raises(TwofoldError, match="first stage found no surface in the rest pose"):
        avatar.find_positions()


def test_parts_with_too_little_surface_are_named(subject):
    joints = RECIPE.method.build(subject, 0).rest_joints
    volume = torch.ones(8, 8, 8)
    volume[3:5, 3:5, 3:5] = -1
    low = joints[0] - 0.035
    with pytest.raises(TwofoldError, match="needs 50 surface points for each body part, the pelvis has"):
        surface_positions(volume.numpy(), low, 0.01, joints, torch.full((24, 3), 0.1), 50)


@torch.no_grad()
def test_pixels_of_the_second_stage_are_those_of_a_loop(avatar, posed, rays):
    """Coarse samples alone, by the integral of density with the last interval open; none below 2 is seen."""
    bounded, hit = avatar.bounded(rays, posed.own)
    found = avatar.render(rays, posed, BACKGROUND)
    checked = 0
    for ray in hit.nonzero()[::7, 0].tolist():
        near, far, count = float(bounded.near[ray]), float(bounded.far[ray]), avatar.settings.coarse
        depths = [near + (far - near) * i / (count - 1) for i in range(count)]
        through, color = 1.0, torch.zeros(3)
        for i, depth in enumerate(depths):
            point = (bounded.origins[ray] + depth * bounded.directions[ray])[None]
            coordinates = box_coordinates(point, posed.own.to_frame, posed.own.half_sizes)
            if not inside_boxes(coordinates[:, list(RIGID_PARTS)]).any():
                continue
            at = avatar.points(posed.own.shared, point, bounded.directions[ray][None], posed.own.code)
            sdf, beta = float(at.extra), float(avatar.points.raw_beta.abs()) + 1e-4
            density = (0.5 + 0.5 * math.copysign(1, sdf) * (math.exp(-abs(sdf) / beta) - 1)) / beta
            assert float(at.density) == pytest.approx(density, rel=1e-4)
            if density >= 2:
                stopped = 1 - math.exp(-density * (depths[i + 1] - depth if i + 1 < count else 1e10))
                color, through = color + through * stopped * at.color[0], through * (1 - stopped)
                checked += 1
        expected = color + through * BACKGROUND
        torch.testing.assert_close(found.extras["coarse"][ray], expected, rtol=0, atol=2e-3)
    assert checked > 20


@torch.no_grad()
def test_the_second_stage_keeps_the_promises_of_rendering(avatar, posed, rays, camera):
    lit, dark = (avatar.render(rays, posed, background) for background in (BACKGROUND, torch.zeros(3)))
    assert lit.opacity.min() >= 0
    assert 0.3 < lit.opacity.max() <= 1 + 1e-5
    torch.testing.assert_close(lit.color - dark.color, (1 - dark.opacity)[:, None] * BACKGROUND, rtol=0, atol=1e-5)
    whole, pieces = (render_image(avatar, posed, camera, BACKGROUND, size) for size in (None, 37))
    torch.testing.assert_close(pieces.color, whole.color, rtol=0, atol=2e-5)
    away = avatar.render(type(rays)(rays.origins, -rays.directions, rays.near, rays.far), posed, BACKGROUND)
    assert torch.equal(away.color, BACKGROUND.expand_as(away.color))


@torch.no_grad()
def test_a_stored_second_stage_makes_a_new_avatar_the_same(avatar, subject, posed, rays, person, tmp_path):
    other = RECIPE.method.build(subject, 7).eval()
    load_state(other, {name: t.clone() for name, t in avatar.state_dict().items()}, tmp_path)
    again = other.pose(person.train[1].pose, person.train[1].translation)
    assert torch.equal(other.render(rays, again, BACKGROUND).color, avatar.render(rays, posed, BACKGROUND).color)


def test_a_damaged_state_does_not_fit(avatar, subject, tmp_path):
    state = {name: t.clone() for name, t in avatar.state_dict().items()}
    for name, wrong in (("points.cloud.positions", torch.zeros(3)), ("cameras", torch.zeros(0, 7, 4))):
        with pytest.raises(TwofoldError, match="does not fit its recipe"):
            load_state(RECIPE.method.build(subject, 7), state | {name: wrong}, tmp_path)


def test_everything_learns_in_the_second_stage(subject, person):
    avatar = with_points(subject, person).train()
    source = PixelSource(person.train, person.body, person.betas, RECIPE.training.pixels)
    for which in (0, 3):
        generator = torch.Generator().manual_seed(which)
        frame, batch = person.train[which], source.draw(which, generator)
        batch, mode = batch.against(avatar.background(BACKGROUND, len(batch.rays), generator)), Mode(5)
        posed = avatar.pose(frame.pose, frame.translation, frame.frame_index, mode)
        rendering = avatar.render(batch.rays, posed, batch.background, mode, generator)
        terms = avatar.losses(rendering, batch, posed, mode, generator)
        assert {"reconstruction", "coarse", "offsets", "eikonal", "neighbours", "surface", "background"} == set(terms)
        assert all(term.isfinite() for term in terms.values())
        total(terms).backward()
    idle = {n for n, p in avatar.named_parameters() if p.requires_grad and (p.grad is None or not p.grad.any())}
    # A bias that cancels in a difference (NPC's bone map).
    assert idle <= {"points.features.bone_map.bias"}


def test_terms_of_the_points_are_those_of_their_formulas(avatar, posed, person):
    """Nothing dropped, so that distances can be asked for again; offsets, neighbours and surface in loops."""
    import twofold.methods.point_networks as module

    before, module.DROPPED = module.DROPPED, 0.0
    try:
        terms = avatar.points.constraints(posed.own.shared, RECIPE.method.weights, torch.Generator().manual_seed(3))
    finally:
        module.DROPPED = before
    ready, cloud = posed.own.shared, avatar.points.cloud
    rest, moved = cloud.rest_points().flatten(0, 1).detach(), ready.posed.positions.detach()
    offsets = ready.posed.offsets.detach().norm(dim=-1).tolist()
    expected = sum(o * o for o in offsets if o > 0.04) / len(offsets)
    assert float(terms["offsets"].detach()) == pytest.approx(expected, abs=1e-7)
    errors = [
        (float((moved[i] - moved[j]).norm()) - float((rest[i] - rest[j]).norm())) ** 2
        for i, row in enumerate(cloud.neighbours.tolist()) for j in row[1:]
    ]  # fmt: skip
    assert float(terms["neighbours"].detach()) == pytest.approx(10 * sum(errors) / len(errors), rel=1e-3, abs=1e-7)
    generator = torch.Generator().manual_seed(3)
    slots = torch.randint(len(cloud.positions), (100, 19), generator=generator)
    number = (slots * 19 + torch.arange(19)).flatten()
    queries = moved[number] + 0.03 * (2 * torch.rand((1900, 3), generator=generator) - 1)

    def distance(at):
        coordinates = box_coordinates(at, ready.posed.world_to_frame, cloud.half_sizes)
        near = module.nearest_posed_points(at, coordinates, moved)
        return avatar.points.radiance.sdf(
            avatar.points.features(at, torch.zeros_like(at), near, cloud, ready.posed, ready.tables,
                                   torch.zeros(len(at), dtype=torch.bool))
        )  # fmt: skip

    asked = queries.requires_grad_(True)
    slope = torch.autograd.grad(distance(asked).sum(), asked)[0].norm(dim=-1)
    assert float(terms["eikonal"].detach()) == pytest.approx(0.01 * float((slope - 1).square().mean()), rel=1e-4)
    outside = distance(moved[number]).detach().clamp_min(0).mean()
    assert float(terms["surface"].detach()) == pytest.approx(0.1 * float(outside), rel=1e-4, abs=1e-8)


def test_pixels_of_training_rays_are_found_again(avatar, person):
    frame = person.train[2]
    grid = pixel_grid(frame.camera).flatten(0, 1)[::97]
    found = avatar._pixels(pixel_rays(frame.camera, grid), frame.frame_index)
    size = torch.tensor([frame.camera.width, frame.camera.height])
    torch.testing.assert_close(found, grid / size, rtol=0, atol=1e-4)


def test_a_surface_comes_out_of_the_second_stage(avatar, posed):
    vertices, faces = posed_surface(avatar, posed, voxel=0.05)
    assert len(faces) > 20
    assert vertices.isfinite().all()


@pytest.mark.slow
@pytest.mark.parametrize("stop_at", [2, 3, 5])
def test_either_stage_resumes_to_the_same_numbers(stop_at, person, tmp_path):
    training = replace(RECIPE.training, steps=3, images_per_step=1, checkpoint_every=1, preview_every=0)
    method = replace(RECIPE.method, first_steps=3)
    recipe = replace(RECIPE, method=method, training=training)
    cpu = torch.device("cpu")

    def dense(avatar):
        """Three steps find no surface; so it begins with one."""
        with torch.no_grad():
            avatar.local.radiance.density.layers[-1].bias += 100

    whole = train(person, recipe, tmp_path / "whole", cpu, before_first=dense)

    def stop(progress):
        if progress.step == stop_at:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(person, recipe, tmp_path / "parts", cpu, progress=stop, before_first=dense)
    parts = train(person, recipe, tmp_path / "parts", cpu, resume=True)
    assert whole.points is not None
    for key, tensor in whole.state_dict().items():
        assert torch.equal(tensor, parts.state_dict()[key]), key
