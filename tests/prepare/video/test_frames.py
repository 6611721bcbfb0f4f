import contextlib
import logging
import socket
import struct
import threading
import tracemalloc
import zlib

import av
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_clips import LEFT, RIGHT, UPRIGHT, UPSIDE_DOWN, corners, grey, hold_phone, real_clip, write_clip, write_sound
from PIL import Image

from twofold.errors import TwofoldError
from twofold.prepare.video.frames import Frames, describe, natural_order, nearest_to_steps, shrunk


def levels(frames) -> list[int]:
    """The grey of each image."""
    return [round(float(image.image.mean())) for image in frames]


def looks_like(found, wanted, tolerance=40) -> bool:
    """Alike but for the soft colours of a compressed video."""
    return found.shape == wanted.shape and np.mean(np.abs(found.astype(int) - wanted)) < tolerance / 4


@pytest.mark.parametrize(
    ("matrix", "quarters"),
    [(UPRIGHT, 0), (RIGHT, -1), (UPSIDE_DOWN, 2), (LEFT, 1)],
    ids=["no", "right", "down", "left"],
)
def test_a_phones_video_comes_out_upright(tmp_path, matrix, quarters):
    meant = corners()
    stored = np.ascontiguousarray(np.rot90(meant, -quarters))
    path = hold_phone(write_clip(tmp_path / "phone.mp4", [stored] * 3), matrix)

    frames = Frames(path)
    images = list(frames)

    assert (frames.info.height, frames.info.width) == meant.shape[:2]
    assert len(images) == 3
    assert all(looks_like(p.image, meant) for p in images)
    assert frames.remarks == ()


def test_a_mirrored_video_is_unmirrored(tmp_path):
    path = hold_phone(write_clip(tmp_path / "selfie.mp4", [corners()[:, ::-1].copy()] * 2), (-1, 0, 0, 1))
    assert all(looks_like(p.image, corners()) for p in Frames(path))


def test_an_odd_angle_is_said_and_left(tmp_path):
    c, s = np.cos(np.radians(20)), np.sin(np.radians(20))
    frames = Frames(hold_phone(write_clip(tmp_path / "odd.mp4", [corners()] * 2), (c, s, -s, c)))
    assert all(looks_like(p.image, corners()) for p in frames)
    assert "20 degrees" in frames.remarks[0]


def test_pixels_come_out_square(tmp_path):
    path = write_clip(tmp_path / "tv.mp4", [corners()] * 2, pixel_aspect="4/3")
    turned = hold_phone(write_clip(tmp_path / "turned.mp4", [corners()] * 2, pixel_aspect="4/3"), RIGHT)
    for clip, size in ((path, (85, 48)), (turned, (48, 85))):
        frames = Frames(clip)
        assert (frames.info.width, frames.info.height) == size
        assert {p.image.shape for p in frames} == {(*size[::-1], 3)}


def test_every_image_of_an_even_clip_comes_once(tmp_path):
    shades = [10 * i for i in range(24)]
    path = write_clip(tmp_path / "clip.mp4", [grey(s) for s in shades], fps=24)
    frames = Frames(path)
    found = list(frames)
    assert np.allclose(levels(found), shades, atol=3)
    assert [p.source for p in found] == [p.index for p in found] == list(range(24))
    assert np.allclose([p.seconds for p in found], np.arange(24) / 24, atol=1e-3)
    assert (frames.info.fps, frames.info.frames, frames.info.sources) == (24, 24, 24)
    assert frames.info.duration == pytest.approx(1.0)
    assert levels(frames) == levels(found), "a second passage shows the same"


def test_fewer_images_are_the_nearest_in_time(tmp_path):
    path = write_clip(tmp_path / "clip.mp4", [grey(10 * i) for i in range(25)], fps=25)
    frames = Frames(path, fps=10)
    assert [p.source for p in frames] == [0, 2, 5, 7, 10, 12, 15, 17, 20, 22]
    assert frames.info.frames == 10


@pytest.mark.parametrize("ending", ["mkv", "mp4"])
def test_uneven_clocks_are_followed(tmp_path, ending):
    seconds = np.cumsum([0.0] + [0.04] * 10 + [0.12] * 10)
    path = write_clip(tmp_path / f"vfr.{ending}", [grey(10 * i) for i in range(21)], seconds=seconds)
    found = list(Frames(path, fps=12.5))
    wanted = literal_steps(seconds, 12.5)
    assert [(p.step, p.source) for p in found] == wanted
    assert np.allclose([p.seconds for p in found], [seconds[source] for _, source in wanted], atol=1e-3)
    assert np.allclose(levels(found), [10 * source for _, source in wanted], atol=3)


