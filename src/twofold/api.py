"""The public functions of `import twofold`: read a capture, train, load, render, evaluate.

`docs/python.md` shows them at work. Lengths are metres, angles radians, colours 0..1.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from twofold.capture.types import Capture
from twofold.capture.validate import require, validate
from twofold.evaluation import MAX_IMAGES, measure
from twofold.geometry.cameras import Camera
from twofold.methods.base import Avatar
from twofold.methods.table import chosen_recipe
from twofold.outputs.mesh import posed_surface
from twofold.outputs.views import RenderedImage, render_image
from twofold.training import loop
from twofold.training.loop import Progress
from twofold.training.run import choose_device
from twofold.training.run import load as load_run

BLACK = (0.0, 0.0, 0.0)


def train(
    capture: Capture,
    out: str | Path,
    recipe: str = "quick",
    settings: Sequence[str] = (),
    seed: int = 0,
    device: str = "auto",
    progress: Callable[[Progress], None] | None = None,
    steps: int | None = None,
) -> Avatar:
    """Trains an avatar of a capture and leaves the run in a folder, as `twofold train` does.

    Args:
        capture: what `read_capture` returned.
        out: run folder to make.
        recipe: a name that `twofold train --help` lists.
        settings: changes of the recipe, such as "training.steps=500".
        seed: of everything random.
        device: "auto", "cpu", "cuda" or "cuda:N".
        progress: called after each step with its losses.
        steps: of the training, all stages together, with the recipe's whole schedule scaled to it.

    Raises:
        TwofoldError: a faulty capture, an unknown recipe or setting, a folder that is not free, a training that
            diverges.
    """
    chosen = chosen_recipe(recipe, settings, seed, steps=steps)
    require(validate(capture.folder), capture.folder)
    return loop.train(capture, chosen, Path(out), choose_device(device), progress=progress)


def load(run: str | Path, device: str = "cpu") -> Avatar:
    """The avatar of a run folder, ready to be posed and rendered.

    Args:
        run: what `train` or `twofold train` left.
        device: "auto", "cpu", "cuda" or "cuda:N".

    Raises:
        TwofoldError: the folder is no run, or has no checkpoint yet.
    """
    return load_run(Path(run), choose_device(device))[0]


def render(
    avatar: Avatar,
    camera: Camera,
    pose: Float[Tensor, "24 3"],
    translation: Float[Tensor, "3"] | None = None,
    background: tuple[float, float, float] = BLACK,
) -> RenderedImage:
    """An image of the avatar in a pose, with opacity, depth, normals, and its pose-independent branch.

    Args:
        avatar: whom.
        camera: from where.
        pose: axis-angle rotations of SMPL's 24 joints, root first, radians.
        translation: SMPL's own, metres; None leaves the body at the origin.
        background: colour behind the person, 0..1.

    Returns:
        tensors on the CPU: `color` [h w 3], `opacity` [h w], `depth` [h w] in metres, `normal` [h w 3], `base` [h w 3].
    """
    with torch.no_grad():
        posed = avatar.pose(pose, torch.zeros(3) if translation is None else translation)
    return render_image(avatar, posed, camera, torch.tensor(background))


def mesh(
    avatar: Avatar,
    pose: Float[Tensor, "24 3"],
    translation: Float[Tensor, "3"] | None = None,
    voxel: float = 0.008,
) -> tuple[Float[Tensor, "V 3"], "Tensor"]:
    """The avatar's surface in a pose as vertices (metres) and triangles.

    Args:
        avatar: whom.
        pose: axis-angle rotations of SMPL's 24 joints, root first, radians.
        translation: SMPL's own, metres; None leaves the body at the origin.
        voxel: edge of the grid cells that the surface is extracted from, metres.

    Raises:
        TwofoldError: there is no surface near the body.
    """
    with torch.no_grad():
        posed = avatar.pose(pose, torch.zeros(3) if translation is None else translation)
        vertices, faces = posed_surface(avatar, posed, voxel)
    return vertices.cpu(), faces.cpu()


def evaluate(
    avatar: Avatar, capture: Capture, max_images: int | None = MAX_IMAGES, max_meshes: int | None = 4
) -> dict[str, object]:
    """Metrics of an avatar against its capture's held-out frames and meshes, each with its protocol.

    Args:
        avatar: to evaluate.
        capture: with ground truth.
        max_images: at most this many images a split, evenly spread; None for all.
        max_meshes: at most this many meshes.

    Returns:
        what `twofold evaluate` writes to metrics.json.
    """
    return measure(avatar, capture, max_images, max_meshes)
