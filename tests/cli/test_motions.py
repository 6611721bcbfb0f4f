"""`twofold motion` and `twofold render RUN --motion`."""

import importlib.util
import shutil

import av
import numpy as np
import pytest
from command_line import files, refused
from motion_rigs import bvh_of, bvh_text, rigs, stick_body

from twofold.body.builtin_motions import BUILTIN_MOTIONS
from twofold.cli.main import main

needs_anny = pytest.mark.skipif(importlib.util.find_spec("anny") is None, reason="the free body is not installed")


@pytest.fixture
def walk(tmp_path):
    """A Mixamo file of a walk."""
    body = stick_body()
    path = tmp_path / "walk.bvh"
    moved = BUILTIN_MOTIONS["walk"](body)
    path.write_text(bvh_text(*bvh_of(rigs(body.joints.double())["mixamo"], body.joints.double(), moved), moved.fps))
    return path


def frames(path):
    with av.open(str(path)) as file:
        return len(list(file.decode(video=0)))


@needs_anny
def test_a_motion_is_reported_and_previewed(walk, tmp_path, capsys):
    out = tmp_path / "preview.mp4"
    main(["motion", str(walk), "--out", str(out), "--size", "32", "--fps", "2", "--follow"])
    said = capsys.readouterr().err
    for fact in ("format: BVH", "frames: 130 at 30 fps", "up axis: y", "units: centimetres"):
        assert fact in said
    assert frames(out) == 9


def test_an_avatar_walks(walk, trained, tmp_path, capsys):
    out = tmp_path / "walk.mp4"
    main(["render", str(trained.folder), "--motion", str(walk), "--size", "16", "--fps", "1", "--out", str(out)])
    assert frames(out) == 5
    assert "units: centimetres" in capsys.readouterr().err


def test_without_a_place_the_video_lies_with_the_run(trained, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(trained.folder, run)
    render = ["render", str(run), "--motion", "turn", "--size", "16", "--fps", "0.3"]
    main([*render, "--background", "white"])
    assert frames(run / "renders" / "motion-turn.mp4") == 2
    main([*render, "--alpha"])
    main([*render, "--alpha"])
    assert len(files(run / "renders" / "motion-turn")) == 2


def test_options_without_a_motion_are_refused(trained, capsys):
    assert "need --motion" in refused(capsys, "render", trained.folder, "--follow")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--motion", "wlak"], "neither a file nor a built-in motion"),
        (["--motion", "walk", "--background", "whitish"], "should be a colour"),
        (["--motion", "walk", "--fps", "-1"], "positive number"),
        (["--motion", "walk", "--alpha", "--out", "a.mp4"], "holds no opacity"),
        (["--motion", "walk", "--size", "3"], "--size should be 16 to 4096"),
    ],
)
def test_bad_input_gets_one_sentence_and_leaves_nothing(trained, tmp_path, monkeypatch, capsys, options, words):
    monkeypatch.chdir(tmp_path)
    assert words in refused(capsys, "render", trained.folder, *options)
    assert not list(tmp_path.iterdir())


@needs_anny
def test_faults_of_files_get_one_sentence(tmp_path, capsys):
    np.savez(tmp_path / "degrees.npz", poses=np.full((4, 72), 90.0), trans=np.zeros((4, 3)))
    (tmp_path / "motion.pt").write_bytes(b"anything")
    for name, words in (("degrees.npz", "look like degrees"), ("motion.pt", "pickle"), ("none.bvh", "neither a file")):
        assert words in refused(capsys, "motion", tmp_path / name, "--out", tmp_path / "out.mp4")
    assert not (tmp_path / "out.mp4").exists()
