"""Fits a body to the landmarks and masks of a whole clip, seen by one camera or by several.

All frames are fitted together, in three stages: the landmarks' directions in space give a first guess; then the body's
points are moved to where the landmarks are seen; then its outline is moved to the outline of the mask. People move
smoothly, bend their joints one way only, and have one shape. Where feet of one camera's clip demonstrably stand still,
they stand on one level, and the body keeps its balance (see `footing`, `physics`).
"""

import contextlib
import threading
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from twofold.body.skeleton import Body
from twofold.errors import TwofoldError
from twofold.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from twofold.kernels.parallel import in_parts, one_thread_each
from twofold.prepare.fitting.body_landmarks import BodyPoints, body_points
from twofold.prepare.fitting.energy import PriorWeights, direction_term, landmark_term, match_rims, outline_term, prior
from twofold.prepare.fitting.footing import MAX_WORSE, carrying, standing, tells_the_vertical
from twofold.prepare.fitting.observations import Evidence, Seen, begin, gather
from twofold.prepare.fitting.outlines import Outlines, trace_outlines
from twofold.prepare.fitting.parameters import Chosen, FittedMotion, Posed, choose, place_joints, pose_motion
from twofold.prepare.fitting.physics import (
    PhysicsWeights,
    Support,
    believable,
    physics_term,
    slope_of,
    standing_axis,
)

WARM_UP = 20
"""Steps over which the rate grows to its full size."""
WINDOW, OVERLAP = 240, 24
"""Frames fitted together, and how many of them two neighbours share."""


@dataclass(frozen=True)
class FitConfig:
    """How hard each kind of evidence pulls. Lengths in the image count in percent of the person's height there.

    Attributes:
        steps: of the landmark stage and of the outline stage.
        rate: Adam's rate at the start, radians and ten centimetres.
        landmark: error of a landmark, percent; larger ones count ever less.
        direction: error of a direction in space, as the length of the difference of unit vectors.
        outline: error of the outline, percent.
        outline_weight: of the outline against the landmarks.
        direction_weight: of the landmarks' directions in space in the last stages.
        prior: what is known about people.
        physics: standing and balance, for one camera, which sees no depth.
        rematch: steps after which outline and body are matched anew.
    """

    steps: tuple[int, int] = (150, 160)
    rate: float = 0.06
    landmark: float = 1.2
    direction: float = 0.35
    outline: float = 1.0
    outline_weight: float = 40.0
    direction_weight: float = 0.3
    prior: PriorWeights = PriorWeights()
    physics: PhysicsWeights = PhysicsWeights()
    rematch: int = 20


def several_cameras() -> FitConfig:
    """Weights where several cameras agree: what they see needs less of what is known before."""
    return FitConfig(prior=PriorWeights(smoothness=5.0, shape=0.1, marks=0.02))


def steadier(config: FitConfig) -> FitConfig:
    """Weights for somebody who stands: such motion is slow beside the noise of landmarks, outlines tell more."""
    prior = replace(config.prior, smoothness=3.3 * config.prior.smoothness)
    return replace(config, landmark=1.33 * config.landmark, outline_weight=1.5 * config.outline_weight, prior=prior)


def stated_focal() -> FitConfig:
    """Weights where the file states its focal length: stabilisation crops some of the view, little is left to find."""
    return FitConfig(prior=PriorWeights(focal=0.04))


_Matched = tuple[int, Outlines, Chosen, Tensor]


def fit(
    body: Body,
    evidence: Sequence[Evidence],
    fps: float,
    free_focal: bool = False,
    config: FitConfig | None = None,
    points_in_space: Float[np.ndarray, "t 33 3"] | None = None,
    progress: Callable[[float], None] | None = None,
) -> FittedMotion:
    """The body's shape and motion through a clip.

    A long clip is fitted window by window, after shape and focal length were found on a part of it, so that memory
    does not grow with its length. The other windows are fitted side by side, as many as there are threads.

    Args:
        body: of any kind; the shape coefficients that it has are fitted.
        evidence: of each camera, all of the same frames.
        fps: frames per second.
        free_focal: the focal length of the one camera is a guess and is fitted too.
        config: weights; by default `FitConfig()` for one camera, `several_cameras()` for more.
        points_in_space: landmarks triangulated from several cameras, world, metres; NaN where unknown.
        progress: called with the fraction that is done.

    Raises:
        TwofoldError: nobody was found in any frame.
    """
    config = config or (FitConfig() if len(evidence) == 1 else several_cameras())
    with one_thread_each():
        return _fit(body, evidence, fps, free_focal, config, points_in_space, progress or (lambda done: None))


