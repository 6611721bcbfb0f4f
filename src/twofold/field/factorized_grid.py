"""The two-branch field on feature grids: the paper's idea at a price that a laptop can pay.

The low branch sees only coarse grid levels and the body; the high branch sees fine levels, the pose, and the low
branch's features. Distances, colours, gates and losses are those of the network form in `factorized`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from twofold.body.skeleton import JOINT_NAMES, PosedBody
from twofold.config import require_within
from twofold.field.fused import FusedField, in_quads
from twofold.field.grids import (
    FeatureGrid,
    Lattices,
    body_distance,
    build_lattices,
    interpolate,
    interpolation_pullback,
)
from twofold.field.output import FieldOutput
from twofold.field.small_net import SmallNet
from twofold.kernels.lanes import QUAD
from twofold.kernels.row_gradient import RowGradient

DETAILED = ("head", "left_wrist", "right_wrist", "left_hand", "right_hand", "left_foot", "right_foot")
"""Faces, hands and shoes: what neither bends much nor is covered by cloth that folds."""


@dataclass(frozen=True)
class GridFieldConfig:
    """The factorized field on feature grids."""

    low_voxels: tuple[float, ...] = (0.12, 0.06)
    """Grid spacings of the pose-independent branch, metres."""
    high_voxels: tuple[float, ...] = (0.02, 0.01)
    """Grid spacings of the pose-dependent branch, metres."""
    detail_voxels: tuple[float, ...] = ()
    """Further spacings of the pose-independent branch near `detail_parts`, metres: frequency bands by body part."""
    detail_parts: tuple[str, ...] = DETAILED
    """Joints whose skin looks much the same in every pose, so that the pose-independent branch can hold its details."""
    features: int = 4
    """Numbers per grid node."""
    width: int = 32
    """Hidden units of the small networks."""
    shared: int = 16
    """Size of the features handed from one network to the next."""
    pose_code: int = 2
    """The pose is squeezed to this many numbers before the pose-dependent branch sees it."""
    radius: float = 0.1
    """Features exist this far from the canonical body, metres; at least the shell's radius."""
    finest_radius: float | None = None
    """The same of the finest spacing of the pose-dependent branch alone, metres; none: like all others."""
    follow_images: bool = False
    """Whether a training adds finer spacings to the pose-dependent branch where its images show more than these."""
    gate_width: float | None = 0.05
    """Distance from the low branch's surface at which the high branch has half its effect, metres; none: plain sums."""
    branches: Literal["both", "low", "high", "high_rendered"] = "both"
    """Which branches exist and are rendered; all but "both" are ablations."""
    share_features: bool = True
    """Whether the high branch sees the low branch's features; off is the ablation "w/o feat"."""
    pose_into: Literal["high", "low"] = "high"
    """Which branch sees the pose; "low" is the ablation "Pose_lf"."""

    def __post_init__(self) -> None:
        """Refuses grids without levels or numbers, and those that fill any memory."""
        if not self.low_voxels or not self.high_voxels:
            raise ValueError("low_voxels and high_voxels should each name a spacing or several")
        if unknown := set(self.detail_parts) - set(JOINT_NAMES):
            raise ValueError(f"detail_parts names {sorted(unknown)[0]!r}; the joints are {', '.join(JOINT_NAMES)}")
        if self.detail_voxels and not self.detail_parts:
            raise ValueError("detail_parts should name a joint or several where detail_voxels names spacings")
        require_within(
            self, low_voxels=(0.003, 1), high_voxels=(0.003, 1), detail_voxels=(0.003, 1), features=(1, 64),
            width=(1, 1024), shared=(1, 256), pose_code=(1, 1024), radius=(0.005, 0.5), gate_width=(1e-4, 10),
            finest_radius=(0.005, 0.5),
        )  # fmt: skip

    def build(self, body: PosedBody, pose_size: int = 69, generator: torch.Generator | None = None) -> "GridField":
        """A field around `body` in its canonical pose."""
        return GridField(self, body, pose_size, generator)


