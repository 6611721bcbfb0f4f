"""Masks that take in more than the person: held objects found with the help of the posed body."""

import numpy as np
from jaxtyping import Bool, Float, Int
from PIL import Image, ImageDraw
from scipy import ndimage


def body_silhouette(
    pixels: Float[np.ndarray, "V 2"], faces: Int[np.ndarray, "F 3"], height: int, width: int
) -> Bool[np.ndarray, "h w"]:
    """Which pixels a body covers whose vertices project to `pixels` (column, row), all of them in front of the camera."""
    canvas = Image.new("1", (width, height))
    pen = ImageDraw.Draw(canvas)
    for triangle in pixels[faces].reshape(-1, 6).tolist():
        pen.polygon(triangle, fill=1)
    return np.asarray(canvas, dtype=bool)


def remove_held_objects(
    mask: Bool[np.ndarray, "h w"],
    body: Bool[np.ndarray, "h w"],
    pixels_per_metre: float,
    clearance: float = 0.04,
    thickness: float = 0.035,
) -> Bool[np.ndarray, "h w"]:
    """A mask without what sticks out of the posed body and is thick: a ball, a bag, a racket's head.

    Clothes and hair stand off the body too, but by less; a fit that is off leaves a margin that is thin. Only what still
    holds a disc of radius `thickness` after all within `clearance` of the body is taken away counts as an object, and it
    goes together with its rim. What lies in front of the body stays: a silhouette cannot tell it apart.

    Args:
        mask: as estimated.
        body: silhouette of the fitted body (`body_silhouette`).
        pixels_per_metre: at the body's distance.
        clearance: metres.
        thickness: metres.
    """
    away = ndimage.distance_transform_edt(~body) / pixels_per_metre
    outside = mask & (away > clearance)
    seeds = ndimage.distance_transform_edt(outside) / pixels_per_metre >= thickness
    if not seeds.any():
        return mask
    reach = thickness + clearance
    near_seeds = ndimage.distance_transform_edt(~seeds) / pixels_per_metre <= reach
    without = mask & ~(near_seeds & (away > clearance / 4))
    # What is left may hang together with the person no longer.
    pieces, count = ndimage.label(without)
    if count > 1:
        without = pieces == 1 + np.argmax(ndimage.sum_labels(without, pieces, range(1, count + 1)))
    return without
