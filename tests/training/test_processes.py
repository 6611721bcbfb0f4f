"""Several processes that train together do what one does alone."""

import os
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from dense_start import dense
from small_recipes import CASES
from tiny_person import tiny_recipe

from twofold.capture.types import Capture
from twofold.files import write_json
from twofold.losses import total
from twofold.methods.base import Mode
from twofold.methods.subject import Subject
from twofold.methods.table import RECIPES, recipe_to_dict
from twofold.recipe import Recipe
from twofold.training.curves import Curves
from twofold.training.loop import Step, train
from twofold.training.pixels import PixelSource
from twofold.training.processes import Team, announced
from twofold.training.run import read_checkpoint

TESTS = str(Path(__file__).resolve().parents[1] / "helpers")
SCRIPT = """
import sys, torch
from pathlib import Path
from dense_start import dense
from twofold.cli import main as cli
from twofold.capture.folder import read_capture
from twofold.inputs import read_json
from twofold.methods.table import recipe_from_dict
from twofold.training import loop
torch.set_num_threads(1)
capture, folder, recipe = map(Path, sys.argv[1:])
chosen = recipe_from_dict(read_json(recipe), str(recipe))
def run():
    resume = (folder / "recipe.json").exists()
    loop.train(read_capture(capture), chosen, folder, torch.device("cpu"), resume, before_first=dense)
cli.COMMANDS = {"go": run, "stay": run}
cli.main(["go"])
"""


