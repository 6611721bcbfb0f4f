"""How the background moves is measured in one place, and what is not verified is not claimed."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_clips import real_clip
from PIL import Image
from scipy import ndimage

from twofold.prepare.detect.background import SIZE, background_motion, shift_between, surroundings_of
from twofold.prepare.video.frames import Frames


def wall(seed=0, height=90, width=160, margin=20):
    """A background with something to see on it, larger than the image by `margin` pixels on each side."""
    rng = np.random.default_rng(seed)
    noise = ndimage.gaussian_filter(rng.standard_normal((height + 2 * margin, width + 2 * margin)), 2)
    return (128 + 38 * noise / noise.std()).clip(0, 255)


def view(background, across=0, down=0, person=40, seed=1, margin=20, gain=1.0):
    """What a camera that was moved sees of that wall, with a person of noise before it."""
    height, width = (side - 2 * margin for side in background.shape)
    top, left = margin + down, margin + across
    image = gain * background[top : top + height, left : left + width]
    mask = np.zeros(image.shape, np.uint8)
    mask[20:80, person : person + 25] = 255
    image[mask > 0] = np.random.default_rng(seed).uniform(0, 255, np.count_nonzero(mask))
    return surroundings_of(np.repeat(image[..., None], 3, 2).clip(0, 255).astype(np.uint8), mask)


@settings(max_examples=12)
@given(across=st.integers(-12, 12), down=st.integers(-8, 8), person=st.integers(10, 110), seed=st.integers(0, 99))
def test_a_background_that_moves_is_noticed_whatever_the_person_does(across, down, person, seed):
    first, now = view(wall(seed)), view(wall(seed), across, down, person, seed=2)
    assert shift_between(first, now) == (-down, -across)


@settings(max_examples=12)
@given(seed=st.integers(0, 99))
def test_what_cannot_be_verified_is_not_told(seed):
    """Neither as a shift nor as none: two walls, a plain one, one that the person hides."""
    first = view(wall(seed))
    assert shift_between(first, view(wall(seed + 1000))) is None
    assert shift_between(first, view(np.full_like(wall(), 77.0))) is None
    hidden = surroundings_of(np.zeros((90, 160, 3), np.uint8), np.full((90, 160), 255, np.uint8))
    assert shift_between(first, hidden) is None
    assert background_motion([first, view(wall(seed + 1000)), view(wall(seed + 2000))]).moved is None


def test_light_that_changes_moves_nothing():
    rows = np.linspace(0.4, 1.0, 130)[:, None]
    assert shift_between(view(wall()), view(wall() * rows, gain=0.8)) == (0, 0)


@settings(max_examples=12)
@given(speed=st.integers(1, 9), seed=st.integers(0, 20))
def test_a_pan_is_followed_far_beyond_the_first_image(speed, seed):
    """Backgrounds of the first and the last image have nothing in common."""
    background = wall(seed, margin=200)
    views = [view(background, across=-190 + 9 * speed * k, margin=200, seed=k) for k in range(380 // (9 * speed))]
    found = background_motion(views)
    wanted = [(0, -9 * speed * k) for k in range(len(views))]
    assert list(found.places) == wanted
    assert found.moved == 9 * speed * (len(views) - 1)


def test_pixels_are_those_of_the_image():
    """Three times as large an image moves by three times as many pixels."""
    background = np.kron(wall(), np.ones((3, 3)))

    def large(across):
        image = background[60 : 60 + 270, 60 + across : 60 + across + 480]
        return surroundings_of(np.repeat(image[..., None], 3, 2).astype(np.uint8), np.zeros((270, 480), np.uint8))

    assert max(large(0).grey.shape) == SIZE
    assert background_motion([large(0), large(30)]).moved == pytest.approx(30, abs=2)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("clip", "least", "most"),
    [("pose2sim/cam01.mp4", 0, 0), ("sam2_juggle/juggle.mp4", 0, 0), ("taiji/taiji.mp4", 8, 32)],
)
def test_real_cameras_stand_still_or_do_not(clip, least, most):
    """The person is not masked here, which is harder."""
    frames = Frames(real_clip(clip), 2, 960)
    views = [surroundings_of(p.image, np.zeros(p.image.shape[:2], np.uint8)) for p in frames]
    assert least <= background_motion(views).moved <= most


@pytest.mark.slow
@pytest.mark.parametrize("clip", ["pose2sim/cam01.mp4", "sam2_juggle/juggle.mp4", "taiji/taiji.mp4"])
def test_a_panning_crop_of_a_real_clip_is_followed(clip):
    frames = [p.image for p in Frames(real_clip(clip), 4, 960)]
    width = frames[0].shape[1]
    room = width // 2
    views = []
    for k, image in enumerate(frames[:40]):
        left = round(room * k / len(frames[:40]))
        part = np.asarray(Image.fromarray(image[:, left : left + width - room]))
        views.append(surroundings_of(np.ascontiguousarray(part), np.zeros(part.shape[:2], np.uint8)))
    moved = background_motion(views).moved
    assert moved == pytest.approx(room * (len(views) - 1) / len(frames[:40]), rel=0.12)
