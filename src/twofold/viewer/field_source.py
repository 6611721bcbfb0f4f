"""Who renders the field: the viewer's own thread, or a training between two of its steps."""

import threading
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol, final, runtime_checkable

import torch

from twofold.geometry.cameras import Camera
from twofold.methods.base import Avatar
from twofold.outputs.views import RenderedImage, render_image
from twofold.viewer.body_pose import BodyPose
from twofold.viewer.view_images import PAPER, strips

_STRIP = 65_536
"""Rays after which a rendering looks whether it is still wanted."""


@runtime_checkable
class FieldSource(Protocol):
    """Renders the field; `revision` counts how often it has changed."""

    @property
    def revision(self) -> int:
        """Changes when the field does."""
        ...

    @property
    def has_base(self) -> bool:
        """Whether the avatar is known to have a pose-independent branch."""
        ...

    def render(self, posed: BodyPose, camera: Camera, wanted: Callable[[], bool]) -> RenderedImage | None:
        """The field in a pose from a camera, on `PAPER`; None once `wanted` says no."""
        ...


@torch.no_grad()
def render_pose(
    avatar: Avatar, posed: BodyPose, camera: Camera, wanted: Callable[[], bool] = lambda: True
) -> RenderedImage | None:
    """The avatar in a pose on `PAPER`, strip by strip; a training frame with its learned corrections and codes."""
    if posed.frame is not None and posed.trained:
        frame = posed.frame
        ready = avatar.pose(frame.pose, frame.translation, frame.frame_index)
    else:
        ready = avatar.pose(posed.pose, posed.translation)
    parts: list[RenderedImage] = []
    for _, strip in strips(camera, max(1, _STRIP // camera.width)):
        if not wanted():
            return None
        parts.append(render_image(avatar, ready, strip, torch.tensor(PAPER)))
    return joined(parts)


def joined(parts: list[RenderedImage]) -> RenderedImage:
    """Strips, from the top, as one image."""
    bases = [part.base_opacity for part in parts if part.base_opacity is not None]
    return RenderedImage(
        color=torch.cat([part.color for part in parts]),
        opacity=torch.cat([part.opacity for part in parts]),
        depth=torch.cat([part.depth for part in parts]),
        normal=torch.cat([part.normal for part in parts]),
        base=torch.cat([part.base for part in parts]),
        base_normal=torch.cat([part.base_normal for part in parts]),
        base_opacity=torch.cat(bases) if len(bases) == len(parts) else None,
    )


@final
class TrainedField:
    """The field of an avatar that no longer changes, rendered on the thread that asks; one rendering at a time."""

    revision = 0

    def __init__(self, avatar: Avatar, has_base: bool) -> None:
        self.avatar, self.has_base = avatar, has_base
        self._lock = threading.Lock()

    @contextmanager
    def used_elsewhere(self) -> Generator[Callable[[], None], None, None]:
        """Keeps renderings out while the block lasts: the avatar is used for something else.

        The function it gives lets those in that are waiting.
        """

        def pause() -> None:
            self._lock.release()
            time.sleep(0.002)  # else this thread would take the lock again before another one wakes
            self._lock.acquire()

        with self._lock:
            yield pause

    def render(self, posed: BodyPose, camera: Camera, wanted: Callable[[], bool]) -> RenderedImage | None:
        """See `FieldSource`."""
        with self._lock:
            return render_pose(self.avatar, posed, camera, wanted)


@dataclass
class _Request:
    posed: BodyPose
    camera: Camera
    wanted: Callable[[], bool]
    done: threading.Event
    image: RenderedImage | None = None


@final
class TrainingField:
    """The field of an avatar in training: the training's thread renders what was requested, between two steps.

    Args:
        share: of the time that rendering may take.
        clock: seconds.
    """

    def __init__(self, share: float = 0.2, clock: Callable[[], float] = time.monotonic) -> None:
        self.share, self._clock = share, clock
        self.revision, self.has_base = 0, False
        self._avatar: Avatar | None = None
        self._pending: _Request | None = None
        self._lock = threading.Lock()
        self._resume_at = -1.0
        self._closed = False

    def attach(self, avatar: Avatar) -> None:
        """The avatar that is trained."""
        self._avatar = avatar

    def close(self) -> None:
        """The training is over: nobody serves requests any more."""
        with self._lock:
            self._closed = True
            if self._pending is not None:
                self._pending.done.set()

    def render(self, posed: BodyPose, camera: Camera, wanted: Callable[[], bool]) -> RenderedImage | None:
        """See `FieldSource`; waits until the training has made a pause."""
        request = _Request(posed, camera, wanted, threading.Event())
        with self._lock:
            if self._closed or self._avatar is None:
                return None
            self._pending = request
        while not request.done.wait(0.05):
            if not wanted():
                with self._lock:
                    if self._pending is request:
                        self._pending = None
                        return None
        return request.image

    def between_steps(self) -> None:
        """Called by the training after each step: the field is another one; renders what is due."""
        self.revision += 1
        if self._avatar is None or self._clock() < self._resume_at:
            return
        with self._lock:
            request, self._pending = self._pending, None
        if request is None:
            return
        began = self._clock()
        self._avatar.eval()
        try:
            if request.wanted():
                request.image = render_pose(self._avatar, request.posed, request.camera)
                self.has_base = request.image is not None and request.image.base_opacity is not None
        finally:
            self._avatar.train()
            request.done.set()
        spent = self._clock() - began
        self._resume_at = self._clock() + spent * (1 - self.share) / self.share
