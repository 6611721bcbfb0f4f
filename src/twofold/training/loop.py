"""Training: one loop for a CPU, a GPU and several processes, readable in one sitting."""

import contextlib
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from twofold import losses
from twofold.capture.coverage import coverage_of
from twofold.capture.types import Capture, Frame
from twofold.errors import TwofoldError
from twofold.files import plain_errors
from twofold.kernels.parallel import one_thread_each
from twofold.kernels.runtime import flush_denormals
from twofold.methods.base import Avatar, Mode, Stage
from twofold.methods.subject import Subject
from twofold.methods.table import fitted
from twofold.recipe import Recipe, TrainingConfig
from twofold.sampling.joint_box import RELEASED_MARGIN, RELEASED_SLACK
from twofold.training.camera_colors import CameraColors, LearnedResponse, load_camera_colors
from twofold.training.clock import Clock
from twofold.training.curves import Curves
from twofold.training.lock import locked
from twofold.training.pixels import PixelSource
from twofold.training.processes import Team, joined
from twofold.training.row_adam import few_visits, make_optimizer
from twofold.training.run import (
    CHECKPOINT,
    load_optimizer,
    load_state,
    lower_rates,
    read_checkpoint,
    read_subject,
    require_finite,
    require_free,
    require_same,
    start_folder,
    write_checkpoint,
)
from twofold.training.stopping import asked_to_stop

MAX_RESTARTS = 5
"""Times that a training may begin again by itself."""
ROW_EVERY = 20
"""Steps between two rows of the curves."""
COMPILED = "The networks are compiled (torch.compile): the first step takes minutes."
NOTHING_COMPILED = "This recipe has no dense networks, so training.compile changes nothing."


@dataclass(frozen=True)
class Progress:
    """The state after a step: steps done and to do, losses, PSNR over the step's rays (dB)."""

    step: int
    steps: int
    losses: dict[str, float]
    psnr: float


class Step(nn.Module):
    """One training step's losses as a module's `forward`, which is where DDP synchronises gradients."""

    color: Tensor

    def __init__(
        self, avatar: Avatar, source: PixelSource, color: Float[Tensor, "3"], stage: Stage, seed: int,
        colors: CameraColors | None = None,
    ) -> None:  # fmt: skip
        """Everything a step needs beside its number; `color` is the capture's background."""
        super().__init__()
        self.avatar, self.source, self.stage, self.seed, self.colors = avatar, source, stage, seed, colors
        self.register_buffer("color", color, persistent=False)

    def forward(self, step: int, mode: Mode, team: Team) -> tuple[dict[str, Tensor], Tensor]:
        """Mean loss terms of this process's part of the step's images, and the mean squared error of its colours."""
        training = self.stage.training
        images = training.images_per_step // team.size
        order = frame_order(training, self.seed, len(self.source.frames), step)
        terms: dict[str, Tensor] = {}
        error = torch.zeros((), device=self.color.device)
        for slot in range(team.rank * images, (team.rank + 1) * images):
            # Every choice follows from seed, step and slot, so a resumed run and any number of processes make the same.
            generator = torch.Generator().manual_seed(mixed(self.seed, step, slot))
            which = order[slot]
            frame = self.source.frames[which]
            batch = self.source.draw(which, generator, self.color.device)
            batch = batch.against(self.avatar.background(self.color, len(batch.rays), generator))
            posed = self.avatar.pose(frame.pose, frame.translation, frame.frame_index, mode)
            rendering = self.avatar.render(batch.rays, posed, batch.background, mode, generator)
            if self.colors is not None:
                rendering = self.colors.seen(rendering, batch, frame.camera_name)
            for name, term in self.avatar.losses(rendering, batch, posed, mode, generator).items():
                terms[name] = terms.get(name, 0) + term / images
            error = error + (rendering.color.detach() - batch.color).square().mean() / images
        if self.colors is not None:
            terms["camera_colors"] = self.colors.penalty()
        return terms, error


def mixed(*numbers: int) -> int:
    """A seed from several numbers, well spread."""
    return int(np.random.SeedSequence(list(numbers)).generate_state(1, np.uint64)[0]) >> 1


