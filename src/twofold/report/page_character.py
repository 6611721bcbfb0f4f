"""The interactive character of a report: a small GLB of a run's avatar with a few motions, and its poster."""

import io
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from PIL import Image

from twofold.body.builtin_motions import BUILTIN_MOTIONS
from twofold.body.joint_limits import joint_limits
from twofold.body.motion import Motion, as_single
from twofold.body.skeleton import JOINT_NAMES
from twofold.capture.types import Capture
from twofold.errors import TwofoldError, install_command
from twofold.geometry.cameras import Camera
from twofold.geometry.rotations import axis_angle_to_matrix
from twofold.html.interactive import InteractiveCharacter, JointControl
from twofold.html.page import EmbeddedImage, embedded_image
from twofold.methods.base import Avatar
from twofold.outputs.export.bake import BakeConfig, Progress
from twofold.outputs.export.bake_cache import BakeCache
from twofold.outputs.export.character import Character, pose_character
from twofold.outputs.export.gltf import glb_bytes, gltf_document
from twofold.outputs.export.make import Baked, bake, recolored
from twofold.outputs.export.options import ExportOptions
from twofold.outputs.export.write import clips_of, missing_packages, require_surface
from twofold.outputs.mesh_preview import render_mesh
from twofold.outputs.motion_video import rest_body
from twofold.outputs.views import orbit_around

PAGE = BakeConfig(faces=20_000, targets=8, frames=24, texture=1024)
"""What fits a page: some megabytes."""
MOTIONS = ("walk", "dance")
WEIGHED = 6
"""Frames of each motion for which the morph targets' weights are worked out."""
_OPTIONS = ExportOptions(image="jpeg", morph_normals=False)
_FREE = 180.0
"""Degrees to which a joint without limits, the root, can be turned."""
POSTER = 480


@dataclass(frozen=True)
class PageCharacter:
    """What the report's character is made from, and what becomes of it.

    Attributes:
        baked: with the clips, for other files and for fast images.
        character: the same with its clips.
        part: of the page.
    """

    baked: Baked
    character: Character
    part: InteractiveCharacter


def lacking(avatar: Avatar, config: BakeConfig = PAGE) -> str:
    """Why there can be no character of this avatar, in one sentence; empty where there can."""
    if missing := missing_packages(config):
        return f"The interactive character needs {' and '.join(missing)}; run `{install_command('export')}`."
    try:
        require_surface(avatar)
    except TwofoldError as error:
        return str(error)
    return ""


@torch.no_grad()
def has_base(avatar: Avatar) -> bool:
    """Whether the field has a base branch, whose colours can be shown by themselves."""
    posed = avatar.pose(torch.zeros(24, 3), torch.zeros(3))
    if avatar.level_space == "posed":
        return False
    x, matrix = avatar.to_canonical(posed.body.vertices[:1], posed)
    return avatar.query(x, posed, matrix).base is not None


def builtin_motions(avatar: Avatar, names: Sequence[str] = MOTIONS) -> tuple[Motion, ...]:
    """Motions that need no file, for the avatar's body."""
    body = rest_body(avatar)
    return tuple(as_single(BUILTIN_MOTIONS[name](body)) for name in names)


def page_character(
    avatar: Avatar,
    capture: Capture,
    motions: Sequence[Motion],
    name: str = "avatar",
    config: BakeConfig = PAGE,
    cache: BakeCache | None = None,
    progress: Progress = lambda _done, _note: None,
) -> PageCharacter:
    """The avatar as a character for a page.

    Args:
        avatar: for which `lacking` is empty.
        capture: that it was trained on.
        motions: that it can play besides the capture's.
        name: of the person.
        config: of the bake.
        cache: of the run that `avatar` was loaded from.
        progress: called with the fraction that is done and what comes next.

    Raises:
        TwofoldError: the field has no surface.
    """
    baked = bake(
        avatar, capture, config, name=name, progress=lambda done, note: progress(0.7 * done, note), cache=cache
    )
    base = b""
    if config.branch == "full" and has_base(avatar):
        progress(0.7, "colours of the base branch")
        painted = recolored(baked, "base", cache).texture
        base = b"" if painted is None else _jpeg(painted)
    progress(0.85, "motions")
    character = replace(baked.character, clips=tuple(clips_of(baked, True, motions, WEIGHED)))
    glb = glb_bytes(*gltf_document(character, _OPTIONS))
    part = InteractiveCharacter(
        glb, f"{name}.glb", tuple(clip.name for clip in character.clips), joint_controls(), base, poster(character)
    )
    progress(1.0, "")
    return PageCharacter(baked, character, part)


def joint_controls() -> tuple[JointControl, ...]:
    """The joints in the order of the skin, each with a person's limits in whole degrees."""
    low, high = (limits.rad2deg().nan_to_num(posinf=_FREE, neginf=-_FREE) for limits in joint_limits())

    def both(joint: int, axis: int) -> tuple[int, int]:
        return round(low[joint, axis].item()), round(high[joint, axis].item())

    return tuple(
        JointControl(name.replace("_", " "), (both(joint, 0), both(joint, 1), both(joint, 2)))
        for joint, name in enumerate(JOINT_NAMES)
    )


def poster(character: Character, size: int = POSTER) -> EmbeddedImage:
    """The character as its first clip begins, from the front, with opacity."""
    clip = character.clips[0]
    weights = None if clip.weights is None else clip.weights[0]
    vertices = pose_character(character, clip.poses[0], clip.translations[0], weights)
    camera = clip_cameras(character, 0, size, 1)[0]
    image = render_mesh(character, vertices, camera, np.zeros(3, dtype=np.float32), headlight=not character.lit)
    image[..., :3] /= image[..., 3:].clip(1e-4)
    return embedded_image((image.clip(0, 1) * 255 + 0.5).astype(np.uint8))


def clip_cameras(character: Character, frame: int, size: int, views: int) -> list[Camera]:
    """Cameras around the character as it stands in a frame of its first clip, the first one in front of it."""
    clip = character.clips[0]
    vertices = torch.from_numpy(pose_character(character, clip.poses[frame], clip.translations[frame]))
    ahead = axis_angle_to_matrix(torch.from_numpy(clip.poses[frame, 0]).float())[:, 2]
    return list(orbit_around(vertices, size, views, torch.tensor([0.0, 1.0, 0.0]), ahead))


def mesh_orbit(character: Character, size: int, views: int, background: np.ndarray) -> list[np.ndarray]:
    """Images from all around by the mesh renderer, 0..255: the character as its first clip begins."""
    clip = character.clips[0]
    weights = None if clip.weights is None else clip.weights[0]
    vertices = pose_character(character, clip.poses[0], clip.translations[0], weights)
    images = (
        render_mesh(character, vertices, camera, background.astype(np.float32), headlight=not character.lit)
        for camera in clip_cameras(character, 0, size, views)
    )
    return [(image[..., :3].clip(0, 1) * 255 + 0.5).astype(np.uint8) for image in images]


def _jpeg(image: np.ndarray) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, "JPEG", quality=88)
    return stream.getvalue()
