"""Errors of images apart where training images had observed the surface and where they had not."""

import math

import numpy as np
import torch
from jaxtyping import Float
from scipy import ndimage

from twofold.body.skeleton import PosedBody, pose_body, shape_body
from twofold.capture.coverage import WELL, Coverage
from twofold.capture.types import Capture, Frame
from twofold.geometry.raster import rasterize
from twofold.outputs.views import RenderedImage

HARDLY = 0.1
"""Weight below which a pixel shows something unobserved."""


def pixel_coverage(frame: Frame, body: PosedBody, weight: Float[torch.Tensor, "V"]) -> Float[np.ndarray, "h w"]:
    """How well training images had observed what each pixel shows; beside the body as at its nearest pixel.

    Args:
        frame: whose camera.
        body: posed as in the frame.
        weight: of its vertices, 0..1.
    """
    height, width = frame.camera.height, frame.camera.width
    hits = rasterize(frame.camera, body.vertices, body.faces)
    image = torch.full((height * width,), torch.nan)
    image[hits.pixel] = (weight[body.faces[hits.face]] * hits.barycentric).sum(1)
    values = image.view(height, width).numpy()
    if np.isnan(values).all():
        return np.ones((height, width), np.float32)
    nearest = ndimage.distance_transform_edt(np.isnan(values), return_distances=False, return_indices=True)
    rows, columns = np.asarray(nearest)
    return values[rows, columns]


class CoverageErrors:
    """Adds up the errors of renderings over pixels of the person, by how well they had been observed."""

    def __init__(self, capture: Capture, coverage: Coverage) -> None:
        """For frames of this capture."""
        self._coverage, self._background = coverage, torch.tensor(capture.background)
        self._shaped = shape_body(capture.body, capture.betas)
        self._sums = {"observed": [0.0, 0.0, 0.0], "unobserved": [0.0, 0.0, 0.0]}

    def add(self, frame: Frame, image: RenderedImage) -> None:
        """One rendering more."""
        body = pose_body(self._shaped, frame.pose, frame.translation)
        weight = pixel_coverage(frame, body, self._coverage.weight)
        person = ((frame.mask() > 0.5) & ~frame.ignored()).numpy()
        off = (image.color - frame.composited(self._background)).numpy()
        for name, chosen in (("observed", weight >= WELL), ("unobserved", weight < HARDLY)):
            here = off[chosen & person]
            for slot, value in enumerate((len(here), np.abs(here).mean(-1).sum(), np.square(here).mean(-1).sum())):
                self._sums[name][slot] += float(value)

    def metrics(self) -> dict[str, object]:
        """Mean absolute errors and PSNR (dB) of both kinds of pixels, and the share of unobserved ones."""
        total = sum(sums[0] for sums in self._sums.values())
        found: dict[str, object] = {}
        for name, (count, absolute, squared) in self._sums.items():
            if count >= 100:
                found[f"{name}_error"] = absolute / count
                found[f"{name}_psnr"] = -10 * math.log10(max(squared / count, 1e-10))
        if total:
            found["unobserved_pixels"] = self._sums["unobserved"][0] / total
        return found


PROTOCOL = (
    "surface: share of the body's surface that training images show well; errors: mean absolute difference of the "
    "colours, 0..1, over pixels of the person in the images of the split novel_view, by the coverage of the body's "
    f"surface there: observed from {WELL:g}, unobserved below {HARDLY:g}"
)