def frame_order(config: TrainingConfig, seed: int, frames: int, step: int) -> list[int]:
    """Which frames a step sees: each epoch goes through all of them in an order of its own."""
    images = config.images_per_step
    # Positions in an endless row of epochs; whole steps make every epoch as long as all its steps.
    length = frames if config.epochs == "images" else images * math.ceil(frames / images)
    chosen = []
    for position in range(step * images, (step + 1) * images):
        generator = torch.Generator().manual_seed(mixed(seed, 7, position // length))
        chosen.append(int(torch.randperm(frames, generator=generator)[position % length % frames]))
    return chosen


def epoch_steps(config: TrainingConfig, frames: int) -> int | float:
    """Steps of an epoch: images over images per step, and as released the next whole number.

    >>> epoch_steps(TrainingConfig(images_per_step=2), 5), epoch_steps(TrainingConfig(epochs="steps"), 5)
    (2.5, 3)
    """
    steps = frames / config.images_per_step
    return steps if config.epochs == "images" else math.ceil(steps)


def mode_at(config: TrainingConfig, step: int, frames: int) -> Mode:
    """The mode of a training step: its epoch, and whether it is the epoch's first step.

    >>> mode_at(TrainingConfig(epochs="steps"), 6, 5)
    Mode(step=6, epoch=2, starts_epoch=True)
    """
    steps = epoch_steps(config, frames)
    epoch = int(step // steps)
    return Mode(step, epoch, step == 0 or epoch > int((step - 1) // steps))


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


def wants_compiling(config: TrainingConfig, device: torch.device) -> bool:
    """Whether `config.compile` asks for compiled networks on that device."""
    return config.compile == "always" or (config.compile == "auto" and device.type == "cuda")


def train(
    capture: Capture, recipe: Recipe, folder: Path, device: torch.device, resume: bool = False,
    progress: Callable[[Progress], None] | None = None, before_first: Callable[[Avatar], str | None] | None = None,
    preview: Callable[[Avatar, int], None] | None = None, say: Callable[[str], None] | None = None,
) -> Avatar:  # fmt: skip
    """Trains an avatar and leaves it in `folder`.

    Args:
        capture: whose training frames are used.
        recipe: how.
        folder: the run; new, or an interrupted one with `resume`.
        device: where.
        resume: continue from the folder's checkpoint (from the start where there is none yet).
        progress: called after every step.
        before_first: called with the new avatar, to attach what is no part of a recipe (perceptual networks); what it
            has to say is noted in the run.
        preview: called with the avatar and the steps done, from time to time.
        say: called with each note before the first step.

    Raises:
        TwofoldError: unusable settings, a checkpoint that does not fit, another capture than the run was begun with,
            a loss that is not finite, an unwritable folder.
        KeyboardInterrupt: passed on after the state has been stored.
    """
    flush_denormals()
    recipe, settled = fitted(recipe, capture)
    config = recipe.training
    with (
        plain_errors(folder), joined(device) as team, asked_to_stop() as stopped, contextlib.ExitStack() as at_the_end
    ):  # fmt: skip
        if resume:
            require_same(folder, capture, motion=True)
        subject = read_subject(folder) if resume else Subject.of(capture)
        begun = team.leads and folder.is_dir() and any(folder.iterdir())
        if begun:
            at_the_end.enter_context(locked(folder))
        if not resume and team.leads:
            require_free(folder)
        avatar = recipe.method.build(subject, recipe.seed).to(device)
        found = None if resume else avatar.check_capture(capture)
        seldom = few_visits(avatar.parameter_groups(), avatar.stages(config)[-1].training, len(subject.times))
        first = before_first(avatar) if before_first else None
        notes = [note for note in (first, found, settled, seldom) if note]
        if wants_compiling(config, device):
            notes.append(COMPILED if at_the_end.enter_context(avatar.compiled()) else NOTHING_COMPILED)
        if say and team.leads:
            for note in [*notes, *([] if resume else [coverage_of(capture).sentence()])]:
                say(note)
        if not resume and team.leads:
            start_folder(folder, recipe, subject, capture.folder, tuple(notes), coverage_of(capture))
            if not begun:
                at_the_end.enter_context(locked(folder))
        clock = Clock(folder / CHECKPOINT if resume else None)
        run = _Run(capture, recipe, folder, device, team, avatar)
        run.restore(resume)
        curves = Curves(folder, run.step) if team.leads else None
        if curves is not None:
            at_the_end.callback(curves.close)
        while run.step < run.steps:
            with run.threads():
                terms, error = run.advance()
            done, steps = run.step, run.steps
            report, stop = _agreed(team, recipe, terms, error, stopped(), done, steps)
            if avatar.after_step(run.mode, capture) == "restart":
                run.restart()
                if curves is not None:
                    curves.rows.clear()
                if say and team.leads:
                    say(f"The training started again at step {done}, from other initial weights: nothing was visible.")
                continue
            if curves is not None:
                if progress:
                    progress(report)
                if done % ROW_EVERY == 0 or done == steps:
                    curves.add({"step": float(done), **report.losses, "psnr": report.psnr, **avatar.scalars()})
                    require_finite(avatar.state_dict(), folder, done)
                if done == steps:
                    require_finite({"the surface": _level_on_body(avatar, capture.train[0])}, folder, done)
                if done % config.checkpoint_every == 0 or done in run.ends or stop:
                    # In this order: the curves are cut back to the checkpoint, not the other way round.
                    curves.save()
                    write_checkpoint(folder, avatar, run.optimizer, done, run.restarts, clock.spent(), run.colors)
                if preview and config.preview_every and done % config.preview_every == 0 and done < steps:
                    avatar.eval()
                    preview(avatar, done)
                    avatar.train()
            if stop:
                raise KeyboardInterrupt
        team.wait()
    avatar.row_gradients(collect=False)
    return avatar.eval()


@torch.no_grad()
def _level_on_body(avatar: Avatar, frame: Frame) -> Float[Tensor, "V"]:
    """The field at the body's vertices, which finite parameters may make infinite all the same."""
    posed = avatar.pose(frame.pose, frame.translation)
    at = posed.body.vertices if avatar.level_space == "posed" else posed.body.canonical_vertices
    return avatar.level(at, posed)


class _Run:
    """The state of a training between steps: its stage, optimizer and pixels."""

    def __init__(
        self, capture: Capture, recipe: Recipe, folder: Path, device: torch.device, team: Team, avatar: Avatar
    ) -> None:
        self.capture, self.folder, self.team, self.avatar = capture, folder, team, avatar
        self.recipe, self.step, self.restarts = recipe, 0, 0
        self.stages = avatar.stages(recipe.training)
        for stage in self.stages:
            images = stage.training.images_per_step
            if images % team.size:
                raise TwofoldError(
                    f"images_per_step is {images}, which {team.size} processes cannot share; choose a multiple."
                )
        self.ends = list(itertools.accumulate(stage.training.steps for stage in self.stages))
        self.steps = self.ends[-1]
        self.color = torch.tensor(capture.background, device=device)
        cameras, wanted = dict.fromkeys(frame.camera_name for frame in capture.train), recipe.training.camera_colors
        self.colors = CameraColors([*cameras], wanted).to(device) if wanted != "off" and len(cameras) > 1 else None
        avatar.camera_response = None if self.colors is None else LearnedResponse(self.colors)
        self.current = -1

    @property
    def seed(self) -> int:
        """The recipe's seed; another one after each restart."""
        return mixed(self.recipe.seed, 13, self.restarts) % 2**32 if self.restarts else self.recipe.seed

    @property
    def begin(self) -> int:
        """The first step of the current stage."""
        return self.ends[self.current] - self.stages[self.current].training.steps

    @property
    def mode(self) -> Mode:
        """Of the step that was made last, or of the first one."""
        step = max(self.step - 1 - self.begin, 0)
        return self._mode(step)

    def _mode(self, step: int) -> Mode:
        return mode_at(self.stages[self.current].training, step, len(self.capture.train))

    def restore(self, resume: bool) -> None:
        """Puts the checkpoint's state back; a new run begins its first stage."""
        if not resume or not (self.folder / CHECKPOINT).is_file():
            self._enter(0, prepared=False)
            return
        tensors, self.step, self.restarts = read_checkpoint(self.folder)
        load_state(self.avatar, {n[7:]: t for n, t in tensors.items() if n.startswith("avatar.")}, self.folder)
        if self.colors is not None:
            load_camera_colors(self.colors, tensors, self.folder)
        # A checkpoint at the very end of a stage still holds that stage's state.
        self._enter(next((i for i, end in enumerate(self.ends) if self.step <= end), len(self.ends) - 1), prepared=True)
        load_optimizer(self.optimizer, tensors)

    def _enter(self, stage: int, prepared: bool) -> None:
        self.current, chosen, frames = stage, self.stages[stage], self.capture.train
        if not prepared:
            generator = torch.Generator().manual_seed(mixed(self.seed, 11, stage, self.restarts))
            self.avatar.prepare_training(self.capture, stage, generator)
        self.optimizer = make_optimizer(self.avatar, chosen.training, self.colors, self.team.size == 1)
        self.rates = [group["lr"] for group in self.optimizer.param_groups]
        subject = self.avatar.subject
        margins = self.avatar.ray_margin, RELEASED_MARGIN + RELEASED_SLACK / subject.scene_scale
        source = PixelSource(frames, subject.body, subject.betas, chosen.training.pixels, *margins)
        module = Step(self.avatar, source, self.color, chosen, self.seed, self.colors)
        self.module = self.team.shared(module) if self.team.size > 1 else module

    def threads(self) -> contextlib.AbstractContextManager[None]:
        """While the block lasts, PyTorch's operations take as many threads as pay for a step of this stage."""
        training = self.stages[self.current].training
        small = self.avatar.one_thread_each(training.pixels.rays * training.images_per_step)
        return one_thread_each() if small and self.color.device.type == "cpu" else contextlib.nullcontext()

    def advance(self) -> tuple[dict[str, Tensor], Tensor]:
        """Makes one step."""
        if self.step == self.ends[self.current]:
            self._enter(self.current + 1, prepared=False)
        config = self.stages[self.current].training
        within = self.step - self.begin
        mode = self._mode(within)
        self.avatar.before_step(mode)
        factor = rate_factor(config, within, len(self.capture.train))
        for group, rate in zip(self.optimizer.param_groups, self.rates, strict=True):
            group["lr"] = rate * factor ** group["decay_power"]
        terms, error = self.module(self.step, mode, self.team)
        self.optimizer.zero_grad(set_to_none=True)
        losses.total(terms).backward()
        if config.clip:
            parameters = [p for g in self.optimizer.param_groups for p in g["params"]]
            nn.utils.clip_grad_norm_(parameters, config.clip)
        self.optimizer.step()
        self.step += 1
        return terms, error

    def restart(self) -> None:
        """Begins the training again from other random choices.

        Raises:
            TwofoldError: it has done so too often.
        """
        self.restarts += 1
        if self.restarts > MAX_RESTARTS:
            raise TwofoldError(
                f"The training of {self.folder} showed nothing {MAX_RESTARTS} times; check the masks and poses of the "
                "capture with `twofold check`, or choose another --seed."
            )
        self.step = 0
        state = self.recipe.method.build(self.avatar.subject, self.seed).state_dict()
        self.avatar.load_stored(state)
        self.avatar.load_state_dict(state)
        if self.colors is not None:
            for parameter in self.colors.parameters():
                parameter.data.zero_()
        self._enter(0, prepared=False)


def _agreed(
    team: Team, recipe: Recipe, terms: dict[str, Tensor], error: Tensor, stop: bool, done: int, steps: int
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
            f"The loss at step {done - 1} is not a finite number; {lower_rates(recipe)}, or look at the capture's "
            "images and poses."
        )
    return Progress(done, steps, named, -10 * math.log10(max(error_mean, 1e-10))), stopping > 0
