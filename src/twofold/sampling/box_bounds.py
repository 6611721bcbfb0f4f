"""Where rays pass the boxes around the bones (DANBO, NPC, PM-Avatar)."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from twofold.geometry.cameras import Rays

BOX_SCALE = 1.1
"""Boxes are enlarged by this factor before rays are cut with them."""
CYLINDER_MARGIN = 0.25
"""How far the bounding cylinder reaches beyond the joints, metres."""
MIN_DIRECTION = 1e-9
"""Smallest component of a direction that is divided by."""


@torch.no_grad()
def clip_to_bone_boxes(
    rays: Rays, world_to_frame: Float[Tensor, "J 4 4"], half_sizes: Float[Tensor, "J 3"], scale: float = BOX_SCALE
) -> tuple[Rays, Bool[Tensor, "R"]]:
    r"""Rays with near and far where they enter the first and leave the last box that they meet, and which meet any.

    \[ t_n = \min_j \max_i \min(t^-_{ji}, t^+_{ji}), \qquad t_f = \max_j \min_i \max(t^-_{ji}, t^+_{ji}),
    \qquad t^\pm = \frac{\pm s - u_{ji}(o)}{u_{ji}(d)} \]

    >>> ahead, never = torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([torch.inf])
    >>> ray = Rays(-3 * ahead, ahead, torch.zeros(1), never)
    >>> clipped, hit = clip_to_bone_boxes(ray, torch.eye(4)[None], torch.tensor([[0.5, 0.5, 1.0]]), scale=1.0)
    >>> clipped.near, clipped.far, hit
    (tensor([2.]), tensor([4.]), tensor([True]))

    Computed in double precision: directions along a face are divided by nearly zero.

    Args:
        rays: world; their own near and far bound the result.
        world_to_frame: of each box (`BoneFrames.world_to_frame`).
        half_sizes: of each box, metres.
        scale: enlarges the boxes.
    """
    rows = (world_to_frame[:, :3] / half_sizes[..., None]).double()
    origins = (rays.origins.double() @ rows[..., :3].flatten(0, 1).T).unflatten(-1, (len(rows), 3)) + rows[..., 3]
    directions = (rays.directions.double() @ rows[..., :3].flatten(0, 1).T).unflatten(-1, (len(rows), 3))
    tiny = directions.abs() < MIN_DIRECTION
    directions = torch.where(tiny, torch.full_like(directions, MIN_DIRECTION), directions)
    first, second = (-scale - origins) / directions, (scale - origins) / directions
    enters = torch.minimum(first, second).amax(-1)
    leaves = torch.maximum(first, second).amin(-1)
    near, far = torch.maximum(enters, rays.near[:, None].double()), torch.minimum(leaves, rays.far[:, None].double())
    meets = far > near
    near = near.masked_fill(~meets, torch.inf).amin(1)
    far = far.masked_fill(~meets, -torch.inf).amax(1)
    return _with_bounds(rays, near, far), meets.any(1)


@torch.no_grad()
def clip_to_cylinder(
    rays: Rays, joints: Float[Tensor, "24 3"], up: Float[Tensor, "3"], margin: float = CYLINDER_MARGIN
) -> tuple[Rays, Bool[Tensor, "R"]]:
    r"""Rays with near and far where they enter and leave the endless cylinder around a body, and which meet it.

    \[ \lVert P (o + t d - J_0) \rVert = r, \qquad P = I - u u^\top,
    \qquad r = \max_j \lVert P (J_j - J_0) \rVert + m \]

    >>> joints, up = torch.zeros(24, 3), torch.tensor([0.0, 1.0, 0.0])
    >>> ahead, never = torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([torch.inf])
    >>> ray = Rays(-3 * ahead, ahead, torch.zeros(1), never)
    >>> clipped, hit = clip_to_cylinder(ray, joints, up, margin=0.25)
    >>> clipped.near, clipped.far, hit
    (tensor([2.7500]), tensor([3.2500]), tensor([True]))

    The axis goes up through the pelvis; the radius is the largest distance of a joint from it, and `margin` more. It is
    where rays that miss all boxes are sampled in the authors' programs. Rays that miss the cylinder too stay as they
    are.

    Args:
        rays: world; their own near and far bound the result.
        joints: posed, pelvis first, world, metres.
        up: unit vector.
        margin: metres.
    """

    def across(vectors: Tensor) -> Tensor:
        return vectors - (vectors @ up)[..., None] * up

    radius = across(joints - joints[0]).norm(dim=-1).max() + margin
    origins, directions = across(rays.origins - joints[0]).double(), across(rays.directions).double()
    a = directions.square().sum(-1).clamp_min(1e-12)
    b, c = (origins * directions).sum(-1), origins.square().sum(-1) - radius.double() ** 2
    root = (b.square() - a * c).clamp_min(0).sqrt()
    near = torch.maximum((-b - root) / a, rays.near.double())
    far = torch.minimum((-b + root) / a, rays.far.double())
    meets = (b.square() > a * c) & (far > near)
    near, far = torch.where(meets, near, rays.near.double()), torch.where(meets, far, rays.far.double())
    return Rays(rays.origins, rays.directions, near.to(rays.near.dtype), far.to(rays.far.dtype)), meets


def _with_bounds(rays: Rays, near: Tensor, far: Tensor) -> Rays:
    """The rays between two depths; where these are infinite they stay as they are."""
    finite = near.isfinite()
    near = torch.where(finite, near, rays.near.double()).to(rays.near.dtype)
    far = torch.where(finite, far, rays.far.double()).to(rays.far.dtype)
    return Rays(rays.origins, rays.directions, near, far)
