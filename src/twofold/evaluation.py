"""Evaluation: which frames are measured, how, and the file that says so."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from twofold.capture.coverage import coverage_of
from twofold.capture.types import VIDEO_LENGTH, Capture, Frame, spread, steady_video
from twofold.capture.validate import read_mesh
from twofold.errors import NoSurfaceError
from twofold.files import write_json
from twofold.methods.base import Avatar, PosedAvatar
from twofold.metrics import image as image_metrics
from twofold.metrics import shape as shape_metrics
from twofold.metrics import video as video_metrics
from twofold.metrics.protocols import Networks, ProtocolMeans
from twofold.outputs.coverage_error import PROTOCOL as COVERAGE_PROTOCOL
from twofold.outputs.coverage_error import CoverageErrors
from twofold.outputs.mesh import posed_surface
from twofold.outputs.shares import Shares
from twofold.outputs.views import RenderedImage, render_image
from twofold.training.clock import Clock, Spent, read_spent
from twofold.training.run import CHECKPOINT

Rendered = Callable[[str, Frame, RenderedImage], None]
"""Takes the rendering of a split's frame."""
NEAR = 0.5
"""Seconds over which the errors of an estimator's poses last."""
_MESH = 4.0
"""Images that can be measured while one surface is; a first guess, until one has been."""
SURFACES = {
    "canonical": "marching cubes of the signed distance at {voxel} in canonical space, largest piece, posed by the 7 "
    "nearest body vertices",
    "posed": "marching cubes of a level of the density at {voxel} in the pose itself, largest piece",
}
"""How a surface is found, by the space that the level belongs to (`Avatar.level_space`)."""
MAX_IMAGES = 30
"""Images a split that are measured unless more are asked for, evenly spread: a minute or two on two cores."""


def render_frame(avatar: Avatar, capture: Capture, frame: Frame, refined: bool) -> RenderedImage:
    """The avatar in a frame's pose from its camera; `refined` applies what was learned about poses at that time."""
    posed = pose_at(avatar, capture, frame) if refined else avatar.pose(frame.pose, frame.translation, None)
    background = torch.tensor(capture.background)
    image = render_image(avatar, posed, frame.camera, background)
    if avatar.camera_response is None:
        return image
    color = avatar.camera_response.image(image.color, image.opacity, background, frame.camera_name)
    opacity = image.opacity if image.base_opacity is None else image.base_opacity
    return replace(
        image, color=color, base=avatar.camera_response.image(image.base, opacity, background, frame.camera_name)
    )


_REFINED = (
    "as refined in training from the training images; a frame between two that were trained on takes the mean of "
    "their corrections, nothing of its own image"
)


def _refines(avatar: Avatar) -> bool:
    return bool(avatar.pose_corrections())


def pose_at(avatar: Avatar, capture: Capture, frame: Frame) -> PosedAvatar[Any]:
    """The avatar in a frame's pose, with what training learned about the errors of the capture's poses.

    A training frame has a correction of its own. Another frame between two of these takes theirs, interpolated, if they
    are no more than `NEAR` seconds apart. All others stay as the capture has them.
    """
    return avatar.pose(*avatar.refined_pose(frame.frame_index, frame.pose, frame.translation, NEAR, capture.second))


def sampled(count: int, of: int, what: str) -> str:
    """How many of how many were measured, for protocols and the command line.

    >>> sampled(30, 412, "images"), sampled(7, 7, "images")
    ('30 of 412 images, evenly spread,', 'all 7 images')
    """
    return f"all {count} {what}" if count == of else f"{count} of {of} {what}, evenly spread,"


