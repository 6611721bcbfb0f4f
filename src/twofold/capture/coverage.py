"""How well the training images observed each point of a person's surface.

The body in the pose of each image is drawn into a z-buffer; a vertex that no triangle hides is observed, the better the
more it faces the camera and the more pixels a metre of it has. Clothes and hair are taken to be seen where the body
below them is.
"""

import weakref
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from twofold.body.skeleton import PosedBody, pose_body, shape_body
from twofold.capture.types import Capture, spread
from twofold.errors import TwofoldError
from twofold.geometry.cameras import Camera, project
from twofold.geometry.raster import depth_map
from twofold.geometry.surfaces import face_areas, nearest_vertices, vertex_normals
from twofold.npz import are_moderate

MAX_FRAMES = 100
"""Images that are looked at, evenly spread: a fiftieth of a second each."""
FACING_FRAMES = 24
"""Images that `mean_facing` looks at."""
BUFFER = 384
"""Longer side of the z-buffers, pixels."""
BEHIND = 0.015
"""A vertex this far behind the nearest surface is hidden, metres: the body's triangles are about as large."""
GRAZING, FACING = 0.15, 0.55
"""Cosines of the angle between normal and line of sight from which a vertex counts, and from which it counts fully: at
81 degrees an error of pose moves the outline across it, at 57 degrees no more."""
OUTLINE = 0.35
"""Cosine of the angle between normal and line of sight up to which a vertex lies on the outline."""
OUTLINE_HALF = 1.0
"""Images on whose outline a vertex lies with which its place is half known."""
FINE = 20.0
"""Pixels a metre from which resolution is no limit: a hand is some pixels wide."""
FEW = 0.25
"""Good images with which a vertex counts half."""
WELL = 0.5
"""Weight from which a vertex counts as observed."""


@dataclass(frozen=True)
class Coverage:
    """How well the training images observed the vertices of a body.

    Attributes:
        count: images that see each vertex.
        cosine: of the angle between its normal and the direction to the camera, in the image where that is smallest;
            0 where no image sees it.
        resolution: pixels a metre in the image where these are most; 0 where no image sees it.
        weight: how well it was observed, 0 (never) to 1.
        area: of the surface around it in the canonical pose, square metres; 0 inside the mouth and the like.
        images: that were looked at.
        outline: how well the place of the surface was observed, 0 to 1: m / (m + 1) with the number m of images on
            whose outline the vertex lay.
    """

    count: Int[Tensor, "V"]
    cosine: Float[Tensor, "V"]
    resolution: Float[Tensor, "V"]
    weight: Float[Tensor, "V"]
    area: Float[Tensor, "V"]
    images: int
    outline: Float[Tensor, "V"]

    @property
    def share(self) -> float:
        """Share of the outer surface that was observed, 0..1."""
        return float(self.area[self.weight >= WELL].sum() / self.area.sum().clamp_min(1e-12))

    @property
    def outlined_share(self) -> float:
        """Share of the outer surface that lay on outlines, 0..1."""
        return float(self.area[self.outline >= WELL].sum() / self.area.sum().clamp_min(1e-12))

    def sentence(self) -> str:
        """For logs and reports."""
        return f"coverage: {100 * self.share:.0f} % of the surface"

    def arrays(self) -> dict[str, np.ndarray]:
        """As a run folder stores it."""
        tensors = {name: value.numpy() for name, value in vars(self).items() if isinstance(value, Tensor)}
        return tensors | {"images": np.array(self.images)}

    @staticmethod
    def from_arrays(arrays: dict[str, np.ndarray], where: str) -> "Coverage":
        """What `arrays` gave, read back.

        Raises:
            TwofoldError: something is missing, has the wrong shape or is not finite.
        """
        names = ("count", "cosine", "resolution", "weight", "area", "outline")
        if "weight" in arrays:
            # Runs of earlier versions did not look at outlines.
            arrays = {"outline": np.ones_like(arrays["weight"]), **arrays}
        sizes = {arrays[name].shape for name in names if name in arrays}
        whole = all(name in arrays for name in (*names, "images")) and len(sizes) == 1 and len(*sizes) == 1
        if not whole or not all(arrays[n].dtype.kind in "fiu" and are_moderate(arrays[n]) for n in (*names, "images")):
            raise TwofoldError(f"{where} does not hold the coverage of a body; it is damaged, train again.")
        tensors = {name: torch.as_tensor(arrays[name]).float() for name in names[1:]}
        return Coverage(torch.as_tensor(arrays["count"]).long(), **tensors, images=int(arrays["images"]))


