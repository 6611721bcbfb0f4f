"""Fast images of an exported character: its textured mesh, drawn by a compiled rasterizer on the CPU."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from twofold.geometry.cameras import Camera
from twofold.geometry.face_kernels import nearest_faces
from twofold.geometry.raster import supersampled
from twofold.kernels.parallel import in_parts
from twofold.outputs.export.character import Character, normals_of
from twofold.outputs.raster_kernels import project, shade


def render_mesh(
    character: Character,
    vertices: Float[np.ndarray, "V 3"],
    camera: Camera,
    background: Float[np.ndarray, "3"],
    samples: int = 2,
    headlight: bool = False,
) -> Float[np.ndarray, "h w 4"]:
    """Colour on the background, 0..1, and opacity.

    Args:
        character: gives triangles, texture (or colours of the vertices).
        vertices: where its vertices are (`pose_character`), world, metres.
        camera: from where.
        background: colour behind, 0..1.
        samples: along each side of a pixel.
        headlight: shade by how far the surface is turned from the camera; else colours are shown as they are.
    """
    return render_mesh_depth(character, vertices, camera, background, samples, headlight)[0]


def render_mesh_depth(
    character: Character,
    vertices: Float[np.ndarray, "V 3"],
    camera: Camera,
    background: Float[np.ndarray, "3"],
    samples: int = 2,
    headlight: bool = False,
) -> tuple[Float[np.ndarray, "h w 4"], Float[np.ndarray, "h w"]]:
    """`render_mesh`, and the distance along the camera's axis, metres: infinite where no sample sees the mesh."""
    fine = supersampled(camera, samples)
    transform = fine.world_to_camera.double().numpy()
    points = np.zeros((len(vertices), 3), dtype=np.float32)
    own = np.ascontiguousarray(vertices, dtype=np.float32)
    project(own, transform[:3, :3], transform[:3, 3], fine.intrinsics.double().numpy(), points)
    faces = character.faces.astype(np.int32)
    inverse = np.zeros((fine.height, fine.width), dtype=np.float32)
    face = np.full((fine.height, fine.width), -1, dtype=np.int32)
    in_parts(fine.height, lambda first, end: nearest_faces(points, faces, inverse, face, first, end), least=32)
    textured = character.texture is not None and character.atlas is not None
    texture = character.texture if character.texture is not None else np.zeros((0, 0, 3), dtype=np.uint8)
    corners, uv = faces, np.zeros((1, 2), dtype=np.float32)
    if textured and character.atlas is not None:
        corners = character.atlas.faces.astype(np.int32)
        uv = character.atlas.uv * np.array(texture.shape[1::-1], dtype=np.float32)
    light = _headlight(own, character, camera) if headlight else np.ones(len(own), dtype=np.float32)
    image = np.zeros((camera.height, camera.width, 4), dtype=np.float32)
    given = (points, faces, face, corners, uv, texture, np.ascontiguousarray(character.colors, dtype=np.float32))
    in_parts(camera.height, lambda first, end: shade(*given, light, samples, image, first, end), least=16)
    image[..., :3] += (1 - image[..., 3:]) * background.astype(np.float32)
    nearest = inverse.reshape(camera.height, samples, camera.width, samples).max((1, 3))
    with np.errstate(divide="ignore"):
        return image, 1 / nearest


def _headlight(vertices: np.ndarray, character: Character, camera: Camera) -> np.ndarray:
    """0.55 where the surface is seen from the side, 1 where it faces the camera."""
    towards = camera.center.numpy() - vertices
    cosine = (normals_of(vertices, character.faces) * towards).sum(1) / np.linalg.norm(towards, axis=1)
    return (0.55 + 0.45 * cosine.clip(0)).astype(np.float32)


def as_tensor(image: Float[np.ndarray, "h w 4"]) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w"]]:
    """Colour and opacity as tensors."""
    whole = torch.from_numpy(image)
    return whole[..., :3], whole[..., 3]
