"""Batches show the right pixels, drawn as asked, and leave out what nothing is known of."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from little_body import moved_pose
from PIL import Image
from tiny_capture import HEIGHT, WIDTH, write_tiny

from twofold.body.skeleton import pose_body, shape_body
from twofold.capture.folder import read_capture
from twofold.errors import TwofoldError
from twofold.geometry.cameras import project
from twofold.geometry.rotations import axis_angle_to_matrix, rigid_inverse, rigid_transform
from twofold.methods.base import Batch
from twofold.recipe import PixelConfig
from twofold.training.pixels import PixelSource

HIDDEN = (slice(10, 24), slice(14, 30))


@pytest.fixture(scope="module")
def hidden(tmp_path_factory):
    """The tiny capture with a rectangle ignored at time 1."""
    layer = np.zeros((HEIGHT, WIDTH), np.uint8)
    layer[HIDDEN] = 255
    return read_capture(write_tiny(tmp_path_factory.mktemp("hidden") / "tiny", ignored={("front", 1): layer}))


def pixels_of(capture, batch: Batch) -> tuple[torch.Tensor, torch.Tensor]:
    """Rows and columns that a batch looks at."""
    return pixels_seen_by(capture.train[1].camera, batch)


def pixels_seen_by(camera, batch):
    rays = batch.rays
    columns, rows = project(camera, rays.origins + 3 * rays.directions)[0].round().long().unbind(-1)
    return rows, columns


@pytest.mark.parametrize("surroundings", [None, 4])
def test_ignored_pixels_are_never_drawn(hidden, surroundings):
    config = PixelConfig(rays=500, surroundings=surroundings, patches=3, patch_size=12)
    source = PixelSource(hidden.train, hidden.body, hidden.betas, config)
    generator = torch.Generator().manual_seed(0)
    left_out = 0
    for _ in range(5):
        batch = source.draw(1, generator)
        rows, columns = pixels_of(hidden, batch)
        assert not hidden.train[1].ignored()[rows, columns].any()
        left_out += int((batch.patch_pixels < 0).sum())
        drawn = batch.patch_pixels[batch.patch_pixels >= 0]
        assert drawn.sort().values.tolist() == list(range(500, len(batch.mask)))
    assert left_out > 0
    rows, columns = pixels_of(hidden, source.draw(0, generator))
    seen = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    seen[rows, columns] = True
    assert seen[HIDDEN].any()


def test_an_image_that_ignores_all_of_the_person_is_one_sentence(hidden, tmp_path):
    layer = np.full((HEIGHT, WIDTH), 255, np.uint8)
    capture = read_capture(write_tiny(tmp_path / "tiny", ignored={("front", 0): layer}))
    source = PixelSource(capture.train, capture.body, capture.betas, PixelConfig())
    with pytest.raises(TwofoldError, match="ignores all of the person"):
        source.image(0)


def test_nothing_ignored_draws_as_if_there_were_no_layer(hidden):
    plain = tuple(replace(frame, ignored_file=None) for frame in hidden.train)
    empty = PixelSource(hidden.train, hidden.body, hidden.betas, PixelConfig())
    without = PixelSource(plain, hidden.body, hidden.betas, PixelConfig())
    first, second = (s.draw(2, torch.Generator().manual_seed(3)) for s in (empty, without))
    torch.testing.assert_close(first.color, second.color, rtol=0, atol=0)
    torch.testing.assert_close(first.rays.directions, second.rays.directions, rtol=0, atol=0)


@pytest.fixture(scope="module")
def noisy(tmp_path_factory):
    """A capture whose first image has another colour in every pixel, and a soft disk as its mask."""
    folder = tmp_path_factory.mktemp("noisy")
    capture = read_capture(write_tiny(folder / "tiny"))
    image = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    disk = np.clip((9 - np.hypot(rows - 18, columns - 26)) / 3, 0, 1)
    Image.fromarray(image).save(folder / "image.png")
    Image.fromarray((255 * disk).astype(np.uint8)).save(folder / "mask.png")
    frame = replace(capture.train[0], image_file=folder / "image.png", mask_file=folder / "mask.png")
    return replace(capture, splits={"train": (frame,)})


BACKGROUND = torch.tensor([0.1, 0.5, 0.9])


def source_of(capture, margin=0.2, **options):
    return PixelSource(capture.train, capture.body, capture.betas, PixelConfig(**options), margin)


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def brute_reachable(capture, margin):
    """Pixels within the margin, at the body's distance, of a projected vertex or of the mask."""
    frame = capture.train[0]
    body = pose_body(shape_body(capture.body, capture.betas), frame.pose, frame.translation)
    pixels, depth = project(frame.camera, body.vertices)
    inside = (frame.mask() > 0.5).nonzero().flip(-1)
    near = torch.cat([pixels.round(), inside]).tolist()
    near = [(x, y) for x, y in near if 0 <= x < WIDTH and 0 <= y < HEIGHT]
    reach = margin * float(frame.camera.intrinsics[0, 0] / depth.median())
    found = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    for row in range(HEIGHT):
        for column in range(WIDTH):
            found[row, column] = any((column - x) ** 2 + (row - y) ** 2 <= reach**2 for x, y in near)
    return found


