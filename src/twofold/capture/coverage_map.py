"""The coverage of a surface as an image: the body in its canonical pose from the front and from behind."""

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from twofold.body.skeleton import canonical_pose, pose_body, shape_body
from twofold.capture.coverage import Coverage, distant_camera
from twofold.capture.types import Capture
from twofold.geometry.raster import box_filter, rasterize, supersampled
from twofold.geometry.surfaces import vertex_normals

UNSEEN, SEEN = (0.90, 0.45, 0.12), (0.16, 0.44, 0.78)
"""Orange never observed, blue observed well; told apart by colour-blind eyes, too."""
BEHIND = (1.0, 1.0, 1.0)
CAPTION = "Front and back of the body: blue where training images show it well, orange where none does."


def coverage_colors(weight: Float[Tensor, "V"]) -> Float[Tensor, "V 3"]:
    """A colour for each weight, from `UNSEEN` over a light grey to `SEEN`.

    >>> coverage_colors(torch.tensor([0.0, 0.5, 1.0]))[:, 0]
    tensor([0.9000, 0.8500, 0.1600])
    """
    low, high = torch.tensor(UNSEEN), torch.tensor(SEEN)
    middle = torch.full((3,), 0.85)
    share = (2 * weight[:, None]).clamp(0, 2)
    return torch.where(share < 1, low + share * (middle - low), middle + (share - 1) * (high - middle))


@torch.no_grad()
def coverage_map(capture: Capture, coverage: Coverage, size: int = 360) -> UInt8[np.ndarray, "h w 3"]:
    """The canonical body of a capture from the front and, to the right, from behind, coloured by coverage.

    Args:
        capture: whose body.
        coverage: of that body's vertices.
        size: rows of the image, pixels.
    """
    shaped = shape_body(capture.body, capture.betas)
    body = pose_body(shaped, canonical_pose(), torch.zeros(3))
    vertices = body.canonical_vertices
    middle = (vertices.amin(0) + vertices.amax(0)) / 2
    reach = float((vertices - middle)[:, :2].abs().max())
    colors, normals = coverage_colors(coverage.weight), vertex_normals(vertices, body.faces)
    parts = []
    for z in (1.0, -1.0):
        side = torch.tensor([0.0, 0.0, z])
        camera = distant_camera(middle, side, reach, size)
        hits = rasterize(supersampled(camera, 2), vertices, body.faces)
        light = 0.55 + 0.45 * (normals @ side).clamp_min(0)
        table = torch.cat([colors * light[:, None], torch.ones(len(colors), 1)], 1)
        values = (hits.barycentric[..., None] * table[body.faces[hits.face]]).sum(1)
        image = box_filter(camera, 2, hits.pixel, values)
        parts.append(image[..., :3] + (1 - image[..., 3:]) * torch.tensor(BEHIND))
    return (torch.cat(parts, 1).clamp(0, 1) * 255).round().to(torch.uint8).numpy()
