"""The parts of `benchmarks.gpu`, one a process: `python -m benchmarks.gpu_parts NAME ...`."""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import json
import os
import platform
import shutil
import signal
import subprocess
import sys
import time
import traceback
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from benchmarks.common import machine, peak_memory_gb, studio_capture
from benchmarks.rendering import seconds as seconds_an_image
from twofold.capture.folder import read_capture
from twofold.capture.types import Capture
from twofold.evaluation import measure_split
from twofold.kernels.runtime import tune_process
from twofold.methods.base import Avatar
from twofold.methods.factorized_recipes import fast, quick
from twofold.methods.subject import Subject
from twofold.outputs.views import render_image
from twofold.recipe import Recipe
from twofold.training.loop import Progress, train
from twofold.training.run import load

NEEDED = (
    "av", "jaxtyping", "jinja2", "matplotlib", "numba", "numpy", "PIL", "rich", "safetensors", "skimage", "scipy",
    "tensorboard", "tyro", "pytest", "beartype", "hypothesis",
)  # fmt: skip
STEPS, LOSS_TOLERANCE = 5, (1e-3, 5e-2)
"""Training steps that are compared, and how far the losses of the first and of the last may be apart, relatively.

Sums in another order differ in the last digits; each step's update by Adam then enlarges that.
"""
COLOR_TOLERANCE, FEW = 2e-3, 0.01
"""Mean difference of a rendered image's colours, 0..1, and the share of pixels that may differ by more than 2/255: on
the two sides of an edge of the samples' grid."""


@dataclass(frozen=True)
class Task:
    """What a part is told: where it runs, for how long, on what, and a folder that the parts share."""

    device: torch.device
    seconds: float
    capture: Path | None
    folder: Path
    size: int
    tests: tuple[str, ...]

    def read(self) -> Capture:
        """The capture; a synthetic one where none was given."""
        return read_capture(self.capture) if self.capture else studio_capture(128, 20, 3)


def environment(task: Task) -> dict[str, object]:
    """Versions, the GPU, and which modules are missing."""
    found: dict[str, object] = {**machine(), "python": platform.python_version(), "cuda": torch.version.cuda}
    found["missing_modules"] = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    for name in ("numpy", "scipy", "numba"):
        found[name] = getattr(importlib.import_module(name), "__version__", None)
    if task.device.type == "cuda":
        found["gpu_memory_gb"] = torch.cuda.get_device_properties(task.device).total_memory / 2**30
        found["capability"] = torch.cuda.get_device_capability(task.device)
    torch.ones(8, device=task.device).sum().item()
    return found


def short(recipe: Recipe, steps: int) -> Recipe:
    """The recipe for some steps, without previews."""
    return replace(recipe, training=replace(recipe.training, steps=steps, preview_every=0))


def compare(task: Task) -> dict[str, object]:
    """Losses of the first steps and a rendered image on the device beside the processor's, within tolerance."""
    capture = task.read()
    found: dict[str, object] = {"loss_tolerance": LOSS_TOLERANCE, "color_tolerance": COLOR_TOLERANCE, "few": FEW}
    wrong: list[str] = []
    for name, recipe in (("quick", few_rays(quick())), ("fast", few_rays(fast()))):
        losses: dict[str, list[float]] = {}
        for device in ("cpu", str(task.device)):
            steps: list[float] = []
            folder = new_place(task, f"compare-{name}-{device.replace(':', '')}-{len(losses)}")
            on_step = watched(lambda p, steps=steps: steps.append(sum(p.losses.values())))
            train(capture, short(recipe, STEPS), folder, torch.device(device), progress=on_step)
            losses[f"{device} {len(losses)}"] = steps
        ours, theirs = losses.values()
        apart = [abs(a - b) / max(abs(a), 1e-9) for a, b in zip(ours, theirs, strict=True)]
        run = task.folder / f"compare-{name}-cpu-0"
        images = [image(load(run, device)[0], capture, 128) for device in ("cpu", task.device)]
        difference = (images[0] - images[1]).abs()
        mean, many = float(difference.mean()), float((difference.amax(-1) > 2 / 255).float().mean())
        found[name] = {
            "losses": losses, "loss_apart": apart, "color_mean_apart": mean, "pixels_apart": many,
        }  # fmt: skip
        wrong += [f"{name}: loss of step 1 is {apart[0]:.2g} apart"] * (apart[0] > LOSS_TOLERANCE[0])
        wrong += [f"{name}: loss of step {STEPS} is {apart[-1]:.2g} apart"] * (apart[-1] > LOSS_TOLERANCE[1])
        wrong += [f"{name}: colours are {mean:.2g} apart"] * (mean > COLOR_TOLERANCE)
        wrong += [f"{name}: {many:.1%} of the pixels differ"] * (many > FEW)
    return found | ({"failed": "; ".join(wrong)} if wrong else {})


def few_rays(recipe: Recipe) -> Recipe:
    """Few enough for a processor to take some steps within seconds."""
    pixels = replace(recipe.training.pixels, rays=128, patches=0)
    return replace(recipe, training=replace(recipe.training, pixels=pixels, images_per_step=1))


def image(avatar: Avatar, capture: Capture, size: int) -> torch.Tensor:
    """The first training frame, rendered."""
    frame = capture.train[0]
    camera = frame.camera.resized(size, round(frame.camera.width * size / frame.camera.height))
    with torch.no_grad():
        posed = avatar.pose(frame.pose, frame.translation)
        return render_image(
            avatar, posed, camera.to(posed.body.vertices.device), torch.tensor(capture.background)
        ).color.cpu()


