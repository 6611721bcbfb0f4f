"""Images of a posed body: over its image, from the side and from above, where leaning and floating show."""

import io
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from PIL import Image, ImageOps
from scipy import ndimage
from torch import Tensor

from twofold.body.leg_ik import ANKLES, TOES
from twofold.body.skeleton import ShapedBody, pose_body, shape_body
from twofold.capture.types import Capture, Frame, spread
from twofold.check.frame_measures import look_at, read_bytes, side_of_faces, stature
from twofold.files import write_together
from twofold.geometry.cameras import Camera, project
from twofold.geometry.raster import rasterize
from twofold.geometry.surfaces import vertex_normals

CELL = (270, 360)
"""Width and height of an image, pixels."""
TINTS = np.array([(72, 190, 130), (245, 140, 30), (40, 120, 250)], np.float32)
"""Trunk and head, left limbs, right limbs; told apart by colour-blind eyes, too."""
IGNORED = np.array((190, 50, 210), np.float32)
"""Pixels that are ignored."""
OUTLINE = (255, 255, 70)
"""Of the mask."""
EMPTY, FLOOR = (18, 20, 24), np.array((120, 126, 136), np.float32)
"""What no image shows, and the line of the floor."""
FIT_PICTURE = "fit.jpg"
"""In the folder of a capture."""
_FAR, _SHOWN = 5.0, 1.35
"""Distance of the cameras beside and above, and what their images show from top to bottom, in heights of the person."""


def overlay(
    frame: Frame, shaped: ShapedBody, sides: Int[np.ndarray, "F"], cell: tuple[int, int] = CELL
) -> UInt8[np.ndarray, "h w 3"]:
    """The posed body tinted over the image, left limbs orange and right ones blue, and the mask's outline.

    What is ignored, because an object hides the person there, is purple.

    Args:
        frame: holds the image.
        shaped: the person's body.
        sides: of its faces (`side_of_faces`).
        cell: width and height of the result, pixels; what the image lacks is dark.
    """
    image, mask = read_bytes(frame)
    look = look_at(frame, shaped, mask, max(cell), cell[0] / cell[1])
    canvas = look.window.image(image).astype(np.float32)
    flat = canvas.reshape(-1, 3)
    pixel = look.hits.pixel.numpy()
    flat[pixel] = 0.5 * flat[pixel] + 0.5 * TINTS[sides[look.hits.face.numpy()]]
    canvas = np.where(look.known[..., None], canvas, 0.4 * canvas + 0.6 * IGNORED)
    edge = look.mask & ~np.asarray(ndimage.binary_erosion(look.mask, border_value=1), dtype=bool)
    canvas[edge] = OUTLINE
    stored = Image.fromarray(canvas.round().astype(np.uint8))
    return np.asarray(ImageOps.pad(stored, cell, color=EMPTY))


def beside(
    frame: Frame, pelvis: Float[Tensor, "3"], height: float, above: bool, cell: tuple[int, int] = CELL
) -> Camera:
    """A camera that sees the body from a side that was not filmed, in a world with y up.

    Args:
        frame: whose camera filmed it: in the view from the side that one stands at the left, from above at the bottom.
        pelvis: of the body, world, metres.
        height: of the person, metres.
        above: from above.
        cell: width and height of the image, pixels.
    """
    up = torch.tensor([0.0, 1.0, 0.0])
    front = frame.camera.center - pelvis
    front = torch.nn.functional.normalize(front - (front @ up) * up, dim=0)
    if above:
        right, down, ahead = torch.linalg.cross(up, front), front, -up
    else:
        right, down, ahead = -front, -up, -torch.linalg.cross(up, front)
    view = torch.eye(4)
    view[:3, :3] = torch.stack([right, down, ahead])
    view[:3, 3] = -view[:3, :3] @ (pelvis - _FAR * height * ahead)
    width, rows = cell
    focal = rows * _FAR / _SHOWN
    lens = torch.tensor([[focal, 0, (width - 1) / 2], [0, focal, (rows - 1) / 2], [0, 0, 1]])
    return Camera(view, lens, rows, width)


def unfilmed_view(
    frame: Frame,
    shaped: ShapedBody,
    sides: Int[np.ndarray, "F"],
    above: bool,
    floor: float,
    cell: tuple[int, int] = CELL,
) -> UInt8[np.ndarray, "h w 3"]:
    """The posed body from the side, with a line for the floor, or from above.

    Args:
        frame: with the pose, in a world with y up.
        shaped: the person's body.
        sides: of its faces (`side_of_faces`).
        above: from above, else from the side.
        floor: height of the lower foot's joints where it usually stands (`StandingFacts.floor`), metres.
        cell: width and height, pixels.
    """
    body = pose_body(shaped, frame.pose, frame.translation)
    camera = beside(frame, body.joints[0], stature(shaped), above, cell)
    canvas = np.broadcast_to(np.array(EMPTY, np.float32), (cell[1], cell[0], 3)).copy()
    if not above:
        feet = float(shaped.joints[[*ANKLES, *TOES], 1].mean() - shaped.vertices[:, 1].min())
        below = torch.stack([body.joints[0, 0], torch.tensor(floor - feet), body.joints[0, 2]])
        row = round(float(project(camera, below[None])[0][0, 1]))
        if 0 <= row < cell[1]:
            canvas[row] = FLOOR
    hits = rasterize(camera, body.vertices, body.faces, cull=True)
    normal = vertex_normals(body.vertices, body.faces)[body.faces[hits.face]].mean(1)
    facing = (normal @ camera.world_to_camera[2, :3]).abs().clamp(0, 1).numpy()
    shade = 0.45 + 0.55 * facing[:, None]
    canvas.reshape(-1, 3)[hits.pixel.numpy()] = TINTS[sides[hits.face.numpy()]] * shade
    return canvas.round().astype(np.uint8)


def views_of(
    frame: Frame, shaped: ShapedBody, sides: Int[np.ndarray, "F"], floor: float, cell: tuple[int, int] = CELL
) -> dict[str, UInt8[np.ndarray, "h w 3"]]:
    """The overlay and both views that were not filmed, by words for a caption; see `unfilmed_view`."""
    return {
        "": overlay(frame, shaped, sides, cell),
        ", from the side": unfilmed_view(frame, shaped, sides, False, floor, cell),
        ", from above": unfilmed_view(frame, shaped, sides, True, floor, cell),
    }


def write_fit_picture(capture: Capture, folder: Path, floor: float, frames: int = 4) -> Path:
    """Writes `FIT_PICTURE`: frames of the capture as overlay, from the side and from above, two in a row.

    Args:
        capture: with y up.
        folder: where to write.
        floor: see `unfilmed_view`.
        frames: how many, spread evenly over the training images.

    Raises:
        TwofoldError: the folder cannot be written.
    """
    shaped = shape_body(capture.body, capture.betas)
    sides = side_of_faces(shaped)
    with torch.inference_mode():
        triples = [np.hstack(list(views_of(f, shaped, sides, floor).values())) for f in spread(capture.train, frames)]
    if len(triples) % 2 and len(triples) > 1:
        triples.append(np.full_like(triples[0], EMPTY))
    rows = [np.hstack(triples[k : k + 2]) for k in range(0, len(triples), 2)]
    buffer = io.BytesIO()
    Image.fromarray(np.vstack(rows)).save(buffer, "JPEG", quality=88)
    write_together(folder, {FIT_PICTURE: buffer.getvalue()})
    return folder / FIT_PICTURE
