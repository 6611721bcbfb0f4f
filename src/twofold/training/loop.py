"""Training: one loop for a CPU, a GPU and several processes, readable in one sitting."""

import contextlib
import math
import signal
import threading
import time
from collections.abc import Callable, Generator
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from twofold import losses
from twofold.capture.types import Capture, Frame
from twofold.errors import TwofoldError
from twofold.files import plain_errors
from twofold.kernels.runtime import flush_denormals
from twofold.methods.base import Avatar, Subject
from twofold.methods.placing import RELEASED_MARGIN, RELEASED_SLACK
from twofold.recipe import Recipe, TrainingConfig
from twofold.training.curves import Curves
from twofold.training.lock import locked
from twofold.training.pixels import PixelSource
from twofold.training.processes import Team, joined
from twofold.training.run import (
    CHECKPOINT,
    LOWER_RATES,
    load_optimizer,
    load_state,
    read_checkpoint,
    read_subject,
    require_finite,
    require_free,
    require_same,
    start_folder,
    write_checkpoint,
)

ROW_EVERY = 20
"""Steps between two rows of the curves."""
COMPILED = "The networks are compiled (torch.compile): the first step takes minutes."
NOTHING_COMPILED = "This recipe has no dense networks, so training.compile changes nothing."


@dataclass(frozen=True)
class Progress:
    """What the loop tells whoever watches: steps done and to do, losses, PSNR over the step's rays (dB)."""

    step: int
    steps: int
    losses: dict[str, float]
    psnr: float


class Step(nn.Module):
    """One training step's losses as a module's `forward`, which is where DDP synchronises gradients."""

    background: Tensor

    def __init__(self, avatar: Avatar, source: PixelSource, background: Float[Tensor, "3"], recipe: Recipe) -> None:
        """Everything a step needs beside its number."""
        super().__init__()
        self.avatar, self.source, self.recipe = avatar, source, recipe
        self.register_buffer("background", background, persistent=False)

    def forward(self, step: int, team: Team) -> tuple[dict[str, Tensor], Tensor]:
        """Mean loss terms of this process's share of the step's pictures, and the mean squared error of its colours."""
        images = self.recipe.training.images_per_step // team.size
        order = frame_order(self.recipe, len(self.source.frames), step)
        terms: dict[str, Tensor] = {}
        error = torch.zeros((), device=self.background.device)
        for slot in range(team.rank * images, (team.rank + 1) * images):
            # Every choice follows from seed, step and slot, so a resumed run and any number of processes make the same.
            generator = torch.Generator().manual_seed(mixed(self.recipe.seed, step, slot))
            which = order[slot]
            frame = self.source.frames[which]
            batch = self.source.draw(which, generator, self.background.device)
            posed = self.avatar.pose(frame.pose, frame.translation, frame.time, step)
            rendering = self.avatar.render(batch.rays, posed, self.background, generator)
            for name, term in self.avatar.losses(rendering, batch, posed, step, generator).items():
                terms[name] = terms.get(name, 0) + term / images
            error = error + (rendering.color.detach() - batch.color).square().mean() / images
        return terms, error


def mixed(*numbers: int) -> int:
    """A seed from several numbers, well spread."""
    return int(np.random.SeedSequence(list(numbers)).generate_state(1, np.uint64)[0]) >> 1


def epoch_steps(config: TrainingConfig, frames: int) -> int | float:
    """Steps of an epoch: pictures over pictures per step, and as released the next whole number.

    >>> epoch_steps(TrainingConfig(images_per_step=2), 5), epoch_steps(TrainingConfig(epochs="steps"), 5)
    (2.5, 3)
    """
    steps = frames / config.images_per_step
    return steps if config.epochs == "images" else math.ceil(steps)


