"""Completion of what the training images never show: pulls the field there to values that were observed elsewhere."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from twofold.body.skeleton import ShapedBody
from twofold.capture.coverage import Coverage
from twofold.config import require_within
from twofold.field.output import FieldOutput
from twofold.field.surface_fill import SurfaceFill
from twofold.geometry.surfaces import vertex_normals
from twofold.losses import MAX_STEPS
from twofold.recipe import scaled_count

Answers = Callable[[Float[Tensor, "n 3"], Int[Tensor, "n"]], tuple[FieldOutput, ...]]
"""The field at canonical points, each beside a vertex of the body: one answer for each branch that is completed."""

INSIDE, OUTSIDE = -0.02, 0.05
"""How far from the completed surface points are pulled, metres."""
LOWEST, HIGHEST = -0.04, 0.09
"""How far the surface may lie from the body, metres."""
ENOUGH = 0.9
"""Weight from which a vertex is left alone."""
WELL_OBSERVED = 0.9
"""Share of the surface from which on nothing is completed."""
NEWTON = 3
"""Steps along the normal from the body to the surface."""


@dataclass(frozen=True)
class CompletionConfig:
    """How unobserved regions are completed; the defaults leave that out."""

    color: float = 0.0
    """Weight of the squared difference to the completed colour; 0 for both weights leaves completion out."""
    shape: float = 0.0
    """Weight of the squared difference to the completed distance, centimetres."""
    light: float = 0.0
    """Weight of what is not linear in the normal in the law of light, for fields that have one."""
    points: int = 512
    """Points a step."""
    start: int = 200
    """First step: by then colours of observed regions mean something."""
    every: int = 200
    """Steps after which the targets are taken anew from what was learned."""

    def __post_init__(self) -> None:
        """Refuses weights that reward what they should punish."""
        require_within(
            self,
            color=(0, 1e6),
            shape=(0, 1e6),
            light=(0, 1e6),
            points=(1, 1_000_000),
            start=(0, MAX_STEPS),
            every=(1, MAX_STEPS),
        )

    @property
    def active(self) -> bool:
        """Whether anything is completed."""
        return self.color > 0 or self.shape > 0

    def scaled(self, factor: float) -> "CompletionConfig":
        """The schedule stretched by a factor."""
        return replace(self, start=scaled_count(self.start, factor), every=scaled_count(self.every, factor))


class Completion(nn.Module):
    """Coverage and targets of one person. All of it is part of the avatar's state, so a resumed run goes on alike."""

    weight: Tensor
    area: Tensor
    color: Tensor
    offset: Tensor
    vertices: Tensor
    normals: Tensor

    def __init__(
        self,
        config: CompletionConfig,
        shaped: ShapedBody,
        vertices: Float[Tensor, "V 3"],
    ) -> None:
        """Everything counts as observed until `prepare`.

        Args:
            config: how.
            shaped: the body in the T-pose.
            vertices: of the canonical body, metres.
        """
        super().__init__()
        self.config, self.shaped = config, shaped
        count = len(vertices)
        self.register_buffer("weight", torch.ones(count))
        self.register_buffer("area", torch.zeros(count))
        self.register_buffer("color", torch.zeros(count, 3))
        self.register_buffer("offset", torch.zeros(count))
        self.register_buffer("vertices", vertices.clone(), persistent=False)
        self.register_buffer("normals", vertex_normals(vertices, shaped.faces), persistent=False)
        self._fill: SurfaceFill | None = None

    def prepare(self, coverage: Coverage) -> None:
        """Takes on what the training images show; where they show nearly all, nothing is completed.

        Between fingers and under arms something always stays unobserved. On a subject that turns fully (97 % observed)
        completing it cost 0.1 dB in novel views, 0.3 dB in novel poses and 0.03 cm of the surface.
        """
        self.weight.copy_(coverage.weight if coverage.share < WELL_OBSERVED else torch.ones_like(self.weight))
        self.area.copy_(coverage.area)
        self._fill = None

    @torch.no_grad()
    def refresh(self, answer_at: Callable[[Float[Tensor, "n 3"], Int[Tensor, "n"]], FieldOutput]) -> None:
        """Takes the targets from the field as it is: its surface along the normals of the body, and colours there."""
        if self._fill is None:
            self._fill = SurfaceFill(self.shaped, self.weight.cpu().numpy(), self.area.cpu().numpy())
        every = torch.arange(len(self.vertices), device=self.vertices.device)
        offset = torch.zeros_like(self.offset)
        answer = answer_at(self.vertices, every)
        for _ in range(NEWTON):
            offset = (offset - answer.sdf).clamp(LOWEST, HIGHEST)
            answer = answer_at(self.vertices + offset[:, None] * self.normals, every)
        observed = torch.cat([answer.color.clamp(0, 1), offset[:, None]], -1).cpu().numpy()
        completed = torch.from_numpy(self._fill(observed.astype(np.float32))).to(self.color)
        self.color.copy_(completed[:, :3].clamp(0, 1))
        self.offset.copy_(completed[:, 3].clamp(LOWEST, HIGHEST))

    def _unseen(self) -> Float[Tensor, "V"]:
        """Unobserved area around each vertex, square metres."""
        return (1 - self.weight.double() / ENOUGH).clamp_min(0) * self.area

    @property
    def unobserved(self) -> float:
        """Share of the surface that was not observed, each point counted by how badly it was."""
        return float(self._unseen().sum() / self.area.sum().clamp_min(1e-12))

    def is_due(self, step: int) -> bool:
        """Whether the targets are to be taken anew at a step."""
        start, every = self.config.start, self.config.every
        return self.unobserved > 1e-3 and (step == start or (step > start and step % every == 0))

    def terms(self, answers: Answers, step: int, generator: torch.Generator) -> dict[str, Float[Tensor, ""]]:
        r"""The weighted loss terms of a step.

        At vertices $v$ drawn with probability proportional to their unobserved area $u_v a_v$, and points
        $x = v + (t_v + \epsilon) n_v$ about the completed surface, with the share $u$ of the area that is unobserved,

        \[ L_{color} = u \, E \lVert c(x) - \hat c_v \rVert^2, \qquad L_{shape} = u \, E (s(x) - \epsilon)^2 \]

        Args:
            answers: the field.
            step: of the training.
            generator: draws the points.
        """
        config, unseen, share = self.config, self._unseen(), self.unobserved
        if step < config.start or share < 1e-3:
            return {}
        random = torch.rand(config.points, 2, generator=generator, device=generator.device).to(unseen)
        ends = unseen.cumsum(0)
        index = torch.searchsorted(ends, random[:, 0] * ends[-1]).clamp_max(len(ends) - 1)
        away = (INSIDE + (OUTSIDE - INSIDE) * random[:, 1]).float()
        x = self.vertices[index] + (self.offset[index] + away)[:, None] * self.normals[index]
        found = answers(x, index)
        color = share * torch.stack([(answer.color - self.color[index]).square().mean() for answer in found]).mean()
        shape = share * torch.stack([((answer.sdf - away) * 100).square().mean() for answer in found]).mean()
        terms = {"completion_color": config.color * color, "completion_shape": config.shape * shape}
        return {name: term for name, term in terms.items() if getattr(config, name.removeprefix("completion_"))}
