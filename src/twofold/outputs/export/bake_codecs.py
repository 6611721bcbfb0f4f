"""How the parts of a baked character are stored: its shape, its atlas, its colours."""

import json
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8

from twofold.body.skeleton import PosedBody
from twofold.outputs.export.atlas import Atlas
from twofold.outputs.export.bake import BakedShape, Pose
from twofold.outputs.export.bake_cache import Arrays, Codec
from twofold.outputs.export.morphs import Skin

_NO_FRAME = -1


@dataclass(frozen=True)
class BakedColors:
    """The colours of a baked shape.

    Attributes:
        colors: of the vertices, sRGB, 0..1.
        observed: how well training images observed each vertex, 0..1.
        texture: sRGB; None for vertex colours alone.
        normal_map: tangent space; None where there is none.
    """

    colors: Float[np.ndarray, "V 3"]
    observed: Float[np.ndarray, "V"]
    texture: UInt8[np.ndarray, "h w 3"] | None
    normal_map: UInt8[np.ndarray, "h w 3"] | None


def shape_codec(rest: PosedBody) -> Codec[BakedShape]:
    """Stores all of a shape but the surfaces of single frames. `rest` is the avatar's body in the T-pose."""

    def decode(arrays: Arrays) -> BakedShape:
        count = len(arrays["vertices"])
        require_arrays(
            arrays,
            {
                "vertices": (count, 3), "extracted": (count, 3), "canonical": (count, 3), "weights": (count, 24),
                "faces": (None, 3), "targets": (None, count, 3), "frame_poses": (None, 24, 3),
                "frame_weights": (len(arrays["frame_poses"]), len(arrays["targets"])),
                "frame_translations": (len(arrays["frame_poses"]), 3), "frame_indices": (len(arrays["frame_poses"]),),
            },
        )  # fmt: skip
        _require_indices(arrays["faces"], count)
        frames = zip(
            _tensor(arrays, "frame_poses"), _tensor(arrays, "frame_translations"), arrays["frame_indices"].tolist(),
            strict=True,
        )  # fmt: skip
        own = {name: _tensor(arrays, name).to(rest.vertices) for name in ("vertices", "canonical", "weights")}
        skin = Skin(own["vertices"], own["canonical"], _tensor(arrays, "faces").to(rest.faces), own["weights"], rest)
        errors = json.loads(arrays["errors"].tobytes())
        return BakedShape(
            skin, _tensor(arrays, "extracted").to(rest.vertices), _tensor(arrays, "targets").to(rest.vertices),
            _tensor(arrays, "frame_weights").to(rest.vertices),
            tuple(Pose(pose, place, None if index == _NO_FRAME else index) for pose, place, index in frames),
            {str(name): float(value) for name, value in errors.items()}, bool(arrays["watertight"]), (),
        )  # fmt: skip

    return Codec(_encode_shape, decode)


def _encode_shape(shape: BakedShape) -> Arrays:
    tensors = {
        "vertices": shape.skin.vertices, "canonical": shape.skin.canonical, "faces": shape.skin.faces,
        "weights": shape.skin.weights, "extracted": shape.extracted, "targets": shape.targets,
        "frame_weights": shape.weights, "frame_poses": torch.stack([frame.pose for frame in shape.frames]),
        "frame_translations": torch.stack([frame.translation for frame in shape.frames]),
    }  # fmt: skip
    indices = [_NO_FRAME if frame.frame_index is None else frame.frame_index for frame in shape.frames]
    return {name: tensor.detach().cpu().numpy() for name, tensor in tensors.items()} | {
        "frame_indices": np.array(indices),
        "errors": np.frombuffer(json.dumps(shape.errors).encode(), dtype=np.uint8),
        "watertight": np.array(shape.watertight),
    }


def atlas_codec(vertices: int) -> Codec[Atlas]:
    """Stores the atlas of a mesh with this number of vertices."""

    def decode(arrays: Arrays) -> Atlas:
        corners = len(arrays["vertex"])
        require_arrays(arrays, {"vertex": (corners,), "faces": (None, 3), "uv": (corners, 2)})
        _require_indices(arrays["vertex"], vertices)
        _require_indices(arrays["faces"], corners)
        return Atlas(arrays["vertex"], arrays["faces"], arrays["uv"])

    return Codec(lambda atlas: {"vertex": atlas.vertex, "faces": atlas.faces, "uv": atlas.uv}, decode)


def paint_codec(vertices: int) -> Codec[BakedColors]:
    """Stores the colours of a mesh with this number of vertices."""

    def decode(arrays: Arrays) -> BakedColors:
        require_arrays(arrays, {"colors": (vertices, 3), "observed": (vertices,)})
        images = [arrays.get(name) for name in _IMAGES]
        if any(image is not None and (image.ndim != 3 or image.shape[2] != 3) for image in images):
            raise ValueError("an image is none")
        return BakedColors(arrays["colors"], arrays["observed"], images[0], images[1])

    def encode(paint: BakedColors) -> Arrays:
        images = {name: getattr(paint, name) for name in _IMAGES}
        known = {name: image for name, image in images.items() if image is not None}
        return {"colors": paint.colors, "observed": paint.observed} | known

    return Codec(encode, decode)


_IMAGES = ("texture", "normal_map")


def require_arrays(arrays: Arrays, shapes: dict[str, Sequence[int | None]]) -> None:
    """Checks that arrays have these shapes (None is any length) and only finite numbers.

    Raises:
        KeyError: one is missing.
        ValueError: one is something else.
    """
    for name, shape in shapes.items():
        own = arrays[name].shape
        fits = len(own) == len(shape) and all(asked in (None, size) for asked, size in zip(shape, own, strict=True))
        if not fits or not np.isfinite(arrays[name]).all():
            raise ValueError(f"{name} is of shape {own}, expected {shape} and finite")


def _require_indices(indices: np.ndarray, count: int) -> None:
    if indices.dtype.kind not in "iu" or indices.min(initial=0) < 0 or indices.max(initial=0) >= count:
        raise ValueError(f"indices should be whole numbers below {count}")


def _tensor(arrays: Arrays, name: str) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(arrays[name]))
