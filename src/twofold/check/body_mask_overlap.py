"""Whether bodies and masks agree, and what is the matter where they do not."""

from collections.abc import Iterator

import numpy as np

from twofold.check.findings import Finding, counted, graded, places, places_of
from twofold.check.frame_measures import FrameFacts
from twofold.check.measure import POOR, Doubt, Facts, inverted
from twofold.prepare.output.acceptance import MAX_BAD, MIN_IOU

BETTER, TELLING = 0.03, 0.1
"""A twin fits better when its IoU is higher by so much; it tells something where it covers so much else."""
LARGER, SMALLER = 1.2, 0.92
"""Loose clothes make a mask up to a fifth larger in length than the body; a smaller one cuts the person."""
OFF = 0.05
"""Masks off the body's middle by more than this, in body heights, everywhere alike: a hand's breadth."""
MAX_NAMED = 4
"""At most this many exchanged images are named one by one."""


def agreement(facts: Facts) -> Iterator[Finding]:
    """Bodies against masks; once a convention explains it all, what follows from that is left out."""
    upside = [f for f in facts.frames if inverted(f)]
    frames = [f for f in facts.frames if not inverted(f)]
    if upside:
        yield Finding(
            graded(len(upside) > MAX_BAD * len(facts.frames)),
            "inverted masks",
            f"{counted(len(upside), 'mask')} inverted: the surroundings are white",
            "Exchange black and white there.",
            places(upside),
        )
    if not frames:
        return
    explained = [finding for doubt in facts.doubts for finding in _convention(doubt, facts)]
    iou = float(np.mean([f.iou for f in frames]))
    delay, gain = facts.delay
    if delay and not explained:
        late = "later" if delay > 0 else "earlier"
        explained.append(
            Finding(
                graded(iou < MIN_IOU),
                "delay",
                f"Images fit the poses of {counted(abs(delay), 'frame')} {late} better, by {gain:.2f} in IoU",
                f"Move the rows of motion.npz by {-delay:+d}, or rename the images.",
            )
        )
    yield from explained
    if explained:
        return
    poor = [camera for camera in facts.cameras if camera.iou < POOR]
    if len(poor) == len(facts.cameras):
        yield _disagreement(iou, "")
        return
    for camera in poor:
        yield _disagreement(camera.iou, f"camera {camera.name}")
    yield from _bad_frames(facts, frames)
    yield from _sides(frames)
    yield from _faces(facts)
    yield from _placement(frames)


def _convention(doubt: Doubt, facts: Facts) -> Iterator[Finding]:
    found = doubt.diagnosis
    if not found.conventions:
        return
    wrong = " and ".join(c.wrong for c in found.conventions)
    advice = "; then ".join(c.advice for c in found.conventions)
    certain = found.given < POOR or any(c.family == "pose" for c in found.conventions)
    yield Finding(
        graded(certain),
        "convention",
        f"It looks as if {wrong}: with that undone, silhouettes agree by {found.iou:.2f} instead of {found.given:.2f}",
        f"{advice[0].upper()}{advice[1:]}.",
        "" if len(doubt.cameras) == len(facts.cameras) else f"camera {', '.join(doubt.cameras)}",
    )


def _disagreement(iou: float, where: str) -> Finding:
    return Finding(
        "fault",
        "disagreement",
        f"Body and masks do not agree (mean IoU {iou:.2f}), and no usual convention of axes, sides, units or "
        "intrinsics would fix it",
        "Look at the overlays below: fit the poses again, or see whether images, masks and poses belong together.",
        where,
    )


