"""A clip gone through once: one clean person a mask, everything put aside as files, nothing kept in memory."""

import threading
import weakref

import numpy as np
import pytest
from disk import files_end_at
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from scipy import ndimage

from twofold.errors import TwofoldError
from twofold.prepare.detect import scan
from twofold.prepare.detect.scan import clean_mask, save_picture, spread_out, watch_clip
from twofold.prepare.detections import Observation, nobody
from twofold.prepare.video.frames import VideoFrame

HEIGHT, WIDTH = 60, 80


def soft_blobs(seed, threshold=0.5, height=HEIGHT, width=WIDTH):
    """Pieces and holes of all sizes with soft edges, as networks give them."""
    noise = ndimage.gaussian_filter(np.random.default_rng(seed).standard_normal((height, width)), 3)
    return (255 / (1 + np.exp(-8 * (noise / noise.std() - threshold)))).round().astype(np.uint8)


def pieces(mask):
    """Pixels of each piece of a mask, and of each piece of what is not the mask."""
    return [[labels == k + 1 for k in range(count)] for labels, count in (ndimage.label(mask), ndimage.label(~mask))]


@given(seed=st.integers(0, 10**6), threshold=st.floats(-1, 2))
def test_a_clean_mask_is_the_largest_piece_with_its_small_holes_filled(seed, threshold):
    mask = soft_blobs(seed, threshold)
    clean = clean_mask(mask)
    found, _ = pieces(mask > 127)
    if not found:
        assert not clean.any()
        return
    largest = max(found, key=np.sum)
    if sum(piece.sum() == largest.sum() for piece in found) > 1:
        return
    expected = largest.copy()
    for hole in pieces(largest)[1]:
        if hole.sum() < 2e-3 * largest.sum():
            expected |= hole
    assert np.array_equal(clean > 127, expected)
    near = ndimage.distance_transform_cdt(~expected, "taxicab") <= 3
    assert not clean[~near].any()
    assert np.array_equal(clean_mask(clean) > 127, expected)


def test_small_holes_are_filled_and_large_ones_stay():
    mask = np.zeros((100, 100), np.uint8)
    mask[10:90, 10:90] = 255
    mask[20:23, 20:23] = 0  # 9 of 6400
    mask[50:60, 50:60] = 0
    mask[95, 95] = 255
    clean = clean_mask(mask)
    assert (clean[20:23, 20:23] == 255).all()
    assert not clean[50:60, 50:60].any()
    assert clean[95, 95] == 0
    outer = mask.copy()
    outer[20:23, 20:23], outer[95, 95] = 255, 0
    assert np.array_equal(clean, outer)


def test_a_gap_at_the_image_edge_is_no_hole_of_the_background():
    """Everything else of the image is one large piece, which must never be filled."""
    mask = np.full((50, 50), 255, np.uint8)
    mask[0, 0] = 0
    assert (clean_mask(mask) == 255).all()
    mask[:, :5] = 0
    assert np.array_equal(clean_mask(mask), mask)


def test_soft_edges_stay_soft_but_narrow():
    columns = np.arange(60, dtype=float)
    ramp = np.clip(255 * (40 - columns) / 20, 0, 255).astype(np.uint8)  # over twenty pixels
    clean = clean_mask(np.tile(ramp, (40, 1)))[20]
    assert (np.diff(clean.astype(int)) <= 0).all()
    assert 2 <= ((clean > 0) & (clean < 255)).sum() <= 6
    assert ((clean > 127) == (ramp > 127)).all()


class Finder:
    """Sees a disc that wanders, with a speck beside it; remembers what it was shown."""

    offsets = np.full((33, 3), 0.01, np.float32)

    def __init__(self):
        self.shown, self.masks = [], []

    def __call__(self, image, seconds):
        self.shown.append((image.mean(), image.shape, seconds))
        if len(self.shown) == 3:
            return nobody(*image.shape[:2])
        mask = disc(20 + len(self.shown))
        mask[0, 0] = 255
        self.masks.append(weakref.ref(mask))
        k = float(len(self.shown))
        return Observation(np.full((33, 2), k), np.full(33, 0.8), np.full((33, 3), -k), mask)

    def close(self):
        pass


