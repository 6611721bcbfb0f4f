"""Cells whose work takes no time: for tests of what happens around training and measuring."""

import os
import signal
from dataclasses import asdict, replace
from pathlib import Path

from twofold.errors import TwofoldError
from twofold.files import write_json
from twofold.methods.factorized_recipes import demo_recipe
from twofold.reproduce.cells import FAILURE, PROGRESS, RESULTS, Cell, read_cell, run_cell
from twofold.reproduce.sources import StudioSource


def stub_cells(count: int, first: int = 0) -> list[Cell]:
    return [Cell(StudioSource(101), replace(demo_recipe(0), seed=seed)) for seed in range(first, first + count)]


def store_results(folder: Path, psnr: float = 20.0, **sections: object) -> None:
    """What a finished cell leaves; the PSNR tells the seed."""
    cell = read_cell(folder)
    value = psnr + cell.recipe.seed
    split = {"paper_psnr": value, "paper_ssim": 0.9, "psnr_box": value - 5, "gradient_error": 0.2}
    split |= {"paper_lpips_x1000": "n/a (put vgg.pth in weights)", "kid_x1000": "n/a (put inception.pth in weights)"}
    image = {"split": "novel_pose", "camera": "a", "frame": 3, "pose_distance": 5.0, "psnr_box": value - 5}
    write_json(
        folder / RESULTS,
        {"recipe": cell.recipe.name, "measures": asdict(cell.measures), "seconds": {"seconds_per_step": 0.5},
         "novel_view": split, "novel_pose": split, "images": [image], **sections},
    )  # fmt: skip


def stub_work(folder: Path) -> None:
    """Seeds 13 fail with a sentence, 14 with a fault of a program, 15 is killed; the others have results."""
    seed = read_cell(folder).recipe.seed
    with (folder / "visits").open("a") as visits:
        visits.write("x")
    if seed == 13:
        raise TwofoldError("The loss at step 3 is not a finite number.")
    if seed == 14:
        raise ZeroDivisionError("division by zero")
    if seed == 15:
        os.kill(os.getpid(), signal.SIGKILL)
    write_json(folder / PROGRESS, {"share": 1.0, "note": "done"})
    store_results(folder)


class HereExecutor:
    """Does a cell at once, in this process."""

    at_once = 1

    def __init__(self, work=stub_work) -> None:
        self.work, self.started = work, []

    def start(self, folder: Path):
        self.started.append(folder.name)
        run_cell(str(folder), None, self.work)
        return FinishedJob()


class FinishedJob:
    def finished(self) -> bool:
        return True

    def stop(self) -> None:
        """It has ended."""

    def failure(self) -> str:
        return ""


def visits(cell: Cell, out: Path) -> int:
    """How often the cell was worked on."""
    file = cell.folder(out) / "visits"
    return len(file.read_text()) if file.exists() else 0


def failed_before(cell: Cell, out: Path) -> bool:
    return (cell.folder(out) / FAILURE).exists()