def new_place(task: Task, name: str) -> Path:
    """A folder for a run; what another try has left there goes."""
    folder = task.folder / name
    if folder.exists():
        shutil.rmtree(folder)
    return folder


def watched(note: Callable[[Progress], object]) -> Callable[[Progress], None]:
    """A progress callback from a function whatever it returns."""

    def on_step(progress: Progress) -> None:
        note(progress)

    return on_step


def trained(task: Task, name: str, recipe: Recipe) -> dict[str, object]:
    """Trains as long as there is time: speed, and PSNR on held-out images."""
    capture = task.read()
    folder = new_place(task, f"train-{name}")
    marks: list[tuple[int, float, float]] = []

    def on_step(progress: Progress) -> None:
        marks.append((progress.step, time.perf_counter(), progress.psnr))
        late = [mark for mark in marks[-2:] if mark[1] - begun > task.seconds]
        if len(late) == 1:  # Once: the loop stores its state after the next step; a second time it would not.
            signal.raise_signal(signal.SIGINT)

    begun = time.perf_counter()
    recipe = short(recipe, recipe.training.steps)
    with contextlib.suppress(KeyboardInterrupt):
        train(capture, recipe, folder, task.device, progress=on_step)
    if not marks:
        raise RuntimeError("not one step was made")
    # The first steps load kernels and fill caches.
    settled = marks[min(len(marks) // 5, 20)]
    steps, spent = marks[-1][0] - settled[0], marks[-1][1] - settled[1]
    found: dict[str, object] = {
        "steps": marks[-1][0], "steps_of_the_recipe": recipe.training.steps, "first_step_s": marks[0][1] - begun,
        "steps_per_s": steps / spent if spent else None, "training_psnr": marks[-1][2],
        "peak_memory_gb": peak_memory_gb(),
    }  # fmt: skip
    if task.device.type == "cuda":
        found["peak_gpu_memory_gb"] = torch.cuda.max_memory_allocated(task.device) / 2**30
    avatar, _ = load(folder, task.device)
    split = next(name for name in ("novel_view", "novel_pose", "train") if capture.splits.get(name))
    with torch.no_grad():
        measured = measure_split(avatar, capture, split, 4)
    return found | {"split": split, **{key: value for key, value in measured.items() if isinstance(value, float)}}


def render(task: Task) -> dict[str, object]:
    """Seconds for an image of the two recipes' avatars, as far as the parts before have trained them."""
    capture = task.read()
    found: dict[str, object] = {"size": task.size}
    for name, recipe in (("quick", quick()), ("fast", fast())):
        folder = task.folder / f"train-{name}"
        at_hand = (folder / "checkpoint.safetensors").exists()
        if at_hand:
            avatar, steps = load(folder, task.device)
        else:
            avatar, steps = recipe.method.build(Subject.of(capture), 0).to(task.device).eval(), 0
        found[name] = {**seconds_an_image(avatar, capture, task.size, 3), "trained_steps": steps}
    return found


def compiled(task: Task) -> dict[str, object]:
    """`fast` through torch.compile: what the first step takes, and the speed after it."""
    recipe = fast()
    recipe = replace(recipe, training=replace(recipe.training, compile="always"))
    if task.device.type == "cpu":
        recipe = few_rays(recipe)
    return trained(task, "compiled", recipe)


def tests(task: Task) -> dict[str, object]:
    """The tests that ask for a device, on this one."""
    report = task.folder / "tests.xml"
    words = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-k", f"[{task.device.type}"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(["src", os.environ.get("PYTHONPATH", "")])}
    words += [f"--junitxml={report}", *task.tests]
    ended = subprocess.run(words, check=False, timeout=max(task.seconds, 30), env=environment)
    suite = ElementTree.parse(report).getroot().find("testsuite")
    if suite is None:
        return {"failed": f"no test ran, exit code {ended.returncode}"}
    counts = {key: int(suite.get(key, "0")) for key in ("tests", "failures", "errors", "skipped")}
    broken = [f"{case.get('classname')}.{case.get('name')}" for case in suite if len(case) and case[0].tag != "skipped"]
    wrong = broken or not counts["tests"]
    found: dict[str, object] = {**counts, "broken": broken}
    return found | ({"failed": f"{len(broken)} of {counts['tests']} tests"} if wrong else {})


PARTS: dict[str, Callable[[Task], dict[str, object]]] = {
    "environment": environment,
    "compare": compare,
    "train-quick": lambda task: trained(task, "quick", quick()),
    "train-fast": lambda task: trained(task, "fast", fast()),
    "render": render,
    "compiled": compiled,
    "tests": tests,
}


def main() -> None:
    """Runs one part; whatever it raises stands in its result."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("part", choices=list(PARTS))
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--capture", default="")
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--result", type=Path, required=True)
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--tests", nargs="+", default=["tests"])
    given = parser.parse_args()
    tune_process()
    result: dict[str, object]
    try:
        task = Task(
            torch.device(given.device), given.seconds, Path(given.capture) if given.capture else None, given.folder,
            given.size, tuple(given.tests),
        )  # fmt: skip
        result = PARTS[given.part](task)
    except Exception as error:  # Whatever it is, the other parts go on, and this is what there is to know.
        result = {"failed": f"{type(error).__name__}: {error}"[:500], "log": traceback.format_exc().splitlines()[-15:]}
    given.result.write_text(json.dumps(result) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
