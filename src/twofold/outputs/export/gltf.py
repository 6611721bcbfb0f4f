"""Binary glTF 2.0 (.glb): mesh, skin, morph targets, animations, textures.

Written here because no kept library writes skins, morph targets and animations from arrays.
"""

import io
import json
import struct
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from twofold import __version__
from twofold.body.skeleton import PARENTS
from twofold.files import write_bytes
from twofold.outputs.export.atlas import tangents
from twofold.outputs.export.character import Animation, Character, normals_of
from twofold.outputs.export.options import ExportOptions
from twofold.outputs.export.rig import joint_names

_COMPONENTS = {np.dtype("u1"): 5121, np.dtype("u2"): 5123, np.dtype("u4"): 5125, np.dtype("f4"): 5126}
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
_ARRAY, _ELEMENT = 34962, 34963
_LINEAR, _MIPMAPS, _CLAMP = 9729, 9987, 33071
ROOT, MESH, FIRST_JOINT = 0, 1, 2
"""Indices of the nodes: what carries the skeleton, the mesh, the joints in SMPL's order."""


class BinaryChunk:
    """The buffer of a GLB while it grows, with its views and accessors."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def view(self, data: bytes, target: int | None = None) -> int:
        """Appends bytes, aligned to four; returns the index of their view."""
        self.data += b"\0" * (-len(self.data) % 4)
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data)}
        self.views.append(view | ({"target": target} if target else {}))
        self.data += data
        return len(self.views) - 1

    def accessor(
        self, array: np.ndarray, target: int | None = None, bounds: bool = False, normalized: bool = False
    ) -> int:
        """Appends an array, one row an element; returns the index of its accessor."""
        array = np.ascontiguousarray(array)
        columns = int(np.prod(array.shape[1:], dtype=int))
        accessor: dict[str, Any] = {
            "bufferView": self.view(array.astype(array.dtype.newbyteorder("<")).tobytes(), target),
            "componentType": _COMPONENTS[array.dtype],
            "count": len(array),
            "type": _TYPES[columns],
        }
        if bounds:
            rows = array.reshape(len(array), -1)
            accessor |= {"min": rows.min(0).tolist(), "max": rows.max(0).tolist()}
        self.accessors.append(accessor | ({"normalized": True} if normalized else {}))
        return len(self.accessors) - 1


def write_glb(character: Character, path: Path, options: ExportOptions) -> None:
    """Writes a character as binary glTF.

    Raises:
        TwofoldError: the file cannot be written.
    """
    write_bytes(path, glb_bytes(*gltf_document(character, options)))


def glb_bytes(document: dict[str, Any], chunk: BinaryChunk) -> bytes:
    """A GLB: header, JSON chunk, binary chunk."""
    data = bytes(chunk.data) + b"\0" * (-len(chunk.data) % 4)
    whole = document | {
        "buffers": [{"byteLength": len(data)}], "bufferViews": chunk.views, "accessors": chunk.accessors,
    }  # fmt: skip
    text = json.dumps(whole, separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    header = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(data))
    return header + struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data


def gltf_document(character: Character, options: ExportOptions) -> tuple[dict[str, Any], BinaryChunk]:
    """The JSON part of a character's glTF, and its buffer."""
    chunk = BinaryChunk()
    lift = np.array([0, -character.ground if character.rigged else 0, 0], dtype=np.float32)
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": f"twofold {__version__}"},
        "scene": 0,
        "materials": [_material(character)],
        "meshes": [_mesh(character, chunk, lift, options.morph_normals)],
    }
    if character.texture is not None:
        images = [character.texture, *_normal_maps(character)]
        document |= {
            "images": [_image(chunk, image, options.image) for image in images],
            "samplers": [{"magFilter": _LINEAR, "minFilter": _MIPMAPS, "wrapS": _CLAMP, "wrapT": _CLAMP}],
            "textures": [{"source": index, "sampler": 0} for index in range(len(images))],
        }
    if character.lit:
        document["extensionsUsed"] = ["KHR_materials_unlit"]
    if not character.rigged:
        return document | {"scenes": [{"nodes": [0]}], "nodes": [{"name": character.name, "mesh": 0}]}, chunk
    document |= {
        "scenes": [{"nodes": [ROOT, MESH]}],
        "nodes": _nodes(character, lift, joint_names(options.rig)),
        "skins": [_skin(character, chunk, lift)],
    }
    if character.clips:
        document["animations"] = [_animation(character, clip, chunk) for clip in character.clips]
    return document, chunk


