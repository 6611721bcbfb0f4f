"""The quick form of `render`: orbit, novel poses, front and back from the baked mesh instead of the field."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8

from twofold.capture.types import Capture
from twofold.errors import TwofoldError
from twofold.files import made_folder
from twofold.geometry.cameras import Camera
from twofold.methods.base import PosedAvatar
from twofold.outputs.export.character import pose_character
from twofold.outputs.export.make import Baked
from twofold.outputs.gallery import save_png, scene_up
from twofold.outputs.mesh_preview import render_mesh
from twofold.outputs.sheets import sheet
from twofold.outputs.video import write_video
from twofold.outputs.views import orbit, pose_canonically

PARTS = ("all", "orbit", "poses", "canonical")
"""What the mesh can show; frames beside ground truth are rendered by the field, which they judge."""
NAMES = {"orbit": "orbit-mesh.mp4", "poses": "novel_pose-mesh.mp4", "canonical": "canonical-mesh.png"}


def render_run_by_mesh(
    baked: Baked, capture: Capture, folder: Path, what: str, size: int, progress: Callable[[float], None],
    views: int = 24,
) -> list[Path]:  # fmt: skip
    """Renders parts of a run into a folder, from the mesh, with the cameras that `render_run` has.

    Args:
        baked: the character, with the capture's light in its colours.
        capture: for cameras and poses.
        folder: for the files of `NAMES`.
        what: of `PARTS`.
        size: edge of the images, pixels.
        progress: called with the fraction that is done.
        views: images of the orbit.

    Raises:
        TwofoldError: the mesh does not show this part, the capture has no such frames, or the disk refuses.
    """
    if what not in PARTS:
        raise TwofoldError(f"--mesh renders {', '.join(PARTS[1:])} or all of these; leave --mesh out for {what}.")
    held = {frame.frame_index: frame for frame in reversed(capture.splits.get("novel_pose", ()))}
    if what == "poses" and not held:
        raise TwofoldError(f"{capture.folder} has no images in its split novel_pose; render the orbit instead.")
    avatar, background = baked.avatar, np.array(capture.background, dtype=np.float32)
    wanted = {part for part in PARTS[1:] if what in ("all", part)} - (set() if held else {"poses"})
    total = {"orbit": views, "poses": len(held), "canonical": 2}
    pieces, done = sum(total[part] for part in wanted), 0

    def shot(vertices: Float[np.ndarray, "V 3"], camera: Camera) -> UInt8[np.ndarray, "h w 3"]:
        nonlocal done
        image = render_mesh(baked.character, vertices, camera, background)[..., :3]
        done += 1
        progress(done / pieces)
        return (image.clip(0, 1) * 255 + 0.5).astype(np.uint8)

    def turning() -> Iterator[np.ndarray]:
        frame = capture.train[0]
        with torch.no_grad():
            posed = avatar.pose(frame.pose, frame.translation, frame.frame_index)
        vertices = posed_vertices(baked, posed)
        for camera in orbit(posed, size, views, scene_up(capture)):
            yield shot(vertices, camera)

    def moving() -> Iterator[np.ndarray]:
        camera = None
        for _, frame in sorted(held.items()):
            height = min(size, frame.camera.height)
            camera = camera or frame.camera.resized(height, round(frame.camera.width * height / frame.camera.height))
            with torch.no_grad():
                posed = avatar.pose(frame.pose, frame.translation)
            yield shot(posed_vertices(baked, posed), camera)

    written = [folder / NAMES[part] for part in NAMES if part in wanted]
    with made_folder(folder):
        if "orbit" in wanted:
            write_video(folder / NAMES["orbit"], turning(), 12)
        if "poses" in wanted:
            write_video(folder / NAMES["poses"], moving(), 12)
        if "canonical" in wanted:
            with torch.no_grad():
                posed = pose_canonically(avatar)
            vertices = posed_vertices(baked, posed)
            images = [shot(vertices, camera) for camera in orbit(posed, size, 2)]
            save_png(folder / NAMES["canonical"], sheet([images], [], ["front", "back"]))
    return written


@torch.no_grad()
def posed_vertices(baked: Baked, posed: PosedAvatar) -> Float[np.ndarray, "V 3"]:
    """The character's vertices where the avatar stands, morph targets included, world, metres."""
    weights = baked.shape.weights_at(baked.avatar, posed, baked.config.branch).cpu().numpy()
    place = (posed.body.joints[0] - baked.shape.skin.rest.joints[0]).cpu().numpy()
    return pose_character(baked.character, posed.body.pose.cpu().numpy(), place, weights)
