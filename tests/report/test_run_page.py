"""A run's page: everything that was asked for is in it, in one file that loads nothing."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import refused
from test_parts import Page

from twofold.capture.types import Capture
from twofold.cli.main import main
from twofold.html.interactive import client_script
from twofold.methods.table import RECIPES, with_settings
from twofold.outputs.sheets import error_map
from twofold.outputs.views import RenderedImage
from twofold.report import page_images
from twofold.report.page_character import joint_controls
from twofold.report.page_images import HeldOut, branches_row, enlarged, one_each
from twofold.report.run_page import shareable, training_command
from twofold.training.run import load

HOSTS = re.compile(r"https?://", re.IGNORECASE)


@pytest.fixture(scope="module")
def written(trained, person_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Page]:
    """The page of a small run, made by the command."""
    pytest.importorskip("xatlas")
    pytest.importorskip("fast_simplification")
    run = tmp_path_factory.mktemp("reported") / 'run <script> & "co"'
    shutil.copytree(trained.folder, run)
    words = ["--size", "64", "--frames", "2", "--max-images", "2", "--max-meshes", "1", "--faces", "800"]
    main(
        ["report", str(run), "--capture", str(person_folder), "--motion", "walk", "--mesh", *words, "--texture", "128"]
    )
    path = run / "report.html"
    return path, Page(path.read_text(encoding="utf-8"))


def test_page_shows_the_run(written: tuple[Path, Page]) -> None:
    _, page = written
    headings = [
        "The character",
        "Novel views",
        "Novel poses",
        "Canonical space",
        "Two branches",
        "Coverage",
        "Training",
    ]
    for words in [*headings, "All metrics, and how they were measured", "Recipe, and how to reproduce this"]:
        assert words in page.text, words
    assert "Renderer: the baked mesh, rasterized" in page.text
    assert "Renderer: the field, volume rendered" in page.text
    assert "psnr_box" in page.text
    assert "settings of the recipe" in page.text
    assert "capture" in page.text
    assert "walk" in page.text


def test_page_loads_nothing_and_names_hosts_in_links_alone(written: tuple[Path, Page]) -> None:
    path, page = written
    for tag, attributes in page.elements:
        for name, value in attributes.items():
            if tag != "a" and name in ("src", "href", "srcset", "data", "poster", "action", "content", "style"):
                assert not HOSTS.search(value or ""), (tag, name, value)
        if "src" in attributes:
            assert (attributes["src"] or "").startswith("data:")
    style = re.findall(r"<style>(.*?)</style>", path.read_text(), re.DOTALL)[0]
    assert "url(" not in style
    assert not page.all("link")
    assert not page.all("iframe")


def test_a_strange_name_of_the_run_breaks_nothing(written: tuple[Path, Page]) -> None:
    path, page = written
    text = path.read_text()
    without = text.replace(str(client_script()), "")
    assert without.count("</script>") == len(page.all("script"))
    assert 'run <script> & "co"' in page.text


def test_small_page_for_a_small_run(written: tuple[Path, Page]) -> None:
    path, _ = written
    assert path.stat().st_size < 3e6
    assert {file.name for file in path.parent.iterdir()} >= {"report.html", "bakes", "metrics.json"}
    assert not list(path.parent.glob("*.mp4")), "videos are in the page"


def test_stored_metrics_are_taken_as_they_are(
    written: tuple[Path, Page], trained, person_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from twofold import evaluation
    from twofold.report import page_character

    run = tmp_path / "run"
    shutil.copytree(trained.folder, run)
    (run / "metrics.json").write_text(json.dumps({"novel_view": {"psnr_box": 12.345, "protocol": "by hand"}}))
    monkeypatch.setattr(evaluation, "evaluate", None)
    monkeypatch.setattr(page_character, "missing_packages", lambda config: ["xatlas"])
    small = ["--size", "64", "--frames", "1", "--mesh"]
    main(["report", str(run), "--capture", str(person_folder), "--out", str(tmp_path / "a.html"), *small])
    page = Page((tmp_path / "a.html").read_text())
    assert "12.35" in page.text or "12.34" in page.text
    assert "by hand" in page.text
    assert "needs xatlas" in page.text, "a page without the packages for the character says which"
    assert not page.all("script")
    assert not page.all("canvas")


def test_output_is_checked_before_any_work(trained, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "--out should end in .html" in refused(capsys, "report", trained.folder, "--out", tmp_path / "page.pdf")
    assert "--frames should be 1 to 30" in refused(capsys, "report", trained.folder, "--frames", "0")


def test_training_command_names_what_differs_from_the_recipe() -> None:
    recipe = with_settings(RECIPES["quick"](), ["seed=3", "training.steps=77"])
    words = training_command(recipe, Path("cap"), Path("runs/a b"))
    assert words == "twofold train cap --out 'runs/a b' --recipe quick --seed 3 --set training.steps=77"
    assert training_command(RECIPES["fast"](), Path("c"), Path("r")) == "twofold train c --out r --recipe fast"


def test_paths_on_the_page_do_not_tell_where_its_maker_works(
    written: tuple[Path, Page], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, page = written
    assert str(path.parent.parent) not in page.text
    monkeypatch.chdir(tmp_path)
    assert shareable(tmp_path / "runs" / "me") == Path("runs/me")
    assert shareable(Path("runs/me")) == Path("runs/me")
    assert shareable(tmp_path.parent / "other" / "me") == Path("me")


def test_branches_are_shown_where_there_are_two(person: Capture) -> None:
    frame = person.train[0]
    size = frame.camera.height, frame.camera.width
    flat, opaque = torch.full((*size, 3), 0.5), torch.ones(size)
    both = RenderedImage(flat, opaque, opaque, flat, flat, flat, opaque)
    captions = [image.caption for image in branches_row(HeldOut("novel_view", frame, both)).images]
    assert captions == ["full", "pose-independent base", "residual", "normals", "normals of the base"]
    assert branches_row(HeldOut("novel_view", frame, replace(both, base_opacity=None))) is None


def test_a_long_motion_is_cut_and_the_page_says_so(
    person: Capture, trained, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(page_images, "MAX_MOTION", 1)
    whole, shown = page_images.held_out_motion(person)
    assert (shown, whole > 1) == (1, True)
    rendered: list[None] = []
    avatar, _ = load(trained.folder)
    video = page_images.write_novel_poses(tmp_path / "a.mp4", avatar, person, 16, lambda: rendered.append(None))
    assert len(rendered) == 1
    assert video.caption.startswith(f"The first 1 of {whole} frames")
    assert page_images.write_novel_poses(tmp_path / "b.mp4", avatar, replace(person, splits={}), 16) is None


def test_error_map_grows_brighter_with_the_difference() -> None:
    truth = torch.zeros(1, 4, 3)
    color = torch.tensor([0.0, 0.05, 0.2, 1.0])[None, :, None].expand(1, 4, 3)
    shown = error_map(color, truth).sum(-1)[0]
    assert shown[0] < 0.05
    assert (shown.diff() > 0.2).all()


def test_frames_are_of_different_cameras(person: Capture) -> None:
    frames = person.splits["novel_view"]
    cameras = {frame.camera_name for frame in frames}
    chosen = one_each(frames, len(cameras))
    assert {frame.camera_name for frame in chosen} == cameras
    assert one_each((), 3) == []


def test_enlarged_images_keep_their_shape() -> None:
    small = np.random.default_rng(0).integers(0, 255, (100, 40, 3), dtype=np.uint8)
    assert enlarged(small).shape == (300, 120, 3)
    assert enlarged(np.zeros((400, 10, 3), np.uint8)).shape == (400, 10, 3)


def test_joints_can_be_turned_as_a_persons() -> None:
    controls = {control.label: control.limits for control in joint_controls()}
    assert controls["left knee"][0] == (-5, 150)
    assert controls["right elbow"][1] == (-10, 155)
    assert controls["pelvis"] == ((-180, 180),) * 3
