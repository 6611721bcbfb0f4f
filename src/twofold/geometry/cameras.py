"""Pinhole cameras and their rays (OpenCV axes: x right, y down, z forward).

Pixel (column i, row j) is the point (i, j) of the image plane, without a half-pixel offset, as in every data set of the
field; an image's left edge therefore lies at -0.5.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor


@dataclass(frozen=True)
class Camera:
    """A pinhole camera that does not move.

    Attributes:
        world_to_camera: rigid transform, metres.
        intrinsics: pixels.
        height: rows of its images.
        width: columns of its images.
    """

    world_to_camera: Float[Tensor, "4 4"]
    intrinsics: Float[Tensor, "3 3"]
    height: int
    width: int

    @property
    def center(self) -> Float[Tensor, "3"]:
        """Its position in the world, metres."""
        return -self.world_to_camera[:3, :3].T @ self.world_to_camera[:3, 3]

    def to(self, device: torch.device | str) -> "Camera":
        """The same camera with its matrices on `device`."""
        return Camera(self.world_to_camera.to(device), self.intrinsics.to(device), self.height, self.width)

    def resized(self, height: int, width: int) -> "Camera":
        """The same view in another image size; whole-pixel-area exact, so with the half-pixel terms."""
        scale = torch.tensor([width / self.width, height / self.height], dtype=self.intrinsics.dtype)
        scaled = self.intrinsics.clone()
        scaled[:2] = self.intrinsics[:2] * scale[:, None].to(self.intrinsics.device)
        scaled[:2, 2] = scaled[:2, 2] + (0.5 * (scale - 1)).to(scaled.device)
        return Camera(self.world_to_camera, scaled, height, width)


@dataclass(frozen=True)
class Rays:
    """Half-lines `origins + t * directions`, directions of unit length, t in metres between near and far."""

    origins: Float[Tensor, "*b 3"]
    directions: Float[Tensor, "*b 3"]
    near: Float[Tensor, "*b"]
    far: Float[Tensor, "*b"]

    def __getitem__(self, index: object) -> "Rays":
        return Rays(self.origins[index], self.directions[index], self.near[index], self.far[index])  # type: ignore[index]

    def __len__(self) -> int:
        return len(self.origins)


def pixel_grid(camera: Camera) -> Float[Tensor, "h w 2"]:
    """(column, row) of every pixel."""
    device = camera.intrinsics.device
    rows, columns = torch.meshgrid(
        torch.arange(camera.height, device=device), torch.arange(camera.width, device=device), indexing="ij"
    )
    return torch.stack([columns, rows], -1).to(camera.intrinsics.dtype)


def pixel_rays(camera: Camera, pixels: Float[Tensor, "*b 2"]) -> Rays:
    """Rays from the camera's centre through pixels (column, row); near is 0 and far infinite."""
    k = camera.intrinsics
    y = (pixels[..., 1] - k[1, 2]) / k[1, 1]
    x = (pixels[..., 0] - k[0, 2] - k[0, 1] * y) / k[0, 0]
    in_camera = torch.stack([x, y, torch.ones_like(x)], -1)
    directions = in_camera @ camera.world_to_camera[:3, :3]
    directions = directions / directions.norm(dim=-1, keepdim=True)
    near = torch.zeros_like(x)
    return Rays(camera.center.expand_as(directions), directions, near, torch.full_like(near, torch.inf))


def project(camera: Camera, points: Float[Tensor, "*b 3"]) -> tuple[Float[Tensor, "*b 2"], Float[Tensor, "*b"]]:
    """Pixels (column, row) and depths (metres, positive in front) of points of the world."""
    in_camera = points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    homogeneous = in_camera @ camera.intrinsics.T
    return homogeneous[..., :2] / homogeneous[..., 2:], in_camera[..., 2]


def without_tiny_components(rays: Rays, least: float = 1e-5) -> Rays:
    """Rays whose direction components closer to zero than `least` become +`least`, as in the release.

    >>> ray = Rays(torch.zeros(1, 3), torch.tensor([[0.0, -1e-6, 1.0]]), torch.zeros(1), torch.ones(1))
    >>> without_tiny_components(ray).directions
    tensor([[1.0000e-05, 1.0000e-05, 1.0000e+00]])
    """
    directions = torch.where(rays.directions.abs() < least, torch.full_like(rays.directions, least), rays.directions)
    return Rays(rays.origins, directions, rays.near, rays.far)


def clip_to_box(rays: Rays, low: Float[Tensor, "3"], high: Float[Tensor, "3"]) -> tuple[Rays, Bool[Tensor, "*b"]]:
    """Rays with near and far where they enter and leave an axis-aligned box, and which of them meet it at all."""
    # A direction component of exactly zero would divide 0 by 0 on a face of the box.
    safe = torch.where(rays.directions.abs() < 1e-9, torch.full_like(rays.directions, 1e-9), rays.directions)
    first, second = (low - rays.origins) / safe, (high - rays.origins) / safe
    near = torch.maximum(torch.minimum(first, second).amax(-1), rays.near)
    far = torch.minimum(torch.maximum(first, second).amin(-1), rays.far)
    return Rays(rays.origins, rays.directions, near, far), far > near
