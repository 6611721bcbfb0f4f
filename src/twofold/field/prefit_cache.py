"""Fitted distance networks, kept in the user's cache folder by what they were fitted to."""

import contextlib
import hashlib
import json
import os
from pathlib import Path

import torch
from jaxtyping import Float, Int
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor

from twofold.config import to_dict
from twofold.errors import TwofoldError
from twofold.field.implicit_geometry import ImplicitFieldConfig
from twofold.field.prefit import PrefitConfig, fit_distance
from twofold.files import write_bytes

_VERSION = 1
"""Changes whenever the fitting does, so that older files are not taken."""


def fitted_distance(
    config: ImplicitFieldConfig,
    pose_size: int,
    vertices: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    prefit: PrefitConfig,
) -> dict[str, Tensor]:
    """The state of a distance network that was fitted to a closed mesh at the zero pose.

    It depends on the arguments alone (the fitting has a seed of its own), so a cached one is as good as a new one. It
    is kept in the user's cache folder by the hash of all arguments, where that folder can be written.

    Args:
        config: of the field that the network belongs to.
        pose_size: numbers of the pose.
        vertices: of the mesh, metres.
        faces: counter-clockwise from outside.
        prefit: how it is fitted.
    """
    file = cache_file(config, pose_size, vertices, faces, prefit)
    field = config.build(pose_size, torch.Generator().manual_seed(0))
    network = field.networks.sdf
    with contextlib.suppress(OSError, SafetensorError, ValueError):
        stored = load_file(file)
        own = network.state_dict()
        fits = stored.keys() == own.keys() and all(stored[n].shape == t.shape for n, t in own.items())
        if fits and all(bool(t.isfinite().all()) for t in stored.values()):
            return stored
    fit_distance(
        field, [*network.parameters()], torch.zeros(pose_size), vertices, faces, prefit,
        torch.Generator().manual_seed(0),
    )  # fmt: skip
    state = {name: tensor.detach().clone() for name, tensor in network.state_dict().items()}
    with contextlib.suppress(TwofoldError, OSError):
        file.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(file, save(state))
    return state


def cache_file(
    config: ImplicitFieldConfig,
    pose_size: int,
    vertices: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    prefit: PrefitConfig,
) -> Path:
    """Where `fitted_distance` keeps its result: by the hash of all that it depends on."""
    about = json.dumps([_VERSION, to_dict(config), pose_size, to_dict(prefit)], sort_keys=True)
    digest = hashlib.sha256(about.encode())
    for tensor in (vertices, faces):
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    named = Path(os.environ.get("XDG_CACHE_HOME", ""))
    folder = named if named.is_absolute() else Path("~/.cache").expanduser()
    return folder / "twofold" / "prefit" / f"{digest.hexdigest()[:32]}.safetensors"
