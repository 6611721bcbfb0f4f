"""Usual ways to write down a body before a camera that are not ours, as changes of a frame."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from twofold.body.skeleton import ShapedBody
from twofold.check.frame_measures import mirrored_pose, posed_points, turned_round
from twofold.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle, rigid_inverse


@dataclass(frozen=True)
class Placed:
    """A posed body before a camera, as a guess may change it.

    Attributes:
        points: of the body's surface, world, metres.
        shaped: the points in the T-pose.
        pose: axis-angle, radians.
        translation: SMPL's own, metres.
        world_to_camera: of the camera.
        intrinsics: of the camera, for the whole image.
        height: of the image, pixels.
        width: of the image, pixels.
    """

    points: Float[Tensor, "n 3"]
    shaped: ShapedBody
    pose: Float[Tensor, "24 3"]
    translation: Float[Tensor, "3"]
    world_to_camera: Float[Tensor, "4 4"]
    intrinsics: Float[Tensor, "3 3"]
    height: int
    width: int

    def posed(self, pose: Float[Tensor, "24 3"]) -> "Placed":
        """The same with another pose."""
        return replace(self, pose=pose, points=posed_points(self.shaped, pose, self.translation))


@dataclass(frozen=True)
class Convention:
    """A usual way to write things down that is not ours.

    Attributes:
        name: short, for `check.json`.
        wrong: what is the matter, where bodies fit with it.
        advice: what to do then.
        family: guesses of different families may be combined.
        change: what it makes of a frame.
    """

    name: str
    wrong: str
    advice: str
    family: str
    change: Callable[[Placed], Placed]


def sizes(ratio: float) -> list[Convention]:
    """Guesses about how large things are drawn, by twice and half and by a measured ratio."""
    found: list[Convention] = []
    for r in (0.5, 2.0, *([ratio] if 0.1 < ratio < 10 and abs(math.log(ratio)) > 0.12 else [])):
        found += [
            Convention(
                f"focal length x {r:.3g}", f"the focal length is {1 / r:.3g} times what the images show",
                f"multiply fx and fy by {r:.3g}", "size", lambda p, r=r: _zoomed(p, r, False),
            ),
            Convention(
                f"intrinsics x {r:.3g}", f"the intrinsics belong to images {1 / r:.3g} times as large",
                f"multiply fx, fy, cx and cy by {r:.3g}", "size", lambda p, r=r: _zoomed(p, r, True),
            ),
            Convention(
                f"body x {r:.3g}", f"the body is {1 / r:.3g} times as large as the person",
                f"fit its shape again, or scale the translations and cameras by {1 / r:.3g}", "size",
                lambda p, r=r: _grown(p, r),
            ),
        ]  # fmt: skip
    return found


def _zoomed(p: Placed, ratio: float, center_too: bool) -> Placed:
    intrinsics = p.intrinsics.clone()
    intrinsics[:2, : 3 if center_too else 2] *= ratio
    return replace(p, intrinsics=intrinsics)


def _grown(p: Placed, ratio: float) -> Placed:
    pelvis = p.shaped.joints[0] + p.translation
    return replace(p, points=pelvis + ratio * (p.points - pelvis))


def _world(*rows: Sequence[float | int]) -> Callable[[Placed], Placed]:
    """The body lives in another world than the cameras."""
    turn = torch.tensor(rows, dtype=torch.float32)
    return lambda p: replace(p, points=p.points @ turn.T)


def _root(change: Callable[[Tensor], Tensor]) -> Callable[[Placed], Placed]:
    """Another rotation of the root."""

    def changed(p: Placed) -> Placed:
        root = matrix_to_axis_angle(change(axis_angle_to_matrix(p.pose[:1])))
        return p.posed(torch.cat([root, p.pose[1:]]))

    return changed


def _moved(change: Callable[[Placed], Tensor]) -> Callable[[Placed], Placed]:
    """Another translation."""

    def changed(p: Placed) -> Placed:
        translation = change(p)
        return replace(p, translation=translation, points=p.points + translation - p.translation)

    return changed


def _camera(change: Callable[[Tensor], Tensor]) -> Callable[[Placed], Placed]:
    """Another reading of the camera's matrix."""
    return lambda p: replace(p, world_to_camera=change(p.world_to_camera))


def _image(change: Callable[[int, int], Sequence[Sequence[float | int]]]) -> Callable[[Placed], Placed]:
    """Images whose pixels are stored in another order; `change` takes height and width."""

    def changed(p: Placed) -> Placed:
        return replace(p, intrinsics=torch.tensor(change(p.height, p.width), dtype=torch.float32) @ p.intrinsics)

    return changed


def _scaled_column(matrix: Tensor, factor: float) -> Tensor:
    return torch.cat([matrix[:, :3], matrix[:, 3:] * torch.tensor([[factor], [factor], [factor], [1.0]])], 1)


def _center_as_column(matrix: Tensor) -> Tensor:
    moved = matrix.clone()
    moved[:3, 3] = -matrix[:3, :3] @ matrix[:3, 3]
    return moved