def points_of(body: PosedBody, joints: Sequence[str]) -> Float[np.ndarray, "n 3"]:
    r"""Canonical vertices of the body that follow one of the joints more than any other, metres.

    \[ \{ v_i : \operatorname{argmax}_j W_{ij} \in J \} \]

    >>> weights, axes = torch.zeros(2, 24), torch.eye(4).expand(24, 4, 4)
    >>> weights[0, JOINT_NAMES.index("head")] = weights[1, JOINT_NAMES.index("neck")] = 1
    >>> at, zeros = torch.tensor([[0.0, 1.7, 0.0], [0.0, 1.5, 0.0]]), torch.zeros(24, 3)
    >>> points_of(PosedBody(at, at, torch.tensor([[0, 1, 0]]), weights, axes, zeros, zeros), ["head"])
    array([[0. , 1.7, 0. ]], dtype=float32)

    Raises:
        ValueError: no vertex does.
    """
    own = torch.isin(body.weights.argmax(1), torch.tensor([JOINT_NAMES.index(name) for name in joints]).to(body.faces))
    if not own.any():
        raise ValueError(f"no vertex of the body belongs to {', '.join(joints)}")
    return body.canonical_vertices[own].detach().cpu().numpy().astype(np.float32)


class _Geometry:
    """Distances (s), features (f), gradients (g) and gate of one call; 1 is the low branch, 2 the high one."""

    __slots__ = ("code", "f1", "f2", "g", "g1", "gate", "high", "low", "s", "s1", "s2")

    def __init__(self, code: Tensor | None) -> None:
        nothing = torch.zeros(0)
        self.code = code
        self.low = self.high = self.s1 = self.s2 = self.f1 = self.f2 = nothing
        self.s = self.gate = self.g = self.g1 = nothing


