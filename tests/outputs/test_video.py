"""Videos are read back: size, rate, order and colours."""

import os
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from twofold.errors import TwofoldError
from twofold.outputs.video import write_alpha_video, write_video

COLORS = np.array([[200, 30, 40], [20, 180, 60], [30, 60, 220], [240, 240, 240], [10, 10, 10]], dtype=np.uint8)


def flat_frames(height: int, width: int) -> list[np.ndarray]:
    return [np.broadcast_to(color, (height, width, 3)).copy() for color in COLORS]


def read_back(path: Path) -> list[np.ndarray]:
    with av.open(str(path)) as file:
        return [frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)]


@pytest.mark.parametrize(("height", "width"), [(64, 48), (65, 47), (31, 90)])
def test_frames_come_back_in_order_with_their_colors(tmp_path: Path, height: int, width: int) -> None:
    path = tmp_path / "turn.mp4"
    write_video(path, iter(flat_frames(height, width)), fps=25)
    back = read_back(path)
    assert len(back) == len(COLORS)
    for frame, color in zip(back, COLORS, strict=True):
        assert frame.shape == (height + height % 2, width + width % 2, 3)
        assert np.abs(frame.astype(int) - color).max() <= 4


def test_players_are_told_rate_format_and_color_matrix(tmp_path: Path) -> None:
    path = tmp_path / "turn.mp4"
    write_video(path, flat_frames(32, 32), fps=30_000 / 1001)
    with av.open(str(path)) as file:
        stream = file.streams.video[0]
        assert stream.average_rate == Fraction(30_000, 1001)
        assert stream.codec_context.name == "h264"
        assert stream.codec_context.pix_fmt == "yuv420p"
        assert stream.codec_context.colorspace == 1, "BT.709"
        assert stream.codec_context.color_range == 1, "limited range"
    content = path.read_bytes()
    assert content.index(b"moov") < content.index(b"mdat"), "a browser can play it before it is all there"


def test_added_column_repeats_the_last(tmp_path: Path) -> None:
    image = np.zeros((33, 33, 3), dtype=np.uint8)
    image[:, 16:] = 200
    write_video(tmp_path / "v.mp4", [image], fps=10)
    (back,) = read_back(tmp_path / "v.mp4")
    assert np.abs(back[:, 33].astype(int) - 200).max() <= 4


def test_codec_without_x264_still_gives_a_video(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(av, "codecs_available", av.codecs_available - {"libx264"})
    write_video(tmp_path / "v.mp4", flat_frames(64, 48), fps=25)
    with av.open(str(tmp_path / "v.mp4")) as file:
        assert file.streams.video[0].codec_context.name == "mpeg4"
    for frame, color in zip(read_back(tmp_path / "v.mp4"), COLORS, strict=True):
        assert np.abs(frame.astype(int) - color).max() <= 8


def test_failing_midway_leaves_the_old_video_as_it_was(tmp_path: Path) -> None:
    path = tmp_path / "v.mp4"
    path.write_bytes(b"the old one")

    def frames() -> Iterator[np.ndarray]:
        yield from flat_frames(32, 32)
        raise RuntimeError("rendering failed")

    with pytest.raises(RuntimeError, match="rendering failed"):
        write_video(path, frames(), fps=25)
    assert path.read_bytes() == b"the old one"
    assert list(tmp_path.iterdir()) == [path]


def test_wrong_frames_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="at least one frame"):
        write_video(tmp_path / "v.mp4", [], fps=25)
    with pytest.raises(ValueError, match=r"a frame of the video is \(32, 34\), the first was \(32, 32\)"):
        write_video(tmp_path / "v.mp4", [*flat_frames(32, 32), *flat_frames(32, 34)], fps=25)
    assert not list(tmp_path.iterdir())


def test_missing_folder_is_one_clear_sentence(tmp_path: Path) -> None:
    with pytest.raises(TwofoldError, match="Cannot write"):
        write_video(tmp_path / "none" / "v.mp4", flat_frames(32, 32), fps=25)


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity") or len(os.sched_getaffinity(0)) < 2, reason="one processor")
@pytest.mark.parametrize("write", [write_video, write_alpha_video])
def test_the_same_frames_give_the_same_bytes_on_any_number_of_processors(tmp_path: Path, write) -> None:
    channels = 4 if write is write_alpha_video else 3
    random = np.random.default_rng(0)
    frames = [random.integers(0, 256, (128, 160, channels), dtype=np.uint8) // (1 + i % 3) for i in range(24)]
    ending = "webm" if channels == 4 else "mp4"
    every = os.sched_getaffinity(0)
    try:
        for number, processors in enumerate((every, {min(every)}, every)):
            os.sched_setaffinity(0, processors)
            write(tmp_path / f"{number}.{ending}", iter(frames), 12)
    finally:
        os.sched_setaffinity(0, every)
    first, second, third = ((tmp_path / f"{number}.{ending}").read_bytes() for number in range(3))
    assert first == second == third
