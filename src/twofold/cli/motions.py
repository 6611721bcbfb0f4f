"""Commands that play motions: `twofold motion`, and `twofold render RUN --motion`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from twofold.cli.advice import require_capture
from twofold.cli.console import bar, console, say, tell, within


@dataclass(frozen=True)
class MotionView:
    """What `twofold render` shows of a motion."""

    motion: str | None = None
    """Renders a motion instead: a .bvh or .npz file (AMASS, SMPL, AIST++), or walk, turn, dance, range-of-motion."""
    mesh: bool = False
    """Renders the baked mesh instead of the field: quick, after half a minute of baking. Also without --motion."""
    follow: bool = False
    """The camera goes along; otherwise it stands where it sees the whole motion."""
    fps: float | None = None
    """Frames per second; by default the motion's own."""
    up: Literal["y", "z"] | None = None
    """Axis that points up in the file; by default it is found."""
    units: Literal["m", "cm"] | None = None
    """Of the file's lengths; by default found (BVH) or metres."""
    start_at_origin: bool = False
    """Moves the first frame over the origin."""
    background: str | None = None
    """A colour such as white, #20a0ff or 0.1,0.2,0.3; by default black."""
    alpha: bool = False
    """PNG images with opacity, or a video with opacity where --out ends in .webm or .mov."""


NO_MOTION = MotionView()


def motion(
    source: Annotated[str, tyro.conf.Positional],
    out: Path | None = None,
    follow: bool = False,
    fps: float | None = None,
    up: Literal["y", "z"] | None = None,
    units: Literal["m", "cm"] | None = None,
    start_at_origin: bool = False,
    size: int = 512,
    background: str = "#eceef3",
    body: str = "anny",
) -> None:
    """Report what a motion file holds, and preview it on the free body as a video.

    Args:
        source: A .bvh or .npz file (AMASS, SMPL, AIST++), or one of walk, turn, dance, range-of-motion.
        out: Video to write; by default NAME-preview.mp4 in the current folder.
        follow: The camera goes along; otherwise it stands where it sees the whole motion.
        fps: Frames per second; by default the motion's own, at most 60.
        up: Axis that points up in the file; by default it is found.
        units: Of the file's lengths; by default found (BVH) or metres.
        start_at_origin: Moves the first frame over the origin.
        size: Rows and columns of the video, 16 to 4096.
        background: A colour such as white, #20a0ff or 0.1,0.2,0.3.
        body: anny, or your own SMPL file.
    """
    from twofold.body.motion import resampled
    from twofold.body.motion_files import MotionOptions, read_motion
    from twofold.body.skeleton import shape_body
    from twofold.outputs.motion_cameras import motion_cameras
    from twofold.outputs.motion_video import body_renderer, read_color, require_video_path, write_motion
    from twofold.prepare.pipeline import read_body

    within(size=(size, 16, 4096))
    color = read_color(background)
    if out is not None:
        require_video_path(out, alpha=False)
    model = read_body(body)
    shaped = shape_body(model, model.shape_basis.new_zeros(model.shape_basis.shape[-1]))
    read = read_motion(source, shaped, MotionOptions(fps, up, units, start_at_origin), model)
    for line in read.lines():
        console().print(line, soft_wrap=True)
    moved = read.motion if fps is not None or read.motion.fps <= 60 else resampled(read.motion, 60.0)
    path = out or Path(f"{moved.name}-preview.mp4")
    cameras = motion_cameras(shaped, moved, size, follow)
    with bar("Rendering") as progress:
        renderer = body_renderer(shaped, moved, color)
        write_motion(path, moved.fps, cameras, renderer, color, progress=lambda done: progress(done, ""))
    say(f"The preview is {path}.", f"twofold render RUN --motion {source}")


def render_by_mesh(run: Path, what: str, size: int, out: Path | None, device: str, capture: Path | None) -> None:
    """Renders orbit, novel poses, front and back from the baked mesh; see `twofold render`."""
    from twofold.capture.folder import read_capture
    from twofold.outputs.export.bake_cache import open_cache
    from twofold.outputs.export.make import bake
    from twofold.outputs.export.write import require_packages, require_surface
    from twofold.outputs.mesh_gallery import render_run_by_mesh
    from twofold.outputs.mesh_motion import CONFIG
    from twofold.training.run import choose_device, find_capture, load, require_same

    require_packages(CONFIG)
    avatar, _ = load(run, choose_device(device))
    require_surface(avatar)
    source = find_capture(run, capture)
    require_capture(source)
    read = read_capture(source)
    require_same(run, read, motion=True)
    with bar("Baking") as progress:
        baked = bake(avatar, read, CONFIG, progress=progress, cache=open_cache(run, read, tell))
    folder = out or run / "renders"
    with bar("Rendering") as progress:
        written = render_run_by_mesh(baked, read, folder, what, size, lambda done: progress(done, ""))
    names = ", ".join(path.name for path in written)
    say(f"{names} in {folder}, by the mesh renderer.", f"twofold render {run}, for the field's own, finer images")


def render_motion(
    run: Path, shown: MotionView, size: int, out: Path | None, chunk: int | None, device: str, capture: Path | None
) -> None:
    """Renders an avatar in a motion; see `twofold render`."""
    from twofold.body.motion_files import MotionOptions, read_motion
    from twofold.capture.folder import read_capture
    from twofold.outputs.motion_cameras import motion_cameras
    from twofold.outputs.motion_video import (
        VIDEO_ENDINGS,
        field_renderer,
        read_color,
        require_video_path,
        rest_body,
        write_motion,
    )
    from twofold.training.run import choose_device, find_capture, load, read_subject, require_same

    name = Path(str(shown.motion)).stem
    default = run / "renders" / (f"motion-{name}" if shown.alpha else f"motion-{name}.mp4")
    path = out or default
    if not shown.alpha and path.suffix.lower() not in VIDEO_ENDINGS:
        path = path / default.name
    require_video_path(path, shown.alpha)
    color = read_color(shown.background or "black")
    avatar, _ = load(run, choose_device(device))
    body = rest_body(avatar)
    options = MotionOptions(shown.fps, shown.up, shown.units, shown.start_at_origin)
    read = read_motion(str(shown.motion), body, options, read_subject(run).body)
    for line in read.lines():
        console().print(line, soft_wrap=True)
    cameras = motion_cameras(body, read.motion, size, shown.follow)
    if shown.mesh:
        from twofold.outputs.export.bake_cache import open_cache
        from twofold.outputs.mesh_motion import mesh_renderer

        folder = find_capture(run, capture)
        require_capture(folder)
        trained_on = read_capture(folder)
        require_same(run, trained_on, motion=True)
        with bar("Baking") as progress:
            cache = open_cache(run, trained_on, tell)
            renderer = mesh_renderer(avatar, trained_on, read.motion, progress=progress, cache=cache)
    else:
        renderer = field_renderer(avatar, read.motion, chunk)
    with bar("Rendering") as progress:
        write_motion(
            path,
            read.motion.fps,
            cameras,
            renderer,
            color,
            shown.alpha,
            lambda done: progress(done, ""),
            path == default,
        )
    say(f"The motion is in {path}.", f"twofold export {run} --motion {shown.motion}")