def test_rays_see_the_image_on_the_background_at_their_own_pixels(noisy):
    batch = source_of(noisy).draw(0, seeded()).against(BACKGROUND)
    rows, columns = pixels_seen_by(noisy.train[0].camera, batch)
    image, mask = noisy.train[0].image(), noisy.train[0].mask()
    for i in range(0, len(batch.mask), 7):
        share = mask[rows[i], columns[i]]
        expected = image[rows[i], columns[i]] * share + torch.tensor([0.1, 0.5, 0.9]) * (1 - share)
        torch.testing.assert_close(batch.color[i], expected, atol=0.51 / 255, rtol=0)
        torch.testing.assert_close(batch.mask[i], share, atol=1e-6, rtol=0)
    assert 0.2 < batch.mask.mean() < 0.9


def test_every_pixel_of_a_patch_is_where_the_image_has_it(noisy):
    reachable = brute_reachable(noisy, 0.2)
    batch = source_of(noisy, patches=6, patch_size=13).draw(0, seeded())
    rows, columns = pixels_seen_by(noisy.train[0].camera, batch)
    assert (batch.patch_pixels < 0).any()
    for patch in batch.patch_pixels:
        i, j = (patch >= 0).nonzero().unbind(-1)
        ray = patch[i, j]
        top, left = int(rows[ray[0]] - i[0]), int(columns[ray[0]] - j[0])
        assert torch.equal(rows[ray], top + i)
        assert torch.equal(columns[ray], left + j)
        assert torch.equal(reachable[top : top + 13, left : left + 13], patch >= 0), (
            "left out if it cannot meet the body"
        )
    drawn = batch.patch_pixels[batch.patch_pixels >= 0]
    assert drawn.tolist() == list(range(batch.singles, len(batch.mask))), "after the single pixels, row by row"


def test_single_pixels_come_from_the_box_around_the_subject_and_from_around_the_body(noisy):
    reachable = brute_reachable(noisy, 0.2)
    batch = source_of(noisy, rays=4000, patches=0, subject_share=0.75).draw(0, seeded())
    assert batch.singles == len(batch.mask) == 4000
    assert batch.patch_pixels.shape == (0, 24, 24)
    rows, columns = pixels_seen_by(noisy.train[0].camera, batch)
    seen = [torch.zeros(HEIGHT, WIDTH, dtype=torch.bool) for _ in range(2)]
    seen[0][rows[:3000], columns[:3000]] = True
    seen[1][rows[3000:], columns[3000:]] = True
    inside = (noisy.train[0].mask() > 0.5).nonzero()
    box = torch.zeros_like(reachable)
    low, high = inside.amin(0), inside.amax(0) + 1
    box[low[0] : high[0], low[1] : high[1]] = True
    assert torch.equal(seen[0], box & reachable), "this many draws leave none out"
    assert not (seen[1] & ~reachable).any()
    assert (seen[1] & reachable).sum() > 0.5 * reachable.sum()


