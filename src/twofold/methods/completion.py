"""Completion of what the training images never show: pulls the field there to values that were observed elsewhere."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

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

Answers = Callable[[Float[Tensor, "n 3"], Int[Tensor, "n"]], FieldOutput]
"""The field at canonical points, each beside a vertex of the body; without light, where the field separates that."""

INSIDE, OUTSIDE = -0.02, 0.05
"""How far from the completed surface points are pulled, metres."""
LOWEST, HIGHEST = -0.04, 0.09
"""How far the surface may lie from the body, metres."""
ENOUGH = 0.7
"""Weight from which a vertex is left alone."""
WELL_OBSERVED = 0.9
"""Share of the surface from which on nothing is completed: that images show, for the shape also that outlines do."""
LEAST_SHARE = 1e-3
"""Share of the surface below which completing it is not worth a term."""
NEWTON = 3
"""Steps along the normal from the body to the surface."""
SHAPE_RING = 0.02
"""Height of the rings that the distance of the surface from the body is taken from, metres."""
LEAST_SLOPE, MOST_SLOPE = -0.1, 0.3
"""How much brighter, in natural logarithms, a surface may be taken to be that faces the cameras than one side on."""
TURNED_AWAY = 0.5
"""How much of that is taken on for surfaces that are turned away, beside those between these two."""


@dataclass(frozen=True)
class CompletionConfig:
    """How unobserved regions are completed; the defaults leave that out."""

    color: float = 0.0
    """Weight of the squared difference to the completed colour; 0 for both weights leaves completion out."""
    shape: float = 0.0
    """Weight of the squared difference to the completed distance, centimetres."""
    outlines: float = 0.0
    """How strongly the shape is completed where images show the body but no outline does, 0 to 1 times as strongly as
    where no image shows it: before few cameras only outlines say how thick limbs are."""
    light: float = 0.0
    """Weight of what is not linear in the normal in the law of light, for fields that have one; 0.1 cost 0.2 dB of the
    training images of a synthetic subject, and gained nothing."""
    points: int = 512
    """Points a step."""
    samples: int = 40_000
    """Points of the surface that have a target."""
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
            outlines=(0, 1),
            light=(0, 1e6),
            points=(1, 1_000_000),
            samples=(100, 10_000_000),
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
    placed: Tensor
    area: Tensor
    facing: Tensor
    target: Tensor
    offset: Tensor
    vertices: Tensor
    normals: Tensor

    def __init__(self, config: CompletionConfig, shaped: ShapedBody, vertices: Float[Tensor, "V 3"]) -> None:
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
        self.register_buffer("placed", torch.ones(count))
        self.register_buffer("area", torch.zeros(count))
        self.register_buffer("facing", torch.zeros(count))
        self.register_buffer("target", torch.zeros(config.samples, 3))
        self.register_buffer("offset", torch.zeros(config.samples))
        self.register_buffer("vertices", vertices.clone(), persistent=False)
        self.register_buffer("normals", vertex_normals(vertices, shaped.faces), persistent=False)
        self._surface: _Surface | None = None
        self._shares: tuple[float, float] | None = None
        self.register_load_state_dict_post_hook(lambda own, _: own._forget())

    def prepare(self, coverage: Coverage, facing: Float[Tensor, "V"]) -> None:
        """Takes on what the training images show.

        Where they show nearly all, no colours are completed; where nearly all of the surface lay on outlines, no shape.
        Between fingers and under arms something always stays unobserved. On a subject that turns fully (97 % observed)
        completing it cost 0.1 dB in novel views, 0.3 dB in novel poses and 0.03 cm of the surface.

        Args:
            coverage: of the body's surface.
            facing: mean cosine between each vertex's normal and its direction to the training cameras.
        """
        well = coverage.share >= WELL_OBSERVED
        self.weight.copy_(torch.ones_like(self.weight) if well else coverage.weight)
        self.area.copy_(coverage.area)
        well = coverage.outlined_share >= WELL_OBSERVED
        self.placed.copy_(torch.ones_like(self.placed) if well else coverage.outline)
        self.facing.copy_(facing)
        self._forget()

    def take_on(self, state: dict[str, Tensor], prefix: str) -> None:
        """Makes the state of an earlier version, whose targets were of vertices, fit; the next step takes new ones."""
        if state.pop(f"{prefix}color", None) is not None:
            state |= {
                f"{prefix}{name}": torch.zeros_like(getattr(self, name)) for name in ("facing", "target", "offset")
            }
        # Their shape was completed where their colours were.
        state.setdefault(f"{prefix}placed", state.get(f"{prefix}weight", self.placed))

    def _forget(self) -> None:
        self._surface = self._shares = None

    def _on_surface(self) -> "_Surface":
        """What follows from coverage alone."""
        if self._surface is None:
            weight, placed, area, facing = (
                values.cpu().numpy() for values in (self.weight, self.placed, self.area, self.facing)
            )
            fill = shape_fill = SurfaceFill(self.shaped, weight, area, facing, self.config.samples)
            if self.config.outlines:
                shape_fill = SurfaceFill(self.shaped, placed, area, facing, self.config.samples)

            def at(values: Tensor) -> Tensor:
                return torch.from_numpy(fill.samples.at(values.cpu().numpy()).astype(np.float32)).to(values)

            nearest = torch.from_numpy(fill.samples.nearest).to(self.vertices.device)
            normals = torch.nn.functional.normalize(at(self.normals), dim=-1)
            lacking = _lacking(at(self.weight))
            ends, shape_ends = lacking.cumsum(0), self._lacking_shape(lacking, at(self.placed)).cumsum(0)
            self._surface = _Surface(fill, at(self.vertices), normals, nearest, ends, shape_fill, shape_ends)
        return self._surface

    @property
    def beside(self) -> Int[Tensor, "n"]:
        """A vertex beside each sample."""
        return self._on_surface().nearest

    @torch.no_grad()
    def refresh(self, answer_at: Answers, light: Float[Tensor, "n 3"]) -> None:
        r"""Takes the targets from the field as it is: its surface along the normals of the body, and colours there.

        A camera that stands still cannot tell a surface that is bright from one that is lit from its side, so the law
        of light does not say how bright the other side is. Here the brightness within rings around the body does: with
        the mean cosine $f$ to the cameras, lit colours are $\exp(b f)$ times what is completed, and the slope $b$ is
        that of `SurfaceFill.slope`; where $f < 0$ half of it, as light that comes from all sides is left there.

        Args:
            answer_at: the field.
            light: what its colours lack at the samples, beside the vertices `beside`.
        """
        on = self._on_surface()
        offset = torch.zeros_like(self.offset)
        answer = answer_at(on.points, on.nearest)
        for _ in range(NEWTON):
            offset = (offset - answer.sdf).clamp(LOWEST, HIGHEST)
            answer = answer_at(on.points + offset[:, None] * on.normals, on.nearest)
        lit = (answer.color.clamp_min(0.004) * light).cpu().numpy()
        slope = min(max(on.fill.slope(np.log(lit.mean(1))), LEAST_SLOPE), MOST_SLOPE)
        facing = on.fill.facing
        brightness = np.exp(slope * np.where(facing < 0, TURNED_AWAY * facing, facing))[:, None]
        found = torch.from_numpy(on.fill(lit / brightness) * brightness).to(self.target)
        self.target.copy_((found / light).clamp(0, 1))
        away = torch.from_numpy(on.shape_fill(offset[:, None].cpu().numpy(), SHAPE_RING, None))[:, 0]
        self.offset.copy_(away.clamp(LOWEST, HIGHEST))

    @property
    def unobserved(self) -> float:
        """Share of the surface that was not observed, each point counted by how badly it was."""
        return self._share(_lacking(self.weight))

    @property
    def unplaced(self) -> float:
        """Share of the surface whose shape is completed, each point counted by how strongly."""
        return self._share(self._lacking_shape(_lacking(self.weight), self.placed))

    def _lacking_shape(self, lacking: Float[Tensor, "n"], placed: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
        """How badly the place of points is known, 0..1, by how badly their colours are and by the outlines."""
        return torch.maximum(lacking, self.config.outlines * _lacking(placed))

    def _share(self, lacking: Float[Tensor, "V"]) -> float:
        return float((lacking * self.area).sum() / self.area.double().sum().clamp_min(1e-12))

    def _weights(self) -> tuple[float, float]:
        """Weights of the terms of colour and shape: the settings times shares of the surface, tiny ones left out."""
        if self._shares is None:
            self._shares = self.unobserved, self.unplaced
        color, shape = (share if share > LEAST_SHARE else 0.0 for share in self._shares)
        return self.config.color * color, self.config.shape * shape

    def is_due(self, step: int) -> bool:
        """Whether the targets are to be taken anew at a step."""
        start, every = self.config.start, self.config.every
        first = step == start or (step > start and not self.target.any())
        return any(self._weights()) and (first or (step > start and step % every == 0))

    def terms(self, answers: Answers, step: int, generator: torch.Generator) -> dict[str, Float[Tensor, ""]]:
        r"""The weighted loss terms of a step.

        At points $p$ of the body drawn with probability proportional to their unobserved area, and points
        $x = p + (t_p + \epsilon) n_p$ about the completed surface, with the share $u$ of the area that is unobserved,

        \[ L_{color} = u \, E \lVert c(x) - \hat c_p \rVert^2, \qquad L_{shape} = u' \, E (s(x') - \epsilon)^2 \]

        The colour of a point is observed where an image shows it, its place where it lies on the outline of one: from
        the front a leg looks alike whatever its depth. So the second term has points $x'$ and a share $u'$ of its own,
        by `CompletionConfig.outlines`.

        Args:
            answers: the field.
            step: of the training.
            generator: draws the points.
        """
        config, (color, shape) = self.config, self._weights()
        if step < config.start or not (color or shape):
            return {}
        on = self._on_surface()
        drawn = [
            self._draw(ends, generator) for ends, weight in ((on.ends, color), (on.shape_ends, shape)) if weight > 0
        ]
        index, away = (torch.cat(parts) for parts in zip(*drawn, strict=True))
        x = on.points[index] + (self.offset[index] + away)[:, None] * on.normals[index]
        answer = answers(x, on.nearest[index])
        found = (answer,) if answer.base is None else (answer, answer.base)
        terms = {}
        if color > 0:
            first = slice(0, config.points)
            off = torch.stack([(f.color[first] - self.target[index[first]]).square().mean() for f in found])
            terms["completion_color"] = color * off.mean()
        if shape > 0:
            last = slice(-config.points, None)
            off = torch.stack([((f.sdf[last] - away[last]) * 100).square().mean() for f in found])
            terms["completion_shape"] = shape * off.mean()
        return terms

    def _draw(
        self, ends: Float[Tensor, "n"], generator: torch.Generator
    ) -> tuple[Int[Tensor, "points"], Float[Tensor, "points"]]:
        """Points of the surface, drawn by how badly they are known, and how far from it samples are taken, metres."""
        random = torch.rand(self.config.points, 2, generator=generator, device=generator.device).to(ends)
        index = torch.searchsorted(ends, random[:, 0] * ends[-1]).clamp_max(len(ends) - 1)
        return index, (INSIDE + (OUTSIDE - INSIDE) * random[:, 1]).float()


class _Surface(NamedTuple):
    """Points of the canonical body with what follows from coverage.

    `nearest` are vertices beside the points; `ends` and `shape_ends` running sums of how badly their colour and their
    place were observed; `fill` and `shape_fill` complete the one and the other.
    """

    fill: SurfaceFill
    points: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"]
    nearest: Int[Tensor, "n"]
    ends: Float[Tensor, "n"]
    shape_fill: SurfaceFill
    shape_ends: Float[Tensor, "n"]


def _lacking(known: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
    """How badly points are known, 0..1, by how well they are."""
    return (1 - known.double() / ENOUGH).clamp_min(0)
