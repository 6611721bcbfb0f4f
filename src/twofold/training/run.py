"""A run: its recipe, its folder, its checkpoints. Everything later starts at `load`."""

import json
import os
import re
import shutil
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from twofold import __version__
from twofold.capture.coverage import Coverage, coverage_of
from twofold.capture.layout import DESCRIPTION
from twofold.capture.types import Capture
from twofold.errors import TwofoldError
from twofold.files import new_folder, plain_errors, write_atomically, write_json, write_npz
from twofold.inputs import is_there, read_json, require_file, shown, shown_path
from twofold.methods.base import Avatar
from twofold.methods.subject import Subject
from twofold.methods.table import learning_rates, recipe_from_dict, recipe_to_dict
from twofold.npz import read_npz
from twofold.provenance import made_with
from twofold.recipe import Recipe
from twofold.training.camera_colors import CameraColors, LearnedResponse, load_camera_colors
from twofold.training.clock import Spent

RECIPE, ABOUT, SUBJECT, COVERAGE, CHECKPOINT, CURVES = (
    "recipe.json", "run.json", "subject.npz", "coverage.npz", "checkpoint.safetensors", "curves.csv",
)  # fmt: skip
"""What a run folder holds. The recipe is written last, so a folder that has one has all it takes to begin."""
_DAMAGED = "is damaged; train again"


def lower_rates(recipe: Recipe) -> str:
    """What helps a training whose numbers run away: the settings of the method's own learning rates, as they are.

    >>> from twofold.methods.table import RECIPES
    >>> lower_rates(RECIPES["danbo"]())
    'lower the learning rates (now method.rates.all=0.0005; --set changes them) and train again'
    """
    rates = ", ".join(f"{name}={rate:g}" for name, rate in learning_rates(recipe).items())
    return f"lower the learning rates (now {rates}; --set changes them) and train again"


def choose_device(name: str) -> torch.device:
    """The device called `name`; "auto" takes the GPU where there is one. Under `torchrun` each process gets its own.

    Raises:
        TwofoldError: it is not there.
    """
    try:
        device = torch.device(("cuda" if torch.cuda.is_available() else "cpu") if name == "auto" else name)
        if str(device) == "cuda" and "LOCAL_RANK" in os.environ:
            device = torch.device("cuda", int(os.environ["LOCAL_RANK"]))
        if device.type not in ("cpu", "cuda"):
            raise RuntimeError("kernels are written for these two only")
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError):
        here = [f"cuda:{i}" for i in range(torch.cuda.device_count())]
        raise TwofoldError(
            f"The device {name} is not here (there are: {', '.join(['cpu', *here])}); use one of these, or leave "
            "--device out."
        ) from None
    if str(device).startswith("cuda:"):
        torch.cuda.set_device(device)
    return device


def require_free(folder: Path) -> None:
    """Says no where a new run would mix with something else; one that never came to a checkpoint may begin again.

    Raises:
        TwofoldError: the folder holds a run with a checkpoint, or other files.
    """
    with plain_errors(folder):
        if (folder / CHECKPOINT).exists():
            raise TwofoldError(
                f"{folder} already holds a run; continue it with --resume {folder}, or choose another --out."
            )
        if folder.is_dir() and any(folder.iterdir()) and not (folder / SUBJECT).is_file():
            raise TwofoldError(f"{folder} holds files that are no run; choose another --out.")


def start_folder(
    folder: Path, recipe: Recipe, subject: Subject, capture: Path, notes: tuple[str, ...] = (),
    coverage: Coverage | None = None,
) -> None:  # fmt: skip
    """Writes what a run is: recipe, subject, versions, where its capture lies, what there is to note; its coverage.

    Raises:
        TwofoldError: see `require_free`; or the disk refuses.
    """
    require_free(folder)
    about = {
        **made_with(),
        "threads": torch.get_num_threads(),
        "capture": str(capture.resolve()),
        **_body_file(capture),
        "notes": list(notes),
    }

    def fill(place: Path) -> None:
        write_npz(place / SUBJECT, subject.arrays())
        if coverage is not None:
            write_npz(place / COVERAGE, coverage.arrays())
        write_json(place / ABOUT, about)
        write_json(place / RECIPE, recipe_to_dict(recipe))

    if folder.is_dir() and any(folder.iterdir()):
        with plain_errors(folder):
            (folder / RECIPE).unlink(missing_ok=True)
            (folder / CURVES).unlink(missing_ok=True)
            for old in ("tensorboard", "previews"):
                shutil.rmtree(folder / old, ignore_errors=True)
        fill(folder)
    else:
        with new_folder(folder) as place:
            fill(place)


