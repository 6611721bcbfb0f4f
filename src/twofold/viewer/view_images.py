"""The image that a view shows: of the posed mesh (quick) or of the field (best); colour, normals, depth, weights."""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import matplotlib
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from twofold.body.skeleton import PARENTS, ShapedBody
from twofold.geometry.cameras import Camera, pixel_grid, pixel_rays
from twofold.geometry.rotations import matrix_to_axis_angle
from twofold.outputs.export.character import Character, normals_of, pose_character
from twofold.outputs.mesh_images import CLAY
from twofold.outputs.mesh_preview import render_mesh_depth
from twofold.outputs.sheets import as_bytes, color_normals, residual_image
from twofold.outputs.views import RenderedImage
from twofold.viewer.body_pose import BodyPose

Part = Literal["full", "base", "residual"]
Quantity = Literal["colour", "normals", "depth", "skinning weights"]
PARTS: tuple[Part, ...] = ("full", "base", "residual")
QUANTITIES: tuple[Quantity, ...] = ("colour", "normals", "depth", "skinning weights")

PAPER = (0.925, 0.933, 0.953)
"""Colour behind the person, 0..1."""
FAR = 150.0
"""Metres that stand for infinity in depth maps; 24 bits of hundredths of a millimetre hold a little more."""
_SEEN = 0.5
"""Opacity from which a pixel has a depth."""


@dataclass(frozen=True)
class ViewImage:
    """What is shown behind cameras and gizmos.

    Attributes:
        color: sRGB, background included.
        depth: along the camera's axis, metres; `FAR` where nothing is.
    """

    color: UInt8[np.ndarray, "h w 3"]
    depth: Float[np.ndarray, "h w"]


def body_character(body: ShapedBody) -> Character:
    """The bare body as clay, for captures and for avatars whose surface is not baked."""
    vertices, weights = body.vertices.numpy(), body.weights.numpy()
    clay = np.tile(np.array(CLAY, dtype=np.float32), (len(vertices), 1))
    none = np.zeros((0, len(vertices), 3), dtype=np.float32)
    return Character("body", vertices, body.faces.numpy(), body.joints.numpy(), weights, none, (), clay)


def residual_character(full: Character, base: Character) -> Character:
    """The same surface in the difference of two colourings: grey where they are equal."""
    colors = 0.5 + full.colors - base.colors
    texture = full.texture
    if texture is not None and base.texture is not None:
        difference = texture.astype(np.int16) - base.texture.astype(np.int16) + 128
        texture = difference.clip(0, 255).astype(np.uint8)
    return replace(full, colors=colors.clip(0, 1).astype(np.float32), texture=texture)


def mesh_view(
    character: Character, posed: BodyPose, camera: Camera, quantity: Quantity, samples: int = 1, clay: bool = False
) -> ViewImage:
    """The posed mesh from a camera.

    Args:
        character: its textures or colours are those of the part to show.
        posed: which pose.
        camera: from where.
        quantity: what to show.
        samples: along each side of a pixel.
        clay: whether the colours are to be shaded.
    """
    vertices = pose_character(character, posed.pose.numpy(), posed.translation.numpy())
    shown = character
    if quantity == "normals":
        shown = _painted(character, normal_colors(normals_of(vertices, character.faces), camera))
    elif quantity == "skinning weights":
        shown = _painted(character, character.weights @ joint_palette())
    paper = np.ones(3, dtype=np.float32) if quantity == "normals" else np.array(PAPER, dtype=np.float32)
    shaded = clay and quantity == "colour"
    color = np.tile((paper * 255 + 0.5).astype(np.uint8), (camera.height, camera.width, 1))
    depth = np.full((camera.height, camera.width), FAR, dtype=np.float32)
    rows, columns = mesh_box(vertices, camera)
    if rows.stop > rows.start and columns.stop > columns.start:
        # Most of a view is background, which costs nothing this way.
        near = cut_out(camera, rows, columns)
        image, far = render_mesh_depth(shown, vertices, near, paper, samples, headlight=shaded)
        seen = depth_colors(far) if quantity == "depth" else (image[..., :3].clip(0, 1) * 255 + 0.5).astype(np.uint8)
        color[rows, columns], depth[rows, columns] = seen, _finite(far)
    return ViewImage(color, depth)


def mesh_box(vertices: Float[np.ndarray, "V 3"], camera: Camera) -> tuple[slice, slice]:
    """Rows and columns that a mesh may cover: all of them where it reaches behind the camera."""
    transform = camera.world_to_camera.numpy()
    placed = vertices @ transform[:3, :3].T + transform[:3, 3]
    if placed[:, 2].min() < 1e-3:
        return slice(0, camera.height), slice(0, camera.width)
    pixels = (placed @ camera.intrinsics.numpy().T)[:, :2] / placed[:, 2:]
    size = np.array([camera.width, camera.height])
    low = (np.floor(pixels.min(0)) - 1).clip(0, size).astype(int)
    high = (np.ceil(pixels.max(0)) + 2).clip(0, size).astype(int)
    return slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))


def cut_out(camera: Camera, rows: slice, columns: slice) -> Camera:
    """The camera of a part of the image."""
    intrinsics = camera.intrinsics.clone()
    intrinsics[0, 2] -= columns.start
    intrinsics[1, 2] -= rows.start
    return Camera(camera.world_to_camera, intrinsics, rows.stop - rows.start, columns.stop - columns.start)


