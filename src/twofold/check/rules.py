"""When a measured fact is worth a sentence, and how bad it is."""

from collections import defaultdict
from collections.abc import Iterator

import numpy as np

from twofold.capture.layout import spans
from twofold.check.body_mask_overlap import agreement
from twofold.check.findings import Finding, Judgement, Level, counted, graded, places, places_of
from twofold.check.frame_measures import FrameFacts
from twofold.check.measure import CameraFacts, Facts, inverted
from twofold.check.motion_measures import LIMBS, STILL
from twofold.prepare.detect.background import MOVING
from twofold.prepare.output.acceptance import MAX_BAD
from twofold.prepare.standing import UPRIGHT, standing_faults
from twofold.prepare.turning import SEEN

STATURES, POSSIBLE_STATURES = (1.2, 2.2), (0.5, 3.0)
"""Metres; children and giants in the wider range. Networks, voxels and losses are made for metres."""
DISTANCES = (0.3, 30.0)
"""Metres; farther away no phone shows a face."""
VIEW_ANGLES = (8.0, 110.0)
"""Degrees: a long telephoto lens and an action camera. Beyond these, a guessed focal length (5000, say) is likelier."""
ODD_PIXELS, OFF_CENTER = 0.05, 0.15
"""fy against fx; distance of the principal point from the image's middle, in image lengths."""
BRIGHTER = 1.3
"""Ratio of the brightnesses of a background: a third of an aperture stop."""
HARD, SOFT, RAGGED, GRAIN = 0.05, 0.03, 0.0015, 0.012
"""Masks: width of the soft edge in pixels below which it is hard; in body heights, the width above which it is too soft
(5 cm), how far an outline deviates from a smooth one (3 mm, good ones 1 mm), and how large its steps are (2 cm)."""
LOOSE = 0.05
"""Share of a mask that does not hang together with the rest: a forearm."""
CROPPED, CUT_OFF = 0.1, 0.3
"""Share of the frames that may touch the border; share of the body that may be outside on average."""
FEWEST, FEW = 8, 20
"""Training images: fewer cannot tell pose from chance; from the second on it begins to work."""
JITTER = 0.03
"""Metres; trembling by more than a finger's breadth and a half is no motion."""
SMALL, FINE = 64, 200
"""The person's height in pixels: below the first there is no face; the second is about a centimetre a pixel."""
BLURRED = 0.45
"""Sharpness relative to the usual one of the same camera."""
NOT_NOVEL = 15.0
"""A test pose whose joints are all this close to a training pose, degrees, tests memory."""
STANDING = ("lean", "floating", "sliding")
FOLLOWS = {
    "convention": {"distance", "jumps", "jitter", "resolution", "sides unseen", "up", "cropped", "blur", *STANDING},
    "scale": {"distance", "jumps", "jitter", "resolution", *STANDING},
    "disagreement": {"cropped"},
}
"""What need not be said beside a fault, because it comes of it."""


def judge(facts: Facts) -> Judgement:
    """Findings about everything that was measured."""
    found = [*agreement(facts), *_scale(facts), *_masks(facts), *_sides_and_poses(facts), *_motion(facts)]
    found += [
        Finding("note" if fault.doubtful else "warning", fault.topic, fault.what, fault.advice)
        for fault in standing_faults(facts.standing)
    ]
    found += [finding for camera in facts.cameras for finding in _camera(camera)]
    found += [*_backgrounds(facts), *_images(facts)]
    found = _merged(found)
    known = {topic for f in found if f.level == "fault" for topic in FOLLOWS.get(f.topic, ())}
    order: tuple[Level, ...] = ("fault", "warning", "note")
    return Judgement(tuple(sorted((f for f in found if f.topic not in known), key=lambda f: order.index(f.level))))


def _merged(findings: list[Finding]) -> list[Finding]:
    """Findings of which those that differ in their place alone are one."""
    groups: dict[tuple[Level, str, str, str], list[Finding]] = defaultdict(list)
    for f in findings:
        groups[f.level, f.topic, f.what, f.advice].append(f)
    return [
        Finding(*key, "; ".join(f.where for f in group if f.where), tuple(image for f in group for image in f.images))
        for key, group in groups.items()
    ]


def _scale(facts: Facts) -> Iterator[Finding]:
    height = facts.stature
    if STATURES[0] <= height <= STATURES[1]:
        return
    units = {"millimetres": 1000.0, "centimetres": 100.0, "inches": 39.37, "kilometres": 0.001}
    unit = next((u for u, n in units.items() if STATURES[0] <= height / n <= STATURES[1]), "")
    yield Finding(
        graded(not POSSIBLE_STATURES[0] <= height <= POSSIBLE_STATURES[1]),
        "scale",
        f"The person is {height:.4g} m tall" + (f"; those will be {unit}" if unit else ""),
        f"Divide body, translations and the last column of world_to_camera by {units[unit]:g}."
        if unit
        else "Scale body, translations and cameras until the person has their true height in metres.",
    )