def _normal_maps(character: Character) -> list[UInt8[np.ndarray, "h w 3"]]:
    """The normal map, where viewers are to light the surface; or nothing."""
    return [] if character.normal_map is None or character.lit else [character.normal_map]


def _material(character: Character) -> dict[str, Any]:
    surface: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 0.9}
    material: dict[str, Any] = {"name": "surface", "pbrMetallicRoughness": surface}
    if character.texture is not None:
        surface["baseColorTexture"] = {"index": 0}
        if _normal_maps(character):
            material["normalTexture"] = {"index": 1}
    if character.lit:
        material["extensions"] = {"KHR_materials_unlit": {}}
    return material


def _mesh(character: Character, chunk: BinaryChunk, lift: np.ndarray, morph_normals: bool) -> dict[str, Any]:
    atlas = character.atlas if character.texture is not None else None
    own = np.arange(len(character.vertices)) if atlas is None else atlas.vertex
    faces = character.faces if atlas is None else atlas.faces
    normals = normals_of(character.vertices, character.faces)
    attributes = {
        "POSITION": chunk.accessor((character.vertices + lift)[own].astype(np.float32), _ARRAY, bounds=True),
        "NORMAL": chunk.accessor(normals[own], _ARRAY),
    }
    if atlas is not None:
        attributes["TEXCOORD_0"] = chunk.accessor(atlas.uv.astype(np.float32), _ARRAY)
        if _normal_maps(character):
            attributes["TANGENT"] = chunk.accessor(tangents(atlas, character.vertices, normals), _ARRAY)
    else:
        attributes["COLOR_0"] = chunk.accessor(_linear_colors(character.colors), _ARRAY, normalized=True)
    if character.rigged:
        joints, weights = four_influences(character.weights)
        attributes["JOINTS_0"] = chunk.accessor(joints[own], _ARRAY)
        attributes["WEIGHTS_0"] = chunk.accessor(weights[own], _ARRAY)
    if character.observed is not None:
        attributes["_OBSERVED"] = chunk.accessor(character.observed[own].astype(np.float32), _ARRAY)
    primitive: dict[str, Any] = {
        "attributes": attributes,
        "indices": chunk.accessor(faces.reshape(-1).astype(np.uint32), _ELEMENT),
        "material": 0,
    }
    mesh: dict[str, Any] = {"name": character.name, "primitives": [primitive]}
    if len(character.targets):
        primitive["targets"] = []
        for target in character.targets:
            moved = {"POSITION": chunk.accessor(target[own].astype(np.float32), _ARRAY, bounds=True)}
            if morph_normals:
                turned = normals_of(character.vertices + target, character.faces) - normals
                moved["NORMAL"] = chunk.accessor(turned[own], _ARRAY)
            primitive["targets"].append(moved)
        count = len(character.targets)
        mesh |= {"weights": [0.0] * count, "extras": {"targetNames": [f"shape {i + 1}" for i in range(count)]}}
    return mesh


def _linear_colors(colors: Float[np.ndarray, "V 3"]) -> np.ndarray:
    """sRGB as glTF stores vertex colours: linear; sixteen bits, with alpha for the alignment."""
    srgb = colors.clip(0, 1).astype(np.float64)
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    opaque = np.concatenate([linear, np.ones((len(linear), 1))], 1)
    return (opaque * 65535 + 0.5).astype(np.uint16)