def literal_steps(seconds, fps):
    """Each image to its nearest step; of several at one step the nearest."""
    taken = {}
    for source, second in enumerate(seconds):
        step = int(np.ceil(second * fps - 0.5 - 1e-9))
        away = abs(second * fps - step)
        if step not in taken or away < taken[step][0] - 1e-9:
            taken[step] = (away, source)
    end = seconds[-1] + (0.5 * (seconds[-1] - seconds[-2]) if len(seconds) > 1 else 0)
    return [(step, source) for step, (_, source) in sorted(taken.items()) if step / fps <= end + 1e-9]


@pytest.mark.parametrize("fps", [None, 7.0, 3.0])
def test_no_image_of_a_phone_in_dim_light_serves_two_frames(tmp_path, fps):
    """28 images at gaps of 1 to 3 in a file that states a higher rate than its time stamps show."""
    gaps = np.tile([1, 1, 2, 1, 3, 1, 1], 4)[:27] / 10
    seconds = np.concatenate([[0.0], np.cumsum(gaps)])
    path = write_clip(tmp_path / "dim.mp4", [grey(8 * i) for i in range(28)], fps=25, seconds=seconds)
    frames = Frames(path, fps)
    found = list(frames)
    sources = [p.source for p in found]
    assert len(set(sources)) == len(sources)
    assert sources == sorted(sources)
    assert np.allclose(levels(found), [8 * source for source in sources], atol=3)
    assert np.allclose([p.seconds for p in found], seconds[sources], atol=1e-3)
    assert frames.info.sources == 28
    if fps is None:
        assert sources == list(range(28))
        assert frames.info.fps == pytest.approx(27 / gaps.sum(), rel=0.01)


def test_the_rate_comes_from_the_time_stamps(tmp_path, monkeypatch):
    seconds = np.concatenate([[0.0], np.cumsum(np.tile([0.1, 0.2], 10))])
    path = write_clip(tmp_path / "vfr.mkv", [grey(8 * i) for i in range(21)], fps=25, seconds=seconds)
    info = describe(path)
    assert info.fps == pytest.approx(20 / 3.0, rel=1e-3)
    assert "states 25 frames a second and its time stamps show 6.667" in info.remarks[0]
    with pytest.raises(TwofoldError, match=r"7\.5 images a second were asked for, and vfr\.mkv has 6\.667"):
        describe(path, fps=7.5)


@given(
    st.lists(st.floats(0.001, 2.0), min_size=0, max_size=30),
    st.floats(0.2, 100.0),
)
def test_every_item_comes_at_its_nearest_step_or_not_at_all(gaps, fps):
    seconds = np.cumsum([0.0, *gaps])
    found = list(nearest_to_steps(zip(seconds.tolist(), seconds.tolist(), strict=True), fps))
    assert [(step, number) for step, number, _, _ in found] == literal_steps(seconds, fps)
    assert len({number for _, number, _, _ in found}) == len(found)
    assert all(item == when == seconds[number] for _, number, when, item in found)


def test_a_clock_that_jumps_makes_no_images(tmp_path):
    seconds = [0.0, 0.04, 0.08, 3600.0, 3600.04]
    frames = Frames(write_clip(tmp_path / "jump.mkv", [grey(40 * i) for i in range(5)], seconds=seconds), fps=25)
    assert [p.source for p in frames] == [0, 1, 2, 3, 4]
    assert "clock" in frames.remarks[0]


@pytest.mark.parametrize("kind", ["video", "folder"])
def test_the_longer_side_is_limited_by_averaging(tmp_path, kind):
    fine = np.zeros((256, 384, 3), np.uint8)
    fine[:, ::2] = 255  # Lines that vanish into grey where areas are averaged, and flicker elsewhere
    if kind == "folder":
        Image.fromarray(fine).save(tmp_path / "0.png")
        frames = Frames(tmp_path, max_size=96)
    else:
        frames = Frames(write_clip(tmp_path / "fine.mp4", [fine] * 2), max_size=96)
    info = frames.info
    assert (info.width, info.height, info.full_width, info.full_height) == (96, 64, 384, 256)
    for image in frames:
        assert image.image.shape == (64, 96, 3)
        assert np.all(np.abs(image.image.astype(int) - 127) < 12)


