"""A character from an avatar and its capture: shape, colours, texture."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from twofold.capture.coverage import coverage_of, weights_at
from twofold.capture.types import Capture, Frame, spread
from twofold.errors import TwofoldError
from twofold.methods.base import Avatar, PosedAvatar
from twofold.outputs.export.atlas import Atlas, as_bytes_image, dilated, paint_texture, tangents, unwrap
from twofold.outputs.export.bake import (
    BakeConfig,
    BakedShape,
    Pose,
    Progress,
    bake_colors,
    bake_normals,
    bake_shape,
    rest_body,
    shown_surfaces,
)
from twofold.outputs.export.bake_cache import BakeCache, kept
from twofold.outputs.export.bake_codecs import BakedColors, atlas_codec, paint_codec, shape_codec
from twofold.outputs.export.character import Character, normals_of
from twofold.outputs.export.density import RAYS, pulled_back, rendered_colors
from twofold.outputs.export.lattice import TriangleLattice, build_lattice, segments_for
from twofold.outputs.export.morphs import PulledBack

QUERIES = 3_000_000
"""Points that the field is queried for the colours of one character, over all poses."""
_NORMAL_FRAMES = 4

Shown = Sequence[tuple[PosedAvatar, PulledBack]]


@dataclass(frozen=True)
class Baked:
    """A character and what its clips and still poses are made with.

    Attributes:
        avatar: that it was made from.
        capture: for frames.
        config: how.
        shape: its surface.
        character: rigged, without clips.
    """

    avatar: Avatar
    capture: Capture
    config: BakeConfig
    shape: BakedShape
    character: Character


def frame_at(capture: Capture, index: int) -> Frame:
    """A frame of any split by its index, a training frame first.

    Raises:
        TwofoldError: there is none.
    """
    for split in ("train", *capture.splits):
        for frame in capture.splits.get(split, ()):
            if frame.frame_index == index:
                return frame
    known = sorted({frame.frame_index for frames in capture.splits.values() for frame in frames})
    raise TwofoldError(f"{capture.folder} has no frame {index}; its frames lie between {known[0]} and {known[-1]}.")


def pose_of(capture: Capture, frame: Frame) -> Pose:
    """A frame's pose; one that was trained on takes its learned correction."""
    trained = any(frame.frame_index == other.frame_index for other in capture.train)
    return Pose(frame.pose, frame.translation, frame.frame_index if trained else None)


def training_poses(capture: Capture) -> list[Pose]:
    """The poses of the training frames, in the order of time."""
    frames_by_index = {frame.frame_index: frame for frame in capture.train}
    return [pose_of(capture, frames_by_index[time]) for time in sorted(frames_by_index)]


def bake(
    avatar: Avatar,
    capture: Capture,
    config: BakeConfig,
    color: str | int = "full",
    name: str = "avatar",
    progress: Progress = lambda _done, _note: None,
    cache: BakeCache | None = None,
) -> Baked:
    """The avatar as a rigged, coloured character.

    Args:
        avatar: trained.
        capture: that it was trained on.
        config: how.
        color: "full" for the mean of the full field over some training poses, "base" for that of the base branch, or a
            frame's index for the full field in that frame's pose.
        name: of the character.
        progress: called with the fraction that is done and what comes next.
        cache: of the run that `avatar` was loaded from; what it holds is not baked again.

    Raises:
        TwofoldError: there is no such frame, no surface, or a package is missing.
    """
    if not isinstance(color, str):
        frame_at(capture, color)
    kind = _settings(config)
    shape = kept(
        cache, "shape", kind, shape_codec(rest_body(avatar)),
        lambda: bake_shape(avatar, training_poses(capture), config, lambda done, note: progress(0.5 * done, note)),
    )  # fmt: skip
    vertices, faces = shape.skin.vertices.cpu().numpy(), shape.skin.faces.cpu().numpy()
    atlas: Atlas | None = None
    if config.texture:
        progress(0.5, "atlas")
        wanted = kind | {"texture": config.texture}
        atlas = kept(
            cache, "atlas", wanted, atlas_codec(len(vertices)), lambda: unwrap(vertices, faces, config.texture)
        )
    progress(0.65, "colours")
    paint = _paint(avatar, capture, config, shape, atlas, color, progress, cache)
    character = Character(
        name=name,
        vertices=vertices,
        faces=faces,
        joints=shape.skin.rest.joints.cpu().numpy(),
        weights=shape.skin.weights.cpu().numpy(),
        targets=shape.targets.cpu().numpy(),
        clips=(),
        colors=paint.colors,
        atlas=atlas,
        texture=paint.texture,
        normal_map=paint.normal_map,
        lit=config.lit or not avatar.separates_light,
        observed=paint.observed,
    )
    progress(1.0, "")
    return Baked(avatar, capture, config, shape, character)


def _settings(config: BakeConfig) -> dict[str, object]:
    """What a stored shape depends on."""
    return {
        "faces": config.faces, "branch": config.branch, "targets": config.targets, "frames": config.frames,
    }  # fmt: skip


def recolored(baked: Baked, color: str | int, cache: BakeCache | None = None) -> Character:
    """The same character in other colours; see `bake`."""
    character = baked.character
    paint = _paint(baked.avatar, baked.capture, baked.config, baked.shape, character.atlas, color, cache=cache)
    return replace(character, colors=paint.colors, texture=paint.texture, normal_map=paint.normal_map)


