import av
import numpy as np
import pytest
import torch
from little_body import little_body
from PIL import Image

from twofold.body.builtin_motions import BUILTIN_MOTIONS
from twofold.body.motion import as_single, resampled
from twofold.body.skeleton import shape_body
from twofold.errors import TwofoldError
from twofold.outputs.motion_cameras import motion_cameras
from twofold.outputs.motion_video import (
    View,
    body_renderer,
    field_renderer,
    read_color,
    require_video_path,
    rest_body,
    write_motion,
)
from twofold.training.run import load

BODY = shape_body(little_body(), torch.zeros(1))
MOTION = resampled(as_single(BUILTIN_MOTIONS["walk"](BODY)), 2.0)
CAMERAS = motion_cameras(BODY, MOTION, 48, follow=True)
WHITE = torch.ones(3)


def half_red(index, camera):
    """Premultiplied half red on the left, nothing on the right."""
    color, opacity = torch.zeros(camera.height, camera.width, 3), torch.zeros(camera.height, camera.width)
    color[:, :24, 0], opacity[:, :24] = 0.5, 0.5
    return View(color, opacity)


def test_a_video_shows_every_frame_on_the_background(tmp_path):
    shares = []
    write_motion(tmp_path / "out" / "walk.mp4", 2.0, CAMERAS, half_red, WHITE, progress=shares.append)
    with av.open(str(tmp_path / "out" / "walk.mp4")) as file:
        frames = [frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)]
        assert file.streams.video[0].average_rate == 2
    assert len(frames) == len(MOTION)
    assert np.abs(frames[0][20, 10].astype(int) - [255, 128, 128]).max() < 12
    assert np.abs(frames[0][20, 40].astype(int) - 255).max() < 6
    assert shares[-1] == 1
    assert shares == sorted(shares)


@pytest.mark.parametrize("ending", [".webm", ".mov"])
def test_videos_with_opacity_hold_straight_colours(tmp_path, ending):
    path = tmp_path / f"walk{ending}"
    write_motion(path, 2.0, CAMERAS, half_red, WHITE, alpha=True)
    with av.open(str(path)) as file:
        stream = file.streams.video[0]
        if ending == ".webm":  # the decoder that knows VP9's opacity is not the default one
            assert stream.metadata.get("alpha_mode", stream.metadata.get("ALPHA_MODE")) == "1"
            return
        frames = [frame.to_ndarray(format="rgba") for frame in file.decode(stream)]
    assert len(frames) == len(MOTION)
    assert np.abs(frames[0][20, 10].astype(int) - [255, 0, 0, 128]).max() < 12
    assert frames[0][20, 40, 3] < 4


def test_images_with_opacity_hold_straight_colours_and_replace_nothing_unasked(tmp_path):
    folder = tmp_path / "images"
    write_motion(folder, 2.0, CAMERAS, half_red, WHITE, alpha=True)
    names = sorted(path.name for path in folder.iterdir())
    assert names == [f"{k:06d}.png" for k in range(len(MOTION))]
    with Image.open(folder / names[0]) as image:
        assert image.getpixel((10, 20)) == (255, 0, 0, 128)
        assert image.getpixel((40, 20))[3] == 0
    with pytest.raises(TwofoldError, match="already holds files"):
        write_motion(folder, 2.0, CAMERAS, half_red, WHITE, alpha=True)
    write_motion(folder, 2.0, CAMERAS, half_red, WHITE, alpha=True, replace=True)


def test_a_rendering_that_fails_leaves_nothing(tmp_path):
    def broken(index, camera):
        raise TwofoldError("broken")

    for path in (tmp_path / "a.mp4", tmp_path / "b"):
        with pytest.raises(TwofoldError, match="broken"):
            write_motion(path, 2.0, CAMERAS, broken, WHITE)
    assert not list(tmp_path.iterdir())


def test_a_bare_body_stands_on_its_floor():
    view = body_renderer(BODY, MOTION, WHITE)(0, CAMERAS[0])
    assert 0.05 < float(view.opacity.mean()) < 0.5
    assert view.behind is not None
    assert view.on(WHITE)[0, 0].tolist() == [1, 1, 1]


def test_an_avatar_is_rendered_as_it_is_posed(trained):
    avatar, _ = load(trained.folder)
    body = rest_body(avatar)
    assert body.vertices.shape == avatar.pose(torch.zeros(24, 3), torch.zeros(3)).body.vertices.shape
    motion = resampled(as_single(BUILTIN_MOTIONS["turn"](body)), 0.5)
    cameras = motion_cameras(body, motion, 24)
    view = field_renderer(avatar, motion)(1, cameras[1])
    assert 0.02 < float(view.opacity.mean()) < 0.7
    assert (view.color <= view.opacity[..., None] + 0.02).all()


@pytest.mark.parametrize(
    ("text", "expected"), [("white", (1, 1, 1)), ("#000", (0, 0, 0)), ("0,0.5,1", (0, 0.5, 1)), ("#ff0000", (1, 0, 0))]
)
def test_colours_are_read(text, expected):
    assert read_color(text).tolist() == list(expected)


@pytest.mark.parametrize("text", ["whitish", "0,0.5", "1,2,3", "a,b,c", "", "nan,0,0"])
def test_what_is_no_colour_is_refused(text):
    with pytest.raises(TwofoldError, match="--background should be a colour"):
        read_color(text)


def test_places_that_cannot_hold_the_video_are_refused(tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "folder.mp4").mkdir()
    for path, alpha, words in (
        (tmp_path / "a.avi", False, "should end in .mp4"),
        (tmp_path / "a.mp4", True, "holds no opacity"),
        (tmp_path / "file", True, "is a file"),
        (tmp_path / "folder.mp4", False, "is a folder"),
    ):
        with pytest.raises(TwofoldError, match=words):
            require_video_path(path, alpha)
    require_video_path(tmp_path / "a.webm", True)
