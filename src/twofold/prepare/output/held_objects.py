"""Masks that take in more than the person: held and passing objects found with the help of the posed body.

What sticks out of the body shows in the silhouette. What passes in front of it shows in the colours alone: every vertex
has a usual colour, the median over the frames that see it, and a thick patch of other colours hides the person.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy import ndimage

from twofold.geometry.face_kernels import nearest_faces

MIN_SIGHTINGS = 5
"""A vertex seen in fewer frames has no usual colour."""


@dataclass(frozen=True)
class SeenBody:
    """What a camera sees of a posed body.

    Attributes:
        top: first row and first column of the window that `vertex` covers.
        vertex: the visible vertex nearest to each pixel of the window, -1 beside the body.
        visible: which vertices are seen.
        pixels: where the vertices are (column, row), rounded.
        pixels_per_metre: at the body's distance.
    """

    top: tuple[int, int]
    vertex: Int[np.ndarray, "a b"]
    visible: Bool[np.ndarray, "V"]
    pixels: Int[np.ndarray, "V 2"]
    pixels_per_metre: float

    @property
    def window(self) -> tuple[slice, slice]:
        """The rows and columns of the image that `vertex` covers."""
        (row, column), (height, width) = self.top, self.vertex.shape
        return slice(row, row + height), slice(column, column + width)

    def silhouette(self, height: int, width: int) -> Bool[np.ndarray, "h w"]:
        """The pixels that the body covers."""
        whole = np.zeros((height, width), dtype=bool)
        whole[self.window] = self.vertex >= 0
        return whole


def body_silhouette(
    pixels: Float[np.ndarray, "V 2"], faces: Int[np.ndarray, "F 3"], height: int, width: int
) -> Bool[np.ndarray, "h w"]:
    """Which pixels a body covers whose vertices, all in front of the camera, project to `pixels` (column, row)."""
    first, second, third = (pixels[faces[:, corner]] for corner in range(3))
    one, other = second - first, third - first
    away = one[:, 0] * other[:, 1] > one[:, 1] * other[:, 0]
    facing = np.where(away[:, None], faces[:, ::-1], faces)
    return _nearest(pixels, np.ones(len(pixels)), facing, height, width) >= 0


def _nearest(
    pixels: Float[np.ndarray, "V 2"],
    depth: Float[np.ndarray, "V"],
    faces: Int[np.ndarray, "F 3"],
    height: int,
    width: int,
) -> Int[np.ndarray, "h w"]:
    """The nearest of the triangles that face the camera behind each pixel's centre, -1 where there is none."""
    points = np.concatenate([pixels, depth[:, None]], 1).astype(np.float32)
    face = np.full((height, width), -1, np.int32)
    nearest_faces(points, faces.astype(np.int32), np.zeros((height, width), np.float32), face, 0, height)
    return face


def see_body(
    pixels: Float[np.ndarray, "V 2"],
    depth: Float[np.ndarray, "V"],
    faces: Int[np.ndarray, "F 3"],
    focal: float,
    height: int,
    width: int,
    tolerance: float = 0.02,
) -> SeenBody:
    """Which part of a body is seen in each pixel.

    Args:
        pixels: where its vertices project to (column, row).
        depth: of the vertices, metres, all above 0.
        faces: its triangles.
        focal: of the camera, pixels.
        height: of the image.
        width: of the image.
        tolerance: a vertex so far behind the surface still counts as seen, metres.
    """
    pixels_per_metre = focal / float(np.median(depth))
    margin = np.ceil(0.3 * pixels_per_metre)
    low = np.clip(np.floor(pixels.min(0)) - margin, 0, (width - 1, height - 1)).astype(int)
    high = np.clip(np.ceil(pixels.max(0)) + margin + 1, low + 1, (width, height)).astype(int)
    columns, rows = (high - low).tolist()
    face = _nearest(pixels - low, depth, faces, rows, columns)
    rows, columns = np.nonzero(face >= 0)
    corners = faces[face[rows, columns]]
    away = np.square(pixels[corners] - low - np.stack([columns, rows], -1)[:, None]).sum(-1)
    vertex = np.full(face.shape, -1)
    vertex[rows, columns] = corners[np.arange(len(corners)), away.argmin(1)]
    rounded = np.rint(pixels).astype(int)
    shown = ((rounded >= low) & (rounded < high)).all(1)
    column, row = (np.where(shown[:, None], rounded, low) - low).T
    depths = np.append(depth[faces].mean(1), -np.inf)  # the last one where nothing is painted
    front = depths[face[row, column]]
    return SeenBody((int(low[1]), int(low[0])), vertex, shown & (depth <= front + tolerance), rounded, pixels_per_metre)