def four_influences(weights: Float[np.ndarray, "V J"]) -> tuple[UInt8[np.ndarray, "V 4"], Float[np.ndarray, "V 4"]]:
    """Joints and weights of each vertex, largest first; where a weight is zero, so is its joint."""
    order = np.argsort(-weights, axis=1, kind="stable")[:, :4]
    largest = np.take_along_axis(weights, order, 1).astype(np.float64)
    # Weights that a float of 2^-23 beside one would hardly show make the sum inexact.
    largest[largest < 1e-5] = 0
    largest = (largest / largest.sum(1, keepdims=True)).astype(np.float32)
    return np.where(largest > 0, order, 0).astype(np.uint8), largest


def _nodes(character: Character, lift: np.ndarray, names: tuple[str, ...]) -> list[dict[str, Any]]:
    nodes: list[dict[str, Any]] = [
        {"name": "skeleton", "children": [FIRST_JOINT]},
        {"name": character.name, "mesh": 0, "skin": 0},
    ]
    for joint, parent in enumerate(PARENTS):
        place = character.joints[joint] - character.joints[parent] if parent >= 0 else character.joints[joint] + lift
        children = [FIRST_JOINT + child for child, above in enumerate(PARENTS) if above == joint]
        node = {"name": names[joint], "translation": place.astype(np.float32).tolist()}
        nodes.append(node | ({"children": children} if children else {}))
    return nodes


def _skin(character: Character, chunk: BinaryChunk, lift: np.ndarray) -> dict[str, Any]:
    inverse = np.tile(np.eye(4, dtype=np.float32), (len(PARENTS), 1, 1))
    inverse[:, :3, 3] = -(character.joints + lift)
    columns = inverse.transpose(0, 2, 1).reshape(-1, 16)  # glTF stores matrices by columns
    return {
        "name": "skin",
        "skeleton": FIRST_JOINT,
        "joints": list(range(FIRST_JOINT, FIRST_JOINT + len(PARENTS))),
        "inverseBindMatrices": chunk.accessor(np.ascontiguousarray(columns)),
    }


def _animation(character: Character, clip: Animation, chunk: BinaryChunk) -> dict[str, Any]:
    times = chunk.accessor((clip.times - clip.times[0]).astype(np.float32), bounds=True)
    outputs = {("translation", FIRST_JOINT): (clip.translations + character.joints[0]).astype(np.float32)}
    rotations = quaternions(clip.poses)
    outputs |= {("rotation", FIRST_JOINT + joint): rotations[:, joint] for joint in range(len(PARENTS))}
    if clip.weights is not None and clip.weights.shape[1]:
        outputs["weights", MESH] = clip.weights.reshape(-1).astype(np.float32)
    samplers = [
        {"input": times, "output": chunk.accessor(output), "interpolation": "LINEAR"} for output in outputs.values()
    ]
    channels = [
        {"sampler": index, "target": {"node": node, "path": path}} for index, (path, node) in enumerate(outputs)
    ]
    return {"name": clip.name, "samplers": samplers, "channels": channels}


def quaternions(poses: Float[np.ndarray, "T 24 3"]) -> Float[np.ndarray, "T 24 4"]:
    """Unit quaternions (x, y, z, w) of axis-angle rotations; each on the side of the one before it in time."""
    angle = np.linalg.norm(poses.astype(np.float64), axis=-1, keepdims=True)
    whole = np.concatenate([poses * 0.5 * np.sinc(angle / (2 * np.pi)), np.cos(angle / 2)], -1)
    for time in range(1, len(whole)):
        whole[time] *= np.where((whole[time] * whole[time - 1]).sum(-1, keepdims=True) < 0, -1, 1)
    return (whole / np.linalg.norm(whole, axis=-1, keepdims=True)).astype(np.float32)


def _image(chunk: BinaryChunk, image: UInt8[np.ndarray, "h w 3"], kind: Literal["png", "jpeg"]) -> dict[str, Any]:
    return {"bufferView": chunk.view(encoded(image, kind)), "mimeType": f"image/{kind}"}


def encoded(image: UInt8[np.ndarray, "h w 3"], kind: Literal["png", "jpeg"]) -> bytes:
    """A PNG or JPEG file."""
    stream = io.BytesIO()
    if kind == "png":
        Image.fromarray(image).save(stream, format="PNG")
    else:
        Image.fromarray(image).save(stream, format="JPEG", quality=92, subsampling=0)
    return stream.getvalue()
