"""Landmarks in space, from where several calibrated cameras see them; and cameras turned until their rays meet.

Landmarks of estimators are off by some pixels in every view and by very much in some (a limb taken for another), so
every point starts from the pair of views that most others agree with, and what disagrees counts for next to nothing
(Geman and McClure's weights in Gauss-Newton steps).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped
from scipy.spatial.transform import Rotation

from twofold.errors import TwofoldError
from twofold.prepare.cameras.calibration import CalibratedCamera, undistort
from twofold.prepare.detections import Track

_PAIRS = 28
"""Pairs of views that are tried: all of eight cameras."""

_INDEPENDENT = 40
"""A view's landmarks are wrong together, the same ones in each frame: they count as this many of independent error."""

_TRUST = 2.0
"""Errors of this many times the usual one still count for a quarter."""

_ENOUGH = 20_000
"""Landmarks, over all views, that tell how cameras are turned."""

_WORTH_IT = 0.8
"""Cameras are turned if their views' disagreement falls below this share."""


@dataclass(frozen=True)
class Triangulation:
    """Points in space, one for each landmark in each frame.

    Attributes:
        points: the world's axes, metres; NaN where fewer than two views show the landmark.
        residual: root mean square distance in the images over the views that agree, pixels; NaN likewise.
        views: number of views that agree (within three times the usual error); 0 where there is no point.
        errors: distance in each view's image, pixels; NaN where it does not show the landmark.
    """

    points: Float[np.ndarray, "t k 3"]
    residual: Float[np.ndarray, "t k"]
    views: Int[np.ndarray, "t k"]
    errors: Float[np.ndarray, "v t k"]


@dataclass(frozen=True)
class _Seen:
    """All views of n points: where, how much it counts, and the usual error in each view's image."""

    matrices: Float[np.ndarray, "v 3 4"]  # from the world to pixels
    rotations: Float[np.ndarray, "v 3 3"]
    pixels: Float[np.ndarray, "v n 2"]
    weights: Float[np.ndarray, "v n"]
    noise: Float[np.ndarray, "v"]


def triangulate(
    cameras: Sequence[CalibratedCamera], tracks: Sequence[Track], noise: float | None = None
) -> Triangulation:
    """Where the landmarks of one person are in space.

    Args:
        cameras: one of each track.
        tracks: the same frames in every view.
        noise: the usual error of a landmark, pixels; by default a hundredth of the person's extent in each image.

    Raises:
        TwofoldError: there are fewer than two views, or their lengths differ.
    """
    everything = _gather(cameras, tracks, noise)
    known = (everything.weights > 0).sum(0) >= 2
    seen = replace(everything, pixels=everything.pixels[:, known], weights=everything.weights[:, known])
    points = _start(seen)
    for _ in range(10):
        points = points + _step(seen, points)
    agree = _agreeing(seen, points)
    # Views that do not agree count for little so far; now for nothing.
    among = replace(seen, weights=np.where(agree | (agree.sum(0) < 2), seen.weights, 0))
    for _ in range(5):
        points = points + _step(among, points)
    errors, agree = _errors(seen, points)[0], _agreeing(seen, points)
    with np.errstate(invalid="ignore"):
        residual = np.sqrt((np.where(agree, errors, 0) ** 2).sum(0) / agree.sum(0))
    in_views = np.where(seen.weights > 0, errors, np.nan)
    shape = tracks[0].pixels.shape[:2]
    return Triangulation(
        _among_all(points, known).reshape(*shape, 3),
        _among_all(residual, known).reshape(shape),
        np.nan_to_num(_among_all(agree.sum(0), known)).astype(np.int64).reshape(shape),
        np.stack([_among_all(view, known) for view in in_views]).reshape(-1, *shape),
    )


def _among_all(values: Shaped[np.ndarray, "n *s"], known: Bool[np.ndarray, "m"]) -> Float[np.ndarray, "m *s"]:
    """Values of the known ones of m, NaN between them."""
    spread = np.full((len(known), *values.shape[1:]), np.nan)
    spread[known] = values
    return spread


