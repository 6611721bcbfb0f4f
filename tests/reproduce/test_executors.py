"""Cells in processes of this machine and in jobs of submitit."""

import sys

import pytest
from stub_cells import stub_cells, stub_work, visits

from twofold.errors import TwofoldError
from twofold.reproduce.executors import LocalExecutor, SlurmExecutor
from twofold.reproduce.scheduling import run_cells


def test_process_that_is_killed_takes_no_other_along(tmp_path):
    cells = [*stub_cells(1, 15), *stub_cells(1)]
    outcome = run_cells(cells, tmp_path, LocalExecutor(2, 1, stub_work))
    assert outcome.done == (cells[1].key,)
    assert "killed" in outcome.failed[cells[0].key]
    assert "--workers" in outcome.failed[cells[0].key]


# Its debug jobs leave their logs open.
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_debug_jobs_of_submitit_do_the_cells_in_this_process(tmp_path):
    cells = [*stub_cells(1, 13), *stub_cells(2)]
    outcome = run_cells(cells, tmp_path, SlurmExecutor(tmp_path / "logs", "debug", work=stub_work))
    assert set(outcome.done) == {cell.key for cell in cells[1:]}
    assert list(outcome.failed.values()) == ["The loss at step 3 is not a finite number."]
    assert [visits(cell, tmp_path) for cell in cells] == [1, 1, 1]


def test_local_jobs_of_submitit_do_the_cells_in_other_processes(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", ":".join(sys.path))
    cells = stub_cells(2, 13)[:1] + stub_cells(1)
    outcome = run_cells(cells, tmp_path, SlurmExecutor(tmp_path / "logs", "local", work=stub_work))
    assert outcome.done == (cells[1].key,)
    assert list(outcome.failed.values()) == ["The loss at step 3 is not a finite number."]


def test_missing_submitit_is_said_with_how_to_get_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "submitit", None)
    with pytest.raises(TwofoldError, match=r"run: pip install .*\[slurm\]"):
        SlurmExecutor(tmp_path)


def test_machine_without_slurm_is_said_to_have_none(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(TwofoldError, match="submitit cannot use slurm here"):
        SlurmExecutor(tmp_path / "logs", "slurm")
