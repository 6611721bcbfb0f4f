"""HDR, wide-gamut and 10-bit video against the formulas of the standards, colour by colour."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_clips import RIGHT, hold_phone, write_deep_clip

from twofold.prepare.video.frames import Frames
from twofold.prepare.video.hdr import (
    HLG,
    PEAK,
    PQ,
    WHITE,
    ColorSpace,
    hlg_light,
    pq_light,
    pq_signal,
    roll_off,
    srgb_light,
    srgb_signal,
    to_srgb,
)

BT709, BT2020, P3 = 1, 9, 12


def primaries_to_xyz(red, green, blue, white=(0.3127, 0.3290)):
    """The matrix of an RGB space from its chromaticities (SMPTE RP 177)."""
    columns = np.array([[x / y, 1, (1 - x - y) / y] for x, y in (red, green, blue)]).T
    x, y = white
    return columns * np.linalg.solve(columns, [x / y, 1, (1 - x - y) / y])


XYZ = {
    BT709: primaries_to_xyz((0.64, 0.33), (0.30, 0.60), (0.15, 0.06)),
    BT2020: primaries_to_xyz((0.708, 0.292), (0.170, 0.797), (0.131, 0.046)),
    P3: primaries_to_xyz((0.680, 0.320), (0.265, 0.690), (0.150, 0.060)),
}


def pq_literally(value):
    """ST 2084 with its constants as printed."""
    m1, m2, c1, c2, c3 = 0.1593017578125, 78.84375, 0.8359375, 18.8515625, 18.6875
    power = value ** (1 / m2)
    return 10000 * (max(power - c1, 0) / (c2 - c3 * power)) ** (1 / m1)


def pq_inverse(light):
    low, high = 0.0, 1.0
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if pq_literally(middle) < light else (low, middle)
    return low


def hlg_literally(value):
    a = 0.17883277
    b, c = 1 - 4 * a, 0.5 - a * math.log(4 * a)
    return value**2 / 3 if value <= 0.5 else (math.exp((value - c) / a) + b) / 12


def tone_literally(light):
    """BT.2390, 5.4.1, from 1000 to 203 cd/m^2."""
    top = pq_inverse(1000)
    bright, most = min(pq_inverse(light) / top, 1), pq_inverse(203) / top
    knee = 1.5 * most - 0.5
    if bright < knee:
        return light
    t = (bright - knee) / (1 - knee)
    spline = (2 * t**3 - 3 * t**2 + 1) * knee + (t**3 - 2 * t**2 + t) * (1 - knee) + (-2 * t**3 + 3 * t**2) * most
    return pq_literally(spline * top)


def expected(signal, transfer, primaries):
    """8-bit sRGB of one colour of the signal 0..1, as the module's text says."""
    if transfer == PQ:
        light = np.array([pq_literally(v) for v in signal])
    elif transfer == HLG:
        scene = np.array([hlg_literally(v) for v in signal])
        light = 1000 * (0.2627 * scene[0] + 0.6780 * scene[1] + 0.0593 * scene[2]) ** 0.2 * scene
    else:
        light = np.array([v / 12.92 if v <= 0.04045 else ((v + 0.055) / 1.055) ** 2.4 for v in signal])
    if transfer in (PQ, HLG):
        largest = max(light)
        light = light * (tone_literally(largest) / largest if largest > 0 else 0) / 203
    light = np.clip(np.linalg.solve(XYZ[BT709], XYZ[primaries] @ light), 0, 1)
    return [255 * (12.92 * v if v <= 0.0031308 else 1.055 * v ** (1 / 2.4) - 0.055) for v in light]


def ycbcr(signal, matrix):
    """Y'CbCr of 10 bits in limited range."""
    red, blue = (0.2126, 0.0722) if matrix == 1 else (0.2627, 0.0593)
    y = signal @ [red, 1 - red - blue, blue]
    cb, cr = (signal[..., 2] - y) / (2 - 2 * blue), (signal[..., 0] - y) / (2 - 2 * red)
    return np.round(np.stack([64 + 876 * y, 512 + 896 * cb, 512 + 896 * cr], -1)).astype(np.uint16)


def patches(seed=0):
    """Signals of 8 x 12 patches of 8 x 8 pixels: greys, pure colours and random ones."""
    colors = np.random.default_rng(seed).uniform(0.02, 0.98, (8, 12, 3))
    colors[0] = np.linspace(0, 1, 12)[:, None]
    colors[1, :6] = [[0.7, 0, 0], [0, 0.7, 0], [0, 0, 0.7], [0.7, 0.7, 0], [0.7, 0, 0.7], [0, 0.7, 0.7]]
    return colors


