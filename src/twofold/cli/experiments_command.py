"""`twofold reproduce`: the paper's tables and figures."""

import contextlib
import shlex
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from twofold.cli.console import bar, console, say, within
from twofold.errors import TwofoldError

if TYPE_CHECKING:
    from twofold.reproduce.cells import Cell
    from twofold.reproduce.executors import Executor
    from twofold.reproduce.experiments import PlannedCell

TableName = Literal["main", "subjects", "wild", "ablation", "frequency", "beyond", "consistency", "masks", "figures"]
Cluster = Literal["slurm", "local", "debug"]


def reproduce(
    table: Annotated[TableName, tyro.conf.Positional],
    data: str = "studio",
    out: Path = Path("reproduce"),
    recipe: Literal["quick", "fast", "released"] = "quick",
    methods: tuple[str, ...] = (),
    subjects: int | None = None,
    seeds: int = 1,
    size: int | None = None,
    steps: int | None = None,
    set: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = (),
    max_images: int | Literal["all"] = 30,
    max_meshes: int = 2,
    weights: Path | None = None,
    unverified_weights: bool = False,
    workers: int = 1,
    dry_run: bool = False,
    shard: str | None = None,
    cluster: Cluster | None = None,
    cluster_hours: float = 24.0,
    cluster_gpus: int = 0,
) -> None:
    """Make one of the paper's tables, or its figures: train and measure what is missing, reuse all the rest.

    Args:
        table: main, subjects, wild, ablation, frequency, beyond, consistency, masks; or figures, of what the others
            trained.
        data: studio (synthetic subjects), real (captures/real), a capture folder, or a folder of capture folders.
        out: Folder for runs, tables and figures; the same one finds again what is done.
        recipe: quick (on feature grids), fast or released (the paper's networks); baselines likewise.
        methods: Rows of the table; by default all. An unknown one lists them.
        subjects: How many; by default one synthetic subject, or all captures.
        seeds: Trainings of each row and subject, from seed 0.
        size: Rows and columns of synthetic subjects' images; by default 192.
        steps: Steps of every training, with its whole schedule scaled to them; by default each recipe's own.
        set: Settings of all recipes, such as training.pixels.rays=500; one or several, once or several times.
        max_images: Images measured of each split, evenly spread; all for all.
        max_meshes: Ground-truth meshes measured, evenly spread.
        weights: Folder with the published weights of LPIPS and Inception; by default the usual caches.
        unverified_weights: Accept other weights than the published ones.
        workers: Cells at the same time on this machine; they share its threads.
        dry_run: Lists the cells and the hours that are left, and does nothing else.
        shard: i/n does the i-th of n parts of the cells, for any scheduler; the folder is shared.
        cluster: slurm submits a job for each cell (needs the extra slurm); local and debug try that without it.
        cluster_hours: Limit of a job.
        cluster_gpus: GPUs of a job.
    """
    from twofold.kernels.runtime import tune_process

    tune_process()
    from twofold.reproduce.costs import known_rates
    from twofold.reproduce.experiments import EXPERIMENTS, planned
    from twofold.reproduce.measuring import Measures
    from twofold.reproduce.scheduling import distinct
    from twofold.reproduce.scheduling import shard as part_of
    from twofold.reproduce.sources import find_sources

    images = None if max_images == "all" else max_images
    within(
        subjects=(subjects, 1, 10_000), seeds=(seeds, 1, 1000), size=(size, 32, 4096), steps=(steps, 1, None),
        workers=(workers, 1, 1024), max_images=(images, 1, None), max_meshes=(max_meshes, 0, None),
    )  # fmt: skip
    if weights is not None and not weights.is_dir():
        raise TwofoldError(f"{weights} is not a folder; name the one that holds the weights, or leave --weights out.")
    sources = find_sources(data, subjects, size)
    measures = Measures(images, max_meshes, True, None if weights is None else str(weights), unverified_weights)
    stem = f"{Path(data).resolve().name}-{recipe}"
    if table == "figures":
        plans: dict[str, list[PlannedCell]] = {}
        for name in EXPERIMENTS:
            # Settings may be for one kind of recipe only; its tables are those that could have been made.
            with contextlib.suppress(TwofoldError):
                plans[name] = planned(name, sources, recipe, seeds, (), set, measures, data == "studio", steps)
        _figures(plans, out, stem)
        return
    plan = planned(table, sources, recipe, seeds, methods, set, measures, data == "studio", steps)
    cells = part_of(distinct([place.cell for place in plan]), shard)
    rates = known_rates(out)
    if dry_run:
        _list(plan, {cell.key for cell in cells}, out, rates, workers)
        return
    about: dict[str, object] = {
        "data": data, "recipe": recipe, "subjects": [source.name for source in sources], "seeds": seeds,
        "settings": list(set), "measures": asdict(measures),
        **{name: number for name, number in (("steps", steps), ("size", size)) if number is not None},
    }  # fmt: skip
    executor = _executor(cluster, cluster_hours, cluster_gpus, workers, out)
    failed = _do(plan, cells, out, executor, rates, table)
    file = _write(table, plan, out, about, stem)
    missing = sum(place.cell.results(out) is None for place in plan)
    words = ["twofold", "reproduce", table, "--data", data, "--recipe", recipe, "--out", str(out)]
    # What decides which cells there are, and which of them count as measured.
    chosen = {
        "--subjects": (subjects, None), "--seeds": (seeds, 1), "--size": (size, None), "--steps": (steps, None),
        "--max-images": (max_images, 30), "--max-meshes": (max_meshes, 2), "--weights": (weights, None),
    }  # fmt: skip
    words += [w for option, (value, usual) in chosen.items() if value != usual for w in (option, str(value))]
    words += ["--unverified-weights"] if unverified_weights else []
    words += [word for setting in set for word in ("--set", setting)]
    if failed:
        raise TwofoldError(
            f"{len(failed)} of {len(cells)} cells failed, the first with: {next(iter(failed.values()))} The others "
            f"are in {file}; the same command tries these again."
        )
    follow = f"the other shards, then the same command without --shard ({missing} cells are missing)"
    say(f"The table is {file}.", follow if missing else shlex.join([*words[:2], "figures", *words[3:]]))


