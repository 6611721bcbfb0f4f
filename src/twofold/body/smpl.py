"""Reads the user's own SMPL file, without running anything that is in it.

SMPL is distributed as Python pickles, which may run any code when opened the usual way. Here every object in them is
only written down: what it claims to be, with which arguments and which state. Numbers are then taken out of these
records.
"""

import re
from pathlib import Path
from typing import Any, cast

import numpy as np

from twofold.body.skeleton import PARENTS, Body
from twofold.errors import TwofoldError
from twofold.inputs import is_there, read_bytes, shown_path
from twofold.npz import read_npz
from twofold.pickles import CONTAINERS, NUMPY, ForbiddenError, Record, numpy_array, record

SHAPES = 10
_MAX_BYTES = 2**30
"""Four times the largest of these files."""
_MAX_CELLS = 10_000_000
"""Of a sparse matrix: 24 joints by 400,000 vertices."""
_NEEDED = ("v_template", "shapedirs", "posedirs", "J_regressor", "weights", "kintree_table", "f")
_OTHER_BODIES = {52: "SMPL-H", 55: "SMPL-X", 16: "MANO hand", 5: "FLAME head"}
_SOURCE = "smpl.is.tue.mpg.de offers it as basicmodel_*_lbs_10_207_0_v1.1.0.pkl"

_HARMLESS = re.compile(rf"(chumpy|scipy\.sparse)(\.\w+)*\.\w+|{NUMPY}|{CONTAINERS}")
"""What occurs in SMPL files; even these are only recorded."""


def read_smpl(path: Path | str) -> Body:
    """SMPL from its distributed pickle (v1.0.0 or v1.1.0, cleaned of chumpy or not) or from an npz of its arrays.

    The first ten shape coefficients are kept; joints are regressed from the vertices.

    Args:
        path: the file, such as basicmodel_neutral_lbs_10_207_0_v1.1.0.pkl.

    Raises:
        TwofoldError: the file is missing, cut short, of another kind, of another body, wants to run code, or its arrays
            do not fit together.
    """
    path = Path(path)
    raw = _content(path)
    arrays = _npz_arrays(path) if raw[:4] in (b"PK\3\4", b"PK\5\6") else _pickle_arrays(path, raw)
    joints = _joint_count(arrays)
    if joints is not None and joints != len(PARENTS):
        other = _OTHER_BODIES.get(joints, "another body")
        raise TwofoldError(f"{path} holds {other} ({joints} joints), expected SMPL with 24 joints; {_SOURCE}.")
    missing = [name for name in _NEEDED if name not in arrays]
    if missing:
        raise TwofoldError(f"{path} is no SMPL file, it lacks {', '.join(missing)}; {_SOURCE}.")
    return _assemble(arrays, path)


def _assemble(arrays: dict[str, np.ndarray], path: Path) -> Body:
    for name, array in arrays.items():
        if array.dtype.kind not in "fiu":
            raise TwofoldError(f"{name} in {path} should hold numbers, it holds {array.dtype}; get the file again.")
    parents = arrays["kintree_table"]
    # The root's parent is stored as 2^32 - 1.
    if parents.shape != (2, len(PARENTS)) or parents[0, 1:].tolist() != list(PARENTS[1:]):
        raise TwofoldError(f"kintree_table in {path} is not SMPL's tree of 24 joints; get the file again.")
    template, shapes, regressor = arrays["v_template"], arrays["shapedirs"], arrays["J_regressor"]
    if template.ndim != 2 or shapes.ndim != 3 or arrays["posedirs"].ndim != 3 or arrays["f"].ndim != 2:
        raise TwofoldError(f"The arrays in {path} have the wrong number of axes for SMPL; get the file again.")
    v = len(template)
    if regressor.shape != (len(PARENTS), v) or shapes.shape[:2] != (v, 3):
        raise TwofoldError(
            f"J_regressor {regressor.shape} and shapedirs {shapes.shape} in {path} should have the shapes (24, {v}) "
            f"and ({v}, 3, 10 or 300); get the file again."
        )
    basis = shapes[..., :SHAPES]
    return Body.from_arrays(
        {
            "name": np.array("smpl"),
            "template": template,
            "faces": arrays["f"],
            "weights": arrays["weights"],
            "joints": regressor @ template,
            "shape_basis": basis,
            "joint_basis": np.einsum("jv,vds->jds", regressor, basis),
            "pose_basis": arrays["posedirs"],
        },
        str(path),
    )