@pytest.mark.parametrize(
    ("transfer", "primaries", "matrix", "words"),
    [
        (HLG, BT2020, 9, "HDR video (HLG, BT.2020) was tone-mapped to sRGB."),
        (PQ, BT2020, 9, "HDR video (PQ, BT.2020) was tone-mapped to sRGB."),
        (PQ, P3, 9, "HDR video (PQ, Display P3) was tone-mapped to sRGB."),
        (14, BT2020, 9, "wide-gamut video (BT.2020) was converted to sRGB."),
    ],
)
def test_a_clip_comes_out_as_the_standards_say(tmp_path, transfer, primaries, matrix, words):
    colors = patches()
    image = np.repeat(np.repeat(ycbcr(colors, matrix), 8, 0), 8, 1)
    frames = Frames(write_deep_clip(tmp_path / "phone.mp4", [image] * 2, transfer, primaries, matrix))
    found = next(iter(frames)).image[4::8, 4::8].astype(float)
    wanted = np.array([[expected(color, transfer, primaries) for color in row] for row in colors])
    assert np.abs(found - wanted).max() <= 4  # The 10 bits of Y'CbCr alone are worth up to 3 where curves are steep.
    assert np.abs(found - wanted).mean() <= 0.6
    assert frames.remarks == (f"phone.mp4: {words}",)


def test_ten_bits_of_usual_colours_are_rounded_and_nothing_is_said(tmp_path):
    colors = patches()
    image = np.repeat(np.repeat(ycbcr(colors, 1), 8, 0), 8, 1)
    frames = Frames(write_deep_clip(tmp_path / "ten.mp4", [image] * 2, 1, 1, 1))
    found = next(iter(frames)).image[4::8, 4::8].astype(float)
    assert np.abs(found - 255 * colors).max() <= 2
    assert abs((found - 255 * colors).mean()) <= 0.3  # Cutting bits off would make it darker by a half.
    assert frames.remarks == ()


def test_an_hdr_clip_of_a_turned_phone_is_upright_and_made_smaller(tmp_path):
    """As phones write it: 4:2:0."""
    image = np.repeat(np.repeat(ycbcr(patches(), 9), 16, 0), 16, 1)
    path = hold_phone(write_deep_clip(tmp_path / "held.mp4", [image] * 2, HLG, BT2020, 9, "yuv420p10le"), RIGHT)
    frames = Frames(path, max_size=96)
    found = next(iter(frames)).image
    assert found.shape == (96, 64, 3)
    wanted = np.array([[expected(color, HLG, BT2020) for color in row] for row in patches()])
    assert np.abs(np.rot90(found[4::8, 4::8].astype(float)) - wanted).mean() < 4


def test_pq_and_its_inverse_are_those_of_the_standard():
    values = np.linspace(0, 1, 101)
    np.testing.assert_allclose(pq_light(values), [pq_literally(v) for v in values], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(pq_signal(pq_light(values)), values, atol=1e-6)
    np.testing.assert_allclose(hlg_light(values), [hlg_literally(v) for v in values], atol=1e-8)
    np.testing.assert_allclose(srgb_signal(srgb_light(values)), values, atol=1e-6)


def test_highlights_are_compressed_smoothly_and_shadows_stay():
    light = np.linspace(0, 1000, 4001)
    out = PEAK * roll_off(light)
    np.testing.assert_allclose(out, [tone_literally(one) for one in light], rtol=1e-4, atol=1e-3)
    steps = np.diff(out)
    assert (steps >= 0).all()
    assert (np.diff(steps[light[:-1] > 95]) <= 1e-6).all()
    np.testing.assert_allclose(out[light < 85], light[light < 85], atol=1e-6)
    assert out[-1] == pytest.approx(WHITE)


@given(level=st.integers(0, 65280), transfer=st.sampled_from([PQ, HLG, 14]), primaries=st.sampled_from([1, 9, 12]))
def test_grey_stays_grey_and_more_signal_is_never_darker(level, transfer, primaries):
    greys = np.array([level, min(level + 300, 65280)], np.uint16)
    found = to_srgb(np.repeat(greys[None, :, None], 3, 2), ColorSpace(transfer, primaries))[0].astype(int)
    assert np.ptp(found, axis=1).max() <= 1
    assert (found[1] >= found[0]).all()
