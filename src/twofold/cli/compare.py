"""Command that compares runs: `twofold compare`."""

from pathlib import Path
from typing import Annotated

import tyro

from twofold.cli.advice import require_capture, require_run
from twofold.cli.console import bar, say, within


def compare(
    runs: Annotated[tuple[Path, ...], tyro.conf.Positional],
    out: Path = Path("comparison"),
    max_images: int = 12,
    max_meshes: int = 1,
    capture: Path | None = None,
    device: str = "auto",
) -> None:
    """Compare runs of one capture: images side by side, and a table of metrics and costs.

    Args:
        runs: Run folders, two or more, in the order of the table.
        out: Folder to make: sheets (PNG), the table (JSON, Markdown), a page (HTML). An earlier comparison is replaced.
        max_images: Images measured of each split, evenly spread.
        max_meshes: Ground-truth meshes measured, evenly spread; 0 for none.
        capture: Capture folder, if it has moved since training.
        device: auto, cpu, cuda or cuda:N.
    """
    from twofold.capture.folder import read_capture
    from twofold.comparison import common_capture, measured, pieces, require_free_for_comparison, write_comparison
    from twofold.evaluation import require_meshes
    from twofold.training.run import choose_device, read_checkpoint, require_same

    within(max_images=(max_images, 1, None), max_meshes=(max_meshes, 0, None))
    for run in runs:
        require_run(run)
    source = common_capture(runs, capture)
    require_free_for_comparison(out)
    require_capture(source)
    read, where = read_capture(source), choose_device(device)
    for run in runs:
        require_same(run, read, motion=True)
        read_checkpoint(run)
    if max_meshes:
        require_meshes(read, max_meshes)
    found = []
    with bar("Comparing") as show:
        done, whole = 0, len(runs) * (pieces(read, max_images, max_meshes) + 1)
        for run in runs:

            def progress(run: Path = run) -> None:
                nonlocal done
                done += 1
                show(min(done / whole, 0.999), run.name)

            found.append(measured(run, read, where, max_images, max_meshes, progress))
            progress()
        write_comparison(out, read, found, max_images)
        show(1.0, "")
    say(
        f"The comparison is in {out}.", f"open {out / 'report.html'}, or put {out / 'comparison.md'} where you need it."
    )
