"""What a viewer shows, apart from any widget: timeline, frame, pose, part, quantity, space; safe between threads."""

import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, final

import torch
from jaxtyping import Float
from torch import Tensor

from twofold.body.skeleton import ShapedBody
from twofold.viewer.body_pose import BodyPose, canonical_like, with_pelvis_at, with_world_rotation
from twofold.viewer.timeline import Timeline
from twofold.viewer.view_images import Part, Quantity

Space = Literal["posed", "canonical"]


@dataclass(frozen=True)
class Shown:
    """Everything that an image of the person depends on, apart from the camera.

    Attributes:
        pose: in which the person is shown; in canonical space that pose.
        part: of the avatar.
        quantity: of the surface.
        still: whether the field is rendered once nothing moves.
    """

    pose: BodyPose
    part: Part = "full"
    quantity: Quantity = "colour"
    still: bool = True

    @property
    def wants_field(self) -> bool:
        """Whether the field can show this; it has no skinning weights."""
        return self.still and self.quantity != "skinning weights"


@final
class SceneState:
    """The state of a viewer. Each change raises `version` and calls what `on_change` was given.

    Args:
        body: in the T-pose.
        turn: rotation from a world with y up to the world that is shown.
        timelines: at least one; the first frame of the first one is shown.
    """

    def __init__(self, body: ShapedBody, turn: Float[Tensor, "3 3"], timelines: tuple[Timeline, ...]) -> None:
        self.body, self.turn = body, turn
        self.timelines = {timeline.name: timeline for timeline in timelines}
        self._lock = threading.RLock()
        self._listeners: list[Callable[[], None]] = []
        self._timeline = timelines[0]
        self._frame = 0
        self._space: Space = "posed"
        self._shown = Shown(timelines[0].poses[0])
        self._version = 0
        self._playing_since: float | None = None

    def on_change(self, listener: Callable[[], None]) -> None:
        """Has a function called after each change, on the thread that made it."""
        self._listeners.append(listener)

    @property
    def version(self) -> int:
        """How many changes there were."""
        return self._version

    @property
    def timeline(self) -> Timeline:
        """What is scrubbed."""
        return self._timeline

    @property
    def frame(self) -> int:
        """The frame of the timeline that was shown last."""
        return self._frame

    @property
    def pose(self) -> BodyPose:
        """The pose that is edited, whatever space is shown."""
        return self._shown.pose

    @property
    def edited(self) -> bool:
        """Whether the pose differs from the timeline's frame."""
        return self._shown.pose is not self._timeline.poses[self._frame]

    def shown(self) -> tuple[int, Shown]:
        """The version, and what it shows."""
        with self._lock:
            shown = self._shown
            if self._space == "canonical":
                shown = replace(shown, pose=canonical_like(shown.pose, self.turn))
            return self._version, shown

    def choose_timeline(self, timeline: Timeline) -> None:
        """Shows the first frame of a timeline, which from now on can be chosen by name."""
        with self._lock:
            self.timelines[timeline.name] = timeline
            self._timeline, self._frame, self._playing_since = timeline, 0, None
            self._set(replace(self._shown, pose=timeline.poses[0]))

    def scrub(self, frame: int) -> None:
        """Shows a frame of the timeline; edits of the pose are lost."""
        with self._lock:
            self._frame = min(max(frame, 0), len(self._timeline) - 1)
            self._set(replace(self._shown, pose=self._timeline.poses[self._frame]))

    def play(self, now: float) -> None:
        """Begins to play from the present frame; `tick` shows what is due.

        Args:
            now: a clock's time, seconds.
        """
        with self._lock:
            self._playing_since = now - self._timeline.begins(self._frame)

    def stop(self) -> None:
        """Stays at the present frame."""
        self._playing_since = None

    @property
    def playing(self) -> bool:
        """Whether the timeline is played."""
        return self._playing_since is not None

    def tick(self, now: float) -> bool:
        """Shows the frame that is due at a time while playing; tells whether it is another one than before."""
        with self._lock:
            if self._playing_since is None:
                return False
            due = self._timeline.at(now - self._playing_since)
            if due == self._frame and not self.edited:
                return False
            self.scrub(due)
            return True

    def show(self, part: Part | None = None, quantity: Quantity | None = None, still: bool | None = None) -> None:
        """Changes what is shown of the person."""
        with self._lock:
            shown = self._shown
            self._set(
                replace(
                    shown, part=part or shown.part, quantity=quantity or shown.quantity,
                    still=shown.still if still is None else still,
                )
            )  # fmt: skip

    @property
    def space(self) -> Space:
        """Whether the person is shown posed or in the canonical pose."""
        return self._space

    def show_space(self, space: Space) -> None:
        """Shows the person posed or in the canonical pose."""
        with self._lock:
            self._space = space
            self._set(self._shown)

    def set_joint(self, joint: int, rotation: Float[Tensor, "3"]) -> None:
        """Gives a joint another rotation vector, radians."""
        with self._lock:
            self._playing_since = None
            self._set(replace(self._shown, pose=self.pose.with_joint(joint, rotation)))

    def turn_joint(self, joint: int, rotation: Float[Tensor, "3 3"]) -> None:
        """Gives a joint another world rotation; what hangs below turns with it."""
        with self._lock:
            self._playing_since = None
            self._set(replace(self._shown, pose=with_world_rotation(self.body, self.pose, joint, rotation)))

    def move_pelvis(self, place: Float[Tensor, "3"]) -> None:
        """Moves the person until the pelvis is at a place, metres."""
        with self._lock:
            self._playing_since = None
            self._set(replace(self._shown, pose=with_pelvis_at(self.body, self.pose, place)))

    def reset_joint(self, joint: int) -> None:
        """Gives a joint the rotation that it has in the timeline's frame."""
        self.set_joint(joint, self._timeline.poses[self._frame].pose[joint])

    def reset_pose(self) -> None:
        """Shows the timeline's frame as it is."""
        self.scrub(self._frame)

    def rest_pose(self) -> None:
        """The T-pose, upright, where the person stands."""
        with self._lock:
            self._playing_since = None
            pose = canonical_like(self.pose, self.turn)
            limbs = torch.zeros(3)
            self._set(replace(self._shown, pose=pose.with_joint(1, limbs).with_joint(2, limbs)))

    def _set(self, shown: Shown) -> None:
        self._shown = shown
        self._version += 1
        for listener in self._listeners:
            listener()