def _fit(
    body: Body,
    evidence: Sequence[Evidence],
    fps: float,
    free_focal: bool,
    config: FitConfig,
    points_in_space: Float[np.ndarray, "t 33 3"] | None,
    progress: Callable[[float], None],
) -> FittedMotion:
    moments = len(evidence[0].track)
    if not np.any([e.track.found for e in evidence]):
        raise TwofoldError("Nobody was found in any image; film one whole person, well lit, and try again.")
    if moments <= WINDOW + OVERLAP:
        return _fit_window(body, evidence, fps, free_focal, config, points_in_space, None, progress)
    starts = list(range(0, moments - OVERLAP, WINDOW))
    # The window in which most is seen tells shape and focal length best.
    seen = [sum(float(e[slice(s, s + WINDOW)].track.visibility.sum()) for e in evidence) for s in starts]
    best = starts[int(np.argmax(seen))]
    first = _window(evidence, points_in_space, slice(best, best + WINDOW + OVERLAP))
    # Distances told apart from translations would be those of one window only.
    known = _fit_window(body, first[0], fps, free_focal, config, first[1], None, lambda done: None).settled(body)
    progress(1 / len(starts))
    parts = [known] * len(starts)
    rest = [number for number, start in enumerate(starts) if start != best]
    stopped, counting, fitted = threading.Event(), threading.Lock(), [1]

    def going_on(done: float) -> None:
        if stopped.is_set():
            raise InterruptedError("another window failed or the user stopped")

    def windows(begin: int, end: int) -> None:
        with _telling(stopped):  # Other threads would go on to the end of their windows.
            for number in rest[begin:end]:
                times = slice(starts[number], starts[number] + WINDOW + OVERLAP)
                some, space = _window(evidence, points_in_space, times)
                parts[number] = _fit_window(body, some, fps, False, config, space, known, going_on)
                with counting:
                    fitted[0] += 1
                    progress(fitted[0] / len(starts))

    with _telling(stopped):
        in_parts(len(rest), windows, 1, long=True)
    return _joined(parts)


@contextlib.contextmanager
def _telling(stopped: threading.Event) -> Generator[None]:
    """Sets the event where the block fails."""
    try:
        yield
    except BaseException:
        stopped.set()
        raise


def _window(
    evidence: Sequence[Evidence], space: Float[np.ndarray, "t 33 3"] | None, times: slice
) -> tuple[list[Evidence], Float[np.ndarray, "u 33 3"] | None]:
    return [e[times] for e in evidence], None if space is None else space[times]


def _joined(parts: Sequence[FittedMotion]) -> FittedMotion:
    """Windows one after the other; where two overlap, the one fades into the other."""
    whole = parts[0]
    for part in parts[1:]:
        shared = min(OVERLAP, len(part))
        fade = torch.linspace(0, 1, shared + 2)[1:-1, None]
        # The second window's turn is told on top of the first one's guess, so that both can be mixed.
        before, after = whole[slice(len(whole) - shared, len(whole))], part[slice(0, shared)]
        again = _on_guess(after, before.guess)
        mixed = replace(
            before,
            root=before.root + fade * (again.root - before.root),
            pose=before.pose + fade[..., None] * (after.pose - before.pose),
            translation=before.translation + fade * (after.translation - before.translation),
        )
        pieces = (whole[slice(0, len(whole) - shared)], mixed, part[slice(shared, len(part))])
        joined = {n: torch.cat([getattr(p, n) for p in pieces]) for n in ("guess", "root", "pose", "translation")}
        whole = replace(whole, **joined)
    return whole


def _on_guess(motion: FittedMotion, guess: Float[Tensor, "t 3 3"]) -> FittedMotion:
    turned = axis_angle_to_matrix(motion.root) @ motion.guess @ guess.transpose(1, 2)
    return replace(motion, guess=guess, root=matrix_to_axis_angle(turned))