def test_sizes_are_never_raised():
    assert shrunk(100, 50, 200) == shrunk(100, 50, None) == (100, 50)
    assert shrunk(10000, 3, 100) == (100, 1)


def test_a_folder_comes_in_natural_order(tmp_path):
    for number in (10, 2, 1):
        Image.fromarray(grey(20 * number)).save(tmp_path / f"frame{number}.png")
    (tmp_path / "._frame1.png").write_bytes(b"what other systems leave behind")
    (tmp_path / "notes.txt").write_text("no image")
    frames = Frames(tmp_path, fps=12)
    assert levels(frames) == [20, 40, 200]
    assert frames.info.names == ("frame1", "frame2", "frame10")
    assert [p.seconds for p in frames] == [0, 1 / 12, 2 / 12]
    assert describe(tmp_path).fps == 30


def test_images_of_a_folder_are_turned_and_brought_to_8_bits(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6  # Shown after a quarter turn to the right
    (tmp_path / "turned").mkdir()
    Image.fromarray(corners()).save(tmp_path / "turned" / "a.png", exif=exif)
    frames = Frames(tmp_path / "turned")
    assert (frames.info.width, frames.info.height) == (48, 64)
    assert np.array_equal(next(iter(frames)).image, np.rot90(corners(), -1))

    (tmp_path / "deep").mkdir()
    Image.fromarray(np.full((70, 80), 200 * 257, np.uint16)).save(tmp_path / "deep" / "a.png", exif=exif)
    assert np.all(next(iter(Frames(tmp_path / "deep"))).image == 200)
    assert next(iter(Frames(tmp_path / "deep"))).image.shape == (80, 70, 3)


@pytest.mark.parametrize(
    ("kind", "white"), [("12 in 16", 4095), ("10 in 16", 1023), ("16", 65535), ("0..1", 1.0), ("0..255", 255.0)]
)
def test_images_of_more_than_8_bits_are_as_bright_as_they_were(tmp_path, kind, white):
    meant = np.tile(np.arange(0, 256, 3, dtype=np.uint8), (70, 1))
    for number, part in enumerate((meant, meant // 8)):  # The second is a dark image, not another scale
        values = part / 255 * white
        stored = values.astype(np.float32) if white in (1.0, 255.0) else values.round().astype(np.uint16)
        Image.fromarray(stored).save(tmp_path / f"{number}.tiff")
    frames = Frames(tmp_path)
    first, second = (image.image.astype(int) for image in frames)
    assert np.abs(first - meant[..., None]).max() <= 1
    assert np.abs(second - (meant // 8)[..., None]).max() <= 1
    assert ("is taken as white" in " ".join(frames.remarks)) == (white not in (65535, 1.0))


def test_colours_of_12_bits_in_16_are_as_bright_as_they_were(tmp_path):
    meant = corners(70, 80)
    (tmp_path / "a.png").write_bytes(png_of_16_bits((meant / 255 * 4095).round().astype(np.uint16)))
    assert np.array_equal(next(iter(Frames(tmp_path))).image, meant)


def png_of_16_bits(colors):
    """The bytes of a PNG file with 16 bits a channel (ISO/IEC 15948), which Pillow does not write."""
    height, width, _ = colors.shape
    lines = b"".join(b"\0" + line.astype(">u2").tobytes() for line in colors)
    pieces = {
        b"IHDR": struct.pack(">IIBBBBB", width, height, 16, 2, 0, 0, 0),
        b"IDAT": zlib.compress(lines),
        b"IEND": b"",
    }
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
        for kind, content in pieces.items()
    )


def test_natural_order_has_no_ties():
    names = ["1", "01", "a", "A", "a1b", "a01b"]
    assert len({natural_order(name) for name in names}) == len(names)


def cut(path, share):
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * share)])
    return path


def test_what_there_is_of_a_cut_file_is_used(tmp_path):
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 255, (48, 64, 3), dtype=np.uint8) for _ in range(50)]
    frames = Frames(cut(write_clip(tmp_path / "cut.mp4", images, first_to_last=True), 0.6))
    found = list(frames)
    assert 15 < len(found) < 40
    assert [p.index for p in found] == list(range(len(found)))
    assert len(frames.remarks) == 1
    assert "cut.mp4 ends early: it says 2.0 seconds" in frames.remarks[0]