@pytest.mark.parametrize("margin", [0.0, 0.1, 0.3])
def test_reachable_pixels_are_those_near_the_body_or_the_mask(noisy, margin):
    found = source_of(noisy, margin=margin).image(0).reachable.long()
    assert torch.equal(found, brute_reachable(noisy, margin).flatten().nonzero()[:, 0])


def test_surroundings_are_so_many_pixels_around_the_mask(noisy):
    found = source_of(noisy, surroundings=3, margin=5.0).image(0).subject.long().tolist()
    inside = (noisy.train[0].mask() > 0.5).nonzero().tolist()
    expected = [
        row * WIDTH + column
        for row in range(HEIGHT)
        for column in range(WIDTH)
        if any((row - a) ** 2 + (column - b) ** 2 <= 9 for a, b in inside)
    ]
    assert found == expected


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_patches_are_centred_on_the_subject_as_often_as_asked(noisy, share):
    batch = source_of(noisy, patches=40, patch_size=5, patch_on_subject=share).draw(0, seeded())
    inside = (noisy.train[0].mask() > 0.5)[pixels_seen_by(noisy.train[0].camera, batch)]
    centers = [bool(inside[patch[2, 2]]) for patch in batch.patch_pixels if patch[2, 2] >= 0]
    assert len(centers) > 30
    # A patch at the border of the image moves inwards, so its middle is not what was drawn.
    assert sum(centers) == len(centers) if share else sum(centers) <= 3


def test_the_generator_decides_everything(noisy):
    source = source_of(noisy)
    first, again, other = (source.draw(0, seeded(seed)) for seed in (1, 1, 2))
    for name in ("color", "mask", "patch_pixels"):
        assert torch.equal(getattr(first, name), getattr(again, name))
    assert torch.equal(first.rays.directions, again.rays.directions)
    assert not torch.equal(first.color[:500], other.color[:500])
    fresh = source_of(noisy).draw(0, seeded(1))
    assert torch.equal(first.color, fresh.color), "what was drawn before does not matter"


def test_patches_larger_than_the_image_are_filled_as_far_as_it_goes(noisy):
    batch = source_of(noisy, patches=1, patch_size=60, margin=9.0).draw(0, seeded())
    expected = torch.full((60, 60), -1)
    expected[:HEIGHT, :WIDTH] = torch.arange(HEIGHT * WIDTH).view(HEIGHT, WIDTH) + batch.singles
    assert torch.equal(batch.patch_pixels[0], expected)


@given(seed=st.integers(0, 999))
@settings(max_examples=8)
def test_moving_body_and_camera_together_changes_no_pixel(noisy, seed):
    turn, shift = torch.randn(3, generator=seeded(seed)), torch.randn(3, generator=seeded(seed + 1))
    frame = noisy.train[0]
    pelvis = shape_body(noisy.body, noisy.betas).joints[0]
    pose, translation = moved_pose(frame.pose, frame.translation, pelvis, turn, shift)
    motion = rigid_transform(axis_angle_to_matrix(turn), shift)
    camera = replace(frame.camera, world_to_camera=frame.camera.world_to_camera @ rigid_inverse(motion))
    moved = replace(frame, pose=pose, translation=translation, camera=camera)
    here = source_of(noisy).draw(0, seeded(seed))
    there = source_of(replace(noisy, splits={"train": (moved,)})).draw(0, seeded(seed))
    assert torch.equal(here.color, there.color)
    assert torch.equal(here.mask, there.mask)
    assert torch.equal(here.patch_pixels, there.patch_pixels)
    origins = here.rays.origins @ motion[:3, :3].T + shift
    torch.testing.assert_close(there.rays.origins, origins, atol=1e-5, rtol=0)
    torch.testing.assert_close(there.rays.directions, here.rays.directions @ motion[:3, :3].T, atol=1e-5, rtol=0)


def test_images_are_read_once(noisy, monkeypatch):
    source = source_of(noisy)
    first = source.draw(0, seeded())
    monkeypatch.setattr(type(noisy.train[0]), "image", lambda frame: pytest.fail("read again"))
    assert torch.equal(source.draw(0, seeded()).color, first.color)