def frame_order(recipe: Recipe, frames: int, step: int) -> list[int]:
    """Which frames a step looks at: each epoch goes through all of them in an order of its own."""
    config, images = recipe.training, recipe.training.images_per_step
    # Positions in an endless row of epochs; whole steps make every epoch as long as all its steps.
    length = frames if config.epochs == "images" else images * math.ceil(frames / images)
    chosen = []
    for position in range(step * images, (step + 1) * images):
        generator = torch.Generator().manual_seed(mixed(recipe.seed, 7, position // length))
        chosen.append(int(torch.randperm(frames, generator=generator)[position % length % frames]))
    return chosen


def rate_factor(config: TrainingConfig, step: int, frames: int) -> float:
    """What the learning rates are multiplied with at a step: warm-up, milestones, decay."""
    epoch = step * config.images_per_step / frames if config.epochs == "images" else step // epoch_steps(config, frames)
    factor = 0.5 ** sum(epoch >= milestone for milestone in config.milestones)
    if config.warmup:
        factor *= min(1.0, (step + 1) / config.warmup)
    begin = config.decay_from * config.steps
    if config.decay != 1.0 and step > begin:
        factor *= config.decay ** ((step - begin) / max(config.steps - begin, 1))
    return factor


def make_optimizer(avatar: Avatar, config: TrainingConfig) -> torch.optim.Optimizer:
    """Adam with one learning rate a parameter group."""
    groups = []
    for name, parameters in avatar.parameter_groups().items():
        if parameters:
            groups.append({"params": parameters, "lr": getattr(config, f"rate_{name}"), "name": name})
    return torch.optim.Adam(groups, betas=config.adam_betas, eps=config.adam_epsilon, fused=True)


def wants_compiling(config: TrainingConfig, device: torch.device) -> bool:
    """Whether `config.compile` asks for compiled networks on that device."""
    return config.compile == "always" or (config.compile == "auto" and device.type == "cuda")


def train(
    capture: Capture, recipe: Recipe, folder: Path, device: torch.device, resume: bool = False,
    watch: Callable[[Progress], None] | None = None, before_first: Callable[[Avatar], str | None] | None = None,
    preview: Callable[[Avatar, int], None] | None = None, say: Callable[[str], None] | None = None,
) -> Avatar:  # fmt: skip
    """Trains an avatar and leaves it in `folder`.

    Args:
        capture: whose training frames are used.
        recipe: how.
        folder: the run; new, or an interrupted one with `resume`.
        device: where.
        resume: continue from the folder's checkpoint (from the start where there is none yet).
        watch: called after every step.
        before_first: called with the new avatar, to attach what is no part of a recipe (perceptual networks); what it
            has to say is noted in the run.
        preview: called with the avatar and the steps done, from time to time.
        say: called with each note before the first step.

    Raises:
        TwofoldError: unusable settings, a checkpoint that does not fit, another capture than the run was begun with,
            a loss that is not finite, an unwritable folder, another process that trains in it.
        KeyboardInterrupt: passed on after the state has been stored.
    """
    flush_denormals()
    config = recipe.training
    with (
        plain_errors(folder), joined(device) as team, asked_to_stop() as stopped, contextlib.ExitStack() as at_the_end
    ):  # fmt: skip
        if config.images_per_step % team.size:
            raise TwofoldError(
                f"training.images_per_step is {config.images_per_step}, which {team.size} processes cannot share; "
                "choose a multiple."
            )
        if resume:
            require_same(folder, capture, motion=True)
        subject = read_subject(folder) if resume else Subject.of(capture)
        begun = team.leads and folder.is_dir() and any(folder.iterdir())
        if begun:
            at_the_end.enter_context(locked(folder))
        if not resume and team.leads:
            require_free(folder)
        avatar = recipe.method.build(subject, recipe.seed).to(device)
        first = before_first(avatar) if before_first else None
        notes = [first] if first else []
        if wants_compiling(config, device):
            notes.append(COMPILED if at_the_end.enter_context(avatar.compiled()) else NOTHING_COMPILED)
        if say and team.leads:
            for note in notes:
                say(note)
        if not resume and team.leads:
            start_folder(folder, recipe, subject, capture.folder, tuple(notes))
            if not begun:
                at_the_end.enter_context(locked(folder))
        avatar.count_epochs(epoch_steps(config, len(capture.train)))
        optimizer = make_optimizer(avatar, config)
        start = _restore(folder, avatar, optimizer) if resume else 0
        margin = getattr(recipe.method.sampler, "radius", 0.3) + 0.02
        box = RELEASED_MARGIN + RELEASED_SLACK / subject.scene_scale
        source = PixelSource(capture.train, subject.body, subject.betas, config.pixels, capture.background, margin, box)
        module: nn.Module = Step(avatar, source, torch.tensor(capture.background, device=device), recipe)
        if team.size > 1:
            module = team.shared(module)
        curves = Curves(folder, start) if team.leads else None
        if curves is not None:
            at_the_end.callback(curves.close)
        base_rates = [group["lr"] for group in optimizer.param_groups]
        for step in range(start, config.steps):
            avatar.before_step(step)
            factor = rate_factor(config, step, len(capture.train))
            for group, rate in zip(optimizer.param_groups, base_rates, strict=True):
                group["lr"] = rate * factor
            terms, error = module(step, team)
            optimizer.zero_grad(set_to_none=True)
            losses.total(terms).backward()
            if config.clip:
                nn.utils.clip_grad_norm_([p for g in optimizer.param_groups for p in g["params"]], config.clip)
            optimizer.step()
            done = step + 1
            report, stop = _agreed(team, terms, error, stopped(), done, config.steps)
            if curves is not None:
                if watch:
                    watch(report)
                if done % ROW_EVERY == 0 or done == config.steps:
                    curves.add({"step": float(done), **report.losses, "psnr": report.psnr, **_scale(avatar)})
                if done % ROW_EVERY == 0 or done == config.steps:
                    require_finite(avatar.state_dict(), folder, done)
                if done == config.steps:
                    require_finite({"the surface": _level_on_body(avatar, capture.train[0])}, folder, done)
                if done % config.checkpoint_every == 0 or done == config.steps or stop:
                    # In this order: the curves are cut back to the checkpoint, not the other way round.
                    curves.save()
                    write_checkpoint(folder, avatar, optimizer, done)
                if preview and config.preview_every and done % config.preview_every == 0 and done < config.steps:
                    avatar.eval()
                    preview(avatar, done)
                    avatar.train()
            if stop:
                raise KeyboardInterrupt
        team.wait()
    return avatar.eval()


@torch.no_grad()
def _level_on_body(avatar: Avatar, frame: Frame) -> Float[Tensor, "V"]:
    """The field at the canonical body's vertices, which finite parameters may make infinite all the same."""
    posed = avatar.pose(frame.pose, frame.translation)
    return avatar.level(posed.body.canonical_vertices, posed)


def _restore(folder: Path, avatar: Avatar, optimizer: torch.optim.Optimizer) -> int:
    """Puts the checkpoint's state back and tells its step; 0 where there is none yet."""
    if not (folder / CHECKPOINT).is_file():
        return 0
    tensors, start = read_checkpoint(folder)
    load_state(avatar, {n[7:]: t for n, t in tensors.items() if n.startswith("avatar.")}, folder)
    load_optimizer(optimizer, tensors)
    return start


def _agreed(
    team: Team, terms: dict[str, Tensor], error: Tensor, stop: bool, done: int, steps: int
) -> tuple[Progress, bool]:
    """What all processes found, averaged, and whether one of them was asked to stop, so that all stop together.

    Raises:
        TwofoldError: the loss is not a finite number.
    """
    values = torch.stack([*(term.detach() for term in terms.values()), error, error.new_tensor(float(stop))])
    *found, error_mean, stopping = team.mean(values.float()).tolist()
    named = dict(zip(terms, found, strict=True))
    if not math.isfinite(sum(found)):
        raise TwofoldError(
            f"The loss at step {done - 1} is not a finite number; {LOWER_RATES}, or look at the capture's pictures and "
            "poses."
        )
    return Progress(done, steps, named, -10 * math.log10(max(error_mean, 1e-10))), stopping > 0


def _scale(avatar: Avatar) -> dict[str, float]:
    """The density's scale, for the curves of methods that have one."""
    beta = getattr(avatar, "beta", None)
    return {"beta": float(beta.detach())} if isinstance(beta, Tensor) else {}


@contextlib.contextmanager
def asked_to_stop() -> Generator[Callable[[], bool], None, None]:
    """Ctrl-C as a question that the loop asks between steps, so that no step is ever half applied.

    A second Ctrl-C interrupts at once, as usual, but only a second later: `torchrun` passes on what the terminal has
    sent already. Outside the main thread, signals are somebody else's.
    """
    asked = math.inf

    def note(number: int, stack: FrameType | None) -> None:
        nonlocal asked
        if time.monotonic() - asked >= 1:
            signal.default_int_handler(number, stack)
        asked = min(asked, time.monotonic())

    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    before = signal.signal(signal.SIGINT, note)
    try:
        yield lambda: asked < math.inf
    finally:
        signal.signal(signal.SIGINT, before)
