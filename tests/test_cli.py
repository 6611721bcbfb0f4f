"""Bad input gets one sentence and exit code 2, and leaves nothing half written."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from twofold.cli import main


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """What the command says on standard error when it ends with code 2."""
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    said = capsys.readouterr().err
    assert ended.value.code == 2, said
    assert "Traceback" not in said
    return " ".join(said.split())


def first(folder: Path, kind: str) -> Path:
    return sorted((folder / kind).rglob("*.png"))[0]


def all_black(folder: Path) -> None:
    file = first(folder, "masks")
    with Image.open(file) as mask:
        Image.new("L", mask.size).save(file)


def wrong_size(folder: Path) -> None:
    Image.new("L", (7, 5), 255).save(first(folder, "masks"))


def nan_pose(folder: Path) -> None:
    with np.load(folder / "motion.npz") as stored:
        arrays = dict(stored)
    arrays["poses"][0, 3, 1] = np.nan
    np.savez(folder / "motion.npz", **arrays)


def edited(change: Callable[[dict], None]) -> Callable[[Path], None]:
    def spoil(folder: Path) -> None:
        data = json.loads((folder / "capture.json").read_text())
        change(data)
        (folder / "capture.json").write_text(json.dumps(data))

    return spoil


def one_frame(data: dict) -> None:
    entry = data["splits"]["train"][0]
    data["splits"] = {"train": [{**entry, "times": entry["times"][:1]}], "novel_view": [], "novel_pose": []}


def camera_behind(data: dict) -> None:
    for camera in data["cameras"].values():
        camera["world_to_camera"][2][3] = -50.0


FAULTS: dict[str, tuple[Callable[[Path], None], str]] = {
    "empty folder": (lambda folder: (shutil.rmtree(folder), folder.mkdir())[1], "empty"),
    "missing mask": (lambda folder: first(folder, "masks").unlink(), "masks"),
    "wrong-sized mask": (wrong_size, "masks"),
    "NaN pose": (nan_pose, "poses"),
    "all-black mask": (all_black, "masks"),
    "one frame only": (edited(one_frame), "one"),
    "camera behind the body": (edited(camera_behind), "behind"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_faulty_capture_is_refused_in_words_before_anything_is_written(
    name: str, person_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capture = tmp_path / "capture"
    shutil.copytree(person_folder, capture)
    spoil, word = FAULTS[name]
    spoil(capture)
    said = refused(capsys, "train", capture, "--out", tmp_path / "run")
    assert word in said
    assert str(capture) in said
    assert not (tmp_path / "run").exists()


def test_an_output_below_a_file_is_refused(
    person_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("mine")
    said = refused(capsys, "train", person_folder, "--out", tmp_path / "file" / "run", "--set", "training.steps=1")
    assert str(tmp_path / "file") in said
    assert (tmp_path / "file").read_text() == "mine"


@pytest.mark.parametrize(
    ("setting", "word"),
    [("training.stepz=3", "training.steps"), ("training.steps=many", "training.steps"), ("training", "=")],
)
def test_a_wrong_setting_is_named(
    setting: str, word: str, person_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert word in refused(capsys, "train", person_folder, "--out", tmp_path / "run", "--set", setting)
    assert not (tmp_path / "run").exists()


def test_an_unknown_device_is_named(person_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "nonsense" in refused(capsys, "train", person_folder, "--out", tmp_path / "run", "--device", "nonsense")


def test_neither_capture_nor_run_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert "--resume" in refused(capsys, "train")


@pytest.mark.parametrize("command", ["render", "evaluate"])
def test_a_folder_that_is_no_run_is_refused(command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "recipe.json" in refused(capsys, command, tmp_path)


def test_a_run_is_trained_drawn_and_measured_and_each_command_says_where_and_what_next(
    person_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    small = ["training.steps=3", "training.pixels.rays=64", "training.preview_every=0"]
    main(["train", str(person_folder), "--out", str(run), *(w for s in small for w in ("--set", s))])
    assert f"twofold render {run}" in " ".join(capsys.readouterr().err.split())
    main(["render", str(run), "--what", "views"])
    assert f"twofold evaluate {run}" in " ".join(capsys.readouterr().err.split())
    main(["evaluate", str(run), "--most", "2"])
    assert str(run / "metrics.json") in " ".join(capsys.readouterr().err.split())
    metrics = json.loads((run / "metrics.json").read_text())
    assert 0 <= metrics["novel_view"]["silhouette_iou"] <= 1
    assert "protocol" in metrics["novel_view"]
    assert "already holds a run" in refused(capsys, "train", person_folder, "--out", run)
