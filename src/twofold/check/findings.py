"""Findings about a capture in words, and the verdict they add up to."""

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from twofold.capture.layout import spans
from twofold.check.frame_measures import FrameFacts

Level = Literal["fault", "warning", "note"]


@dataclass(frozen=True)
class Finding:
    """Something worth knowing about a capture.

    Attributes:
        level: a fault makes a capture not trainable, a warning costs quality, a note is for information.
        topic: short, the same in every version.
        what: a sentence.
        where: cameras and frames; empty for the whole capture.
        advice: a sentence about what to do.
        images: camera and time of those that `check --write-splits` leaves out because of it.
    """

    level: Level
    topic: str
    what: str
    advice: str
    where: str = ""
    images: tuple[tuple[str, int], ...] = ()

    def __str__(self) -> str:
        where = f" ({self.where})" if self.where else ""
        return f"{self.what.rstrip('.')}{where}. {self.advice}"


@dataclass(frozen=True)
class Judgement:
    """The verdict: its findings, worst first."""

    findings: tuple[Finding, ...]

    @property
    def level(self) -> Literal["good", "usable", "not trainable"]:
        """Of the whole capture."""
        levels = {finding.level for finding in self.findings}
        return "not trainable" if "fault" in levels else "usable" if "warning" in levels else "good"

    @property
    def unfit(self) -> dict[tuple[str, int], str]:
        """Camera and time of the images to leave out of the splits, and the topic of the first finding that says so."""
        found: dict[tuple[str, int], str] = {}
        for finding in self.findings:
            for image in finding.images:
                found.setdefault(image, finding.topic)
        return found

    @property
    def words(self) -> str:
        """The verdict in a sentence."""
        count = {level: sum(f.level == level for f in self.findings) for level in ("fault", "warning")}
        if self.level == "good":
            return "Good: nothing speaks against training."
        if self.level == "usable":
            return f"Usable, with {counted(count['warning'], 'warning')}."
        return f"Not trainable as it is: {counted(count['fault'], 'fault')} to fix first."


def graded(serious: bool) -> Level:
    """A fault where it is serious, else a warning."""
    return "fault" if serious else "warning"


def counted(number: int, noun: str) -> str:
    """A number with its noun.

    >>> counted(1, "warning"), counted(3, "warning")
    ('1 warning', '3 warnings')
    """
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def places(frames: Iterable[FrameFacts]) -> str:
    """Cameras and times of frames in few words."""
    return places_of((f.camera, f.frame_index) for f in frames)


def places_of(images: Iterable[tuple[str, int]]) -> str:
    """Cameras and times in few words.

    >>> places_of([("a", 1), ("a", 2), ("b", 7)])
    'camera a at 1-2; camera b at 7'
    """
    times: dict[str, list[int]] = defaultdict(list)
    for camera, time in images:
        times[camera].append(time)
    return "; ".join(f"camera {camera} at {spans(group)}" for camera, group in sorted(times.items()))
