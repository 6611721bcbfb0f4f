"""How right fitted bodies are in depth: one camera of a clip against the fit of four, and subjects that are known.

python -m benchmarks.fits --filmed [--frames-in FOLDER]
python -m benchmarks.fits --clips cam01.mp4 cam03.mp4 --all cam01.mp4 cam02.mp4 cam03.mp4 cam04.mp4 \
    --calibration Calib.qca.txt [--every 4]

Per clip: mean joint error with the pelvis laid over the reference's (MPJPE) and after the best similarity transform of
each frame (PA-MPJPE), millimetres; angle between the trunks and between the bends of the knees, degrees; distance of
the pelvis over the reference's; IoU of silhouette and mask. What the estimator found is kept in the folder `--cache`.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks.common import store
from benchmarks.filmed_subject import ACTS, FPS, film
from twofold.body.anny import anny_body
from twofold.body.skeleton import JOINT_NAMES, Body
from twofold.geometry.cameras import Camera
from twofold.geometry.silhouettes import overlap, silhouette
from twofold.prepare.cameras.calibration import pinhole
from twofold.prepare.cameras.triangulation import triangulate, turn_cameras
from twofold.prepare.detect.blazepose import blazepose_offsets, mediapipe_estimator
from twofold.prepare.detect.left_right import repair_swaps, repair_with_views
from twofold.prepare.detect.scan import Watched, watch_clip
from twofold.prepare.detections import Track
from twofold.prepare.fitting.fit import fit
from twofold.prepare.fitting.observations import Evidence
from twofold.prepare.fitting.outlines import Mask, open_mask
from twofold.prepare.fitting.parameters import FittedMotion, Posed, choose, place_joints, pose_motion
from twofold.prepare.fitting.physics import up_of
from twofold.prepare.video.clips import Clip, PrepareConfig, longer, open_clips


def angle(a: Tensor, b: Tensor) -> Tensor:
    """Between directions, degrees."""
    return torch.rad2deg(torch.arccos(torch.nn.functional.cosine_similarity(a, b, dim=-1).clamp(-1, 1)))


def knees(joints: Tensor) -> Tensor:
    """The bends of both knees, degrees."""
    out = []
    for side in ("left", "right"):
        hip, knee, ankle = (joints[:, JOINT_NAMES.index(f"{side}_{part}")] for part in ("hip", "knee", "ankle"))
        out.append(angle(knee - hip, ankle - knee))
    return torch.stack(out, -1)


def aligned_errors(found: Tensor, truth: Tensor) -> Tensor:
    """Distances after the similarity transform of each frame that makes them least (Umeyama 1991)."""
    a, b = found - found.mean(1, keepdim=True), truth - truth.mean(1, keepdim=True)
    u, s, v = torch.linalg.svd(b.transpose(1, 2) @ a)
    flip = torch.ones_like(s)
    flip[:, 2] = torch.linalg.det(u @ v).sign()
    turn = (u * flip[:, None]) @ v
    scale = (s * flip).sum(1) / a.square().sum((1, 2))
    return (scale[:, None, None] * (a @ turn.transpose(1, 2)) - b).norm(dim=-1)


def compare(found: Tensor, truth: Tensor) -> dict[str, float]:
    """The measures of the docstring above, of joints in the camera's axes (`t 24 3`)."""
    apart = (found - found[:, :1]) - (truth - truth[:, :1])
    neck = JOINT_NAMES.index("neck")
    trunks = [joints[:, neck] - joints[:, 0] for joints in (found, truth)]
    bends = (knees(found) - knees(truth)).abs().mean(0)
    return {
        "mpjpe_mm": 1000 * float(apart.norm(dim=-1).mean()),
        "pa_mpjpe_mm": 1000 * float(aligned_errors(found, truth).mean()),
        "trunk_degrees": float(angle(*trunks).mean()),
        "left_knee_degrees": float(bends[0]),
        "right_knee_degrees": float(bends[1]),
        "distance": float((found[:, 0].norm(dim=-1) / truth[:, 0].norm(dim=-1)).mean()),
    }


def mean_iou(body: Body, motion: FittedMotion, camera: Camera, masks: Sequence[Mask]) -> float:
    """Of every third frame."""
    posed, skin = pose_motion(body, motion), choose(body, torch.arange(len(body.template)))
    found = []
    for t in range(0, len(motion), 3):
        vertices = Posed(posed.transforms[t : t + 1], posed.vertices).place(skin)[0]
        found.append(overlap(silhouette(camera, vertices, body.faces), open_mask(masks[t]) > 127))
    return float(np.mean(found))


def measured(body: Body, evidence: Evidence, fps: float, truth: Tensor, up: Tensor) -> dict[str, float | str]:
    """One camera's fit against joints and the vertical in its axes."""
    start = time.process_time()
    motion = fit(body, [evidence], fps, True).settled(body)
    seconds = time.process_time() - start
    camera = longer(evidence.camera, float(motion.log_focal.exp()))
    row = compare(place_joints(pose_motion(body, motion), body, motion), truth)
    row["iou"] = mean_iou(body, motion, camera, evidence.masks or [])
    row["focal_pixels"], row["processor_seconds"] = float(camera.intrinsics[0, 0]), seconds
    rounded: dict[str, float | str] = {name: round(value, 3) for name, value in row.items()}
    told = bool(motion.slope.any())
    rounded["vertical"] = f"{float(angle(up_of(motion.slope), up)):.1f} degrees off" if told else "not told"
    return rounded


