"""Studio captures: made people with known truth.

A person is drawn from a seed (body, clothes, hair, face), moves in front of a ring of cameras under light that stays
fixed, and is rendered exactly: the poses, the cameras and the surface of every test frame are the very ones used.
"""

import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, UInt8
from scipy import sparse

from twofold.body.anny import anny_body
from twofold.body.skeleton import Body, PosedBody, ShapedBody, pose_body, shape_body
from twofold.body.stances import choreograph
from twofold.capture.folder import CaptureWriter
from twofold.config import MAX_SEED
from twofold.errors import TwofoldError
from twofold.geometry.cameras import Camera, project
from twofold.geometry.raster import box_filter, rasterize, supersampled
from twofold.geometry.surfaces import vertex_normals
from twofold.studio.appearance import Look, sample_look
from twofold.studio.figure import Figure, build_figure
from twofold.studio.lighting import Beads, cast_shade, illuminate, thread_beads
from twofold.studio.scene import degrade_mask, ring, room
from twofold.studio.texture import paint
from twofold.studio.wrinkles import Fold, displacement, lay_folds


@dataclass(frozen=True)
class StudioConfig:
    """What to make.

    Attributes:
        seed: who, wearing what, moving how.
        size: rows and columns of the images.
        frames: how many; the last fifth shows the unseen motion.
        cameras: in the ring; the first one trains.
        pose_noise: standard deviation of the error of the given poses, radians; a tenth of it in metres is that of the
            translations.
        mask_noise: faults of the masks, from 0 (exact) to 1 (bad).
        background: behind the person.
        samples: along each side of a pixel, against jagged edges.
        yaw_range: the training motion shows the first camera only directions within this angle about the front,
            degrees; None: the person turns twice about itself.
    """

    seed: int = 0
    size: int = 256
    frames: int = 80
    cameras: int = 8
    pose_noise: float = 0.0
    mask_noise: float = 0.0
    background: Literal["black", "textured"] = "black"
    samples: int = 3
    yaw_range: float | None = None

    def __post_init__(self) -> None:
        limits = {
            "seed": (0, MAX_SEED),
            "size": (16, 4096),
            "frames": (4, 100_000),
            "cameras": (1, 100),
            "samples": (1, 16),
        }
        for name, (low, high) in limits.items():
            if not low <= getattr(self, name) <= high:
                raise TwofoldError(
                    f"{name} of a studio capture should be {low} to {high}, it is {getattr(self, name)}."
                )
        if self.yaw_range is not None and not 0 <= self.yaw_range <= 360:
            raise TwofoldError(f"yaw_range of a studio capture should be 0 to 360 degrees, it is {self.yaw_range}.")
        for name in ("pose_noise", "mask_noise"):
            if not 0 <= getattr(self, name) <= 1:
                raise TwofoldError(f"{name} of a studio capture should be 0 to 1, it is {getattr(self, name)}.")


class PosedPerformer(NamedTuple):
    """The person in one frame: the true posed surface and the light on it."""

    vertices: Float[np.ndarray, "V 3"]
    normals: Float[np.ndarray, "V 3"]
    key: Float[np.ndarray, "V"]
    sky: Float[np.ndarray, "V"]


@dataclass(frozen=True)
class Performer:
    """A made person and how it moves.

    Attributes:
        body: the body model.
        betas: its shape coefficients.
        shaped: the naked body.
        look: clothes and colours.
        figure: the dressed person in the canonical pose.
        folds: its wrinkles.
        beads: where light and shade are worked out.
        poses: of all frames, radians.
        translations: of all frames, metres; the soles touch the floor.
    """

    body: Body
    betas: Float[torch.Tensor, "S"]
    shaped: ShapedBody
    look: Look
    figure: Figure
    folds: tuple[Fold, ...]
    beads: Beads
    poses: Float[np.ndarray, "T 24 3"]
    translations: Float[np.ndarray, "T 3"]


def cast(seed: int, rehearsed: int, unrehearsed: int, yaw_range: float | None = None) -> Performer:
    """Draw a person and a motion.

    Args:
        seed: another seed, another person.
        rehearsed: frames of the training motion.
        unrehearsed: frames of the unseen motion.
        yaw_range: see `StudioConfig`.
    """
    body = anny_body()
    random = np.random.default_rng([seed, 0])
    betas = torch.from_numpy(random.normal(0, 0.9, body.shape_basis.shape[-1]).clip(-1.8, 1.8).astype(np.float32))
    shaped = shape_body(body, betas)
    look = sample_look(seed)
    figure = build_figure(shaped, look)
    poses, sway = choreograph(seed, rehearsed, unrehearsed, yaw_range)
    poses = poses.astype(np.float32)
    # The naked body's lowest point stands for the soles, which are 1.6 cm thick.
    lowest = [_posed(shaped, pose, np.zeros(3)).vertices[:, 1].min().item() - 0.016 for pose in poses]
    root = shaped.joints[0].numpy()
    translations = np.stack([sway[:, 0] - root[0], -np.array(lowest), sway[:, 1] - root[2]], -1).astype(np.float32)
    beads = thread_beads(figure.vertices, figure.normals)
    return Performer(body, betas, shaped, look, figure, lay_folds(figure, seed), beads, poses, translations)


