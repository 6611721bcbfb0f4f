"""The avatar as a triangle mesh: marching cubes in canonical space, then forward skinning into a pose."""

from typing import Any

from jaxtyping import Float, Int
from torch import Tensor

from twofold.body.skeleton import PosedBody
from twofold.deform.skinning import neighbour_weights, to_posed, vertex_transforms
from twofold.geometry.isosurface import extract_surface
from twofold.geometry.surfaces import nearest_vertices
from twofold.methods.base import Avatar, PosedAvatar


def posed_surface(
    avatar: Avatar, posed: PosedAvatar[Any], voxel: float = 0.008, branch: str = "full"
) -> tuple[Float[Tensor, "W 3"], Int[Tensor, "F 3"]]:
    """The avatar's surface in a pose, metres: extracted in the space of its level, canonical surfaces then posed.

    Raises:
        TwofoldError: see `extract_surface`.
    """

    def level(x: Tensor) -> Tensor:
        return avatar.level(x.to(avatar.device), posed, branch)

    if avatar.level_space == "posed":
        return extract_surface(level, posed.body.vertices.detach(), voxel)
    # What lies further out has never been rendered, so nothing says what is there.
    vertices, faces = extract_surface(level, posed.body.canonical_vertices, voxel, radius=min(avatar.reach, 0.1))
    return pose_surface(vertices, posed.body), faces


def pose_surface(vertices: Float[Tensor, "n 3"], body: PosedBody, neighbours: int = 7) -> Float[Tensor, "n 3"]:
    """Canonical vertices carried into the body's pose, each with the skinning of its nearest canonical body vertices.

    Several neighbours make the weights smoother than the body's own tessellation, which would show as creases.
    """
    distances, nearest = nearest_vertices(vertices, body.canonical_vertices, neighbours)
    return to_posed(vertices, nearest, neighbour_weights(distances.square()), vertex_transforms(body))
