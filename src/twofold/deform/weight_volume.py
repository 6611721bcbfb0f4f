"""Skinning by a learned volume of canonical blend weights (HumanNeRF, MonoHuman).

The volume lives in canonical space (T-pose). A point of observation space is moved by every bone to where it would be
in canonical space, and each bone's weight is looked up at its own place (HumanNeRF Eqs. 3-5); a canonical point is
moved forward with the weights at that one place (MonoHuman).
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from twofold.body.blending import weighted_transforms
from twofold.body.skeleton import PARENTS
from twofold.deform import weight_volume_kernels as kernels
from twofold.kernels.mlp import dense_layer, uniform, xavier_bound
from twofold.kernels.parallel import in_parts

MARGIN = 0.3
"""How far the canonical box reaches beyond the joints, metres."""
ALONG, ACROSS = 0.12, 0.06
"""Widths of a bone's Gaussian along and across it, metres (1 / the diagonal of S)."""
TORSO, TORSO_FACTOR = (0, 3, 6, 9, 13, 14), 1.5
"""Joints whose bones are wider across, and how much."""
HEAD, HEAD_WIDTH, END_WIDTH = 15, 0.12, 0.04
"""Joints without children have a ball: the head, and the hands and toes; metres."""
MIN_SUM = 1e-3
"""Smallest denominator when the prior is normalised."""
MIN_WEIGHT = 1e-4
"""Smallest sum of weights that the blended point is divided by."""
LEAKY_SLOPE = 0.2
LEAKY_GAIN = math.sqrt(2 / (1 + LEAKY_SLOPE**2))
CHANNELS = (1024, 512, 512, 256, 256)
"""Of the network that makes the weight volume, from one position to half the volume's size."""
CODE = 256
"""Numbers of its learned input."""


