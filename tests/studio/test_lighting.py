import numpy as np

from twofold.studio.lighting import KEY, cast_shade, illuminate, thread_beads, to_srgb
from twofold.studio.texture import Paint


def sheet(height, half, step=0.005):
    """A level square of vertices, facing up."""
    line = np.arange(-half, half, step)
    x, z = (a.ravel() for a in np.meshgrid(line, line))
    vertices = np.stack([x, np.full_like(x, height), z], -1).astype(np.float32)
    return vertices, np.tile(np.array([0, 1, 0], np.float32), (len(x), 1))


def shade_of(*sheets):
    vertices, normals = (np.concatenate(parts) for parts in zip(*sheets, strict=True))
    beads = thread_beads(vertices, normals)
    return cast_shade(vertices, normals, beads), vertices


def test_an_open_sheet_lies_in_full_light():
    (key, sky), _ = shade_of(sheet(0.0, 0.3))
    assert key.min() > 0.95
    assert sky.min() > 0.8
    assert sky.mean() > 0.95


def test_a_small_roof_throws_its_shadow_away_from_the_key_light():
    (key, sky), vertices = shade_of(sheet(0.0, 0.5), sheet(0.2, 0.1))
    floor = vertices[:, 1] == 0
    middle = -KEY / KEY[1] * 0.2
    in_shadow = np.hypot(vertices[:, 0] - middle[0], vertices[:, 2] - middle[2]) < 0.05
    assert key[floor & in_shadow].max() < 0.1
    far = np.hypot(vertices[:, 0] - middle[0], vertices[:, 2] - middle[2]) > 0.2
    assert key[floor & far].min() > 0.9
    assert key[~floor].min() > 0.9
    # Right under the roof much of the sky is hidden, too.
    under = np.hypot(vertices[:, 0], vertices[:, 2]) < 0.05
    assert sky[floor & under].mean() < 0.7


def test_beads_are_spread_evenly_and_mean_to_one():
    vertices, normals = sheet(0.0, 0.2)
    beads = thread_beads(vertices, normals)
    assert 0.1 < len(beads.chosen) / len(vertices) < 0.7
    assert np.allclose(beads.spread @ np.ones(len(beads.chosen), np.float32), 1, atol=1e-5)


def grey(count):
    return Paint(np.full((count, 3), 0.5, np.float32), np.zeros(count, np.float32))


def test_turning_the_surface_changes_its_colour_since_the_light_stays():
    normals = np.array([KEY, -KEY, [0, 1, 0], [0, -1, 0]], np.float32)
    ones = np.ones(4, np.float32)
    color = illuminate(grey(4), normals, normals, ones, ones)
    brightness = color.mean(1)
    assert brightness[0] > brightness[1] + 0.2
    assert brightness[2] > brightness[3] + 0.1
    assert color.min() > 0.05


def test_shadow_darkens_but_does_not_blacken():
    normals = np.array([KEY, KEY, KEY], np.float32)
    key, sky = np.array([1, 0, 0], np.float32), np.array([1, 1, 0], np.float32)
    lit, shadow, deep = illuminate(grey(3), normals, normals, key, sky).mean(1)
    assert lit > shadow + 0.1
    assert shadow > deep + 0.03
    assert deep > 0.05


def test_gloss_adds_a_highlight_only_where_the_light_is_mirrored():
    glossy = Paint(np.full((2, 3), 0.3, np.float32), np.full(2, 0.3, np.float32))
    normals = np.array([KEY, [1, 0, 0]], np.float32)
    views = np.stack([KEY, KEY])
    ones = np.ones(2, np.float32)
    matt = Paint(glossy.color, np.zeros(2, np.float32))
    gain = (illuminate(glossy, normals, views, ones, ones) - illuminate(matt, normals, views, ones, ones)).mean(1)
    assert gain[0] > 0.05
    assert gain[1] < 1e-3


def test_tones_rise_steadily_from_black_and_never_pass_white():
    light = np.linspace(0, 8, 2000, dtype=np.float32)[:, None].repeat(3, 1)
    tone = to_srgb(light)[:, 0]
    assert tone[0] == 0
    assert (np.diff(tone) >= 0).all()
    assert tone.max() <= 1
    assert abs(tone[np.searchsorted(light[:, 0], 0.2140)] - 0.5) < 0.01
