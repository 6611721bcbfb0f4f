"""What is exported: a coloured surface in the T-pose with skinning, morph targets and clips; and how it moves."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8

from twofold.body.skeleton import joint_transforms, skin
from twofold.geometry.surfaces import vertex_normals
from twofold.outputs.export.atlas import Atlas


@dataclass(frozen=True)
class Animation:
    """A motion of the character.

    Attributes:
        name: of the animation.
        times: of the frames, ascending, seconds.
        poses: axis-angle rotations, root first, radians.
        translations: SMPL's own (the root turns about its rest joint, then this is added), metres.
        weights: of the morph targets; None where the motion has none.
    """

    name: str
    times: Float[np.ndarray, "T"]
    poses: Float[np.ndarray, "T 24 3"]
    translations: Float[np.ndarray, "T 3"]
    weights: Float[np.ndarray, "T M"] | None = None


@dataclass(frozen=True)
class Character:
    """A person to be handed to other programs. Lengths in metres; T-pose, facing +z, y up, in the body's own frame.

    Attributes:
        name: of the person.
        vertices: in the rest pose.
        faces: triangles, counter-clockwise from outside.
        joints: in the rest pose.
        weights: skinning weights, at most four a vertex.
        targets: morph targets, displacements of the rest vertices.
        clips: motions.
        colors: of the vertices, sRGB, 0..1.
        atlas: where there is a texture.
        texture: sRGB.
        normal_map: tangent space, as glTF has it.
        lit: colours hold the capture's light, so viewers should add none.
        observed: how well training images observed each vertex, 0..1; None where it was not measured.
        rigged: False for a still mesh, whose vertices are in the world and which has neither targets nor clips.
    """

    name: str
    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    joints: Float[np.ndarray, "24 3"]
    weights: Float[np.ndarray, "V 24"]
    targets: Float[np.ndarray, "M V 3"]
    clips: tuple[Animation, ...]
    colors: Float[np.ndarray, "V 3"]
    atlas: Atlas | None = None
    texture: UInt8[np.ndarray, "h w 3"] | None = None
    normal_map: UInt8[np.ndarray, "h w 3"] | None = None
    lit: bool = False
    observed: Float[np.ndarray, "V"] | None = None
    rigged: bool = True

    @property
    def ground(self) -> float:
        """Height of the soles in the rest pose, metres."""
        return float(self.vertices[:, 1].min())


def pose_character(
    character: Character,
    pose: Float[np.ndarray, "24 3"],
    translation: Float[np.ndarray, "3"],
    weights: Float[np.ndarray, "M"] | None = None,
) -> Float[np.ndarray, "V 3"]:
    """The vertices in a pose, world, metres: morph targets, then linear blend skinning."""
    vertices = character.vertices
    if weights is not None and len(weights):
        vertices = vertices + np.tensordot(weights.astype(np.float32), character.targets, 1)
    transforms = joint_transforms(
        torch.from_numpy(character.joints), torch.from_numpy(pose).float(), torch.from_numpy(translation).float()
    )
    return skin(torch.from_numpy(vertices), torch.from_numpy(character.weights), transforms).numpy()


def normals_of(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> Float[np.ndarray, "V 3"]:
    """Unit normals of the vertices; (0, 1, 0) where triangles give none."""
    normals = vertex_normals(torch.from_numpy(vertices).double(), torch.from_numpy(faces)).numpy()
    normals[np.linalg.norm(normals, axis=1) < 0.5] = (0, 1, 0)
    return (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