def _painted(character: Character, colors: Float[np.ndarray, "V 3"]) -> Character:
    return replace(character, colors=colors.astype(np.float32), texture=None, atlas=None)


def normal_colors(normals: Float[np.ndarray, "V 3"], camera: Camera) -> Float[np.ndarray, "V 3"]:
    """Normals as colours: red to the right, green up, blue towards the viewer (as `color_normals`)."""
    rotation = camera.world_to_camera[:3, :3].numpy() * np.array([[1.0], [-1.0], [-1.0]], dtype=np.float32)
    return (0.5 + 0.5 * normals @ rotation.T).astype(np.float32)


@lru_cache(maxsize=1)
def joint_palette() -> Float[np.ndarray, "24 3"]:
    """A colour for each joint; neighbours in the tree differ clearly."""
    hues = matplotlib.colormaps["hsv"](np.arange(24) * 0.381966 % 1)[:, :3]
    light = np.array([0.95 if _generation(joint) % 2 else 0.7 for joint in range(24)])
    return (hues * light[:, None]).astype(np.float32)


def _generation(joint: int) -> int:
    return 0 if PARENTS[joint] < 0 else 1 + _generation(PARENTS[joint])


def depth_colors(depth: Float[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Depths as colours, yellow near and violet far, over the range of nearly all; infinite ones background."""
    seen = np.isfinite(depth)
    image = np.tile((np.array(PAPER) * 255 + 0.5).astype(np.uint8), (*depth.shape, 1))
    if seen.any():
        near, far = np.percentile(depth[seen], (1, 99))  # pixels at the outline can be far off
        share = (1 - (depth[seen] - near) / max(float(far - near), 1e-6)).clip(0, 1)
        table = (matplotlib.colormaps["viridis"](np.linspace(0, 1, 256))[:, :3] * 255 + 0.5).astype(np.uint8)
        image[seen] = table[(255 * share + 0.5).astype(np.uint8)]
    return image


def field_view(image: RenderedImage, camera: Camera, part: Part, quantity: Quantity) -> ViewImage:
    """A rendering of the field on `PAPER` as the image to show.

    Args:
        image: from `render_image`.
        camera: that it was rendered from.
        part: of the avatar.
        quantity: "colour", "normals" or "depth"; the field has no skinning weights.
    """
    opacity = image.base_opacity if part == "base" and image.base_opacity is not None else image.opacity
    depth = _axial_depth(image, camera)
    if quantity == "depth":
        return ViewImage(depth_colors(depth), _finite(depth))
    if quantity == "normals":
        normal = image.base_normal if part == "base" else image.normal
        return ViewImage(as_bytes(color_normals(normal, opacity, camera)), _finite(depth))
    colors = {"full": image.color, "base": image.base, "residual": residual_image(image.color, image.base)}
    return ViewImage(as_bytes(colors[part]), _finite(depth))


def _axial_depth(image: RenderedImage, camera: Camera) -> Float[np.ndarray, "h w"]:
    """Distances along the camera's axis, metres; infinite where little is covered."""
    rays = pixel_rays(camera, pixel_grid(camera))
    along = rays.directions @ camera.world_to_camera[2, :3]
    depth = image.depth / image.opacity.clamp_min(1e-6) * along
    return torch.where(image.opacity > _SEEN, depth, torch.inf).numpy()


def _finite(depth: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    return np.minimum(depth, FAR).astype(np.float32)


def view_camera(
    wxyz: Float[np.ndarray, "4"], position: Float[np.ndarray, "3"], fov: float, height: int, width: int
) -> Camera:
    """A camera of OpenCV's axes from what a browser sends.

    Args:
        wxyz: unit quaternion from the camera's axes to the world's.
        position: metres.
        fov: vertical field of view, radians.
        height: rows.
        width: columns.
    """
    w, x, y, z = (wxyz / np.linalg.norm(wxyz)).tolist()
    rotation = torch.tensor([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip
    transform = torch.eye(4)
    transform[:3, :3] = rotation.T
    transform[:3, 3] = -rotation.T @ torch.from_numpy(np.asarray(position, dtype=np.float32))
    focal = 0.5 * height / np.tan(0.5 * fov)
    intrinsics = torch.tensor([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]]).float()
    return Camera(transform, intrinsics, height, width)


def quaternion(rotation: Float[Tensor, "3 3"]) -> tuple[float, float, float, float]:
    """Unit quaternion (w, x, y, z) of a rotation matrix."""
    vector = matrix_to_axis_angle(rotation.double())
    angle = float(vector.norm())
    scale = np.sin(angle / 2) / angle if angle > 1e-9 else 0.5
    x, y, z = (vector * scale).tolist()
    return float(np.cos(angle / 2)), x, y, z


def strips(camera: Camera, rows: int) -> list[tuple[slice, Camera]]:
    """The camera's image cut into strips of at most `rows` rows, each with a camera of its own."""
    cut: list[tuple[slice, Camera]] = []
    for first in range(0, camera.height, rows):
        part = slice(first, min(first + rows, camera.height))
        cut.append((part, cut_out(camera, part, slice(0, camera.width))))
    return cut


def fitted_size(height: int, width: int, rows: int) -> tuple[int, int]:
    """The largest size of the same aspect with at most this many rows.

    >>> fitted_size(600, 800, 256), fitted_size(100, 100, 256)
    ((256, 341), (100, 100))
    """
    if height <= rows:
        return height, width
    return rows, max(1, round(width * rows / height))