def _posed(shaped: ShapedBody, pose: Float[np.ndarray, "24 3"], translation: Float[np.ndarray, "3"]) -> PosedBody:
    return pose_body(shaped, torch.from_numpy(pose), torch.from_numpy(translation.astype(np.float32)))


def perform(performer: Performer, time: int) -> PosedPerformer:
    """The dressed person in one frame: wrinkled, posed and lit."""
    figure, pose = performer.figure, performer.poses[time]
    moved = displacement(performer.folds, pose.astype(np.float64), len(figure.vertices)).astype(np.float32)
    canonical = figure.vertices + moved[:, None] * figure.normals
    bones = _posed(performer.shaped, pose, performer.translations[time]).bones.numpy()
    vertices = skin_sparsely(canonical, figure.weights, bones)
    normals = vertex_normals(torch.from_numpy(vertices), torch.from_numpy(figure.faces)).numpy()
    key, sky = cast_shade(vertices, normals, performer.beads)
    return PosedPerformer(vertices, normals, key, sky)


def skin_sparsely(
    points: Float[np.ndarray, "V 3"], weights: sparse.csr_matrix, bones: Float[np.ndarray, "24 4 4"]
) -> Float[np.ndarray, "V 3"]:
    """Linear blend skinning with few weights a vertex."""
    blended = (weights @ bones[:, :3].reshape(24, 12)).reshape(-1, 3, 4)
    moved = blended[:, :, 3]
    for axis in range(3):
        moved = moved + blended[:, :, axis] * points[:, axis, None]
    return moved.astype(np.float32)


def photograph(
    performer: Performer, moment: PosedPerformer, camera: Camera, samples: int
) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]:
    """Colours over black and the share of each pixel that the person covers.

    The mean over a pixel is taken of the sRGB values, as a program does that lays one image over another.
    """
    figure = performer.figure
    hits = rasterize(
        supersampled(camera, samples), torch.from_numpy(moment.vertices), torch.from_numpy(figure.faces), cull=True
    )
    table = np.concatenate(
        [figure.rest, moment.normals, moment.vertices, figure.layers, moment.key[:, None], moment.sky[:, None]], 1
    )
    corners = torch.from_numpy(figure.faces).index_select(0, hits.face)
    rows = [torch.from_numpy(table).index_select(0, corners[:, i]) * hits.barycentric[:, i, None] for i in range(3)]
    sample = (rows[0] + rows[1] + rows[2]).numpy()
    normals = sample[:, 3:6] / np.linalg.norm(sample[:, 3:6], axis=1, keepdims=True).clip(1e-9)
    to_camera = camera.center.numpy() - sample[:, 6:9]
    to_camera /= np.linalg.norm(to_camera, axis=1, keepdims=True)
    material = paint(sample[:, :3], sample[:, 9:15].argmin(1), figure.anatomy, performer.look)
    color = illuminate(material, normals, to_camera, sample[:, 15], sample[:, 16])
    with_alpha = torch.from_numpy(np.concatenate([color, np.ones((len(color), 1), np.float32)], 1))
    image = box_filter(camera, samples, hits.pixel, with_alpha).numpy()
    return image[..., :3], image[..., 3]


def make_studio(
    config: StudioConfig, out: Path, progress: Callable[[float], None] | None = None, overwrite: bool = False
) -> Path:
    """Make a capture folder; the same configuration gives the same bytes.

    Args:
        config: what to make.
        out: the folder to write; it must not exist, or be empty.
        progress: called with the fraction done, 0..1.
        overwrite: a capture in `out` without any other files is overwritten once the new one is complete.

    Raises:
        TwofoldError: the free body is not installed, or the folder cannot be written.
    """
    splits = plan_splits(config.frames, config.cameras)
    rehearsed = max(times[-1] for times in splits["train"].values()) + 1
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with CaptureWriter(out, overwrite) as writer:
            performer = cast(config.seed, rehearsed, config.frames - rehearsed, config.yaw_range)
            cameras = ring(config.cameras, config.size, _outline(performer))
            _film(config, performer, cameras, splits, writer, progress or (lambda _: None))
            given_poses, given_translations = _disturbed(config, performer)
            disturbed = config.pose_noise > 0
            writer.finish(
                name=f"studio {config.seed}",
                body=performer.body,
                betas=performer.betas,
                poses=torch.from_numpy(given_poses),
                translations=torch.from_numpy(given_translations),
                cameras=cameras,
                splits=splits,
                fps=12.0,
                true_poses=torch.from_numpy(performer.poses) if disturbed else None,
                true_translations=torch.from_numpy(performer.translations) if disturbed else None,
                notes={"made_by": "studio", **asdict(config)},
            )
    finally:
        torch.set_num_threads(threads)
    return out


