"""The panel of a viewer: widgets that change the state, and follow it."""

import math
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, final

import torch

from twofold.body.builtin_motions import BUILTIN_MOTIONS
from twofold.body.motion_files import READERS
from twofold.body.skeleton import JOINT_NAMES
from twofold.errors import TwofoldError
from twofold.viewer.body_pose import joint_ranges
from twofold.viewer.field_source import FieldSource
from twofold.viewer.meshes import Meshes
from twofold.viewer.scene_objects import CaptureCameras, JointGizmo
from twofold.viewer.scene_state import SceneState
from twofold.viewer.view_images import PARTS, QUANTITIES
from twofold.viewer.viewed import Viewed, named_motion

REFRESH = 0.1
"""Seconds between two looks whether the widgets have to follow the state."""
_POSED, _CANONICAL = "posed", "canonical"


@final
class Panel:
    """The widgets that choose what is shown; `follow` has them show the state, whoever changed it.

    Args:
        server: viser's.
        viewed: what is viewed.
        state: that is changed.
        meshes: that move.
        source: renders the field; None where there is no avatar.
    """

    def __init__(
        self, server: Any, viewed: Viewed, state: SceneState, meshes: Meshes, source: FieldSource | None
    ) -> None:
        self.server, self.viewed, self.state, self.meshes, self.source = server, viewed, state, meshes, source
        self._seen = -1
        self._noted = ""
        self._line = ""
        self.progress = ""
        self._following = threading.Lock()
        self.status = server.gui.add_markdown("")
        self._add_show()
        self._add_motion()
        self._add_pose()
        self.gizmo = JointGizmo(server, state, self.follow)
        self.cameras = None if viewed.capture is None else CaptureCameras(server, viewed.capture)
        self.follow()

    # ---- widgets

    def _add_show(self) -> None:
        gui = self.server.gui
        with gui.add_folder("Show"):
            self.part = gui.add_dropdown("Branch", PARTS, visible=self._has_base)
            self.quantity = gui.add_dropdown("As", QUANTITIES)
            self.space = gui.add_dropdown("Space", (_POSED, _CANONICAL))
            self.still = gui.add_checkbox(
                "Field when still", True, visible=self.source is not None,
                hint="Renders the avatar's field once nothing moves; otherwise the mesh stays.",
            )  # fmt: skip
            captured = self.viewed.capture is not None
            self.frustums = gui.add_checkbox("Cameras", False, visible=captured, hint="Blue ones were trained on.")
            self.images = gui.add_checkbox("Their images", True, visible=captured)
        _on_update(self.part, lambda value: self.state.show(part=value))
        _on_update(self.quantity, lambda value: self.state.show(quantity=value))
        _on_update(self.space, self.state.show_space)
        _on_update(self.still, lambda value: self.state.show(still=value))
        _on_update(self.frustums, lambda _: self.follow(True))
        _on_update(self.images, lambda _: self.follow(True))

    def _add_motion(self) -> None:
        gui, timeline = self.server.gui, self.state.timeline
        with gui.add_folder("Motion"):
            self.timeline = gui.add_dropdown("Motion", tuple(self.state.timelines) + tuple(BUILTIN_MOTIONS))
            self.frame = gui.add_slider("Frame", 0, max(1, len(timeline) - 1), 1, 0, disabled=len(timeline) < 2)
            self.play = gui.add_checkbox("Play", False)
            self.upload = gui.add_upload_button("Open a motion file", hint=f"{' or '.join(READERS)}")
        _on_update(self.timeline, self._choose)
        _on_update(self.frame, self._scrub)
        _on_update(self.play, lambda value: self.state.play(time.monotonic()) if value else self.state.stop())
        self.upload.on_upload(lambda event: self.opened(event.target.value.name, event.target.value.content))

    def _add_pose(self) -> None:
        gui = self.server.gui
        with gui.add_folder("Pose", expand_by_default=False):
            self.joint = gui.add_dropdown("Joint", JOINT_NAMES, initial_value="left_shoulder")
            self.with_gizmo = gui.add_checkbox("Gizmo", False, hint="Rings that turn the joint; arrows at the pelvis.")
            self.angles = [
                gui.add_slider(f"{axis} (degrees)", -180.0, 180.0, 1.0, 0.0, hint="Component of the rotation vector.")
                for axis in "xyz"
            ]
            buttons = gui.add_button_group("Reset", ("joint", "pose", "T-pose"))
        _on_update(self.joint, lambda _: self.follow(True))
        _on_update(self.with_gizmo, lambda _: self.follow(True))
        for slider in self.angles:
            _on_update(slider, lambda _: self._bend())
        buttons.on_click(lambda event: self.reset(event.target.value))

    # ---- changes by hand

    def _choose(self, name: str) -> None:
        try:
            timeline = self.state.timelines.get(name) or named_motion(self.viewed, name)
        except TwofoldError as error:
            self.tell(str(error))
            return
        self.state.choose_timeline(timeline)
        self.follow()

    def _scrub(self, frame: int) -> None:
        self.state.stop()
        self.state.scrub(frame)
        self.follow()

    def _bend(self) -> None:
        angles = torch.tensor([math.radians(slider.value) for slider in self.angles])
        self.state.set_joint(self.chosen_joint, angles)
        self.follow()

    def opened(self, name: str, content: bytes) -> None:
        """Takes over a motion file that a browser sent."""
        ending = Path(name).suffix.lower()
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / f"{Path(name).stem[:60] or 'motion'}{ending}"
            file.write_bytes(content)
            try:
                timeline = named_motion(self.viewed, file)
            except TwofoldError as error:
                self.tell(str(error).replace(str(file), name))
                return
        self.state.choose_timeline(timeline)
        self.follow()

    def reset(self, what: str) -> None:
        """Takes back edits: of the "joint", of the whole "pose"; or stands in the "T-pose"."""
        if what == "joint":
            self.state.reset_joint(self.chosen_joint)
        elif what == "pose":
            self.state.reset_pose()
        else:
            self.state.rest_pose()
        self.follow()

    @property
    def _has_base(self) -> bool:
        """Whether there are branches to choose from."""
        return self.source is not None and self.source.has_base

    @property
    def chosen_joint(self) -> int:
        """The joint that sliders and gizmo turn."""
        return JOINT_NAMES.index(self.joint.value)

    # ---- following the state

    def follow(self, anew: bool = False) -> None:
        """Has all widgets show the state; nothing happens where they do, unless `anew`."""
        with self._following:
            version = self.state.version
            if version != self._seen or anew:
                self._seen = version
                self._follow_motion()
                self._follow_pose()
            self._follow_notes()

    def _follow_motion(self) -> None:
        timeline = self.state.timeline
        names = dict.fromkeys((*self.state.timelines, *BUILTIN_MOTIONS))
        if tuple(names) != tuple(self.timeline.options):
            self.timeline.options = tuple(names)
        _set(self.timeline, timeline.name)
        last = max(1, len(timeline) - 1)
        if self.frame.max != last:
            self.frame.max = last
            self.frame.disabled = len(timeline) < 2
        _set(self.frame, self.state.frame)
        _set(self.play, self.state.playing)
        if self.cameras is not None:
            shown = timeline.poses[self.state.frame].frame
            index = None if shown is None else shown.frame_index
            self.cameras.show(self.frustums.value, self.images.value, index)

    def _follow_pose(self) -> None:
        joint = self.chosen_joint
        rotation = self.state.pose.pose[joint]
        ranges = joint_ranges(joint, rotation)
        for slider, angle, (least, largest) in zip(self.angles, rotation.tolist(), ranges, strict=True):
            low, high = round(math.degrees(least), 1), round(math.degrees(largest), 1)
            if (slider.min, slider.max) != (low, high):
                slider.min, slider.max = low, high
            _set(slider, round(math.degrees(angle), 1))
        posed = self.state.space == _POSED
        self.gizmo.show(joint if self.with_gizmo.value and posed else None)

    # ---- notes

    def note(self, text: str) -> None:
        """How the last image was made."""
        self._line = text

    def tell(self, text: str) -> None:
        """Something that happened, for everybody who watches."""
        self._noted = text
        for client in self.server.get_clients().values():
            client.add_notification("twofold", text, auto_close_seconds=12)
        self.follow()

    def _follow_notes(self) -> None:
        timeline = self.state.timeline
        label = timeline.labels[self.state.frame] if timeline.labels else str(self.state.frame)
        place = f"{timeline.name}, frame {label}" + (", edited" if self.state.edited else "")
        notes = (place, self._line, self.progress, *self.viewed.notes, self.meshes.note, self._noted)
        text = "  \n".join(_plain(note) for note in notes if note)
        if self.status.content != text:
            self.status.content = text
        if self.part.visible != self._has_base:  # a training learns it with its first rendering
            self.part.visible = self._has_base


def _plain(text: str) -> str:
    """Text that Markdown shows as it is."""
    return "".join(f"\\{sign}" if sign in "\\`*_{}[]<>#|" else sign for sign in text)


def _on_update(widget: Any, change: Callable[[Any], object]) -> None:
    """Calls `change` with a widget's value where a person changed it, not where the program did."""

    @widget.on_update
    def _(event: Any) -> None:
        if event.client_id is not None:
            change(event.target.value)


def _set(widget: Any, value: Any) -> None:
    if widget.value != value:
        widget.value = value
