"""The person that an avatar is made of."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from twofold.body.blending import in_pytorch
from twofold.body.skeleton import Body, PosedBody, pose_body, shape_body
from twofold.capture.types import Capture
from twofold.deform.observability import observed_projection, pose_jacobian
from twofold.errors import TwofoldError
from twofold.npz import are_moderate


@dataclass(frozen=True)
class Subject:
    """The person that an avatar is made of: body and training motion. A run folder carries it as arrays.

    Attributes:
        body: the body model.
        betas: its shape coefficients.
        times: frame indices of the training images, ascending.
        poses: their axis-angle rotations, radians.
        translations: their translations, metres.
        scene_scale: what the authors' release multiplies lengths with (3 / (1.1 times the furthest camera)).
        canonical: vertices of the canonical body, metres; None in older runs. Feature grids have nodes within a
            distance of these, and another processor that rounds otherwise would find some more or fewer.
    """

    body: Body
    betas: Float[Tensor, "S"]
    times: Int[Tensor, "T"]
    poses: Float[Tensor, "T 24 3"]
    translations: Float[Tensor, "T 3"]
    scene_scale: float
    canonical: Float[Tensor, "V 3"] | None = None

    def canonical_body(self) -> PosedBody:
        """The body of the first training frame beside the canonical one."""
        with in_pytorch():  # As it was where a run has not stored it.
            posed = pose_body(shape_body(self.body, self.betas), self.poses[0], self.translations[0])
        return posed if self.canonical is None else replace(posed, canonical_vertices=self.canonical)

    @staticmethod
    def of(capture: Capture) -> "Subject":
        """The subject of a capture's training frames."""
        frames_by_index = {frame.frame_index: frame for frame in capture.train}
        frames = [frames_by_index[time] for time in sorted(frames_by_index)]
        middle = torch.stack([f.translation + capture.body.joints[0] for f in frames]).mean(0)
        away = max(float((f.camera.center - middle).norm()) for f in frames)
        subject = Subject(
            body=capture.body,
            betas=capture.betas,
            times=torch.tensor([f.frame_index for f in frames]),
            poses=torch.stack([f.pose for f in frames]),
            translations=torch.stack([f.translation for f in frames]),
            scene_scale=3 / (1.1 * away),
        )
        return replace(subject, canonical=subject.canonical_body().canonical_vertices)

    def arrays(self) -> dict[str, np.ndarray]:
        """As a run folder stores it."""
        own = {"betas": self.betas, "times": self.times, "poses": self.poses, "translations": self.translations}
        body = {f"body_{name}": array for name, array in self.body.arrays().items()}
        if self.canonical is not None:
            own["canonical"] = self.canonical
        return {**{name: t.numpy() for name, t in own.items()}, **body, "scene_scale": np.array(self.scene_scale)}

    @staticmethod
    def from_arrays(arrays: dict[str, np.ndarray], where: str) -> "Subject":
        """What `arrays` gave, read back.

        Raises:
            TwofoldError: something is missing, has the wrong shape or is not finite.
        """
        shapes = {"betas": ("S",), "times": ("T",), "poses": ("T", 24, 3), "translations": ("T", 3), "scene_scale": ()}
        missing = [name for name in shapes if name not in arrays]
        if missing:
            raise TwofoldError(f"{where} lacks {', '.join(missing)}; it is damaged, train again.")
        body = Body.from_arrays({n[5:]: a for n, a in arrays.items() if n.startswith("body_")}, where)
        if "canonical" in arrays:
            shapes["canonical"] = ("V", 3)
        sizes: dict[str | int, int] = {"S": arrays["betas"].size, "T": arrays["times"].size, "V": len(body.template)}
        for name, shape in shapes.items():
            array, expected = arrays[name], tuple(sizes.get(axis, axis) for axis in shape)
            if array.shape != expected or array.dtype.kind not in "fiu" or not are_moderate(array):
                raise TwofoldError(
                    f"{name} in {where} should be finite numbers of shape {expected}, it is {array.dtype} of "
                    f"{array.shape}; it is damaged, train again."
                )
        return Subject(
            body=body,
            betas=torch.as_tensor(arrays["betas"]).float(),
            times=torch.as_tensor(arrays["times"]).long(),
            poses=torch.as_tensor(arrays["poses"]).float(),
            translations=torch.as_tensor(arrays["translations"]).float(),
            scene_scale=float(arrays["scene_scale"]),
            canonical=torch.as_tensor(arrays["canonical"]).float() if "canonical" in arrays else None,
        )


def observed_corrections(subject: Subject, capture: Capture, parts: Sequence[str]) -> Float[Tensor, "T 75 75"]:
    """For each training frame the projection of a pose correction onto what its training cameras see.

    Args:
        subject: with the poses as given.
        capture: whose training cameras count.
        parts: what is corrected at all: "root", "body", "translation"; other numbers stay.
    """
    shaped = shape_body(subject.body, subject.betas)
    corrected = [name for name, count in (("root", 3), ("body", 69), ("translation", 3)) for _ in range(count)]
    free = torch.tensor([name in parts for name in corrected])
    centers: dict[int, list[Tensor]] = {}
    for frame in capture.train:
        centers.setdefault(frame.frame_index, []).append(frame.camera.center)
    out = torch.zeros(len(subject.times), 75, 75)
    for row, time in enumerate(subject.times.tolist()):
        points, moves = pose_jacobian(shaped, subject.poses[row], subject.translations[row])
        if not bool(free.any()):
            continue
        seen = observed_projection(points, moves[..., free], torch.stack(centers[time]))
        out[row] = out[row].index_put(
            tuple(torch.meshgrid(*2 * [torch.nonzero(free)[:, 0]], indexing="ij")), seen.float()
        )
    return out