def plan_splits(frames: int, cameras: int) -> dict[str, dict[str, list[int]]]:
    """Which camera shows which frames in which split.

    The first four fifths train from the first camera. Up to ten of them, evenly spread, and all later frames are
    shown by the other cameras (by the only one, where there is no other).
    """
    rehearsed = max(2, frames * 4 // 5)
    names = [f"camera{i:02d}" for i in range(cameras)]
    step = max(1, round(rehearsed / 9))
    seen = list(range(step // 2, rehearsed, step))
    others = names[1:] or names
    return {
        "train": {names[0]: list(range(rehearsed))},
        "novel_view": dict.fromkeys(names[1:], seen),
        "novel_pose": {name: list(range(rehearsed, frames)) for name in others},
    }


def _outline(performer: Performer) -> Float[np.ndarray, "n 3"]:
    """Points that bound the person over the whole motion: joints with room for flesh, hair and soles."""
    moments = zip(performer.poses, performer.translations, strict=True)
    joints = torch.stack([_posed(performer.shaped, p, t).joints for p, t in moments]).numpy()
    head = performer.figure.vertices[:, 1].max() - performer.figure.anatomy.joints[15, 1]
    right, up, ahead = np.eye(3, dtype=np.float32)
    feet, hands = joints[:, [7, 8, 10, 11]], joints[:, 22:]
    ends = [joints[:, 15] + head * up, feet * (1 - up), feet + 0.1 * right, feet - 0.1 * right]
    ends += [hands + reach * way for way in (right, up, ahead) for reach in (-0.1, 0.1)]
    return np.concatenate([end.reshape(-1, 3) for end in ends]).astype(np.float32)


def _film(
    config: StudioConfig,
    performer: Performer,
    cameras: dict[str, Camera],
    splits: dict[str, dict[str, list[int]]],
    writer: CaptureWriter,
    progress: Callable[[float], None],
) -> None:
    """Every image, mask and mesh, one frame after the other, several at once."""
    rooms = (
        {name: room(camera, config.seed) for name, camera in cameras.items()} if config.background != "black" else {}
    )
    wanted: dict[int, set[str]] = {time: set() for time in range(config.frames)}
    for split in splits.values():
        for name, times in split.items():
            for time in times:
                wanted[time].add(name)
    tested = {time for split in ("novel_view", "novel_pose") for times in splits[split].values() for time in times}
    done, lock = 0, threading.Lock()

    def film(time: int) -> None:
        nonlocal done
        moment = perform(performer, time)
        if time in tested:
            writer.mesh(time, moment.vertices, performer.figure.faces)
        hands = torch.from_numpy(_hands(performer, time))
        for name in sorted(wanted[time]):
            color, mask = photograph(performer, moment, cameras[name], config.samples)
            if name in rooms:
                color = color + (1 - mask[..., None]) * rooms[name]
            random = np.random.default_rng([config.seed, 5, time, list(cameras).index(name)])
            mask = degrade_mask(mask, project(cameras[name], hands)[0].numpy(), config.mask_noise, random)
            writer.image(name, time, _eight_bit(color))
            writer.mask(name, time, _eight_bit(mask))
        with lock:
            done += 1
            progress(done / config.frames)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        try:
            for finished in [pool.submit(film, time) for time in range(config.frames)]:
                finished.result()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _hands(performer: Performer, time: int) -> Float[np.ndarray, "2 3"]:
    return _posed(performer.shaped, performer.poses[time], performer.translations[time]).joints[22:].numpy()


def _disturbed(
    config: StudioConfig, performer: Performer
) -> tuple[Float[np.ndarray, "T 24 3"], Float[np.ndarray, "T 3"]]:
    """Poses and translations as an estimator would give them."""
    random = np.random.default_rng([config.seed, 6])
    poses = performer.poses + config.pose_noise * random.normal(size=performer.poses.shape)
    moved = performer.translations + 0.1 * config.pose_noise * random.normal(size=performer.translations.shape)
    return poses.astype(np.float32), moved.astype(np.float32)


def _eight_bit(values: Float[np.ndarray, "*b"]) -> UInt8[np.ndarray, "*b"]:
    return np.rint(values.clip(0, 1) * 255).astype(np.uint8)