def test_a_mask_without_a_person_is_one_sentence(noisy, tmp_path):
    Image.fromarray(np.full((HEIGHT, WIDTH), 120, np.uint8)).save(tmp_path / "mask.png")
    frame = replace(noisy.train[0], mask_file=tmp_path / "mask.png")
    with pytest.raises(TwofoldError, match=r"mask\.png shows nobody"):
        source_of(replace(noisy, splits={"train": (frame,)})).draw(0, seeded())


def test_batches_go_to_the_device(noisy, device):
    batch, there = source_of(noisy).draw(0, seeded()), source_of(noisy).draw(0, seeded(), device)
    assert {t.device.type for t in (there.color, there.mask, there.patch_pixels, there.rays.near)} == {device.type}
    assert torch.equal(there.color.cpu(), batch.color)


RELEASED = {"reachable": "box", "subject": "any", "replacement": False}


def literal_box_hits(frame, joints, margin):
    """Pixels of whose ray exactly two of the six plane hits lie on the box, one ray at a time."""
    low, high = joints.amin(0).double() - margin, joints.amax(0).double() + margin
    camera, found = frame.camera, torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    for row in range(HEIGHT):
        for column in range(WIDTH):
            pixel = torch.tensor([column, row, 1.0], dtype=torch.float64)
            direction = camera.world_to_camera[:3, :3].T.double() @ (camera.intrinsics.double().inverse() @ pixel)
            direction = direction / direction.norm()
            direction = torch.tensor([1e-5 if abs(d) < 1e-5 else d for d in direction.tolist()], dtype=torch.float64)
            hits = 0
            for axis in range(3):
                for plane in (low[axis], high[axis]):
                    point = camera.center.double() + (plane - camera.center[axis]) / direction[axis] * direction
                    hits += bool((point >= low - 1e-6).all() and (point <= high + 1e-6).all())
            found[row, column] = hits == 2
    return found


@pytest.fixture(scope="module")
def far(noisy):
    """The noisy image from further away, so that the box of the joints does not fill it."""
    frame = noisy.train[0]
    moved = frame.camera.world_to_camera.clone()
    moved[2, 3] += 1.5
    camera = replace(frame.camera, world_to_camera=moved)
    return replace(noisy, splits={"train": (replace(frame, camera=camera),)})


def test_released_pools_are_the_box_of_the_joints_and_the_mask_without_its_last_row_and_column(far):
    frame, config = far.train[0], PixelConfig(**RELEASED)
    source = PixelSource(far.train, far.body, far.betas, config, box_margin=0.3142)
    joints = pose_body(shape_body(far.body, far.betas), frame.pose, frame.translation).joints
    hit = literal_box_hits(frame, joints, 0.3142)
    assert 0.1 < hit.float().mean() < 0.9
    image = source.image(0)
    assert image.reachable.tolist() == hit.flatten().nonzero()[:, 0].tolist()
    any_ = frame.mask() > 0
    rows, columns = [sorted(set(axis.tolist())) for axis in any_.nonzero(as_tuple=True)]
    box = [r * WIDTH + c for r in range(rows[0], rows[-1]) for c in range(columns[0], columns[-1]) if hit[r, c]]
    assert image.subject.tolist() == box
    assert torch.equal(image.inside, any_)


def test_released_pixels_are_drawn_once_and_not_rounded(far):
    frame, config = far.train[0], PixelConfig(rays=300, patches=3, patch_size=12, subject_share=0.7, **RELEASED)
    source = PixelSource(far.train, far.body, far.betas, config)
    batch = source.draw(0, seeded()).against(torch.tensor([0.1, 0.5, 0.9]))
    rows, columns = pixels_seen_by(frame.camera, batch)
    flat = (rows * WIDTH + columns).tolist()
    assert len(set(flat[:210])) == 210
    assert len(set(flat[210:300])) == 90
    share = frame.mask()[rows, columns, None]
    expected = frame.image()[rows, columns] * share + torch.tensor([0.1, 0.5, 0.9]) * (1 - share)
    torch.testing.assert_close(batch.color, expected, atol=1e-7, rtol=0)
    assert (batch.color * 255 - (batch.color * 255).round()).abs().max() > 0.3


