"""What one image of a capture says: how well mask and posed body agree, and whether their sides do."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from PIL import Image
from scipy import ndimage
from torch import Tensor

from twofold.body.skeleton import JOINT_NAMES, ShapedBody, blend_shapes, joint_transforms, skin
from twofold.capture.types import Frame
from twofold.check.mask_measures import MaskFacts, mask_facts
from twofold.geometry.cameras import Camera, project
from twofold.geometry.raster import Hits, rasterize
from twofold.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from twofold.geometry.silhouettes import overlap
from twofold.images import read_grey, read_rgb

LOOKED_AT = 320
"""Longest side, in pixels, at which body and mask are compared: finer than any fit is, and quick."""
TWIN_SIZE = 144
"""Longest side at which twins are compared: many of them are tried, and a limb is still some pixels wide."""
POINTS = 8000
"""Points that stand for the body's surface where many guesses are tried; three for each pixel it covers then."""
_OTHER_SIDE = [
    JOINT_NAMES.index(name.replace("left", "?").replace("right", "left").replace("?", "right")) for name in JOINT_NAMES
]


@dataclass(frozen=True)
class Window:
    """A part of an image, scaled down.

    Attributes:
        box: left, top, right, bottom in whole pixels of the image; the last two are outside.
        camera: sees just this part in its new size.
    """

    box: tuple[int, int, int, int]
    camera: Camera

    def mask(self, mask: UInt8[np.ndarray, "h w"]) -> Bool[np.ndarray, "a b"]:
        """The same part of a mask."""
        size = (self.camera.width, self.camera.height)
        return np.asarray(Image.fromarray(mask).resize(size, Image.Resampling.BOX, box=self.box)) > 127

    def image(self, image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "a b 3"]:
        """The same part of an image."""
        size = (self.camera.width, self.camera.height)
        return np.asarray(Image.fromarray(image).resize(size, Image.Resampling.LANCZOS, box=self.box))


@dataclass(frozen=True)
class Twins:
    """How well bodies with changed sides fit, beside the body as it is given; all drawn in the same rough way.

    Attributes:
        given: silhouette IoU of the body with the mask.
        sides: of the body whose left limbs do what the right ones did.
        facing: of the body turned round, left and right exchanged, so that from the front it covers the same pixels.
        sides_differ: 1 - IoU of the given body with that twin: near 0 the mask cannot tell them apart.
        facing_differs: the same.
    """

    given: float
    sides: float
    facing: float
    sides_differ: float
    facing_differs: float


@dataclass(frozen=True)
class FrameFacts:
    """What one image showed.

    Attributes:
        camera: its name.
        frame_index: which frame of the capture.
        split: of the capture.
        iou: silhouette of the posed body and mask, where nothing is ignored.
        size_ratio: root of mask area over body area; above 1 the mask is larger.
        offset: from the body's centre to the mask's, in body heights: right and down.
        body_height: of the person standing upright at that distance, pixels.
        body_outside: share of the body's points that project outside the image.
        mask: facts of the mask alone.
        ignored: share of the mask that is ignored, because something hides the person there.
        twins: whether other sides fit better.
        sharpness: mean strength of the finest details on the person, 0..1.
    """

    camera: str
    frame_index: int
    split: str
    iou: float
    size_ratio: float
    offset: tuple[float, float]
    body_height: float
    body_outside: float
    mask: MaskFacts
    ignored: float
    twins: Twins
    sharpness: float


def posed_points(
    shaped: ShapedBody, pose: Float[Tensor, "24 3"], translation: Float[Tensor, "3"]
) -> Float[Tensor, "V 3"]:
    """Vertices of the body in a pose, world, metres."""
    transforms = joint_transforms(shaped.joints, pose, translation)
    return skin(blend_shapes(shaped, pose), shaped.weights, transforms)