def test_damage_in_the_middle_is_left_out(tmp_path):
    path = write_clip(tmp_path / "hurt.mp4", [corners()] * 30)
    with av.open(str(path)) as file:
        place = [packet.pos for packet in file.demux(video=0) if packet.size][12]
    content = bytearray(path.read_bytes())
    content[place : place + 4] = b"\xff\xff\xff\xff"  # The length of what follows
    path.write_bytes(content)
    frames = Frames(path)
    found = list(frames)
    assert len(found) == 29
    assert [p.source for p in found] == sorted(p.source for p in found)
    assert frames.remarks == ("hurt.mp4 is damaged: 1 pieces could not be decoded and are left out.",)


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda p: p / "no.mp4", "does not exist"),
        (lambda p: cut(write_clip(p / "c.mp4", [corners()] * 3), 0.5), "cannot be read as a video"),
        (lambda p: cut(write_clip(p / "c.mp4", [corners()] * 3), 0.0), "cannot be read as a video"),
        (lambda p: text(p / "c.mp4"), "cannot be read as a video"),
        (lambda p: text(p / "c.txt"), "cannot be read as a video"),
        (lambda p: write_sound(p / "c.m4a"), "only sound"),
        (lambda p: write_sound(p / "c.mp4"), "only sound"),
        (lambda p: p, "holds no images"),
        (lambda p: sizes(p), "b.png is 65 x 48"),
        (lambda p: damaged(p), "b.png is no image of a known kind|b.png is damaged"),
    ],
)
def test_what_cannot_be_used_is_said_in_one_sentence(tmp_path, capfd, caplog, make, sentence):
    clip = make(tmp_path)
    with pytest.raises(TwofoldError, match=sentence) as caught, caplog.at_level(logging.ERROR):
        list(Frames(clip))
    assert str(caught.value).count("\n") == 0
    assert str(caught.value).endswith(".")
    assert capfd.readouterr().err == ""


def text(path):
    path.write_text("not a video\n" * 100)
    return path


def sizes(folder):
    Image.fromarray(grey(1)).save(folder / "a.png")
    Image.fromarray(grey(1, width=65)).save(folder / "b.png")
    return folder


def damaged(folder):
    Image.fromarray(corners()).save(folder / "a.png")
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)).save(folder / "b.png")
    cut(folder / "b.png", 0.5)
    return folder


def test_a_playlist_calls_nobody(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"http://127.0.0.1:{server.getsockname()[1]}/clip.ts"
        entries = ("#EXTM3U", "#EXT-X-TARGETDURATION:1", "#EXTINF:1,", address, "#EXT-X-ENDLIST", "")
        (tmp_path / "list.m3u8").write_text("\n".join(entries))
        server.settimeout(0.2)
        answers = threading.Thread(target=hang_up, args=(server,))
        answers.start()
        with pytest.raises(TwofoldError, match="cannot be read"):
            list(Frames(tmp_path / "list.m3u8"))
        answers.join()


def hang_up(server):
    with contextlib.suppress(TimeoutError):
        server.accept()[0].close()
        raise AssertionError("somebody called")


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"fps": 60}, "60 images a second were asked for, and clip.mp4 has 25"),
        ({"fps": 0}, "makes no sense"),
        ({"fps": float("nan")}, "makes no sense"),
        ({"max_size": 8}, "at least 64"),
    ],
)
def test_impossible_wishes_are_refused(tmp_path, arguments, sentence):
    with pytest.raises(TwofoldError, match=sentence):
        describe(write_clip(tmp_path / "clip.mp4", [corners()] * 3), **arguments)


def test_long_clips_are_not_kept_in_memory(tmp_path):
    frames = Frames(write_clip(tmp_path / "long.mp4", [grey(i % 200) for i in range(600)]))
    tracemalloc.start()
    try:
        count = sum(1 for _ in frames)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert count == frames.info.frames == 600
    assert peak < 40 * 48 * 64 * 3


def test_a_real_clip():
    info = describe(real_clip("pose2sim/cam01.mp4"), max_size=960)
    assert (info.width, info.height, info.full_width, info.full_height) == (540, 960, 1080, 1920)
    assert (info.fps, info.frames, info.sources) == (60, 100, 100)
    assert info.remarks == ()
