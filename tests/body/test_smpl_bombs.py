"""SMPL files that ask for far more memory or time than they are large."""

import time
import tracemalloc

import numpy as np
import pytest
from smpl_files import model, pickled_by_python2, sparse, stand_in, write

from twofold.body.smpl import read_smpl
from twofold.errors import TwofoldError


def limited(seconds=2, mebibytes=300):
    """Runs a block that takes little time and memory."""
    return Limited(seconds, mebibytes * 2**20)


class Limited:
    def __init__(self, seconds, size):
        self.seconds, self.size = seconds, size

    def __enter__(self):
        self.begun = time.process_time()
        tracemalloc.start()

    def __exit__(self, *error):
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert time.process_time() - self.begun < self.seconds
        assert most < self.size


BOMBS = {
    "a memo of four thousand million places": b"\x80\x02}r\xff\xff\xff\xf0.",
    "a memo with holes": b"\x80\x02}q\x00}r\x00\x00\x00\x10.",
    "a memo in text": b"(dp4000000000\n.",
    "a million objects": b"\x80\x02(" + b"}" * 1_000_100 + b"l.",
    "a million classes": b"\x80\x02(" + b"".join(b"cchumpy.ch\nC%d\n" % i for i in range(20_000)) + b"l.",
    "a string that is not there": b"\x80\x04\x8e" + (2**40).to_bytes(8, "little") + b"abc.",
    "an array of bytes that is not there": b"\x80\x05\x96" + (2**33).to_bytes(8, "little") + b"abc.",
    "a frame that is not there": b"\x80\x04\x95" + (2**60).to_bytes(8, "little") + b"}.",
    "deep lists": b"\x80\x02" + b"]" * 200_000 + b"a" * 199_999 + b".",
    "a long number": b"L" + b"9" * 100_000 + b"L\n.",
}


@pytest.mark.parametrize("name", BOMBS)
def test_a_pickle_that_asks_for_endless_memory_is_refused(tmp_path, name):
    path = write(tmp_path / "smpl.pkl", BOMBS[name])
    with limited(seconds=30), pytest.raises(TwofoldError):
        read_smpl(path)


@pytest.mark.parametrize(
    "wrong",
    [
        {"indptr": np.array([0] * 60 + [2**31])},  # one column repeated two thousand million times
        {"indptr": np.array([0, 2**40] + [0] * 59)},
        {"indptr": np.zeros(0, int)},
        {"indptr": np.arange(10**6)},
        {"_shape": (2**20, 2**20)},
        {"_shape": (-24, -60)},
        {"indices": np.full(3, -1)},
        {"data": np.ones(1)},
    ],
)
def test_a_sparse_matrix_that_asks_for_endless_memory_is_refused(tmp_path, wrong):
    bad = sparse(model()["J_regressor"])
    bad.__dict__.update(wrong)
    raw = pickled_by_python2(model() | {"J_regressor": bad}, 2)
    with limited(), pytest.raises(TwofoldError, match=r"J_regressor in .* cannot be read"):
        read_smpl(write(tmp_path / "smpl.pkl", raw))


def test_a_chain_of_chumpy_objects_without_end_is_refused(tmp_path):
    endless = stand_in("chumpy.ch.Ch")
    endless.x = endless
    with pytest.raises(TwofoldError, match=r"weights in .* cannot be read"):
        read_smpl(write(tmp_path / "smpl.pkl", pickled_by_python2(model() | {"weights": endless}, 2)))