def surface_points(shaped: ShapedBody, count: int = POINTS) -> ShapedBody:
    """A body made of points spread evenly over the skin of another one; it has no faces."""
    a, b, c = (shaped.vertices[shaped.faces[:, corner]] for corner in range(3))
    area = torch.linalg.cross(b - a, c - a).norm(dim=-1).double()
    ends = area.cumsum(0)
    # Equal steps along the summed area give every face its share without chance.
    steps = (torch.arange(count, dtype=torch.float64) + 0.5) * ends[-1] / count
    face = torch.searchsorted(ends, steps).clamp_max(len(ends) - 1)
    golden = (torch.arange(count, dtype=torch.float64) * 0.6180339887498949) % 1
    other = (torch.arange(count, dtype=torch.float64) * 0.7548776662466927) % 1
    root = golden.sqrt()
    barycentric = torch.stack([1 - root, root * (1 - other), root * other], -1).to(shaped.vertices.dtype)
    corners = shaped.faces[face]

    def between(values: Tensor) -> Tensor:
        flat = values.flatten(1)
        return sum(barycentric[:, k, None] * flat[corners[:, k]] for k in range(3)).unflatten(1, values.shape[1:])  # type: ignore[union-attr]

    basis = between(shaped.pose_basis) if shaped.pose_basis.shape[-1] else shaped.pose_basis.new_zeros(count, 3, 0)
    return ShapedBody(between(shaped.vertices), shaped.joints, shaped.faces[:0], between(shaped.weights), basis)


def mirrored_pose(pose: Float[Tensor, "24 3"]) -> Float[Tensor, "24 3"]:
    """The pose in which the left side does what the right one did; the root stays as it is.

    >>> pose = torch.zeros(24, 3)
    >>> pose[JOINT_NAMES.index("left_knee")] = torch.tensor([0.5, 0.1, 0.2])
    >>> [round(float(v), 1) for v in mirrored_pose(pose)[JOINT_NAMES.index("right_knee")]]
    [0.5, -0.1, -0.2]
    """
    mirrored = pose[_OTHER_SIDE] * torch.tensor([1.0, -1.0, -1.0]).to(pose)
    return torch.cat([pose[:1], mirrored[1:]])


def turned_round(pose: Float[Tensor, "24 3"]) -> Float[Tensor, "24 3"]:
    """The mirrored pose with the root rotated by 180 degrees about the body's own axis.

    Limbs stay where they are, as seen from the front or the back, and the body faces the other way.
    """
    half = torch.diag(torch.tensor([-1.0, 1.0, -1.0])).to(pose)
    root = matrix_to_axis_angle(axis_angle_to_matrix(pose[:1]) @ half)
    return torch.cat([root, mirrored_pose(pose)[1:]])


def window_of(
    camera: Camera,
    mask: UInt8[np.ndarray, "h w"],
    pixels: Float[Tensor, "n 2"],
    longest: int,
    margin: float = 0.06,
    aspect: float | None = None,
) -> Window:
    """The part of an image that holds its mask and these pixels (column, row), as far as they are in it.

    Args:
        camera: of the image.
        mask: of the image.
        pixels: that should be seen, too.
        longest: side of the window, pixels; it is never enlarged.
        margin: added on each side, as a share of the longer side.
        aspect: width over height that is wanted, as far as the image reaches; any without.
    """
    shown = mask > 127
    columns, rows = np.flatnonzero(shown.any(0)), np.flatnonzero(shown.any(1))
    corners = [pixels.numpy()] if len(pixels) else []
    if len(columns):
        corners.append(np.array([[columns[0], rows[0]], [columns[-1], rows[-1]]], np.float32))
    size = np.array([camera.width, camera.height])
    inside = np.clip(np.concatenate(corners), 0, size - 1) if corners else np.stack([np.zeros(2), size - 1])
    low, high = inside.min(0), inside.max(0)
    extent = (high - low) + 2 * margin * (high - low).max()
    if aspect is not None:
        extent = np.maximum(extent, [aspect * extent[1], extent[0] / aspect])
    extent = np.minimum(extent, size)
    start = np.clip((low + high - extent) / 2, 0, size - extent)
    left, top = np.clip(np.floor(start), 0, size - 2).astype(int).tolist()
    right, bottom = np.clip(np.ceil(start + extent) + 1, (left + 2, top + 2), size).astype(int).tolist()
    cut = camera.intrinsics.clone()
    cut[:2, 2] -= torch.tensor([float(left), float(top)])
    scale = min(1.0, longest / max(right - left, bottom - top))
    part = Camera(camera.world_to_camera, cut, bottom - top, right - left)
    small = part.resized(max(round(scale * part.height), 1), max(round(scale * part.width), 1))
    return Window((left, top, right, bottom), small)


