"""Held objects leave a mask, what passes in front is found, clothes stay."""

import numpy as np
import pytest

from twofold.prepare.output.held_objects import (
    SeenBody,
    body_silhouette,
    object_mask,
    remove_held_objects,
    see_body,
    unlikeness,
    usual_colors,
)
from twofold.prepare.output.object_tracks import foreign_patches, without

SCALE = 100.0  # pixels a metre: the images below are 2 m high


def _disc(row: float, column: float, radius: float) -> np.ndarray:
    rows, columns = np.mgrid[:200, :200]
    return (rows - row) ** 2 + (columns - column) ** 2 <= radius**2


def _person() -> np.ndarray:
    body = np.zeros((200, 200), dtype=bool)
    body[20:180, 80:110] = True
    return body


def test_a_ball_beside_the_body_goes_and_the_body_stays() -> None:
    body, ball = _person(), _disc(120, 121, 11)
    cleaned = remove_held_objects(body | ball, body, SCALE)
    assert (cleaned & ball & ~body).sum() < 0.15 * (ball & ~body).sum()
    assert cleaned[body].all()


def test_clothes_three_centimetres_off_the_body_stay() -> None:
    body = _person()
    clothed = body.copy()
    clothed[60:120, 77:113] = True
    np.testing.assert_array_equal(remove_held_objects(clothed, body, SCALE), clothed)


def test_a_thin_margin_of_a_bad_fit_stays() -> None:
    body = _person()
    shifted = np.roll(body, 6, axis=1)
    np.testing.assert_array_equal(remove_held_objects(body | shifted, body, SCALE), body | shifted)


def test_a_piece_cut_off_with_the_object_goes_too() -> None:
    body, ball, crumb = _person(), _disc(120, 122, 11), np.zeros((200, 200), dtype=bool)
    crumb[118:122, 133:152] = True
    assert not remove_held_objects(body | ball | crumb, body, SCALE)[:, 140:].any()


def test_a_silhouette_is_the_union_of_its_triangles() -> None:
    corners = np.array([[10.0, 10.0], [30.0, 10.0], [30.0, 40.0], [10.0, 40.0]])
    shown = body_silhouette(corners, np.array([[0, 1, 2], [0, 2, 3]]), 60, 50)
    expected = np.zeros((60, 50), dtype=bool)
    expected[10:41, 10:31] = True
    np.testing.assert_array_equal(shown, expected)


def test_near_triangles_hide_far_ones_and_those_that_face_away() -> None:
    """Two squares, one behind the other and shifted, both facing the camera, and a third one facing away."""
    square = np.array([[0.0, 0.0], [0.0, 20.0], [20.0, 20.0], [20.0, 0.0]])
    pixels = np.concatenate([square + 20, square + 30, square + 25])
    depth = np.repeat([3.0, 2.0, 1.0], 4)
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7], [8, 10, 9], [8, 11, 10]])
    seen = see_body(pixels, depth, faces, 200.0, 80, 90)
    assert seen.pixels_per_metre == 100
    silhouette = seen.silhouette(80, 90)
    np.testing.assert_array_equal(silhouette, body_silhouette(pixels[:8], faces[:4], 80, 90))
    vertex = np.full((80, 90), -1)
    vertex[seen.window] = seen.vertex
    assert vertex[22, 23] == 0
    assert vertex[32, 33] == 4  # the near square's corner, not the far one's
    assert vertex[49, 32] == 5
    np.testing.assert_array_equal(seen.visible[:8], [True, True, False, True, True, True, True, True])


