"""UV atlas of a mesh, and textures painted into it."""

import importlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy import ndimage

from twofold.errors import TwofoldError, install_command
from twofold.outputs.export.atlas_kernels import paint
from twofold.outputs.export.lattice import TriangleLattice

PADDING = 4
"""Texels between two charts."""


@dataclass(frozen=True)
class Atlas:
    """A mesh cut open and laid flat.

    Attributes:
        vertex: of each corner of the atlas the vertex of the mesh that it is; a vertex on a seam has several.
        faces: the mesh's triangles, in their order, by corners.
        uv: of the corners, 0..1, from the upper left (as glTF has it).
    """

    vertex: Int[np.ndarray, "C"]
    faces: Int[np.ndarray, "F 3"]
    uv: Float[np.ndarray, "C 2"]


def unwrap(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], size: int) -> Atlas:
    """Charts of the mesh by xatlas, packed for a texture of `size` x `size`.

    Raises:
        TwofoldError: the package xatlas is not installed.
    """
    try:
        xatlas: Any = importlib.import_module("xatlas")
    except ImportError as error:
        raise TwofoldError(
            f"A texture needs the package xatlas, which is not installed; run {install_command('export')}, or give "
            "--vertex-colors."
        ) from error
    atlas = xatlas.Atlas()
    atlas.add_mesh(np.ascontiguousarray(vertices, dtype=np.float32), faces.astype(np.uint32))
    charts, packing = xatlas.ChartOptions(), xatlas.PackOptions()
    charts.max_iterations = 1
    packing.resolution, packing.padding, packing.bilinear = size, PADDING, True
    atlas.generate(charts, packing)
    vertex, corners, uv = atlas[0]
    return Atlas(vertex.astype(np.int64), corners.astype(np.int64), uv.astype(np.float32))


def paint_texture(
    atlas: Atlas, lattice: TriangleLattice, values: Float[np.ndarray, "N c"], size: int
) -> tuple[Float[np.ndarray, "h w c"], Bool[np.ndarray, "h w"]]:
    """Values at the lattice's nodes as an image, spread over everything between the charts; and where the charts are.

    Args:
        atlas: of the mesh.
        lattice: of the same mesh.
        values: one row a node.
        size: edge of the image, texels.
    """
    image = np.zeros((size, size, values.shape[1]), dtype=np.float32)
    covered = np.zeros((size, size), dtype=np.uint8)
    paint(image, covered, atlas.uv * np.float32(size), atlas.faces, lattice.table, lattice.segments,
          np.ascontiguousarray(values, dtype=np.float32))  # fmt: skip
    known = covered > 0
    return dilated(image, known), known


def dilated(image: Float[np.ndarray, "h w c"], known: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w c"]:
    """The image with every unknown texel as the nearest known one, so that filtering and mipmaps meet no edge."""
    if not known.any():
        return image
    nearest = np.asarray(ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True))
    return image[tuple(nearest)]


def tangents(
    atlas: Atlas, vertices: Float[np.ndarray, "V 3"], normals: Float[np.ndarray, "V 3"]
) -> Float[np.ndarray, "C 4"]:
    """glTF's tangents of the corners: along u, at right angles to the normal, and the sign of the bitangent.

    The bitangent, `sign * cross(normal, tangent)`, points up in the texture, which is where v falls.
    """
    own = vertices[atlas.vertex]
    a, b, c = (own[atlas.faces[:, corner]] for corner in range(3))
    (du1, dv1), (du2, dv2) = ((atlas.uv[atlas.faces[:, corner]] - atlas.uv[atlas.faces[:, 0]]).T for corner in (1, 2))
    area = du1 * dv2 - du2 * dv1
    sign = np.sign(area)[:, None]
    along_u = sign * ((b - a) * dv2[:, None] - (c - a) * dv1[:, None])
    along_v = sign * ((c - a) * du1[:, None] - (b - a) * du2[:, None])
    summed = np.zeros((2, len(own), 3), dtype=np.float64)
    for corner in range(3):
        np.add.at(summed[0], atlas.faces[:, corner], along_u)
        np.add.at(summed[1], atlas.faces[:, corner], -along_v)
    normal = normals[atlas.vertex].astype(np.float64)
    tangent = summed[0] - (summed[0] * normal).sum(1, keepdims=True) * normal
    # Where triangles cancel or have no area, any direction along the surface serves.
    other = np.cross(normal, np.where(np.abs(normal[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]]))
    length = np.linalg.norm(tangent, axis=1, keepdims=True)
    tangent = np.where(
        length > 1e-9, tangent / np.maximum(length, 1e-9), other / np.linalg.norm(other, axis=1)[:, None]
    )
    handed = np.where((np.cross(normal, tangent) * summed[1]).sum(1) < 0, -1.0, 1.0)
    return np.concatenate([tangent, handed[:, None]], 1).astype(np.float32)


def as_bytes_image(image: Float[np.ndarray, "h w c"]) -> UInt8[np.ndarray, "h w c"]:
    """Values of 0..1 as bytes."""
    return (image.clip(0, 1) * 255 + 0.5).astype(np.uint8)