def measure_split(
    avatar: Avatar, capture: Capture, split: str, most: int | None = None, refined: bool = False,
    progress: Callable[[Frame, RenderedImage], None] | None = None,
) -> dict[str, object]:  # fmt: skip
    """Means of all image metrics over a split's frames.

    Args:
        avatar: to measure.
        capture: with the true images.
        split: "train", "novel_view" or "novel_pose".
        most: at most this many frames, evenly spread; None for all.
        refined: apply what training learned about the poses (`pose_at`).
        progress: called with every frame and its rendering.
    """
    rows, shares = [], []
    frames = spread(capture.splits.get(split, ()), most)
    for frame in frames:
        rendered = render_frame(avatar, capture, frame, refined)
        image, mask = frame.composited(torch.tensor(capture.background)), frame.mask()
        ignored = frame.ignored()
        row = image_metrics.compare(rendered.color, image, rendered.opacity, mask, ignored)
        if rendered.base_opacity is not None:
            row["base_silhouette_iou"] = image_metrics.silhouette_iou(rendered.base_opacity, mask, ignored=ignored)
        rows.append(row)
        shares.append(ignored[image_metrics.subject_box(mask)].float().mean().item())
        if progress:
            progress(frame, rendered)
    if not rows:
        return {}
    means: dict[str, object] = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    poses = _REFINED if refined and _refines(avatar) else "as the capture gives them"
    times = len({frame.frame_index for frame in frames})
    cameras = len({frame.camera_name for frame in frames})
    protocol = {
        **image_metrics.PROTOCOLS,
        "frames": f"mean over {sampled(len(frames), len(capture.splits[split]), 'images')} of the split {split}: "
        f"{times} frame{'s' * (times > 1)}, {cameras} camera{'s' * (cameras > 1)}",
        "poses": poses,
        "background": f"constant {capture.background}",
    }
    if "base_silhouette_iou" in means:
        protocol["base_silhouette_iou"] = "silhouette_iou of the pose-independent branch rendered alone"
    if avatar.camera_response is not None:
        protocol["colours"] = avatar.camera_response.protocol()
    if any(shares):
        protocol["ignored"] = image_metrics.IGNORED_PROTOCOL.format(share=100 * float(np.mean(shares)))
    return means | {"protocol": protocol}


def _with_mesh(capture: Capture, most: int | None) -> dict[int, Frame]:
    by_index = {
        f.frame_index: f for split in ("novel_view", "novel_pose", "train") for f in capture.splits.get(split, ())
    }
    return {time: by_index[time] for time in spread([t for t in sorted(capture.meshes) if t in by_index], most)}


def require_meshes(capture: Capture, most: int | None = None) -> None:
    """Reads the true meshes that `measure_geometry` will take, before hours of other work.

    Raises:
        TwofoldError: one is missing or damaged.
    """
    for time in _with_mesh(capture, most):
        read_mesh(capture.meshes[time])


def measure_geometry(
    avatar: Avatar, capture: Capture, most: int | None = None, voxel: float = 0.008,
    progress: Callable[[], None] | None = None,
) -> dict[str, object]:  # fmt: skip
    """Means of the surface metrics over the frames whose true mesh is known; empty where none is.

    Of an avatar without a surface there are no numbers, and "protocol" says so.
    """
    rows = []
    for time, frame in _with_mesh(capture, most).items():
        posed = avatar.pose(frame.pose, frame.translation, None)
        try:
            vertices, faces = posed_surface(avatar, posed, voxel)
        except NoSurfaceError as error:
            return {"protocol": f"not measured: {error}"}
        rows.append(shape_metrics.compare_surfaces(vertices.cpu(), faces.cpu(), *read_mesh(capture.meshes[time])))
        if progress:
            progress()
    if not rows:
        return {}
    means: dict[str, object] = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    means["protocol"] = {
        **shape_metrics.PROTOCOLS,
        "surface": SURFACES[avatar.level_space].format(voxel=f"{1000 * voxel:g} mm"),
        "moments": f"mean over {sampled(len(rows), len(_with_mesh(capture, None)), 'frames with a true mesh')}",
    }
    return means


def measure_refinement(
    avatar: Avatar, capture: Capture, most: int, trained: dict[str, object] | None = None,
    progress: Callable[[Frame, RenderedImage], None] | None = None,
) -> dict[str, object]:  # fmt: skip
    """How far training moved the poses, and the same avatar in the poses before and after, in at most `most` images.

    Held-out frames are of the split "novel_pose"; without a training frame near them their poses stay as they are.
    `trained` are the training images' metrics in the poses after, where the caller has them already.
    """
    found: dict[str, object] = dict(avatar.pose_corrections())
    told = {"shape": "length of the change of the coefficients"}
    for name, unit in (("root", "radians"), ("body", "radians"), ("translation", "metres")):
        told[name] = f"root mean square change over the training frames, {unit}"
    poses = {"before": "the poses of the capture", "after": "the poses that training made of them"}
    for split, called, known in (("train", "train", trained), ("novel_pose", "held_out", None)):
        for when in poses:
            after = when == "after"
            metrics = known if known and after else measure_split(avatar, capture, split, most, after, progress)
            for metric in ("psnr_box", "silhouette_iou") if metrics else ():
                found[f"{called}_{metric}_{when}"] = metrics[metric]
                told[f"{called}_{metric}_{when}"] = f"up to {most} images of the split {split} in {poses[when]}"
    return found | {"protocol": told}