def _fit_window(
    body: Body,
    evidence: Sequence[Evidence],
    fps: float,
    free_focal: bool,
    config: FitConfig,
    points_in_space: Float[np.ndarray, "t 33 3"] | None,
    known: FittedMotion | None,
    progress: Callable[[float], None],
) -> FittedMotion:
    points = body_points(body)
    outlines = [None if e.masks is None else trace_outlines(e.masks) for e in evidence]
    seen = gather(evidence, outlines, points_in_space)
    motion = begin(body, points, seen)
    if known is not None:
        motion = replace(motion, betas=known.betas, marks=known.marks, log_focal=known.log_focal, slope=known.slope)
    shared: tuple[str, ...] = () if known is not None else ("betas", "marks")
    if known is None and len(evidence) == 1:
        shared += ("log_distance", "log_focal") if free_focal else ("log_distance",)
    total = sum(config.steps)

    def everything(
        config: FitConfig, direction: float, wide: float, support: Support | None = None
    ) -> Callable[[FittedMotion, Posed], Tensor]:
        def loss(motion: FittedMotion, posed: Posed) -> Tensor:
            terms = landmark_term(posed, points, motion, seen, config.landmark * wide)
            terms = terms + direction * direction_term(posed, points, motion, seen, config.direction)
            if support is not None:
                terms = terms + physics_term(body, posed, points, motion, support, fps, config.physics, seen.seconds)
            return terms + prior(body, posed, motion, fps, config.prior, seen.offsets, seen.seconds)

        return loss

    # Directions in space first, so that no limb starts from the wrong side of the image plane.
    few = config.steps[0] // 3
    guess = _descend(body, motion, ("root", "pose", "translation"), everything(config, 1.0, 4.0), few, config.rate)
    progress(few / total)

    def to_landmarks(motion: FittedMotion, changing: tuple[str, ...], support: Support | None = None) -> FittedMotion:
        for wide in (4.0, 2.0):
            loss = everything(config, config.direction_weight, wide, support)
            motion = _descend(body, motion, changing, loss, (config.steps[0] - few) // 2, config.rate)
        return motion

    changing = ("root", "pose", "translation", *shared)
    motion = to_landmarks(guess, changing)
    support = _support(body, motion, seen, fps, config, known)
    if support is not None:
        # The vertical of a long clip is that of the window which told its shape.
        upright, start = changing, motion
        if known is None:
            axis = standing_axis(place_joints(pose_motion(body, motion), body, motion), support.stands)
            upright, start = (*changing, "slope"), replace(start, slope=slope_of(axis))
        floored = to_landmarks(start, upright, support)
        if _contradicted(body, points, seen, motion, floored, support, config):
            support = None
        else:
            motion, changing, config = floored, upright, steadier(config)
    progress(config.steps[0] / total)
    masks = [(k, o) for k, o in enumerate(outlines) if o is not None]
    rounds = max(1, config.steps[1] // config.rematch) if masks else 0
    count = len(body.template)
    searched, skin = (choose(body, torch.arange(0, count, max(1, count // n))) for n in (4500, 450))
    base = everything(config, config.direction_weight, 1.0, support)
    for number in range(rounds):
        matched = [(k, o, *match_rims(body, motion, seen, k, o, searched)) for k, o in masks]
        width = config.outline * (1 + 3 * (1 - number / rounds))
        rate = config.rate * 0.5 * (1 - number / rounds) + 0.002

        def with_outlines(
            motion: FittedMotion, posed: Posed, matched: list[_Matched] = matched, width: float = width
        ) -> Tensor:
            loss = base(motion, posed)
            for k, traced, rims, weight in matched:
                term = outline_term(posed, motion, seen, k, traced, rims, weight, skin, width)
                loss = loss + config.outline_weight * term
            return loss

        motion = _descend(body, motion, changing, with_outlines, config.rematch, rate, decay=False)
        progress((config.steps[0] + (number + 1) * config.rematch) / total)
    return motion


def _support(
    body: Body, motion: FittedMotion, seen: Seen, fps: float, config: FitConfig, known: FittedMotion | None
) -> Support | None:
    """Where the floor is known to hold the body; None where the clip does not tell it, or several cameras do."""
    vertical_elsewhere = known is not None and not bool(known.slope.any())
    if len(seen.pixels) > 1 or config.physics.weight == 0 or vertical_elsewhere:
        return None
    stands = standing(seen, fps)
    if not tells_the_vertical(stands, fps):
        return None
    joints = place_joints(pose_motion(body, motion), body, motion)
    return Support(stands, carrying(joints, stands))


def _contradicted(
    body: Body,
    points: BodyPoints,
    seen: Seen,
    free: FittedMotion,
    floored: FittedMotion,
    support: Support,
    config: FitConfig,
) -> bool:
    """Whether a floor and balance go against what is seen.

    Args:
        body: that is fitted.
        points: its landmarks.
        seen: landmarks.
        free: fitted without them.
        floored: fitted with them.
        support: where feet stand.
        config: weights.
    """
    with torch.no_grad():
        posed = [pose_motion(body, motion) for motion in (free, floored)]
        missed = [
            float(landmark_term(one, points, motion, seen, 2 * config.landmark))
            for one, motion in zip(posed, (free, floored), strict=True)
        ]
        return missed[1] > (1 + MAX_WORSE) * missed[0] or not believable(body, posed[1], points, floored, support)


def _descend(
    body: Body,
    motion: FittedMotion,
    changing: tuple[str, ...],
    loss: Callable[[FittedMotion, Posed], Tensor],
    steps: int,
    rate: float,
    decay: bool = True,
) -> FittedMotion:
    """Adam on some of the unknowns.

    Its first steps move every unknown by the whole rate, however small the slope: along an arm that adds up to half a
    metre, from where robust terms no longer find back. So the rate starts small.
    """
    free = {name: getattr(motion, name).clone().requires_grad_() for name in changing}
    pace = {"translation": 0.5, "betas": 2.0, "marks": 0.05, "log_focal": 0.2, "log_distance": 0.3, "slope": 0.3}
    groups = [{"params": [value], "lr": rate * pace.get(name, 1.0)} for name, value in free.items()]
    optimizer = torch.optim.Adam(groups, betas=(0.9, 0.99))
    start = [rate * pace.get(name, 1.0) for name in free]
    for step in range(steps):
        share = (1 - 0.8 * step / steps if decay else 1.0) * min(1.0, (step + 1) / WARM_UP)
        for group, first in zip(optimizer.param_groups, start, strict=True):
            group["lr"] = first * share
        now = replace(motion, **free)
        optimizer.zero_grad()
        loss(now, pose_motion(body, now)).backward()
        optimizer.step()
    return replace(motion, **{name: value.detach() for name, value in free.items()})