def splat(pixels: Float[Tensor, "n 2"], depth: Float[Tensor, "n"], height: int, width: int) -> Bool[np.ndarray, "h w"]:
    """The pixels that a dense cloud of points covers; points behind the camera are left out."""
    rounded = pixels[depth > 0].round()
    size = torch.tensor([width, height])
    rounded = rounded[((rounded >= 0) & (rounded < size)).all(-1)].long().numpy()
    canvas = np.zeros((height + 4, width + 4), bool)
    canvas[rounded[:, 1] + 2, rounded[:, 0] + 2] = True
    # A closing by three pixels, which fills the holes between points; written out, because it is called so often.
    tall = canvas[:-2] | canvas[1:-1] | canvas[2:]
    grown = tall[:, :-2] | tall[:, 1:-1] | tall[:, 2:]
    low = grown[:-2] & grown[1:-1] & grown[2:]
    return low[:, :-2] & low[:, 1:-1] & low[:, 2:]


@dataclass(frozen=True)
class LookedAt:
    """An image opened, with the body drawn into it.

    Attributes:
        window: the part that is looked at.
        mask: that part of the mask.
        known: pixels that are not ignored.
        hits: what the pixels of the window see of the body.
        body: pixels that the body covers.
    """

    window: Window
    mask: Bool[np.ndarray, "a b"]
    known: Bool[np.ndarray, "a b"]
    hits: Hits
    body: Bool[np.ndarray, "a b"]


def read_bytes(frame: Frame) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]:
    """Image and mask as they are stored."""
    return read_rgb(frame.image_file), read_grey(frame.mask_file)


def read_mask(frame: Frame) -> UInt8[np.ndarray, "h w"]:
    """The mask as it is stored."""
    return read_grey(frame.mask_file)


def stature(shaped: ShapedBody) -> float:
    """How tall the person stands in the T-pose, metres."""
    return float(shaped.vertices[:, 1].max() - shaped.vertices[:, 1].min())


def look_at(
    frame: Frame,
    shaped: ShapedBody,
    mask: UInt8[np.ndarray, "h w"],
    longest: int = LOOKED_AT,
    aspect: float | None = None,
) -> LookedAt:
    """Draws the posed body into the part of the image that holds it and the mask; see `window_of`."""
    vertices = posed_points(shaped, frame.pose, frame.translation)
    pixels, depth = project(frame.camera, vertices)
    window = window_of(frame.camera, mask, pixels[depth > 0], longest, aspect=aspect)
    hits = rasterize(window.camera, vertices, shaped.faces, cull=True)
    body = np.zeros(window.camera.height * window.camera.width, bool)
    body[hits.pixel.numpy()] = True
    ignored = frame.ignored().numpy().astype(np.uint8) * 255
    return LookedAt(
        window, window.mask(mask), ~window.mask(ignored), hits,
        body.reshape(window.camera.height, window.camera.width),
    )  # fmt: skip


