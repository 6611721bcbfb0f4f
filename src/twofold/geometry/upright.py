"""A world whose axes are turned, with the people and cameras in it."""

from jaxtyping import Float
from torch import Tensor

from twofold.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle


def turn_world(
    rotation: Float[Tensor, "3 3"],
    root: Float[Tensor, "3"],
    poses: Float[Tensor, "T 24 3"],
    translations: Float[Tensor, "T 3"],
    world_to_camera: Float[Tensor, "4 4"],
) -> tuple[Float[Tensor, "T 24 3"], Float[Tensor, "T 3"], Float[Tensor, "4 4"]]:
    """Motion and camera in a turned world, so that every image stays the same.

    Args:
        rotation: from the old world's axes to the new ones.
        root: rest position of the root joint, about which a body turns, metres.
        poses: axis-angle, radians.
        translations: metres.
        world_to_camera: of the old world.
    """
    root, rotation = root.to(poses), rotation.to(poses)
    turned = poses.clone()
    turned[:, 0] = matrix_to_axis_angle(rotation @ axis_angle_to_matrix(poses[:, 0]))
    moved = (translations + root) @ rotation.T - root
    camera = world_to_camera.clone()
    camera[:3, :3] = world_to_camera[:3, :3] @ rotation.T.to(world_to_camera)
    return turned, moved, camera
