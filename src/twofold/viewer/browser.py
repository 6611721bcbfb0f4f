"""A browser that watches: its camera, and the images it is sent."""

import contextlib
import math
import threading
import time
from collections.abc import Callable
from typing import Any, final

import numpy as np
import torch

from twofold.geometry.cameras import Camera
from twofold.geometry.rotations import axis_angle_to_matrix
from twofold.viewer.camera_path import KeyView
from twofold.viewer.view_images import ViewImage, view_camera
from twofold.viewer.viewed import Viewed

_QUALITY = 88
_PATIENCE = 2.0
"""Seconds after which the next image is sent all the same."""
ANSWERS = 2
SLOW, QUICK = 0.050, 0.033
"""Seconds from sending an image to the last answer, on average, above which a browser is slow, and below which it no
longer is. A graphics card needs two frames of its screen; software rendering spends its time on pixels."""
_MEMORY = 0.8
"""Weight of the earlier images in that average."""
_FOV = math.radians(40)
_AWAY = 2.1
"""Distance of the first view, in heights of the body."""
_NOTES_EVERY = 0.3
"""Seconds between two notes while images follow each other."""


@final
class Pace:
    """How long a browser takes to show an image.

    >>> pace = Pace()
    >>> for _ in range(20):
    ...     pace.note(0.08)
    >>> pace.slow
    True
    """

    def __init__(self) -> None:
        self.seconds = 0.0
        self.slow = False

    def note(self, seconds: float) -> None:
        """Takes one more image into the average."""
        self.seconds = _MEMORY * self.seconds + (1 - _MEMORY) * seconds
        # Between the two limits nothing changes: smaller images are shown sooner, which is no reason to go back.
        if self.seconds > SLOW or self.seconds < QUICK:
            self.slow = self.seconds > SLOW


@final
class Browser:
    """A viser client as a `Watcher`.

    Browsers decode images on the side and drop one that is not decoded yet when the next one comes. So the next image
    waits until the page has answered twice: the first answer says that it has taken the image, the second one that it
    has gone on to a further frame since.

    Args:
        client: viser's handle.
        wants_depth: whether there is anything in front of or behind the person.
        note: is given notes about how images were made.
        free: called when the browser is ready for the next image.
    """

    def __init__(
        self, client: Any, wants_depth: Callable[[], bool], note: Callable[[str], None], free: Callable[[], None]
    ) -> None:
        self._client, self._wants_depth, self._note, self._free = client, wants_depth, note, free
        self._noted = -math.inf
        self._next: tuple[ViewImage, str] | None = None
        self._changed = threading.Condition()
        self._left = False
        self._pace = Pace()
        self.sent = 0
        threading.Thread(target=self._work, name="browser", daemon=True).start()

    def ready(self) -> bool:
        """Whether it can take another image: one is on its way, the next one may be rendered meanwhile."""
        return self._next is None

    def slow(self) -> bool:
        """Whether it takes long to show an image."""
        return self._pace.slow

    def camera(self) -> Camera | None:
        """From where the browser looks; None before it has a size."""
        seen = self._client.camera
        if seen.image_height < 8 or seen.image_width < 8:
            return None
        return view_camera(seen.wxyz, seen.position, seen.fov, seen.image_height, seen.image_width)

    def key_view(self) -> KeyView:
        """The present view as one that a camera path goes through."""
        seen = self._client.camera
        eye, target, up = (np.array(v, dtype=np.float64) for v in (seen.position, seen.look_at, seen.up_direction))
        return KeyView(eye, target, up, float(seen.fov))

    def send(self, image: ViewImage, note: str) -> None:
        """Shows an image behind cameras and gizmos, in place of one that has not been sent yet."""
        with self._changed:
            self._next = (image, note)
            self._changed.notify_all()

    def leave(self) -> None:
        """The browser is gone."""
        with self._changed:
            self._left = True
            self._changed.notify_all()

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._next is not None or self._left)
                if self._left or self._next is None:
                    return
                (image, note), self._next = self._next, None
            self._free()
            self._show(image, note)

    def _show(self, image: ViewImage, note: str) -> None:
        depth, began = image.depth if self._wants_depth() else None, time.monotonic()
        self._client.scene.set_background_image(image.color, "jpeg", jpeg_quality=_QUALITY, depth=depth)
        self.sent += 1
        now = time.monotonic()
        if now - self._noted > _NOTES_EVERY or note.startswith("Field"):
            self._noted = now
            self._note(note)
        with contextlib.suppress(RuntimeError, TimeoutError):  # it has left, or it sleeps in a tab that nobody sees
            for _ in range(ANSWERS):
                self._client.local_storage.get_item("twofold", timeout=_PATIENCE)
            self._pace.note(time.monotonic() - began)


def first_view(viewed: Viewed) -> KeyView:
    """The whole person, a little from the side and from above."""
    pose = viewed.timelines[0].poses[0]
    up = viewed.up
    ahead = axis_angle_to_matrix(pose.pose[0])[:, 2]
    ahead = torch.nn.functional.normalize(ahead - (ahead @ up) * up, dim=0)
    side = torch.linalg.cross(up, ahead)
    tall = float(viewed.body.vertices[:, 1].max() - viewed.body.vertices[:, 1].min())
    middle = viewed.start + 0.02 * tall * up
    eye = middle + _AWAY * tall * (0.93 * ahead + 0.34 * side + 0.14 * up)
    return KeyView(eye.double().numpy(), middle.double().numpy(), up.double().numpy(), _FOV)