def test_a_pool_smaller_than_the_draw_is_drawn_with_replacement(far):
    config = PixelConfig(rays=3000, patches=0, subject_share=1.0, **RELEASED)
    assert len(PixelSource(far.train, far.body, far.betas, config).draw(0, seeded()).mask) == 3000


@pytest.mark.parametrize("options", [{}, RELEASED])
def test_patches_show_the_image_where_no_ray_goes_and_fill_what_is_rendered_there(far, options):
    frame, background = far.train[0], torch.tensor([0.1, 0.5, 0.9])
    config = PixelConfig(patches=30, patch_size=20, **options)
    source = PixelSource(far.train, far.body, far.betas, config, margin=0.1)
    batch = source.draw(0, seeded()).against(background)
    rows, columns = pixels_seen_by(frame.camera, batch)
    share = frame.mask()[..., None]
    whole = frame.image() * share + background * (1 - share)
    rendered = batch.patches(batch.color, background).permute(0, 2, 3, 1)
    plain = batch.patches(batch.color).permute(0, 2, 3, 1)
    off = batch.patch_pixels < 0
    assert 0.02 < off.float().mean() < 0.98
    for patch in range(30):
        ray = batch.patch_pixels[patch]
        i, j = (ray >= 0).nonzero()[0].tolist()
        top, left = int(rows[ray[i, j]]) - i, int(columns[ray[i, j]]) - j
        shown = whole[top : top + 20, left : left + 20]
        torch.testing.assert_close(batch.patch_color[patch], shown, atol=0.51 / 255, rtol=0)
    torch.testing.assert_close(rendered[~off], batch.patch_color[~off])
    assert (rendered[off] == background).all()
    assert (plain[off] == 0).all()


def test_ignored_pixels_of_a_patch_are_background_in_the_image_too(hidden):
    config = PixelConfig(patches=20, patch_size=12, patch_on_subject=1.0)
    source = PixelSource(hidden.train, hidden.body, hidden.betas, config, margin=9.0)
    batch = source.draw(1, seeded()).against(BACKGROUND)
    off = batch.patch_pixels < 0
    assert off.any()
    assert (batch.patch_color[off] == torch.tensor([0.1, 0.5, 0.9])).all()


def test_pixels_of_the_whole_image_are_drawn_where_asked(hidden):
    source = PixelSource(hidden.train, hidden.body, hidden.betas, PixelConfig(rays=9000, reachable="image", patches=0))
    rows, columns = pixels_of(hidden, source.draw(1, torch.Generator().manual_seed(0)))
    seen = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    seen[rows, columns] = True
    assert seen[~hidden.train[1].ignored()].float().mean() > 0.7
    assert not seen[hidden.train[1].ignored()].any()


def test_rays_between_pixels_have_colours_between_theirs(hidden):
    """By the plain formula of bilinear interpolation, at places that lie in the squares of the pixels drawn."""
    config = PixelConfig(rays=200, reachable="image", patches=0)
    plain, between = (
        PixelSource(hidden.train, hidden.body, hidden.betas, replace(config, between=on)).draw(
            0, torch.Generator().manual_seed(0)
        )
        for on in (False, True)
    )
    camera, image = hidden.train[0].camera, (hidden.train[0].image() * 255).round() / 255
    place = project(camera, between.rays.origins + 3 * between.rays.directions)[0]
    pixel = project(camera, plain.rays.origins + 3 * plain.rays.directions)[0]
    assert (place - pixel).abs().max() < 0.5 + 1e-3
    assert (place - pixel).abs().mean() > 0.15
    for (column, row), color in zip(place.tolist(), between.image, strict=True):
        left, top = min(int(column), WIDTH - 2), min(int(row), HEIGHT - 2)
        u, v = column - left, row - top
        upper = (1 - u) * image[top, left] + u * image[top, left + 1]
        lower = (1 - u) * image[top + 1, left] + u * image[top + 1, left + 1]
        torch.testing.assert_close(color, (1 - v) * upper + v * lower, rtol=0, atol=2e-3)
