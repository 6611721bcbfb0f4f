"""What NPC's points need of a capture, found before the hours of its first stage."""

import torch
from jaxtyping import Float
from torch import Tensor

from twofold.body.skeleton import JOINT_NAMES, pose_body, shape_body
from twofold.capture.coverage import WELL, coverage_of
from twofold.capture.types import Capture
from twofold.errors import TwofoldError
from twofold.field.bone_boxes import RIGID_PARTS, assign_to_boxes, bone_frames, box_coordinates
from twofold.geometry.surfaces import face_areas, sample_surface

PER_SQUARE = 1.5
"""Vertices of marching cubes for each square of the grid's spacing that a surface fills, mean over its directions: the
surface crosses |n_x| + |n_y| + |n_z| edges of the grid there."""
SAMPLES = 40_000
"""Points of the body's surface that stand for it."""
MIN_SHOWN = 0.02
"""Smallest share of a part's surface that training images have to show."""


@torch.no_grad()
def require_points(capture: Capture, half_sizes: Float[Tensor, "19 3"], count: int, voxel: float) -> None:
    """Refuses captures and settings with which some body part would get no points, or too few.

    Args:
        capture: to be trained on.
        half_sizes: of the boxes of the rigid parts, metres.
        count: points of each part.
        voxel: spacing of the grid that they are found on, metres.

    Raises:
        TwofoldError: names the part.
    """
    shaped, zero = shape_body(capture.body, capture.betas), torch.zeros(24, 3)
    body = pose_body(shaped, zero, zero[0])
    still = torch.eye(4).repeat(24, 1, 1)
    to_frame = bone_frames(shaped.joints).world_to_frame(still)[list(RIGID_PARTS)]

    def parts_of(points: Tensor) -> Tensor:
        return assign_to_boxes(box_coordinates(points, to_frame, half_sizes), half_sizes)

    area = float(face_areas(body.vertices, body.faces).sum())
    points, _ = sample_surface(body.vertices, body.faces, SAMPLES, torch.Generator().manual_seed(0))
    fewest = PER_SQUARE * area / SAMPLES / voxel**2 * torch.stack([(parts_of(points) == p).sum() for p in _PARTS])
    part = int(fewest.argmin())
    if fewest[part] < count:
        raise TwofoldError(
            f"NPC needs {count} points on each body part, and a grid of {1000 * voxel:g} mm has room for about "
            f"{int(fewest[part])} on the {_name(part)}; lower method.points, or lower method.point_voxel."
        )
    coverage, part_of = coverage_of(capture), parts_of(body.vertices)
    for part in _PARTS:
        whole = coverage.area * (part_of == part)
        shown = float(whole[coverage.weight >= WELL].sum() / whole.sum().clamp_min(1e-12))
        if whole.sum() > 0 and shown < MIN_SHOWN:
            raise TwofoldError(
                f"NPC finds points on every body part, and the {len(capture.train)} training images of "
                f"{capture.folder} show {100 * shown:.0f} % of the {_name(part)}; add training frames that show it, or "
                "choose another --recipe."
            )


_PARTS = range(len(RIGID_PARTS))


def _name(part: int) -> str:
    return JOINT_NAMES[RIGID_PARTS[part]].replace("_", " ")
