"""What is viewed: a run with its capture, a run whose capture is gone, or a capture alone."""

from dataclasses import dataclass, field
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from twofold.body.motion_files import MotionOptions, read_motion
from twofold.body.skeleton import Body, ShapedBody, shape_body
from twofold.capture.folder import read_capture
from twofold.capture.types import Capture
from twofold.geometry.cameras import Camera
from twofold.methods.base import Avatar
from twofold.outputs.export.animations import upright
from twofold.outputs.motion_video import rest_body
from twofold.outputs.views import look_at, render_image
from twofold.training.run import load, read_subject, require_same
from twofold.viewer.body_pose import BodyPose
from twofold.viewer.timeline import Timeline, motion_timeline, split_timelines


@dataclass(frozen=True)
class Viewed:
    """What is viewed.

    Attributes:
        title: for the panel.
        body: in the T-pose.
        model: its body model.
        turn: rotation from a world with y up to the world that is shown, which is the capture's.
        timelines: of the capture's splits, at least one; the first one is shown at first.
        capture: for cameras, images and the bake; None where it is gone.
        avatar: None for a capture alone.
        run: the run's folder, None for a capture alone.
        has_base: whether the avatar has a pose-independent branch.
        notes: sentences about what is not there.
    """

    title: str
    body: ShapedBody
    model: Body
    turn: Float[Tensor, "3 3"]
    timelines: tuple[Timeline, ...]
    capture: Capture | None = None
    avatar: Avatar | None = None
    run: Path | None = None
    has_base: bool = False
    notes: tuple[str, ...] = field(default=())

    @property
    def up(self) -> Float[Tensor, "3"]:
        """The direction that points up in the world that is shown."""
        return self.turn[:, 1]

    @property
    def start(self) -> Float[Tensor, "3"]:
        """Where the pelvis is in the first frame, metres."""
        return self.timelines[0].poses[0].translation + self.body.joints[0]


def open_capture(folder: Path) -> Viewed:
    """A capture without an avatar: its body, motion, cameras and images.

    Raises:
        TwofoldError: the folder is no capture, or is faulty.
    """
    return view_capture(read_capture(folder))


def view_capture(capture: Capture) -> Viewed:
    """A capture that has been read, without an avatar."""
    body = shape_body(capture.body, capture.betas)
    lines = split_timelines(capture, None)
    return Viewed(capture.name, body, capture.body, upright(capture).T, tuple(lines), capture)


def open_run(run: Path, capture: Path | None, device: torch.device) -> Viewed:
    """A trained avatar, with its capture where that is still there.

    Args:
        run: its folder.
        capture: its capture; None where that is gone.
        device: where the avatar is to be.

    Raises:
        TwofoldError: the run cannot be loaded, or the capture is faulty or another one's.
    """
    read = None if capture is None else read_capture(capture)
    if read is not None:
        require_same(run, read, motion=True)
    avatar, steps = load(run, device)
    return view_run(run, avatar, read, f"{run.resolve().name}, {steps} steps")


def view_run(run: Path, avatar: Avatar, capture: Capture | None, title: str) -> Viewed:
    """An avatar of a run, with or without its capture."""
    body, model = rest_body(avatar), read_subject(run).body
    if capture is None:
        note = "The capture of this run is gone: no cameras, no images, and the bare body stands in for the baked mesh."
        turn, lines, notes = torch.eye(3), [_standing(body)], (note,)
    else:
        turn, lines, notes = upright(capture).T, split_timelines(capture, avatar), ()
    base = has_base_branch(avatar)
    return Viewed(title, body, model, turn, tuple(lines), capture, avatar, run, base, notes)


def _standing(body: ShapedBody) -> Timeline:
    return Timeline("rest pose", (BodyPose(torch.zeros(24, 3), torch.zeros(3)),), 30.0)


def named_motion(viewed: Viewed, source: Path | str) -> Timeline:
    """A motion file, or a built-in motion by its name, begun where the person stands in the first frame.

    Raises:
        TwofoldError: see `read_motion`.
    """
    read = read_motion(source, viewed.body, MotionOptions(), viewed.model)
    return motion_timeline(read.motion, viewed.body, viewed.turn, viewed.start)


@torch.no_grad()
def has_base_branch(avatar: Avatar) -> bool:
    """Whether renderings hold those of a pose-independent branch; a few rays tell."""
    posed = avatar.pose(torch.zeros(24, 3), torch.zeros(3))
    middle = posed.body.vertices.detach().cpu().mean(0)
    eye = middle + torch.tensor([0.0, 0.0, 3.0])
    intrinsics = torch.tensor([[12.0, 0.0, 3.5], [0.0, 12.0, 3.5], [0.0, 0.0, 1.0]])
    camera = Camera(look_at(eye, middle, torch.tensor([0.0, 1.0, 0.0])), intrinsics, 8, 8)
    return render_image(avatar, posed, camera, torch.ones(3)).base_opacity is not None
