"""Converting: image by image, whole or not at all."""

import json
import os
import subprocess
import sys
import threading
import weakref
from pathlib import Path

import datasets
import numpy as np
import pytest
from smpl_subject import make_scene

from twofold.capture.folder import read_capture
from twofold.capture.readers import sequence
from twofold.capture.readers.convert import ConvertOptions, convert
from twofold.errors import TwofoldError
from twofold.images import read_rgb

MEASURE = """
import resource, sys
from pathlib import Path
from twofold.capture.readers.convert import ConvertOptions, convert
source, body, out = map(Path, sys.argv[1:])
convert(source, out, ConvertOptions(body=body, split="humannerf"))
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024)
"""


def test_few_images_are_in_memory_at_once(scene, tmp_path, monkeypatch):
    source = datasets.write_humannerf(tmp_path / "387", scene)
    alive, most, lock = [0], [0], threading.Lock()

    def gone():
        with lock:
            alive[0] -= 1

    def watched(path):
        image = read_rgb(path)
        with lock:
            alive[0] += 1
            most[0] = max(most[0], alive[0])
        weakref.finalize(image, gone)
        return image

    monkeypatch.setattr(sequence, "read_rgb", watched)
    convert(source, tmp_path / "out", ConvertOptions(body=scene.smpl))
    assert 1 <= most[0] <= min(4, os.cpu_count() or 1) + 2
    assert alive[0] <= 1


def long_recording(folder: Path, frames: int, size: int) -> tuple[Path, Path]:
    """One camera of ZJU-MoCap for many frames, whose files are links to those of five."""
    scene = make_scene(folder, frames=5, cameras=1, size=size)
    source = datasets.write_zju(folder / "CoreView_315", scene, from_one=True, masks=("mask",))
    annotations = np.load(source / "annots.npy", allow_pickle=True).item()
    first = annotations["ims"]
    long = []
    for t in range(frames):
        paths = []
        for path in first[t % 5]["ims"]:
            name = path.replace(f"_{t % 5 + 1:04d}_", f"_{t + 1:04d}_")
            paths.append(name)
            if t >= 5:
                os.link(source / path, source / name)
                masks = [(source / "mask" / p).with_suffix(".png") for p in (path, name)]
                os.link(*masks)
        long.append({"ims": paths})
        if t >= 5:
            os.link(source / "new_params" / f"{t % 5 + 1}.npy", source / "new_params" / f"{t + 1}.npy")
    np.save(source / "annots.npy", {"cams": annotations["cams"], "ims": long})
    return source, scene.smpl


@pytest.mark.slow
def test_two_thousand_large_frames_take_under_one_and_a_half_gigabytes(tmp_path):
    source, body = long_recording(tmp_path, 2000, 1024)
    words = [sys.executable, "-c", MEASURE, str(source), str(body), str(tmp_path / "out")]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    assert float(done.stdout) < 1.5e9
    assert len(read_capture(tmp_path / "out").train) == 2000


def test_what_cannot_be_written_leaves_nothing_and_an_old_capture_stays(scene, tmp_path):
    source = datasets.write_humannerf(tmp_path / "387", scene)
    options = ConvertOptions(body=scene.smpl)
    convert(source, tmp_path / "out", options)
    before = (tmp_path / "out" / "capture.json").read_bytes()
    with pytest.raises(TwofoldError, match="already holds a capture"):
        convert(source, tmp_path / "out", options)
    (source / "masks" / "frame_000003.png").write_bytes(b"damaged")
    with pytest.raises(TwofoldError, match=r"frame_000003.png"):
        convert(source, tmp_path / "out", options, overwrite=True)
    assert (tmp_path / "out" / "capture.json").read_bytes() == before
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["387", "out"]


def test_the_same_source_gives_the_same_bytes(scene, tmp_path):
    source = datasets.write_vid2avatar(tmp_path / "v2a", scene)
    for name in ("one", "two"):
        convert(source, tmp_path / name, ConvertOptions(body=scene.smpl))
    files = [p.relative_to(tmp_path / "one") for p in (tmp_path / "one").rglob("*") if p.is_file()]
    assert len(files) == 23
    for file in files:
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "two" / file).read_bytes()


def test_notes_say_where_it_came_from(scene, tmp_path):
    source = datasets.write_vid2avatar(tmp_path / "v2a", scene)
    convert(source, tmp_path / "out", ConvertOptions(body=scene.smpl, credit="somebody", fps=24.0))
    description = json.loads((tmp_path / "out" / "capture.json").read_text())
    assert (description["credit"], description["fps"]) == ("somebody", 24.0)
    notes = description["notes"]
    assert notes["converted_from"] == str(source)
    assert notes["frame_names"][:2] == ["0000", "0001"]
    assert notes["scale_undone"] > 0.5
