"""From a field to a character: surface, skinning, morph targets, texture."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from twofold.body.skeleton import PosedBody
from twofold.capture.types import spread
from twofold.config import require_within
from twofold.errors import TwofoldError
from twofold.geometry.isosurface import extract_surface, keep_largest
from twofold.geometry.surfaces import face_areas
from twofold.methods.base import Avatar, PosedAvatar
from twofold.outputs.export.density import COLOR_FRAMES, FRAMES, pulled_back, rest_skin, t_pose
from twofold.outputs.export.morphs import PulledBack, Skin, bounded_weights, fit_morphs, morph_errors
from twofold.outputs.export.repair import as_tensors, decimate, is_watertight, solid
from twofold.outputs.export.rig import to_rest, transfer_weights

Progress = Callable[[float, str], None]


@dataclass(frozen=True)
class BakeConfig:
    """What a character is made of.

    Attributes:
        faces: number of triangles, roughly.
        branch: whose surface, the full field's or the base branch's.
        targets: at most this many morph targets.
        frames: at most this many training frames are taken for the morph targets.
        color_frames: frames over which the colour is averaged.
        texture: edge of the texture, texels; 0 for vertex colours.
        lit: keep the capture's light in the colours, also where the method knows it.
    """

    faces: int = 40_000
    branch: str = "full"
    targets: int = 16
    frames: int = 48
    color_frames: int = 16
    texture: int = 2048
    lit: bool = False

    def __post_init__(self) -> None:
        """Refuses sizes that no program takes."""
        require_within(self, faces=(500, 2_000_000), targets=(0, 16), frames=(2, 1000), color_frames=(1, 1000))
        if self.texture and not 64 <= self.texture <= 8192:
            raise ValueError(f"texture={self.texture} should be 64 to 8192, or 0 for none")


@dataclass(frozen=True)
class Pose:
    """A pose to be baked from: what `Avatar.pose` takes.

    Attributes:
        pose: axis-angle, radians.
        translation: metres.
        frame_index: a training frame whose correction is applied; None for none.
    """

    pose: Float[Tensor, "24 3"]
    translation: Float[Tensor, "3"]
    frame_index: int | None

    def of(self, avatar: Avatar) -> PosedAvatar:
        """The avatar in this pose."""
        return avatar.pose(self.pose, self.translation, self.frame_index)


_T_POSE = Pose(torch.zeros(24, 3), torch.zeros(3), None)


@dataclass(frozen=True)
class BakedShape:
    """The surface of a character and how it changes over the training frames.

    Attributes:
        skin: the mean surface.
        extracted: the surface before it took the mean of the frames, rest space, metres.
        targets: morph targets, rest space, metres at weight 1.
        weights: of the targets at the fitted frames.
        frames: those frames.
        errors: of the targets, see `morph_errors`.
        watertight: measured after merging equal positions.
        shown: some of the frames, with the surface pulled back from each: what colours are averaged over. Empty where
            the shape was stored; see `shown_surfaces`.
    """

    skin: Skin
    extracted: Float[Tensor, "V 3"]
    targets: Float[Tensor, "M V 3"]
    weights: Float[Tensor, "T M"]
    frames: tuple[Pose, ...]
    errors: dict[str, float]
    watertight: bool
    shown: tuple[tuple[PosedAvatar, PulledBack], ...]

    def weights_at(self, avatar: Avatar, posed: PosedAvatar, branch: str) -> Float[Tensor, "M"]:
        """Weights of the targets that bring the mean surface nearest to the avatar's in this pose."""
        if len(self.targets) == 0:
            return self.targets.new_zeros(0)
        back = pulled_back(avatar, posed, self.skin, branch)
        return bounded_weights(self.targets, back.displacement[None])[0]


def rest_body(avatar: Avatar) -> PosedBody:
    """The avatar's body in the T-pose at the origin."""
    if avatar.level_space == "posed":
        return t_pose(avatar)
    return avatar.pose(torch.zeros(24, 3), torch.zeros(3)).body


@torch.no_grad()
def bake_shape(
    avatar: Avatar, frames: Sequence[Pose], config: BakeConfig, progress: Progress = lambda _done, _note: None
) -> BakedShape:
    """Surface, skinning and morph targets.

    The surface is the mean of the full field over three training frames in canonical space, with as many triangles as
    asked for; then each vertex takes the mean of the frames' surfaces, pulled back through the skinning. Of a level in
    posed space (`outputs.export.density`) it is that of the T-pose, and there are fewer frames and no morph targets.

    Args:
        avatar: trained.
        frames: training poses, in the order of time.
        config: see there.
        progress: called with the fraction that is done and what comes next.

    Raises:
        TwofoldError: the field has no surface, or a package is missing.
    """
    if not frames:
        raise TwofoldError("The capture has no training frames, so there is nothing to take the avatar's surface from.")
    rest = rest_body(avatar)
    progress(0.0, "surface")
    in_pose = avatar.level_space == "posed"
    if in_pose:
        body = avatar.pose(torch.zeros(24, 3), torch.zeros(3)).body
        skin = rest_skin(*_extract(avatar, [_T_POSE], body.vertices, body.faces, config), body, rest)
    else:
        canonical, faces = _extract(avatar, spread(list(frames), 3), rest.canonical_vertices, rest.faces, config)
        weights = transfer_weights(canonical, faces.numpy(), rest)
        skin = Skin(to_rest(canonical, weights, rest), canonical, faces, weights, rest)
    watertight = is_watertight(skin.canonical.cpu().numpy(), skin.faces.cpu().numpy())
    chosen = tuple(spread(list(frames), min(config.frames, FRAMES) if in_pose else config.frames))
    averaged = {id(frame) for frame in spread(chosen, _color_frames(avatar, config))}
    displacements: list[Tensor] = []
    found: list[Tensor] = []
    shown: list[tuple[PosedAvatar, PulledBack]] = []
    for index, frame in enumerate(chosen):
        progress(0.3 + 0.7 * index / len(chosen), "pose-dependent surface")
        posed = frame.of(avatar)
        back = pulled_back(avatar, posed, skin, config.branch)
        displacements.append(back.displacement)
        found.append(back.found)
        if id(frame) in averaged:
            shown.append((posed, back))
    off, known = torch.stack(displacements), torch.stack(found)
    count = config.targets if config.branch == "full" and not in_pose else 0
    morphs = fit_morphs(off, known, count)
    moved = replace(skin, vertices=skin.vertices + morphs.mean)
    errors = morph_errors(off, known, count)
    return BakedShape(moved, skin.vertices, morphs.targets, morphs.weights, chosen, errors, watertight, tuple(shown))