def visible_vertices(
    camera: Camera, vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]
) -> tuple[Bool[Tensor, "V"], Float[Tensor, "V"], Float[Tensor, "V"]]:
    r"""Which vertices a camera sees, cosines of the angles to their normals, and pixels a metre there.

    A vertex $v$ with the normal $n$, seen from $o$, has the cosine $n \cdot (o - v) / \lVert o - v \rVert$ and
    $f / z$ pixels a metre at the depth $z$; it is seen where the cosine is positive, the image contains it and the
    z-buffer holds nothing nearer.

    Args:
        camera: from where.
        vertices: world, metres.
        faces: triangles, counter-clockwise from outside.
    """
    scale = min(1.0, BUFFER / max(camera.height, camera.width))
    small = camera.resized(max(round(camera.height * scale), 1), max(round(camera.width * scale), 1))
    depths, _ = depth_map(small, vertices, faces)
    pixels, depth = project(small, vertices)
    column, row = pixels.nan_to_num(-1.0, -1.0, -1.0).clamp(-1, BUFFER).round().long().unbind(-1)
    inside = (depth > 1e-3) & (column >= 0) & (row >= 0) & (column < small.width) & (row < small.height)
    front = depths[row.clamp(0, small.height - 1), column.clamp(0, small.width - 1)]
    # Where the buffer holds nothing, the vertex is on the outline.
    towards = camera.center.to(vertices) - vertices
    cosine = (vertex_normals(vertices, faces) * towards / towards.norm(dim=-1, keepdim=True).clamp_min(1e-9)).sum(-1)
    seen = inside & (cosine > 0) & (depth <= front + BEHIND)
    return seen, cosine, float(camera.intrinsics[0, 0]) / depth.clamp_min(1e-3)


def quality(seen: Bool[Tensor, "V"], cosine: Float[Tensor, "V"], resolution: Float[Tensor, "V"]) -> Float[Tensor, "V"]:
    r"""How well one image shows each vertex, 0..1.

    \[ q = [\text{seen}] \cdot \mathrm{clamp}\Big(\frac{\cos - c_0}{c_1 - c_0}, 0, 1\Big)
    \cdot \min\Big(\frac{r}{r_1}, 1\Big) \]

    >>> quality(torch.tensor([True, True, False]), torch.tensor([0.35, 1.0, 1.0]), torch.tensor([500.0, 10.0, 500.0]))
    tensor([0.5000, 0.5000, 0.0000])
    """
    facing = ((cosine - GRAZING) / (FACING - GRAZING)).clamp(0, 1)
    return seen * facing * (resolution / FINE).clamp_max(1)


def combined(best: Float[Tensor, "V"], total: Float[Tensor, "V"]) -> Float[Tensor, "V"]:
    r"""Weight of a vertex from the largest and the summed quality of all images.

    \[ w = q_{max} \, \frac{n}{n + n_0}, \qquad n = \sum_i q_i / q_{max} \]

    >>> combined(torch.tensor([1.0, 1.0, 0.0]), torch.tensor([1.0, 5.0, 0.0]))
    tensor([0.8000, 0.9524, 0.0000])
    """
    count = total / best.clamp_min(1e-9)
    return best * count / (count + FEW)


@torch.no_grad()
def measure_coverage(capture: Capture, max_frames: int = MAX_FRAMES) -> Coverage:
    """How well the training images observed the body, from their poses and cameras.

    Pixels that are ignored, because an object hides the person there, show nothing.

    Raises:
        TwofoldError: an image that says what is ignored is damaged.
    """
    shaped = shape_body(capture.body, capture.betas)
    frames = spread(capture.train, max_frames)
    zeros = torch.zeros(len(shaped.vertices))
    count, cosines, resolutions, best, total, outlines = zeros.long(), zeros, zeros, zeros, zeros, zeros
    body = None
    for frame in frames:
        body = pose_body(shaped, frame.pose, frame.translation)
        seen, cosine, resolution = visible_vertices(frame.camera, body.vertices, body.faces)
        if frame.ignored_file is not None:
            column, row = project(frame.camera, body.vertices)[0][seen].round().long().unbind(-1)
            ignored = frame.ignored()
            row, column = row.clamp(0, ignored.shape[0] - 1), column.clamp(0, ignored.shape[1] - 1)
            seen[seen.clone()] = ~ignored[row, column]
        count = count + seen
        cosines = torch.where(seen, torch.maximum(cosines, cosine), cosines)
        resolutions = torch.where(seen, torch.maximum(resolutions, resolution), resolutions)
        here = quality(seen, cosine, resolution)
        best, total = torch.maximum(best, here), total + here
        outlines = outlines + (seen & (cosine < OUTLINE))
    area = outer_area(body) if body is not None else zeros
    return Coverage(
        count, cosines, resolutions, combined(best, total), area, len(frames), outlines / (outlines + OUTLINE_HALF)
    )


