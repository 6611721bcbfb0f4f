"""Training repeats, resumes, survives being killed, and is the same for one process and two."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_person import Run, tiny_recipe

from twofold.capture.types import Capture
from twofold.train.loop import train
from twofold.train.run import Recipe, read_checkpoint

CPU = torch.device("cpu")
SCRIPT = """
import sys, torch
from pathlib import Path
sys.path.insert(0, sys.argv[4])
from tiny_person import tiny_recipe
from dataclasses import replace
from twofold.capture.folder import read_capture
from twofold.train.loop import train
torch.set_num_threads(1)
folder, steps, every = Path(sys.argv[2]), int(sys.argv[3]), 3
recipe = tiny_recipe(steps, checkpoint_every=every, images_per_step=2)
resume = (folder / "recipe.json").exists()
train(read_capture(sys.argv[1]), recipe, folder, torch.device("cpu"), resume=resume)
"""


def state(folder: Path) -> dict[str, torch.Tensor]:
    """Everything a finished run stored."""
    return read_checkpoint(folder)[0]


def assert_same(first: dict[str, torch.Tensor], second: dict[str, torch.Tensor], tolerance: float = 0.0) -> None:
    assert first.keys() == second.keys()
    for name, tensor in first.items():
        torch.testing.assert_close(tensor, second[name], rtol=0, atol=tolerance, msg=name)


def recipe_of(steps: int, **training: object) -> Recipe:
    return tiny_recipe(steps, checkpoint_every=3, images_per_step=2, **training)


def run_script(capture: Path, folder: Path, steps: int) -> subprocess.Popen[bytes]:
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    tests = str(Path(__file__).resolve().parents[1])
    command = [sys.executable, "-c", SCRIPT, str(capture), str(folder), str(steps), tests]
    with (folder.parent / "errors.txt").open("wb") as errors:
        return subprocess.Popen(command, env=environment, stderr=errors)


def finish(process: "subprocess.Popen[bytes]", folder: Path) -> None:
    assert process.wait() == 0, (folder.parent / "errors.txt").read_text()


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


def test_the_same_seed_gives_the_same_bits_and_another_does_not(person: Capture, tmp_path: Path) -> None:
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        train(person, replace(recipe_of(6), seed=seed), tmp_path / name, CPU)
    assert_same(state(tmp_path / "a"), state(tmp_path / "b"))
    with pytest.raises(AssertionError):
        assert_same(state(tmp_path / "a"), state(tmp_path / "c"))


def test_an_interrupted_run_continues_to_the_same_bits(person: Capture, tmp_path: Path) -> None:
    train(person, recipe_of(9), tmp_path / "whole", CPU)

    class Stop(Exception):
        """Stands for whatever ends a run between two checkpoints."""

    def watch(progress: object) -> None:
        if getattr(progress, "step", 0) == 5:
            raise Stop

    with pytest.raises(Stop):
        train(person, recipe_of(9), tmp_path / "cut", CPU, watch=watch)
    train(person, recipe_of(9), tmp_path / "cut", CPU, resume=True)
    assert_same(state(tmp_path / "whole"), state(tmp_path / "cut"))


def test_a_run_without_a_checkpoint_yet_resumes_from_its_start(person: Capture, tmp_path: Path) -> None:
    train(person, recipe_of(4), tmp_path / "whole", CPU)
    train(person, recipe_of(4), tmp_path / "cut", CPU)
    (tmp_path / "cut" / "checkpoint.safetensors").unlink()
    train(person, recipe_of(4), tmp_path / "cut", CPU, resume=True)
    assert_same(state(tmp_path / "whole"), state(tmp_path / "cut"))


def killed_and_resumed(capture: Path, folder: Path, steps: int, waits: list[float]) -> None:
    """Kills the run after each of the waits (seconds after its folder is there), then lets it finish."""
    for wait in waits:
        process = run_script(capture, folder, steps)
        while process.poll() is None and not (folder / "recipe.json").exists():
            time.sleep(0.02)
        time.sleep(wait)
        process.send_signal(signal.SIGKILL)
        process.wait()
    finish(run_script(capture, folder, steps), folder)


def kills(count: int, person: Capture, tmp_path: Path) -> None:
    finish(run_script(person.folder, tmp_path / "whole", 24), tmp_path / "whole")
    waits = np.random.default_rng(0).uniform(0, 4, count).tolist()
    killed_and_resumed(person.folder, tmp_path / "killed", 24, waits)
    assert_same(state(tmp_path / "whole"), state(tmp_path / "killed"))


def test_a_run_killed_at_random_instants_ends_with_the_same_bits(person: Capture, tmp_path: Path) -> None:
    kills(2, person, tmp_path)


@pytest.mark.slow
def test_a_run_killed_twenty_times_ends_with_the_same_bits(person: Capture, tmp_path: Path) -> None:
    kills(20, person, tmp_path)


def test_training_lowers_the_loss(trained: Run) -> None:
    seen = [sum(progress.losses.values()) for progress in trained.told]
    assert sum(seen[-10:]) < 0.7 * sum(seen[:10])
