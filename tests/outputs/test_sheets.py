"""Contact sheets hold every image unaltered in its place; colours of maps mean what they say."""

import numpy as np
import pytest
import torch

from twofold.geometry.cameras import Camera
from twofold.geometry.rotations import axis_angle_to_matrix, rigid_transform
from twofold.outputs.sheets import as_bytes, color_normals, residual_image, sheet


def noise(seed: int, height: int = 40, width: int = 30) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def place(page: np.ndarray, image: np.ndarray) -> tuple[int, int]:
    """Row and column of the one place where the page shows exactly this image."""
    height, width = image.shape[:2]
    windows = np.lib.stride_tricks.sliding_window_view(page, (height, width, 3))[:, :, 0]
    hits = np.argwhere((windows[..., 0, 0, :] == image[0, 0]).all(-1))
    found = [(int(i), int(j)) for i, j in hits if np.array_equal(page[i : i + height, j : j + width], image)]
    assert len(found) == 1
    return found[0]


def test_every_image_stands_in_its_row_and_column() -> None:
    images = [[noise(3 * i + j) for j in range(3)] for i in range(2)]
    page = sheet(images, ["first", "a second one"], ["truth", "full", "base"], title="Seed 7", footer="By nobody")
    places = np.array([[place(page, p) for p in row] for row in images])
    assert (places[:, :, 0] == places[:, :1, 0]).all(), "one height in a row"
    assert (places[:, :, 1] == places[:1, :, 1]).all(), "one left edge in a column"
    assert (np.diff(places[:, 0, 0]) > 40).all()
    assert (np.diff(places[0, :, 1]) > 30).all()


def ink(page: np.ndarray) -> int:
    return int((page < 128).all(-1).sum())


def test_labels_are_written_beside_the_images_not_over_them() -> None:
    white = np.full((60, 60, 3), 255, dtype=np.uint8)
    rows = [[white, white]]
    assert ink(sheet(rows)) == 0
    assert ink(sheet(rows, row_labels=["pose"])) > 20
    assert ink(sheet(rows, column_labels=["truth", "full"])) > 20
    assert ink(sheet(rows, title="Title")) > 20
    image = noise(1)
    place(sheet([[image]], ["a very long label that has to be broken"], ["wider than its image"]), image)


def test_text_is_never_cut_off() -> None:
    page = sheet(
        [[noise(1)]], ["left label"], ["wider than its image"], "A title wider than the whole page", "words " * 30
    )
    assert (page[:10] == 255).all()
    assert (page[-10:] == 255).all()
    assert (page[:, :10] == 255).all()
    assert (page[:, -10:] == 255).all()
    narrow = [noise(1), noise(2)]
    labelled = sheet([narrow], column_labels=["wider than its image", "wider than its image"])
    apart = place(labelled, narrow[1])[1] - place(labelled, narrow[0])[1]
    assert apart > place(sheet([narrow]), narrow[1])[1] - place(sheet([narrow]), narrow[0])[1] + 60


def test_empty_places_and_short_rows_stay_white() -> None:
    a, b, c = noise(1), noise(2), noise(3)
    page = sheet([[a, None, b], [c]])
    (top, first), (_, third), (second_row, left) = place(page, a), place(page, b), place(page, c)
    assert left == first
    assert (page[top : top + 40, first + 30 : third] == 255).all()
    assert (page[second_row : second_row + 40, left + 30 :] == 255).all()


def test_images_of_other_sizes_are_brought_to_one_height() -> None:
    page = sheet([[noise(1, 80, 60), noise(2, 40, 60)]], height=40)
    place(page, noise(2, 40, 60))
    occupied = np.flatnonzero((page < 255).any((1, 2)))
    assert occupied[-1] - occupied[0] + 1 == 40


def test_floats_are_stored_as_a_png_would() -> None:
    color = torch.rand(5, 4, 3, generator=torch.Generator().manual_seed(0))
    assert np.array_equal(as_bytes(color), (color * 255).round().numpy().astype(np.uint8))
    shade = torch.tensor([[0.0, 0.5], [1.0, 2.0]])
    assert np.array_equal(as_bytes(shade)[..., 1], [[0, 128], [255, 255]])
    assert as_bytes(shade).shape == (2, 2, 3)


def test_wrong_tables_are_refused() -> None:
    with pytest.raises(ValueError, match="at least one image"):
        sheet([[None]])
    with pytest.raises(ValueError, match="1 rows, but 2 row labels"):
        sheet([[noise(1)]], ["a", "b"])
    with pytest.raises(ValueError, match="2 columns, but 1 column labels"):
        sheet([[noise(1), noise(2)]], column_labels=["a"])


def test_normals_to_right_up_and_viewer_are_red_green_blue() -> None:
    axes = torch.eye(3)[None]
    colors = color_normals(0.7 * axes, torch.ones(1, 3))
    assert torch.allclose(colors[0], 0.5 + 0.5 * torch.eye(3))
    assert torch.equal(color_normals(torch.zeros(1, 1, 3), torch.zeros(1, 1)), torch.ones(1, 1, 3))
    half = color_normals(0.5 * axes[:, :1], torch.full((1, 1), 0.5))
    assert torch.allclose(half[0, 0], torch.tensor([1.0, 0.75, 0.75]))


def test_normals_look_the_same_from_every_camera_that_sees_the_same() -> None:
    rotation = axis_angle_to_matrix(torch.tensor([0.3, 2.0, -0.4]))
    camera = Camera(rigid_transform(rotation, torch.tensor([0.0, 0.0, 3.0])), torch.eye(3), 1, 3)
    seen = torch.tensor([[[1.0, 0, 0], [0, -1.0, 0], [0, 0, -1.0]]])  # OpenCV: y down, z away from the viewer
    colors = color_normals(seen @ rotation, torch.ones(1, 3), camera)
    assert torch.allclose(colors[0], 0.5 + 0.5 * torch.eye(3), atol=1e-6)


def test_residual_is_grey_where_nothing_was_added() -> None:
    base = torch.rand(4, 4, 3, generator=torch.Generator().manual_seed(0))
    assert torch.equal(residual_image(base, base), torch.full_like(base, 0.5))
    assert torch.allclose(residual_image(base + 0.1, base, gain=2.0), torch.full_like(base, 0.7))
    assert torch.equal(residual_image(base - 1, base), torch.zeros_like(base))
