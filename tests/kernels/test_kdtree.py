"""Search trees, also where the smallest numbers count as zero."""

import subprocess
import sys

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from twofold.kernels.kdtree import denormals_kept, query_nearest, search_tree

TINY = 5e-324


@pytest.fixture
def flushing():
    assert torch.set_flush_denormal(True)
    yield
    torch.set_flush_denormal(False)


def test_a_cell_of_zeros_does_not_kill_the_process():
    """In a process of its own, because the fault ends it."""
    script = (
        "import numpy as np, torch; from twofold.kernels.kdtree import search_tree; torch.set_flush_denormal(True);"
        "p = np.zeros((40, 3)); p[25:, 0] = np.arange(1, 16);"
        "assert all(search_tree(p, quick).query([[7.1, 0, 0]])[1][0] == 31 for quick in (False, True))"
    )
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == 0


@pytest.mark.parametrize("before", [True, False])
def test_what_the_thread_did_with_denormals_it_does_again(before):
    torch.set_flush_denormal(before)
    try:
        with denormals_kept():
            assert TINY * 1.0 > 0
        assert (TINY * 1.0 == 0) is before
    finally:
        torch.set_flush_denormal(False)


@given(arrays(np.float64, (30, 2), elements=st.sampled_from([0.0, -0.0, 1.0, 0.5, -2.0])), st.booleans())
def test_the_nearest_is_the_nearest(points, quick):
    sought = np.array([[0.3, 0.4], [-1.0, 5.0]])
    found, _ = search_tree(points, quick).query(sought)
    assert found == pytest.approx(np.linalg.norm(sought[:, None] - points, axis=-1).min(1))


def test_flushing_threads_get_the_same_answers(flushing):
    points = np.random.default_rng(0).normal(size=(500, 3)).round(1)
    distance, _ = search_tree(points).query(points + 0.04, k=3)
    full = np.linalg.norm((points + 0.04)[:, None] - points, axis=-1)
    assert distance == pytest.approx(np.sort(full, 1)[:, :3])


@pytest.mark.parametrize("k", [1, 3])
@pytest.mark.parametrize("threads", [1, 2])
def test_searching_in_parts_finds_what_one_search_finds(k, threads):
    random = np.random.default_rng(0)
    points, sought = random.normal(size=(500, 3)), random.normal(size=(3000, 3))
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        distance, index = query_nearest(search_tree(points), sought, k)
    finally:
        torch.set_num_threads(before)
    full = np.linalg.norm(sought[:, None] - points, axis=-1)
    assert (index == np.argsort(full, 1)[:, :k]).all()
    assert distance == pytest.approx(np.sort(full, 1)[:, :k])


def test_a_search_that_is_interrupted_ends_before_its_process_does():
    """SciPy's own threads run on after Ctrl-C and read the tree that the ending process has freed."""
    script = (
        "import numpy as np, signal, sys, threading, torch; from twofold.kernels.kdtree import *;"
        # A process that was started in the background ignores Ctrl-C.
        "signal.signal(signal.SIGINT, signal.default_int_handler);"
        "torch.set_num_threads(4); random = np.random.default_rng(0);"
        "tree = search_tree(random.normal(size=(50_000, 3))); sought = random.normal(size=(400_000, 3));"
        "threading.Timer(0.1, lambda: signal.raise_signal(signal.SIGINT)).start()\n"
        "try: query_nearest(tree, sought, 7); print('too late')\n"
        "except KeyboardInterrupt:\n"
        "    assert not [t for t in threading.enumerate() if t.daemon]\n"
        "    sys.exit(130)"
    )
    done = subprocess.run([sys.executable, "-c", script], check=False, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")
