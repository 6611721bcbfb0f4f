"""The paper's field: a pose-independent branch that sees low frequencies, and a pose-dependent one that sees high ones.

Four dense networks answer at a point x of canonical space. The base branch gives a signed distance s1, a colour c1 and
two feature vectors; the detail branch takes those features and the pose and gives s2 and c2, which are added.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from twofold.body.skeleton import PosedBody
from twofold.config import require_within
from twofold.field.branches import Branch, BranchNetworks, Geometry, ReadyBranch
from twofold.field.dense_field import DenseField
from twofold.field.encoding import encoding_size, fourier_encoding
from twofold.field.networks import NetworkConfig, Precision
from twofold.field.output import FieldOutput

Branches = Literal["both", "low", "high", "high_rendered"]


@dataclass(frozen=True)
class FactorizedFieldConfig:
    """The field and its ablations; the defaults are the authors' released program.

    Attributes:
        low_octaves: frequencies that the base branch sees (L_ind).
        high_octaves: frequencies that the detail branch sees (L_d).
        include_pi: frequencies 2^k pi as printed in the paper, in place of 2^k.
        branches: "both"; "low" alone (w/o {s2, c2}); "high" alone (w/o {s1, c1}, and [a]); "high_rendered" keeps both
            but shows the detail branch only (w/o comm).
        share_features: the detail branch sees the base branch's features; False is "w/o feat".
        pose_into: the branch that sees the pose; "low" is "Pose_lf".
        gate_width: s2 and c2 count 1 / (1 + (s1 / gate_width)^4), metres; None is the paper's plain sum.
        base_color: sigmoid over c1, or c1 as it is.
        sdf_head: tanh over the outputs of the distance networks, or none.
        color_sees_position: the colour networks also see x.
        normals: whose normals the colour networks see, those of observation space or of canonical space.
        pose_code: the colour network sees a linear map of the pose to this many numbers; None: the pose itself.
        feature_code: the same for the base branch's colour feature; None shows all of it.
        width: units of every hidden layer, and of each feature vector.
        low_sdf_depth: hidden layers of the base branch's distance network.
        low_color_depth: of its colour network.
        high_sdf_depth: of the detail branch's distance network.
        high_color_depth: of its colour network.
        high_skip: hidden layer of the detail branch's distance network that sees the encoded point again; None is none.
        activation: of the distance networks; the colour networks have ReLU.
        weight_norm: every row of a weight matrix is a direction times a gain.
        radius: the distance starts near that of a sphere, metres.
        gradients: of the distance by the point: "analytic", a reverse pass written by hand, or "autograd", the plain
            form with torch's own softplus. As in the released program the latter keeps no graph in evaluation mode.
        hidden_dtype: of the layers between first and last; bfloat16 is off by about a millimetre and 1.5 degrees;
            "auto" takes it where the hardware is made for it.
    """

    low_octaves: int = 5
    high_octaves: int = 10
    include_pi: bool = False
    branches: Branches = "both"
    share_features: bool = True
    pose_into: Literal["high", "low"] = "high"
    gate_width: float | None = 0.05
    base_color: Literal["sigmoid", "linear"] = "sigmoid"
    sdf_head: Literal["tanh", "linear"] = "tanh"
    color_sees_position: bool = True
    normals: Literal["observation", "canonical"] = "observation"
    pose_code: int | None = 8
    feature_code: int | None = 32
    width: int = 256
    low_sdf_depth: int = 4
    low_color_depth: int = 2
    high_sdf_depth: int = 8
    high_color_depth: int = 4
    high_skip: int | None = 3
    activation: Literal["softplus", "relu"] = "softplus"
    weight_norm: bool = True
    radius: float = 0.6
    gradients: Literal["analytic", "autograd"] = "analytic"
    hidden_dtype: Precision = "float32"

    def __post_init__(self) -> None:
        """Refuses sizes that no network has, and options that exclude each other."""
        depths = {name: (1, 64) for name in vars(self) if name.endswith("_depth")}
        require_within(
            self, low_octaves=(0, 20), high_octaves=(0, 20), pose_code=(1, 1024), feature_code=(1, 1024),
            width=(1, 4096), radius=(0.01, 3), **depths,
        )  # fmt: skip
        if self.branches == "high" and self.pose_into == "low":
            raise ValueError('branches="high" leaves out the branch of pose_into="low"; set pose_into="high"')
        if self.branches == "high_rendered" and not self.share_features:
            raise ValueError(
                'branches="high_rendered" shows the base branch through its features, share_features=False hides them; '
                'set branches="high"'
            )
        if self.gate_width is not None and self.gate_width <= 0:
            raise ValueError(f"gate_width should be positive, or None for no gate; it is {self.gate_width}")
        if self.branches == "low" or self.high_skip is None:
            return
        if not 0 < self.high_skip < self.high_sdf_depth:
            raise ValueError(
                f"high_skip={self.high_skip} is no layer after the first of high_sdf_depth={self.high_sdf_depth}; "
                "set high_skip=None or deepen the network"
            )
        columns = encoding_size(self.high_octaves)
        if columns >= self.width:
            raise ValueError(
                f"high_octaves={self.high_octaves} make {columns} columns, which high_skip={self.high_skip} puts into "
                f"layers of width={self.width}; widen them or set high_skip=None"
            )

    def build(
        self, body: PosedBody | None = None, pose_size: int = 69, generator: torch.Generator | None = None
    ) -> "FactorizedField":
        """A new field for poses of `pose_size` numbers, its start drawn from `generator`; the body is not used."""
        return FactorizedField(self, pose_size, generator)


_Branches = tuple[ReadyBranch | None, ReadyBranch | None]
"""The pose-independent and the pose-dependent branch at one pose."""


class FactorizedField(DenseField):
    """Signed distance and colour at points of canonical space, for one pose at a time."""

    separates_light = False
    """Colours include the lighting."""

    def __init__(self, config: FactorizedFieldConfig, pose_size: int, generator: torch.Generator | None = None) -> None:
        super().__init__(config.gradients)
        self.config = config
        has_low, has_high = config.branches != "high", config.branches != "low"
        self.handed = has_low and has_high and config.share_features
        self.low = self._networks("low", pose_size, generator) if has_low else None
        self.high = self._networks("high", pose_size, generator) if has_high else None

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Parameters of the "low" and of the "high" branch, which learn at different rates; empty for one left out."""
        branches = {"low": self.low, "high": self.high}
        return {name: [] if branch is None else list(branch.parameters()) for name, branch in branches.items()}

    def unlit(self, x: Float[Tensor, "S 3"], pose: Float[Tensor, "P"]) -> FieldOutput:
        """Not to be had: the networks' colours include the lighting."""
        raise ValueError("colours of dense networks include the lighting; ask for them with lit=True")

    def at(self, pose: Float[Tensor, "P"]) -> _Branches:
        """See `DenseField.at`: both branches."""
        return None if self.low is None else self.low.at(pose), None if self.high is None else self.high.at(pose)

    def _sdf(self, x: Float[Tensor, "S 3"], networks: _Branches) -> Float[Tensor, "S"]:
        """See `DenseField._sdf`."""
        low, high = networks
        s1 = s2 = None
        handed: list[Tensor] = []
        if low is not None:
            answer = low.sdf(self._encoded(x, self.config.low_octaves), None if self.handed else 1)
            s1, handed = answer[:, 0], [answer[:, 1:]] if self.handed else []
        if high is not None:
            encoded = self._encoded(x, self.config.high_octaves)
            s2 = high.sdf(torch.cat([encoded, *handed], -1), 1)[:, 0]
        return self._shown(s1, s2, s1)

    def base_branch(
        self, x: Float[Tensor, "S 3"], networks: ReadyBranch, to_observation: Float[Tensor, "S 3 3"] | None
    ) -> Branch:
        r"""The pose-independent branch: signed distance, colour and features (Eq. 3).

        \[ s_1, \bar f_{sdf} = \overline{\mathrm{MLP}}_{sdf}(\bar\gamma(x_c)), \qquad
        c_1, \bar f_c = \overline{\mathrm{MLP}}_c(\bar f_{sdf}, n_1) \]

        with the normal $n_1$ of $s_1$; the released program shows the colour network $x_c$ as well.
        """
        geometry = self._geometry(self._encoded(x, self.config.low_octaves), None, networks)
        gradient = self._gradient(x, geometry.sdf, geometry.pull_sdf)
        hidden = networks.color.hidden(self._color_input(x, gradient, to_observation, geometry.feature))
        return Branch(geometry, gradient, networks.color.head(hidden), hidden)

    def detail_branch(
        self,
        x: Float[Tensor, "S 3"],
        base: Branch | None,
        networks: ReadyBranch,
        to_observation: Float[Tensor, "S 3 3"] | None,
    ) -> Branch:
        r"""The pose-dependent branch: what the pose adds to distance and colour (Eq. 5).

        \[ s_2, \tilde f_{sdf} = \widetilde{\mathrm{MLP}}_{sdf}(\tilde\gamma(x_c), \bar f_{sdf}, \theta), \quad
        c_2 = \widetilde{\mathrm{MLP}}_c(\tilde f_{sdf}, \bar f_c, n, \theta) \]

        with the normal $n$ of $s$. The networks have taken in the pose already. A field that shows this branch alone
        has s2 for s.
        """
        low = None if base is None else base.geometry
        geometry = self._geometry(self._encoded(x, self.config.high_octaves), low, networks)
        gradient = self._gradient(x, geometry.sdf, geometry.pull_sdf)
        shown, features = gradient, [geometry.feature]
        if base is not None:
            shown = self._shown(base.gradient, gradient, base.geometry.sdf)
            features += [networks.told(base.color_feature)] if self.handed else []
        hidden = networks.color.hidden(self._color_input(x, shown, to_observation, *features))
        return Branch(geometry, gradient, networks.color.head(hidden), hidden)

    def combine(
        self, base: Float[Tensor, "S *c"], detail: Float[Tensor, "S *c"], base_sdf: Float[Tensor, "S"]
    ) -> Float[Tensor, "S *c"]:
        r"""Adds the branches (Eq. 6), and likewise the gradients of s.

        \[ s = s_1 + w s_2, \qquad c = c_1 + w c_2, \qquad w = \frac{1}{1 + (s_1 / b)^4} \]

        with $w = 1$ in the text. With a gate of width $b$ the detail fades away from the base branch's surface. No
        gradient passes through the gate, so the gradient of s is that of s1 plus the gated one of s2.

        >>> field = FactorizedFieldConfig(gate_width=0.05, width=72, high_octaves=2).build()
        >>> field.combine(torch.tensor([0.0, 0.05]), torch.tensor([0.01, 0.01]), torch.tensor([0.0, 0.05]))
        tensor([0.0100, 0.0550])
        """
        if self.config.gate_width is None:
            return base + detail
        gate = 1 / (1 + (base_sdf.detach() / self.config.gate_width) ** 4)
        return base + (gate[:, None] if base.dim() == 2 else gate) * detail

    def _evaluate(
        self, x: Float[Tensor, "S 3"], networks: _Branches, to_observation: Float[Tensor, "S 3 3"] | None
    ) -> FieldOutput:
        """See `DenseField._evaluate`; `normals` says whether the colour networks see normals of observation space."""
        to_observation = to_observation if self.config.normals == "observation" else None
        low, high = networks
        base = None if low is None else self.base_branch(x, low, to_observation)
        below = None if base is None else self._output(base, None)
        if high is not None:
            return self._output(self.detail_branch(x, base, high, to_observation), below)
        assert below is not None
        return below

    def _output(self, branch: Branch, below: FieldOutput | None) -> FieldOutput:
        """A branch's answer, upon that of the base branch."""
        sdf, color = branch.geometry.sdf, branch.color
        if below is None or below.gradient is None or self.config.branches == "high_rendered":
            color = color.sigmoid() if self.config.base_color == "sigmoid" else color
            return FieldOutput(sdf, color, branch.gradient, below)
        return FieldOutput(
            sdf=self.combine(below.sdf, sdf, below.sdf),
            color=self.combine(below.color, color, below.sdf),
            gradient=self.combine(below.gradient, branch.gradient, below.sdf),
            base=below,
        )

    def _distance_and_gradient(
        self, x: Float[Tensor, "S 3"], networks: _Branches
    ) -> tuple[Float[Tensor, "S"], Float[Tensor, "S 3"]]:
        """See `DenseField._distance_and_gradient`."""
        low, high = networks
        base = None if low is None else self._geometry(self._encoded(x, self.config.low_octaves), None, low)
        detail = None if high is None else self._geometry(self._encoded(x, self.config.high_octaves), base, high)
        s1 = None if base is None else base.sdf
        sdf = self._shown(s1, None if detail is None else detail.sdf, s1)

        def by_hand() -> Tensor:
            by_base = None if base is None or self.config.branches == "high_rendered" else base.pull_sdf()
            return self._shown(by_base, None if detail is None else detail.pull_sdf(), s1)

        return sdf, self._gradient(x, sdf, by_hand)

    def _encoded(self, x: Tensor, octaves: int) -> Tensor:
        return fourier_encoding(x, octaves, self.config.include_pi)

    def _geometry(self, encoded: Tensor, low: Geometry | None, networks: ReadyBranch) -> Geometry:
        below = low if self.handed else None
        inputs = encoded if below is None else torch.cat([encoded, below.feature], -1)
        if self.analytic:
            answer, tape = networks.sdf.forward_with_tape(inputs)
        else:
            answer, tape = networks.sdf(inputs), None
        return Geometry(networks.sdf, encoded, answer[:, 0], answer[:, 1:], tape, below, self.config.include_pi)

    def _gradient(self, x: Tensor, sdf: Tensor, by_hand: Callable[[], Tensor]) -> Tensor:
        if self.analytic:
            return by_hand()
        return torch.autograd.grad(sdf.sum(), x, create_graph=self.training, retain_graph=True)[0]

    def _shown(self, base: Tensor | None, detail: Tensor | None, base_sdf: Tensor | None) -> Tensor:
        """What the whole field shows: one of the two, or both combined."""
        if base is not None and detail is not None and base_sdf is not None and self.config.branches == "both":
            return self.combine(base, detail, base_sdf)
        shown = base if detail is None else detail
        assert shown is not None
        return shown

    def _color_input(self, x: Tensor, gradient: Tensor, to_observation: Tensor | None, *features: Tensor) -> Tensor:
        if to_observation is not None:
            gradient = (to_observation * gradient[:, None]).sum(-1)
        position = [x] if self.config.color_sees_position else []
        return torch.cat([*position, F.normalize(gradient, dim=-1, eps=1e-6), *features], -1)

    def _networks(
        self, branch: Literal["low", "high"], pose_size: int, generator: torch.Generator | None
    ) -> BranchNetworks:
        config = self.config
        is_low, posed = branch == "low", branch == config.pose_into
        columns = encoding_size(config.low_octaves if is_low else config.high_octaves)
        skip = None if is_low else config.high_skip
        handed = self.handed and not is_low
        code = pose_size if config.pose_code is None else config.pose_code
        color_feature = config.width if config.feature_code is None else config.feature_code
        sdf = NetworkConfig(
            inputs=columns + (config.width if handed else 0),
            outputs=1 + config.width,
            depth=config.low_sdf_depth if is_low else config.high_sdf_depth,
            width=config.width,
            constants=pose_size if posed else 0,
            skip_layer=skip,
            skip_columns=0 if skip is None else columns,
            activation=config.activation,
            head=config.sdf_head,
            weight_norm=config.weight_norm,
            start="sphere",
            radius=config.radius,
            hidden_dtype=config.hidden_dtype,
            native_softplus=config.gradients == "autograd",
        )
        color = NetworkConfig(
            inputs=(3 if config.color_sees_position else 0) + 3 + config.width + (color_feature if handed else 0),
            outputs=3,
            depth=config.low_color_depth if is_low else config.high_color_depth,
            width=config.width,
            constants=code if posed else 0,
            activation="relu",
            weight_norm=config.weight_norm,
            hidden_dtype=config.hidden_dtype,
        )
        pose_code = config.pose_code if posed else None
        return BranchNetworks(sdf, color, pose_code, config.feature_code if handed else None, generator)
