"""Training: one loop for a CPU, a GPU and several processes, readable in one sitting."""

import contextlib
import csv
import io
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor, distributed, nn
from torch.nn.parallel import DistributedDataParallel
from torch.utils.tensorboard import SummaryWriter

from twofold.capture.pixels import PixelSource
from twofold.capture.types import Capture
from twofold.errors import TwofoldError
from twofold.files import write_atomically
from twofold.methods.base import Avatar, Subject
from twofold.outputs.views import draw
from twofold.train.run import (
    Recipe,
    TrainingConfig,
    load_optimizer,
    load_state,
    read_checkpoint,
    read_subject,
    start_folder,
    write_checkpoint,
)


@dataclass(frozen=True)
class Progress:
    """What the loop tells whoever watches: steps done and to do, losses, PSNR over the step's rays (dB)."""

    step: int
    steps: int
    losses: dict[str, float]
    psnr: float


class Step(nn.Module):
    """One training step's losses as a module's `forward`, which is where DDP synchronises gradients."""

    def __init__(self, avatar: Avatar, source: PixelSource, background: Float[Tensor, "3"], recipe: Recipe) -> None:
        """Everything a step needs beside its number."""
        super().__init__()
        self.avatar, self.source, self.recipe = avatar, source, recipe
        self.register_buffer("background", background, persistent=False)

    def forward(self, step: int, rank: int = 0, world: int = 1) -> tuple[dict[str, Tensor], Tensor]:
        """Mean loss terms of this process's share of the step's pictures, and the mean squared error of its colours."""
        images = self.recipe.training.images_per_step // world
        order = frame_order(self.recipe, len(self.source.frames), step)
        terms: dict[str, Tensor] = {}
        error = torch.zeros((), device=self.background.device)
        for slot in range(rank * images, (rank + 1) * images):
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
    return int(np.random.SeedSequence(list(numbers)).generate_state(1, np.uint64)[0] >> 1)


