"""Triangles to images: which surface point does each pixel see?

A z-buffer over all triangles at once. Meshes of a person have triangles about as small as a pixel, and for those a list
of (triangle, pixel) pairs is far quicker than building a tree for ray casting anew in every pose.

This is the reference: silhouettes, ground-truth images and every measurement come from it. The only other rasterizer,
`outputs.raster_kernels`, is held against it.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from twofold.geometry.cameras import Camera

_PAIRS_AT_ONCE = 1 << 20

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


def rasterize(camera: Camera, vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], cull: bool = False) -> Hits:
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
    # One number after the other, each in a row of its own, and `index_select` for its speed: studio captures spend most
    # of their time here.
    corners = [faces[:, corner].contiguous() for corner in range(3)]
    x0, x1, x2 = (projected[:, 0].index_select(0, corner) for corner in corners)
    y0, y1, y2 = (projected[:, 1].index_select(0, corner) for corner in corners)
    doubled_area = (x1 - x0) * (y2 - y0) - (y1 - y0) * (x2 - x0)
    # The image's y axis points down, so a triangle seen from outside turns the other way there.
    turned = doubled_area < -1e-12 if cull else doubled_area.abs() > 1e-12
    left, right = _pixels_between(x0, x1, x2, camera.width)
    top, bottom = _pixels_between(y0, y1, y2, camera.height)
    d0, d1, d2 = (inverse_depth.index_select(0, corner) for corner in corners)
    in_front = torch.minimum(torch.minimum(d0, d1), d2) > 0
    kept = torch.nonzero(turned & (right >= left) & (bottom >= top) & in_front)[:, 0]
    left, right, top, bottom, x0, y0, x1, y1, x2, y2, d0, d1, d2, doubled_area = (
        row.index_select(0, kept)
        for row in (left, right, top, bottom, x0, y0, x1, y1, x2, y2, d0, d1, d2, doubled_area)
    )
    ax, ay, bx, by, scale = x1 - x0, y1 - y0, x2 - x0, y2 - y0, 1 / doubled_area
    # b1 = b1x * x + b1y * y and b2 likewise, with x and y counted from the first corner.
    table = torch.stack(
        [left - x0, top - y0, by * scale, -bx * scale, -ay * scale, ax * scale, d0, d1 - d0, d2 - d0], -1
    ).float()
    low_pixel = top.long() * camera.width + left.long()
    spans = torch.stack([right - left + 1, bottom - top + 1], -1).long()
    buffer = _nearest_triangles(table, low_pixel, spans, camera.height * camera.width, camera.width)
    return _hits(buffer, table, kept, low_pixel, camera.width)


def _pixels_between(
    a: Float[Tensor, "F"], b: Float[Tensor, "F"], c: Float[Tensor, "F"], size: int
) -> tuple[Float[Tensor, "F"], Float[Tensor, "F"]]:
    """First and last pixel centre along one axis that a triangle may cover; the last before the first if none."""
    low = torch.minimum(torch.minimum(a, b), c).sub_(_ON_THE_EDGE).ceil_().clamp_min_(0)
    high = torch.maximum(torch.maximum(a, b), c).add_(_ON_THE_EDGE).floor_().clamp_max_(size - 1)
    return low, high


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
        nth = torch.arange(len(triangle), device=table.device) - (ends - counts - done).index_select(0, triangle)
        span = spans[:, 0].index_select(0, triangle)
        down = torch.div(nth, span, rounding_mode="floor")
        right = nth - down * span
        row = table.index_select(0, triangle).T.contiguous()
        x, y = row[0] + right, row[1] + down
        b1 = row[2] * x + row[3] * y
        b2 = row[4] * x + row[5] * y
        inside = (b1 >= -_ON_THE_EDGE) & (b2 >= -_ON_THE_EDGE) & (b1 + b2 <= 1 + _ON_THE_EDGE)
        inverse_depth = (row[6] + b1 * row[7] + b2 * row[8]).clamp_min(1e-20)
        # Positive floats sort like their bit patterns, so one integer maximum is the depth test.
        inside = torch.nonzero(inside)[:, 0]
        triangle, inverse_depth = triangle.index_select(0, inside), inverse_depth.index_select(0, inside)
        key = (inverse_depth.view(torch.int32).long() << 32) | triangle
        offset = (down * width + right).index_select(0, inside)
        buffer.scatter_reduce_(0, low_pixel.index_select(0, triangle) + offset, key, "amax")
        start = stop
    return buffer


def _hits(
    buffer: Int[Tensor, "P"],
    table: Float[Tensor, "T 9"],
    kept: Int[Tensor, "T"],
    low_pixel: Int[Tensor, "T"],
    width: int,
) -> Hits:
    """Unpack the z-buffer and compute the barycentric weights of what won."""
    pixel = torch.nonzero(buffer)[:, 0]
    triangle = buffer.index_select(0, pixel) & 0xFFFFFFFF
    row = table.index_select(0, triangle).T.contiguous()
    low_row, low_column = torch.div(low_pixel, width, rounding_mode="floor"), low_pixel % width
    pixel_row = torch.div(pixel, width, rounding_mode="floor")
    x = row[0] + (pixel - pixel_row * width - low_column.index_select(0, triangle))
    y = row[1] + (pixel_row - low_row.index_select(0, triangle))
    b1 = (row[2] * x + row[3] * y).clamp(0, 1)
    b2 = torch.minimum((row[4] * x + row[5] * y).clamp_min(0), 1 - b1)
    weighted = torch.stack([(1 - b1 - b2) * row[6], b1 * (row[6] + row[7]), b2 * (row[6] + row[8])], -1)
    total = weighted.sum(-1)
    return Hits(pixel, kept.index_select(0, triangle), weighted / total[:, None], 1 / total)


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