def usual_colors(
    colors: UInt8[np.ndarray, "T V 3"], seen: Bool[np.ndarray, "T V"]
) -> tuple[Float[np.ndarray, "V 3"], Bool[np.ndarray, "V"]]:
    """The median colour (0..1) of each vertex over the frames that see it, and for which vertices it can be trusted.

    Example:
        >>> colors = np.full((6, 1, 3), 51, dtype=np.uint8)
        >>> colors[2] = 255  # something passed by
        >>> usual_colors(colors, np.ones((6, 1), dtype=bool))[0].tolist()
        [[0.2, 0.2, 0.2]]
    """
    count = seen.sum(0)
    ordered = np.sort(np.where(seen[..., None], colors, 255).astype(np.uint8), axis=0)
    middle = np.maximum(count - 1, 0) // 2
    return ordered[middle, np.arange(len(middle))] / 255, count >= MIN_SIGHTINGS


def unlikeness(
    image: UInt8[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"],
    seen: SeenBody,
    usual: Float[np.ndarray, "V 3"],
    trusted: Bool[np.ndarray, "V"],
    shift: float = 0.03,
) -> Float[np.ndarray, "h w"]:
    """How far the colours of an image are from all usual ones near them, mean of the channels.

    So folds, shading and the edges of a shirt do not count. Beside the body the nearest part of it is expected; 0 where
    nothing is.

    Args:
        image: the image.
        mask: where to look, beside the body.
        seen: the fitted body.
        usual: colours of the body's vertices, 0..1 (`usual_colors`).
        trusted: which of these are known.
        shift: by so much the fitted body may be off, metres.
    """
    out = np.zeros(mask.shape, dtype=np.float32)
    window, body = seen.window, seen.vertex >= 0
    known = body & trusted[seen.vertex]
    if not known.any():
        return out
    row, column = np.asarray(ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True))
    expected = usual[seen.vertex[row, column]].astype(np.float32)
    where = np.where(body, known, mask[window])
    out[window] = _least_difference(
        image[window].astype(np.float32) / 255, expected, where, shift * seen.pixels_per_metre
    )
    return out


