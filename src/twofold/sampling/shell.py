"""The shell: the part of space close to a posed body, as a voxel list that knows each voxel's nearest vertices.

The body is the prior of everything here. A ray is sampled only where it runs through the shell, and the nearest vertex
of a sample is sought only among the few that its voxel lists, instead of among all of them.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import ndimage
from torch import Tensor

from twofold.geometry.cameras import Rays, clip_to_box
from twofold.kernels.kdtree import query_nearest, search_tree
from twofold.kernels.lanes import LANES
from twofold.kernels.parallel import in_parts
from twofold.sampling import voxel_kernels, walk_kernels
from twofold.volume.samples import Samples


@dataclass(frozen=True)
class Shell:
    """Voxels within `radius` of a body's vertices.

    Attributes:
        low: corner of the voxel grid, metres.
        voxel: edge of a voxel, metres.
        radius: distance to the nearest vertex that still counts as inside the shell, metres.
        row: for each voxel of the grid the row of `nearest` that belongs to it; outside the shell -k, where no voxel of
            the shell is closer than k - 1 voxels.
        nearest: the vertices nearest to each listed voxel's centre, nearest first.
        vertices: the body's vertices, metres.
    """

    low: Float[Tensor, "3"]
    voxel: float
    radius: float
    row: Int[Tensor, "X Y Z"]
    nearest: Int[Tensor, "N C"]
    vertices: Float[Tensor, "V 3"]

    @property
    def high(self) -> Float[Tensor, "3"]:
        """The corner opposite to `low`, metres."""
        size = torch.tensor(self.row.shape, dtype=self.low.dtype, device=self.low.device)
        return self.low + self.voxel * size

    def rows_at(self, points: Float[Tensor, "*b 3"]) -> Int[Tensor, "*b"]:
        r"""Row of the voxel $\lfloor (x - l) / h \rfloor$ that each point lies in, or a negative number.

        >>> corners = torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]])
        >>> shell = build_shell(corners, radius=0.05, voxel=0.02)
        >>> shell.rows_at(torch.tensor([[0.0, 0.0, 0.03], [0.0, 0.0, 0.3]])) >= 0
        tensor([ True, False])
        """
        cell = ((points - self.low) * (1 / self.voxel)).floor()
        x, y, z = self.row.shape
        flat = (cell[..., 0] * y + cell[..., 1]) * z + cell[..., 2]
        # Points outside the grid are rare: rays are clipped to it first. A flat index in range may still lie outside.
        inside = (cell >= 0).all(-1) & (cell[..., 0] < x) & (cell[..., 1] < y) & (cell[..., 2] < z)
        return torch.where(inside, self.row.flatten()[torch.where(inside, flat, 0).long()], -1).long()


def build_shell(vertices: Float[Tensor, "V 3"], radius: float, voxel: float, candidates: int = 6) -> Shell:
    r"""Lists the voxels within `radius` of the vertices, and for each the vertices that may be nearest in it.

    A voxel with the centre $c$ and the edge $h$ is listed where

    \[ \min_v \lVert c - v \rVert \le r + \tfrac{\sqrt 3}{2} h, \]

    so that no point within $r$ of a vertex is missed.

    >>> corners = torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]])
    >>> shell = build_shell(corners, radius=0.05, voxel=0.02, candidates=2)
    >>> shell.nearest.shape[1], bool(shell.rows_at(corners + 0.02).min() >= 0)
    (2, True)

    Args:
        vertices: posed (or canonical) vertices, metres.
        radius: metres.
        voxel: metres.
        candidates: how many vertices a voxel lists.
    """
    points = vertices.detach().cpu().numpy().astype(np.float32)
    low = points.min(0) - radius - 2 * voxel
    # An even number of voxels along each axis: empty space is measured in blocks of two.
    shape = 2 * np.ceil((points.max(0) + radius + 2 * voxel - low) / (2 * voxel)).astype(int)
    limit = radius + np.sqrt(3) / 2 * voxel
    inside, row = np.zeros(shape, dtype=bool), np.empty(shape, np.int32)
    given = (points, low, voxel, limit, inside)
    in_parts(len(row), lambda begin, end: voxel_kernels.mark(*given, begin, end), least=8)
    empty = np.ones(shape // 2, dtype=bool)
    count = voxel_kernels.number(inside, row, empty)
    nearest = _listed(points, low, voxel, limit, row, count, min(candidates, len(points)))
    voxel_kernels.tell_distance(row, np.asarray(ndimage.distance_transform_edt(empty)))
    device = vertices.device
    return Shell(
        low=torch.as_tensor(low, device=device),
        voxel=voxel,
        radius=radius,
        row=torch.as_tensor(row, device=device),
        nearest=torch.as_tensor(nearest, device=device),
        vertices=vertices.detach().float(),
    )


def _listed(
    points: Float[np.ndarray, "V 3"], low: Float[np.ndarray, "3"], voxel: float, limit: float,
    row: Int[np.ndarray, "X Y Z"], rows: int, count: int,
) -> Int[np.ndarray, "N C"]:  # fmt: skip
    """The `count` vertices nearest to the centres of the voxels, nearest first.

    A search tree answers for each voxel apart. It is quicker to let each vertex offer itself to the voxels nearby, and
    to ask the tree only where that leaves a list short, or where lists are longer than a vector.
    """
    numbers, squares = np.zeros((rows, LANES), np.float32), np.full((rows, LANES), np.inf, np.float32)
    if count <= LANES:
        given = (points, low, voxel, limit + voxel / 2, row, count, numbers, squares)
        in_parts(len(row), lambda begin, end: voxel_kernels.list_vertices(*given, begin, end), least=8)
    index = np.zeros((rows, count), np.int32)
    index[:, :LANES] = numbers[:, :count]
    short = np.flatnonzero(np.isinf(squares[:, min(count, LANES) - 1]))
    if len(short):
        places = np.stack(np.unravel_index(np.flatnonzero(row.ravel() >= 0)[short], row.shape), 1)
        centers = (low + (places + 0.5) * voxel).astype(np.float32)
        index[short] = query_nearest(search_tree(points, quick=True), centers, count)[1]
    return index


def nearest_listed(
    shell: Shell, points: Float[Tensor, "S 3"], rows: Int[Tensor, "S"], k: int
) -> tuple[Int[Tensor, "S k"], Float[Tensor, "S k"]]:
    r"""The k nearest vertices of points in the shell and their squared distances (metres squared), nearest first.

    \[ v_1 = \arg\min_{v \in C(x)} \lVert x - v \rVert^2 \]

    and so on, among the candidates $C(x)$ of the point's voxel.

    >>> corners = torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]])
    >>> shell, x = build_shell(corners, 0.05, 0.02), torch.tensor([[0.09, 0.0, 0.02]])
    >>> nearest_listed(shell, x, shell.rows_at(x), k=1)
    (tensor([[1]]), tensor([[0.0005]]))

    Sought among the candidates of each point's voxel, so some are missed where vertices lie denser than voxels.
    Around an Anny body (14,000 vertices, voxels of 2 cm) the nearest one found is 0.6 mm too far on average with six
    candidates, 0.3 mm with twelve.
    """
    listed = shell.nearest[rows].long()
    offsets = shell.vertices[listed] - points[:, None]
    squared = (offsets * offsets).sum(-1)
    if k == 1:
        best, which = squared.min(-1, keepdim=True)
    else:
        best, which = squared.topk(k, -1, largest=False)
    return listed.gather(1, which), best


def sample_shell(
    shell: Shell, rays: Rays, step: float, generator: torch.Generator | None, limit: float, k: int = 1
) -> tuple[Samples, Int[Tensor, "S k"], Float[Tensor, "S k"]]:
    r"""Samples every `step` metres along each ray, kept only within `limit` of the body.

    \[ t_i = t_n + (i + u) h, \qquad \min_v \lVert o + t_i d - v \rVert < r, \qquad \delta_i = h \]

    with $u$ random for each ray, or a half.

    >>> corners = torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]])
    >>> shell = build_shell(corners, radius=0.05, voxel=0.02)
    >>> ray = Rays(torch.tensor([[0.0, 0, -1]]), torch.tensor([[0.0, 0, 1]]), torch.zeros(1), torch.tensor([2.0]))
    >>> samples, nearest, squared = sample_shell(shell, ray, step=0.02, generator=None, limit=0.03)
    >>> samples.depth.round(decimals=2), nearest[:, 0].tolist()
    (tensor([0.9800, 1.0000, 1.0200]), [0, 0, 0])

    Args:
        shell: where to sample.
        rays: their near and far bounds are respected.
        step: metres.
        generator: shifts each ray's evenly spaced samples by a random part of a step; None puts samples at mid-step.
        limit: largest distance to the nearest vertex, metres, at most the shell's radius.
        k: how many nearest vertices are wanted, at most as many as a voxel lists.

    Returns:
        packed samples, the nearest listed vertices of each, and their squared distances (metres squared).
    """
    device = rays.origins.device
    clipped, ray_ids, start = ray_starts(shell, rays, generator)
    if len(ray_ids) == 0:
        none = torch.zeros(0, device=device)
        return Samples(ray_ids, none, none), ray_ids[:, None].expand(0, k), none[:, None].expand(0, k)
    find = _listed_in_torch if device.type != "cpu" or rays.origins.dtype != torch.float32 else _listed_compiled
    ray, depth, row = find(shell, clipped, start, step)
    points = clipped.origins[ray] + depth[:, None] * clipped.directions[ray]
    nearest, squared = nearest_listed(shell, points, row, min(k, shell.nearest.shape[1]))
    close = squared[:, 0] < limit**2
    depth = depth[close]
    return Samples(ray_ids[ray[close]], depth, torch.full_like(depth, step)), nearest[close], squared[close]


def expected_samples(shell: Shell, rays: Rays, step: float) -> float:
    """About how many samples, `step` metres apart, the rays have in the shell.

    It fills a certain part of its box, and so it does of the rays' way through the box.
    """
    clipped, hit = clip_to_box(rays, shell.low, shell.high)
    way = torch.where(hit, clipped.far - clipped.near, 0.0).sum()
    return float(way) / step * len(shell.nearest) / max(shell.row.numel(), 1)


def ray_starts(
    shell: Shell, rays: Rays, generator: torch.Generator | None
) -> tuple[Rays, Int[Tensor, "r"], Float[Tensor, "r"]]:
    """The rays that meet the shell's box, clipped to it, which ones these are, and where in a step each one begins."""
    clipped, hit = clip_to_box(rays, shell.low, shell.high)
    ray_ids = hit.nonzero()[:, 0]
    start = torch.full_like(rays.near, 0.5)
    if generator is not None:
        start = torch.rand(len(rays), generator=generator, device=generator.device).to(rays.near.device)
    return clipped[ray_ids], ray_ids, start[ray_ids]