def _bad_frames(facts: Facts, frames: list[FrameFacts]) -> Iterator[Finding]:
    if facts.elsewhere:
        named = ", ".join(f"{time} shows the pose of {other}" for _, time, other in facts.elsewhere[:MAX_NAMED])
        more = f", and {len(facts.elsewhere) - MAX_NAMED} more" if len(facts.elsewhere) > MAX_NAMED else ""
        yield Finding(
            graded(len(facts.elsewhere) > MAX_BAD * len(frames)),
            "exchanged images",
            f"{counted(len(facts.elsewhere), 'image')} with the pose of another frame: {named}{more}",
            "Put images and poses into the same order, or leave them out: check --write-splits.",
            places_of((camera, time) for camera, time, _ in facts.elsewhere),
            tuple((camera, time) for camera, time, _ in facts.elsewhere),
        )
    known = {(camera, time) for camera, time, _ in facts.elsewhere}
    rest = [f for f in frames if f.iou < MIN_IOU and (f.camera, f.frame_index) not in known]
    if rest:
        yield Finding(
            graded(len(rest) > MAX_BAD * len(frames)),
            "bad frames",
            f"In {counted(len(rest), 'image')} body and mask do not agree: IoU below {MIN_IOU:g}, down to "
            f"{min(f.iou for f in rest):.2f}",
            "Fit these again, fix their masks, or leave them out: check --write-splits, or prepare --drop FRAMES.",
            places(rest),
            tuple((f.camera, f.frame_index) for f in rest),
        )


def _sides(frames: list[FrameFacts]) -> Iterator[Finding]:
    telling = [f for f in frames if f.twins.sides_differ > TELLING]
    swapped = [f for f in telling if f.twins.sides > max(f.twins.given + BETTER, MIN_IOU)]
    if swapped:
        yield Finding(
            graded(len(swapped) > MAX_BAD * len(telling)),
            "sides",
            f"In {counted(len(swapped), 'image')} the body fits better with left and right limbs exchanged",
            "Exchange left and right in these poses, or leave them out: check --write-splits.",
            places(swapped),
            tuple((f.camera, f.frame_index) for f in swapped),
        )
    if len(telling) < 0.25 * len(frames):
        yield Finding(
            "note",
            "sides",
            f"Whether left and right are exchanged shows in {len(telling)} of {len(frames)} images only; in the "
            "others both ways cover the same pixels",
            "Look at the overlays: left limbs are orange, right ones blue.",
        )
    turned = [
        f
        for f in frames
        if f.twins.facing_differs > TELLING
        and f.twins.facing > max(f.twins.given + BETTER, MIN_IOU)
        and f not in swapped
    ]
    if turned:
        yield Finding(
            graded(len(turned) > MAX_BAD * len(frames)),
            "facing",
            f"In {counted(len(turned), 'image')} the body fits better facing the other way",
            "Rotate these roots by 180 degrees about the body's axis and swap left and right, or leave them out: check "
            "--write-splits.",
            places(turned),
            tuple((f.camera, f.frame_index) for f in turned),
        )


def _faces(facts: Facts) -> Iterator[Finding]:
    # Patterns pass for a face in a few images of a hundred.
    if len(facts.faces) >= max(3, 0.25 * len(facts.backs)):
        yield Finding(
            graded(len(facts.faces) > 0.5 * len(facts.backs)),
            "faces",
            f"A face looks at the camera in {len(facts.faces)} of {len(facts.backs)} images where the body shows its "
            "back",
            "Rotate these roots by 180 degrees about the body's axis and exchange left and right limbs.",
            places_of(facts.faces),
        )


def _placement(frames: list[FrameFacts]) -> Iterator[Finding]:
    ratio = float(np.median([f.size_ratio for f in frames]))
    if not SMALLER <= ratio <= LARGER:
        smaller = ratio < 1
        yield Finding(
            "warning",
            "size",
            f"Masks are {'smaller' if smaller else 'larger'} than the body, by {abs(ratio - 1):.0%} in length",
            f"Check focal length, shape and distance; or the masks {'cut the person' if smaller else 'hold too much'}.",
        )
    right, down = np.median([f.offset for f in frames], axis=0).tolist()
    words = [f"{abs(right):.0%} to the {'right' if right > 0 else 'left'} of"] if abs(right) > OFF else []
    words += [f"{abs(down):.0%} {'below' if down > 0 else 'above'}"] if abs(down) > OFF else []
    if words:
        yield Finding(
            "warning",
            "offset",
            f"Masks lie {' and '.join(words)} the body, in body heights, everywhere alike",
            "Check the principal point, whether images were cropped, and what the translations are relative to.",
        )