def add_picture(means: ProtocolMeans, capture: Capture, frame: Frame, image: RenderedImage) -> None:
    """One rendering more for the table of protocols; pixels that are ignored take the true colours."""
    truth, ignored, mask = frame.composited(torch.tensor(capture.background)), frame.ignored(), frame.mask()
    color = torch.where(ignored[..., None], truth, image.color)
    opacity = torch.where(ignored, mask, image.opacity)
    means.add(color, opacity, mask, capture.background, lambda background: frame.composited(torch.tensor(background)))


def measure_consistency(
    avatar: Avatar, capture: Capture, most: int = VIDEO_LENGTH, progress: Callable[[], None] | None = None
) -> dict[str, object]:
    """Figures of the flow between successive frames of `steady_video`; empty where there is no such video."""
    frames = steady_video(capture, most)

    def rendered() -> Iterator[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
        for frame in frames:
            image = render_frame(avatar, capture, frame, True)
            if progress:
                progress()
            yield image.color, frame.composited(torch.tensor(capture.background)), frame.mask()

    figures: dict[str, object] = dict(video_metrics.frame_consistency(rendered()))
    if not figures:
        return {}
    seconds = float(np.diff(capture.seconds_of([frame.frame_index for frame in frames])).mean())
    told = f"{len(frames)} successive frames of the camera {frames[0].camera_name}, {seconds:.3g} s apart"
    return figures | {"protocol": {**video_metrics.PROTOCOLS, "frames": told}}


def measure_cost(avatar: Avatar, capture: Capture, spent: Spent | None) -> dict[str, object]:
    """Parameters, time of the training (where it is known), and the time that an image takes.

    Args:
        avatar: to measure.
        capture: an image of its first split that has some is rendered once more; all is warm by then.
        spent: by the training.
    """
    split = next(name for name in ("novel_view", "novel_pose", "train") if capture.splits.get(name))
    frame = capture.splits[split][0]
    clock = Clock(None)
    render_frame(avatar, capture, frame, False)
    image, threads = clock.spent(), torch.get_num_threads()
    where = f"{avatar.device}, {threads} thread{'s' if threads > 1 else ''}"
    found: dict[str, object] = {"parameters": sum(p.numel() for p in avatar.parameters())}
    protocol = {
        "parameters": "numbers that are stored for the avatar, codes and corrections of training frames included"
    }
    if spent is not None:
        found |= {"training_seconds": spent.seconds, "training_processor_seconds": spent.processor}
        protocol |= {
            "training_seconds": "on the clock, all sessions together, preparation and previews included",
            "training_processor_seconds": "the same on all cores together, of the leading process",
        }
    found |= {"frame_seconds": image.seconds, "frame_processor_seconds": image.processor}
    size = f"{frame.camera.width} x {frame.camera.height}"
    protocol["frame_seconds"] = f"on the clock, to pose and render one image of {size} ({split}), {where}"
    protocol["frame_processor_seconds"] = "the same on all cores together"
    return found | {"protocol": protocol}


def evaluate(
    avatar: Avatar, capture: Capture, folder: Path, most: int | None = MAX_IMAGES, meshes: int | None = 4,
    progress: Callable[[float, str], None] | None = None, extra: dict[str, object] | None = None,
    networks: Networks | None = None, rendered: Rendered | None = None,
) -> dict[str, object]:  # fmt: skip
    """`measure` with its metrics written to `metrics.json` in the run's folder.

    Args:
        avatar: to measure.
        capture: with ground truth.
        folder: the run.
        most: at most this many images a split; None for all.
        meshes: at most this many ground-truth meshes.
        progress: called with the fraction that is done and what is being measured.
        extra: further sections for the file.
        networks: see `measure`.
        rendered: see `measure`.

    Raises:
        TwofoldError: an image or mesh is damaged, or the avatar's numbers are not finite.
    """
    metrics = measure(avatar, capture, most, meshes, progress, networks, rendered)
    metrics |= {"cost": measure_cost(avatar, capture, read_spent(folder / CHECKPOINT))} | (extra or {})
    write_json(folder / "metrics.json", metrics)
    return metrics


def measure(
    avatar: Avatar, capture: Capture, most: int | None = MAX_IMAGES, meshes: int | None = 4,
    progress: Callable[[float, str], None] | None = None, networks: Networks | None = None,
    rendered: Rendered | None = None,
) -> dict[str, object]:  # fmt: skip
    """Metrics of everything that the capture knows the ground truth of.

    Args:
        avatar: to measure.
        capture: with ground truth.
        most: at most this many images a split; None for all.
        meshes: at most this many ground-truth meshes.
        progress: called with the fraction that is done and what is being measured.
        networks: measures under the settings of several papers as well (`twofold.metrics.protocols`), and the
            consistency of a video, with what networks there are; None leaves both out.
        rendered: called with the split, frame and rendering of every held-out image.

    Raises:
        TwofoldError: an image or mesh is damaged, or the avatar's numbers are not finite.
    """
    few = min(most or 8, 8)
    require_meshes(capture, meshes)
    images = {name: len(spread(capture.splits.get(name, ()), most)) for name in ("novel_view", "novel_pose")}
    images["train"] = len(spread(capture.train, few))
    # Training images are drawn once more, in the poses as given; held-out ones in both.
    refined = images["train"] + 2 * min(images["novel_pose"], few) if _refines(avatar) else 0
    pieces = {**images, "pose refinement": refined, "geometry": len(_with_mesh(capture, meshes))}
    pieces["consistency"] = len(steady_video(capture)) if networks else 0
    section = ""
    shares = Shares(pieces, {"geometry": _MESH}, lambda share: progress(share, section) if progress else None)

    def count(what: str) -> None:
        nonlocal section
        section = what
        shares.done(what)

    metrics: dict[str, object] = {}
    coverage = coverage_of(capture)
    errors = CoverageErrors(capture, coverage)
    for split in ("novel_view", "novel_pose"):
        means = ProtocolMeans(networks) if networks else None

        def seen(frame: Frame, image: RenderedImage, split: str = split, means: ProtocolMeans | None = means) -> None:
            if means:
                add_picture(means, capture, frame, image)
            if rendered:
                rendered(split, frame, image)
            if split == "novel_view":
                errors.add(frame, image)
            count(split)

        part = measure_split(avatar, capture, split, most, True, seen)
        if part:
            metrics[split] = part
        if means and part:
            metrics[f"{split}_protocols"] = means.figures() | {"protocol": means.protocols()}
    metrics["coverage"] = {"surface": coverage.share, **errors.metrics(), "protocol": COVERAGE_PROTOCOL}
    metrics["train"] = trained = measure_split(avatar, capture, "train", few, True, lambda f, p: count("train"))
    geometry = measure_geometry(avatar, capture, meshes, progress=lambda: count("geometry"))
    if geometry:
        metrics["geometry"] = geometry
    consistency = measure_consistency(avatar, capture, progress=lambda: count("consistency")) if networks else {}
    if consistency:
        metrics["consistency"] = consistency
    if avatar.camera_response is not None:
        told = "what each training camera multiplies colours with and adds to them, learned (training.camera_colors)"
        metrics["camera_colors"] = {**avatar.camera_response.numbers(), "protocol": told}
    if _refines(avatar):
        metrics["pose_refinement"] = measure_refinement(
            avatar, capture, few, trained, lambda f, p: count("pose refinement")
        )
    return metrics


def with_protocols(metrics: dict[str, object]) -> dict[str, object]:
    """The metrics for a table: each number of a section beside its protocol, general remarks as a line of their own."""
    out: dict[str, object] = {}
    for section, values in metrics.items():
        if not isinstance(values, dict):
            out[section] = values
            continue
        protocol = values.get("protocol", {})
        lines: dict[str, object] = {}
        for name, value in values.items():
            if name != "protocol":
                own = protocol.get(name, "") if isinstance(protocol, dict) else protocol
                lines[name] = {"value": value, "protocol": own}
        if isinstance(protocol, dict):
            lines |= {name: {"value": "", "protocol": text} for name, text in protocol.items() if name not in values}
        out[section] = lines
    return out