def _body_file(capture: Path) -> dict[str, object]:
    """Name and SHA-256 of the user's SMPL file that a converted capture was made with; nothing where there is none."""
    file = capture / DESCRIPTION
    description = read_json(file) if is_there(file) else None
    notes = description.get("notes") if isinstance(description, dict) else None
    kept = ("body_file", "body_sha256")
    return {key: notes[key] for key in kept if notes.get(key)} if isinstance(notes, dict) else {}


def read_recipe(folder: Path) -> Recipe:
    """The recipe of a run.

    Raises:
        TwofoldError: the folder is no run, or its recipe is damaged.
    """
    file = folder / RECIPE
    if not is_there(file):
        raise TwofoldError(
            f"{shown_path(folder)} is not a run: it has no {RECIPE}; give the folder that `twofold train` made."
        )
    return recipe_from_dict(read_json(file), str(file))


def read_about(folder: Path) -> dict[str, object]:
    """What `run.json` says: versions and where the capture lay.

    Raises:
        TwofoldError: it is missing or damaged.
    """
    about = read_json(folder / ABOUT)
    if not isinstance(about, dict):
        raise TwofoldError(f"{folder / ABOUT} should hold an object; it is damaged, train again.")
    return about


def find_capture(folder: Path, given: Path | None = None, say: str = "--capture") -> Path:
    """The capture of a run: `given`, or where `run.json` says that it lay.

    Raises:
        TwofoldError: it is not there any more; the sentence asks for it by `say`.
    """
    if given is not None:
        return given
    stored = read_about(folder).get("capture")
    if not isinstance(stored, str):
        raise TwofoldError(f"{folder / ABOUT} does not name the run's capture; name it with {say}.")
    if not is_there(Path(stored)):
        raise TwofoldError(f"The capture of {folder} is no longer at {shown_path(stored)}; say where it is with {say}.")
    return Path(stored)


def require_same(folder: Path, capture: Capture, motion: bool) -> None:
    """Says no to a capture that shows somebody else than a run was begun with.

    Args:
        folder: the run.
        capture: that it is to go on with, or to be drawn or measured with.
        motion: whether the training motion has to be the same, too. It has where corrections of poses are used, which
            belong to frames; the avatar alone may take on any motion of its own body.

    Raises:
        TwofoldError: body, shape or, if asked for, motion differ.
    """
    stored, shown = read_subject(folder).arrays(), Subject.of(capture).arrays()
    # The canonical body follows from the others, up to rounding.
    named = [name for name in stored if name != "canonical"]
    compared = [name for name in named if motion or name == "betas" or name.startswith("body_")]
    changed = [name for name in compared if not np.array_equal(stored[name], shown[name])]
    if changed:
        raise TwofoldError(
            f"{capture.folder} is not what {folder} was begun with ({changed[0].replace('_', ' ')} differs); name the "
            "capture that it was trained on, or train anew."
        )


def read_subject(folder: Path) -> Subject:
    """The subject of a run.

    Raises:
        TwofoldError: it is missing or damaged.
    """
    file = folder / SUBJECT
    return Subject.from_arrays(read_npz(file), str(file))


def read_coverage(folder: Path, capture: Capture) -> Coverage:
    """How well the training images of a run observed the surface; of a run that has not stored it, from its capture.

    Raises:
        TwofoldError: it is damaged.
    """
    file = folder / COVERAGE
    if not is_there(file):
        return coverage_of(capture)
    coverage = Coverage.from_arrays(read_npz(file), str(file))
    if len(coverage.weight) != len(capture.body.template):
        raise TwofoldError(f"{file} belongs to another body than {capture.folder} has; train again.")
    return coverage