def test_usual_colours_are_those_of_most_sightings() -> None:
    random = np.random.default_rng(0)
    colors = random.integers(0, 255, (9, 4, 3), dtype=np.uint8)
    seen = random.random((9, 4)) < 0.8
    seen[:, 3] = False
    seen[:4, 3] = True
    usual, trusted = usual_colors(colors, seen)
    for vertex in range(4):
        ordered = np.sort(colors[seen[:, vertex], vertex], axis=0)
        np.testing.assert_array_equal(usual[vertex], ordered[(len(ordered) - 1) // 2] / 255)
    assert trusted.tolist() == [True, True, True, False]


SHIRT, TROUSERS, STRIPE, BALL = (0.35, 0.4, 0.5), (0.1, 0.1, 0.2), (0.5, 0.3, 0.3), (0.9, 0.9, 0.85)


def _striped() -> tuple[np.ndarray, SeenBody, np.ndarray]:
    """An image of somebody in a striped shirt and dark trousers, the body in it, and its usual colours."""
    body = _person()
    usual = np.zeros((200, 200, 3))
    usual[:100], usual[100:] = SHIRT, TROUSERS
    usual[20:100:16], usual[21:100:16] = STRIPE, STRIPE
    image = np.where(body[..., None], usual, (0.2, 0.4, 0.1))
    vertex = np.where(body, np.arange(40000).reshape(200, 200), -1)
    nothing = np.zeros(40000, dtype=int)
    seen = SeenBody((0, 0), vertex, nothing > 0, np.stack([nothing, nothing], 1), SCALE)
    return image, seen, usual.reshape(-1, 3)


def _hidden(
    image: np.ndarray, mask: np.ndarray, seen: SeenBody, usual: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """The mask without all patches that may be objects, and what they hide."""
    patches = foreign_patches(
        mask * np.uint8(255), (image * 255).astype(np.uint8), seen, usual, np.ones(len(usual), dtype=bool)
    ).patches
    return without(mask * np.uint8(255), patches)


def test_a_ball_in_front_of_a_striped_body_is_ignored_with_its_rim_and_the_mask_stays() -> None:
    image, seen, usual = _striped()
    ball, mask = _disc(110, 105, 9), _person() | _disc(110, 105, 9)
    image[ball] = BALL
    cleaned, hidden, share = _hidden(image, mask, seen, usual)
    assert hidden[_disc(110, 105, 10)].all()
    assert not hidden[~_disc(110, 105, 13)].any()
    assert share == pytest.approx((hidden & mask).sum() / mask.sum())
    np.testing.assert_array_equal(cleaned > 0, mask)


def test_folds_shading_edges_and_a_fit_that_is_off_are_no_objects() -> None:
    image, seen, usual = _striped()
    rows = np.arange(200)[:, None, None]
    shaded = image * (1 + 0.4 * np.sin(rows / 5)) * np.linspace(1.3, 0.6, 200)[None, :, None]
    for original in (image, shaded.clip(0, 1), np.roll(image, 3, axis=1), np.roll(image, -2, axis=0)):
        mask = np.roll(_person(), 3, axis=1) | _person()
        assert not _hidden(original, mask, seen, usual)[1].any()


def test_thin_things_are_no_objects_and_where_nothing_is_known_nothing_is_found() -> None:
    image, seen, usual = _striped()
    strap = image.copy()
    strap[60:160, 92:96] = BALL
    assert not _hidden(strap, _person(), seen, usual)[1].any()
    image[_disc(110, 95, 9)] = BALL
    bytes_ = (image * 255).astype(np.uint8)
    assert not unlikeness(bytes_, _person(), seen, usual, np.zeros(len(usual), dtype=bool)).any()


def test_what_sticks_out_is_an_object_only_in_other_colours_than_the_body_beside_it() -> None:
    image, seen, usual = _striped()
    thing = _disc(140, 121, 9)
    mask = _person() | thing
    for color, is_object in ((BALL, True), (TROUSERS, False)):
        image[thing & ~_person()] = color
        cleaned, hidden, _ = _hidden(image, mask, seen, usual)
        assert hidden[140, 124] == is_object
        assert (cleaned[140, 124] == 0) == is_object
    assert not hidden.any()


def test_more_than_a_quarter_of_the_mask_is_a_bad_fit() -> None:
    image, seen, usual = _striped()
    image[100:170, 80:110] = BALL
    cleaned, hidden, share = _hidden(image, _person(), seen, usual)
    assert share == 0
    assert not hidden.any()
    np.testing.assert_array_equal(cleaned > 0, _person())


def test_an_object_grows_only_so_far_into_what_is_like_it() -> None:
    image, seen, _ = _striped()
    mask = _person()
    mask[100:106, 110:180] = True
    image[100:106, 110:180] = BALL
    image[_disc(103, 100, 9)] = BALL
    unlike = np.where(_disc(103, 100, 9), 0.6, 0).astype(np.float32)
    found = object_mask((image * 255).astype(np.uint8), mask, seen, unlike, np.zeros_like(mask))
    assert found[103, 109:115].all()
    assert not found[:, 119:].any()