@torch.no_grad()
def mean_facing(capture: Capture, max_frames: int = FACING_FRAMES) -> Float[Tensor, "V"]:
    r"""Mean cosine between each vertex's normal and its direction to the camera over training images, -1..1.

    \[ f_v = E_i \big[ n_{v,i} \cdot (o_i - v_i) / \lVert o_i - v_i \rVert \big] \]

    Near 1 on the front of somebody who always faces the camera, and near 0 everywhere on one who turns.
    """
    shaped = shape_body(capture.body, capture.betas)
    frames = spread(capture.train, max_frames)
    total = torch.zeros(len(shaped.vertices))
    for frame in frames:
        body = pose_body(shaped, frame.pose, frame.translation)
        towards = torch.nn.functional.normalize(frame.camera.center - body.vertices, dim=-1)
        total += (vertex_normals(body.vertices, body.faces) * towards).sum(-1)
    return total / len(frames)


def outer_area(body: PosedBody) -> Float[Tensor, "V"]:
    """Area of the surface around each vertex in the canonical pose, square metres; 0 where nobody can look."""
    vertices, faces = body.canonical_vertices, body.faces
    middle = (vertices.amin(0) + vertices.amax(0)) / 2
    reach = float((vertices - middle).norm(dim=-1).max())
    outer = torch.zeros(len(vertices), dtype=torch.bool)
    sides = [torch.tensor([x, y, z]).float() for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or y or z]
    for side in sides:
        outer |= visible_vertices(distant_camera(middle, side, reach), vertices, faces)[0]
    area = torch.zeros(len(vertices))
    for corner in range(3):
        area.index_add_(0, faces[:, corner], face_areas(vertices, faces) / 3)
    return area * outer


def distant_camera(middle: Float[Tensor, "3"], side: Float[Tensor, "3"], reach: float, size: int = BUFFER) -> Camera:
    """A square image of everything within `reach` metres of `middle`, from far away on one side, +y up in it."""
    away = 12 * reach
    forward = -side / side.norm()
    up = torch.tensor([0.0, 1.0, 0.0]) if abs(float(forward[1])) < 0.99 else torch.tensor([0.0, 0.0, 1.0])
    right = torch.linalg.cross(forward, up)
    right = right / right.norm()
    transform = torch.eye(4)
    transform[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    transform[:3, 3] = -transform[:3, :3] @ (middle - away * forward)
    focal, center = 0.5 * size * away / (1.04 * reach), (size - 1) / 2
    return Camera(transform, torch.tensor([[focal, 0, center], [0, focal, center], [0.0, 0, 1]]), size, size)


_last: "list[tuple[weakref.ref[Capture], Coverage]]" = []


def coverage_of(capture: Capture) -> Coverage:
    """`measure_coverage` of a capture; that of the last one is kept, as several parts of a training ask for it."""
    if not _last or _last[0][0]() is not capture:
        _last[:] = [(weakref.ref(capture), measure_coverage(capture))]
    return _last[0][1]


def weights_at(
    weight: Float[Tensor, "V"], vertices: Float[Tensor, "V 3"], points: Float[Tensor, "n 3"], neighbours: int = 4
) -> Float[Tensor, "n"]:
    """Weights of vertices at points near them: the mean over the nearest ones, by inverse distance."""
    distance, index = nearest_vertices(points, vertices, min(neighbours, len(vertices)))
    share = 1 / (distance + 1e-3)
    return (share * weight[index]).sum(-1) / share.sum(-1)