def load(folder: Path, device: torch.device | str = "cpu") -> tuple[Avatar, int]:
    """The avatar of a run as its newest checkpoint has it, and how many steps it was trained.

    Raises:
        TwofoldError: the folder is no run, or has no checkpoint yet.
    """
    recipe = read_recipe(folder)
    avatar = recipe.method.build(read_subject(folder), recipe.seed)
    tensors, step, _ = read_checkpoint(folder)
    own = {name[len("avatar.") :]: t for name, t in tensors.items() if name.startswith("avatar.")}
    load_state(avatar, own, folder)
    broken = not_finite(own)
    if broken:
        raise TwofoldError(
            f"{folder / CHECKPOINT} holds {broken} with numbers that are not finite, so its avatar cannot be used; "
            f"{lower_rates(recipe)}."
        )
    colors = _camera_colors(folder, tensors)
    avatar.camera_response = None if colors is None else LearnedResponse(colors.to(device))
    return avatar.to(device).eval(), step


def read_camera_colors(folder: Path) -> CameraColors | None:
    """The learned colours of a run's training cameras, as its newest checkpoint has them; None where it has none.

    Raises:
        TwofoldError: there is no checkpoint, or it is damaged.
    """
    return _camera_colors(folder, read_checkpoint(folder)[0])


def _camera_colors(folder: Path, tensors: dict[str, Tensor]) -> CameraColors | None:
    """`read_camera_colors` of a checkpoint that has been read."""
    if "camera_colors.offset" not in tensors:
        return None
    recipe, cameras = read_recipe(folder), json.loads(_metadata(folder / CHECKPOINT).get("cameras", "[]"))
    colors = CameraColors(cameras, "first" if recipe.training.camera_colors == "first" else "mean")
    load_camera_colors(colors, tensors, folder)
    return colors


def _metadata(file: Path) -> dict[str, str]:
    with safe_open(file, framework="pt") as stored:
        return stored.metadata() or {}


def not_finite(tensors: Mapping[str, Tensor]) -> str:
    """The name of the first of these tensors that holds a number that is not finite; empty where none does."""
    return next((name for name, t in tensors.items() if t.is_floating_point() and not t.isfinite().all()), "")


def load_state(avatar: Avatar, state: dict[str, Tensor], folder: Path) -> None:
    """Puts stored tensors into an avatar; a mismatch is a TwofoldError that names the first one."""
    avatar.load_stored(state)
    expected = avatar.state_dict()
    wrong = [n for n, t in expected.items() if n not in state or _kind(state[n]) != _kind(t)]
    if wrong or len(expected) != len(state):
        first = wrong[0] if wrong else next(n for n in state if n not in expected)
        raise TwofoldError(f"The checkpoint in {folder} does not fit its recipe (first at {first}); train again.")
    avatar.load_state_dict(state)


def _kind(tensor: Tensor) -> tuple[torch.Size, bool]:
    """What two tensors have in common of which one can take the other's place."""
    return tensor.shape, tensor.is_floating_point()


def write_checkpoint(
    folder: Path, avatar: Avatar, optimizer: torch.optim.Optimizer, step: int, restarts: int = 0,
    spent: Spent | None = None, colors: CameraColors | None = None,
) -> None:  # fmt: skip
    """Stores everything that continuing needs, beside the old checkpoint and then in its place.

    Args:
        folder: the run.
        avatar: as it is.
        optimizer: with its state.
        step: how many were made.
        restarts: how often the training has begun again.
        spent: the time that all of it took.
        colors: of the training cameras, where they are learned.

    Raises:
        TwofoldError: a parameter is not finite, so the old checkpoint stays; or the disk refuses.
    """
    tensors = {f"avatar.{name}": t for name, t in avatar.state_dict().items()}
    if colors is not None:
        tensors |= {f"camera_colors.{name}": t for name, t in colors.state_dict().items()}
    for index, values in optimizer.state_dict()["state"].items():
        tensors |= {f"optimizer.{index}.{key}": torch.as_tensor(value) for key, value in values.items()}
    require_finite(tensors, folder, step)
    whole = {name: t.detach().cpu().contiguous() for name, t in tensors.items()}
    with write_atomically(folder / CHECKPOINT) as beside:
        about = {"step": str(step), "restarts": str(restarts), "tensors": str(len(whole)), "twofold": __version__}
        about |= {} if colors is None else {"cameras": json.dumps(colors.names)}
        beside.write_bytes(save(whole, metadata=about | (spent.as_text() if spent else {})))


