"""Bad input gets one sentence and exit code 2, and leaves nothing half written."""

import functools
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import files, refused
from PIL import Image
from tiny_person import Run

from twofold import __version__
from twofold.cli.main import main
from twofold.config import with_overrides
from twofold.methods.table import RECIPES
from twofold.metrics import perceptual
from twofold.training.lock import locked
from twofold.training.run import read_checkpoint


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


def no_weights(folder: Path) -> None:
    with np.load(folder / "body.npz") as stored:
        arrays = dict(stored)
    np.savez(folder / "body.npz", **arrays | {"weights": 0 * arrays["weights"]})


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
    "no weights": (no_weights, "weights"),
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
    said = refused(capsys, "train", person_folder, "--out", tmp_path / "run", "--set", setting)
    assert word in said
    assert len(said) < 150  # not a list of every setting
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("words", [
    ["--set", "training.steps=7", "training.pixels.rays=64", "--seed", "3"],
    ["--set", "training.steps=7", "--seed", "3", "--set", "training.pixels.rays=64"],
    ["--seed", "3", "--set=training.steps=7", "--set", "training.pixels.rays=64"],
])  # fmt: skip
def test_settings_come_in_one_list_or_one_by_one(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    main(["train", "--settings", *words])
    shown = capsys.readouterr()
    text = "".join((shown.out + shown.err).split())
    assert "training.steps=7" in text
    assert "training.pixels.rays=64" in text


@pytest.mark.parametrize("seed", ["-1", "12345678901234567890123"])
@pytest.mark.parametrize("command", ["studio", "train", "settings", "demo", "set"])
def test_a_seed_that_no_generator_takes_is_refused_before_anything_is_written(
    command: str, seed: str, person_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    words = {
        "studio": ["studio", out, "--seed", seed],
        "train": ["train", person_folder, "--out", out, "--seed", seed],
        "settings": ["train", "--settings", "--seed", seed],
        "demo": ["demo", "--out", out, "--seed", seed],
        "set": ["train", person_folder, "--out", out, "--set", f"seed={seed}"],
    }[command]
    said = refused(capsys, *words)
    assert "seed" in said
    assert "should be 0 to 4294967295" in said
    assert list(tmp_path.iterdir()) == []


def test_a_demo_does_not_take_the_place_of_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("mine")
    assert f"Cannot write {tmp_path / 'file'}: " in refused(capsys, "demo", "--out", tmp_path / "file")
    assert (tmp_path / "file").read_text() == "mine"


def test_the_version_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    main(["--version"])
    assert capsys.readouterr().out == f"twofold {__version__}\n"


def test_options_keep_their_old_names_beside_the_new(
    trained: Run, person_folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[object, object]] = []

    def measure(
        avatar: object, capture: object, run: object, most: object, meshes: object, show: object, networks: object
    ) -> dict:  # fmt: skip
        asked.append((most, meshes))
        return {}

    monkeypatch.setattr("twofold.evaluation.evaluate", measure)
    for words in (["--most", "3", "--meshes=2"], ["--max-images=3", "--max-meshes", "2"], ["--max-images", "all"], []):
        main(["evaluate", str(trained.folder), *words])
    assert asked == [(3, 2), (3, 2), (None, 4), (30, 4)]
    assert "--max-images should be at least 1" in refused(capsys, "evaluate", trained.folder, "--most", 0)
    assert "--max-images should be at least 2" in refused(capsys, "check", person_folder, "--most", 1)


def test_a_run_that_is_being_trained_is_left_alone_before_any_work(
    trained: Run,
    person_folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    run = shutil.copytree(trained.folder, tmp_path / "run")
    monkeypatch.setattr("twofold.capture.validate.validate", lambda _: pytest.fail("work was done"))
    with locked(run):
        assert f"{run} is being trained by another process" in refused(capsys, "train", "--resume", run)
        (run / "checkpoint.safetensors").unlink()
        assert f"{run} is being trained by another" in refused(capsys, "train", person_folder, "--out", run)
    assert (run / "recipe.json").exists()


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
    again = " ".join(capsys.readouterr().err.split())
    assert str(run / "metrics.json") in again
    assert f"twofold train {person_folder} --recipe fast" in again  # all of this one has been shown
    metrics = json.loads((run / "metrics.json").read_text())
    assert 0 <= metrics["novel_view"]["silhouette_iou"] <= 1
    assert "protocol" in metrics["novel_view"]
    moved = shutil.copytree(person_folder, tmp_path / "moved")
    (run / "metrics.json").unlink()
    main(["render", str(run), "--what", "views", "--capture", str(moved)])
    assert f"Next: twofold evaluate {run} --capture {moved}" in " ".join(capsys.readouterr().err.split())
    shutil.rmtree(run / "renders")
    main(["evaluate", str(run), "--max-images", "1", "--max-meshes", "0", "--capture", str(moved)])
    assert f"Next: twofold render {run} --capture {moved}" in " ".join(capsys.readouterr().err.split())
    assert "already holds a run" in refused(capsys, "train", person_folder, "--out", run)


@pytest.mark.parametrize("size", [15, 100_000, -1])
def test_images_of_no_size_and_of_more_than_memory_holds_are_refused(
    size: int, trained: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said = refused(capsys, "render", trained.folder, "--out", tmp_path / "out", "--size", size)
    assert said == f"twofold: --size should be 16 to 4096; it is {size}."
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("command", ["render", "evaluate", "train"])
def test_a_run_is_not_drawn_measured_or_continued_with_somebody_else(
    command: str, trained: Run, person_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, other = shutil.copytree(trained.folder, tmp_path / "run"), shutil.copytree(person_folder, tmp_path / "other")
    with np.load(other / "motion.npz") as stored:
        arrays = dict(stored)
    np.savez(other / "motion.npz", **arrays | {"betas": arrays["betas"] + 0.1})
    before = files(run)
    with_it = [other, "--resume", run] if command == "train" else [run, "--capture", other]
    said = refused(capsys, command, *with_it)
    assert f"{other} is not what {run} was begun with (betas differs)" in said
    assert files(run) == before


def write_small_lpips(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both files of LPIPS for a network of few channels, and makes that the one that is looked for."""
    blocks = ((4, 4), (4, 4), (6, 6, 6), (6, 6, 6), (6, 6, 6))
    monkeypatch.setattr(perceptual, "_BLOCKS", blocks)
    monkeypatch.setattr(perceptual, "LPIPS", functools.partial(perceptual.LPIPS, blocks))
    monkeypatch.setenv("TWOFOLD_WEIGHTS", str(folder))
    monkeypatch.setenv("TWOFOLD_UNVERIFIED_WEIGHTS", "1")
    vgg, inputs = {}, 3
    names = [f"features.{number}" for number in (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)]
    for name, outputs in zip(names, [c for block in blocks for c in block], strict=True):
        vgg |= {f"{name}.weight": torch.rand(outputs, inputs, 3, 3), f"{name}.bias": torch.rand(outputs)}
        inputs = outputs
    folder.mkdir()
    torch.save(vgg, folder / perceptual.VGG_FILE)  # noqa: TID251
    linear = {f"lin{i}.model.1.weight": torch.rand(1, block[-1], 1, 1) for i, block in enumerate(blocks)}
    torch.save(linear, folder / perceptual.LINEAR_FILE)  # noqa: TID251


def test_perceptual_weights_shape_the_training_but_are_not_stored_with_it(
    person_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    small = [
        "method.field.width=72", "method.field.high_sdf_depth=4", "method.field.high_color_depth=2",
        "method.sampler.step=0.03", "method.losses.lpips_start=0", "method.losses.eikonal_points=16",
        "training.steps=2", "training.pixels.rays=16", "training.pixels.patches=1", "training.pixels.patch_size=16",
    ]  # fmt: skip
    train = ["train", str(person_folder), "--recipe", "fast", *(w for s in small for w in ("--set", s))]
    monkeypatch.setenv("TWOFOLD_WEIGHTS", str(tmp_path / "nowhere"))
    main([*train, "--out", str(tmp_path / "without")])
    assert str(tmp_path / "nowhere") in " ".join(capsys.readouterr().err.split())
    write_small_lpips(tmp_path / "weights", monkeypatch)
    main([*train, "--out", str(tmp_path / "with")])
    notes = {name: json.loads((tmp_path / name / "run.json").read_text())["notes"] for name in ("with", "without")}
    assert notes["with"] == ["LPIPS is part of the loss."]
    assert "LPIPS is left out" in notes["without"][0]
    (first, *_), (second, *_) = (read_checkpoint(tmp_path / name) for name in ("with", "without"))
    assert {name: tensor.shape for name, tensor in first.items()} == {n: t.shape for n, t in second.items()}
    columns = {name: (tmp_path / name / "curves.csv").read_text().split()[0].split(",") for name in notes}
    assert set(columns["with"]) - set(columns["without"]) == {"lpips"}
    (tmp_path / "weights" / perceptual.VGG_FILE).unlink()
    main(["evaluate", str(tmp_path / "with"), "--max-images", "1", "--max-meshes", "0"])


@pytest.mark.parametrize("command", ["studio", "render"])
def test_a_place_below_a_file_cannot_be_written(
    command: str, trained: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("mine")
    out = tmp_path / "file" / "out"
    arguments = [out] if command == "studio" else [trained.folder, "--out", out, "--what", "views"]
    assert f"Cannot write {out}" in refused(capsys, command, *arguments)
    assert (tmp_path / "file").read_text() == "mine"


def test_the_settings_of_a_recipe_are_shown_and_each_can_be_set(capsys: pytest.CaptureFixture[str]) -> None:
    main(["train", "--recipe", "fast", "--settings", "--set", "training.steps=7"])
    shown = [line.split("  ")[0].strip() for line in capsys.readouterr().out.splitlines()]
    keys = [line.partition(" = ")[0] for line in shown]
    assert "training.steps = 7" in shown
    assert {"method.field.width", "method.sampler.radius", "training.compile", "seed"} <= {*keys}
    same = with_overrides(RECIPES["fast"](), [line.replace(" = ", "=", 1) for line in shown])
    assert same == with_overrides(RECIPES["fast"](), ["training.steps=7"])


def test_help_has_a_line_for_each_recipe(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["train", "--help"])
    shown = " ".join(capsys.readouterr().out.replace("│", " ").split())
    for name, recipe in RECIPES.items():
        line = " ".join(str(recipe.__doc__).split("\n")[0].split())
        assert f"{name}: {line}" in shown
