"""What one cell of an experiment measures: a row for each image, and the means that tables show."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from twofold.capture.types import Capture, Frame, spread
from twofold.evaluation import measure_consistency, measure_geometry, render_frame
from twofold.methods.base import Avatar
from twofold.metrics import detail, distribution
from twofold.metrics import image as image_metrics
from twofold.metrics.inception import inception_cell, inception_input
from twofold.metrics.perceptual import lpips_cell
from twofold.metrics.protocols import SETTINGS, Networks, load_networks, measure_setting, on_background
from twofold.outputs.views import RenderedImage
from twofold.reproduce.pose_distance import PROTOCOL as POSE_DISTANCE
from twofold.reproduce.pose_distance import pose_distances

SPLITS = ("novel_view", "novel_pose")
PAPER = SETTINGS["humannerf"]
"""How the paper's numbers are taken to be measured, see `docs/metrics.md`."""
PROTOCOLS = {
    **image_metrics.PROTOCOLS,
    **{f"paper_{name}": PAPER.sentence(name) for name in ("psnr", "ssim", "lpips_x1000")},
    **detail.PROTOCOLS,
    **distribution.PROTOCOLS,
    "pose_distance": POSE_DISTANCE,
    "poses": "as refined in training where the recipe refines poses, else as the capture gives them",
}
"""What each number of an image is, in one line."""


@dataclass(frozen=True)
class Measures:
    """What is measured of a trained avatar.

    Attributes:
        max_images: of each split, evenly spread; None for all.
        max_meshes: true surfaces compared with.
        video: whether the consistency of successive frames is measured.
        weights: folder with the weights of LPIPS and Inception; None for the usual caches.
        unverified_weights: other weights than the published ones count, too.
    """

    max_images: int | None = 30
    max_meshes: int = 2
    video: bool = True
    weights: str | None = None
    unverified_weights: bool = False


def measure_avatar(
    avatar: Avatar, capture: Capture, measures: Measures, progress: Callable[[float], None] | None = None
) -> dict[str, Any]:
    """All metrics of an avatar on a capture.

    Args:
        avatar: trained.
        capture: with the true images.
        measures: which.
        progress: called with the share that is done, 0..1.

    Returns:
        "images", a row for each image; the sections "novel_view", "novel_pose", "geometry" and "consistency" as means;
        "protocol". Sections that the capture has no ground truth for are missing.

    Raises:
        TwofoldError: an image, a mesh or a file of weights is damaged, or the avatar's numbers are not finite.
    """
    weights = Path(measures.weights) if measures.weights else None
    networks = load_networks(weights, measures.unverified_weights or None)
    chosen = {split: spread(capture.splits.get(split, ()), measures.max_images) for split in SPLITS}
    count, done = max(sum(map(len, chosen.values())), 1), 0
    trained = torch.stack([frame.pose for frame in capture.train])
    found: dict[str, Any] = {"images": [], "protocol": PROTOCOLS}
    for split, frames in chosen.items():
        rows: list[dict[str, Any]] = []
        features: list[tuple[torch.Tensor, torch.Tensor]] = []
        for frame in frames:
            image = render_frame(avatar, capture, frame, True)
            away = pose_distances(frame.pose[None], trained).item()
            about = {"split": split, "camera": frame.camera_name, "frame": frame.frame_index, "pose_distance": away}
            rows.append(about | measure_image(image, capture, frame, networks))
            if networks.inception is not None:
                truth = frame.composited(torch.tensor(capture.background))
                ours, theirs = networks.inception(torch.stack([inception_input(image.color), inception_input(truth)]))
                features.append((ours, theirs))
            done += 1
            if progress:
                progress(0.9 * done / count)
        found["images"] += rows
        if rows:
            found[split] = _means(rows) | _distances(features, networks, weights)
    geometry = measure_geometry(avatar, capture, measures.max_meshes) if measures.max_meshes else {}
    consistency = measure_consistency(avatar, capture) if measures.video else {}
    for name, section in (("geometry", geometry), ("consistency", consistency)):
        if section:
            found["protocol"] = {**found["protocol"], name: section.pop("protocol")}
            found[name] = section
    return found


@torch.no_grad()
def measure_image(rendered: RenderedImage, capture: Capture, frame: Frame, networks: Networks) -> dict[str, float]:
    """All numbers of one image, named as in `PROTOCOLS`; ignored pixels count nowhere or take the true colours."""
    truth, mask, ignored = frame.composited(torch.tensor(capture.background)), frame.mask(), frame.ignored()
    row = image_metrics.compare(rendered.color, truth, rendered.opacity, mask, ignored)
    color = torch.where(ignored[..., None], truth, rendered.color)
    opacity = torch.where(ignored, mask, rendered.opacity)
    behind = capture.background if PAPER.background is None else PAPER.background
    moved = on_background(color, opacity, capture.background, behind)
    paper = measure_setting(
        PAPER, moved, frame.composited(torch.tensor(behind)), mask, networks.lpips.get(PAPER.network)
    )
    row |= {f"paper_{name}": value for name, value in paper.items()}
    box = image_metrics.subject_box(mask)
    row["ms_ssim"] = detail.ms_ssim(color, truth)
    row["gradient_error"] = detail.gradient_error(color[box], truth[box])
    return row


def _means(rows: list[dict[str, Any]]) -> dict[str, Any]:
    names = [name for name, value in rows[0].items() if isinstance(value, float)]
    return {name: float(np.mean([row[name] for row in rows])) for name in names}


def _distances(
    features: list[tuple[torch.Tensor, torch.Tensor]], networks: Networks, weights: Path | None
) -> dict[str, Any]:
    """LPIPS, KID and FID, or which file they lack."""
    absent: dict[str, Any] = {}
    if networks.lpips.get(PAPER.network) is None:
        absent["paper_lpips_x1000"] = lpips_cell(weights, PAPER.network)
    if len(features) < 2:
        cell = inception_cell(weights) if networks.inception is None else "n/a (needs 2 images)"
        return absent | {"kid_x1000": cell, "fid": cell}
    ours, theirs = (torch.stack(part) for part in zip(*features, strict=True))
    kid = distribution.kid(ours, theirs, torch.Generator().manual_seed(0))
    return absent | {"kid_x1000": kid, "fid": distribution.fid(ours, theirs)}
