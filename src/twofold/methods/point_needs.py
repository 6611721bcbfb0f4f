"""What NPC's points need of a capture, found before the hours of its first stage."""

import torch
from jaxtyping import Float
from torch import Tensor

from twofold.body.skeleton import JOINT_NAMES, Body, pose_body, shape_body
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
"""Smallest share of a part's surface that training images have to show, or its points lie on the body's surface."""
MOST_UNSEEN = 2
"""Parts that training images may fail to show: of a person filmed from one side the spot between the shoulder blades,
but no limb."""


@torch.no_grad()
def require_points(capture: Capture, half_sizes: Float[Tensor, "19 3"], count: int, voxel: float) -> str | None:
    """Refuses captures and settings with which body parts would get no points, or too few.

    Args:
        capture: to be trained on.
        half_sizes: of the boxes of the rigid parts, metres.
        count: points of each part.
        voxel: spacing of the grid that they are found on, metres.

    Returns:
        which parts will have their points on the body's surface, because no training image shows them; None if none.

    Raises:
        TwofoldError: names the part.
    """
    shaped = shape_body(capture.body, capture.betas)
    points, area = body_surface(capture.body, capture.betas)
    part = assign_to_boxes(_coordinates(points, shaped.joints, half_sizes), half_sizes)
    fewest = PER_SQUARE * area / SAMPLES / voxel**2 * torch.stack([(part == p).sum() for p in _PARTS])
    least = int(fewest.argmin())
    if fewest[least] < count:
        raise TwofoldError(
            f"NPC needs {count} points on each body part, and a grid of {1000 * voxel:g} mm has room for about "
            f"{int(fewest[least])} on the {_name(least)}; lower method.points, or lower method.point_voxel."
        )
    unseen = unseen_parts(capture, half_sizes)
    if len(unseen) > MOST_UNSEEN:
        named, shown = next(iter(unseen.items()))
        raise TwofoldError(
            f"NPC finds points on every body part, and the {len(capture.train)} training images of {capture.folder} "
            f"show {100 * shown:.0f} % of the {_name(named)} and too little of {len(unseen) - 1} other parts; add "
            "training frames that show them, or choose another --recipe."
        )
    if not unseen:
        return None
    names = " and the ".join(_name(p) for p in unseen)
    return f"No training image shows the {names} well: NPC takes its points there from the body model's surface."


@torch.no_grad()
def unseen_parts(capture: Capture, half_sizes: Float[Tensor, "19 3"]) -> dict[int, float]:
    """Which of the 19 parts training images hardly show, and the share of their surface that these show.

    Args:
        capture: to be trained on.
        half_sizes: of the boxes of the rigid parts, metres.
    """
    shaped, zero = shape_body(capture.body, capture.betas), torch.zeros(24, 3)
    vertices = pose_body(shaped, zero, zero[0]).vertices
    coverage = coverage_of(capture)
    part_of = assign_to_boxes(_coordinates(vertices, shaped.joints, half_sizes), half_sizes)
    found = {}
    for part in _PARTS:
        whole = coverage.area * (part_of == part)
        shown = float(whole[coverage.weight >= WELL].sum() / whole.sum().clamp_min(1e-12))
        if whole.sum() > 0 and shown < MIN_SHOWN:
            found[part] = shown
    return found


@torch.no_grad()
def body_surface(body: Body, betas: Tensor) -> tuple[Float[Tensor, "s 3"], float]:
    """Points all over the body's surface in the T-pose, metres, and its area, square metres."""
    zero = torch.zeros(24, 3)
    posed = pose_body(shape_body(body, betas), zero, zero[0])
    points, _ = sample_surface(posed.vertices, posed.faces, SAMPLES, torch.Generator().manual_seed(0))
    return points, float(face_areas(posed.vertices, posed.faces).sum())


def _coordinates(points: Tensor, joints: Tensor, half_sizes: Tensor) -> Float[Tensor, "p 19 3"]:
    to_frame = bone_frames(joints).world_to_frame(torch.eye(4).repeat(24, 1, 1))[list(RIGID_PARTS)]
    return box_coordinates(points, to_frame, half_sizes)


_PARTS = range(len(RIGID_PARTS))


def _name(part: int) -> str:
    return JOINT_NAMES[RIGID_PARTS[part]].replace("_", " ")