def frame_facts(frame: Frame, split: str, shaped: ShapedBody, points: ShapedBody) -> FrameFacts:
    """Everything that is measured in one image.

    Args:
        frame: the image.
        split: that it belongs to.
        shaped: the person's body.
        points: the same as `surface_points`.
    """
    image, mask = read_bytes(frame)
    look = look_at(frame, shaped, mask)
    shown, body = look.mask & look.known, look.body & look.known
    cloud = posed_points(points, frame.pose, frame.translation)
    pixels, depth = project(frame.camera, cloud)
    tall = stature(shaped) * float(frame.camera.intrinsics[1, 1]) / max(float(depth.median()), 1e-3)
    scale = (look.window.box[3] - look.window.box[1]) / look.window.camera.height
    size = torch.tensor([frame.camera.width, frame.camera.height])
    inside = ((pixels >= -0.5) & (pixels <= size - 0.5)).all(-1) & (depth > 0)
    return FrameFacts(
        camera=frame.camera_name,
        frame_index=frame.frame_index,
        split=split,
        iou=overlap(shown, body),
        size_ratio=float(np.sqrt(shown.sum() / max(body.sum(), 1))),
        offset=_offset(shown, body, max(tall / scale, 1.0)),
        body_height=tall,
        body_outside=1 - float(inside.float().mean()),
        mask=mask_facts(mask),
        ignored=1 - np.count_nonzero(shown) / max(np.count_nonzero(look.mask), 1),
        twins=_twins(frame, points, cloud, mask),
        sharpness=_sharpness(image, mask),
    )


def _offset(mask: np.ndarray, body: np.ndarray, tall: float) -> tuple[float, float]:
    if not mask.any() or not body.any():
        return 0.0, 0.0
    here, there = (np.argwhere(m).mean(0) for m in (mask, body))
    down, right = ((here - there) / tall).tolist()
    return right, down


def _twins(frame: Frame, points: ShapedBody, given: Float[Tensor, "n 3"], mask: np.ndarray) -> Twins:
    pixels, depth = project(frame.camera, given)
    window = window_of(frame.camera, mask, pixels[depth > 0], TWIN_SIZE)
    known = ~window.mask(frame.ignored().numpy().astype(np.uint8) * 255)
    shown = window.mask(mask) & known
    twins = [
        posed_points(points, pose, frame.translation) for pose in (mirrored_pose(frame.pose), turned_round(frame.pose))
    ]
    size = (window.camera.height, window.camera.width)
    drawn = [splat(*project(window.camera, cloud), *size) & known for cloud in (given, *twins)]
    fits = [overlap(shown, one) for one in drawn]
    return Twins(fits[0], fits[1], fits[2], 1 - overlap(drawn[0], drawn[1]), 1 - overlap(drawn[0], drawn[2]))


def _sharpness(image: np.ndarray, mask: np.ndarray) -> float:
    """Mean absolute Laplacian on the person, away from the outline, which is sharp in any cut-out image."""
    person = mask > 127
    rows, columns = np.flatnonzero(person.any(1)), np.flatnonzero(person.any(0))
    if not len(rows):
        return 0.0
    part = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    # Green stands for brightness: one channel is enough to see blur in.
    grey = image[part][..., 1].astype(np.int16)
    details = np.abs(grey[:-2, 1:-1] + grey[2:, 1:-1] + grey[1:-1, :-2] + grey[1:-1, 2:] - 4 * grey[1:-1, 1:-1])
    inner = np.asarray(ndimage.binary_erosion(person[part], iterations=3), dtype=bool)[1:-1, 1:-1]
    return float(details[inner].mean()) / 255 if inner.any() else 0.0


def side_of_faces(shaped: ShapedBody) -> Int[np.ndarray, "F"]:
    """1 for faces on the person's left arm or leg, 2 on the right, 0 on the trunk and head."""
    limbs = ("hip", "knee", "ankle", "foot", "shoulder", "elbow", "wrist", "hand")
    kinds = [0 if n.split("_")[-1] not in limbs else 1 if n.startswith("left") else 2 for n in JOINT_NAMES]
    share = torch.zeros(len(shaped.weights), 3).index_add(1, torch.tensor(kinds), shaped.weights)
    return share[shaped.faces].sum(1).argmax(-1).numpy()