def _transposed(matrix: Tensor) -> Tensor:
    turned = matrix.clone()
    turned[:3, :3] = matrix[:3, :3].T
    return turned


def _raw_swap(p: Placed) -> Placed:
    """Numbers of left and right joints exchanged as they are, as after a wrong joint order."""
    swapped = mirrored_pose(p.pose) * torch.tensor([1.0, -1.0, -1.0])
    return p.posed(torch.cat([p.pose[:1], swapped[1:]]))


def _mirrored_whole(p: Placed) -> Placed:
    pose = mirrored_pose(p.pose)
    return p.posed(torch.cat([pose[:1] * torch.tensor([1.0, -1.0, -1.0]), pose[1:]]))


_FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
_FLIP4 = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))


def _rolled(side: int) -> Callable[[Tensor], Tensor]:
    """Turns a camera by a quarter about its own axis, to one side (1) or the other (-1)."""
    roll = torch.tensor([[0, -side, 0, 0], [side, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], dtype=torch.float32)
    return lambda matrix: roll @ matrix


CONVENTIONS: tuple[Convention, ...] = (
    Convention(
        "OpenGL camera", "the camera axes are OpenGL's (y up, z towards the viewer)",
        "multiply the second and third row of world_to_camera by -1", "camera", _camera(lambda m: _FLIP4 @ m),
    ),
    Convention(
        "camera to world", "world_to_camera holds its inverse (camera to world)", "invert it", "camera",
        _camera(rigid_inverse),
    ),
    Convention(
        "OpenGL camera to world", "world_to_camera holds camera to world, with OpenGL's axes (y up, z towards the "
        "viewer)", "invert it, then multiply its second and third row by -1", "camera",
        _camera(lambda m: _FLIP4 @ rigid_inverse(m)),
    ),
    Convention(
        "camera centre", "the last column of world_to_camera holds where the camera stands",
        "put minus the rotation times that there", "camera", _camera(_center_as_column),
    ),
    Convention(
        "transposed rotation", "the rotation in world_to_camera is transposed", "transpose its upper left 3 x 3",
        "camera", _camera(_transposed),
    ),
    Convention(
        "world turned over", "the body's world has y and z the other way round than the cameras' (y down, z away)",
        "rotate roots and translations by 180 degrees about x, or the cameras", "world",
        _world((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    ),
    Convention(
        "z up", "the body's world has y up and the cameras' has z up",
        "turn root rotations and translations by a quarter about x, or the cameras", "world",
        _world((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    ),
    Convention(
        "y up", "the body's world has z up and the cameras' has y up",
        "turn root rotations and translations by minus a quarter about x, or the cameras", "world",
        _world((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    ),
    Convention(
        "facing away", "the body's world is rotated by 180 degrees about y against the cameras'",
        "rotate roots and translations by 180 degrees about y, or the cameras", "world",
        _world((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
    ),
    Convention(
        "upside down", "the body's world is rotated by 180 degrees about z against the cameras'",
        "rotate roots and translations by 180 degrees about z, or the cameras", "world",
        _world((-1, 0, 0), (0, -1, 0), (0, 0, 1)),
    ),
    Convention(
        "left/right swap", "the left and right limbs are exchanged",
        "exchange the rotations of left and right joints and negate their y and z parts", "pose",
        lambda p: p.posed(mirrored_pose(p.pose)),
    ),
    Convention(
        "left/right order swapped", "the left and right joints are in the wrong order",
        "exchange the rotations of left and right joints", "pose", _raw_swap,
    ),
    Convention(
        "images mirrored", "images and masks are mirrored left to right against body and cameras",
        "mirror them back or, where writing in the images reads well, mirror poses, translations and cameras",
        "picture",
        _image(lambda h, w: ((-1, 0, w - 1), (0, 1, 0), (0, 0, 1))),
    ),
    Convention(
        "pose mirrored", "the whole pose is mirrored, root and all",
        "exchange the rotations of left and right joints, and negate the y and z parts of all, the root's too", "pose",
        _mirrored_whole,
    ),
    Convention(
        "turned round", "the body faces the other way", "rotate the roots by 180 degrees about the body's axis and "
        "swap left and right limbs", "pose", lambda p: p.posed(turned_round(p.pose)),
    ),
    Convention(
        "world mirrored in x", "the body's world is mirrored against the cameras' (x the other way)",
        "mirror translations, roots and sides back", "world", _world((-1, 0, 0), (0, 1, 0), (0, 0, 1)),
    ),
    Convention(
        "world mirrored in y", "the body's world is mirrored against the cameras' (y the other way)",
        "mirror translations, roots and sides back", "world", _world((1, 0, 0), (0, -1, 0), (0, 0, 1)),
    ),
    Convention(
        "world mirrored in z", "the body's world is mirrored against the cameras' (z the other way)",
        "mirror translations, roots and sides back", "world", _world((1, 0, 0), (0, 1, 0), (0, 0, -1)),
    ),
    Convention(
        "root inverted", "the root rotations are inverted", "negate the first row of each pose", "pose",
        _root(lambda m: m.transpose(-1, -2)),
    ),
    Convention(
        "root in other axes", "the root rotations have y and z the other way round than the translations",
        "rotate the roots by 180 degrees about x", "pose", _root(lambda m: _FLIP @ m),
    ),
    Convention(
        "translation in other axes", "the translations have y and z the other way round than the root rotations",
        "multiply y and z of the translations by -1", "translation", _moved(lambda p: _FLIP @ p.translation),
    ),
    Convention(
        "turning about the origin", "the translations are EasyMocap's (`Th`: the root turns about the model's origin)",
        "add R j - j to each translation, with R the root's rotation and j its rest position", "translation",
        _moved(lambda p: p.translation + axis_angle_to_matrix(p.pose[0]) @ p.shaped.joints[0] - p.shaped.joints[0]),
    ),
    Convention(
        "translation of the pelvis", "the translations say where the pelvis is",
        "subtract the pelvis' rest position from each translation", "translation",
        _moved(lambda p: p.translation - p.shaped.joints[0]),
    ),
    Convention(
        "translation in millimetres", "the translations are in millimetres", "divide the translations by 1000", "unit",
        _moved(lambda p: p.translation / 1000),
    ),
    Convention(
        "translation in centimetres", "the translations are in centimetres", "divide the translations by 100", "unit",
        _moved(lambda p: p.translation / 100),
    ),
    Convention(
        "camera in millimetres", "the cameras' positions are in millimetres",
        "divide the last column of world_to_camera by 1000", "unit", _camera(lambda m: _scaled_column(m, 1e-3)),
    ),
    Convention(
        "camera in centimetres", "the cameras' positions are in centimetres",
        "divide the last column of world_to_camera by 100", "unit", _camera(lambda m: _scaled_column(m, 1e-2)),
    ),
    Convention(
        "both in millimetres", "translations and cameras' positions are in millimetres",
        "divide the translations and the last column of world_to_camera by 1000", "unit",
        lambda p: _camera(lambda m: _scaled_column(m, 1e-3))(_moved(lambda q: q.translation / 1000)(p)),
    ),
    Convention(
        "body in millimetres", "the body is in millimetres, unlike translations and cameras",
        "divide template, joints and the shape bases in body.npz by 1000", "unit", lambda p: _shrunk(p, 1e-3),
    ),
    Convention(
        "body in centimetres", "the body is in centimetres, unlike translations and cameras",
        "divide template, joints and the shape bases in body.npz by 100", "unit", lambda p: _shrunk(p, 1e-2),
    ),
    Convention(
        "upside-down images", "images and masks stand on their heads", "rotate them by 180 degrees", "picture",
        _image(lambda h, w: ((-1, 0, w - 1), (0, -1, h - 1), (0, 0, 1))),
    ),
    Convention(
        "rows from the bottom", "the rows of images and masks run from the bottom up", "turn them over", "picture",
        _image(lambda h, w: ((1, 0, 0), (0, -1, h - 1), (0, 0, 1))),
    ),
    Convention(
        "images turned right", "images and masks are turned by a quarter, clockwise, against the camera",
        "turn them back by a quarter", "picture", _image(lambda h, w: ((0, -1, w - 1), (1, 0, 0), (0, 0, 1))),
    ),
    Convention(
        "images turned left", "images and masks are turned by a quarter, anticlockwise, against the camera",
        "turn them back by a quarter", "picture", _image(lambda h, w: ((0, 1, 0), (-1, 0, h - 1), (0, 0, 1))),
    ),
    Convention(
        "camera rolled right", "the camera is rolled by a quarter against its images",
        "exchange its first two rows and negate the new first", "camera", _camera(_rolled(1)),
    ),
    Convention(
        "camera rolled left", "the camera is rolled by a quarter against its images",
        "exchange its first two rows and negate the new second", "camera", _camera(_rolled(-1)),
    ),
    Convention(
        "principal point off the middle", "the principal point is not where the images show it",
        "put it into the middle: cx = (width - 1) / 2, cy = (height - 1) / 2", "center",
        lambda p: _centered(p, (p.width - 1) / 2, (p.height - 1) / 2),
    ),
    Convention(
        "principal point exchanged", "cx and cy are exchanged", "exchange them", "center",
        lambda p: _centered(p, float(p.intrinsics[1, 2]), float(p.intrinsics[0, 2])),
    ),
)  # fmt: skip
"""The usual ones first: of guesses that are equally good the earlier one is named."""


def _centered(p: Placed, x: float, y: float) -> Placed:
    intrinsics = p.intrinsics.clone()
    intrinsics[0, 2], intrinsics[1, 2] = x, y
    return replace(p, intrinsics=intrinsics)


def _shrunk(p: Placed, factor: float) -> Placed:
    return replace(p, points=(p.points - p.translation) * factor + p.translation)
