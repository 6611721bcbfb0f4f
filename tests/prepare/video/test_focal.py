"""Focal lengths that files state, and what is done with them."""

from dataclasses import replace

import av
import pytest
import torch
from made_clips import grey, write_clip
from PIL import Image

from twofold.geometry.cameras import Camera
from twofold.prepare.video.clips import FOCAL_GUESS, PrepareConfig, focal_in_words, open_clips
from twofold.prepare.video.focal import focal_of_video, focal_share
from twofold.prepare.video.frames import describe

FOCAL_35MM = 0xA405


def stills(folder, millimeters=None):
    folder.mkdir()
    for k in range(2):
        image = Image.fromarray(grey(90 + k, 80, 120))
        exif = image.getexif()
        if millimeters is not None:
            exif.get_ifd(0x8769)[FOCAL_35MM] = millimeters
        image.save(folder / f"{k}.jpg", exif=exif)
    return folder


@pytest.mark.parametrize("value", [0, -3, 5000, "", None, float("nan"), "wide", [27]])
def test_what_no_lens_has_is_not_believed(value):
    assert focal_share(value) is None


def test_tags_of_phones_are_known():
    tags = {"com.apple.quicktime.camera.focal_length.35mm_equivalent": "26", "encoder": "x"}
    assert focal_of_video(tags) == pytest.approx(26 / 36)
    assert focal_of_video({"encoder": "35"}) is None


@pytest.mark.parametrize(("millimeters", "share"), [(27, 0.75), (None, None), (0, None)])
def test_images_state_it_in_their_exif(tmp_path, millimeters, share):
    assert describe(stills(tmp_path / "a", millimeters)).focal == (None if share is None else pytest.approx(share))


def test_a_video_states_it_in_its_tags(tmp_path):
    plain = write_clip(tmp_path / "plain.mp4", [grey(50)] * 3)
    assert describe(plain).focal is None
    tagged = tmp_path / "tagged.mov"
    name = "com.apple.quicktime.camera.focal_length.35mm_equivalent"
    with av.open(str(plain)) as source, av.open(str(tagged), "w", options={"movflags": "use_metadata_tags"}) as file:
        file.metadata[name] = "28"
        stream = file.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(source.streams.video[0]):
            if packet.dts is not None:
                packet.stream = stream
                file.mux(packet)
    assert describe(tagged).focal == pytest.approx(28 / 36)


def test_a_stated_focal_length_takes_the_place_of_the_guess(tmp_path):
    (clip,) = open_clips([stills(tmp_path / "a", 27)], PrepareConfig())
    assert float(clip.camera.intrinsics[0, 0]) == pytest.approx(0.75 * 120)
    (given,) = open_clips([tmp_path / "a"], PrepareConfig(intrinsics=(70.0, 70.0, 59.5, 39.5)))
    assert float(given.camera.intrinsics[0, 0]) == pytest.approx(70)


def test_where_it_comes_from_is_said(tmp_path):
    (stated,) = open_clips([stills(tmp_path / "a", 27)], PrepareConfig())
    (guessed,) = open_clips([stills(tmp_path / "b")], PrepareConfig())
    lens = torch.tensor([[95.0, 0, 59.5], [0, 95, 39.5], [0, 0, 1]])
    found = Camera(torch.eye(4), lens, 80, 120)
    words = focal_in_words(stated, PrepareConfig(), found)
    assert "95 pixels of images of 120 x 80" in words
    assert "states 27 mm" in words
    words = focal_in_words(guessed, PrepareConfig(), found)
    assert f"estimated as 95 pixels of images of 120 x 80, from a guess of {FOCAL_GUESS * 120:.0f}" in words
    assert "--intrinsics" in words
    given = replace(PrepareConfig(), intrinsics=(70.0, 70.0, 59.5, 39.5))
    assert focal_in_words(guessed, given, found).endswith("as given.")
    calibrated = replace(PrepareConfig(), calibration=tmp_path / "x")
    assert focal_in_words(guessed, calibrated, found) == ""