def frame_order(recipe: Recipe, frames: int, step: int) -> list[int]:
    """Which frames a step looks at: each epoch goes through all of them in an order of its own."""
    images = recipe.training.images_per_step
    chosen = []
    for position in range(step * images, (step + 1) * images):
        generator = torch.Generator().manual_seed(mixed(recipe.seed, 7, position // frames))
        chosen.append(int(torch.randperm(frames, generator=generator)[position % frames]))
    return chosen


def rate_factor(config: TrainingConfig, step: int, frames: int) -> float:
    """What the learning rates are multiplied with at a step: warm-up, milestones, decay."""
    epoch = step * config.images_per_step / frames
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


class Curves:
    """Losses over time, as a small table that is written whole with every checkpoint, and for TensorBoard."""

    def __init__(self, folder: Path, start: int) -> None:
        """Continues the table of an interrupted run up to `start`."""
        self.file = folder / "curves.csv"
        self.rows: list[dict[str, float]] = []
        if start and self.file.is_file():
            with self.file.open(newline="", encoding="utf-8") as lines:
                rows = [{k: float(v) for k, v in row.items() if v} for row in csv.DictReader(lines)]
            self.rows = [row for row in rows if row["step"] <= start]
        self.board = SummaryWriter(str(folder / "tensorboard"), purge_step=start)

    def add(self, row: dict[str, float]) -> None:
        """Appends one point."""
        self.rows.append(row)
        for name, value in row.items():
            if name != "step":
                self.board.add_scalar(name, value, int(row["step"]))

    def save(self) -> None:
        """Writes the table."""
        names = list(dict.fromkeys(name for row in self.rows for name in row))
        text = io.StringIO()
        writer = csv.DictWriter(text, names)
        writer.writeheader()
        writer.writerows(self.rows)
        with write_atomically(self.file) as beside:
            beside.write_text(text.getvalue(), encoding="utf-8")
        self.board.flush()


def train(
    capture: Capture, recipe: Recipe, folder: Path, device: torch.device, resume: bool = False,
    watch: Callable[[Progress], None] | None = None, before_first: Callable[[Avatar], None] | None = None,
) -> Avatar:  # fmt: skip
    """Trains an avatar and leaves it in `folder`.

    Args:
        capture: whose training frames are used.
        recipe: how.
        folder: the run; new, or an interrupted one with `resume`.
        device: where.
        resume: continue from the folder's checkpoint (from the start where there is none yet).
        watch: called after every step.
        before_first: called with the new avatar, to attach what is no part of a recipe (perceptual networks).

    Raises:
        TwofoldError: unusable settings, a checkpoint that does not fit, a loss that is not finite, an unwritable folder.
        KeyboardInterrupt: passed on after the state has been stored.
    """
    torch.set_flush_denormal(True)
    rank, world = int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1))
    config = recipe.training
    if config.images_per_step % world:
        raise TwofoldError(f"training.images_per_step is {config.images_per_step}, which {world} processes cannot share.")
    subject = read_subject(folder) if resume else Subject.of(capture)
    if not resume and rank == 0:
        start_folder(folder, recipe, subject, capture.folder)
    avatar = recipe.method.build(subject, recipe.seed).to(device)
    if before_first:
        before_first(avatar)
    optimizer = make_optimizer(avatar, config)
    start = 0
    if resume and (folder / "checkpoint.safetensors").is_file():
        tensors, start = read_checkpoint(folder)
        load_state(avatar, {n[7:]: t for n, t in tensors.items() if n.startswith("avatar.")}, folder)
        load_optimizer(optimizer, tensors)
    margin = getattr(recipe.method.sampler, "radius", 0.3) + 0.02
    source = PixelSource(capture.train, subject.body, subject.betas, config.pixels, capture.background, margin)
    module: nn.Module = Step(avatar, source, torch.tensor(capture.background, device=device), recipe)
    if world > 1:
        # Which parameters take part changes with the schedules (poses, pose-dependent branch).
        module = DistributedDataParallel(module, find_unused_parameters=True)
    curves = Curves(folder, start) if rank == 0 else None
    base_rates = [group["lr"] for group in optimizer.param_groups]
    begun = time.monotonic()
    with asked_to_stop() as stopped:
        for step in range(start, config.steps):
            avatar.before_step(step)
            factor = rate_factor(config, step, len(capture.train))
            for group, rate in zip(optimizer.param_groups, base_rates, strict=True):
                group["lr"] = rate * factor
            terms, error = module(step, rank, world)
            loss = torch.stack(list(terms.values())).sum()
            if not torch.isfinite(loss):
                raise TwofoldError(
                    f"The loss at step {step} is not a finite number; lower the learning rates "
                    "(--set training.rate_low=...) or check the capture with `twofold check`."
                )
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            if config.clip:
                nn.utils.clip_grad_norm_([p for g in optimizer.param_groups for p in g["params"]], config.clip)
            optimizer.step()
            done = step + 1
            if rank == 0 and curves is not None:
                report = Progress(done, config.steps, {n: float(t.detach()) for n, t in terms.items()}, _psnr(error))
                if watch:
                    watch(report)
                if done % 20 == 0 or done == config.steps:
                    row = {"step": float(done), **report.losses, "psnr": report.psnr, "beta": float(avatar.beta.detach())}
                    curves.add(row)
                if done % config.checkpoint_every == 0 or done == config.steps or stopped():
                    write_checkpoint(folder, avatar, optimizer, done)
                    curves.save()
                if config.preview_every and done % config.preview_every == 0 and done < config.steps:
                    _preview(avatar, capture, folder, done)
            if stopped():
                raise KeyboardInterrupt
    if curves is not None:
        curves.board.add_scalar("seconds", time.monotonic() - begun, config.steps)
        curves.board.close()
    if distributed.is_initialized():
        distributed.barrier()
    return avatar.eval()


@contextlib.contextmanager
def asked_to_stop() -> Iterator[Callable[[], bool]]:
    """Ctrl-C as a question that the loop asks between steps, so that no step is ever half applied.

    A second Ctrl-C interrupts at once, as usual. Outside the main thread, signals are somebody else's.
    """
    asked = False

    def note(number: int, stack: object) -> None:
        nonlocal asked
        asked = True
        signal.signal(number, signal.default_int_handler)

    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    before = signal.signal(signal.SIGINT, note)
    try:
        yield lambda: asked
    finally:
        signal.signal(signal.SIGINT, before)


def _psnr(error: Tensor) -> float:
    return -10 * float(torch.log10(error.clamp_min(1e-10)))


def _preview(avatar: Avatar, capture: Capture, folder: Path, step: int) -> None:
    """A training picture beside the avatar's, at most 256 pixels high."""
    frame = capture.train[(step // 7) % len(capture.train)]
    height = min(256, frame.camera.height)
    camera = frame.camera.resized(height, round(frame.camera.width * height / frame.camera.height))
    avatar.eval()
    posed = avatar.pose(frame.pose, frame.translation, frame.time)
    picture = draw(avatar, posed, camera, torch.tensor(capture.background))
    avatar.train()
    truth = Image.open(frame.image_file).convert("RGB").resize((camera.width, camera.height), Image.Resampling.BOX)
    drawn = (torch.cat([picture.color, picture.normal * 0.5 + 0.5], 1) * 255).round().to(torch.uint8).numpy()
    (folder / "previews").mkdir(exist_ok=True)
    Image.fromarray(np.concatenate([np.asarray(truth), drawn], 1)).save(folder / "previews" / f"{step:06d}.png")
