"""Training repeats, resumes and survives being killed."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from small_recipes import CASES
from tiny_person import Run, completing_recipe, tiny_recipe

from twofold.capture.coverage import coverage_of
from twofold.capture.types import Capture
from twofold.errors import TwofoldError
from twofold.recipe import Recipe
from twofold.training import loop
from twofold.training.loop import COMPILED, NOTHING_COMPILED, Progress, train
from twofold.training.row_adam import few_visits
from twofold.training.run import read_checkpoint

CPU = torch.device("cpu")
SCRIPT = """
import sys, torch
from pathlib import Path
sys.path.insert(0, sys.argv[4])
from tiny_person import tiny_recipe
from dataclasses import replace
from twofold.capture.folder import read_capture
from twofold.errors import TwofoldError
from twofold.training.loop import Progress, train
torch.set_num_threads(1)
folder, steps, every = Path(sys.argv[2]), int(sys.argv[3]), 3
recipe = tiny_recipe(steps, checkpoint_every=every, images_per_step=2)
resume = (folder / "recipe.json").exists()
print("begun", flush=True)
def on_step(progress):
    print(progress.step, flush=True)
train(read_capture(sys.argv[1]), recipe, folder, torch.device("cpu"), resume=resume, progress=on_step)
"""


def state(folder: Path) -> dict[str, torch.Tensor]:
    """Everything a finished run stored."""
    return read_checkpoint(folder)[0]


def assert_same(first: dict[str, torch.Tensor], second: dict[str, torch.Tensor], tolerance: float = 0.0) -> None:
    assert first.keys() == second.keys()
    for name, tensor in first.items():
        torch.testing.assert_close(tensor, second[name], rtol=0, atol=tolerance, msg=name)


def recipe_of(steps: int, **training: object) -> Recipe:
    return completing_recipe(steps, checkpoint_every=3, images_per_step=2, **training)


def run_script(capture: Path, folder: Path, steps: int) -> subprocess.Popen[bytes]:
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    tests = str(Path(__file__).resolve().parents[1] / "helpers")
    command = [sys.executable, "-c", SCRIPT, str(capture), str(folder), str(steps), tests]
    with (folder.parent / "errors.txt").open("wb") as errors:
        return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=errors)


def finish(process: "subprocess.Popen[bytes]", folder: Path) -> None:
    process.communicate()
    assert process.returncode == 0, (folder.parent / "errors.txt").read_text()


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

    def on_step(progress: object) -> None:
        if getattr(progress, "step", 0) == 5:
            raise Stop

    with pytest.raises(Stop):
        train(person, recipe_of(9), tmp_path / "cut", CPU, progress=on_step)
    train(person, recipe_of(9), tmp_path / "cut", CPU, resume=True)
    assert_same(state(tmp_path / "whole"), state(tmp_path / "cut"))


def test_a_run_without_a_checkpoint_yet_resumes_from_its_start(person: Capture, tmp_path: Path) -> None:
    train(person, recipe_of(4), tmp_path / "whole", CPU)
    train(person, recipe_of(4), tmp_path / "cut", CPU)
    (tmp_path / "cut" / "checkpoint.safetensors").unlink()
    train(person, recipe_of(4), tmp_path / "cut", CPU, resume=True)
    assert_same(state(tmp_path / "whole"), state(tmp_path / "cut"))


@pytest.mark.parametrize("resume", [False, True])
def test_only_one_of_two_trainings_at_a_time_gets_the_folder(person: Capture, tmp_path: Path, resume: bool) -> None:
    refused: list[str] = []

    def again(progress: object) -> None:
        if getattr(progress, "step", 0) == 2:
            with pytest.raises(TwofoldError, match="is being trained by another process") as error:
                train(person, replace(recipe_of(1), seed=5), tmp_path / "run", CPU, resume=resume)
            refused.append(str(error.value))

    train(person, recipe_of(4), tmp_path / "whole", CPU)
    train(person, recipe_of(4), tmp_path / "run", CPU, progress=again)
    assert str(tmp_path / "run") in refused[0]
    assert_same(state(tmp_path / "whole"), state(tmp_path / "run"))
    assert {path.name for path in (tmp_path / "run").iterdir()} == {p.name for p in (tmp_path / "whole").iterdir()}


def reached(folder: Path) -> int:
    """The step of the folder's checkpoint, which must be whole; 0 without one."""
    return read_checkpoint(folder)[1] if (folder / "checkpoint.safetensors").exists() else 0


def kills(count: int, person: Capture, tmp_path: Path) -> list[int]:
    """Kills a training that many times, then lets it finish; the step of its checkpoint after each kill.

    Each time it may do up to nine steps, and then so much of the next ones as fits into a random part of 0.3 seconds.
    """
    steps, folder, random = 6 * count, tmp_path / "killed", np.random.default_rng(0)
    finish(run_script(person.folder, tmp_path / "whole", steps), tmp_path / "whole")
    trail = []
    for _ in range(count):
        process = run_script(person.folder, folder, steps)
        assert process.stdout is not None
        for _ in range(1 + random.integers(10)):
            process.stdout.readline()
        time.sleep(random.uniform(0, 0.3))
        process.send_signal(signal.SIGKILL)
        process.communicate()
        assert process.returncode in (0, -signal.SIGKILL), (folder.parent / "errors.txt").read_text()
        trail.append(reached(folder))
    assert trail == sorted(trail), "a checkpoint was lost"
    finish(run_script(person.folder, folder, steps), folder)
    assert_same(state(tmp_path / "whole"), state(folder))
    assert not [path.name for path in folder.iterdir() if "partial" in path.name]
    return trail


def test_a_run_killed_at_random_instants_ends_with_the_same_bits(person: Capture, tmp_path: Path) -> None:
    kills(2, person, tmp_path)


