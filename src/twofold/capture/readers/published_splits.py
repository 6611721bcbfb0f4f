"""Which frames and cameras train and test: the splits that papers use on ZJU-MoCap, and one for everything else.

The frame ranges of the subjects are those of the papers' published configurations; frames are counted from 0 in the
order of the recording. Camera 0 trains, but for NeuralBody's split, which trains on four.
"""

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

from twofold.capture.readers.sequence import Sequence3D, Split
from twofold.errors import TwofoldError

ProtocolName = Literal["paper", "humannerf", "monohuman", "neuralbody", "every_nth"]

KEPT = {"313": 1000, "315": 2000, "377": 570, "386": 540, "387": 540, "394": 475}
"""Frames of a subject that are used, from the first one; of the others all."""
TEST_EVERY = 30
NEURALBODY_CAMERAS = (0, 6, 12, 18)


class Range(NamedTuple):
    """Frames from `first` up to but without `end`."""

    first: int
    end: int


NEURALBODY: dict[str, tuple[Range, Range]] = {
    "313": (Range(0, 60), Range(60, 1060)),
    "315": (Range(0, 400), Range(400, 1400)),
    "390": (Range(700, 1000), Range(0, 700)),
}
"""Training frames and unseen poses of the subjects that differ from 0-299 and 300 to the end."""


def needed_frames(protocol: ProtocolName, subject: str) -> int | None:
    """How many frames from the first one a split looks at; None for all."""
    if protocol == "neuralbody":
        ranges = NEURALBODY.get(subject)
        return None if ranges is None else max(r.end for r in ranges)
    return None if protocol == "every_nth" else KEPT.get(subject)


def split(protocol: ProtocolName, sequence: Sequence3D, held_out: int) -> Split:
    """The images of each split.

    Args:
        protocol: whose.
        sequence: to split.
        held_out: every Nth frame is held out, where the split is "every_nth".

    Raises:
        TwofoldError: there are too few frames or cameras.
    """
    chosen = PROTOCOLS[protocol](sequence, held_out)
    there = {
        part: {
            camera: [frame for frame in frames if (camera, frame) in sequence.images]
            for camera, frames in cameras.items()
        }
        for part, cameras in chosen.items()
    }
    there = {part: {camera: frames for camera, frames in cameras.items() if frames} for part, cameras in there.items()}
    if sum(len(frames) for frames in there["train"].values()) < 2:
        raise TwofoldError(
            f"The split {protocol} leaves fewer than two training images of {sequence.name} "
            f"({len(sequence.poses)} frames, cameras {', '.join(list(sequence.cameras)[:4])}...); choose another "
            "--split or check the data set."
        )
    return there


def _used(sequence: Sequence3D) -> int:
    return min(KEPT.get(sequence.subject, len(sequence.poses)), len(sequence.poses))


def _names(sequence: Sequence3D) -> tuple[str, list[str]]:
    """The training camera and the others."""
    train, *others = sequence.cameras
    return train, others


def _paper(sequence: Sequence3D, held_out: int) -> Split:
    """First four fifths and last fifth; every 30th frame of all other cameras tests both."""
    return _fifths(sequence, with_training_camera=False)


def _monohuman(sequence: Sequence3D, held_out: int) -> Split:
    """The same, but unseen poses are tested on the training camera, too."""
    return _fifths(sequence, with_training_camera=True)


def _fifths(sequence: Sequence3D, with_training_camera: bool) -> Split:
    used, (train, others) = _used(sequence), _names(sequence)
    cut = used - used // 5
    tested = [train, *others] if with_training_camera else others
    return {
        "train": {train: range(cut)},
        "novel_view": dict.fromkeys(others, range(0, cut, TEST_EVERY)),
        "novel_pose": dict.fromkeys(tested, range(cut, used, TEST_EVERY)),
    }


def _humannerf(sequence: Sequence3D, held_out: int) -> Split:
    """All frames of the first camera train; every 30th frame of all other cameras tests."""
    used, (train, others) = _used(sequence), _names(sequence)
    return {
        "train": {train: range(used)},
        "novel_view": dict.fromkeys(others, range(0, used, TEST_EVERY)),
        "novel_pose": {},
    }


def _neuralbody(sequence: Sequence3D, held_out: int) -> Split:
    """Four cameras train; the others test every 30th training frame and unseen pose."""
    names = list(sequence.cameras)
    trained = [names[i] for i in NEURALBODY_CAMERAS if i < len(names)]
    if len(trained) < len(NEURALBODY_CAMERAS):
        raise TwofoldError(
            f"NeuralBody's split trains on cameras 0, 6, 12 and 18, and {sequence.name} has {len(names)} cameras; "
            "choose another --split."
        )
    others = [name for name in names if name not in trained]
    seen, unseen = NEURALBODY.get(sequence.subject, (Range(0, 300), Range(300, len(sequence.poses))))
    return {
        "train": dict.fromkeys(trained, range(seen.first, seen.end)),
        "novel_view": dict.fromkeys(others, range(seen.first, seen.end, TEST_EVERY)),
        "novel_pose": dict.fromkeys(others, range(unseen.first, unseen.end, TEST_EVERY)),
    }


def _every_nth(sequence: Sequence3D, held_out: int) -> Split:
    """The middle one of every N frames is held out for all cameras; the first camera trains on the others."""
    train, others = _names(sequence)
    out = [frame for frame in range(len(sequence.poses)) if frame % held_out == held_out // 2]
    kept = [frame for frame in range(len(sequence.poses)) if frame % held_out != held_out // 2]
    return {
        "train": {train: kept},
        "novel_view": dict.fromkeys(others, kept),
        "novel_pose": dict.fromkeys([train, *others], out),
    }


PROTOCOLS: dict[ProtocolName, Callable[[Sequence3D, int], Split]] = {
    "paper": _paper,
    "humannerf": _humannerf,
    "monohuman": _monohuman,
    "neuralbody": _neuralbody,
    "every_nth": _every_nth,
}


def default_protocol(sequence: Sequence3D) -> ProtocolName:
    """What is taken where the user names no split: the paper's for several cameras, held-out frames for one."""
    return "paper" if len(sequence.cameras) > 1 else "every_nth"


def count_images(chosen: Split) -> dict[str, int]:
    """Images of each split."""
    return {part: sum(len(frames) for frames in cameras.values()) for part, cameras in chosen.items()}


def ordered(chosen: Split) -> Sequence[tuple[str, int]]:
    """Camera and frame of every image of any split, once, camera by camera."""
    return sorted({(c, f) for cameras in chosen.values() for c, frames in cameras.items() for f in frames})