def _camera(camera: CameraFacts) -> Iterator[Finding]:
    where = f"camera {camera.name}"
    if not VIEW_ANGLES[0] <= camera.view_angle <= VIEW_ANGLES[1]:
        yield Finding(
            "warning",
            "focal length",
            f"The camera sees {camera.view_angle:.3g} degrees across, which no usual lens does",
            "Check the focal length: in pixels, of these images and not of larger ones, and not guessed.",
            where,
        )
    if abs(np.log(camera.aspect)) > ODD_PIXELS:
        yield Finding(
            "warning",
            "focal length",
            f"fy is {camera.aspect:.3g} times fx, so pixels are not square",
            "Check that width and height were scaled alike, and the intrinsics with them.",
            where,
        )
    if camera.off_center > OFF_CENTER:
        yield Finding(
            "note",
            "principal point",
            f"The principal point lies {camera.off_center:.0%} of the image's length off its middle",
            "That is right for cropped images; else check cx and cy.",
            where,
        )
    if not DISTANCES[0] <= camera.distance <= DISTANCES[1]:
        yield Finding(
            "warning",
            "distance",
            f"The body stands {camera.distance:.3g} m from the camera",
            "Check the units of translations and cameras, and whether the focal length is a guess.",
            where,
        )


def _masks(facts: Facts) -> Iterator[Finding]:
    frames = [f for f in facts.frames if not inverted(f)]
    if not frames:
        return
    tall, softness, ragged, grain = (
        float(np.median(values))
        for values in zip(
            *((f.body_height, f.mask.softness, f.mask.roughness, f.mask.grain) for f in frames), strict=True
        )
    )
    if softness < HARD:
        yield Finding(
            "note",
            "hard masks",
            "Masks are black and white, without soft edges",
            "That works; mattes with soft edges give cleaner outlines.",
        )
    if softness > max(4.0, SOFT * tall):
        yield Finding(
            "warning",
            "soft masks",
            f"The edges of the masks are {softness:.0f} pixels wide",
            "Sharpen the masks: in such an edge nobody knows where the person ends.",
        )
    if ragged > RAGGED:
        yield Finding(
            "warning",
            "jagged masks",
            f"Outlines are ragged: they deviate {ragged:.1%} of the body height from smooth ones",
            "Smooth the masks, or make them with a better segmentation.",
        )
    elif grain > max(3.0, GRAIN * tall):
        yield Finding(
            "warning",
            "jagged masks",
            f"Outlines go in steps of {grain:.0f} pixels, as enlarged small masks do",
            "Make masks at the images' own size, or enlarge them smoothly.",
        )
    loose = [f for f in frames if f.mask.loose > LOOSE]
    if loose:
        yield Finding(
            "warning",
            "pieces",
            f"{counted(len(loose), 'mask')} in pieces",
            "Keep the person's piece; where something in front parts it, mark that as ignored.",
            places(loose),
        )
    hidden = [f for f in frames if f.ignored > 0]
    if hidden:
        worst = max(hidden, key=lambda f: f.ignored)
        yield Finding(
            "note",
            "held objects",
            f"In {counted(len(hidden), 'image')} a part of the person is ignored, as if an object hid it: at most "
            f"{worst.ignored:.1%}, on average {sum(f.ignored for f in frames) / len(frames):.1%} of the mask",
            "Compare the overlays: ignored parts are purple. If they show the person's own body, prepare again with "
            "--held-objects keep.",
            places(hidden),
        )
    cropped = [f for f in frames if f.mask.borders]
    if len(cropped) > CROPPED * len(frames):
        sides = sorted({side for f in cropped for side in f.mask.borders})
        outside = float(np.mean([f.body_outside for f in frames]))
        yield Finding(
            graded(outside > CUT_OFF),
            "cropped",
            f"In {counted(len(cropped), 'image')} the person runs out at the {', '.join(sides)}; on average "
            f"{f'{outside:.0%}' if outside >= 0.005 else 'less than 1%'} of the body is outside",
            "Use images that show all of the person; the colours of what is never seen are guesses.",
            places(cropped),
        )


