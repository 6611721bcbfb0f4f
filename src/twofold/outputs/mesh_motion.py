"""A motion of an avatar by its baked mesh: quick images, the wrinkles as morph targets."""

from collections.abc import Callable

import numpy as np

from twofold.body.motion import Motion
from twofold.capture.types import Capture
from twofold.geometry.cameras import Camera
from twofold.methods.base import Avatar
from twofold.outputs.export.animations import motion_clip
from twofold.outputs.export.bake import BakeConfig
from twofold.outputs.export.bake_cache import BakeCache
from twofold.outputs.export.character import Animation, Character, pose_character
from twofold.outputs.export.make import bake
from twofold.outputs.mesh_preview import as_tensor, render_mesh
from twofold.outputs.motion_video import Renderer, View

CONFIG = BakeConfig(faces=40_000, texture=1024, lit=True)
"""With the capture's light in the colours, as the field is rendered."""


def mesh_renderer(
    avatar: Avatar,
    capture: Capture,
    motion: Motion,
    config: BakeConfig = CONFIG,
    progress: Callable[[float, str], None] = lambda _done, _note: None,
    cache: BakeCache | None = None,
) -> Renderer:
    """Bakes the avatar once, and renders the frames of a motion from the mesh.

    Args:
        avatar: trained.
        capture: that it was trained on, for the poses whose colours are averaged.
        motion: what it does.
        config: of the mesh.
        progress: called with the fraction that is done and what comes next.
        cache: of the run that `avatar` was loaded from (`open_cache`).

    Raises:
        TwofoldError: see `bake`.
    """
    baked = bake(avatar, capture, config, progress=lambda done, note: progress(0.9 * done, note), cache=cache)
    clip = motion_clip(baked, motion)
    progress(1.0, "")
    return clip_renderer(baked.character, clip)


def clip_renderer(character: Character, clip: Animation) -> Renderer:
    """Renders the frames of a character's clip; colours are shown as they are."""

    def view(index: int, camera: Camera) -> View:
        weights = None if clip.weights is None else clip.weights[index]
        vertices = pose_character(character, clip.poses[index], clip.translations[index], weights)
        image = render_mesh(character, vertices, camera, np.zeros(3, dtype=np.float32))
        return View(*as_tensor(image))

    return view