class GridField(nn.Module):
    """See `GridFieldConfig`; answers like `factorized.FactorizedField`."""

    dense = False
    """A query is a few table lookups and small networks."""
    separates_light = True
    """Colours can be had without the lighting."""

    def __init__(
        self, config: GridFieldConfig, body: PosedBody, pose_size: int, generator: torch.Generator | None
    ) -> None:
        """Starts as the naked body, grey."""
        super().__init__()
        self.config = config
        vertices = body.canonical_vertices.detach().cpu().numpy().astype(np.float32)
        faces = body.faces.cpu().numpy()
        points = np.concatenate([vertices, vertices[faces].mean(1)])
        lattices, nodes = build_lattices(points, (0.02,), config.radius)
        prior = body_distance(nodes, vertices, faces)
        prior[0] = config.radius
        self.register_buffer("prior", torch.from_numpy(prior)[:, None].contiguous(), persistent=False)
        self.register_buffer("prior_rows", lattices.rows, persistent=False)
        self.register_buffer("prior_place", lattices.place, persistent=False)
        self.register_buffer("prior_shape", lattices.shape, persistent=False)
        shared, width, code = config.shared, config.width, config.pose_code
        self.has_low = config.branches != "high"
        self.has_high = config.branches != "low"
        handed = shared if self.has_low and config.share_features else 0
        low_code = code if config.pose_into == "low" and self.has_low else 0
        high_code = code if config.pose_into == "high" or not self.has_low else 0
        if low_code or (self.has_high and high_code):
            self.pose_code = nn.Linear(pose_size, code, bias=False)
            nn.init.normal_(self.pose_code.weight, std=0.3, generator=generator)
        if self.has_low:
            voxels, levels = config.low_voxels + config.detail_voxels, None
            if config.detail_voxels:
                detailed = points_of(body, config.detail_parts)
                levels = [points] * len(config.low_voxels) + [detailed] * len(config.detail_voxels)
            self.low_grid = FeatureGrid(points, voxels, config.features, config.radius, generator, levels)
            size = self.low_grid.size
            self.low_sdf = SmallNet(size, width, 1 + shared, low_code, generator)
            self.low_color = SmallNet(size + shared, width, 3 + shared, low_code, generator)
        if self.has_high:
            radius: float | list[float] = config.radius
            if config.finest_radius is not None:
                finest = min(config.high_voxels)
                radius = [config.finest_radius if v == finest else config.radius for v in config.high_voxels]
            self.high_grid = FeatureGrid(points, config.high_voxels, config.features, radius, generator)
            size = self.high_grid.size
            self.high_sdf = SmallNet(size + handed, width, 1 + shared, high_code, generator)
            self.high_color = SmallNet(size + shared + handed, width, 3, high_code, generator)
        self.handed = handed
        self.light = nn.Linear(9, 3, bias=False)
        nn.init.zeros_(self.light.weight)

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Parameters by what they are: grid tables, and networks of either branch."""
        groups: dict[str, list[nn.Parameter]] = {"grid": [], "low": [], "high": []}
        for name, parameter in self.named_parameters():
            kind = "grid" if "grid" in name else "low" if name.startswith("low") else "high"
            groups[kind].append(parameter)
        return groups

    def row_gradients(self, collect: bool) -> dict[nn.Parameter, RowGradient]:
        """The gradients of the tables, added up in rows from now on, or no more: where both branches are compiled."""
        grids = [getattr(self, name) for name in ("low_grid", "high_grid") if hasattr(self, name)]
        possible = collect and self.config.features % QUAD == 0 and not self.light.weight.is_cuda
        for grid in grids:
            grid.row_gradient = RowGradient.of(grid.table) if possible else None
        return {grid.table: grid.row_gradient for grid in grids if grid.row_gradient is not None}

    def _geometry(self, x: Tensor, pose: Tensor, slopes: Literal["none", "constant", "trained"]) -> _Geometry:
        """Distances and features of both branches; `slopes` says whether their gradients by x are wanted too."""
        g = _Geometry(self.pose_code(pose) if hasattr(self, "pose_code") else None)
        body = self.get_buffer("prior")
        lattices = self._prior_lattices
        # With a second column, how well the surface there was observed.
        known = interpolate(body, x, lattices)
        prior = known[:, 0]
        tape = tape2 = (x, x)
        if self.has_low:
            g.low = self.low_grid(x)
            answer, tape = self.low_sdf(g.low, g.code)
            # A tenth of the output: distances are centimetres, network outputs of order one.
            g.s1, g.f1 = prior + 0.1 * answer[:, 0], answer[:, 1:]
        if self.has_high:
            g.high = self.high_grid(x)
            answer2, tape2 = self.high_sdf(torch.cat([g.high, g.f1], -1) if self.handed else g.high, g.code)
            g.s2, g.f2 = 0.1 * answer2[:, 0], answer2[:, 1:]
        alone = not self.has_low or self.config.branches == "high_rendered"
        if alone:
            g.s = prior + g.s2
        elif not self.has_high:
            g.s = g.s1
        else:
            g.gate = self._gate(g.s1)
            if known.shape[1] > 1:
                g.gate = g.gate * known[:, 1].detach()
            g.s = g.s1 + g.gate * g.s2
        if slopes == "none":
            return g
        with torch.set_grad_enabled(torch.is_grad_enabled() and slopes == "trained"):
            # The reverse pass, by hand: head, networks, grids.
            head = torch.zeros(len(x), 1 + self.config.shared, dtype=x.dtype, device=x.device)
            head[:, 0] = 0.1
            only_prior = torch.zeros_like(known)
            only_prior[:, 0] = 1
            slope = interpolation_pullback(body, x, only_prior, lattices)
            if self.has_low:
                g.g1 = slope + self.low_grid.pullback(x, self.low_sdf.pullback(tape, head)[:, : self.low_grid.size])
                g.g = g.g1
            if self.has_high:
                u = self.high_sdf.pullback(tape2, head)
                g2 = self.high_grid.pullback(x, u[:, : self.high_grid.size])
                if self.handed:
                    back = torch.cat([torch.zeros_like(u[:, :1]), u[:, self.high_grid.size :]], -1)
                    g2 = g2 + self.low_grid.pullback(x, self.low_sdf.pullback(tape, back))
                g.g = slope + g2 if alone else g.g1 + g.gate[:, None] * g2
        return g

    def _fused(self, x: Tensor, pose: Tensor) -> FusedField | None:
        """The field at a pose as one compiled operation, where that exists: both branches, float32, on a CPU."""
        config = self.config
        plain = config.branches == "both" and config.share_features and config.pose_into == "high"
        if not plain or x.is_cuda or x.dtype != torch.float32 or self.light.weight.dtype != torch.float32:
            return None
        code = self.pose_code(pose)
        nets = tuple(net.at(code) for net in (self.low_sdf, self.low_color, self.high_sdf, self.high_color))
        prior = self._prior_lattices
        width = float("inf") if config.gate_width is None else config.gate_width
        lattices = (prior, self.low_grid.lattices, self.high_grid.lattices)
        tables = (self.get_buffer("prior"), self.low_grid.table, self.high_grid.table)
        rows = self.low_grid.row_gradient, self.high_grid.row_gradient
        return in_quads(FusedField(*tables, lattices, nets, width, rows))  # type: ignore[arg-type]

    def _gate(self, s1: Tensor) -> Tensor:
        if self.config.gate_width is None:
            return torch.ones_like(s1)
        return 1 / (1 + (s1.detach() / self.config.gate_width) ** 4)

    def sdf(self, x: Float[Tensor, "S 3"], pose: Float[Tensor, "P"]) -> Float[Tensor, "S"]:
        """Signed distance alone, metres."""
        fused = self._fused(x, pose)
        if fused is None:
            return self._geometry(x, pose, "none").s
        return fused.distance_and_gradient(x)[0] if torch.is_grad_enabled() else fused.sdf(x)

    @torch.no_grad()
    def sdf_at(self, pose: Float[Tensor, "P"]) -> Callable[[Float[Tensor, "S 3"]], Float[Tensor, "S"]]:
        """`sdf` at one pose without gradients, for many small sets of points between two changes of parameters."""
        fused = self._fused(pose, pose)
        return (lambda x: self._geometry(x, pose, "none").s) if fused is None else fused.prepared()

    def distance_and_gradient(
        self, x: Float[Tensor, "S 3"], pose: Float[Tensor, "P"]
    ) -> tuple[Float[Tensor, "S"], Float[Tensor, "S 3"]]:
        """Signed distance and its canonical gradient, both differentiable by the parameters."""
        fused = self._fused(x, pose)
        if fused is not None:
            return fused.distance_and_gradient(x)
        out = self._geometry(x, pose, "trained")
        return out.s, out.g

    def forward(
        self, x: Float[Tensor, "S 3"], pose: Float[Tensor, "P"], to_observation: Float[Tensor, "S 3 3"] | None
    ) -> FieldOutput:
        """Distances and colours of the whole and of the base branch.

        Args:
            x: points of canonical space, metres.
            pose: what the pose-dependent branch is conditioned on.
            to_observation: turns canonical gradients into those of observation space; None leaves them.
        """
        # Normals enter the colours as constants: the shape learns from densities, at half the cost.
        fused = self._fused(x, pose)
        if fused is not None:
            turn = torch.eye(3).expand(len(x), 3, 3) if to_observation is None else to_observation
            s, c, g, s1, c1, g1 = fused.colors(x, turn, self.light.weight)
            return FieldOutput(s, c, g, FieldOutput(s1, c1, g1))
        g = self._geometry(x, pose, "constant")
        base, plain = self._unlit_colors(x, g)
        below = None if base is None else FieldOutput(g.s1, base * self._light(g.g1, to_observation), g.g1)
        return self._output(FieldOutput(g.s, plain * self._light(g.g, to_observation), g.g), below)

    def unlit(self, x: Float[Tensor, "S 3"], pose: Float[Tensor, "P"]) -> FieldOutput:
        """What `forward` gives without its law of light: the surface's own colour, up to one factor; no gradients."""
        fused = self._fused(x, pose)
        if fused is not None:
            # The exponential of a law of zeros is one.
            s, c, _, s1, c1, _ = fused.colors(x, torch.eye(3).expand(len(x), 3, 3), torch.zeros(3, 9))
            return FieldOutput(s, c, None, FieldOutput(s1, c1, None))
        g = self._geometry(x, pose, "none")
        base, plain = self._unlit_colors(x, g)
        return self._output(FieldOutput(g.s, plain, None), None if base is None else FieldOutput(g.s1, base, None))

    def unlit_features(self, x: Float[Tensor, "S 3"], pose: Float[Tensor, "P"]) -> FieldOutput:
        """`unlit` of which only the features in the grids learn, and the networks do not."""
        networks = [p for name, p in self.named_parameters() if "grid" not in name and p.requires_grad]
        for parameter in networks:
            parameter.requires_grad_(False)
        try:
            return self.unlit(x, pose)
        finally:
            for parameter in networks:
                parameter.requires_grad_(True)

    def light_bend(self) -> Float[Tensor, ""]:
        r"""Squared size of the part of the law of light that is quadratic in the normal.

        A camera that stands still sees normals of one hemisphere, on which $z$ and $z^2$ look alike. A diffuse surface
        under a light from one side is nearly linear in the normal, and so the other hemisphere is dark where this one
        is bright.
        """
        squares, mixed = self.light.weight[:, 3:6], self.light.weight[:, 6:]
        return (squares - squares.mean(1, keepdim=True)).square().sum() + 0.5 * mixed.square().sum()

    @property
    def _prior_lattices(self) -> Lattices:
        return Lattices(*(self.get_buffer(f"prior_{name}") for name in ("rows", "place", "shape")))

    def make_observable(self) -> None:
        """Gives the field a measure of where the pose-dependent branch has an effect, as stored in earlier versions."""
        self.register_buffer("observed", torch.ones(len(self.get_buffer("prior"))))
        self._take_observed()
        # A loaded state has a measure of its own.
        self.register_load_state_dict_post_hook(lambda field, _: field._take_observed())

    def _take_observed(self) -> None:
        prior, observed = self.get_buffer("prior"), self.get_buffer("observed")
        self.register_buffer("prior", torch.stack([prior[:, 0], observed], -1), persistent=False)

    def _output(self, whole: FieldOutput, base: FieldOutput | None) -> FieldOutput:
        return replace(whole, base=base) if self.config.branches in ("both", "high_rendered") else whole

    def _unlit_colors(self, x: Tensor, g: _Geometry) -> tuple[Tensor | None, Tensor]:
        """Colours of the base branch, where there is one, and of the whole."""
        base, plain, feature = None, torch.zeros_like(x), None
        if self.has_low:
            answer, _ = self.low_color(torch.cat([g.low, g.f1], -1), g.code)
            base, feature = torch.sigmoid(answer[:, :3]), answer[:, 3:]
            plain = base
        if self.has_high:
            parts = [g.high, g.f2]
            if self.handed and feature is not None:
                parts.append(F.relu(feature))
            residual, _ = self.high_color(torch.cat(parts, -1), g.code)
            alone = base is None or self.config.branches == "high_rendered"
            plain = torch.sigmoid(residual) if alone else plain + g.gate[:, None] * residual
        return base, plain

    def _light(self, gradient: Tensor, to_observation: Tensor | None) -> Tensor:
        """Brightness for a normal, the same law for all points of the body.

        A camera that stands still never sees normals that face away from it. A network with the normal among its inputs
        invents colours for these; one smooth law, learned from every part of the body, carries on sensibly.
        """
        if to_observation is not None:
            gradient = (to_observation.detach() * gradient[:, None]).sum(-1)
        return self.light_on(F.normalize(gradient, dim=-1))

    def light_on(self, normal: Float[Tensor, "S 3"]) -> Float[Tensor, "S 3"]:
        """Brightness of surfaces with these unit normals, observation space."""
        # Polynomials of degree two, as in spherical-harmonics lighting: all that a diffuse surface shows of a scene.
        return torch.exp(self.light(torch.cat([normal, normal * normal, normal * normal.roll(1, -1)], -1)))
