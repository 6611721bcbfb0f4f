"""Whoever gives a command the wrong kind of path learns which command takes it."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from command_line import refused
from PIL import Image
from tiny_person import Run

from twofold.cli.advice import after_evaluation, after_rendering
from twofold.errors import install_command


def video(folder: Path) -> Path:
    (folder / "me.mp4").write_bytes(b"....ftypisom")
    return folder / "me.mp4"


def images(folder: Path) -> Path:
    (folder / "clip").mkdir()
    Image.new("RGB", (8, 8)).save(folder / "clip" / "0000.png")
    return folder / "clip"


def humannerf(folder: Path) -> Path:
    for name in ("cameras.pkl", "mesh_infos.pkl"):
        (folder / name).write_bytes(b"\x80\x04}.")
    return folder


def wham(folder: Path) -> Path:
    (folder / "wham_output.pkl").write_bytes(b"\x80\x04}.")
    return folder


@pytest.mark.parametrize("command", ["train", "check", "render", "evaluate", "import"])
@pytest.mark.parametrize("make", [video, images])
def test_a_video_or_its_images_are_sent_to_prepare(
    command: str, make: Callable[[Path], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = make(tmp_path)
    out = [tmp_path / "out"] if command == "import" else []
    said = refused(capsys, command, path, *out)
    assert f"twofold prepare {path} --out " in said
    assert said.startswith(f"twofold: {path} is a ")
    assert not (tmp_path / "out").exists()


def test_a_capture_and_a_run_are_told_apart(
    trained: Run, person_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for command in ("render", "evaluate"):
        assert f"twofold train {person_folder}" in refused(capsys, command, person_folder)
    for command in ("train", "check"):
        assert f"{trained.folder} is a run, expected a capture" in refused(capsys, command, trained.folder)
    said = refused(capsys, "render", trained.folder, "--capture", trained.folder)
    assert f"{trained.folder} is a run, expected a capture" in said


@pytest.mark.parametrize(("make", "called"), [(humannerf, "a HumanNeRF folder"), (wham, "output of WHAM")])
def test_folders_of_other_programs_are_known_by_name(
    make: Callable[[Path], Path], called: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said = refused(capsys, "import", make(tmp_path), tmp_path / "out")
    assert called in said
    assert "twofold prepare " in said
    assert "damaged" not in said


@pytest.mark.parametrize("recipe", ["quick", "fast"])
def test_what_has_just_been_done_is_not_advised_again(recipe: str, tmp_path: Path) -> None:
    capture, finer = tmp_path / "capture", f"twofold train {tmp_path / 'capture'} --recipe fast"
    (tmp_path / "checkpoint.safetensors").write_bytes(b"")
    assert after_rendering(tmp_path, capture, "measure", recipe) == "measure"
    assert after_evaluation(tmp_path, capture, "render", recipe) == "render"
    (tmp_path / "metrics.json").write_text("{}")
    (tmp_path / "renders").mkdir()
    for following in (
        after_rendering(tmp_path, capture, "again", recipe),
        after_evaluation(tmp_path, capture, "again", recipe),
    ):
        assert "again" not in following
        assert (finer in following) == (recipe == "quick")
    later = (tmp_path / "renders").stat().st_mtime + 10  # trained on since
    os.utime(tmp_path / "checkpoint.safetensors", (later, later))
    assert after_rendering(tmp_path, capture, "measure", recipe) == "measure"
    assert after_evaluation(tmp_path, capture, "render", recipe) == "render"


def test_extras_are_installed_from_the_clone_where_there_is_one(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    package = tmp_path / "my clone" / "src" / "twofold"
    package.mkdir(parents=True)
    monkeypatch.setattr("twofold.errors.__file__", str(package / "errors.py"))
    assert install_command("prepare") == "pip install 'twofold[prepare]'"
    for name in ("pyproject.toml", "constraints.txt"):
        (tmp_path / "my clone" / name).write_text("")
    clone = tmp_path / "my clone"
    assert (
        install_command("prepare")
        == f"pip install --constraint '{clone}/constraints.txt' --editable '{clone}[prepare]'"
    )
