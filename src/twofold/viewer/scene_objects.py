"""What stands around the person: the capture's cameras with their images, and the gizmo of a joint."""

from collections.abc import Callable
from typing import Any, final

import numpy as np
import torch
from PIL import Image

from twofold.capture.types import Capture, Frame
from twofold.errors import TwofoldError
from twofold.outputs.sheets import as_bytes
from twofold.viewer.body_pose import joint_place
from twofold.viewer.scene_state import SceneState
from twofold.viewer.view_images import quaternion, view_camera

_IMAGE_ROWS = 160
_SIZE = 0.22
"""How far a camera's frustum reaches, metres."""
_TRAIN, _HELD_OUT = (40, 110, 200), (200, 120, 30)


@final
class CaptureCameras:
    """The cameras of a capture as frustums, which show what they saw in the frame at hand.

    Args:
        server: viser's.
        capture: whose cameras.
    """

    def __init__(self, server: Any, capture: Capture) -> None:
        self._server, self._capture = server, capture
        self._handles: dict[str, Any] = {}
        self._frames: dict[tuple[str, int], Frame] = {}
        self._trained = {frame.camera_name for frame in capture.train}
        for frames in capture.splits.values():
            for frame in frames:
                self._frames.setdefault((frame.camera_name, frame.frame_index), frame)
        self._shown: tuple[bool, bool, int | None] = (False, False, None)

    def show(self, visible: bool, images: bool, frame_index: int | None) -> None:
        """Shows the cameras or not, with the images of a frame (None: without) or not."""
        wanted = (visible, images, frame_index if images else None)
        if wanted == self._shown:
            return
        self._shown = wanted
        if visible and not self._handles:
            self._add()
        for name, handle in self._handles.items():
            handle.visible = visible
            if visible:
                handle.image = self._image(name, wanted[2]) if images and wanted[2] is not None else None

    def _add(self) -> None:
        cameras = {frame.camera_name: frame.camera for frame in self._frames.values()}
        for name, camera in cameras.items():
            fov = 2 * np.arctan(0.5 * camera.height / float(camera.intrinsics[1, 1]))
            self._handles[name] = self._server.scene.add_camera_frustum(
                f"/cameras/{name}", float(fov), camera.width / camera.height, scale=_SIZE,
                color=_TRAIN if name in self._trained else _HELD_OUT, thickness=0.006,
                wxyz=quaternion(camera.world_to_camera[:3, :3].T), position=camera.center.numpy(),
                cast_shadow=False, receive_shadow=False,
            )  # fmt: skip

    def _image(self, camera: str, frame_index: int) -> np.ndarray | None:
        frame = self._frames.get((camera, frame_index))
        if frame is None:
            return None
        try:
            image = Image.fromarray(as_bytes(frame.image()))
        except TwofoldError:  # damaged since the capture was read
            return None
        image.thumbnail((4 * _IMAGE_ROWS, _IMAGE_ROWS))
        return np.asarray(image)


@final
class JointGizmo:
    """Rings that turn a joint; at the pelvis also arrows that move the person.

    Args:
        server: viser's.
        state: that it changes.
        changed: called after a change by hand.
    """

    def __init__(self, server: Any, state: SceneState, changed: Callable[[], None]) -> None:
        self._server, self._state, self._changed = server, state, changed
        self._handle: Any = None
        self._joint: int | None = None
        self._held = False

    def show(self, joint: int | None) -> None:
        """Stands at a joint, or nowhere."""
        if joint != self._joint:
            self._joint = joint
            if self._handle is not None:
                self._handle.remove()
                self._handle = None
            if joint is not None:
                self._handle = self._add(joint)
        self.follow()

    def follow(self) -> None:
        """Goes to where its joint is, unless somebody holds it."""
        if self._handle is None or self._joint is None or self._held:
            return
        rotation, place = joint_place(self._state.body, self._state.pose, self._joint)
        wxyz, position = np.array(quaternion(rotation)), place.numpy()
        if not np.allclose(self._handle.wxyz, wxyz, atol=1e-5):
            self._handle.wxyz = wxyz
        if not np.allclose(self._handle.position, position, atol=1e-5):
            self._handle.position = position

    def _add(self, joint: int) -> Any:
        rotation, place = joint_place(self._state.body, self._state.pose, joint)
        handle = self._server.scene.add_transform_controls(
            "/gizmo", scale=0.28 if joint else 0.5, disable_axes=joint != 0, disable_sliders=True, depth_test=False,
            wxyz=quaternion(rotation), position=place.numpy(),
        )  # fmt: skip

        @handle.on_update
        def _(event: Any) -> None:
            self._held = event.phase != "end"
            if event.phase != "start":
                self.apply(handle.wxyz, handle.position)

        return handle

    def apply(self, wxyz: np.ndarray, position: np.ndarray) -> None:
        """Takes over where the gizmo is."""
        if self._joint is None:
            return
        turned = view_camera(np.asarray(wxyz), np.zeros(3), 1.0, 8, 8).world_to_camera[:3, :3].T
        before, _ = joint_place(self._state.body, self._state.pose, self._joint)
        if float((turned - before).abs().max()) > 1e-5:
            self._state.turn_joint(self._joint, turned.contiguous())
        if self._joint == 0:
            self._state.move_pelvis(torch.from_numpy(np.array(position, dtype=np.float32)))
        self._changed()