def together(capture: Capture, recipe: Recipe, folder: Path, size: int = 2) -> "list[subprocess.Popen[str]]":
    """Starts a team as `torchrun` does, by what it says in the environment."""
    write_json(folder.parent / "wanted.json", recipe_to_dict(recipe))
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    shared = {"WORLD_SIZE": str(size), "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "OMP_NUM_THREADS": "1"}
    shared["PYTHONPATH"] = os.pathsep.join([TESTS, os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, "-c", SCRIPT, str(capture.folder), str(folder), str(folder.parent / "wanted.json")]
    return [
        subprocess.Popen(command, env={**os.environ, **shared, "RANK": str(rank)}, stderr=subprocess.PIPE, text=True)
        for rank in range(size)
    ]


def ended(team: "list[subprocess.Popen[str]]") -> list[tuple[int, str]]:
    """Exit codes of a team and what each of its processes said."""
    said = [process.communicate(timeout=300)[1] for process in team]
    return [(process.returncode, text) for process, text in zip(team, said, strict=True)]


def wait_for(path: Path, team: "list[subprocess.Popen[str]]") -> None:
    """Until a team has made this file or folder."""
    while not path.exists():
        assert all(process.poll() is None for process in team), ended(team)
        time.sleep(0.1)


def last_losses(folder: Path) -> dict[str, float]:
    curves = Curves(folder, 10**9)
    curves.close()
    return curves.rows[-1]


def test_without_torchrun_a_process_is_alone() -> None:
    assert announced() == Team(0, 1)
    assert Team().leads


def test_two_processes_learn_what_one_does(person: Capture, tmp_path: Path) -> None:
    recipe = tiny_recipe(8, images_per_step=4, clip=0.05)
    for code, said in ended(together(person, recipe, tmp_path / "two")):
        assert code == 0, said
    torch.set_num_threads(1)
    train(person, recipe, tmp_path / "one", torch.device("cpu"))
    one, two = (read_checkpoint(tmp_path / name)[0] for name in ("one", "two"))
    assert one.keys() == two.keys()
    for name, tensor in one.items():
        torch.testing.assert_close(two[name], tensor, rtol=1e-5, atol=1e-6, msg=name)
    assert last_losses(tmp_path / "two") == pytest.approx(last_losses(tmp_path / "one"), rel=1e-5)


@pytest.mark.slow
def test_a_team_stops_together_when_one_is_asked_to_and_goes_on_together(person: Capture, tmp_path: Path) -> None:
    recipe = tiny_recipe(400, images_per_step=2, checkpoint_every=1000)
    team = together(person, recipe, tmp_path / "run")
    wait_for(tmp_path / "run" / "tensorboard", team)
    time.sleep(1)
    team[1].send_signal(signal.SIGINT)
    assert [code for code, _ in ended(team)] == [130, 130]
    _, stopped, _ = read_checkpoint(tmp_path / "run")
    assert 0 < stopped < 400
    shorter = replace(recipe, training=replace(recipe.training, steps=stopped + 2))
    assert [code for code, _ in ended(together(person, shorter, tmp_path / "run"))] == [0, 0]
    train(person, shorter, tmp_path / "one", torch.device("cpu"))
    one, two = (read_checkpoint(tmp_path / name)[0] for name in ("one", "run"))
    assert one["avatar.raw_beta"].item() == pytest.approx(two["avatar.raw_beta"].item(), rel=1e-3)


@pytest.mark.slow
def test_a_process_whose_partner_ends_says_so_in_one_sentence(person: Capture, tmp_path: Path) -> None:
    recipe = tiny_recipe(400, images_per_step=2, checkpoint_every=1000)
    team = together(person, recipe, tmp_path / "run")
    wait_for(tmp_path / "run" / "tensorboard", team)
    team[1].kill()
    code, said = ended(team)[0]
    assert code == 2, said
    assert said.strip() == "twofold: Another of the processes that train together has ended; what it says is the cause."


FAST = [name for name in RECIPES if name.endswith("_fast")]


@pytest.mark.parametrize(("name", "which"), [*((name, 0) for name in FAST), ("npc_fast", 1)])
def test_parts_of_a_step_add_up_to_the_whole_by_every_method(name: str, which: int, person: Capture) -> None:
    """What each of two processes computes of a step of a stage, averaged as DDP does, is what one computes."""
    start = CASES[name]
    training = replace(start.training, images_per_step=2, pixels=replace(start.training.pixels, rays=24))
    subject = Subject.of(person)
    avatar = start.method.build(subject, 0)
    avatar.check_capture = lambda capture: None  # the tiny person has no background
    for before in range(which + 1):
        avatar.prepare_training(person, before, torch.Generator().manual_seed(0))
        dense(avatar)
    stages = avatar.stages(training)
    assert which == len(stages) - 1 or name == "npc_fast"
    stage = stages[which]
    source = PixelSource(person.train, subject.body, subject.betas, stage.training.pixels, avatar.ray_margin)
    step = Step(avatar, source, torch.tensor(person.background), stage, 0)
    mode = Mode(step=40, epoch=16)

    def gradients(team: Team) -> tuple[dict[str, torch.Tensor], float]:
        avatar.zero_grad(set_to_none=True)
        terms, _ = step(40, mode, team)
        loss = total(terms)
        loss.backward()
        return {n: p.grad.clone() for n, p in avatar.named_parameters() if p.grad is not None}, float(loss.detach())

    whole, loss = gradients(Team())
    parts = [gradients(Team(rank, 2)) for rank in range(2)]
    assert loss == pytest.approx(sum(part for _, part in parts) / 2, rel=1e-5)
    assert whole
    for key, gradient in whole.items():
        mean = sum((part.get(key, torch.zeros_like(gradient)) for part, _ in parts), torch.zeros_like(gradient)) / 2
        assert (mean - gradient).norm() <= 1e-3 * gradient.norm() + 1e-9, key


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in FAST if name != "vid2avatar_fast"])  # that one wants a background
def test_two_processes_learn_what_one_does_by_every_method(name: str, person: Capture, tmp_path: Path) -> None:
    """Over whole trainings, stages included; Adam magnifies rounding where gradients are next to nothing."""
    start = CASES[name]
    pixels = replace(start.training.pixels, rays=24)
    training = replace(start.training, steps=4, images_per_step=2, warmup=0, pixels=pixels, preview_every=0)
    recipe = replace(start, training=training)
    for code, said in ended(together(person, recipe, tmp_path / "two")):
        assert code == 0, said
    torch.set_num_threads(1)
    train(person, recipe, tmp_path / "one", torch.device("cpu"), before_first=dense)
    (one, done, _), (two, also, _) = (read_checkpoint(tmp_path / folder) for folder in ("one", "two"))
    assert done == also == recipe.method.total_steps(training)
    assert one.keys() == two.keys()
    assert last_losses(tmp_path / "two") == pytest.approx(last_losses(tmp_path / "one"), rel=2e-3)
