"""Held objects leave a mask, clothes stay."""

import numpy as np

from twofold.capture.masks import body_silhouette, remove_held_objects

SCALE = 100.0  # pixels a metre: the pictures below are 2 m high


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
