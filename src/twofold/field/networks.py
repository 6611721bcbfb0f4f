"""Dense networks whose gradient by the input is written out as a reverse pass.

`Network` holds the parameters. `Network.at` multiplies them out into a `ReadyNetwork`, once for as many evaluations as
a call needs; that one gives values, or values with a `Tape` from which `pullback` finds gradients. Both passes are
ordinary differentiable operations, so a loss on a gradient trains the parameters by first-order differentiation.
"""

import functools
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from twofold.field.softplus import SHARPNESS, softplus

Precision = Literal["float32", "bfloat16", "auto"]
"""Of hidden layers; "auto" is bfloat16 where the hardware multiplies it faster (`bf16_is_fast`), else float32."""


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes and kind of one network.

    Attributes:
        inputs: columns that differ from sample to sample.
        outputs: columns of the answer.
        depth: hidden layers.
        width: units of each.
        constants: input columns that are the same for all samples of a call, after the others (the pose).
        skip_layer: hidden layer that sees the first `skip_columns` inputs again, beside its own (both over sqrt 2).
        skip_columns: how many; the layer before is narrower by as many.
        activation: softplus(100 z) / 100 or ReLU.
        head: last step, tanh or nothing.
        weight_norm: each row of a matrix is a direction times a gain of its own.
        start: "sphere" makes the first output begin near |x| - radius; "kaiming" is normal, by fan-out; "torch" is
            uniform up to 1 / sqrt(fan in), as torch.nn.Linear has it.
        radius: of that sphere, metres.
        hidden_dtype: type of the layers between the first and the last. With bfloat16 a signed distance is off by about
            a millimetre on average and a normal by some 1.5 degrees; "auto" takes it where the hardware is made for it.
        native_softplus: torch's own softplus in place of the fast one.
    """

    inputs: int
    outputs: int
    depth: int
    width: int = 256
    constants: int = 0
    skip_layer: int | None = None
    skip_columns: int = 0
    activation: Literal["softplus", "relu"] = "softplus"
    head: Literal["tanh", "linear"] = "linear"
    weight_norm: bool = True
    start: Literal["sphere", "kaiming", "torch"] = "kaiming"
    radius: float = 0.6
    hidden_dtype: Precision = "float32"
    native_softplus: bool = False

    def __post_init__(self) -> None:
        """Refuses options that exclude each other."""
        if self.depth < 1:
            raise ValueError(f"depth should be at least 1, it is {self.depth}")
        if self.skip_layer is not None and not 0 < self.skip_layer < self.depth:
            raise ValueError(f"skip_layer={self.skip_layer} is no layer after the first of depth={self.depth}")
        if self.skip_layer is not None and self.skip_columns >= self.width:
            raise ValueError(f"skip_columns={self.skip_columns} leave nothing of width={self.width}; widen the layers")

    def build(self, generator: torch.Generator | None = None) -> "Network":
        """A new network, its start drawn from `generator`."""
        return Network(self, generator)

    def layer_sizes(self) -> list[tuple[int, int]]:
        """(columns in, columns out) of every layer, the last included."""
        widths = [self.width] * self.depth
        if self.skip_layer is not None:
            widths[self.skip_layer - 1] -= self.skip_columns
        columns = [self.inputs + self.constants, *widths]
        if self.skip_layer is not None:
            columns[self.skip_layer] += self.skip_columns
        return list(zip(columns, [*widths, self.outputs], strict=True))


class Layer(nn.Module):
    """Parameters of one layer: matrix [out in], as direction and gain where weights are normalised, and bias [out]."""

    def __init__(self, matrix: Float[Tensor, "o i"], bias: Float[Tensor, "o"], weight_norm: bool) -> None:
        super().__init__()
        self.direction = nn.Parameter(matrix)
        self.gain = nn.Parameter(matrix.norm(dim=1, keepdim=True)) if weight_norm else None
        self.bias = nn.Parameter(bias)

    def matrix(self) -> Tensor:
        r"""The matrix [out in], multiplied out: where weights are normalised, $W_i = g_i \, v_i / \lVert v_i \rVert$.

        >>> layer = Layer(torch.tensor([[3.0, 4.0]]), torch.zeros(1), weight_norm=True)
        >>> _ = layer.gain.data.fill_(10.0)
        >>> layer.matrix().tolist()
        [[6.0, 8.0]]
        """
        if self.gain is None:
            return self.direction
        return self.direction * (self.gain / self.direction.norm(dim=1, keepdim=True))


@dataclass(frozen=True)
class Tape:
    """What a forward pass leaves for the reverse pass.

    Attributes:
        slopes: derivative of the activation at each hidden unit, by layer.
        outputs: the answer, where a tanh follows the last layer.
    """

    slopes: tuple[Tensor, ...]
    outputs: Float[Tensor, "S o"] | None


@dataclass(frozen=True)
class ReadyNetwork:
    """A network at one constant input, its matrices multiplied out, normalised and cast.

    Attributes:
        config: of the network.
        matrices: one a layer, [out in].
        biases: one a layer, [out]; the constant input is inside the first.
    """

    config: NetworkConfig
    matrices: tuple[Tensor, ...]
    biases: tuple[Tensor, ...]

    def __call__(self, x: Float[Tensor, "S i"], outputs: int | None = None) -> Float[Tensor, "S o"]:
        """The answer, or its first columns alone."""
        return self.head(self.hidden(x), outputs)

    def hidden(self, x: Float[Tensor, "S i"]) -> Float[Tensor, "S w"]:
        """Activations of the last hidden layer."""
        h = x
        for layer in range(self.config.depth):
            h = self._activate(self._linear(h, x, layer))
        return h.to(x.dtype)

    def head(self, hidden: Float[Tensor, "S w"], outputs: int | None = None) -> Float[Tensor, "S o"]:
        """The answer from the last hidden layer, or its first columns alone."""
        y = F.linear(hidden, self.matrices[-1][:outputs], self.biases[-1][:outputs])
        return y.tanh() if self.config.head == "tanh" else y

    def forward_with_tape(self, x: Float[Tensor, "S i"]) -> tuple[Float[Tensor, "S o"], Tape]:
        """The answer, and what `pullback` needs."""
        slopes: list[Tensor] = []
        h = x
        for layer in range(self.config.depth):
            h, slope = self._activate_with_slope(self._linear(h, x, layer))
            slopes.append(slope)
        y = self.head(h.to(x.dtype))
        return y, Tape(tuple(slopes), y if self.config.head == "tanh" else None)

    def pullback(self, tape: Tape, cotangent: Float[Tensor, "S k"], first: int = 0) -> Float[Tensor, "S i"]:
        r"""$J^\top u$, where $J$ is the Jacobian of the answer by the (not constant) inputs.

        \[ J^\top u = W_1^\top D_1 W_2^\top D_2 \cdots W_n^\top u, \qquad D_l = \mathrm{diag}(\phi'(z_l)) \]

        with the slopes of the activations on the tape; a tanh at the end adds its own.

        >>> network = Network(NetworkConfig(3, 2, depth=2, width=4, head="tanh"), torch.Generator().manual_seed(0)).at()
        >>> x = torch.rand(5, 3).requires_grad_()
        >>> answer, tape = network.forward_with_tape(x)
        >>> by_hand = network.pullback(tape, torch.ones(5, 1))
        >>> torch.allclose(by_hand, torch.autograd.grad(answer[:, 0].sum(), x)[0], atol=1e-6)
        True

        Args:
            tape: from `forward_with_tape`.
            cotangent: u for the outputs first..first + k; zero for the others.
            first: where they begin.
        """
        rows = slice(first, first + cotangent.shape[-1])
        u, again = cotangent, None
        if tape.outputs is not None:
            u = u * (1 - tape.outputs[:, rows].square())
        u = u @ self.matrices[-1][rows]
        for layer in reversed(range(self.config.depth)):
            matrix, slope = self.matrices[layer], tape.slopes[layer]
            u = (u.to(slope.dtype) * slope).to(matrix.dtype) @ matrix
            if layer == self.config.skip_layer:
                k = self.config.skip_columns
                u, again = u[:, :-k], u[:, -k:].to(cotangent.dtype)
        if again is not None:
            u = u + F.pad(again, (0, u.shape[-1] - again.shape[-1]))
        return u

    def _linear(self, h: Tensor, x: Tensor, layer: int) -> Tensor:
        matrix, bias = self.matrices[layer], self.biases[layer]
        if layer == self.config.skip_layer:
            h = torch.cat([h.to(matrix.dtype), x[:, : self.config.skip_columns].to(matrix.dtype)], -1)
        return F.linear(h.to(matrix.dtype), matrix, bias)

    def _activate(self, z: Tensor) -> Tensor:
        if self.config.activation == "relu":
            return F.relu(z)
        if self.config.native_softplus:
            return F.softplus(z, beta=SHARPNESS)
        return softplus(z)[0]

    def _activate_with_slope(self, z: Tensor) -> tuple[Tensor, Tensor]:
        if self.config.activation == "relu":
            return F.relu(z), (z > 0).to(z.dtype)
        return softplus(z)


class Network(nn.Module):
    """Parameters of a dense network; see `NetworkConfig`."""

    def __init__(self, config: NetworkConfig, generator: torch.Generator | None = None) -> None:
        super().__init__()
        self.config = config
        start = {"sphere": _sphere_start, "kaiming": _kaiming_start, "torch": _torch_start}[config.start]
        starts = start(config, generator)
        self.layers = nn.ModuleList([Layer(matrix, bias, config.weight_norm) for matrix, bias in starts])

    def forward(self, x: Float[Tensor, "S i"], constant: Float[Tensor, "c"] | None = None) -> Float[Tensor, "S o"]:
        """The answer at each sample; `constant` is the input that all of them share."""
        return self.at(constant)(x)

    def at(self, constant: Float[Tensor, "c"] | None = None) -> ReadyNetwork:
        """The network at one constant input, ready to be evaluated many times."""
        config = self.config
        given = 0 if constant is None else len(constant)
        if given != config.constants:
            raise ValueError(f"the network takes {config.constants} constant inputs, {given} were given")
        matrices = [layer.matrix() for layer in self._layers()]
        biases: list[Tensor] = [layer.bias for layer in self._layers()]
        if constant is not None:
            biases[0] = biases[0] + matrices[0][:, config.inputs :] @ constant
            matrices[0] = matrices[0][:, : config.inputs]
        if config.skip_layer is not None:
            matrices[config.skip_layer] = matrices[config.skip_layer] * math.sqrt(0.5)
        if config.hidden_dtype == "bfloat16" or (config.hidden_dtype == "auto" and bf16_is_fast(matrices[0].device)):
            for layer in range(1, config.depth):
                matrices[layer] = matrices[layer].to(torch.bfloat16)
                biases[layer] = biases[layer].to(torch.bfloat16)
        return ReadyNetwork(config, tuple(matrices), tuple(biases))

    def _layers(self) -> list[Layer]:
        return [layer for layer in self.layers if isinstance(layer, Layer)]


def bf16_is_fast(device: torch.device | str = "cpu") -> bool:
    """Whether matrix products of bfloat16 have hardware of their own there (AMX or AVX-512 BF16; Ampere or newer).

    >>> bf16_is_fast("cpu") in (True, False)
    True
    """
    if torch.device(device).type == "cuda":
        return torch.cuda.get_device_capability(device) >= (8, 0)
    return bool({"amx_bf16", "avx512_bf16"} & _processor_flags(Path("/proc/cpuinfo")))


@functools.cache
def _processor_flags(file: Path) -> set[str]:
    """What a Linux processor says it can do; empty on other systems."""
    if not file.is_file():
        return set()
    lines = file.read_text(errors="replace").splitlines()
    return {flag for line in lines if line.startswith("flags") for flag in line.partition(":")[2].split()}


def _sphere_start(config: NetworkConfig, generator: torch.Generator | None) -> list[tuple[Tensor, Tensor]]:
    """Weights whose first output is near |x| - radius: features are zero at first, coordinates are the first three."""
    starts: list[tuple[Tensor, Tensor]] = []
    for layer, (columns, rows) in enumerate(config.layer_sizes()):
        if layer == config.depth:
            mean = math.sqrt(math.pi / columns)
            matrix = mean + 1e-4 * torch.randn(rows, columns, generator=generator)
            starts.append((matrix, torch.full((rows,), -config.radius)))
            continue
        matrix = math.sqrt(2 / rows) * torch.randn(rows, columns, generator=generator)
        if layer == 0:
            matrix[:, 3:] = 0
        elif layer == config.skip_layer:
            matrix[:, columns - config.skip_columns + 3 :] = 0
        starts.append((matrix, torch.zeros(rows)))
    return starts


def _kaiming_start(config: NetworkConfig, generator: torch.Generator | None) -> list[tuple[Tensor, Tensor]]:
    starts: list[tuple[Tensor, Tensor]] = []
    for columns, rows in config.layer_sizes():
        matrix = math.sqrt(2 / rows) * torch.randn(rows, columns, generator=generator)
        bias = (2 * torch.rand(rows, generator=generator) - 1) / math.sqrt(columns)
        starts.append((matrix, bias))
    return starts


def _torch_start(config: NetworkConfig, generator: torch.Generator | None) -> list[tuple[Tensor, Tensor]]:
    starts: list[tuple[Tensor, Tensor]] = []
    for columns, rows in config.layer_sizes():
        matrix = (2 * torch.rand(rows, columns, generator=generator) - 1) / math.sqrt(columns)
        bias = (2 * torch.rand(rows, generator=generator) - 1) / math.sqrt(columns)
        starts.append((matrix, bias))
    return starts
