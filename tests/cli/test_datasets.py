"""Data sets of other projects on the command line: convert, train and check."""

import json
from pathlib import Path

import datasets
import pytest
from command_line import refused
from smpl_subject import Scene, make_scene

from twofold.capture.readers.convert import sha256_of
from twofold.cli.main import main


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return make_scene(tmp_path_factory.mktemp("scene"), frames=6, cameras=2, size=40)


@pytest.fixture
def zju(scene: Scene, tmp_path: Path) -> Path:
    return datasets.write_zju(tmp_path / "CoreView_377", scene)


def said(capsys: pytest.CaptureFixture[str]) -> str:
    return " ".join(capsys.readouterr().err.split())


def test_convert_says_what_it_made_assumed_and_what_comes_next(
    zju: Path, scene: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main(["convert", str(zju), str(tmp_path / "out"), "--body", str(scene.smpl)])
    words = said(capsys)
    assert "5 train, 1 novel view, 1 novel pose images." in words
    assert words.endswith(f"Next: twofold check {tmp_path / 'out'}")
    assert "Note: No --split was named; the paper's is taken" in words
    assert "Note: Body and masks agree with a silhouette IoU of 0.9" in words
    notes = json.loads((tmp_path / "out" / "capture.json").read_text())["notes"]
    assert notes["body_sha256"] == sha256_of(scene.smpl)
    assert notes["body_file"] == "smpl.npz"
    assert notes["reader"] == "zju"
    assert notes["masks"] == "mask"


def test_import_is_another_name_of_convert(zju: Path, scene: Scene, tmp_path: Path) -> None:
    main(["import", str(zju), str(tmp_path / "out"), "--body", str(scene.smpl), "--split", "humannerf"])
    assert json.loads((tmp_path / "out" / "capture.json").read_text())["notes"]["split"] == "humannerf"


def test_train_takes_a_data_set_as_it_is(
    zju: Path, scene: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    few = ["--set", "training.steps=1", "training.pixels.rays=16", "--out", "run"]
    main(["train", str(zju), "--body", str(scene.smpl), *few])
    assert f"{zju} is ZJU-MoCap; the capture made of it is in captures/CoreView_377" in said(capsys)
    about = json.loads((tmp_path / "run" / "run.json").read_text())
    assert about["capture"] == str(tmp_path / "captures" / "CoreView_377")
    assert about["body_sha256"] == sha256_of(scene.smpl)


def test_check_takes_a_data_set_as_it_is_and_what_was_made_before_again(
    zju: Path, scene: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        with pytest.raises(SystemExit):  # so few images are not trainable
            main(["check", str(zju), "--body", str(scene.smpl), "--split", "monohuman"])
    words = said(capsys)
    assert words.count("Converting:") > 0
    assert f"Note: captures/CoreView_377-monohuman was made of {zju} before and is taken" in words
    (zju / "annots.npy").write_bytes(b"no longer read")
    other = tmp_path / "other.npz"
    other.write_bytes(scene.smpl.read_bytes() + b"\0")
    words = refused(capsys, "check", zju, "--body", other, "--split", "monohuman")
    assert "was not made of" in words


def test_options_that_do_not_go_together(
    zju: Path, scene: Scene, person_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    body = ("--body", scene.smpl)
    out = tmp_path / "out"
    assert "--drop-below-iou and --held-objects belong" in refused(
        capsys, "convert", zju, out, *body, "--drop-below-iou", "0.5"
    )
    assert "is no data set of a known format" in refused(capsys, "convert", person_folder, out, *body)
    assert "a capture folder has its own body" in refused(capsys, "train", person_folder, *body)
    assert "--scale 2 should be" in refused(capsys, "convert", zju, out, *body, "--scale", "2")
    assert "take 3 or more" in refused(capsys, "convert", zju, out, *body, "--held-out", "2")
    assert "names your SMPL file" in refused(capsys, "convert", zju, out)
    assert not out.exists()
