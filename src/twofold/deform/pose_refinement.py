"""Corrections to estimated poses, learned along with the avatar."""

from collections.abc import Callable
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from twofold.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle


@runtime_checkable
class KnownPoses(Protocol):
    """Frames in ascending order with their poses."""

    @property
    def times(self) -> Int[Tensor, "T"]:
        """Frame indices."""
        ...

    @property
    def poses(self) -> Float[Tensor, "T 24 3"]:
        """Axis-angle, radians."""
        ...

    @property
    def translations(self) -> Float[Tensor, "T 3"]:
        """Metres."""
        ...


class PoseRefinement(nn.Module):
    """One correction a training frame (root, body, translation) and one for the shape; all start at zero.

    The correction is added to the axis-angle numbers, which is what optimising the stored poses themselves would do.
    """

    def __init__(self, times: Int[Tensor, "T"], shapes: int, parts: tuple[str, ...]) -> None:
        """Tables for the frames `times`; `parts` names what may change: "root", "body", "translation", "shape"."""
        super().__init__()
        count = len(times)
        self.rows = {int(time): row for row, time in enumerate(times)}
        self.parts = parts
        self.root = nn.Parameter(torch.zeros(count, 1, 3), requires_grad="root" in parts)
        self.body = nn.Parameter(torch.zeros(count, 23, 3), requires_grad="body" in parts)
        self.translation = nn.Parameter(torch.zeros(count, 3), requires_grad="translation" in parts)
        self.shape = nn.Parameter(torch.zeros(shapes), requires_grad="shape" in parts)

    def forward(
        self, time: int, pose: Float[Tensor, "24 3"], translation: Float[Tensor, "3"]
    ) -> tuple[Float[Tensor, "24 3"], Float[Tensor, "3"]]:
        r"""The corrected pose and translation of a frame; frames it does not know stay as they are.

        \[ \theta' = \theta + \Delta\theta_t, \qquad \tau' = \tau + \Delta\tau_t \]

        >>> refinement = PoseRefinement(torch.tensor([4, 7]), 10, ("translation",))
        >>> _ = refinement.translation.data[1].fill_(0.5)
        >>> [refinement(time, torch.zeros(24, 3), torch.zeros(3))[1].tolist() for time in (7, 8)]
        [[0.5, 0.5, 0.5], [0.0, 0.0, 0.0]]
        """
        row = self.rows.get(time)
        if row is None or not self.parts:
            return pose, translation
        return pose + torch.cat([self.root[row], self.body[row]]), translation + self.translation[row]

    def project(self, projections: Float[Tensor, "T 75 75"]) -> None:
        """Takes out of each frame's correction what its projection removes (`deform.observability`).

        Args:
            projections: of the 72 numbers of the pose and the translation, one for each frame.
        """
        with torch.no_grad():
            whole = torch.cat([self.root.flatten(1), self.body.flatten(1), self.translation], 1)
            kept = (projections @ whole[..., None])[..., 0]
            self.root.copy_(kept[:, None, :3])
            self.body.copy_(kept[:, 3:72].unflatten(1, (23, 3)))
            self.translation.copy_(kept[:, 72:])

    def at(
        self, time: int, pose: Float[Tensor, "24 3"], translation: Float[Tensor, "3"], known: KnownPoses,
        max_gap: float, clock: Callable[[int], float] = float,
    ) -> tuple[Float[Tensor, "24 3"], Float[Tensor, "3"]]:  # fmt: skip
        """A frame's corrected pose: by its own correction, or by its neighbours' (`between`), or as given.

        Args:
            time: the frame.
            pose: as given, radians.
            translation: as given, metres.
            known: the training frames with their poses as given.
            max_gap: largest distance between the neighbours, by the clock.
            clock: when a frame was taken; by default its index.
        """
        times = known.times.tolist()
        if time in self.rows or not self.parts or not times[0] < time < times[-1]:
            return self(time, pose, translation)
        after = next(row for row, other in enumerate(times) if other > time)
        before = after - 1
        if clock(times[after]) - clock(times[before]) > max_gap:
            return pose, translation
        neighbours = tuple((times[r], known.poses[r].to(pose), known.translations[r].to(pose)) for r in (before, after))
        return self.between(neighbours, time, pose, translation, clock)

    def between(
        self,
        neighbours: tuple[tuple[int, Float[Tensor, "24 3"], Float[Tensor, "3"]], ...],
        time: int,
        pose: Float[Tensor, "24 3"],
        translation: Float[Tensor, "3"],
        clock: Callable[[int], float] = float,
    ) -> tuple[Float[Tensor, "24 3"], Float[Tensor, "3"]]:
        r"""A frame that was not trained on, corrected by what its neighbours in time were corrected by.

        An estimator's errors last longer than a frame. Nothing of the frame's own image is used. With
        $u = (t - t_0) / (t_1 - t_0)$ and the corrections $R_i$ and $\Delta\tau_i$ of the neighbours,

        \[ R' = \exp\big((1 - u) \log R_0 + u \log R_1\big) \, R, \qquad
        \tau' = \tau + (1 - u) \Delta\tau_0 + u \Delta\tau_1 \]

        >>> refinement = PoseRefinement(torch.tensor([0, 4]), 10, ("translation",))
        >>> _ = refinement.translation.data[1].fill_(1.0)
        >>> known = tuple((time, torch.zeros(24, 3), torch.zeros(3)) for time in (0, 4))
        >>> refinement.between(known, 1, torch.zeros(24, 3), torch.zeros(3))[1]
        tensor([0.2500, 0.2500, 0.2500], grad_fn=<AddBackward0>)

        Args:
            neighbours: the frames before and after it that were trained on, each with its pose and translation as
                given.
            time: the frame between them.
            pose: as given, radians.
            translation: as given, metres.
            clock: when a frame was taken; by default its index.
        """
        (before, *_), (after, *_) = neighbours
        share = (clock(time) - clock(before)) / (clock(after) - clock(before))
        turn, shift = torch.zeros_like(pose), torch.zeros_like(translation)
        for weight, (known, given, place) in zip((1 - share, share), neighbours, strict=True):
            better, moved = self(known, given, place)
            # As rotations: axis-angle numbers jump where a body faces away.
            change = axis_angle_to_matrix(better) @ axis_angle_to_matrix(given).transpose(-1, -2)
            turn, shift = turn + weight * matrix_to_axis_angle(change), shift + weight * (moved - place)
        turned = matrix_to_axis_angle(axis_angle_to_matrix(turn) @ axis_angle_to_matrix(pose))
        return turned, translation + shift

    def change(self) -> dict[str, float]:
        r"""Root-mean-square size of the corrections: radians for the rotations, metres for the translation.

        \[ \sqrt{ \tfrac{1}{n} \sum_i \lVert \Delta_i \rVert^2 } \]

        over frames (and joints); of the shape the norm.

        >>> refinement = PoseRefinement(torch.tensor([0, 4]), 10, ("translation",))
        >>> refinement.translation.data[0, 0] = 0.2
        >>> round(refinement.change()["translation"], 4)
        0.1414
        """
        tables = {"root": self.root, "body": self.body, "translation": self.translation}
        norms = {name: t.detach().square().sum(-1).mean().sqrt() for name, t in tables.items()}
        return {name: float(value) for name, value in norms.items()} | {"shape": float(self.shape.detach().norm())}
