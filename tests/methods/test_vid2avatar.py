"""Vid2Avatar against slow literal forms of what its authors' program does."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from small_recipes import CASES

from twofold.errors import TwofoldError
from twofold.geometry.cameras import pixel_grid, pixel_rays, without_tiny_components
from twofold.geometry.surfaces import closest_on_triangles
from twofold.methods.base import EVALUATION, Mode
from twofold.methods.subject import Subject
from twofold.methods.table import RECIPES
from twofold.methods.vid2avatar import Vid2Avatar
from twofold.outputs.mesh import posed_surface
from twofold.training.loop import train
from twofold.training.pixels import PixelSource
from twofold.training.run import load, read_checkpoint

CPU = torch.device("cpu")
WHOLE, MASKED = CASES["vid2avatar"], CASES["vid2avatar_mask"]


@pytest.fixture(autouse=True)
def _own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.fixture(scope="module")
def room(person, tmp_path_factory):
    """The tiny person in front of an image of many colours."""
    folder, random = tmp_path_factory.mktemp("room"), np.random.default_rng(0)
    frames = []
    for frame in person.train:
        mask = frame.mask().numpy()[..., None]
        image = frame.image().numpy() * mask + random.random((*mask.shape[:2], 3)) * (1 - mask)
        file = folder / f"{frame.frame_index}.png"
        Image.fromarray((255 * image).round().astype(np.uint8)).save(file)
        frames.append(replace(frame, image_file=file))
    return replace(person, splits={**person.splits, "train": tuple(frames)})


def solid(recipe, subject) -> Vid2Avatar:
    avatar = recipe.method.build(subject, 3)
    with torch.no_grad():
        avatar.raw_beta.fill_(0.05)
    return avatar


@pytest.fixture(scope="module")
def subject(person):
    return Subject.of(person)


@pytest.fixture(scope="module")
def rays(person):
    camera = person.train[1].camera.resized(5, 5)
    return pixel_rays(camera, pixel_grid(camera).flatten(0, 1))


@pytest.mark.parametrize(("name", "count"), [("vid2avatar", 1_391_643), ("vid2avatar_mask", 815_851)])
@pytest.mark.parametrize("fast", ["", "_fast"])
def test_parameters_are_as_many_as_the_authors(name, count, fast, subject):
    avatar = RECIPES[name + fast]().method.build(subject, 0)
    poses = sum(p.numel() for p in avatar.refinement.parameters())
    codes = 32 * len(subject.times) if name == "vid2avatar" else 0
    assert sum(p.numel() for p in avatar.parameters()) == count + poses + codes


# ---- the scene behind the sphere


def literal_scene_point(origin, direction, rho):
    """The sphere hit, turned about (o x hit) by asin(|p| / R) - asin(|p| rho), p the foot of the perpendicular."""
    foot = origin - (origin @ direction) * direction
    hit = origin + ((9 - foot @ foot) ** 0.5 - origin @ direction) * direction
    axis = torch.linalg.cross(origin, hit)
    axis = axis / axis.norm()
    angle = torch.asin(foot.norm() / 3) - torch.asin(foot.norm() * rho)
    unit = hit / 3
    turned = (
        unit * angle.cos() + torch.linalg.cross(axis, unit) * angle.sin() + axis * (axis @ unit) * (1 - angle.cos())
    )
    return torch.cat([turned, rho[None]])


def literal_scene(avatar, rays, middle, row):
    colors = []
    for origin, direction in zip(rays.origins, rays.directions, strict=True):
        origin = (origin - middle) * avatar.subject.scene_scale
        inverse = torch.linspace(0, 1, avatar.config.scene_samples).flip(0) / 3
        points = torch.stack([literal_scene_point(origin, direction, rho) for rho in inverse])
        answer = avatar.scene(points, direction.expand(len(points), 3), avatar.codes[row])
        color, through = torch.zeros(3), 1.0
        for i in range(len(points)):
            delta = inverse[i] - inverse[i + 1] if i + 1 < len(points) else torch.tensor(1e10)
            alpha = 1 - torch.exp(-answer.density[i] * delta)
            color, through = color + through * alpha * answer.color[i], through * (1 - alpha)
        colors.append(color)
    return torch.stack(colors)


@pytest.mark.parametrize("center", ["body", "world"])
def test_scene_is_what_turned_sphere_points_add_up_to(center, subject, person, rays):
    method = replace(WHOLE.method, center=center)
    avatar, frame = solid(replace(WHOLE, method=method), subject), person.train[1]
    posed = avatar.pose(frame.pose, frame.translation, frame.frame_index)
    low, high = posed.body.vertices.amin(0), posed.body.vertices.amax(0)
    middle = (low + high) / 2 if center == "body" else subject.translations.mean(0) + subject.body.joints[0]
    expected = literal_scene(avatar, rays, middle, subject.times.tolist().index(frame.frame_index))
    torch.testing.assert_close(avatar.scene_color(rays, posed), expected, rtol=0, atol=2e-5)


# ---- the person in front of it


@pytest.mark.slow
@pytest.mark.parametrize("recipe", [WHOLE, MASKED], ids=["scene", "mask"])
@pytest.mark.parametrize("training", [False, True])
def test_pixels_are_the_printed_sum_over_samples(recipe, training, subject, person, rays):
    avatar, frame = solid(recipe, subject), person.train[1]
    mode, seed = (Mode(900, 61), 5) if training else (EVALUATION, None)
    posed = avatar.pose(frame.pose, frame.translation, frame.frame_index, mode)
    color = None if avatar.scene is not None else torch.tensor([0.2, 0.9, 0.4])
    rays = without_tiny_components(rays)  # as the program has them where rays begin at a box
    with torch.no_grad():
        found = avatar.render(rays, posed, color, mode, seed and torch.Generator().manual_seed(seed))
        generator = seed and torch.Generator().manual_seed(seed)
        bounded, behind = rays, color
        if avatar.scene is not None:
            behind = avatar.scene_color(rays, posed, generator)
            origins = (rays.origins - avatar._middle(posed.own.row)) * subject.scene_scale
            b = (origins * rays.directions).sum(1)
            far = (-b + (b**2 - origins.square().sum(1) + 9).sqrt()) / subject.scene_scale
            bounded = type(rays)(rays.origins, rays.directions, torch.zeros_like(far), far)
        placed = avatar.place(bounded, posed, mode, generator)
        x, matrix = avatar.to_canonical(placed.samples.points(rays), posed)
        answer = avatar.field(x, posed.own.condition, matrix)
        beta = avatar.raw_beta.abs() + 1e-4
        vertices = posed.body.vertices
        for ray in range(0, len(rays), 4):
            through, expected, opacity = 1.0, torch.zeros(3), 0.0
            for i in (placed.samples.ray_index == ray).nonzero()[:, 0].tolist():
                s, delta = answer.sdf[i], placed.samples.delta[i] * subject.scene_scale
                point = rays.origins[ray] + placed.samples.depth[i] * rays.directions[ray]
                away = (point - vertices).norm(dim=-1).min() * subject.scene_scale
                if away > 0.1 and not training:
                    s = torch.tensor(4.0)
                sigma = (0.5 + 0.5 * s.sign() * (torch.exp(-s.abs() / beta) - 1)) / beta
                alpha = 1 - torch.exp(-sigma * delta)
                expected, opacity = expected + through * alpha * answer.color[i], opacity + through * alpha
                through = through * (1 - alpha)
            back = behind if behind.ndim == 1 else behind[ray]
            torch.testing.assert_close(found.color[ray], expected + through * back, rtol=0, atol=1e-4)
            torch.testing.assert_close(found.opacity[ray], torch.as_tensor(opacity), rtol=0, atol=1e-4)


# ---- losses


def literal_distance(points, vertices, faces):
    """To all triangles; inside where these surround the point (solid angles, van Oosterom and Strackee 1983)."""
    found = []
    corners = vertices[faces]
    for point in points:
        a, b, c = (corners - point).unbind(1)
        feet = closest_on_triangles(point.expand_as(a), *corners.unbind(1))
        la, lb, lc = a.norm(dim=1), b.norm(dim=1), c.norm(dim=1)
        below = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
        turns = 2 * torch.atan2((a * torch.linalg.cross(b, c)).sum(1), below).sum() / (4 * math.pi)
        distance = (feet - point).norm(dim=1).min()
        found.append(-distance if turns > 0.5 else distance)
    return torch.stack(found)


@pytest.mark.slow
def test_losses_are_the_listed_terms(subject, room):
    avatar, frame = solid(WHOLE, subject), room.train[1]
    source = PixelSource(room.train, room.body, room.betas, WHOLE.training.pixels)
    batch, mode = source.draw(1, torch.Generator().manual_seed(0)), Mode(610, 122)
    posed = avatar.pose(frame.pose, frame.translation, frame.frame_index, mode)
    generator = torch.Generator().manual_seed(1)
    found = avatar.render(batch.rays, posed, None, mode, generator)
    terms = avatar.losses(found, batch, posed, mode, torch.Generator().manual_seed(2))
    generator = torch.Generator().manual_seed(1)
    avatar.scene_color(batch.rays, posed, generator)
    origins = (batch.rays.origins - avatar._middle(posed.own.row)) * subject.scene_scale
    b = (origins * batch.rays.directions).sum(1)
    far = (-b + (b**2 - origins.square().sum(1) + 9).sqrt()) / subject.scene_scale
    bounded = type(batch.rays)(batch.rays.origins, batch.rays.directions, torch.zeros_like(far), far)
    placed = avatar.place(bounded, posed, mode, generator)
    chosen = torch.arange(0, len(batch.rays), 8)
    for ray in chosen.tolist():
        own = placed.x_canonical[placed.samples.ray_index == ray]
        smallest = literal_distance(own, avatar.canonical_points, subject.body.faces).min()
        torch.testing.assert_close(found.extras["clearance"][ray], smallest, rtol=0, atol=1e-4)
    acc, clear = found.opacity.detach().double(), found.extras["clearance"]
    entropy = -(acc * (acc + 1e-6).log() + (1 - acc) * (1 - acc + 1e-6).log())
    far_off, inside = acc[clear > 0.05], acc[clear <= 0]
    assert len(far_off)
    assert len(inside)
    expected = {
        "reconstruction": (found.color.detach() - batch.image).abs().mean(),
        "binarisation": 5e-3 * 2 * entropy.mean(),
        "sparseness": 3e-3 * (1 + 122**2 / 40) * far_off.abs().mean(),
        "in_shape": 1e-2 * (1 - 122 / 200) * (1 - inside).abs().mean(),
    }
    assert terms.keys() == {*expected, "eikonal"}
    for name, value in expected.items():
        torch.testing.assert_close(terms[name].detach().double(), value.double(), rtol=1e-4, atol=1e-7, msg=name)


def test_with_masks_the_terms_are_colour_eikonal_and_mask(subject, person):
    avatar, frame = solid(MASKED, subject), person.train[1]
    source = PixelSource(person.train, person.body, person.betas, MASKED.training.pixels)
    color, mode = torch.tensor(person.background), Mode(0)
    batch = source.draw(1, torch.Generator().manual_seed(0)).against(color)
    posed = avatar.pose(frame.pose, frame.translation, frame.frame_index, mode)
    found = avatar.render(batch.rays, posed, color, mode, torch.Generator().manual_seed(0))
    terms = avatar.losses(found, batch, posed, mode, torch.Generator().manual_seed(0))
    assert set(terms) == {"reconstruction", "eikonal", "mask"}
    inside = batch.mask >= 1
    expected = (found.opacity[inside] - 1).abs().mean() + found.opacity[~inside].abs().mean()
    torch.testing.assert_close(terms["mask"], 0.1 * expected)


# ---- trainings


def short(name, **changes):
    """Nine steps of a shrunk recipe whose canonical surface is extracted at each epoch of five steps."""
    recipe = CASES[name]
    method = replace(recipe.method, prefit=replace(recipe.method.prefit, steps=60, points=256, pool=2000), **changes)
    if method.separation.needs_surface:
        method = replace(method, separation=replace(method.separation, surface_every=1))
    training = replace(recipe.training, steps=9, images_per_step=1, checkpoint_every=3, preview_every=0)
    return replace(recipe, method=method, training=training)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["vid2avatar_fast", "vid2avatar_mask_fast"])
def test_an_interrupted_training_continues_to_the_same_numbers(name, room, tmp_path):
    torch.set_num_threads(1)
    recipe = short(name)

    class Stop(Exception):
        """Stands for whatever ends a run between two checkpoints."""

    def on_step(progress):
        if progress.step == 7:
            raise Stop

    whole = train(room, recipe, tmp_path / "whole", CPU)
    with pytest.raises(Stop):
        train(room, recipe, tmp_path / "cut", CPU, progress=on_step)
    train(room, recipe, tmp_path / "cut", CPU, resume=True)
    first, second = (read_checkpoint(tmp_path / run)[0] for run in ("whole", "cut"))
    assert first.keys() == second.keys()
    assert all(torch.equal(second[key], tensor) for key, tensor in first.items())
    if whole.scene is not None:
        assert len(whole.surface_vertices) != len(whole.canonical_points), "the surface was not extracted"
    again, steps = load(tmp_path / "whole")
    assert steps == 9
    frame = room.train[0]
    vertices, _ = posed_surface(again, again.pose(frame.pose, frame.translation, frame.frame_index), 0.03)
    assert len(vertices) > 100


def test_images_without_a_background_are_refused_before_anything_is_written(person, tmp_path):
    with pytest.raises(TwofoldError, match=r"one colour behind the person.*vid2avatar_mask"):
        train(person, short("vid2avatar_fast"), tmp_path / "run", CPU)
    assert not (tmp_path / "run").exists()


def test_cameras_outside_of_the_sphere_are_refused(room, subject):
    far = replace(subject, scene_scale=5.0)
    with pytest.raises(TwofoldError, match=r"camera front is outside the sphere.*center=world"):
        WHOLE.method.build(far, 0).check_capture(room)


def test_damaged_surface_is_one_sentence(subject):
    avatar = WHOLE.method.build(subject, 0)
    state = {name: tensor.clone() for name, tensor in avatar.state_dict().items()}
    state["surface_faces"][0, 0] = len(state["surface_vertices"])
    with pytest.raises(TwofoldError, match="surface in the checkpoint is damaged"):
        avatar.load_stored(state)


def test_surface_stays_where_the_field_has_none(subject):
    avatar = WHOLE.method.build(subject, 0)
    with torch.no_grad():
        avatar.field.networks.sdf.layers[-1].bias[0] += 5
    before = avatar.surface_vertices.clone()
    avatar.before_step(Mode(100, 20, True))
    assert torch.equal(avatar.surface_vertices, before)


@pytest.mark.parametrize("change", [{"scene_samples": 1}, {"losses": MASKED.method.losses}])
def test_settings_that_exclude_each_other_are_refused(change):
    with pytest.raises(ValueError, match=r"scene_samples|losses\.mask"):
        replace(WHOLE.method, **change)
    with pytest.raises(ValueError, match=r"sampler\.box=rays"):
        replace(WHOLE.method, sampler=replace(WHOLE.method.sampler, box="posed"))
