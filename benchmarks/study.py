r"""Collects finished cells of `twofold reproduce` into one stored result: every number by row, subject and seed.

python -m benchmarks.study reproduce/tables/ablation-studio-quick.json [--name ablation]
python -m benchmarks.study reproduce/tables/beyond-studio-quick.json \
    --full-of reproduce/tables/ablation-studio-quick.json
python -m benchmarks.study a/tables/main-studio-quick.json --rows-of b/tables/main-studio-quick.json c/...
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from benchmarks.common import store
from benchmarks.study_section import FULL
from twofold.reproduce.cells import read_cell
from twofold.reproduce.pose_distance import PROTOCOL, binned

METRICS = {
    "novel_view": ("psnr_box", "gradient_error"), "novel_pose": ("psnr_box", "gradient_error"),
    "geometry": ("chamfer_cm",), "consistency": ("flow_error_mask_px",),
}  # fmt: skip
"""What is stored of a cell."""
PARTS = ("rows", "steps", "minutes", "printed")
"""Of a study, by row."""


def collect(table: dict[str, Any], cells: Path) -> dict[str, Any]:
    """Of each row every metric by "subject, seed N", the PSNR of novel poses by distance, and how it was trained.

    "minutes" are the mean processor minutes of a training, where the cells know their seconds a step.

    Args:
        table: JSON of a table.
        cells: folder of the cells.
    """
    rows: dict[str, dict[str, dict[str, float]]] = {}
    images: dict[str, list[dict[str, Any]]] = {}
    steps: dict[str, int] = {}
    minutes: dict[str, list[float]] = {}
    for cell in table["cells"]:
        if cell["state"] != "done":
            continue
        found = json.loads((cells / cell["key"] / "results.json").read_text("utf-8"))
        recipe = read_cell(cells / cell["key"]).recipe
        steps[cell["row"]] = recipe.method.total_steps(recipe.training)
        if "processor_seconds_per_step" in found.get("seconds", {}):
            spent = found["seconds"]["processor_seconds_per_step"] * steps[cell["row"]] / 60
            minutes.setdefault(cell["row"], []).append(spent)
        images.setdefault(cell["row"], []).extend(i for i in found["images"] if i["split"] == "novel_pose")
        for section, names in METRICS.items():
            for name in names:
                value = found.get(section, {}).get(name)
                if isinstance(value, float):
                    where = f"{cell['subject']}, seed {cell['seed']}"
                    rows.setdefault(cell["row"], {}).setdefault(f"{section}.{name}", {})[where] = value
    distances = {
        row: [list(point) for point in binned([i["pose_distance"] for i in own], [i["psnr_box"] for i in own])]
        for row, own in images.items()
    }
    return {
        "experiment": table["experiment"], "about": table["about"], "steps": steps,
        "minutes": {row: sum(own) / len(own) for row, own in minutes.items()}, "rows": rows,
        "extreme": {"protocol": f"PSNR over the box by {PROTOCOL}", "bins": distances},
        "cells": [cell for cell in table["cells"] if cell["state"] == "done"],
        "printed": {
            line["row"]: {title: value["printed"] for title, value in line["values"].items() if value["printed"]}
            for line in table["lines"]
        },
    }  # fmt: skip


def with_full_model(study: dict[str, Any], other: dict[str, Any]) -> dict[str, Any]:
    """A study with the full model of another one in place of its own: the same training under a table's other name.

    Args:
        study: from `collect`.
        other: from `collect`, of the same subjects and steps.

    Raises:
        ValueError: it was trained otherwise.
    """
    (name,) = [row for row in other["rows"] if row in FULL]
    _require_equal(study, other, ("data", "recipe", "settings"))
    merged = dict(study)
    for part in PARTS:
        own_rows = {row: v for row, v in study[part].items() if row not in FULL}
        merged[part] = own_rows | {row: v for row, v in other[part].items() if row == name}
    bins = study["extreme"]["bins"] | {name: other["extreme"]["bins"][name]}
    merged["extreme"] = study["extreme"] | {"bins": bins}
    own = [cell for cell in study["cells"] if cell["row"] not in FULL]
    merged["cells"] = own + [cell for cell in other["cells"] if cell["row"] == name]
    return merged


def with_rows_of(study: dict[str, Any], other: dict[str, Any]) -> dict[str, Any]:
    """A study with the rows that another one of the same subjects has and it lacks, such as of a longer training.

    Args:
        study: from `collect`.
        other: from `collect`.

    Raises:
        ValueError: it was trained on something else.
    """
    _require_equal(study, other, ("data", "subjects", "size", "recipe", "settings"))
    new = [row for row in other["rows"] if row not in study["rows"]]
    merged = dict(study)
    for part in PARTS:
        merged[part] = study[part] | {row: other[part][row] for row in new if row in other[part]}
    bins = study["extreme"]["bins"] | {row: other["extreme"]["bins"][row] for row in new}
    merged["extreme"] = study["extreme"] | {"bins": bins}
    merged["cells"] = study["cells"] + [cell for cell in other["cells"] if cell["row"] in new]
    return merged


def _require_equal(study: dict[str, Any], other: dict[str, Any], keys: tuple[str, ...]) -> None:
    for key in keys:
        one, two = study["about"].get(key), other["about"].get(key)
        if one != two:
            raise ValueError(f"{key} is {one!r} in one table, {two!r} in the other")


def _commit(cells: list[dict[str, Any]]) -> dict[str, str]:
    """The commit that made all cells, for `store`; nothing where they do not agree or do not say.

    >>> _commit([{"made_with": "0.1.0 at f22924d"}] * 2)
    {'commit': 'f22924d'}
    >>> _commit([{"made_with": "0.1.0 at f22924d"}, {"made_with": None}])
    {}
    """
    programs = {cell.get("made_with") for cell in cells}
    (program,) = programs if len(programs) == 1 else ("",)
    head = (program or "").partition(" at ")[2]
    return {"commit": head} if head else {}


def main() -> None:
    """Collects and stores."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("table", type=Path)
    parser.add_argument("--name", default="")
    parser.add_argument("--full-of", type=Path, help="table whose full model is compared with")
    parser.add_argument("--rows-of", type=Path, nargs="+", default=[], help="tables with further rows")
    arguments = parser.parse_args()

    def collected(file: Path) -> dict[str, Any]:
        return collect(json.loads(file.read_text("utf-8")), file.parent.parent / "cells")

    study = collected(arguments.table)
    if arguments.full_of is not None:
        study = with_full_model(study, collected(arguments.full_of))
    for table in arguments.rows_of:
        study = with_rows_of(study, collected(table))
    store(f"study-{arguments.name or study['experiment']}", {**_commit(study["cells"]), **study})


if __name__ == "__main__":
    main()