def disc(column, row=30, radius=10):
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    return (((columns - column) ** 2 + (rows - row) ** 2 < radius**2) * 255).astype(np.uint8)


def wall(seed=0):
    noise = ndimage.gaussian_filter(
        np.random.default_rng(seed).standard_normal((HEIGHT + 40, WIDTH + 40, 3)), (2, 2, 0)
    )
    return (128 + 50 * noise / noise.std()).clip(0, 255).astype(np.uint8)


def clip_frames(count, step=0, alive=None, every=1):
    """A wall seen by a camera that moves sideways by `step` pixels an image."""
    background = wall()
    for k in range(count):
        left = 20 + min(step * k, 20)
        image = background[20 : 20 + HEIGHT, left : left + WIDTH].copy()
        if alive is not None:
            alive.append(weakref.ref(image))
        image[0, k % WIDTH] = k  # No two are equal
        yield VideoFrame(k, k / 10, image, every * k, k)


def test_images_masks_and_landmarks_are_put_aside(tmp_path):
    finder, told = Finder(), []
    given = list(clip_frames(6, every=3))
    seen = watch_clip(iter(given), 6, finder, tmp_path / "a" / "b", progress=told.append)
    assert len(seen.images) == len(seen.masks) == len(seen.track) == 6
    assert seen.sources == (0, 3, 6, 9, 12, 15)
    assert told == pytest.approx([(k + 1) / 6 for k in range(6)])
    assert [second for *_, second in finder.shown] == pytest.approx([k / 10 for k in range(6)])
    for k, (original, image, mask) in enumerate(zip(given, seen.images, seen.masks, strict=True)):
        with Image.open(image) as stored:
            assert np.abs(np.asarray(stored).astype(int) - original.image).mean() < 2
        with Image.open(mask) as stored:
            expected = disc(21 + k) if k != 2 else np.zeros((HEIGHT, WIDTH), np.uint8)
            assert np.array_equal(np.asarray(stored), expected)
    assert seen.track.found.tolist() == [True, True, False, True, True, True]
    assert (seen.track.pixels[4] == 5).all()
    assert (seen.track.world[4] == -5).all()
    assert seen.offsets is finder.offsets
    assert sorted(path.name for path in (tmp_path / "a" / "b").iterdir()) == sorted(
        f"{k:06d}.{ending}" for k in range(6) for ending in ("jpg", "png")
    )


def test_the_estimator_sees_the_images_in_order_while_others_are_written_and_decoded(tmp_path, monkeypatch):
    """Three threads at a time, each at an image of its own."""
    at_work, names = threading.Barrier(3, timeout=20), set()

    def together(number):
        names.add(threading.get_ident())
        if number == 3:
            at_work.wait()

    class Slow(Finder):
        def __call__(self, image, seconds):
            found = super().__call__(image, seconds)
            together(len(self.shown) - 2)  # looks at image 4
            return found

    def decoded():
        for frame in clip_frames(8):
            together(frame.index - 2)  # decodes image 5
            yield frame

    finder, done = Slow(), []

    def save(path, pixels, **options):
        if path.suffix == ".jpg":
            done.append(path)
            together(len(done) - 1)  # writes image 3
        save_picture(path, pixels, **options)

    monkeypatch.setattr(scan, "save_picture", save)
    seen = watch_clip(decoded(), 8, finder, tmp_path)
    assert len(names) == 3
    assert [second for *_, second in finder.shown] == pytest.approx([k / 10 for k in range(8)])
    assert np.array_equal(seen.track.pixels[:, 0, 0], [1, 2, np.nan, 4, 5, 6, 7, 8], equal_nan=True)


