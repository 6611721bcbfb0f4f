"""A reader of binary glTF that shares nothing with the writer: what a viewer would show, in plain loops."""

import json
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

TYPES = {5121: "<u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
COLUMNS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


@dataclass(frozen=True)
class Glb:
    """The two chunks of a file."""

    json: dict[str, Any]
    data: bytes

    def accessor(self, index: int) -> np.ndarray:
        """Its elements, one a row; whole numbers that stand for 0..1 as such."""
        accessor = self.json["accessors"][index]
        view = self.json["bufferViews"][accessor["bufferView"]]
        kind, columns = np.dtype(TYPES[accessor["componentType"]]), COLUMNS[accessor["type"]]
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        flat = np.frombuffer(self.data, kind, accessor["count"] * columns, start)
        rows = flat.reshape(accessor["count"], columns)
        return rows / np.iinfo(kind).max if accessor.get("normalized") else rows

    def image(self, index: int) -> bytes:
        """The file of an image."""
        view = self.json["bufferViews"][self.json["images"][index]["bufferView"]]
        return self.data[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]

    @property
    def primitive(self) -> dict[str, Any]:
        """Of the only mesh."""
        return self.json["meshes"][0]["primitives"][0]


def read_glb(path: Path) -> Glb:
    """Both chunks; whatever is not as the specification has it is an AssertionError."""
    raw = path.read_bytes()
    magic, version, length = struct.unpack("<4sII", raw[:12])
    assert (magic, version, length) == (b"glTF", 2, len(raw))
    chunks, at = {}, 12
    while at < len(raw):
        size, kind = struct.unpack("<I4s", raw[at : at + 8])
        assert size % 4 == 0
        chunks[kind] = raw[at + 8 : at + 8 + size]
        at += 8 + size
    return Glb(json.loads(chunks[b"JSON"]), chunks[b"BIN\0"])


def rotation(quaternion: np.ndarray) -> np.ndarray:
    x, y, z, w = quaternion.astype(float)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def animated_nodes(glb: Glb, animation: int, key: int) -> tuple[dict[int, dict[str, np.ndarray]], np.ndarray]:
    """Translation and rotation of the nodes at one key of an animation, and the weights of the morph targets."""
    nodes = {
        index: {
            "translation": np.array(node.get("translation", [0, 0, 0]), float),
            "rotation": np.array(node.get("rotation", [0, 0, 0, 1]), float),
        }
        for index, node in enumerate(glb.json["nodes"])
    }
    weights = np.array(glb.json["meshes"][0].get("weights", []), float)
    moving = glb.json["animations"][animation]
    for channel in moving["channels"]:
        output = glb.accessor(moving["samplers"][channel["sampler"]]["output"])
        path = channel["target"]["path"]
        if path == "weights":
            weights = output.reshape(-1, len(weights))[key].astype(float)
        else:
            nodes[channel["target"]["node"]][path] = output[key].astype(float)
    return nodes, weights


def node_matrices(glb: Glb, nodes: dict[int, dict[str, np.ndarray]]) -> dict[int, np.ndarray]:
    """Node to world."""
    matrices: dict[int, np.ndarray] = {}

    def visit(index: int, above: np.ndarray) -> None:
        own = np.eye(4)
        own[:3, :3], own[:3, 3] = rotation(nodes[index]["rotation"]), nodes[index]["translation"]
        matrices[index] = above @ own
        for child in glb.json["nodes"][index].get("children", []):
            visit(child, matrices[index])

    for root in glb.json["scenes"][glb.json["scene"]]["nodes"]:
        visit(root, np.eye(4))
    return matrices


def shown_at(glb: Glb, animation: int, key: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions of the joints and of the skinned, morphed vertices at one key of an animation."""
    nodes, weights = animated_nodes(glb, animation, key)
    matrices, skin, attributes = node_matrices(glb, nodes), glb.json["skins"][0], glb.primitive["attributes"]
    inverse = glb.accessor(skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1).astype(float)
    joints = np.stack([matrices[node] for node in skin["joints"]])
    points = glb.accessor(attributes["POSITION"]).astype(float)
    for weight, target in zip(weights, glb.primitive.get("targets", []), strict=True):
        points = points + weight * glb.accessor(target["POSITION"])
    which, shares = glb.accessor(attributes["JOINTS_0"]), glb.accessor(attributes["WEIGHTS_0"]).astype(float)
    whole = np.concatenate([points, np.ones((len(points), 1))], 1)
    moved = np.zeros((len(points), 4))
    for column in range(4):
        transforms = (joints @ inverse)[which[:, column]]
        moved += shares[:, column, None] * np.einsum("vij,vj->vi", transforms, whole)
    return joints[:, :3, 3], moved[:, :3]