def shown_surfaces(avatar: Avatar, shape: BakedShape, config: BakeConfig) -> tuple[tuple[PosedAvatar, PulledBack], ...]:
    """The frames that colours are averaged over, with the surface pulled back from each; made again where not kept."""
    if shape.shown:
        return shape.shown
    skin = replace(shape.skin, vertices=shape.extracted)
    posed = [frame.of(avatar) for frame in spread(shape.frames, _color_frames(avatar, config))]
    return tuple((one, pulled_back(avatar, one, skin, config.branch)) for one in posed)


def _color_frames(avatar: Avatar, config: BakeConfig) -> int:
    return min(config.color_frames, COLOR_FRAMES) if avatar.level_space == "posed" else config.color_frames


def _extract(
    avatar: Avatar, frames: list[Pose], body: Float[Tensor, "B 3"], triangles: Int[Tensor, "T 3"], config: BakeConfig
) -> tuple[Float[Tensor, "V 3"], Int[Tensor, "F 3"]]:
    """The surface where the mean level over some frames is zero, with about as many triangles as asked for.

    Args:
        avatar: whose level.
        frames: poses.
        body: vertices that it is near to, in the space of the level.
        triangles: of the body.
        config: see there.
    """
    posed = [frame.of(avatar) for frame in (frames if config.branch == "full" else frames[:1])]

    def level(x: Tensor) -> Tensor:
        return torch.stack([avatar.level(x, one, config.branch) for one in posed]).mean(0)

    area = float(face_areas(body, triangles).sum())
    # Marching cubes make some 2.9 triangles per voxel's face of surface; two of three are taken away again, so that the
    # decimation can put the rest where the surface bends.
    voxel = min(max((2.9 * area / (2.7 * config.faces)) ** 0.5, 0.0025), 0.008)
    vertices, faces = extract_surface(solid(level, body, triangles, avatar.reach), body, voxel)
    return keep_largest(*as_tensors(*decimate(vertices.cpu().numpy(), faces.cpu().numpy(), config.faces)))


@torch.no_grad()
def bake_colors(
    avatar: Avatar,
    shown: Sequence[tuple[PosedAvatar, PulledBack]],
    interpolate: Callable[[Tensor], Tensor],
    branch: str,
    lit: bool,
    chunk: int = 65_536,
) -> Float[Tensor, "N 3"]:
    """Colour of the surface, sRGB, 0..1: the mean over poses.

    Args:
        avatar: whose.
        shown: poses, and the surface pulled back from each.
        interpolate: takes values at the vertices to the points that are asked for.
        branch: "full" or "base".
        lit: with the capture's light.
        chunk: points at once.
    """
    total: list[Tensor] = []
    for posed, back in shown:
        x, matrix = interpolate(back.canonical), interpolate(back.to_observation)
        parts = [
            avatar.query(points, posed, turned, branch, lit or not avatar.separates_light).color.clamp(0, 1)
            for points, turned in zip(x.split(chunk), matrix.split(chunk), strict=True)
        ]
        total.append(torch.cat(parts))
    return torch.stack(total).mean(0)


@torch.no_grad()
def bake_normals(
    avatar: Avatar,
    shown: Sequence[tuple[PosedAvatar, PulledBack]],
    interpolate: Callable[[Tensor], Tensor],
    branch: str,
    chunk: int = 65_536,
) -> Float[Tensor, "N 3"]:
    """Unit normals of the rest pose from the gradient of the signed distance, mean over poses; see `bake_colors`."""
    total: Tensor | None = None
    for posed, back in shown:
        x, matrix, to_rest_ = (interpolate(t) for t in (back.canonical, back.to_observation, back.to_rest))
        parts: list[Tensor] = []
        for points, turned, home in zip(x.split(chunk), matrix.split(chunk), to_rest_.split(chunk), strict=True):
            gradient = avatar.query(points, posed, turned, branch).gradient
            if gradient is None:
                raise TwofoldError(f"{type(avatar).__name__} gives no normals; leave the normal map out.")
            parts.append(torch.nn.functional.normalize((home @ turned @ gradient[..., None])[..., 0], dim=-1))
        here = torch.cat(parts)
        total = here if total is None else total + here
    if total is None:
        raise ValueError("normals need at least one pose")
    return torch.nn.functional.normalize(total, dim=-1)
