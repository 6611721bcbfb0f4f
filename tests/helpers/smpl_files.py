"""SMPL files with random numbers, in the forms in which they are distributed."""

import io
import pickle

import numpy as np
import scipy.sparse

from twofold.body.skeleton import PARENTS


def model(v=60, shapes=10, joints=24, seed=0):
    """The arrays of a SMPL file with the types they have in it, all numbers random."""
    random = np.random.default_rng(seed)
    regressor = np.zeros((joints, v))
    for row in regressor:
        row[random.choice(v, 7, replace=False)] = random.dirichlet(np.ones(7))
    parents = np.array([PARENTS, range(24)]) if joints == 24 else np.zeros((2, joints))
    columns = 9 * (joints - 1)
    return {
        "v_template": random.normal(size=(v, 3)) * 0.3,
        "shapedirs": random.normal(size=(v, 3, shapes)) * 0.03,
        "posedirs": random.normal(size=(v, 3, columns)) * 0.003,
        "J_regressor": regressor,
        "weights": random.dirichlet(np.full(joints, 0.1), v),
        "kintree_table": np.where(parents < 0, 2**32 - 1, parents).astype(np.uint32),
        "f": random.integers(0, v, (2 * v - 4, 3)).astype(np.uint32),
    }


def stand_in(where, **state):
    """An object that claims to come from a package that is not installed."""
    module, _, name = where.rpartition(".")
    made = type(name, (), {"__module__": module, "__qualname__": name})()
    made.__dict__.update(state)
    return made


def chumpy(array):
    return stand_in("chumpy.ch.Ch", x=array, _dirty_vars=set(), _depends_on_deps=None)


def selected(array):
    """chumpy's way to write array[...] : the numbers of another object, and which of them."""
    order = np.random.default_rng(1).permutation(array.size)
    spread = np.empty(array.size)
    spread[order] = array.ravel()
    return stand_in("chumpy.reordering.Select", a=chumpy(spread), idxs=order, preferred_shape=array.shape)


def sparse(array, where="scipy.sparse.csc.csc_matrix", shape_name="_shape"):
    matrix = (scipy.sparse.csc_matrix if "csc" in where else scipy.sparse.csr_matrix)(array)
    state = {name: getattr(matrix, name) for name in ("data", "indices", "indptr")}
    return stand_in(where, maxprint=50, **state, **{shape_name: matrix.shape})


OLD_NAMES = {"numpy._core.multiarray": "numpy.core.multiarray", "builtins": "__builtin__", "copyreg": "copy_reg"}


class Python2Pickler(pickle._Pickler):
    """Writes what Python 2 wrote: byte strings without a detour, old module names."""

    dispatch = dict(pickle._Pickler.dispatch)  # noqa: RUF012

    def save_bytes(self, data):
        if self.proto == 0:
            self.write(b"S" + repr(data)[1:].encode() + b"\n")
        else:
            self.write(b"T" + len(data).to_bytes(4, "little") + data)

    dispatch[bytes] = save_bytes
    dispatch[str] = lambda self, text: self.save_bytes(text.encode("latin1"))

    def save_global(self, obj, name=None):
        module = OLD_NAMES.get(obj.__module__, obj.__module__)
        self.write(f"c{module}\n{name or obj.__qualname__}\n".encode())
        self.memoize(obj)

    def save_type(self, obj):
        self.save_global(obj)

    dispatch[type] = save_type
    dispatch[type(stand_in)] = save_global


def pickled_by_python2(content, protocol):
    file = io.BytesIO()
    Python2Pickler(file, protocol).dump(content)
    return file.getvalue()


def write(path, content):
    path.write_bytes(content)
    return path