@pytest.mark.parametrize("where", ["decoding", "estimating"])
def test_an_error_in_a_thread_is_the_users_sentence(tmp_path, where):
    class Fails(Finder):
        def __call__(self, image, seconds):
            if where == "estimating" and len(self.shown) == 2:
                raise TwofoldError("The third image is bad.")
            return super().__call__(image, seconds)

    def decoded():
        yield from clip_frames(2)
        if where == "decoding":
            raise TwofoldError("The third image is bad.")
        yield from clip_frames(4)

    before = threading.active_count()
    with pytest.raises(TwofoldError, match=r"^The third image is bad\.$"):
        watch_clip(decoded(), 6, Fails(), tmp_path)
    assert threading.active_count() == before


def test_images_are_undistorted_before_anybody_looks(tmp_path):
    finder = Finder()
    seen = watch_clip(clip_frames(3), 3, finder, tmp_path, undistort=lambda image: image // 2)
    plain = Finder()
    watch_clip(clip_frames(3), 3, plain, tmp_path / "plain")
    for (dark, *_), (bright, *_) in zip(finder.shown, plain.shown, strict=True):
        assert dark == pytest.approx(bright / 2, abs=1)
    with Image.open(seen.images[0]) as stored:
        assert np.asarray(stored).mean() < 100


def test_own_masks_are_taken_as_they_are(tmp_path):
    own = disc(50, radius=6)
    own[5, 5] = 200

    def given(source):
        return own if source == 4 else None

    seen = watch_clip(clip_frames(3, every=4), 3, Finder(), tmp_path, given=[given])
    stored = [np.asarray(Image.open(path)) for path in seen.masks]
    assert np.array_equal(stored[1], own)
    assert np.array_equal(stored[0], disc(21))
    seen = watch_clip(clip_frames(3, every=4), 3, Finder(), tmp_path, lambda image: np.roll(image, 3, 1), [given])
    with Image.open(seen.masks[1]) as original:
        assert np.array_equal(np.asarray(original), np.roll(own, 3, 1))


def test_memory_holds_a_few_images_only(tmp_path):
    alive, finder, most = [], Finder(), []

    def count(done):
        most.append(sum(image() is not None for image in alive) + sum(mask() is not None for mask in finder.masks))

    seen = watch_clip(clip_frames(60, alive=alive), 60, finder, tmp_path, progress=count)
    assert len(seen.sample) == 12
    # The sample, and the image at hand with its mask.
    assert max(most) <= 12 + 4
    assert sum(image() is not None for image in alive) == 12
    assert sum(mask() is not None for mask in finder.masks) <= 1


@pytest.mark.parametrize(("step", "least", "most"), [(0, 0.0, 0.5), (1, 10.0, 25.0)])
def test_a_camera_that_moves_is_noticed(tmp_path, step, least, most):
    seen = watch_clip(clip_frames(24, step), 24, Finder(), tmp_path)
    assert least <= seen.moved <= most


def test_a_clip_of_unknown_length_is_gone_through(tmp_path):
    told = []
    seen = watch_clip(clip_frames(5), 2, Finder(), tmp_path, progress=told.append)
    assert len(seen.images) == 5
    assert told[-1] == 1


def test_a_full_disk_is_said_in_one_sentence(tmp_path):
    with files_end_at(500), pytest.raises(TwofoldError, match=r"^Cannot write .*: .*\.$"):
        watch_clip(clip_frames(3), 3, Finder(), tmp_path / "scratch")


@given(count=st.integers(0, 300), most=st.integers(1, 50))
def test_spread_out_numbers_are_even(count, most):
    chosen = spread_out(count, most)
    assert len(chosen) == min(count, most)
    assert list(chosen) == sorted(set(chosen))
    if count:
        assert chosen[0] == 0
        assert all(0 <= c < count for c in chosen)
    if len(chosen) > 1:
        assert chosen[-1] == count - 1
        steps = np.diff(chosen)
        assert steps.max() - steps.min() <= 1
