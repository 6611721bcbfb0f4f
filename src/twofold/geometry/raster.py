"""Triangles to pictures: which surface point does each pixel see?

A z-buffer over all triangles at once. Meshes of a person have triangles about as small as a pixel, and for those a list
of (triangle, pixel) pairs is far quicker than building a tree for ray casting anew in every pose.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from twofold.geometry.cameras import Camera

_PAIRS_AT_ONCE = 1 << 22
_ON_THE_EDGE = 1e-5
"""Barycentric slack: a pixel centre on a shared edge must not fall between both triangles by rounding."""


@dataclass(frozen=True)
class Hits:
    """Surface points that pixels see; a pixel that sees nothing is not in the list.

    Attributes:
        pixel: row * width + column, ascending.
        face: which triangle.
        barycentric: weights of its three corners, perspective-correct, sum 1.
        depth: distance along the camera's z axis, metres.
    """

    pixel: Int[Tensor, "n"]
    face: Int[Tensor, "n"]
    barycentric: Float[Tensor, "n 3"]
    depth: Float[Tensor, "n"]


def rasterize(
    camera: Camera, vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], cull: bool = False
) -> Hits:
    """The nearest surface point behind every pixel centre.

    Args:
        camera: where from.
        vertices: world, metres.
        faces: triangles; one that reaches behind the camera is left out.
        cull: leave out triangles seen from behind (counter-clockwise is outside). Half the work for a closed mesh.
    """
    in_camera = vertices @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    inverse_depth = 1 / in_camera[:, 2]
    projected = in_camera @ camera.intrinsics[:2].T * inverse_depth[:, None]
    a, b, c = (projected[faces[:, corner]] for corner in range(3))
    first, second = b - a, c - a
    doubled_area = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    # The picture's y axis points down, so a triangle seen from outside turns the other way there.
    kept = torch.nonzero(doubled_area < -1e-12 if cull else doubled_area.abs() > 1e-12)[:, 0]
    origin, b, c = a[kept], b[kept], c[kept]
    depths = inverse_depth[faces[kept]]
    size = torch.tensor([camera.width, camera.height], dtype=origin.dtype, device=origin.device)
    low = torch.minimum(torch.minimum(origin, b), c).sub(_ON_THE_EDGE).ceil().clamp_min(0)
    high = torch.minimum(torch.maximum(torch.maximum(origin, b), c).add(_ON_THE_EDGE).floor(), size - 1)
    spans = (high - low + 1).clamp_min(0)
    wanted = (spans[:, 0] * spans[:, 1] > 0) & (depths[:, 0] > 0) & (depths[:, 1] > 0) & (depths[:, 2] > 0)
    kept, low, spans, origin, depths = kept[wanted], low[wanted], spans[wanted], origin[wanted], depths[wanted]
    first, second = first[kept], second[kept]
    scale = 1 / doubled_area[kept]
    # b1 = b1x * x + b1y * y and b2 likewise, with x and y counted from the first corner.
    table = torch.stack(
        [
            low[:, 0] - origin[:, 0],
            low[:, 1] - origin[:, 1],
            second[:, 1] * scale,
            -second[:, 0] * scale,
            -first[:, 1] * scale,
            first[:, 0] * scale,
            depths[:, 0],
            depths[:, 1] - depths[:, 0],
            depths[:, 2] - depths[:, 0],
        ],
        -1,
    ).float()
    low_pixel = low[:, 1].long() * camera.width + low[:, 0].long()
    spans = spans.long()
    buffer = _nearest_triangles(table, low_pixel, spans, camera.height * camera.width, camera.width)
    return _hits(buffer, table, kept, low_pixel, depths.float(), camera.width)


def _nearest_triangles(
    table: Float[Tensor, "T 9"], low_pixel: Int[Tensor, "T"], spans: Int[Tensor, "T 2"], pixels: int, width: int
) -> Int[Tensor, "P"]:
    """For every pixel the largest (1/depth, triangle) packed into one integer, or 0."""
    buffer = torch.zeros(pixels, dtype=torch.int64, device=table.device)
    counts = spans.prod(-1)
    ends = counts.cumsum(0)
    start = 0
    while start < len(counts):
        done = int(ends[start - 1]) if start else 0
        stop = max(start + 1, int(torch.searchsorted(ends, done + _PAIRS_AT_ONCE)))
        triangle = torch.repeat_interleave(torch.arange(start, stop, device=table.device), counts[start:stop])
        nth = torch.arange(len(triangle), device=table.device) - (ends - counts)[triangle] + done
        span = spans[triangle, 0]
        down = torch.div(nth, span, rounding_mode="floor")
        right = nth - down * span
        row = table[triangle]
        x, y = row[:, 0] + right, row[:, 1] + down
        b1 = row[:, 2] * x + row[:, 3] * y
        b2 = row[:, 4] * x + row[:, 5] * y
        inside = (b1 >= -_ON_THE_EDGE) & (b2 >= -_ON_THE_EDGE) & (b1 + b2 <= 1 + _ON_THE_EDGE)
        inverse_depth = (row[:, 6] + b1 * row[:, 7] + b2 * row[:, 8]).clamp_min(1e-20)
        # Positive floats sort like their bit patterns, so one integer maximum is the depth test.
        key = (inverse_depth.view(torch.int32).long() << 32) | triangle
        pixel = low_pixel[triangle] + down * width + right
        buffer.scatter_reduce_(0, pixel[inside], key[inside], "amax")
        start = stop
    return buffer


def _hits(
    buffer: Int[Tensor, "P"],
    table: Float[Tensor, "T 9"],
    kept: Int[Tensor, "T"],
    low_pixel: Int[Tensor, "T"],
    depths: Float[Tensor, "T 3"],
    width: int,
) -> Hits:
    """Unpack the z-buffer and compute the barycentric weights of what won."""
    pixel = torch.nonzero(buffer)[:, 0]
    triangle = buffer[pixel] & 0xFFFFFFFF
    row = table[triangle]
    offset = pixel - low_pixel[triangle] % width
    x = row[:, 0] + offset % width
    y = row[:, 1] + torch.div(pixel, width, rounding_mode="floor") - torch.div(
        low_pixel[triangle], width, rounding_mode="floor"
    )
    b1 = (row[:, 2] * x + row[:, 3] * y).clamp(0, 1)
    b2 = torch.minimum((row[:, 4] * x + row[:, 5] * y).clamp_min(0), 1 - b1)
    weighted = torch.stack([1 - b1 - b2, b1, b2], -1) * depths[triangle]
    total = weighted.sum(-1)
    return Hits(pixel, kept[triangle], weighted / total[:, None], 1 / total)


def supersampled(camera: Camera, factor: int) -> Camera:
    """The same view with `factor` x `factor` samples in every pixel; `box_filter` takes it back."""
    return camera.resized(camera.height * factor, camera.width * factor)


def box_filter(
    camera: Camera, factor: int, pixel: Int[Tensor, "n"], values: Float[Tensor, "n c"]
) -> Float[Tensor, "h w c"]:
    """Mean over the `factor` x `factor` samples of each pixel; samples that saw nothing count as zero.

    Args:
        camera: the view to return to (not the supersampled one).
        factor: samples along each side of a pixel.
        pixel: sample indices of the supersampled view, as in `Hits`.
        values: what each sample saw.
    """
    wide = camera.width * factor
    row = torch.div(pixel, wide * factor, rounding_mode="floor")
    column = torch.div(pixel % wide, factor, rounding_mode="floor")
    summed = torch.zeros(camera.height * camera.width, values.shape[1], dtype=values.dtype, device=values.device)
    summed.index_add_(0, row * camera.width + column, values)
    return (summed / factor**2).view(camera.height, camera.width, -1)


def silhouette(
    camera: Camera, vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], factor: int = 3
) -> Float[Tensor, "h w"]:
    """Share of each pixel that the mesh covers, from `factor` x `factor` samples a pixel."""
    hits = rasterize(supersampled(camera, factor), vertices, faces)
    ones = torch.ones(len(hits.pixel), 1, dtype=vertices.dtype, device=vertices.device)
    return box_filter(camera, factor, hits.pixel, ones)[..., 0]


def depth_map(
    camera: Camera, vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]
) -> tuple[Float[Tensor, "h w"], Bool[Tensor, "h w"]]:
    """Depth behind every pixel centre (infinite where there is nothing), and where there is something."""
    hits = rasterize(camera, vertices, faces)
    depth = torch.full((camera.height * camera.width,), torch.inf, device=vertices.device)
    depth[hits.pixel] = hits.depth
    depth = depth.view(camera.height, camera.width)
    return depth, depth.isfinite()