def shell_arrays(shell: Shell) -> tuple[np.ndarray, float, np.ndarray, np.ndarray, np.ndarray]:
    """A shell on the CPU as compiled loops take it."""
    low, row, nearest, vertices = (t.numpy() for t in (shell.low, shell.row, shell.nearest, shell.vertices))
    return low, shell.voxel, row, nearest, vertices


def ray_arrays(rays: Rays, start: Float[Tensor, "R"], step: float) -> tuple[Any, ...]:
    """Rays on the CPU, where in a step each begins, and the step, as compiled loops take them."""
    tensors = (rays.origins, rays.directions, rays.near, rays.far, start)
    return (*(t.contiguous().numpy() for t in tensors), np.float32(step))


def listed_on_rays(arrays: Any, lines: Any, rays: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ray, depth and row of `Shell.nearest` of every step in a listed voxel; see `shell_arrays` and `ray_arrays`."""
    parts = in_parts(rays, lambda begin, end: walk_kernels.candidates(arrays, lines, begin, end), least=64)
    return parts[0] if len(parts) == 1 else tuple(np.concatenate(part) for part in zip(*parts, strict=True))  # type: ignore[return-value]


def _listed_compiled(shell: Shell, rays: Rays, start: Tensor, step: float) -> tuple[Tensor, Tensor, Tensor]:
    found = listed_on_rays(shell_arrays(shell), ray_arrays(rays, start, step), len(rays))
    ray, depth, row = (torch.from_numpy(array) for array in found)
    return ray, depth, row.long()


def _listed_in_torch(shell: Shell, rays: Rays, start: Tensor, step: float) -> tuple[Tensor, Tensor, Tensor]:
    """The same as `_listed_compiled`, for GPUs and as its slow twin."""
    longest = int(((rays.far - rays.near) / step).max().ceil())
    steps = torch.arange(longest, device=rays.near.device, dtype=rays.near.dtype)
    depth = rays.near[:, None] + step * (steps + start[:, None])
    points = rays.origins[:, None] + depth[..., None] * rays.directions[:, None]
    rows = shell.rows_at(points)
    ray, position = ((rows >= 0) & (depth < rays.far[:, None])).nonzero(as_tuple=True)
    return ray, depth[ray, position], rows[ray, position]