def require_finite(tensors: Mapping[str, Tensor], folder: Path, step: int) -> None:
    """Ends a training whose numbers have run away.

    Raises:
        TwofoldError: one of these tensors holds a number that is not finite; it is named.
    """
    broken = not_finite(tensors)
    if broken:
        name, advice = broken.removeprefix("avatar."), lower_rates(read_recipe(folder))
        raise TwofoldError(f"The training of {folder} diverged: {name} is not finite at step {step}; {advice}.")


def read_checkpoint(folder: Path) -> tuple[dict[str, Tensor], int, int]:
    """The tensors of the newest checkpoint, its step, and how often the training had begun again.

    Raises:
        TwofoldError: there is none, or it cannot be read.
    """
    file = folder / CHECKPOINT
    if not is_there(file):
        raise TwofoldError(f"{folder} has no checkpoint yet; continue it with `twofold train --resume {folder}`.")
    require_file(file)
    try:
        with safe_open(file, framework="pt") as stored:
            about = stored.metadata() or {}
            tensors = {name: stored.get_tensor(name) for name in stored.keys()}  # noqa: SIM118
    except (SafetensorError, KeyError, ValueError, TypeError, AttributeError, OSError) as error:
        raise TwofoldError(f"{file} {_DAMAGED}.") from error
    step = about.get("step", "")
    if not re.fullmatch(r"[0-9]{1,12}", step):
        raise TwofoldError(f"{file} is damaged: the step it was written after is {shown(step)}; train again.")
    # Older checkpoints do not say how many tensors they hold.
    if about.get("tensors", str(len(tensors))) != str(len(tensors)):
        raise TwofoldError(f"{file} is damaged: it lacks tensors that it was written with; train again.")
    restarts = about.get("restarts", "0")
    if not re.fullmatch(r"[0-9]{1,3}", restarts):
        raise TwofoldError(f"{file} is damaged: the restarts before it are {shown(restarts)}; train again.")
    return tensors, int(step), int(restarts)


def load_optimizer(optimizer: torch.optim.Optimizer, tensors: dict[str, Tensor]) -> None:
    """Puts stored moments back into an optimizer of the same parameters.

    Raises:
        TwofoldError: they belong to other parameters, or are not all there.
    """
    parameters = [p for group in optimizer.param_groups for p in group["params"]]
    state: dict[int, dict[str, Tensor]] = {}
    for name, tensor in tensors.items():
        if name.startswith("optimizer."):
            match = re.fullmatch(r"optimizer\.(\d{1,6})\.(step|exp_avg|exp_avg_sq|visits|signal_sums)", name)
            index = int(match[1]) if match else len(parameters)
            shape = parameters[index].shape if index < len(parameters) else torch.Size()
            pooled = torch.Size((2, *shape[1:-1]))
            wanted = {"step": torch.Size(), "visits": shape[:1], "signal_sums": pooled}.get(
                match[2] if match else "", shape
            )
            fits = index < len(parameters) and _kind(tensor) == (wanted, True)
            if match is None or not fits or not tensor.isfinite().all():
                raise TwofoldError(f"The checkpoint does not fit the optimizer (first at {name}); train again.")
            state.setdefault(index, {})[match[2]] = tensor
    lacking = [
        f"optimizer.{i}.{key}" for i, s in state.items() for key in ("step", "exp_avg", "exp_avg_sq") if key not in s
    ]
    if lacking:
        raise TwofoldError(f"The checkpoint lacks {lacking[0]}, which the optimizer needs to continue; train again.")
    optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})