@pytest.mark.slow
def test_a_run_killed_twenty_times_ends_with_the_same_bits(person: Capture, tmp_path: Path) -> None:
    trail = kills(20, person, tmp_path)
    print(f"checkpoints after each kill of a run of 120 steps: {trail}")
    assert sum(step < 120 for step in trail) > 15, "kills should fall into the training"
    assert len(set(trail)) > 5


def dense(steps: int, compile: str) -> Recipe:
    """`fast` with networks so small that a step takes milliseconds."""
    start = CASES["fast"]
    return replace(start, training=replace(start.training, steps=steps, images_per_step=1, compile=compile))


@pytest.mark.parametrize(("choice", "compiled"), [("never", False), ("auto", False), ("always", True)])
def test_networks_run_compiled_where_the_recipe_asks_for_it_and_the_run_says_so(
    choice: str, compiled: bool, person: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted: list[object] = []
    ran: list[str] = []
    said: list[str] = []

    def compile_(function: Callable[..., object], **options: object) -> Callable[..., object]:
        wanted.append(options)
        return lambda *inputs: (ran.append(function.__name__), function(*inputs))[1]

    monkeypatch.setattr(torch, "compile", compile_)
    avatar = train(person, dense(1, choice), tmp_path / "run", CPU, say=said.append)
    assert wanted == [{"dynamic": True}] * (3 if compiled else 0)
    notes = [COMPILED] * compiled
    assert set(ran) == ({"forward", "_sdf", "distance_and_gradient"} if compiled else set())
    assert said == [*notes, coverage_of(person).sentence()]
    assert json.loads((tmp_path / "run" / "run.json").read_text())["notes"] == notes
    assert not {"forward", "sdf"} & set(vars(avatar.field))


def test_feature_grids_have_nothing_to_compile_and_the_run_says_so(
    person: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch, "compile", None)
    said: list[str] = []
    recipe = recipe_of(1, compile="always")
    avatar = train(person, recipe, tmp_path / "run", CPU, say=said.append)
    seldom = few_visits(avatar.parameter_groups(), recipe.training, len(avatar.subject.times))
    assert seldom is not None
    assert said == [seldom, NOTHING_COMPILED, coverage_of(person).sentence()]


COMPILING = """
import sys, torch
from pathlib import Path
sys.path.insert(0, sys.argv[3])
from training.test_loop import dense
from twofold.capture.folder import read_capture
from twofold.errors import TwofoldError
from twofold.training.loop import Progress, train
for choice in ("never", "always"):
    train(read_capture(sys.argv[1]), dense(4, choice), Path(sys.argv[2]) / choice, torch.device("cpu"))
"""


@pytest.mark.slow
def test_compiled_networks_learn_what_plain_ones_do(person: Capture, tmp_path: Path) -> None:
    """In a process of its own, since a compiler cannot look into functions whose shapes are being checked."""
    tests = str(Path(__file__).resolve().parents[1] / "helpers")
    command = [sys.executable, "-c", COMPILING, str(person.folder), str(tmp_path), tests]
    subprocess.run(command, check=True)
    plain, compiled = (state(tmp_path / choice) for choice in ("never", "always"))
    assert_same(plain, compiled, 1e-4)


@pytest.mark.parametrize(("case", "rays", "threads"), [("quick", 40, 1), ("quick", 9000, 2), ("fast", 40, 2)])
def test_only_small_steps_of_feature_grids_take_one_thread_for_each_operation(
    person: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, case: str, rays: int, threads: int
) -> None:
    before, within, after = torch.get_num_threads(), [], []
    start = CASES[case].training
    pixels = replace(start.pixels, rays=rays, patches=0)
    recipe = replace(CASES[case], training=replace(start, steps=1, preview_every=0, images_per_step=1, pixels=pixels))
    make_step = loop._Run.advance
    monkeypatch.setattr(loop._Run, "advance", lambda run: within.append(torch.get_num_threads()) or make_step(run))
    torch.set_num_threads(2)
    try:
        train(person, recipe, tmp_path / "run", CPU, progress=lambda _: after.append(torch.get_num_threads()))
        assert within == [threads]
        assert after == [2]
    finally:
        torch.set_num_threads(before)


def test_training_lowers_the_loss(trained: Run) -> None:
    seen = [sum(progress.losses.values()) for progress in trained.told]
    assert sum(seen[-10:]) < 0.7 * sum(seen[:10])


def test_a_surface_that_is_not_finite_ends_a_training(person: Capture, tmp_path: Path, monkeypatch) -> None:
    """Finite parameters may overflow where they are combined."""
    monkeypatch.setattr("twofold.training.loop._level_on_body", lambda avatar, frame: torch.tensor([0.1, torch.nan]))
    with pytest.raises(
        TwofoldError,
        match=r"diverged: the surface is not finite at step 2; lower the learning rates .now method.rates.low=",
    ):
        train(person, recipe_of(2), tmp_path / "run", CPU)
    assert not (tmp_path / "run" / "checkpoint.safetensors").exists()


def test_parameters_that_are_not_finite_end_a_training_before_they_are_drawn(person: Capture, tmp_path: Path) -> None:
    drawn = []

    def on_step(progress: Progress) -> None:
        if progress.step == 20:
            with torch.no_grad():
                next(p for p in avatars[0].parameters() if p.ndim == 2)[0, 0] = torch.nan

    avatars = []
    with pytest.raises(TwofoldError, match="is not finite at step 20"):
        train(
            person, tiny_recipe(40, preview_every=20, checkpoint_every=40), tmp_path / "run", CPU, progress=on_step,
            before_first=avatars.append, preview=lambda avatar, step: drawn.append(step),
        )  # fmt: skip
    assert drawn == []
