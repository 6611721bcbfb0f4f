"""Compares speed and quality with `benchmarks/baseline.json`, and reports what has become worse.

Speed is measured as ratios of processor time: each compiled form over its slow twin in the same process, so that the
numbers mean the same on another machine. Quality is read from the metrics of a demo, where one is given.

    python -m benchmarks.regressions [--metrics demo/run/metrics.json] [--write]

The exit code is the number of regressions. `--write` stores what was measured as the new baseline.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from benchmarks.common import studio_capture
from twofold.geometry.cameras import pixel_grid, pixel_rays
from twofold.kernels.kdtree import query_nearest, search_tree
from twofold.kernels.runtime import tune_process
from twofold.methods.factorized import FactorizedAvatar
from twofold.methods.factorized_recipes import quick
from twofold.methods.subject import Subject
from twofold.sampling.shell import Shell, sample_shell

BASELINE = Path(__file__).parent / "baseline.json"
SLOWER = 1.3
"""A ratio counts as worse where it is more than this many times that of the baseline."""
METRICS = {"novel_view.psnr_box": -0.3, "novel_pose.psnr_box": -0.3, "geometry.chamfer_cm": 0.05}
"""Metrics of the demo, and by how much each may change for the worse."""


def processor_seconds(work: Callable[[], object], repeats: int = 5) -> float:
    """Least processor time of some calls after one to warm up."""
    work()
    seconds = []
    for _ in range(repeats):
        begun = time.process_time()
        work()
        seconds.append(time.process_time() - begun)
    return min(seconds)


def field_ratios(avatar: FactorizedAvatar) -> dict[str, float]:
    """The compiled field over the same in PyTorch: distances alone, and a training step's passes."""
    field, vertices = avatar.field, avatar.canonical_points
    generator = torch.Generator().manual_seed(0)
    which = torch.randint(len(vertices), (8192,), generator=generator)
    x = vertices[which] + 0.02 * torch.randn(len(which), 3, generator=generator)
    pose, turn = torch.zeros(69), torch.eye(3).repeat(len(x), 1, 1)

    @torch.no_grad()
    def distances() -> None:
        field.sdf(x, pose)

    def step() -> None:
        out = field(x, pose, turn)
        slope = field.distance_and_gradient(x[:512], pose)[1]
        assert out.base is not None
        (out.color.square().sum() + out.base.color.sum() + out.sdf.sum() + slope.square().sum()).backward()
        field.zero_grad()

    fast = [processor_seconds(work) for work in (distances, step)]
    vars(field)["_fused"] = lambda *_: None
    slow = [processor_seconds(work) for work in (distances, step)]
    del vars(field)["_fused"]
    return {f"field.{name}": a / b for name, a, b in zip(("distances", "step"), fast, slow, strict=True)}


def sampling_ratios(avatar: FactorizedAvatar, shell: Shell, size: int) -> dict[str, float]:
    """Samples found by the compiled walk over the walk in PyTorch; a shell over a search tree's answers for it."""
    capture = studio_capture(64, 4, 1)
    frame = capture.train[0]
    rays = pixel_rays(frame.camera.resized(size, size), pixel_grid(frame.camera.resized(size, size)).flatten(0, 1))
    double = type(rays)(*(value.double() for value in vars(rays).values()))
    limit, step = avatar.config.sampler.reach, 0.01

    def build() -> None:
        avatar.config.sampler.shell(shell.vertices, 6)

    centers = shell.vertices[shell.nearest[:, 0].long()].numpy().astype(np.float32)
    vertices = shell.vertices.numpy()
    walks = [processor_seconds(lambda r=r: sample_shell(shell, r, step, None, limit, 6)) for r in (rays, double)]
    tree = processor_seconds(lambda: query_nearest(search_tree(vertices, quick=True), centers + 0.04, 12))
    return {"sampling.walk": walks[0] / walks[1], "sampling.shell": processor_seconds(build) / tree}


def measured() -> dict[str, float]:
    """All ratios, by name; less is better."""
    torch.set_num_threads(1)
    tune_process()
    capture = studio_capture(64, 4, 1)
    avatar = quick().method.build(Subject.of(capture), 0)
    with torch.no_grad():
        shell = avatar.pose(capture.train[0].pose, capture.train[0].translation).own.surface.shell
        return sampling_ratios(avatar, shell, 64) | torch.enable_grad()(field_ratios)(avatar)


def demo_metrics(file: Path) -> dict[str, float]:
    """Those of `METRICS`, from a `metrics.json`; names with a dot lie in nested objects."""
    found: dict[str, float] = {}
    stored = json.loads(file.read_text(encoding="utf-8"))
    for name in METRICS:
        value = stored
        for key in name.split("."):
            value = value[key]
        found[name] = float(value)
    return found


def regressions(
    baseline: dict[str, dict[str, float]], ratios: dict[str, float], metrics: dict[str, float]
) -> list[str]:
    """One sentence for each number that is worse than the baseline allows.

    >>> regressions({"ratios": {"a": 0.5}, "metrics": {}}, {"a": 0.9}, {})
    ['a takes 0.90 of its slow twin, the baseline 0.50']
    """
    worse = [
        f"{name} takes {ratios[name]:.2f} of its slow twin, the baseline {value:.2f}"
        for name, value in baseline["ratios"].items()
        if ratios[name] > SLOWER * value
    ]
    for name, value in baseline["metrics"].items():
        allowed = METRICS[name]
        if name in metrics and (metrics[name] - value) / allowed > 1:
            worse.append(f"{name} is {metrics[name]:.2f}, the baseline {value:.2f}")
    return worse


def main(words: list[str] | None = None) -> int:
    """Measures, compares and says what is worse; the exit code is how much is."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.regressions", description=__doc__)
    parser.add_argument("--metrics", type=Path, help="metrics.json of a demo with seed 0")
    parser.add_argument("--write", action="store_true", help="store what was measured as the new baseline")
    arguments = parser.parse_args(words)
    ratios = measured()
    metrics = demo_metrics(arguments.metrics) if arguments.metrics else {}
    for name, value in (ratios | metrics).items():
        print(f"{name}: {value:.3f}")
    if arguments.write:
        metrics = metrics or json.loads(BASELINE.read_text(encoding="utf-8"))["metrics"]
        text = json.dumps({"ratios": ratios, "metrics": metrics}, indent=2)
        BASELINE.write_text(text + "\n", encoding="utf-8")
        return 0
    worse = regressions(json.loads(BASELINE.read_text(encoding="utf-8")), ratios, metrics)
    print("\n".join(worse) if worse else "Nothing has become worse.")
    return len(worse)


if __name__ == "__main__":
    sys.exit(main())
