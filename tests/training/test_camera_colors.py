"""Colours of several training cameras: what is learned, what it changes, and that it is kept to the bit."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from dense_start import dense
from PIL import Image
from small_recipes import CASES
from test_processes import ended, together
from tiny_person import tiny_recipe

from twofold import evaluation
from twofold.capture.folder import read_capture
from twofold.capture.types import Capture
from twofold.errors import TwofoldError
from twofold.geometry.cameras import Rays
from twofold.methods.base import Batch, Rendering
from twofold.recipe import Recipe
from twofold.training.camera_colors import CameraColors, LearnedResponse, load_camera_colors
from twofold.training.loop import train
from twofold.training.run import load, read_camera_colors, read_checkpoint

CPU = torch.device("cpu")
DARKER = np.array([0.9, 0.8, 0.75])


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


@pytest.fixture
def two_cameras(person: Capture, tmp_path: Path) -> Capture:
    """Both cameras train, and the second one shows the person darker and tinted."""
    folder = tmp_path / "both"
    shutil.copytree(person.folder, folder)
    description = json.loads((folder / "capture.json").read_text())
    description["splits"]["train"] = [{"camera": name, "times": [0, 1, 2, 3, 4]} for name in ("front", "side")]
    description["splits"]["novel_view"] = []
    (folder / "capture.json").write_text(json.dumps(description))
    for file in (folder / "images" / "side").iterdir():
        image = np.asarray(Image.open(file).convert("RGB"))
        Image.fromarray((image * DARKER).round().astype(np.uint8)).save(file)
    return read_capture(folder)


def recipe_of(steps: int, colors: str = "first", **training: object) -> Recipe:
    return tiny_recipe(steps, camera_colors=colors, images_per_step=2, **training)


def learned(reference: str = "first") -> CameraColors:
    """Three cameras with some colours."""
    colors = CameraColors(("a", "b", "c"), reference)  # type: ignore[arg-type]
    generator = torch.Generator().manual_seed(0)
    for parameter in colors.parameters():
        parameter.data.uniform_(-0.2, 0.2, generator=generator)
    return colors


def test_the_reference_keeps_its_colours() -> None:
    first, mean = learned("first"), learned("mean")
    assert torch.equal(first.gains()[0], torch.ones(3))
    assert torch.equal(first.offsets()[0], torch.zeros(3))
    torch.testing.assert_close(mean.gains().log().mean(0), torch.zeros(3), atol=1e-6, rtol=0)
    torch.testing.assert_close(mean.offsets().mean(0), torch.zeros(3), atol=1e-6, rtol=0)


def test_the_person_is_changed_and_the_background_stays() -> None:
    colors, generator = learned(), torch.Generator().manual_seed(1)
    person, opacity = torch.rand(50, 3, generator=generator), torch.rand(50, generator=generator)
    background = torch.tensor([0.2, 0.1, 0.3])

    def composited(shown: torch.Tensor) -> torch.Tensor:
        return opacity[:, None] * shown + (1 - opacity[:, None]) * background

    nothing = torch.zeros(50, 3)
    base = Rendering(composited(person / 2), opacity, opacity, nothing)
    extras = {"coarse": composited(person / 3), "coarse_opacity": opacity}
    rendering = Rendering(composited(person), opacity, opacity, nothing, base, extras)
    rays = Rays(nothing, nothing, opacity, opacity)
    none = torch.zeros(0, 2, 2, dtype=torch.long)
    batch = Batch(rays, nothing, opacity, 50, none, torch.zeros(0, 2, 2, 3), none.float(), 0, background)
    seen = colors.seen(rendering, batch, "b")
    gain, offset = colors.gains()[1], colors.offsets()[1]
    assert seen.base is not None
    for found, shown in ((seen.color, person), (seen.base.color, person / 2), (seen.extras["coarse"], person / 3)):
        torch.testing.assert_close(found, composited(gain * shown + offset))


def test_images_of_known_cameras_alone_are_changed() -> None:
    colors, generator = learned(), torch.Generator().manual_seed(1)
    response, opacity = LearnedResponse(colors), torch.ones(4, 5)
    image, background = 0.3 + 0.3 * torch.rand(4, 5, 3, generator=generator), torch.zeros(3)
    assert torch.equal(response.image(image, opacity, background, "held out"), image)
    expected = image * colors.gains()[2] + colors.offsets()[2]
    torch.testing.assert_close(response.image(image, opacity, background, "c"), expected.detach())
    assert response.numbers()["c_gain_red"] == pytest.approx(float(colors.gains().detach()[2, 0]))
    assert "the camera a" in response.protocol()


def test_a_cameras_colours_are_learned_and_the_avatar_has_the_firsts(two_cameras: Capture, tmp_path: Path) -> None:
    avatar = train(two_cameras, recipe_of(240, checkpoint_every=1000), tmp_path / "run", CPU)
    colors = read_camera_colors(tmp_path / "run")
    assert colors is not None
    assert colors.names == ("front", "side")
    assert torch.equal(colors.gains()[0], torch.ones(3))
    brightness = colors.gains()[1] + 2 * colors.offsets()[1]  # Of a grey in the middle
    assert np.abs(brightness.detach().numpy() - DARKER).max() < 0.08
    assert avatar.camera_response is not None
    loaded, _ = load(tmp_path / "run")
    frame = next(frame for frame in two_cameras.train if frame.camera_name == "side")
    own, stored = (evaluation.render_frame(a, two_cameras, frame, True).color for a in (avatar, loaded))
    assert torch.equal(own, stored)
    loaded.camera_response = None
    bright = evaluation.render_frame(loaded, two_cameras, frame, True).color
    inside = frame.mask() > 0.9
    assert float(stored[inside].mean() - bright[inside].mean()) < -0.02
    metrics = evaluation.measure(avatar, two_cameras, 2, 0)
    assert "training.camera_colors" in metrics["train"]["protocol"]["colours"]  # type: ignore[index]
    assert metrics["camera_colors"]["side_gain_blue"] == pytest.approx(float(colors.gains().detach()[1, 2]))  # type: ignore[index]


def test_an_interrupted_run_continues_to_the_same_bits(two_cameras: Capture, tmp_path: Path) -> None:
    recipe = recipe_of(9, "mean", checkpoint_every=3)
    train(two_cameras, recipe, tmp_path / "whole", CPU)

    class Stop(Exception):
        """Stands for whatever ends a run between two checkpoints."""

    def on_step(progress: object) -> None:
        if getattr(progress, "step", 0) == 5:
            raise Stop

    with pytest.raises(Stop):
        train(two_cameras, recipe, tmp_path / "cut", CPU, progress=on_step)
    train(two_cameras, recipe, tmp_path / "cut", CPU, resume=True)
    whole, cut = (read_checkpoint(tmp_path / name)[0] for name in ("whole", "cut"))
    assert whole.keys() == cut.keys()
    assert whole["camera_colors.log_gain"].abs().max() > 0
    for name, tensor in whole.items():
        assert torch.equal(tensor, cut[name]), name


def test_two_processes_learn_what_one_does(two_cameras: Capture, tmp_path: Path) -> None:
    recipe = recipe_of(6)
    recipe = replace(recipe, training=replace(recipe.training, images_per_step=4, clip=0.05))
    for code, said in ended(together(two_cameras, recipe, tmp_path / "two")):
        assert code == 0, said
    train(two_cameras, recipe, tmp_path / "one", CPU)
    one, two = (read_checkpoint(tmp_path / name)[0] for name in ("one", "two"))
    assert one["camera_colors.log_gain"].abs().max() > 0
    assert one.keys() == two.keys()
    for name, tensor in one.items():
        torch.testing.assert_close(two[name], tensor, rtol=1e-5, atol=1e-6, msg=name)


@pytest.mark.parametrize("name", CASES)
def test_every_method_learns_them(
    name: str, two_cameras: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The tiny person has no background.
    monkeypatch.setattr("twofold.methods.vid2avatar.require_backdrop", lambda capture: None)
    recipe = CASES[name]
    training = replace(recipe.training, steps=4, camera_colors="first")
    train(two_cameras, replace(recipe, training=training), tmp_path / "run", CPU, before_first=dense)
    colors = read_camera_colors(tmp_path / "run")
    assert colors is not None
    assert colors.log_gain.abs().max() > 0


def test_one_camera_has_nothing_to_learn(person: Capture, tmp_path: Path) -> None:
    for name, colors in (("off", "off"), ("first", "first")):
        avatar = train(person, recipe_of(4, colors), tmp_path / name, CPU)
        assert avatar.camera_response is None
        assert read_camera_colors(tmp_path / name) is None
    off, first = (read_checkpoint(tmp_path / name)[0] for name in ("off", "first"))
    assert all(torch.equal(first[name], tensor) for name, tensor in off.items())


def test_colours_of_other_cameras_are_refused(tmp_path: Path) -> None:
    stored = {f"camera_colors.{name}": tensor for name, tensor in learned().state_dict().items()}
    again = CameraColors(("a", "b", "c"), "first")
    load_camera_colors(again, stored, tmp_path)
    assert torch.equal(again.gains(), learned().gains())
    for names, tensors in ((("a", "b"), stored), (("a", "b", "c"), {})):
        with pytest.raises(TwofoldError, match="does not fit its training cameras"):
            load_camera_colors(CameraColors(names, "first"), tensors, tmp_path)