def object_mask(
    image: UInt8[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"],
    seen: SeenBody,
    unlike: Float[np.ndarray, "h w"],
    beside: Bool[np.ndarray, "h w"],
    difference: float = 0.25,
    thickness: float = 0.035,
    growth: float = 0.06,
    rim: float = 0.02,
) -> Bool[np.ndarray, "h w"]:
    """Pixels that show something else than the person although a mask has them, or near it: a ball, somebody's arm.

    Only a patch of unlike colours that holds a disc of radius `thickness` counts as an object. It takes in what hangs
    together with it and has its colour, as far as that is off the body or not the body's colour, and a rim.

    Args:
        image: the image.
        mask: as estimated.
        seen: the fitted body in it.
        unlike: how far its colours are from the usual ones (`unlikeness`).
        beside: what is an object already, because it sticks out; grown as the others are.
        difference: from here on a colour is unlike.
        thickness: metres.
        growth: so far a patch may take in what is like it, metres.
        rim: metres.
    """
    out = np.zeros(mask.shape, dtype=bool)
    window, scale, body = seen.window, seen.pixels_per_metre, seen.vertex >= 0
    unlike, shown = unlike[window], image[window].astype(np.float32) / 255
    foreign = mask[window] & (unlike > difference)
    seeds = _depth(foreign) >= thickness * scale
    solid = beside[window].copy()
    if seeds.any():
        solid |= foreign & (_depth(~seeds) <= 1.5 * thickness * scale)
    if not solid.any():
        return out
    away = _depth(~solid) / scale
    reach = (mask[window] | body) & (away <= growth) & (~body | (unlike > 0.5 * difference))
    found = solid.copy()
    for piece in _pieces(solid):
        color = np.median(shown[piece], axis=0)
        alike = reach & (np.abs(shown - color).mean(-1) < 0.5 * difference)
        found |= ndimage.binary_propagation(piece, mask=alike | piece)
    # Vertices without a usual colour leave holes.
    found = np.asarray(ndimage.binary_fill_holes(found))
    out[window] = _depth(~found) <= rim * scale
    return out


def objects_beside(
    person: Bool[np.ndarray, "h w"], seen: SeenBody, unlike: Float[np.ndarray, "h w"], difference: float = 0.25
) -> Bool[np.ndarray, "h w"]:
    """Pixels that stick out of the body, but for what has the colours of the body next to it: a limb fitted badly.

    Args:
        person: the mask.
        seen: the fitted body in the image.
        unlike: how far its colours are from the usual ones (`unlikeness`).
        difference: from here on a colour is unlike.
    """
    beside = person & ~remove_held_objects(person, seen.silhouette(*person.shape), seen.pixels_per_metre)
    for piece in _pieces(beside):
        if np.median(unlike[piece]) < difference:
            beside[piece] = False
    return beside


def _least_difference(
    shown: Float[np.ndarray, "h w 3"],
    expected: Float[np.ndarray, "h w 3"],
    where: Bool[np.ndarray, "h w"],
    radius: float,
    enough: float = 0.1,
) -> Float[np.ndarray, "h w"]:
    """The mean difference of the channels to the best fitting expected colour within that many pixels.

    It is exact where it is above `enough`; pixels that are alike so far are not looked at again. 0 outside `where`.
    """
    height, width = where.shape
    rows, columns = np.nonzero(where)
    least = np.zeros((height, width), dtype=np.float32)
    # Some hundred places are enough, however large the image.
    steps = np.arange(-int(radius), int(radius) + 1, 1 + int(radius) // 7)
    moves = [(r, c) for r in steps for c in steps if r * r + c * c <= radius * radius]
    least[where] = np.inf
    for row, column in [(0, 0), *moves]:
        there = expected[np.clip(rows + row, 0, height - 1), np.clip(columns + column, 0, width - 1)]
        now = np.minimum(least[rows, columns], np.abs(shown[rows, columns] - there).mean(-1))
        least[rows, columns] = now
        rows, columns = rows[now > enough], columns[now > enough]
    return least


def remove_held_objects(
    mask: Bool[np.ndarray, "h w"],
    body: Bool[np.ndarray, "h w"],
    pixels_per_metre: float,
    clearance: float = 0.04,
    thickness: float = 0.035,
) -> Bool[np.ndarray, "h w"]:
    """A mask without what sticks out of the posed body and is thick: a ball, a bag, a racket's head.

    Clothes and hair stand off the body too, but by less; a fit that is off leaves a margin that is thin. Only what
    still holds a disc of radius `thickness` after all within `clearance` of the body is taken away counts as an object,
    and it goes together with its rim. What lies in front of the body stays: a silhouette cannot tell it apart.

    Args:
        mask: as estimated.
        body: silhouette of the fitted body (`body_silhouette`).
        pixels_per_metre: at the body's distance.
        clearance: metres.
        thickness: metres.
    """
    away = _depth(~body) / pixels_per_metre
    outside = mask & (away > clearance)
    seeds = _depth(outside) / pixels_per_metre >= thickness
    if not seeds.any():
        return mask
    reach = thickness + clearance
    near_seeds = _depth(~seeds) / pixels_per_metre <= reach
    without = mask & ~(near_seeds & (away > clearance / 4))
    # What is left may hang together with the person no longer.
    return max(_pieces(without), key=np.count_nonzero, default=without)


def _depth(inside: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """How far it is from each pixel to the nearest one that is not `inside`, pixels."""
    return np.asarray(ndimage.distance_transform_edt(inside))


def _pieces(mask: Bool[np.ndarray, "h w"]) -> list[np.ndarray]:
    """The pixels of each connected part of a mask."""
    labels = np.zeros(mask.shape, dtype=np.int32)
    ndimage.label(mask, output=labels)
    return [labels == piece for piece in range(1, int(labels.max()) + 1)]
