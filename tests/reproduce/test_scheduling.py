"""All cells are done once; a failed one stops no other; shards part them exactly."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from stub_cells import HereExecutor, store_results, stub_cells, visits

from twofold.errors import TwofoldError
from twofold.reproduce.cells import FAILURE, store_cell
from twofold.reproduce.scheduling import distinct, run_cells, shard

CELLS = stub_cells(23)


@given(st.integers(1, 23), st.integers(1, 9))
def test_shards_are_disjoint_and_give_all_cells_together(count, parts):
    cells = CELLS[:count]
    shares = [shard(cells, f"{number}/{parts}") for number in range(1, parts + 1)]
    assert sorted(cell.key for share in shares for cell in share) == sorted(cell.key for cell in cells)
    assert max(map(len, shares)) - min(map(len, shares)) <= 1


def test_shards_do_not_depend_on_the_order_of_the_cells():
    cells = stub_cells(9)
    assert {c.key for c in shard(cells, "2/3")} == {c.key for c in shard(cells[::-1], "2/3")}


@pytest.mark.parametrize("which", ["0/3", "4/3", "1", "a/b", "1/0", "-1/2", "1/2/3", ""])
def test_shards_that_are_none_are_refused(which):
    with pytest.raises(TwofoldError, match="--shard should be i/n"):
        shard(stub_cells(3), which)


def test_cells_that_tables_share_are_one():
    cells = stub_cells(3)
    assert distinct([*cells, *cells[::-1]]) == cells


def test_finished_cells_are_not_done_again(tmp_path):
    cells = stub_cells(4)
    run_cells(cells[:2], tmp_path, HereExecutor())
    executor = HereExecutor()
    outcome = run_cells(cells, tmp_path, executor)
    assert executor.started == [cell.key for cell in cells[2:]]
    assert set(outcome.done) == {cell.key for cell in cells}
    assert [visits(cell, tmp_path) for cell in cells] == [1, 1, 1, 1]


def test_failed_cells_are_reported_and_stop_no_other(tmp_path):
    cells = [*stub_cells(2, 13), *stub_cells(2)]
    outcome = run_cells(cells, tmp_path, HereExecutor())
    assert outcome.failed == {
        cells[0].key: "The loss at step 3 is not a finite number.",
        cells[1].key: "ZeroDivisionError: division by zero",
    }
    assert set(outcome.done) == {cell.key for cell in cells[2:]}


def test_cell_that_failed_is_tried_again_and_its_failure_forgotten(tmp_path):
    cells = stub_cells(1, 13)
    run_cells(cells, tmp_path, HereExecutor())
    outcome = run_cells(cells, tmp_path, HereExecutor(store_results))
    assert outcome.done == (cells[0].key,)
    assert not outcome.failed
    assert not (cells[0].folder(tmp_path) / FAILURE).exists()


def test_cell_that_leaves_nothing_has_failed(tmp_path):
    cells = stub_cells(1)
    assert run_cells(cells, tmp_path, HereExecutor(lambda folder: None)).failed == {cells[0].key: "it left no results"}


def test_progress_ends_at_one_and_never_falls(tmp_path):
    told = []
    cells = stub_cells(5)
    run_cells(cells, tmp_path, HereExecutor(), lambda share, note: told.append((share, note)))
    shares = [share for share, _ in told]
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    assert told[-1][1] == "5 of 5 cells"


def test_long_cells_count_for_more(tmp_path):
    told = []
    first, second = stub_cells(2)
    weights = {first.key: 1.0, second.key: 3.0}
    run_cells([first, second], tmp_path, HereExecutor(), lambda share, note: told.append(share), weights=weights)
    assert told[0] == pytest.approx(0.25)


def test_what_an_earlier_run_has_done_of_a_cell_is_no_progress_of_this_one(tmp_path):
    first, second = stub_cells(2)
    folder = store_cell(first, tmp_path)
    (folder / "progress.json").write_text('{"share": 0.6, "note": "step 3 of 5"}')
    told = []
    run_cells([first, second], tmp_path, HereExecutor(), lambda share, note: told.append(share))
    assert told[0] == pytest.approx(0.4 / 1.4)


def test_interrupted_run_stops_the_cells_at_work_and_waits_for_them(tmp_path):
    class Slow:
        at_once = 2

        def __init__(self):
            self.jobs = []

        def start(self, folder):
            self.jobs.append(SlowJob())
            return self.jobs[-1]

    class SlowJob:
        asked, looks = False, 0

        def finished(self):
            self.looks += self.asked
            return self.looks > 2

        def stop(self):
            self.asked = True

        def failure(self):
            return ""

    def interrupt(share, note):
        raise KeyboardInterrupt

    executor = Slow()
    with pytest.raises(KeyboardInterrupt):
        run_cells(stub_cells(3), tmp_path, executor, interrupt)
    assert [job.asked and job.finished() for job in executor.jobs] == [True, True]
