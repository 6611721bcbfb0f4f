"""A viewer that runs: server, panel, loop, bake, and what is saved."""

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, final

from twofold.errors import TwofoldError
from twofold.viewer.browser import Browser, first_view
from twofold.viewer.camera_path import KeyView, path_cameras, save_path
from twofold.viewer.field_source import FieldSource, TrainedField
from twofold.viewer.live import ALL_ROWS, FIRST_ROWS, ViewLoop
from twofold.viewer.meshes import Meshes
from twofold.viewer.panel import REFRESH, Panel
from twofold.viewer.saving import best_image, next_name, save_glb, save_image, save_path_video, save_pose
from twofold.viewer.scene_state import SceneState
from twofold.viewer.server import open_server, stop_server
from twofold.viewer.viewed import Viewed

_PATH_SECONDS, _PATH_FPS = 2.0, 30.0
"""Of a camera path, between two key views."""


@final
class ViewSession:
    """A viewer that is open. Use it in a `with` block.

    Args:
        viewed: what is viewed.
        host: address to listen on.
        port: from `choose_port`.
        out: folder for what is saved.
        source: renders the field; None renders it where there is an avatar, on a thread of its own.
        bake: whether the avatar is baked; a training's is not.

    Raises:
        TwofoldError: the package viser is missing.
    """

    def __init__(
        self, viewed: Viewed, host: str, port: int, out: Path, source: FieldSource | None = None, bake: bool = True
    ) -> None:
        self.viewed, self.out = viewed, out
        self.state = SceneState(viewed.body, viewed.turn, viewed.timelines)
        self.meshes = Meshes(viewed)
        if not bake:
            self.meshes.note = "The bare body moves; the field is rendered between training steps."
        self._trained: TrainedField | None = None
        if source is None and viewed.avatar is not None:
            self._trained = TrainedField(viewed.avatar, viewed.has_base)
        self.source: FieldSource | None = source or self._trained
        # While an avatar is trained, time spent on large images is missing there.
        rows = (FIRST_ROWS, ALL_ROWS) if source is None else (FIRST_ROWS,)
        self.loop = ViewLoop(self.state, self.meshes, self.source, rows, failed=lambda said: self.panel.tell(said))
        self.saved: list[Path] = []
        self.keys: list[KeyView] = []
        self.browsers: dict[int, Browser] = {}
        self._bake = bake and viewed.avatar is not None
        self._closed = threading.Event()
        self._saving = threading.Lock()
        self.server: Any = open_server(host, port, viewed.title)
        self.address = f"http://{host}:{self.server.get_port()}"
        self._arrange()

    def __enter__(self) -> "ViewSession":
        self.loop.start()
        threading.Thread(target=self._follow, name="panel", daemon=True).start()
        if self._bake:
            threading.Thread(target=self._bake_meshes, name="bake", daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closed.set()
        self.loop.stop()
        stop_server(self.server)

    def _arrange(self) -> None:
        scene, up = self.server.scene, tuple(self.viewed.up.tolist())
        scene.set_up_direction(up)
        scene.world_axes.visible = False
        scene.configure_default_lights(enabled=False, cast_shadow=False)  # nothing in the scene is lit
        scene.configure_environment_map(None)
        first = first_view(self.viewed)
        initial = self.server.initial_camera
        initial.position, initial.look_at, initial.up, initial.fov = first.eye, first.target, first.up, first.fov
        self.panel = Panel(self.server, self.viewed, self.state, self.meshes, self.source)
        self._add_saving()
        self.server.on_client_connect(self._connected)
        self.server.on_client_disconnect(lambda client: self._left(client.client_id))

    def _connected(self, client: Any) -> None:
        browser = Browser(client, self._wants_depth, self.panel.note, self.loop.wake)
        self.browsers[client.client_id] = browser
        self.loop.seat(client.client_id, browser)
        client.camera.on_update(lambda _: self.loop.camera_moved(client.client_id))

    def _left(self, key: int) -> None:
        self.loop.leave(key)
        if (browser := self.browsers.pop(key, None)) is not None:
            browser.leave()

    def _wants_depth(self) -> bool:
        return bool(self.panel.frustums.value)

    def _follow(self) -> None:
        # Redrawing widgets costs the browser time that images need while a motion is played.
        while not self._closed.wait(4 * REFRESH if self.state.playing else REFRESH):
            self.panel.follow()

    def _bake_meshes(self) -> None:
        assert self._trained is not None
        with self._trained.used_elsewhere() as pause:

            def progress(done: float, note: str) -> None:
                pause()
                self.panel.progress = f"Baking: {100 * done:.0f} %, {note}" if done < 1 else ""
                self.loop.wake()

            self.meshes.bake(progress, self.panel.tell)
        self.panel.progress = ""
        self.loop.wake()

    # ---- saving

    def _add_saving(self) -> None:
        gui = self.server.gui
        with gui.add_folder("Save", expand_by_default=False):
            image, pose, glb = (gui.add_button(name) for name in ("Image (PNG)", "Pose (npz)", "Character (GLB)"))
            self.path_note = gui.add_markdown("Camera path: no key views")
            group = gui.add_button_group("Camera path", ("add", "clear", "save", "video"))
        image.on_click(lambda event: self.save(lambda: self._image(event.client.client_id)))
        pose.on_click(lambda _: self.save(lambda: save_pose(self.out, self.viewed, self.state)))
        glb.on_click(lambda _: self.save(lambda: save_glb(self.out, self.viewed, self.state, self.meshes)))
        group.on_click(lambda event: self.path_button(event.target.value, event.client.client_id))

    def save(self, write: Callable[[], Path]) -> Path | None:
        """Saves something, and says where it is or why it is not."""
        with self._saving:
            try:
                path = write()
            except TwofoldError as error:
                self.panel.tell(str(error))
                return None
        self.saved.append(path)
        self.panel.tell(f"Saved {path}")
        return path

    def _image(self, key: int) -> Path:
        camera = self.browsers[key].camera()
        if camera is None:
            raise TwofoldError("The browser has not said how large its view is; move the camera and try again.")
        _, shown = self.state.shown()
        return save_image(self.out, best_image(shown, camera, self.meshes, self.source))

    def path_button(self, what: str, key: int) -> None:
        """A button of the camera path: "add", "clear", "save" or "video"."""
        if what == "add":
            self.keys.append(self.browsers[key].key_view())
        elif what == "clear":
            self.keys.clear()
        elif what == "save":
            self.save(lambda: self._path(key))
        else:
            self.save(lambda: self._path_video(key))
        count = len(self.keys)
        self.path_note.content = f"Camera path: {count or 'no'} key view{'' if count == 1 else 's'}"

    def _cameras(self, key: int) -> list[Any]:
        seen = self.browsers[key].camera()
        height, width = (512, 512) if seen is None else (seen.height, seen.width)
        frames = 1 + round(_PATH_SECONDS * _PATH_FPS * max(len(self.keys) - 1, 1))
        return path_cameras(self.keys, frames, height, width)

    def _path(self, key: int) -> Path:
        path = next_name(self.out, "path", ".json")
        save_path(path, self._cameras(key), _PATH_FPS)
        return path

    def _path_video(self, key: int) -> Path:
        _, shown = self.state.shown()
        return save_path_video(self.out, self._cameras(key), _PATH_FPS, shown, self.meshes)

    def wait(self) -> None:
        """Stays until Ctrl-C."""
        try:
            while True:
                time.sleep(3600)
        except KeyboardInterrupt:
            return
