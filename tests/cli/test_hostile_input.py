"""Damaged input, full disks and too little memory, as the commands meet them: one sentence, nothing half written."""

import os
import resource
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import files, refused
from disk import files_end_at
from tiny_person import Run

from twofold.errors import TwofoldError
from twofold.methods.base import Rendering
from twofold.outputs.views import orbit, pose_canonically, render_image
from twofold.training.run import load


def without_pixels(path: Path) -> None:
    """A PNG whose checksums are right and which has no pixels."""
    raw = path.read_bytes()
    path.write_bytes(raw[: raw.index(b"IDAT") - 4] + raw[raw.index(b"IEND") - 4 :])


@pytest.mark.parametrize("kind", ["images", "masks"])
def test_an_image_without_pixels_ends_train_and_check_before_anything_is_written(
    kind: str, person_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capture = shutil.copytree(person_folder, tmp_path / "capture")
    without_pixels(capture / kind / "front" / "000001.png")
    assert "000001.png is damaged" in refused(capsys, "train", capture, "--out", tmp_path / "run")
    assert "000001.png is damaged" in refused(capsys, "check", capture, "--out", tmp_path / "check")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["capture"]


@pytest.mark.parametrize("name", ["meshes/000000.npz", "images/side/000000.png"])
def test_what_only_evaluate_reads_is_one_sentence_when_damaged(
    name: str, trained: Run, person_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = shutil.copytree(trained.folder, tmp_path / "run")
    capture = shutil.copytree(person_folder, tmp_path / "capture")
    (run / "metrics.json").unlink(missing_ok=True)
    whole = (capture / name).read_bytes()
    if name.endswith("npz"):
        (capture / name).write_bytes(whole[: len(whole) // 2])
    else:
        without_pixels(capture / name)
    said = refused(capsys, "evaluate", run, "--capture", capture)
    assert f"{Path(name).name} is damaged" in said
    assert not (run / "metrics.json").exists()


def test_a_full_disk_leaves_neither_numbers_nor_report_of_a_check(
    person_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with files_end_at(30_000):  # the numbers fit, the report does not
        said = refused(capsys, "check", person_folder, "--out", tmp_path / "a" / "check")
    assert f"Cannot write {tmp_path / 'a' / 'check' / 'index.html'}: " in said
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("part", ["views", "orbit"])
def test_a_full_disk_leaves_no_empty_folder_of_images(
    part: str, trained: Run, person_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "a" / "out"
    with files_end_at(100):
        said = refused(capsys, "render", trained.folder, "--out", out, "--what", part, "--size", 32)
    assert f"Cannot write {out}" in said
    assert list(tmp_path.iterdir()) == []


def test_a_diverged_run_is_neither_rendered_nor_measured(
    trained: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from safetensors import safe_open
    from safetensors.torch import load_file, save_file

    run = shutil.copytree(trained.folder, tmp_path / "run")
    file = run / "checkpoint.safetensors"
    with safe_open(file, "pt") as stored:
        about = stored.metadata()
    tensors = load_file(file)
    tensors["avatar.field.high_grid.table"][:] = np.nan
    save_file(tensors, file, about)
    before = files(run)
    for command in ("render", "evaluate"):
        assert "numbers that are not finite" in refused(capsys, command, run)
    assert files(run) == before


def test_an_image_that_is_not_finite_is_not_shown(trained: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    avatar, _ = load(trained.folder)
    posed = pose_canonically(avatar)
    camera = next(iter(orbit(posed, 24, 1)))

    def broken(rays: object, *_: object) -> Rendering:
        count = len(rays.origins)  # type: ignore[attr-defined]
        color = torch.full((count, 3), torch.nan)
        return Rendering(color, torch.ones(count), torch.ones(count), torch.zeros(count, 3))

    monkeypatch.setattr(avatar, "render", broken)
    with pytest.raises(TwofoldError, match="not finite"):
        render_image(avatar, posed, camera, torch.zeros(3))


@pytest.mark.skipif(os.name == "nt", reason="needs POSIX limits")
@pytest.mark.slow
def test_a_training_that_the_memory_does_not_hold_names_the_setting(person_folder: Path, tmp_path: Path) -> None:
    words = ["train", str(person_folder), "--out", str(tmp_path / "run"), "--set", "training.pixels.rays=400000"]
    limit = 3 * 2**30

    def limited() -> None:
        resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))

    done = subprocess.run(
        [sys.executable, "-m", "twofold", *words], capture_output=True, text=True, preexec_fn=limited, check=False,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    assert done.returncode == 2, done.stderr
    assert "The memory does not suffice; lower --set training.pixels.memory_gb=" in done.stderr
    assert "Traceback" not in done.stderr
