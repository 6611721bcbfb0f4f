"""What a viewer saves: images, poses, camera paths, a rigged character; never over something that is there."""

import io
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from twofold.files import made_folder, write_bytes
from twofold.geometry.cameras import Camera
from twofold.inputs import is_there
from twofold.outputs.export.animations import capture_clip, grounded, turned
from twofold.outputs.export.character import Animation, Character
from twofold.outputs.export.gltf import write_glb
from twofold.outputs.export.options import ExportOptions
from twofold.outputs.video import write_video
from twofold.viewer.body_pose import BodyPose, save_poses
from twofold.viewer.field_source import FieldSource
from twofold.viewer.meshes import Meshes
from twofold.viewer.scene_state import SceneState, Shown
from twofold.viewer.view_images import ViewImage, field_view, mesh_view
from twofold.viewer.viewed import Viewed


def next_name(folder: Path, stem: str, ending: str) -> Path:
    """The first of STEM-000, STEM-001 and so on that is not there yet."""
    number = 0
    while is_there(path := folder / f"{stem}-{number:03d}{ending}"):
        number += 1
    return path


def best_image(shown: Shown, camera: Camera, meshes: Meshes, source: FieldSource | None) -> ViewImage:
    """What a still view shows in the end: the field where it can be rendered, else the mesh without jagged edges."""
    if source is not None and shown.wants_field:
        image = source.render(shown.pose, camera, lambda: True)
        if image is not None:
            return field_view(image, camera, shown.part, shown.quantity)
    character, clay = meshes.of(shown.part)
    return mesh_view(character, shown.pose, camera, shown.quantity, 2, clay)


def save_image(folder: Path, image: ViewImage) -> Path:
    """Writes an image as PNG.

    Raises:
        TwofoldError: the folder cannot be written to.
    """
    path = next_name(folder, "image", ".png")
    stream = io.BytesIO()
    Image.fromarray(image.color).save(stream, format="PNG")
    with made_folder(folder):
        write_bytes(path, stream.getvalue())
    return path


def save_pose(folder: Path, viewed: Viewed, state: SceneState) -> Path:
    """Writes the edited pose, which `twofold render RUN --motion` reads.

    Raises:
        TwofoldError: the folder cannot be written to.
    """
    path = next_name(folder, "pose", ".npz")
    betas = None if viewed.capture is None else viewed.capture.betas
    save_poses(path, [state.pose], state.timeline.fps, betas)
    return path


def save_path_video(folder: Path, cameras: Sequence[Camera], fps: float, shown: Shown, meshes: Meshes) -> Path:
    """Renders the mesh along a camera path into an MP4.

    Raises:
        TwofoldError: the folder cannot be written to.
    """
    path = next_name(folder, "path", ".mp4")
    character, clay = meshes.of(shown.part)
    images = (mesh_view(character, shown.pose, camera, shown.quantity, 2, clay).color for camera in cameras)
    with made_folder(folder):
        write_video(path, images, fps)
    return path


def save_glb(folder: Path, viewed: Viewed, state: SceneState, meshes: Meshes) -> Path:
    """Writes the mesh as a rigged character with the timeline, and the pose where it was edited, as animations.

    Raises:
        TwofoldError: the folder cannot be written to.
    """
    character = meshes.of("full")[0]
    back = viewed.turn.T
    line = state.timeline
    clips = [_clip(character, line.name, line.poses, [line.begins(frame) for frame in range(len(line))])]
    if meshes.baked is not None and line.name == "capture: train":
        clips = [capture_clip(meshes.baked, line.name)]
    if state.edited:
        clips.append(_clip(character, "edited pose", (state.pose,), [0.0]))
    standing = tuple(grounded(turned(clip, back, character.joints[0]), character) for clip in clips)
    path = next_name(folder, "avatar", ".glb")
    with made_folder(folder):
        write_glb(replace(character, clips=standing, name=viewed.title), path, ExportOptions(name=viewed.title))
    return path


def _clip(character: Character, name: str, poses: Sequence[BodyPose], seconds: Sequence[float]) -> Animation:
    """The poses as an animation; morph targets, where there are any, stay at their means."""
    weights = np.zeros((len(poses), len(character.targets)), dtype=np.float32) if len(character.targets) else None
    turns, places = (torch.stack([getattr(p, part) for p in poses]).numpy() for part in ("pose", "translation"))
    return Animation(name, np.array(seconds, dtype=np.float32), turns, places, weights)
