"""PM-Avatar's field before its density network: features whose frequencies are modulated by the pose."""

from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor, nn

from twofold.field.bone_boxes import box_window
from twofold.field.graph import PoseGraph
from twofold.field.siren import SineLayer, modulated_sine, siren_linear

FREQUENCY, VALUE_FREQUENCY = 8.0, 16.0
POSE_INPUTS, WIDTH, ENCODED, LAYERS = 6, 128, 64, 3
MODULATED_WIDTH = 256
FEATURE_COLUMNS = LAYERS * MODULATED_WIDTH


class PoseModulatedField(nn.Module):
    """Features [y1, y2, y3] (768 columns) at a sample, from its coordinates in all 24 boxes and the pose.

    With H the pose graph, x_j box coordinates, and window_1 = exp(-2 sum x_j^6) without gradient:
    u_j = sin(8 lin x_j); A_j = (lin H_j + lin u_j) window_1; m = max_j A_j;
    window_2 = sigmoid(lin sin(8 lin sin(8 lin m))); w_j = window_1 window_2;
    (f, phase) = PE(sum_j w_j lin H_j); v = concat_j w_j sin(16 lin x_j);
    y_1 = sin((15 f_1 + 30) lin v + phase_1), and y_2, y_3 likewise from y_1, y_2. lin H is one map, used twice.

    Parameters: pose graph 1,205,632; encoders 512; window 60,952; pose extractor PE 247,680; modulated 525,056. The
    density and colour networks are `field.conditioned_radiance.ConditionedRadiance(768, 16)`.
    """

    def __init__(self, generator: torch.Generator | None = None) -> None:
        super().__init__()
        self.pose_graph = PoseGraph(POSE_INPUTS, WIDTH, activation="sine", generator=generator)
        self.window_encoder = SineLayer(3, ENCODED, FREQUENCY, generator, is_first=True)
        self.value_encoder = SineLayer(3, ENCODED, VALUE_FREQUENCY, generator, is_first=True)
        self.pose_map = siren_linear(WIDTH, WIDTH, FREQUENCY, generator)
        self.point_map = siren_linear(ENCODED, WIDTH, FREQUENCY, generator)
        self.window = nn.Sequential(
            SineLayer(WIDTH, WIDTH, FREQUENCY, generator),
            SineLayer(WIDTH, WIDTH, FREQUENCY, generator),
            siren_linear(WIDTH, 24, FREQUENCY, generator),
        )
        self.pose_extractor = nn.Sequential(
            *(SineLayer(WIDTH, WIDTH, FREQUENCY, generator) for _ in range(3)),
            siren_linear(WIDTH, 2 * FEATURE_COLUMNS, FREQUENCY, generator),
        )
        widths = [24 * ENCODED, MODULATED_WIDTH, MODULATED_WIDTH]
        self.modulated = nn.ModuleList(
            [siren_linear(width, MODULATED_WIDTH, VALUE_FREQUENCY, generator) for width in widths]
        )

    def pose(self, features: Float[Tensor, "24 i"]) -> Float[Tensor, "24 w"]:
        """lin H of a pose, once for all samples; see `field.graph.pose_features` (0 octaves)."""
        return self.pose_map(self.pose_graph(features))

    def forward(
        self, pose: Float[Tensor, "24 w"], coordinates: Float[Tensor, "S 24 3"], min_window: float = 0.0
    ) -> Float[Tensor, "S f"]:
        """The features of each sample, 768 columns.

        Only pairs of a sample and a box where window_1 is above `min_window` are computed. At 0 that leaves out exact
        zeros (about two half-sizes from the box's centre), so nothing changes; 1e-4 leaves out what lies 1.3
        half-sizes away.

        Args:
            pose: from `pose`.
            coordinates: box coordinates of the samples.
            min_window: see above.
        """
        samples = len(coordinates)
        first_window = box_window(coordinates.detach())
        # By joint, then by sample: the pairs of one joint stand together.
        joint, sample = (min_window < first_window.T).nonzero().unbind(-1)
        x, window = coordinates[sample, joint], first_window[sample, joint][:, None]
        weight = window * self._second_window(pose, x, window, joint, sample, samples)[sample, joint][:, None]
        pose_mix = torch.zeros_like(pose[:1].expand(samples, -1)).index_add(0, sample, weight * pose[joint])
        modulation = self.pose_extractor(pose_mix)
        frequencies = modulation[:, :FEATURE_COLUMNS].unflatten(-1, (LAYERS, -1))
        phases = modulation[:, FEATURE_COLUMNS:].unflatten(-1, (LAYERS, -1))
        values = self._first_linear(weight * self.value_encoder(x), joint, sample, samples)
        outputs = [modulated_sine(values, frequencies[:, 0], phases[:, 0])]
        for index in range(1, LAYERS):
            values = cast(Tensor, self.modulated[index](outputs[-1]))
            outputs.append(modulated_sine(values, frequencies[:, index], phases[:, index]))
        return torch.cat(outputs, -1)

    def _second_window(
        self, pose: Tensor, x: Tensor, window: Tensor, joint: Tensor, sample: Tensor, samples: int
    ) -> Tensor:
        pairs = (pose[joint] + self.point_map(self.window_encoder(x))) * window
        # Boxes that were left out have A = 0; where all 24 are there, the maximum is theirs alone.
        count = torch.zeros(samples, dtype=torch.long, device=x.device).index_add(0, sample, torch.ones_like(sample))
        lowest = torch.where(count == 24, -torch.inf, 0.0).to(pairs.dtype)[:, None].expand(samples, WIDTH)
        largest = lowest.scatter_reduce(0, sample[:, None].expand_as(pairs), pairs, "amax")
        return self.window(largest).sigmoid()

    def _first_linear(self, values: Tensor, joint: Tensor, sample: Tensor, samples: int) -> Tensor:
        """lin of the 24 joints' values side by side (zero where a box was left out), box by box."""
        layer = cast(nn.Linear, self.modulated[0])
        by_joint = layer.weight.unflatten(1, (24, ENCODED)).unbind(1)
        counts = torch.bincount(joint, minlength=24).tolist()
        parts = [part @ weight.T for part, weight in zip(values.split(counts), by_joint, strict=True)]
        return layer.bias.expand(samples, -1).index_add(0, sample, torch.cat(parts))
