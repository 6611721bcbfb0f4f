"""What came of preparing a clip, for the closing lines."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from twofold.prepare.output.acceptance import ImageQuality
from twofold.prepare.standing import StandingFacts


@dataclass(frozen=True)
class Prepared:
    """What came of it.

    Attributes:
        folder: the capture.
        kept: frames in the splits.
        qualities: a record of every image.
        warnings: sentences for the user.
        standing: how the body stands in the frames that are kept.
        objects: share of the mask that held objects took, of each image that has some and is kept.
        refined: share of the masks' pixels that refinement changed, of each clip whose masks were refined.
        focal: where the focal length comes from, a sentence; empty for calibrated cameras.
    """

    folder: Path
    kept: tuple[int, ...]
    qualities: tuple[ImageQuality, ...]
    warnings: tuple[str, ...]
    standing: StandingFacts
    objects: tuple[float, ...] = ()
    refined: tuple[float, ...] = ()
    focal: str = ""

    def summary(self) -> str:
        """What came of it in a few words."""
        moments = len({quality.frame_index for quality in self.qualities})
        return (
            f"{len(self.kept)} of {moments} frames, silhouette IoU {self.mean('iou'):.2f}, landmarks off by "
            f"{self.mean('reprojection'):.1f} pixels ({self.mean('reprojection_percent'):.1f} % of the body's height)."
            f"{self._refined()}{self._objects()}"
        )

    def _refined(self) -> str:
        """How much the masks were changed."""
        if not self.refined:
            return ""
        return (
            f" The masks were compared with the background, and {100 * np.mean(self.refined):.1f} % of their pixels "
            "changed (--refine-masks off leaves them)."
        )

    def _objects(self) -> str:
        """How much of the masks was taken for held objects."""
        if not self.objects:
            return ""
        images = sum(quality.frame_index in set(self.kept) for quality in self.qualities)
        return (
            f" Held objects were taken out in {len(self.objects)} of {images} images, at most "
            f"{100 * max(self.objects):.1f} % and on average {100 * sum(self.objects) / max(images, 1):.1f} % of the "
            "person's mask; the report of check shows them, --held-objects keep leaves them."
        )

    def mean(self, what: Literal["iou", "reprojection", "reprojection_percent"]) -> float:
        """Over the images of the frames that are kept."""
        kept = set(self.kept)
        return float(np.mean([getattr(q, what) for q in self.qualities if q.frame_index in kept]))
