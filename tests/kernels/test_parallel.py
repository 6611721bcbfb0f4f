"""A range cut into parts: nothing twice, nothing left out, in order."""

import os
import subprocess
import sys
import threading
import time
import weakref
from functools import wraps
from itertools import chain

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from twofold.kernels import parallel
from twofold.kernels.parallel import ahead, compiled, in_parts, one_thread_each


@pytest.fixture(autouse=True)
def sharing(monkeypatch):
    """What an earlier test found about the load of the machine decides nothing here."""
    own = parallel._Sharing()
    monkeypatch.setattr(parallel, "_SHARING", own)
    return own


@pytest.fixture(params=[1, 3])
def threads(request, monkeypatch):
    monkeypatch.setattr(torch, "get_num_threads", lambda: request.param)
    return request.param


@given(count=st.integers(0, 5000), least=st.integers(0, 2000), allowed=st.integers(1, 4))
def test_parts_cover_the_range_once_and_in_order(count, least, allowed):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch, "get_num_threads", lambda: allowed)
        parts = in_parts(count, lambda begin, end: (begin, end), least)
    assert list(chain.from_iterable(range(*part) for part in parts)) == list(range(count))
    assert 1 <= len(parts) <= (parallel.PARTS_EACH * allowed if allowed > 1 else 1)
    assert len(parts) == 1 or min(end - begin for begin, end in parts) >= least


def test_parts_run_side_by_side(threads):
    everyone = threading.Barrier(threads, timeout=20)
    assert sorted(in_parts(threads, lambda begin, end: (everyone.wait(), begin)[1], least=1)) == list(range(threads))


def test_an_error_in_a_part_is_raised(threads):
    def work(begin, end):
        if end == 10:
            raise ValueError("the last part")

    with pytest.raises(ValueError, match="the last part"):
        in_parts(10, work, least=1)
    # No thread keeps the mark that it is inside a part.
    assert list(chain.from_iterable(range(*part) for part in in_parts(9, lambda *part: part, least=1))) == list(
        range(9)
    )
    assert len(in_parts(9, lambda *part: part, least=1)) == (1 if threads == 1 else 6)


def test_a_thread_that_is_done_takes_the_parts_that_are_left(monkeypatch):
    """Where one core is slow, or a part long, the other threads handle the rest."""
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    rest = threading.Barrier(1 + 1, timeout=20)
    done = []

    def work(begin, end):
        if begin == 0:
            rest.wait()  # until all others are done
        done.append((begin, threading.get_ident()))
        if len(done) == 2 * parallel.PARTS_EACH - 1:
            rest.wait()

    in_parts(100, work, least=1)
    assert done[-1][0] == 0
    assert len({thread for begin, thread in done if begin}) == 1


def test_work_is_not_shared_for_a_while_where_threads_only_wait(sharing, monkeypatch):
    """The clock is the test's own: the work takes as long as one thread would, or half as long."""
    now = [100.0]
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    monkeypatch.setattr(parallel.time, "perf_counter", lambda: now[0])

    for _ in range(50):
        sharing.note(0.0055, 0.01)
    assert sharing.pays()
    slow = 0
    while sharing.pays():
        sharing.note(0.015, 0.01)
        slow += 1
    assert 1 < slow < 20
    # Work is cut all the same, so results are what they were.
    ranges = in_parts(100, lambda begin, end: (begin, end, threading.get_ident()), least=1)
    assert [part[:2] for part in ranges] == [(0, 25), (25, 50), (50, 75), (75, 100)]
    assert {part[2] for part in ranges} == {threading.get_ident()}
    now[0] += parallel.PAUSE
    assert sharing.pays()
    # Short work says nothing, and one slow work does not decide.
    for _ in range(50):
        sharing.note(1e-3, 1e-5)
    sharing.note(1.0, 0.01)
    assert sharing.pays()


def test_long_work_is_shared_however_busy_the_machine_is(sharing, monkeypatch):
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    sharing.alone_until = float("inf")
    both = threading.Barrier(2, timeout=20)
    in_parts(2, lambda begin, end: both.wait(), least=1, long=True)
    with pytest.raises(threading.BrokenBarrierError):
        in_parts(2, lambda begin, end: both.wait(timeout=0.05), least=1)


def test_the_first_error_is_raised_and_no_further_part_begins(monkeypatch):
    """Other threads may fail because they are told that one has."""
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    both, told, begun = threading.Barrier(2, timeout=20), threading.Event(), []

    def work(begin, end):
        begun.append(begin)
        both.wait()
        if threading.current_thread() is threading.main_thread():
            assert told.wait(20)
            time.sleep(0.1)
            raise InterruptedError("another part failed")
        told.set()
        raise ValueError("the fault")

    with pytest.raises(ValueError, match="the fault"):
        in_parts(100, work, least=1)
    assert sorted(begun) == [0, 25]


def test_threads_that_were_asked_are_waited_for_where_one_cannot_be(monkeypatch):
    """Else they would write into arrays that their owner has given up."""
    monkeypatch.setattr(torch, "get_num_threads", lambda: 3)
    pool, asked, done = parallel._pool(2), [], []
    real = pool.submit

    def submit(take):
        asked.append(take)
        if len(asked) == 2:
            raise RuntimeError("can't start new thread")
        return real(take)

    monkeypatch.setattr(pool, "submit", submit)
    with pytest.raises(RuntimeError, match="new thread"):
        in_parts(100, lambda begin, end: (time.sleep(0.02), done.append(begin)), least=1)
    before = len(done)
    time.sleep(0.1)
    assert len(done) == before < 6