def _paint(
    avatar: Avatar,
    capture: Capture,
    config: BakeConfig,
    shape: BakedShape,
    atlas: Atlas | None,
    color: str | int,
    progress: Progress = lambda _done, _note: None,
    cache: BakeCache | None = None,
) -> BakedColors:
    """Colours of a shape, and with an atlas its texture and normal map, stored ones where there are; see `bake`."""
    settings = _settings(config) | {
        "texture": config.texture, "color_frames": config.color_frames, "color": color, "lit": config.lit,
    }  # fmt: skip
    return kept(
        cache, "paint", settings, paint_codec(len(shape.skin.vertices)),
        lambda: _painted(avatar, capture, config, shape, atlas, color, progress),
    )  # fmt: skip


def _painted(
    avatar: Avatar,
    capture: Capture,
    config: BakeConfig,
    shape: BakedShape,
    atlas: Atlas | None,
    color: str | int,
    progress: Progress,
) -> BakedColors:
    averaged = shown_surfaces(avatar, shape, config)
    shown: Shown = averaged
    if isinstance(color, int):
        posed = pose_of(capture, frame_at(capture, color)).of(avatar)
        shown = [(posed, pulled_back(avatar, posed, shape.skin, config.branch))]
    vertices, faces = shape.skin.vertices.cpu().numpy(), shape.skin.faces.cpu().numpy()
    # The lattice is as fine for one pose as a texture shows, and coarser where many poses are averaged.
    in_pose = avatar.level_space == "posed"
    budget = RAYS if in_pose else QUERIES // 2
    segments = segments_for(len(vertices), len(faces), budget // len(shown)) if atlas else 1
    lattice = build_lattice(len(vertices), faces, segments)
    branch = "base" if color == "base" or config.branch == "base" else "full"
    lit = config.lit or not avatar.separates_light
    if in_pose:
        colors = rendered_colors(avatar, shown, shape.skin.faces, lattice.interpolate).cpu().numpy()
    else:
        colors = bake_colors(avatar, shown, lattice.interpolate, branch, lit).cpu().numpy()
    observed = _observed(capture, shape)
    if atlas is None:
        return BakedColors(colors[: len(vertices)], observed, None, None)
    progress(0.85, "texture")
    texture, _ = paint_texture(atlas, lattice, colors, config.texture)
    normals = None
    if not lit:
        wanted = bake_normals(avatar, spread(averaged, _NORMAL_FRAMES), lattice.interpolate, config.branch)
        normals = normal_map(vertices, faces, atlas, lattice, wanted.cpu().numpy(), config.texture)
    return BakedColors(colors[: len(vertices)], observed, as_bytes_image(texture), normals)


def _observed(capture: Capture, shape: BakedShape) -> Float[np.ndarray, "V"]:
    """How well training images observed the body below each vertex."""
    body = shape.skin.rest.canonical_vertices.cpu()
    return weights_at(coverage_of(capture).weight, body, shape.skin.canonical.cpu()).numpy()


def normal_map(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], atlas: Atlas, lattice: TriangleLattice,
    wanted: Float[np.ndarray, "N 3"], size: int,
) -> UInt8[np.ndarray, "h w 3"]:  # fmt: skip
    """Normals of the rest pose, given at the lattice's nodes, as glTF's tangent-space image.

    Args:
        vertices: whose normals the image is relative to.
        faces: triangles.
        atlas: of its mesh.
        lattice: of its mesh.
        wanted: unit normals at the nodes.
        size: edge of the image, texels.
    """
    own = normals_of(vertices, faces)
    frame = np.concatenate([own[atlas.vertex], tangents(atlas, vertices, own)], 1)
    corners = TriangleLattice(1, torch.zeros(0, 3, dtype=torch.long), torch.zeros(0, 3), _corner_table(atlas))
    local, known = paint_texture(atlas, corners, frame, size)
    image, _ = paint_texture(atlas, lattice, wanted, size)
    flat = np.zeros((size, size, 3), dtype=np.float32)
    n, t, sign = local[known, :3], local[known, 3:6], np.sign(local[known, 6:7])
    n /= np.linalg.norm(n, axis=1, keepdims=True).clip(1e-9)
    t /= np.linalg.norm(t, axis=1, keepdims=True).clip(1e-9)
    here = image[known]
    parts = np.stack([(here * axis).sum(1) for axis in (t, sign * np.cross(n, t), n)], 1)
    parts[:, 2] = parts[:, 2].clip(0.2)  # an image cannot turn a normal into the surface
    flat[known] = parts / np.linalg.norm(parts, axis=1, keepdims=True).clip(1e-9)
    return as_bytes_image(0.5 + 0.5 * dilated(flat, known))


def _corner_table(atlas: Atlas) -> np.ndarray:
    """The atlas's triangles as a lattice of one segment: nodes (0, 0), (0, 1), (1, 0)."""
    return np.ascontiguousarray(atlas.faces[:, [0, 2, 1]]).astype(np.int32)


def still(baked: Baked, index: int, turn: Callable[[Tensor], Tensor] = lambda x: x) -> Character:
    """The character's mesh as the avatar stands in a frame, without a rig.

    Args:
        baked: from `bake`.
        index: of the frame.
        turn: takes positions of the capture's world to those of the file.

    Raises:
        TwofoldError: there is no such frame.
    """
    posed = pose_of(baked.capture, frame_at(baked.capture, index)).of(baked.avatar)
    back = pulled_back(baked.avatar, posed, baked.shape.skin, baked.config.branch)
    vertices = turn(back.posed).cpu().numpy()
    none = baked.character.targets[:0]
    return replace(baked.character, vertices=vertices, targets=none, clips=(), rigged=False)