@dataclass(frozen=True)
class CanonicalBox:
    """An axis-aligned box of canonical space, metres."""

    low: Float[Tensor, "3"]
    high: Float[Tensor, "3"]

    def coordinates(self, points: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        """Points as `grid_sample` takes them: -1 to 1 from corner to corner, x first."""
        return (points - self.low) * (2 / (self.high - self.low)) - 1

    def lattice(self, size: int) -> Float[Tensor, "z y x 3"]:
        """Positions of the grid's vertices, corners included, in the order of a volume's axes (z, y, x), metres."""
        steps = torch.linspace(0, 1, size, dtype=self.low.dtype, device=self.low.device)
        axes = [low + (high - low) * steps for low, high in zip(self.low, self.high, strict=True)]
        return torch.stack(torch.meshgrid(*reversed(axes), indexing="ij")[::-1], -1)


def canonical_box(joints: Float[Tensor, "24 3"], margin: float = MARGIN) -> CanonicalBox:
    r"""The box of the T-pose joints, `margin` metres larger on every side.

    \[ [\min_j J_j - m, \; \max_j J_j + m] \]

    >>> canonical_box(torch.zeros(24, 3))
    CanonicalBox(low=tensor([-0.3000, -0.3000, -0.3000]), high=tensor([0.3000, 0.3000, 0.3000]))
    """
    return CanonicalBox(joints.amin(0) - margin, joints.amax(0) + margin)


def bone_prior(joints: Float[Tensor, "24 3"], box: CanonicalBox, size: int = 32) -> Float[Tensor, "25 z y x"]:
    r"""Where each bone is expected: Gaussians around the bones of a skeleton, background last; sums to one.

    \[ W_b \propto \sum_c e^{-(a_c / 0.12)^2 - (r_c / 0.06)^2},
    \qquad W_{bg} \propto 1 - \mathrm{clamp}\Big(\sum_b W_b, 0, 1\Big) \]

    with the distances $a_c$ along and $r_c$ across the bone to the child $c$.

    >>> joints = torch.rand(24, 3, generator=torch.Generator().manual_seed(0))
    >>> prior = bone_prior(joints, canonical_box(joints), size=4)
    >>> prior.shape, bool(torch.allclose(prior.sum(0), torch.ones(4, 4, 4)))
    (torch.Size([25, 4, 4, 4]), True)

    A joint's channel is the sum over its child bones of exp(-(a / 0.12)^2 - (c / 0.06)^2), with a and c the distances
    from the bone's midpoint along and across the bone, metres (c is over 0.09 in the torso). This is the quadratic form
    (p - m)^T R S^2 R^T (p - m) of HumanNeRF, which does not depend on how R turns about the bone. Joints without
    children have a ball. The background is 1 - clip(sum, 0, 1); then all are divided by their sum.

    Args:
        joints: of the T-pose, metres.
        box: that the volume fills.
        size: vertices along each axis.
    """
    points = box.lattice(size)
    channels = [_joint_prior(joint, joints, points) for joint in range(24)]
    bones = torch.stack(channels)
    prior = torch.cat([bones, 1 - bones.sum(0, keepdim=True).clamp(0, 1)])
    return prior / prior.sum(0).clamp_min(MIN_SUM)


def _joint_prior(joint: int, joints: Tensor, points: Tensor) -> Tensor:
    children = [child for child, parent in enumerate(PARENTS) if parent == joint]
    if not children:
        width = HEAD_WIDTH if joint == HEAD else END_WIDTH
        return torch.exp(-((points - joints[joint]) / width).square().sum(-1))
    across = ACROSS * TORSO_FACTOR if joint in TORSO else ACROSS
    total = torch.zeros_like(points[..., 0])
    for child in children:
        offset = points - (joints[joint] + joints[child]) / 2
        along = offset @ F.normalize(joints[child] - joints[joint], dim=0)
        squared_across = (offset.square().sum(-1) - along.square()).clamp_min(0)
        total = total + torch.exp(-(along / ALONG).square() - squared_across / across**2)
    return total


class WeightVolume(nn.Module):
    """The learned volume: softmax over 25 channels of (logits + log prior) (HumanNeRF Eq. 10).

    A constant code of 256 numbers goes through a linear layer to 1024 channels and five transposed 3-D convolutions
    (kernel 4, stride 2) to 25 channels of 32^3 logits; LeakyReLU(0.2) between. 63,589,145 parameters, and no input: its
    result is the same for every pose, so one evaluation serves a whole training step, and a trained
    avatar needs none.
    """

    log_prior: Tensor

    def __init__(
        self,
        prior: Float[Tensor, "25 z y x"],
        generator: torch.Generator | None = None,
        channels: Sequence[int] = CHANNELS,
        code: int = CODE,
    ) -> None:
        """The volume over `prior` (`bone_prior`), which has 2^n vertices along each axis for n channels."""
        super().__init__()
        self.code = nn.Parameter(torch.randn(code, generator=generator))
        bound = xavier_bound(code, channels[0], LEAKY_GAIN)
        self.first = dense_layer(code, channels[0], bound, generator)
        pairs = list(itertools.pairwise([*channels, len(prior)]))
        gains = [LEAKY_GAIN] * (len(pairs) - 1) + [1.0]
        self.upsampling = nn.ModuleList(
            [
                Upsampling(*pair, gain, generator, from_one=index == 0)
                for index, (pair, gain) in enumerate(zip(pairs, gains, strict=True))
            ]
        )
        # Not stored: it follows from the skeleton, and far from a bone it is minus infinity.
        self.register_buffer("log_prior", prior.log(), persistent=False)

    def forward(self) -> Float[Tensor, "25 z y x"]:
        """Blend weights of the 24 bones and the background; they sum to one everywhere."""
        return (self.logits() + self.log_prior).softmax(0)

    def logits(self) -> Float[Tensor, "25 z y x"]:
        """What the network adds to the logarithm of the prior."""
        h = F.leaky_relu(self.first(self.code), LEAKY_SLOPE)[None, None, None]
        for index, layer in enumerate(self.upsampling):
            h = layer(h)
            if index < len(self.upsampling) - 1:
                h = F.leaky_relu(h, LEAKY_SLOPE)
        return h.permute(3, 0, 1, 2)


class Upsampling(nn.Module):
    """A transposed 3-D convolution with kernel 4, stride 2 and padding 1, as matrix products: each side is doubled.

    On CPUs this takes a third of the time of torch's own, which is not made for many channels and few positions. The
    weights start alike in all eight stride phases; an output sees (kernel / stride)^3 = 8 taps, which count as the fan.

    Args:
        inputs: channels.
        outputs: channels.
        gain: of the activation that follows, see `xavier_bound`.
        generator: draws the weights.
        from_one: the input has a single position. Then 56 of the 64 taps fall outside of the result; they are kept for
            the authors' parameter count, but neither read nor trained (their gradient would be zero).
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        gain: float,
        generator: torch.Generator | None = None,
        from_one: bool = False,
    ) -> None:
        super().__init__()
        taps = uniform((inputs, 2, 2, 2, outputs), xavier_bound(8 * inputs, 8 * outputs, gain), generator)
        if from_one:
            self.taps = nn.Parameter(taps)
            self.unread = nn.Parameter(taps.repeat(1, 7, 1, 1, 1), requires_grad=False)
        else:
            for axis in (1, 2, 3):
                taps = taps.repeat_interleave(2, axis)
            self.taps = nn.Parameter(taps)
        self.bias = nn.Parameter(torch.zeros(outputs))

    def forward(self, h: Float[Tensor, "n n n i"]) -> Float[Tensor, "m m m o"]:
        """The upsampled grid, channels last, m = 2 n."""
        columns = (h.flatten(0, 2) @ self.taps.flatten(1)).reshape(*h.shape[:3], *self.taps.shape[1:])
        if len(h) == 1:
            return columns[0, 0, 0] + self.bias
        return _AddTaps.apply(columns) + self.bias  # type: ignore[return-value]


class _AddTaps(torch.autograd.Function):
    """out[2 i + k - 1] = sum of columns[i, k] along each of three axes: [n n n 4 4 4 o] to [2n 2n 2n o]."""

    @staticmethod
    def forward(columns: Tensor) -> Tensor:
        size = len(columns)
        out = columns.new_zeros(*(3 * [2 * size + 2]), columns.shape[-1])
        for k in itertools.product(range(4), repeat=3):
            out[_every_second(k, size)] += columns[(..., *k, slice(None))]
        return out[1:-1, 1:-1, 1:-1]

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor], output: Tensor) -> None:
        ctx.shape = inputs[0].shape

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor) -> Tensor:  # type: ignore[override]
        padded = F.pad(grad_outputs[0], (0, 0, 1, 1, 1, 1, 1, 1))
        by_columns = padded.new_empty(ctx.shape)
        for k in itertools.product(range(4), repeat=3):
            by_columns[(..., *k, slice(None))] = padded[_every_second(k, ctx.shape[0])]
        return by_columns


def _every_second(first: tuple[int, ...], count: int) -> tuple[slice, ...]:
    return tuple(slice(k, k + 2 * count, 2) for k in first)


@dataclass(frozen=True)
class SkeletalPoints:
    """Samples moved to canonical space by the skeleton.

    Attributes:
        index: which of the given points they are, ascending.
        points: x_skel, canonical space, metres.
        likelihood: f, the sum of the 24 bone weights: how likely a point belongs to the person; 0..1 and slightly more.
    """

    index: Int[Tensor, "n"]
    points: Float[Tensor, "n 3"]
    likelihood: Float[Tensor, "n"]


def skeletal_backward(
    weights: Float[Tensor, "C z y x"],
    points: Float[Tensor, "S 3"],
    to_canonical: Float[Tensor, "24 4 4"],
    box: CanonicalBox,
    min_likelihood: float | None = None,
) -> SkeletalPoints:
    r"""Points of observation space in canonical space: x_skel = sum_i w_i M_i x / max(sum_i w_i, 1e-4).

    \[ x_{skel} = \frac{\sum_i w_i M_i x}{\max(\sum_i w_i, 10^{-4})}, \qquad w_i = W_i(M_i x) \]

    >>> box = CanonicalBox(-torch.ones(3), torch.ones(3))
    >>> moves = torch.eye(4).repeat(24, 1, 1)
    >>> moves[:, 0, 3] = -0.5  # every bone takes points half a metre to the left
    >>> skeletal_backward(torch.full((24, 2, 2, 2), 1 / 24), torch.tensor([[0.75, 0.0, 0.0]]), moves, box).points
    tensor([[0.2500, 0.0000, 0.0000]])

    w_i = W_i(M_i x) is bone i's weight where that bone takes the point, zero outside the box; f = sum_i w_i
    (HumanNeRF Eqs. 3-5). One batched lookup serves all bones, and the transforms are blended before they are applied:
    sum_i w_i M_i x = (sum_i w_i M_i) x.

    Args:
        weights: blend weights, the 24 bones first (`WeightVolume`).
        points: observation space, metres.
        to_canonical: M_i, posed to T-pose: the inverse of `joint_transforms`.
        box: that the volume fills.
        min_likelihood: keep only the points with a larger f, found by a lookup without gradients; None keeps all. f
            multiplies alpha, so 1e-3 changes no pixel by more than that fraction for each sample left out.
    """
    if min_likelihood is None:
        index = torch.arange(len(points), device=points.device)
    else:
        with torch.no_grad():
            index = (_bone_weights(weights, points, to_canonical, box).sum(-1) > min_likelihood).nonzero()[:, 0]
        points = points[index]
    bone_weights = _bone_weights(weights, points, to_canonical, box)
    likelihood = bone_weights.sum(-1)
    blended = bone_weights / likelihood.clamp_min(MIN_WEIGHT)[:, None]
    return SkeletalPoints(index, _moved(blended, to_canonical, points), likelihood)


def skeletal_forward(
    weights: Float[Tensor, "C z y x"],
    x_canonical: Float[Tensor, "S 3"],
    from_canonical: Float[Tensor, "24 4 4"],
    box: CanonicalBox,
) -> Float[Tensor, "S 3"]:
    r"""Canonical points in a pose: x = sum_i W_i(x_c) M_i^-1 x_c / max(sum_i W_i(x_c), 1e-4) (MonoHuman Eq. 5).

    \[ x = \frac{\sum_i W_i(x_c) M_i^{-1} x_c}{\max(\sum_i W_i(x_c), 10^{-4})} \]

    >>> box = CanonicalBox(-torch.ones(3), torch.ones(3))
    >>> moves = torch.eye(4).repeat(24, 1, 1)
    >>> moves[:, 0, 3] = 0.5
    >>> skeletal_forward(torch.full((24, 2, 2, 2), 1 / 24), torch.tensor([[0.25, 0.0, 0.0]]), moves, box)
    tensor([[0.7500, 0.0000, 0.0000]])

    All weights are looked up at the point itself.

    Args:
        weights: blend weights, the 24 bones first.
        x_canonical: metres.
        from_canonical: M_i^-1, T-pose to posed: `joint_transforms`.
        box: that the volume fills.
    """
    grid = box.coordinates(x_canonical)[None, None, None]
    looked_up = F.grid_sample(weights[None, :24], grid, align_corners=True)[0, :, 0, 0].T
    blended = looked_up / looked_up.sum(-1, keepdim=True).clamp_min(MIN_WEIGHT)
    return _moved(blended, from_canonical, x_canonical)


def _bone_weights(weights: Tensor, points: Tensor, to_canonical: Tensor, box: CanonicalBox) -> Float[Tensor, "S 24"]:
    """W_i(M_i x) for every bone."""
    if points.device.type == "cpu" and weights.dtype == points.dtype == torch.float32:
        # From a point to the volume's vertices: each bone's transform, then the box's corners at 0 and n - 1.
        steps = torch.tensor([n - 1 for n in reversed(weights.shape[1:])]) / (box.high - box.low)
        rows = to_canonical[:, :3] * steps[:, None] - F.pad((box.low * steps)[:, None], (3, 0))
        return _BoneLookup.apply(weights[:24], points, rows)  # type: ignore[return-value]
    return _looked_up(weights, points, to_canonical, box)


def _looked_up(weights: Tensor, points: Tensor, to_canonical: Tensor, box: CanonicalBox) -> Tensor:
    """`_bone_weights` by PyTorch: the bones are the batch of one lookup in volumes of one channel."""
    places = points @ to_canonical[:, :3, :3].transpose(1, 2) + to_canonical[:, None, :3, 3]
    grid = box.coordinates(places)[:, None, None]
    return F.grid_sample(weights[:24, None], grid, align_corners=True)[:, 0, 0, 0].T


class _BoneLookup(torch.autograd.Function):
    @staticmethod
    def forward(weights: Tensor, points: Tensor, rows: Tensor) -> Tensor:
        arrays = [t.detach().contiguous().numpy() for t in (points, rows, weights)]
        out = torch.empty(len(points), len(rows))
        in_parts(len(points), lambda begin, end: kernels.interpolate(*arrays, out.numpy(), begin, end))
        return out

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor, Tensor], output: Tensor) -> None:
        ctx.save_for_backward(*inputs)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, Tensor, Tensor]:  # type: ignore[override]
        weights, points, rows = ctx.saved_tensors
        arrays = [t.detach().contiguous().numpy() for t in (points, rows, weights, grad_outputs[0])]
        by_weights, by_rows = torch.zeros_like(weights), torch.zeros_like(rows)

        def part(begin: int, end: int) -> Tensor:
            by_points = torch.zeros_like(points)
            targets = [t.numpy() for t in (by_weights, by_rows, by_points)]
            kernels.scatter(*arrays, *targets, begin, end)
            return by_points

        # Bones own their channels and rows; what they add to the points is summed at the end.
        by_points = in_parts(len(rows), part, 1)
        return by_weights, torch.stack(by_points).sum(0), by_rows


def _moved(blended: Tensor, transforms: Tensor, points: Tensor) -> Tensor:
    rows = weighted_transforms(blended, transforms)
    return (rows[..., :3] * points[:, None]).sum(-1) + rows[..., 3]
