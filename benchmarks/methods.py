"""Methods side by side: what `twofold compare` measured, stored with how each run was trained.

`python -m benchmarks.methods COMPARISON NAME --capture "how it was made"` writes `results/methods-NAME.json`. With
`--also` rows of other comparisons follow, of the same person in other images.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from benchmarks.common import store
from twofold.capture.folder import read_capture
from twofold.methods.table import RECIPES, fitted, recipe_to_dict, with_steps
from twofold.training.run import find_capture, read_recipe

IMAGE = ("psnr_box", "ssim_box", "silhouette_iou")
COST = ("parameters", "training_processor_seconds", "frame_processor_seconds")


def settings_of(run: Path) -> list[str]:
    """What `--set` would have to change for the recipe of a run's name and length to be the run's own."""
    recipe = read_recipe(run)
    plain = with_steps(RECIPES[recipe.name](), recipe.method.total_steps(recipe.training))
    plain, _ = fitted(plain, read_capture(find_capture(run, None)))
    known, own = (_flat(recipe_to_dict(one)) for one in (plain, recipe))
    return [f"{key}={value}" for key, value in own.items() if key != "seed" and value != known.get(key)]


def stored(comparison: dict[str, Any], runs: Path, capture: str) -> dict[str, Any]:
    """The rows of `comparison.json`, each with its run's settings.

    Args:
        comparison: as read.
        runs: folder of the runs.
        capture: how the capture was made.
    """
    rows = []
    for run in comparison["runs"]:
        metrics = run["metrics"]
        recipe = read_recipe(runs / run["run"])
        second = recipe.training.steps if recipe.method.total_steps(recipe.training) != recipe.training.steps else None
        rows.append(
            {
                "recipe": run["recipe"], "steps": run["steps"], "second_stage": second,
                "settings": settings_of(runs / run["run"]),
                **{split: {name: metrics[split][name] for name in IMAGE}
                   for split in ("novel_view", "novel_pose") if metrics.get(split)},
                "cost": {name: metrics["cost"][name] for name in COST},
            }
        )  # fmt: skip
    splits = [s for s in ("novel_view", "novel_pose") if comparison["runs"][0]["metrics"].get(s)]
    protocol = comparison["runs"][0]["metrics"][splits[0]]["protocol"]["frames"]
    return {"capture": capture, "frames": protocol, "rows": rows}


def _flat(data: dict[str, Any], above: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in data.items():
        flat |= _flat(value, f"{above}{name}.") if isinstance(value, dict) else {above + name: value}
    return flat


def main() -> None:
    """Reads a comparison and stores it."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.methods", description=__doc__)
    parser.add_argument("comparison", type=Path, help="folder that twofold compare made")
    parser.add_argument("name", help="of the file")
    parser.add_argument("--also", type=Path, nargs="+", default=[])
    parser.add_argument("--runs", type=Path, required=True, help="folder that holds the runs")
    parser.add_argument("--capture", required=True, help="how the capture was made, for readers")
    given = parser.parse_args()
    parts = [json.loads((c / "comparison.json").read_text("utf-8")) for c in (given.comparison, *given.also)]
    comparison = {**parts[0], "runs": [run for part in parts for run in part["runs"]]}
    store(f"methods-{given.name}", stored(comparison, given.runs, given.capture))


if __name__ == "__main__":
    main()