def _joint_count(arrays: dict[str, np.ndarray]) -> int | None:
    weights = arrays.get("weights")
    return weights.shape[1] if weights is not None and weights.ndim == 2 else None


def _content(path: Path) -> bytes:
    """The whole file."""
    if not is_there(path):
        raise TwofoldError(f"{shown_path(path)} is missing, expected your SMPL file; {_SOURCE}.")
    if path.is_dir():
        raise TwofoldError(f"{path} is a folder, expected the SMPL file itself; name a file in it.")
    return read_bytes(path, _MAX_BYTES)


def _npz_arrays(path: Path) -> dict[str, np.ndarray]:
    """The needed arrays of an npz; the rest may hold Python objects and is not touched."""
    try:
        return read_npz(path, _NEEDED)
    except TwofoldError as error:
        if "Python objects" in str(error):
            what = "holds Python objects, expected plain arrays; use the .pkl file instead"
        else:
            what = "is damaged or cut short; get the file again"
        raise TwofoldError(f"{path} {what}.") from error


def _pickle_arrays(path: Path, raw: bytes) -> dict[str, np.ndarray]:
    try:
        content = record(raw, _HARMLESS)
    except ForbiddenError as error:
        raise TwofoldError(
            f"{path} would run {error} when opened as usual, which no SMPL file does; nothing was run, do not trust it."
        ) from error
    except Exception as error:  # a damaged pickle may fail in any way
        if isinstance(error, EOFError) or "truncated" in str(error):
            raise TwofoldError(f"{path} is cut short; get the file again.") from error
        raise TwofoldError(f"{path} is no SMPL file, neither a pickle nor an npz; {_SOURCE}.") from error
    if not isinstance(content, dict):
        raise TwofoldError(f"{path} is a pickle but holds no SMPL body; {_SOURCE}.")
    arrays: dict[str, np.ndarray] = {}
    for name in _NEEDED:
        if name in content:
            try:
                arrays[name] = _array(content[name])
            except Exception as error:  # records may claim anything, too
                raise TwofoldError(f"{name} in {path} cannot be read ({error}); get the file again.") from error
    return arrays


def _array(value: object) -> np.ndarray:
    """The array that a record stands for."""
    if not isinstance(value, Record):
        return np.asarray(_numbers(value))
    claims = value.claims()
    if claims.endswith(("._reconstruct", "._frombuffer")):
        return numpy_array(value)
    state = cast("dict[str, Any]", value.state)
    if claims.startswith("scipy.sparse."):
        return _dense(state, by_column="csc" in claims)
    if "x" in state:
        return _array(state["x"])
    if claims.endswith(".Select"):
        return _array(state["a"]).ravel()[_array(state["idxs"])].reshape([int(n) for n in state["preferred_shape"]])
    raise ValueError(f"an unknown kind of chumpy object, {claims}")


def _numbers(value: object) -> object:
    if isinstance(value, list | tuple) and all(isinstance(x, int | float) for x in value):
        return value
    raise ValueError(f"expected an array, it is a {type(value).__name__}")


def _dense(state: dict[str, Any], by_column: bool) -> np.ndarray:
    """A compressed sparse matrix as a full one; entries given twice add up."""
    rows, columns = (int(n) for n in state["_shape" if "_shape" in state else "shape"])
    data, inner, starts = (_array(state[name]).ravel() for name in ("data", "indices", "indptr"))
    counts = np.diff(starts)
    if min(rows, columns) < 0 or rows * columns > _MAX_CELLS or len(starts) - 1 > max(rows, columns):
        raise ValueError(f"a sparse matrix of {rows} x {columns} is none of SMPL's")
    if starts.dtype.kind not in "iu" or starts[0] != 0 or starts[-1] != len(data) or counts.min(initial=0) < 0:
        raise ValueError("a sparse matrix does not fit its own numbers")
    if len(inner) != len(data) or inner.min(initial=0) < 0:
        raise ValueError("a sparse matrix points outside itself")
    outer = np.repeat(np.arange(len(counts)), counts)
    dense = np.zeros((rows, columns))
    np.add.at(dense, (inner, outer) if by_column else (outer, inner), data)
    return dense