def _sides_and_poses(facts: Facts) -> Iterator[Finding]:
    motion = facts.motion
    if motion.seen < SEEN:
        yield Finding(
            "warning",
            "sides unseen",
            f"Training cameras see {motion.seen:.0f} of the 360 degrees around the body, which turns by "
            f"{motion.turned:.0f} before them; its {motion.unseen} is hardly observed, so its colours are guesses",
            "Let the person turn round, or train on more cameras.",
        )
    train = facts.images["train"]
    if train < FEW:
        yield Finding(
            graded(train < FEWEST),
            "few images",
            f"There are {train} training images only",
            f"Take {FEW} or more, from all sides and in different poses.",
        )
    still = [name for (name, _), turn in zip(LIMBS, motion.ranges, strict=True) if turn < STILL]
    if motion.poses < 3:
        yield Finding(
            "warning",
            "poses",
            f"The person hardly moves: {counted(motion.poses, 'pose')} that differ by 30 degrees in a joint",
            "Expect new poses to look wrong; film arms and legs moving.",
        )
    elif still:
        yield Finding(
            "note",
            "poses",
            f"These turn by less than {STILL:g} degrees: {', '.join(still)}",
            "New poses that use them are guesses.",
        )
    if motion.novelty is not None and motion.novelty < NOT_NOVEL:
        yield Finding(
            "note",
            "novel poses",
            f"No joint of a novel_pose frame is turned by more than {motion.novelty:.0f} degrees against the nearest "
            "training pose (median)",
            "Metrics will tell how well frames in between are met, not how well new poses are.",
        )
    if motion.up < UPRIGHT:
        yield Finding(
            "note",
            "up",
            "The body does not stand along the world's y axis",
            "Orbits are drawn about y and will look tilted; turn the world so that y is up.",
        )


def _motion(facts: Facts) -> Iterator[Finding]:
    motion = facts.motion
    trained = [t for t in motion.jumps if t in facts.train_times]
    rest = [t for t in motion.jumps if t not in facts.train_times]
    if trained:
        yield Finding(
            graded(len(trained) > MAX_BAD * len(motion.frames)),
            "jumps",
            f"{counted(len(trained), 'frame')} cannot be reached in time from the one before: failed or exchanged "
            "frames, or a wrong `fps`",
            "Fit these again, or leave them out: check --write-splits, or prepare --drop FRAMES.",
            f"times {spans(trained)}",
            tuple((camera.name, time) for camera in facts.cameras for time in trained),
        )
    if rest:
        yield Finding(
            "note",
            "jumps",
            f"{counted(len(rest), 'test frame')} cannot be reached in time from the one before",
            "Metrics measured there may be too low.",
            f"times {spans(rest)}",
        )
    if motion.jitter > JITTER:
        yield Finding(
            "warning",
            "jitter",
            f"Joints tremble by {100 * motion.jitter:.1f} cm from frame to frame",
            "Smooth the poses over time, or check `fps`.",
        )


def _backgrounds(facts: Facts) -> Iterator[Finding]:
    for name, background in facts.backgrounds.items():
        ratios = [1.0, *background.brightness]
        if background.shift is not None and background.shift > MOVING:
            yield Finding(
                "warning",
                "moving camera",
                f"The background moves by {background.shift:.1%} of the image, so the camera does not stand still",
                "Poses must be relative to the camera in each frame, and light that stays in the world will blur; "
                "film from a tripod.",
                f"camera {name}",
            )
        elif background.lost:
            yield Finding(
                "warning",
                "moving camera",
                "The background differs so much from image to image that nothing tells whether the camera stands still",
                "Film from a tripod, before a background that does not move.",
                f"camera {name}",
            )
        elif max(ratios) > BRIGHTER * min(ratios):
            yield Finding(
                "warning",
                "exposure",
                f"The brightness of the background changes by a factor of {max(ratios) / min(ratios):.2g}",
                "Lock exposure and white balance, or equalise the images.",
                f"camera {name}",
            )


def _images(facts: Facts) -> Iterator[Finding]:
    if facts.twins:
        yield Finding(
            "warning",
            "overlap",
            f"{counted(len(facts.twins), 'test image')} equal to a training image, byte for byte",
            "Take each out of one split; what is measured there is memory.",
            places_of((camera, time) for _, camera, time in facts.twins),
        )
    if facts.repeated:
        yield Finding(
            "warning",
            "repeated images",
            f"{counted(len(facts.repeated), 'training image')} equal to the one before, as in stretched videos",
            "Leave them out, and check `fps`.",
            f"times {spans(facts.repeated)}",
        )
    tall = float(np.median([f.body_height for f in facts.frames]))
    if tall < FINE:
        yield Finding(
            "warning" if tall < SMALL else "note",
            "resolution",
            f"The person is {tall:.0f} pixels tall: {100 * facts.stature / max(tall, 1e-6):.1f} cm a pixel",
            "Finer things cannot be learned; use larger images where there are any.",
        )
    groups: dict[str, list[FrameFacts]] = defaultdict(list)
    for frame in facts.frames:
        groups[frame.camera].append(frame)
    usual = {name: float(np.median([f.sharpness for f in group])) for name, group in groups.items()}
    blurred = [f for f in facts.frames if f.sharpness < BLURRED * usual[f.camera]]
    if blurred:
        yield Finding(
            "note",
            "blur",
            f"{counted(len(blurred), 'image')} much less sharp than the others",
            "Leave out what is blurred.",
            places(blurred),
        )
