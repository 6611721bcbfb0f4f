"""Networks over the joints of the skeleton (DANBO, NPC, PM-Avatar): every node has weights of its own."""

import math
from collections.abc import Sequence
from typing import Literal, cast

import torch
from jaxtyping import Float
from torch import Tensor, nn

from twofold.body.skeleton import PARENTS
from twofold.field.encoding import fourier_encoding
from twofold.kernels.mlp import uniform

POSE_OCTAVES = 5
SINE_FREQUENCY = 8.0
_NEIGHBOUR_MEAN, _NEIGHBOUR_SPREAD, _MIN_NEIGHBOUR = 0.05, 0.05, 0.01


def skeleton_adjacency() -> Float[Tensor, "24 24"]:
    r"""One where two joints are the same or joined by a bone, zero elsewhere.

    \[ A_{ij} = 1 \text{ where } i = j \text{ or a bone joins them, else } 0 \]

    >>> skeleton_adjacency()[0].nonzero()[:, 0]  # the pelvis, both hips and the spine
    tensor([0, 1, 2, 3])
    """
    adjacency = torch.eye(24)
    for child, parent in enumerate(PARENTS):
        if parent >= 0:
            adjacency[child, parent] = adjacency[parent, child] = 1
    return adjacency


def rotation_features(rotations: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 6"]:
    r"""The first two columns of rotation matrices, row by row ("rot6d").

    \[ (R_{11}, R_{12}, R_{21}, R_{22}, R_{31}, R_{32}) \]

    >>> rotation_features(torch.arange(9.0).reshape(3, 3))
    tensor([0., 1., 3., 4., 6., 7.])
    """
    return rotations[..., :2].flatten(-2)


def pose_features(rotations: Float[Tensor, "*b 24 3 3"], octaves: int) -> Float[Tensor, "*b 24 f"]:
    r"""What a pose graph sees of each joint: `rotation_features` and their sines and cosines; zeros for the root.

    \[ f_j = \gamma_L(R_{j11}, R_{j12}, \dots, R_{j32}), \qquad f_0 = 0 \]

    >>> features = pose_features(torch.eye(3).expand(24, 3, 3), octaves=0)
    >>> features[0].tolist(), features[1].tolist()
    ([0.0, 0.0, 0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 1.0, 0.0, 0.0])

    Args:
        rotations: local rotations of the pose.
        octaves: 5 for DANBO and NPC (66 numbers a joint), 0 for PM-Avatar (6).
    """
    features = rotation_features(rotations)
    encoded = fourier_encoding(features.flatten(0, -2), octaves, include_pi=False).unflatten(0, features.shape[:-1])
    keep = torch.ones(24, 1, dtype=encoded.dtype, device=encoded.device)
    keep[0] = 0
    return encoded * keep


class NodeLinear(nn.Module):
    """A linear map for each node: y_j = W_j x_j + b_j.

    Args:
        nodes: how many.
        inputs: columns of each node.
        outputs: columns of each node.
        bound: weights start at U(+-bound); None is 1 / sqrt(inputs). Biases start at U(+-1 / sqrt(inputs)).
        generator: draws the start.
    """

    def __init__(
        self,
        nodes: int,
        inputs: int,
        outputs: int,
        bound: float | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        usual = 1 / math.sqrt(inputs)
        self.weight = nn.Parameter(uniform((nodes, inputs, outputs), usual if bound is None else bound, generator))
        self.bias = nn.Parameter(uniform((nodes, outputs), usual, generator))

    def forward(self, x: Float[Tensor, "*b n i"]) -> Float[Tensor, "*b n o"]:
        """The mapped columns of each node."""
        return _by_node(x, self.weight) + self.bias


class GraphLinear(nn.Module):
    """A graph layer on the skeleton: y_i = sum_j (A o M)_ij W_j x_j + b, M the bones and the nodes themselves.

    The adjacency A is learned; it starts at 1 on the diagonal and at N(0.05, 0.05^2), at least 0.01, elsewhere. The
    bias is shared by all nodes and starts at zero.

    Args:
        inputs: columns of each joint.
        outputs: columns of each joint.
        bound: weights start at U(+-bound); None is 1 / sqrt(inputs).
        generator: draws the start.
    """

    mask: Tensor

    def __init__(
        self, inputs: int, outputs: int, bound: float | None = None, generator: torch.Generator | None = None
    ) -> None:
        super().__init__()
        bound = 1 / math.sqrt(inputs) if bound is None else bound
        self.weight = nn.Parameter(uniform((24, inputs, outputs), bound, generator))
        self.bias = nn.Parameter(torch.zeros(outputs))
        near = _NEIGHBOUR_MEAN + _NEIGHBOUR_SPREAD * torch.randn(24, 24, generator=generator)
        itself = torch.eye(24)
        self.adjacency = nn.Parameter(itself + (1 - itself) * near.clamp_min(_MIN_NEIGHBOUR))
        self.register_buffer("mask", skeleton_adjacency(), persistent=False)

    def forward(self, x: Float[Tensor, "*b 24 i"]) -> Float[Tensor, "*b 24 o"]:
        """The mapped and mixed columns of each joint."""
        return (self.adjacency * self.mask) @ _by_node(x, self.weight) + self.bias


class PoseGraph(nn.Module):
    """A pose to numbers for each joint or part: graph layer, graph layer, node layer, node layer.

    Args:
        inputs: numbers of each joint, from `pose_features`.
        outputs: numbers of each node in the end.
        parts: joints of the last layer; None for all 24.
        activation: between the layers "relu"; or "sine", sin(8 x) after every layer, the last too (PM-Avatar). Sine
            layers start at U(+-1 / width) for the first and U(+-sqrt(6 / width) / 8) for the others, with the output
            width, as the authors' program has it.
        width: of the hidden layers.
        generator: draws the start.
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        parts: Sequence[int] | None = None,
        activation: Literal["relu", "sine"] = "relu",
        width: int = 128,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        self.activation, self.parts = activation, None if parts is None else list(parts)
        is_sine = activation == "sine"
        bounds = [1 / width, *(math.sqrt(6 / n) / SINE_FREQUENCY for n in (width, width, outputs))]
        first, second, third, fourth = bounds if is_sine else [None] * 4
        nodes = 24 if parts is None else len(parts)
        self.layers = nn.ModuleList(
            [
                GraphLinear(inputs, width, first, generator),
                GraphLinear(width, width, second, generator),
                NodeLinear(24, width, width, third, generator),
                NodeLinear(nodes, width, outputs, fourth, generator),
            ]
        )

    def forward(self, features: Float[Tensor, "*b 24 i"]) -> Float[Tensor, "*b n o"]:
        """Numbers for each joint, or for each of `parts`."""
        h = features
        for index, layer in enumerate(self.layers):
            if index == 3 and self.parts is not None:
                h = h[..., self.parts, :]
            h = cast(Tensor, layer(h))
            if self.activation == "sine":
                h = torch.sin(SINE_FREQUENCY * h)
            elif index < 3:
                h = h.relu()
        return h


def _by_node(x: Tensor, weight: Tensor) -> Tensor:
    """W_j x_j for each node j: a batched product over the nodes."""
    flat = x.flatten(0, -3) if x.dim() > 2 else x[None]
    mapped = (flat.transpose(0, 1) @ weight).transpose(0, 1)
    return mapped.unflatten(0, x.shape[:-2]) if x.dim() > 2 else mapped[0]