def test_parts_of_busy_threads_are_counted_as_work(sharing, monkeypatch):
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    noted = []
    monkeypatch.setattr(sharing, "note", lambda seconds, busy: noted.append((seconds, busy)))

    def work(begin, end):
        until = time.thread_time() + 0.02
        while time.thread_time() < until:
            pass

    in_parts(100, work, least=1)
    ((seconds, busy),) = noted
    assert busy > 0.99 * 4 * 0.02
    assert seconds > 0


def test_this_thread_takes_all_where_no_other_begins(monkeypatch):
    """The pool's one thread is kept busy until afterwards."""
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    begun, ended = threading.Event(), threading.Event()
    busy = parallel._pool(1).submit(lambda: (begun.set(), ended.wait(20)))
    assert begun.wait(20)
    try:
        threads = in_parts(100, lambda begin, end: threading.get_ident(), least=1)
        assert set(threads) == {threading.get_ident()}
    finally:
        ended.set()
        assert busy.result()[1]


def test_a_compiled_loop_is_the_plain_one_even_if_something_wraps_it():
    def total(values):
        out = 0.0
        for i in range(len(values)):
            out += values[i]
        return out

    @wraps(total)
    def checked(values):
        raise AssertionError("the check was compiled")

    # Without the copy on disk, whose place the test's own file would have to give.
    values = np.arange(5.0)
    assert compiled(checked)(values) == total(values) == 10


def triple(x):
    return 3 * x


def test_without_any_folder_to_keep_it_in_a_loop_is_compiled_all_the_same(monkeypatch):
    """A system's installation that a foreign user runs, in a container say."""
    monkeypatch.setattr("numba.core.caching.CacheImpl._locator_classes", [])
    assert compiled(triple)(2.0) == 6.0


@pytest.mark.parametrize("method", ["_load_index", "_save_index", "_save_data"])
def test_a_cache_that_fails_costs_nothing_but_time(method, monkeypatch, tmp_path):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("numba.core.config.CACHE_DIR", str(tmp_path))
    kernel = compiled(triple)
    monkeypatch.setattr(f"numba.core.caching.IndexDataCacheFile.{method}", full)
    assert kernel(2.0) == 6.0


def test_a_damaged_cache_is_compiled_past_and_a_sound_one_is_used(monkeypatch, tmp_path):
    monkeypatch.setattr("numba.core.config.CACHE_DIR", str(tmp_path))
    assert compiled(triple)(2.0) == 6.0
    again = compiled(triple)
    assert again(2.0) == 6.0
    assert sum(again.stats.cache_hits.values()) == 1
    for file in tmp_path.rglob("*.nb*"):
        file.write_bytes(b"junk")
    assert compiled(triple)(2.0) == 6.0


def test_a_part_that_cuts_its_own_range_does_that_alone(threads):
    """Else all threads would wait for parts that no thread is left for."""

    def work(begin, end):
        return in_parts(50, lambda first, last: (first, last), least=1)

    for parts in in_parts(threads, work, least=1):
        assert list(chain.from_iterable(range(*part) for part in parts)) == list(range(50))
        assert threads == 1 or parts == [(0, 50)]


def test_operations_take_one_thread_and_ranges_are_still_cut():
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        with one_thread_each():
            assert torch.get_num_threads() == 1
            assert len(in_parts(30, lambda begin, end: None, least=1)) == 3 * parallel.PARTS_EACH
        assert torch.get_num_threads() == 3
        with pytest.raises(ValueError, match="inside"), one_thread_each():
            raise ValueError("inside")
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)


def test_the_next_item_is_made_while_one_is_used():
    asked = threading.Semaphore(0)

    def items():
        for number in range(3):
            asked.release()
            yield number

    taken = ahead(items())
    assert next(taken) == 0
    assert asked.acquire(timeout=20)  # Item 0
    assert asked.acquire(timeout=20)  # Item 1, which nobody has asked for yet
    assert not asked.acquire(timeout=0.05)
    assert list(taken) == [1, 2]


def test_an_error_comes_when_its_item_is_due():
    def items():
        yield 0
        raise ValueError("the second item")

    taken = ahead(items())
    assert next(taken) == 0
    with pytest.raises(ValueError, match="the second item"):
        next(taken)


def test_items_are_gone_when_their_user_is_done_with_them():
    class Item:
        pass

    made = []

    def items():
        for _ in range(20):
            item = Item()
            made.append(weakref.ref(item))
            yield item
            del item

    for item in ahead(items()):
        del item
        assert sum(one() is not None for one in made) <= 1


def test_a_user_who_stops_ends_the_thread():
    before, closed = threading.active_count(), []

    def items():
        try:
            yield from range(100)
        finally:
            closed.append(True)

    taken = ahead(items())
    assert next(taken) == 0
    taken.close()
    del taken
    assert closed == [True]
    assert threading.active_count() == before


COLD = """
import sys
import numpy as np
from twofold.geometry.face_kernels import nearest_faces
if sys.argv[1:] == ["use"]:
    points, faces = np.zeros((3, 3), np.float32), np.zeros((1, 3), np.int32)
    nearest_faces(points, faces, np.zeros((2, 2), np.float32), np.zeros((2, 2), np.int32), 0, 2)
    from twofold.kernels.parallel import compiled
    nearest_faces(points.astype(float), faces, np.zeros((2, 2), np.float32), np.zeros((2, 2), np.int32), 0, 2)
"""


def test_the_first_compiling_is_announced_and_no_other(tmp_path):
    """Neither an import nor a loop of another signature says anything, nor does a later process."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "kept"), "OMP_NUM_THREADS": "1"}

    def said(*words):
        command = [sys.executable, "-c", COLD, *words]
        return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stderr

    assert said() == ""
    assert said("use") == f"{parallel.COMPILING}\n"
    assert said("use") == ""
