"""A run: its recipe, its folder, its checkpoints. Everything later starts at `load`."""

import json
import platform
import sys
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from twofold import __version__
from twofold.capture.pixels import PixelConfig
from twofold.config import from_dict, to_dict
from twofold.errors import TwofoldError
from twofold.files import write_atomically, write_json, write_npz
from twofold.methods.base import Avatar, Subject
from twofold.methods.factorized import FactorizedConfig


@dataclass(frozen=True)
class TrainingConfig:
    """How an avatar is trained; the defaults are the authors' release."""

    steps: int = 200_000
    images_per_step: int = 2
    """Pictures whose gradients are averaged; each of N processes takes an N-th of them."""
    pixels: PixelConfig = PixelConfig()
    rate_low: float = 5e-4
    rate_high: float = 2e-4
    rate_grid: float = 1e-2
    rate_beta: float = 1e-4
    rate_pose: float = 5e-5
    milestones: tuple[int, ...] = (200, 400)
    """Epochs after which the rates are halved; an epoch sees every training picture once."""
    warmup: int = 0
    """Steps over which the rates rise from zero."""
    decay: float = 1.0
    """What the rates are multiplied with in the end, approached exponentially after `decay_from`; 1 for milestones alone."""
    decay_from: float = 0.3
    """Share of the steps before that decay begins."""
    adam_betas: tuple[float, float] = (0.9, 0.999)
    adam_epsilon: float = 1e-8
    clip: float = 1.0
    """Largest global norm of the gradient; 0 for no limit."""
    checkpoint_every: int = 500
    preview_every: int = 1000


@dataclass(frozen=True)
class Recipe:
    """All that decides a run beside its capture."""

    name: str = "released"
    method: FactorizedConfig = FactorizedConfig()
    training: TrainingConfig = TrainingConfig()
    seed: int = 0


def choose_device(name: str) -> torch.device:
    """The device called `name`; "auto" takes the GPU where there is one.

    Raises:
        TwofoldError: it is not there.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError):
        raise TwofoldError(f"The device {name} is not here; use cpu, or leave --device out.") from None
    return device


def start_folder(folder: Path, recipe: Recipe, subject: Subject, capture: Path) -> None:
    """Writes what a run is: recipe, subject, versions, where its capture lies."""
    folder.mkdir(parents=True, exist_ok=True)
    write_npz(folder / "subject.npz", subject.arrays())
    write_json(folder / "recipe.json", to_dict(recipe))
    packages = {name: metadata.version(name) for name in ("torch", "numpy", "scipy", "safetensors")}
    about = {
        "twofold": __version__,
        "python": sys.version.split()[0],
        "machine": platform.platform(),
        "threads": torch.get_num_threads(),
        "packages": packages,
        "capture": str(capture.resolve()),
    }
    write_json(folder / "run.json", about)


def read_recipe(folder: Path) -> Recipe:
    """The recipe of a run.

    Raises:
        TwofoldError: the folder is no run, or its recipe is damaged.
    """
    file = folder / "recipe.json"
    if not file.is_file():
        raise TwofoldError(f"{folder} is not a run: it has no recipe.json; give the folder that `twofold train` made.")
    try:
        data = json.loads(file.read_text(encoding="utf-8"))
    except ValueError:
        raise TwofoldError(f"{file} is not valid JSON; it is damaged, train again.") from None
    return from_dict(Recipe, data, str(file))


def read_about(folder: Path) -> dict[str, object]:
    """What `run.json` says: versions and where the capture lies."""
    try:
        return json.loads((folder / "run.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        raise TwofoldError(f"{folder / 'run.json'} is missing or damaged; train again.") from None


def read_subject(folder: Path) -> Subject:
    """The subject of a run."""
    file = folder / "subject.npz"
    try:
        with np.load(file) as data:
            return Subject.from_arrays(dict(data), str(file))
    except (OSError, ValueError):
        raise TwofoldError(f"{file} is missing or damaged; train again.") from None


def load(folder: Path, device: torch.device | str = "cpu") -> tuple[Avatar, int]:
    """The avatar of a run as its newest checkpoint has it, and how many steps it was trained.

    Raises:
        TwofoldError: the folder is no run, or has no checkpoint yet.
    """
    recipe = read_recipe(folder)
    avatar = recipe.method.build(read_subject(folder), recipe.seed)
    tensors, step = read_checkpoint(folder)
    own = {name[len("avatar.") :]: t for name, t in tensors.items() if name.startswith("avatar.")}
    load_state(avatar, own, folder)
    return avatar.to(device).eval(), step


def load_state(avatar: Avatar, state: dict[str, Tensor], folder: Path) -> None:
    """Puts stored tensors into an avatar; a mismatch is a TwofoldError that names the first one."""
    expected = avatar.state_dict()
    wrong = [n for n in expected if n not in state or state[n].shape != expected[n].shape]
    if wrong or len(expected) != len(state):
        first = wrong[0] if wrong else next(n for n in state if n not in expected)
        raise TwofoldError(f"The checkpoint in {folder} does not fit its recipe (first at {first}); train again.")
    avatar.load_state_dict(state)


def write_checkpoint(folder: Path, avatar: Avatar, optimizer: torch.optim.Optimizer, step: int) -> None:
    """Stores everything that continuing needs, beside the old checkpoint and then in its place."""
    tensors = {f"avatar.{name}": t for name, t in avatar.state_dict().items()}
    for index, values in optimizer.state_dict()["state"].items():
        tensors |= {f"optimizer.{index}.{key}": torch.as_tensor(value) for key, value in values.items()}
    whole = {name: t.detach().cpu().contiguous() for name, t in tensors.items()}
    with write_atomically(folder / "checkpoint.safetensors") as beside:
        beside.write_bytes(save(whole, metadata={"step": str(step), "twofold": __version__}))


def read_checkpoint(folder: Path) -> tuple[dict[str, Tensor], int]:
    """The tensors of the newest checkpoint and its step.

    Raises:
        TwofoldError: there is none, or it cannot be read.
    """
    file = folder / "checkpoint.safetensors"
    if not file.is_file():
        raise TwofoldError(f"{folder} has no checkpoint yet; continue it with `twofold train --resume {folder}`.")
    try:
        with safe_open(file, framework="pt") as stored:
            return {n: stored.get_tensor(n) for n in stored.keys()}, int((stored.metadata() or {})["step"])  # noqa: SIM118
    except (SafetensorError, KeyError, ValueError, OSError):
        raise TwofoldError(f"{file} is damaged; train again.") from None


def load_optimizer(optimizer: torch.optim.Optimizer, tensors: dict[str, Tensor]) -> None:
    """Puts stored moments back into an optimizer of the same parameters."""
    state: dict[int, dict[str, Tensor]] = {}
    for name, tensor in tensors.items():
        if name.startswith("optimizer."):
            _, index, key = name.split(".")
            state.setdefault(int(index), {})[key] = tensor
    optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})
