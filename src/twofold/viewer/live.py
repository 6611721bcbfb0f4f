"""The loop behind a viewer: at once the posed mesh, and the field once nothing has moved for a while."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, final, runtime_checkable

from twofold.errors import TwofoldError
from twofold.geometry.cameras import Camera
from twofold.kernels.runtime import flush_denormals
from twofold.viewer.field_source import FieldSource
from twofold.viewer.meshes import Meshes
from twofold.viewer.scene_state import SceneState, Shown
from twofold.viewer.view_images import ViewImage, field_view, fitted_size, mesh_view

SETTLED = 0.25
"""Seconds without a change after which the field is rendered."""
FASTEST = 1 / 30
"""Seconds between two images of the mesh, at least."""
MOVING_ROWS, SLOW_ROWS = 720, 440
"""Rows of an image of the mesh while something moves, at most; and for a browser that is slow to show images."""
FIRST_ROWS, ALL_ROWS = 256, 4096
"""Rows of the field's first image, and of its last one at most."""


@runtime_checkable
class Watcher(Protocol):
    """Somebody who watches: a browser, or a test."""

    def camera(self) -> Camera | None:
        """From where; None while that is not known."""
        ...

    def ready(self) -> bool:
        """Whether it can show another image."""
        ...

    def slow(self) -> bool:
        """Whether it takes long to show one, as without a graphics card."""
        ...

    def send(self, image: ViewImage, note: str) -> None:
        """Shows an image, and a note about how it was made."""
        ...


@dataclass
class _Seat:
    """What a watcher has been shown."""

    watcher: Watcher
    moved: int = 0
    drawn: tuple[int, int, int] | None = None
    changed_at: float = 0.0
    stage: int = 0
    revision: int = -1


@final
class ViewLoop:
    """Renders for all watchers, one image after the other.

    Args:
        state: what is shown.
        meshes: that move.
        source: renders the field; None where there is no avatar.
        rows: of the field's images, one after the other.
        clock: seconds.
        failed: called with a sentence where an image could not be rendered; the loop goes on with the next change.
    """

    def __init__(
        self,
        state: SceneState,
        meshes: Meshes,
        source: FieldSource | None,
        rows: tuple[int, ...] = (FIRST_ROWS, ALL_ROWS),
        clock: Callable[[], float] = time.monotonic,
        failed: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._failed = failed
        self.state, self.meshes, self.source, self.rows = state, meshes, source, rows
        self._clock = clock
        self._seats: dict[int, _Seat] = {}
        self._wake = threading.Condition()
        self._stopped = False
        self._thread: threading.Thread | None = None
        state.on_change(self.wake)

    def seat(self, key: int, watcher: Watcher) -> None:
        """Renders for a watcher from now on."""
        self._seats[key] = _Seat(watcher)
        self.wake()

    def leave(self, key: int) -> None:
        """Renders for a watcher no more."""
        self._seats.pop(key, None)

    def camera_moved(self, key: int) -> None:
        """Notes that a watcher's camera is another one now."""
        seat = self._seats.get(key)
        if seat is not None:
            seat.moved += 1
            self.wake()

    def wake(self) -> None:
        """Has the loop look at once whether there is something to do."""
        with self._wake:
            self._wake.notify_all()

    def start(self) -> None:
        """Runs the loop on a thread."""
        self._thread = threading.Thread(target=self._run, name="view", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Ends the loop; a rendering of the field is given up."""
        self._stopped = True
        self.wake()
        if self._thread is not None:
            self._thread.join(30)

    def _run(self) -> None:
        flush_denormals()
        while not self._stopped:
            began = self._clock()
            if self._safe_step():
                time.sleep(max(0.0, FASTEST - (self._clock() - began)))
                continue
            with self._wake:
                if not self._stopped:
                    self._wake.wait(0.01 if self.state.playing else 0.1)

    def _safe_step(self) -> bool:
        """`step`; a fault ends what is being rendered, not the viewer."""
        try:
            return self.step()
        except Exception as error:
            for seat in self._seats.values():  # not the same fault again until something changes
                seat.stage, seat.revision = len(self.rows), -1 if self.source is None else self.source.revision
            said = str(error) if isinstance(error, TwofoldError) else f"{type(error).__name__}: {error}"
            self._failed(f"This could not be rendered: {said}")
            return False

    def step(self) -> bool:
        """Renders at most one image; tells whether it did."""
        now = self._clock()
        self.state.tick(now)
        for seat in list(self._seats.values()):
            if self._move(seat, now):
                return True
        return any(self._refine(seat, now) for seat in list(self._seats.values()))

    def _move(self, seat: _Seat, now: float) -> bool:
        """Shows the mesh where anything has changed."""
        version, shown = self.state.shown()
        key = (version, seat.moved, self.meshes.version)
        camera = seat.watcher.camera()
        if camera is None or seat.drawn == key or not seat.watcher.ready():
            return False
        seat.drawn, seat.changed_at, seat.stage = key, now, 0
        size = fitted_size(camera.height, camera.width, SLOW_ROWS if seat.watcher.slow() else MOVING_ROWS)
        self._show_mesh(seat, shown, camera.resized(*size), samples=1)
        return True

    def _show_mesh(self, seat: _Seat, shown: Shown, camera: Camera, samples: int) -> None:
        began = self._clock()
        character, clay = self.meshes.of(shown.part)
        image = mesh_view(character, shown.pose, camera, shown.quantity, samples, clay)
        spent = 1000 * (self._clock() - began)
        name = "Bare body" if clay else "Baked mesh"
        seat.watcher.send(image, f"{name}, {len(character.faces):,} triangles, {spent:.0f} ms")

    def _refine(self, seat: _Seat, now: float) -> bool:
        """Shows something better where nothing has changed for a while: the field, or the mesh without jagged edges."""
        _, shown = self.state.shown()
        camera = seat.watcher.camera()
        if camera is None or self.state.playing or now - seat.changed_at < SETTLED:
            return False
        if self.source is None or not shown.wants_field:
            if seat.stage > 0:
                return False
            seat.stage = 1
            self._show_mesh(seat, shown, camera, samples=2)
            return True
        if seat.stage >= len(self.rows):
            if seat.revision == self.source.revision:
                return False
            seat.stage = 0
        size = fitted_size(camera.height, camera.width, self.rows[seat.stage])
        smaller = camera.resized(*size)
        key, revision, began = seat.drawn, self.source.revision, self._clock()

        def wanted() -> bool:
            current = (self.state.version, seat.moved, self.meshes.version)
            return not self._stopped and current == key and not self.state.playing

        image = self.source.render(shown.pose, smaller, wanted)
        if image is None or not wanted():
            return False
        seconds = self._clock() - began
        note = f"Field, {size[1]} x {size[0]} pixels, {seconds:.2f} s"
        seat.watcher.send(field_view(image, smaller, shown.part, shown.quantity), note)
        # A camera that is no larger than this stage has nothing better to come.
        seat.stage = len(self.rows) if size == (camera.height, camera.width) else seat.stage + 1
        seat.revision = revision
        return True