def watched(clip: Clip, cache: Path) -> Watched:
    """What the estimator finds in a clip, kept in a folder."""
    folder = cache / clip.name
    if not (folder / "track.npz").exists():
        found = watch_clip(clip.frames, clip.info.frames, mediapipe_estimator(), folder)
        times = {name: np.array(getattr(found, name)) for name in ("seconds", "steps", "sources")}
        np.savez(folder / "track.npz", **vars(found.track), **times)
    data = np.load(folder / "track.npz")
    count = len(data["pixels"])
    images, masks = ([folder / f"{k:06d}.{kind}" for k in range(count)] for kind in ("jpg", "png"))
    track = Track(data["pixels"], data["visibility"], data["world"])
    sources, seconds, steps = (tuple(data[name].tolist()) for name in ("sources", "seconds", "steps"))
    return Watched(
        tuple(images), tuple(masks), track, sources, seconds, steps, None, (), offsets=blazepose_offsets()
    )  # fmt: skip


def alone(clip: Clip, seen: Watched) -> Evidence:
    """What one camera tells, with its sides repaired."""
    track = repair_swaps(seen.track, np.array(seen.seconds)).track
    return Evidence(clip.camera, track, seen.masks, seen.offsets)


def real(options: argparse.Namespace) -> dict[str, dict[str, float | str]]:
    """Clips of calibrated cameras, each alone against all together."""
    body, every = anny_body(), options.every
    clips = open_clips(options.all, PrepareConfig(calibration=options.calibration))
    seen = [watched(clip, options.cache) for clip in clips]
    seen = [one.at(range(0, len(one.images), every)) for one in seen]
    tracks, lenses = [s.track for s in seen], [clip.calibrated for clip in clips if clip.calibrated is not None]
    tracks = [r.track for r in repair_with_views(tracks, lenses, np.array(seen[0].seconds))]
    lenses = turn_cameras(lenses, tracks)
    cameras = [pinhole(c, clip.info.height, clip.info.width) for c, clip in zip(lenses, clips, strict=True)]
    # Without the estimator's usual offsets, as it was before these were known, so that the reference stays the same.
    evidence = [Evidence(c, t, s.masks) for c, t, s in zip(cameras, tracks, seen, strict=True)]
    fps = clips[0].info.fps / every
    space = triangulate(lenses, tracks).points.astype(np.float32)
    together = fit(body, evidence, fps, points_in_space=space).settled(body)
    joints = place_joints(pose_motion(body, together), body, together)
    rows = {}
    for path in options.clips:
        k = next(k for k, clip in enumerate(clips) if clip.path.stem == path.stem)
        view = cameras[k].world_to_camera
        clip = open_clips([path], PrepareConfig())[0]
        truth = joints @ view[:3, :3].T + view[:3, 3]
        rows[path.stem] = measured(body, alone(clip, seen[k]), fps, truth, view[:3, 2])
        print(path.stem, rows[path.stem], flush=True)
    return rows


def filmed(options: argparse.Namespace) -> dict[str, dict[str, float | str]]:
    """Synthetic subjects whose joints are known."""
    body, rows = anny_body(), {}
    for seed, name in enumerate(ACTS):
        folder = options.cache / f"filmed-{name.replace(' ', '-')}"
        camera, joints = film(name, 20 + seed, folder)
        clip = open_clips([folder], PrepareConfig(fps=FPS))[0]
        seen = watched(clip, options.cache / "found")
        # Images that equal the one before them are left out.
        truth = joints[list(seen.sources)]
        evidence = alone(replace(clip, name=f"{folder.name}-found"), seen)
        rows[name] = measured(body, evidence, FPS, truth, camera.world_to_camera[:3, 1])
        rows[name]["true_focal_pixels"] = round(float(camera.intrinsics[0, 0]), 1)
        print(name, rows[name], flush=True)
    return rows


def main() -> None:
    """Measures and stores."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clips", nargs="*", type=Path, default=[])
    parser.add_argument("--all", nargs="*", type=Path, default=[])
    parser.add_argument("--calibration", type=Path)
    parser.add_argument("--every", type=int, default=4)
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "twofold-fits")
    parser.add_argument("--filmed", action="store_true")
    parser.add_argument("--name", default="fits", help="of the file of results")
    options = parser.parse_args()
    result: dict[str, object] = {
        "what": "fits of one camera against four, and against synthetic subjects",
        "every": options.every,
    }
    if options.clips:
        result["clips"] = real(options)
    if options.filmed:
        result["filmed"] = filmed(options)
    store(options.name, result)


if __name__ == "__main__":
    main()