def _executor(cluster: Cluster | None, hours: float, gpus: int, workers: int, out: Path) -> "Executor":
    from twofold.reproduce.executors import LocalExecutor, SlurmExecutor

    if cluster is None:
        return LocalExecutor(workers)
    return SlurmExecutor(out / "logs", cluster, hours, gpus)


def _do(
    plan: "list[PlannedCell]", cells: "list[Cell]", out: Path, executor: "Executor", rates: dict[str, float], table: str
) -> dict[str, str]:  # fmt: skip
    """All cells, with progress; returns why some failed."""
    from twofold.reproduce.costs import expected_seconds
    from twofold.reproduce.scheduling import run_cells

    names = {p.cell.key: f"{p.row.label}, {p.subject}, seed {p.seed}" for p in plan}
    # A cell of unknown length counts as much as the others do on average.
    known = {cell.key: expected_seconds(cell, rates) for cell in cells}
    sure = [seconds for seconds in known.values() if seconds is not None]
    middle = sum(sure) / len(sure) if sure else 1.0
    weights = {key: middle if seconds is None else seconds for key, seconds in known.items()}
    try:
        with bar(f"Table {table}") as show:
            outcome = run_cells(cells, out, executor, show, names, weights)
    except KeyboardInterrupt:
        raise KeyboardInterrupt("What is done is kept; the same command goes on from there.") from None
    for key, reason in outcome.failed.items():
        console().print(f"Failed: {names[key]} ({key}): {reason}", soft_wrap=True)
    return dict(outcome.failed)


def _write(table: str, plan: "list[PlannedCell]", out: Path, about: dict[str, object], stem: str) -> Path:
    from twofold.reproduce.tables import fill, image_rows, write_table

    return write_table(fill(table, plan, out, about), image_rows(plan, out), out / "tables", f"{table}-{stem}")


def _list(plan: "list[PlannedCell]", mine: set[str], out: Path, rates: dict[str, float], workers: int) -> None:
    """Every cell on a line of standard output, then the hours."""
    from twofold.reproduce.costs import WHERE, hours, left

    seen: dict[str, float | None] = {}
    for place in plan:
        cell = place.cell
        if cell.key not in mine or cell.key in seen:
            continue
        seconds = seen[cell.key] = left(cell, out, rates)
        share, note = cell.share(out)
        done = cell.results(out) is not None
        state = "done" if done else f"{100 * share:.0f} % ({note})" if share else "not begun"
        print(f"{cell.key}  {place.row.label}, {place.subject}, seed {place.seed}: {state}, {hours([seconds], 1)} left")
    source = "from cells that are done here" if rates else WHERE
    print(f"{len(seen)} cells, {hours(list(seen.values()), workers)} left with {workers} at once ({source}).")


def _figures(plans: "dict[str, list[PlannedCell]]", out: Path, stem: str) -> None:
    from twofold.reproduce.figures import make_figures

    with bar("Figures") as show:
        files = make_figures(plans, out, out / "figures" / stem, show)
    for file in files:
        console().print(str(file), soft_wrap=True)
    say(f"The figures are in {out / 'figures' / stem}.", f"open {files[0]}")
