"""Characters of methods whose density belongs to a pose (`Avatar.level_space` is "posed").

There is no canonical field to be asked. So the surface is found where the body stands in the T-pose, bound by the
body's skinning weights, and corrected by the surfaces of some training poses; colours are what rays along the inward
normals see there.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional as F

from twofold.body.skeleton import PosedBody, pose_body, shape_body
from twofold.body.skeleton import skin as skin_points
from twofold.deform.skinning import inverse_skinning, invert_affine
from twofold.geometry.cameras import Rays
from twofold.geometry.rotations import rigid_inverse
from twofold.geometry.surfaces import vertex_normals
from twofold.methods.base import Avatar, PosedAvatar
from twofold.outputs.export.morphs import PulledBack, Skin, pull_back
from twofold.outputs.export.rig import transfer_weights

FRAMES, COLOR_FRAMES = 12, 4
"""Training frames whose surfaces are averaged at most, and those that colours are averaged over: a level takes several
values of a large network at each vertex, and a colour those of a whole ray."""
RAYS = 160_000
"""Rays for the colours of one character, over all poses."""
INWARD, OUTWARD = 0.015, 0.03
"""How far a pose's surface is looked for below and above the skinned one, metres; a wrist is 2 cm thick."""
ROUNDS = 5
"""Times that this range is halved before the level is interpolated in it."""
ABOVE, THROUGH = 0.02, 0.1
"""Where rays for colours start above the surface, and how far they go, metres."""
MIN_OPACITY = 0.05
"""Rays that see less than this have no colour."""


def t_pose(avatar: Avatar) -> PosedBody:
    """The subject's body in the T-pose at the origin, exactly: a method that corrects poses corrects this one, too."""
    subject, zero = avatar.subject, torch.zeros(24, 3)
    body = pose_body(shape_body(subject.body, subject.betas), zero, zero[0])
    return replace(body, **{name: tensor.to(avatar.device) for name, tensor in vars(body).items()})


def rest_skin(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], body: PosedBody, rest: PosedBody) -> Skin:
    """A surface around a body as a skin of the rest pose, with the weights of the nearest body vertices.

    Args:
        vertices: around `body`, metres.
        faces: triangles.
        body: in about the T-pose.
        rest: in the T-pose.
    """
    weights = transfer_weights(vertices, faces.cpu().numpy(), replace(body, canonical_vertices=body.vertices))
    home = rigid_inverse(rest.bones)
    in_rest = inverse_skinning(vertices, weights, body.bones @ home)
    return Skin(in_rest, skin_points(in_rest, weights, home), faces, weights, rest)


def pulled_back(avatar: Avatar, posed: PosedAvatar, skin: Skin, branch: str = "full") -> PulledBack:
    """`morphs.pull_back` or `pull_back_posed`, by the space of the avatar's level."""
    return (pull_back_posed if avatar.level_space == "posed" else pull_back)(avatar, posed, skin, branch)


@torch.no_grad()
def pull_back_posed(avatar: Avatar, posed: PosedAvatar, skin: Skin, branch: str = "full") -> PulledBack:
    """`morphs.pull_back` for a level of posed space: each skinned vertex moves along its normal to the zero level.

    The range from `INWARD` below to `OUTWARD` above is halved, since such levels are flat away from the surface. A
    vertex whose range does not begin inside and end outside stays.

    Args:
        avatar: whose level.
        posed: its pose.
        skin: the exported surface.
        branch: see `Avatar.level`.
    """
    rows = skin.transforms(posed.body)
    start = skin.moved(rows)
    normals = vertex_normals(start, skin.faces)

    def level(shift: Tensor) -> Tensor:
        return avatar.level(start + shift[:, None] * normals, posed, branch)

    low, high = torch.full_like(start[:, 0], -INWARD), torch.full_like(start[:, 0], OUTWARD)
    inside, outside = level(low), level(high)
    found = (inside < 0) & (outside > 0)
    for _ in range(ROUNDS):
        middle = (low + high) / 2
        value = level(middle)
        deep = value < 0
        low, inside = torch.where(deep, middle, low), torch.where(deep, value, inside)
        high, outside = torch.where(deep, high, middle), torch.where(deep, outside, value)
    share = (inside / (inside - outside).clamp_max(-1e-9)).clamp(0, 1)
    shift = torch.where(found, low + share * (high - low), 0.0)
    linear = rows[..., :3]
    displacement = torch.linalg.solve(linear, shift[:, None] * normals)
    inverse = invert_affine(rows)[..., :3].transpose(-1, -2)
    return PulledBack(
        displacement, start + shift[:, None] * normals, skin.canonical, inverse, linear.transpose(-1, -2), found
    )


@torch.no_grad()
def rendered_colors(
    avatar: Avatar,
    shown: Sequence[tuple[PosedAvatar, PulledBack]],
    faces: Int[Tensor, "F 3"],
    interpolate: Callable[[Tensor], Tensor],
    chunk: int = 16_384,
) -> Float[Tensor, "N 3"]:
    """Colour of the surface, sRGB, 0..1: what rays along the inward normals see, the mean over poses by opacity.

    Args:
        avatar: whose.
        shown: poses, and the surface pulled back from each.
        faces: of the surface.
        interpolate: takes values at the vertices to the points that are asked for.
        chunk: rays at once.
    """
    total = weight = torch.zeros(0)
    for posed, back in shown:
        x, normals = interpolate(back.posed), F.normalize(interpolate(vertex_normals(back.posed, faces)), dim=-1)
        near = torch.zeros_like(x[:, 0])
        rays = Rays(x + ABOVE * normals, -normals, near, torch.full_like(near, ABOVE + THROUGH))
        black = torch.zeros(3, device=x.device)
        seen = [avatar.render(rays[part], posed, black) for part in torch.arange(len(x)).split(chunk)]
        color, opacity = torch.cat([r.color for r in seen]), torch.cat([r.opacity for r in seen])
        opacity = torch.where(opacity < MIN_OPACITY, 0.0, opacity)
        color = torch.where(opacity[:, None] > 0, color, 0.0)
        total = color + total if len(total) else color
        weight = opacity + weight if len(weight) else opacity
    return (total / weight.clamp_min(1e-6)[:, None]).clamp(0, 1)
