"""Images of an avatar: any camera, any pose, either branch."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from twofold.body.skeleton import canonical_pose
from twofold.errors import TwofoldError
from twofold.geometry.cameras import Camera, Rays, clip_to_box, pixel_grid, pixel_rays
from twofold.methods.base import Avatar, PosedAvatar, Rendering


@dataclass(frozen=True)
class RenderedImage:
    """A rendered image; fields as in `Rendering`, as images. `residual` is the full colour minus the base one.

    Without a base branch, `base` and `base_normal` are those of the whole, and `base_opacity` is None.
    """

    color: Float[Tensor, "h w 3"]
    opacity: Float[Tensor, "h w"]
    depth: Float[Tensor, "h w"]
    normal: Float[Tensor, "h w 3"]
    base: Float[Tensor, "h w 3"]
    base_normal: Float[Tensor, "h w 3"]
    base_opacity: Float[Tensor, "h w"] | None = None

    @property
    def has_base(self) -> bool:
        """Whether a base branch was rendered, too."""
        return self.base_opacity is not None

    @property
    def residual(self) -> Float[Tensor, "h w 3"]:
        """What the pose-dependent branch adds."""
        return self.color - self.base


def rays_at_once(device: torch.device) -> int:
    """How many rays fit into the free memory, generously counted (64 kB a ray)."""
    free = 2**31
    if device.type == "cuda":
        free = torch.cuda.mem_get_info(device)[0]
    else:
        try:
            with open("/proc/meminfo", encoding="ascii") as lines:
                free = next(1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable"))
        except (OSError, StopIteration):
            pass  # Not Linux: the guess above stands.
    return max(1024, min(free // 2 // 65536, 131_072))


@torch.no_grad()
def render_image(
    avatar: Avatar, posed: PosedAvatar, camera: Camera, background: Float[Tensor, "3"], chunk: int | None = None
) -> RenderedImage:
    """Renders an image; rays that miss the body's surroundings are background without being followed.

    Args:
        avatar: whom.
        posed: in which pose (`Avatar.pose`).
        camera: from where.
        background: colour behind, 0..1.
        chunk: rays at once; None as many as memory allows.
    """
    device = posed.body.vertices.device
    camera, background = camera.to(device), background.to(device)
    rays = pixel_rays(camera, pixel_grid(camera).flatten(0, 1))
    margin = 0.35
    low, high = posed.body.vertices.amin(0) - margin, posed.body.vertices.amax(0) + margin
    clipped, hit = clip_to_box(rays, low, high)
    wanted = hit.nonzero()[:, 0]
    pixels = camera.height * camera.width
    out = torch.zeros(pixels, 15, dtype=background.dtype, device=device)
    has_base = False
    out[:, :3], out[:, 8:11] = background, background
    for part in wanted.split(chunk or rays_at_once(device)):
        chosen: Rays = clipped[part]
        whole = avatar.render(chosen, posed, background)
        base: Rendering = whole.base or whole
        has_base = whole.base is not None
        columns = [whole.color, whole.opacity[:, None], whole.depth[:, None], whole.normal, base.color, base.normal]
        columns.append(base.opacity[:, None])
        out[part] = torch.cat(columns, -1)
    image = out.unflatten(0, (camera.height, camera.width)).cpu()
    if not image.isfinite().all():
        raise TwofoldError(
            "The avatar has colours or depths that are not finite, as after a training that diverged; train again with "
            "lower learning rates."
        )
    color, opacity, depth, normal, bottom, bottom_normal, bottom_opacity = image.split([3, 1, 1, 3, 3, 3, 1], -1)
    return RenderedImage(
        color.clamp(0, 1), opacity[..., 0], depth[..., 0], normal, bottom.clamp(0, 1), bottom_normal,
        bottom_opacity[..., 0] if has_base else None,
    )  # fmt: skip


def look_at(eye: Float[Tensor, "3"], target: Float[Tensor, "3"], up: Float[Tensor, "3"]) -> Float[Tensor, "4 4"]:
    """World-to-camera transform of a camera at `eye` that looks at `target`, `up` pointing up in its image."""
    forward = torch.nn.functional.normalize(target - eye, dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up), dim=0)
    down = torch.linalg.cross(forward, right)
    rotation = torch.stack([right, down, forward])
    transform = torch.eye(4)
    transform[:3, :3] = rotation
    transform[:3, 3] = -rotation @ eye
    return transform


def body_up(posed: PosedAvatar) -> Float[Tensor, "3"]:
    """Which way is up for this body: from the feet to the neck."""
    joints = posed.body.joints.detach().cpu()
    return torch.nn.functional.normalize(joints[12] - joints[[7, 8]].mean(0), dim=0)


def orbit(
    posed: PosedAvatar, size: int, views: int, up: Float[Tensor, "3"] | None = None, start: float = 0.0
) -> Iterator[Camera]:
    """Cameras on a circle around a posed body, at its middle's height, the whole body in view.

    Args:
        posed: whom to look at.
        size: edge of the square images, pixels.
        views: how many, evenly spaced.
        up: axis of the circle; None takes the body's own.
        start: angle of the first one from the body's front, radians.
    """
    vertices = posed.body.vertices.detach().cpu()
    axis = body_up(posed) if up is None else up
    hips = posed.body.joints.detach().cpu()
    across = hips[1] - hips[2]
    yield from orbit_around(vertices, size, views, axis, torch.linalg.cross(across, axis), start)


def orbit_around(
    vertices: Float[Tensor, "V 3"], size: int, views: int, axis: Float[Tensor, "3"], front: Float[Tensor, "3"],
    start: float = 0.0,
) -> Iterator[Camera]:  # fmt: skip
    """Cameras on a circle around some points; see `orbit`.

    Args:
        vertices: to have in view, metres.
        size: edge of the square images, pixels.
        views: how many, evenly spaced.
        axis: of the circle, a unit vector; up in the images.
        front: from where the first camera looks; need not be at right angles to the axis.
        start: angle of the first one from there, radians.
    """
    middle = (vertices.amin(0) + vertices.amax(0)) / 2
    reach = float((vertices - middle).norm(dim=-1).max()) + 0.05
    focal = 1.8 * size
    away = reach * (focal / (size / 2)) * 1.06
    front = torch.nn.functional.normalize(front - (front @ axis) * axis, dim=0)
    side = torch.linalg.cross(axis, front)
    intrinsics = torch.tensor([[focal, 0.0, (size - 1) / 2], [0.0, focal, (size - 1) / 2], [0.0, 0.0, 1.0]])
    for view in range(views):
        angle = start + 2 * math.pi * view / views
        eye = middle + away * (math.cos(angle) * front + math.sin(angle) * side)
        yield Camera(look_at(eye, middle, axis), intrinsics, size, size)


def pose_canonically(avatar: Avatar) -> PosedAvatar:
    """The avatar in the canonical pose at the origin."""
    return avatar.pose(canonical_pose(), torch.zeros(3))