def turn_cameras(
    cameras: Sequence[CalibratedCamera], tracks: Sequence[Track], degrees: float = 1.0
) -> list[CalibratedCamera]:
    """Cameras turned a little about their centres, so that their rays to the landmarks meet as well as they can.

    A camera that was touched after its calibration points elsewhere by fractions of a degree, which is many pixels.
    What all cameras share, the world's own axes, stays. Where turning makes the views agree only slightly better, the
    cameras stay as they are: then it would only follow the landmarks' errors.

    Args:
        cameras: one of each track.
        tracks: the same frames in every view, left and right repaired.
        degrees: how far a touched camera is usually off.

    Raises:
        TwofoldError: see `triangulate`.
    """
    stride = -(-sum(track.pixels.shape[0] * track.pixels.shape[1] for track in tracks) // _ENOUGH)
    tracks = [Track(t.pixels[::stride], t.visibility[::stride], t.world[::stride]) for t in tracks]
    seen = _gather(cameras, tracks, None)
    points = _start(seen)
    for _ in range(5):
        points = points + _step(seen, points)
    before = _disagreement(seen, points)
    turns, total = [np.eye(3) for _ in cameras], np.zeros((len(cameras), 3))
    centers = np.stack([camera.center for camera in cameras])
    for _ in range(30):
        by_turn, step = _turn_step(seen, points, total, centers, np.radians(degrees))
        points, total = points + step, total + by_turn
        turns = [Rotation.from_rotvec(turn).as_matrix() @ old for turn, old in zip(by_turn, turns, strict=True)]
        rotations = np.stack([turn @ c.world_to_camera[:3, :3] for turn, c in zip(turns, cameras, strict=True)])
        seen = replace(seen, rotations=rotations, matrices=_matrices(cameras, rotations))
        if np.abs(by_turn).max() < 1e-6:
            break
    if not _disagreement(seen, points) < _WORTH_IT * before:
        return list(cameras)
    return [_turned(camera, turn) for camera, turn in zip(cameras, turns, strict=True)]


def _disagreement(seen: _Seen, points: np.ndarray) -> float:
    """The middle error of each view's landmarks, pixels, on average over the views."""
    errors = np.where((seen.weights > 0) & ((seen.weights > 0).sum(0) >= 2), _errors(seen, points)[0], np.nan)
    middle = [np.nanmedian(view) for view in errors if np.isfinite(view).any()]
    return float(np.mean(middle)) if middle else 0.0


def _turned(camera: CalibratedCamera, turn: np.ndarray) -> CalibratedCamera:
    rigid = camera.world_to_camera.copy()
    rigid[:3] = turn @ rigid[:3]
    return replace(camera, world_to_camera=rigid)


def _matrices(cameras: Sequence[CalibratedCamera], rotations: np.ndarray) -> Float[np.ndarray, "v 3 4"]:
    places = [np.c_[r, -r @ c.center] for r, c in zip(rotations, cameras, strict=True)]
    return np.stack([c.intrinsics @ place for c, place in zip(cameras, places, strict=True)])


def _gather(cameras: Sequence[CalibratedCamera], tracks: Sequence[Track], noise: float | None) -> _Seen:
    lengths = {len(track) for track in tracks}
    if len(tracks) < 2:
        raise TwofoldError(f"Points in space need two views or more, there is {len(tracks)}; give more videos.")
    if len(lengths) > 1:
        words = ", ".join(f"{c.name} {len(t)}" for c, t in zip(cameras, tracks, strict=True))
        raise TwofoldError(f"The views have different numbers of frames ({words}); cut the videos to the same ones.")
    rotations = np.stack([camera.world_to_camera[:3, :3] for camera in cameras])
    pixels = np.stack([undistort(c, t.pixels.reshape(-1, 2)) for c, t in zip(cameras, tracks, strict=True)])
    weights = np.stack([t.visibility.reshape(-1).astype(np.float64) for t in tracks])
    weights = np.where(np.isfinite(pixels).all(-1), weights, 0)
    usual = [noise if noise is not None else 0.01 * _extent(track) for track in tracks]
    seen_pixels = np.where(weights[..., None] > 0, pixels, 0)
    return _Seen(_matrices(cameras, rotations), rotations, seen_pixels, weights, np.array(usual, dtype=np.float64))


def _extent(track: Track) -> float:
    """How large the person usually is in the image, pixels."""
    found = track.pixels[track.found]
    if not len(found):
        return 100.0
    sides = np.nanmax(found, axis=1) - np.nanmin(found, axis=1)
    return max(float(np.median(np.linalg.norm(sides, axis=-1))), 1.0)


def _errors(seen: _Seen, points: np.ndarray) -> tuple[Float[np.ndarray, "v n"], Float[np.ndarray, "v n"]]:
    """Distance in the images (pixels) and depth of points."""
    projected = np.einsum("vij,nj->vni", seen.matrices[:, :, :3], points) + seen.matrices[:, None, :, 3]
    depth = projected[..., 2]
    safe = np.where(np.abs(depth) < 1e-9, 1e-9, depth)
    return np.linalg.norm(projected[..., :2] / safe[..., None] - seen.pixels, axis=-1), depth


def _agreeing(seen: _Seen, points: np.ndarray) -> Bool[np.ndarray, "v n"]:
    """Which views show a point that two or more show within three times the usual error."""
    errors, depth = _errors(seen, points)
    shown = (seen.weights > 0) & ((seen.weights > 0).sum(0) >= 2)
    return shown & (errors < 3 * seen.noise[:, None]) & (depth > 0)


def _start(seen: _Seen) -> Float[np.ndarray, "n 3"]:
    """For each point the middle between two views' rays that most views agree with."""
    centers = -np.einsum("vij,vj->vi", np.linalg.inv(seen.matrices[:, :, :3]), seen.matrices[:, :, 3])
    homogeneous = np.concatenate([seen.pixels, np.ones((*seen.pixels.shape[:2], 1))], -1)
    rays = np.einsum("vij,vnj->vni", np.linalg.inv(seen.matrices[:, :, :3]), homogeneous)
    rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    best = np.zeros((seen.pixels.shape[1], 3))
    least = np.full(len(best), np.inf)
    pairs = list(combinations(range(len(rays)), 2))
    for i, j in pairs[:: max(1, -(-len(pairs) // _PAIRS))] if len(pairs) > _PAIRS else pairs:
        points = _between(centers[i], rays[i], centers[j], rays[j])
        errors, depth = _errors(seen, points)
        square = (errors / (_TRUST * seen.noise[:, None])) ** 2
        cost = (seen.weights * np.where(depth > 0, square / (1 + square), 2)).sum(0)
        cost = np.where((seen.weights[i] > 0) & (seen.weights[j] > 0), cost, np.inf)
        better = cost < least
        best[better], least[better] = points[better], cost[better]
    return best


def _between(a: np.ndarray, to_a: np.ndarray, b: np.ndarray, to_b: np.ndarray) -> Float[np.ndarray, "n 3"]:
    """The middle of the shortest way between lines from a and b in unit directions."""
    apart, cosine = b - a, (to_a * to_b).sum(-1)
    slope = np.maximum(1 - cosine**2, 1e-9)
    along_a = (to_a @ apart - cosine * (to_b @ apart)) / slope
    along_b = (cosine * (to_a @ apart) - to_b @ apart) / slope
    return (a + along_a[:, None] * to_a + b + along_b[:, None] * to_b) / 2


def _linearized(
    seen: _Seen, points: np.ndarray
) -> tuple[Float[np.ndarray, "v n 2"], Float[np.ndarray, "v n 2 3"], Float[np.ndarray, "v n"]]:
    """Differences in the images in units of the usual error, their slopes with the points, and the weights."""
    projected = np.einsum("vij,nj->vni", seen.matrices[:, :, :3], points) + seen.matrices[:, None, :, 3]
    depth = np.where(np.abs(projected[..., 2]) < 1e-9, 1e-9, projected[..., 2])[..., None]
    flat = projected[..., :2] / depth
    noise = seen.noise[:, None, None]
    slopes = (seen.matrices[:, None, :2, :3] - flat[..., None] * seen.matrices[:, None, 2:, :3]) / depth[..., None]
    differences = (flat - seen.pixels) / noise
    robust = 1 / (1 + (differences**2).sum(-1) / _TRUST**2) ** 2
    return differences, slopes / noise[..., None], np.where(depth[..., 0] > 0, seen.weights * robust, 0)


def _step(seen: _Seen, points: np.ndarray) -> Float[np.ndarray, "n 3"]:
    """Gauss-Newton for each point alone."""
    differences, slopes, weights = _linearized(seen, points)
    weighted = slopes * weights[..., None, None]
    normal = np.einsum("vnai,vnaj->nij", weighted, slopes)
    scale = np.trace(normal, axis1=1, axis2=2)[:, None, None]
    normal = normal + (1e-9 * scale + (scale == 0)) * np.eye(3)
    return -np.linalg.solve(normal, np.einsum("vnai,vna->ni", weighted, differences)[..., None])[..., 0]


def _turn_step(
    seen: _Seen, points: np.ndarray, total: np.ndarray, centers: np.ndarray, usual: float
) -> tuple[Float[np.ndarray, "v 3"], Float[np.ndarray, "n 3"]]:
    """Gauss-Newton for the cameras' turns (axis-angle in their own axes) and all points together.

    The points are eliminated from the normal equations (Schur's complement).
    """
    differences, slopes, weights = _linearized(seen, points)
    used: Bool[np.ndarray, "n"] = (weights > 0).sum(0) >= 2
    differences, slopes, weights = differences[:, used], slopes[:, used], weights[:, used]
    views, count = weights.shape
    weights = weights * min(1.0, _INDEPENDENT / max(count, 1))
    # A small turn w moves a point p in the camera's axes by w x p.
    arms = np.einsum("vij,vnj->vni", seen.rotations, points[None, used] - centers[:, None])
    in_camera = np.einsum("vnai,vji->vnaj", slopes, seen.rotations)
    by_turn = np.cross(arms[:, :, None], in_camera)
    weighted_turn, weighted_point = by_turn * weights[..., None, None], slopes * weights[..., None, None]
    point = np.einsum("vnai,vnaj->nij", weighted_point, slopes)
    point = np.linalg.inv(point + 1e-9 * np.trace(point, axis1=1, axis2=2)[:, None, None] * np.eye(3))
    mixed = np.einsum("vnai,vnaj->nvij", weighted_turn, slopes).reshape(-1, 3 * views, 3)
    gradient_point = np.einsum("vnai,vna->ni", weighted_point, differences)
    eliminated = mixed @ point
    full = np.zeros((3 * views, 3 * views))
    for v, block in enumerate(np.einsum("vnai,vnaj->vij", weighted_turn, by_turn)):
        full[3 * v : 3 * v + 3, 3 * v : 3 * v + 3] = block + np.eye(3) / usual**2
    reduced = full - np.tensordot(eliminated, mixed, ((0, 2), (0, 2)))
    gradient = np.einsum("vnai,vna->vi", weighted_turn, differences).ravel() + total.ravel() / usual**2
    gradient = gradient - np.einsum("nij,nj->i", eliminated, gradient_point)
    turns = -np.linalg.solve(reduced, gradient)
    steps = np.zeros_like(points)
    steps[used] = -(point @ (gradient_point + turns @ mixed)[..., None])[..., 0]
    turns = turns.reshape(views, 3)
    return turns, steps
