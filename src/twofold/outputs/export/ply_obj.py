"""PLY and OBJ: the mesh in one pose, with its colours."""

from pathlib import Path

import numpy as np

from twofold.files import write_bytes
from twofold.outputs.export.atlas import as_bytes_image
from twofold.outputs.export.character import Character, normals_of
from twofold.outputs.export.gltf import encoded
from twofold.outputs.export.options import ExportOptions


def write_ply(character: Character, path: Path, options: ExportOptions) -> None:
    """Writes a binary PLY: positions (metres), normals, colours of the vertices, triangles.

    Raises:
        TwofoldError: the file cannot be written.
    """
    del options
    seen = [("observed", "<f4")] if character.observed is not None else []
    fields = [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")]
    fields += [(name, "u1") for name in ("red", "green", "blue")]
    rows = np.empty(len(character.vertices), dtype=fields + seen)
    normals, colors = normals_of(character.vertices, character.faces), as_bytes_image(character.colors[None])[0]
    for axis in range(3):
        rows["xyz"[axis]] = character.vertices[:, axis]
        rows[f"n{'xyz'[axis]}"] = normals[:, axis]
        rows[("red", "green", "blue")[axis]] = colors[:, axis]
    if character.observed is not None:
        rows["observed"] = character.observed
    triangles = np.empty(len(character.faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    triangles["count"], triangles["corners"] = 3, character.faces
    properties = [f"property {'float' if kind == '<f4' else 'uchar'} {name}" for name, kind in fields + seen]
    header = [
        "ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}", *properties,
        f"element face {len(triangles)}", "property list uchar int vertex_indices", "end_header", "",
    ]  # fmt: skip
    write_bytes(path, "\n".join(header).encode() + rows.tobytes() + triangles.tobytes())


def write_obj(character: Character, path: Path, options: ExportOptions) -> None:
    """Writes an OBJ (metres); beside a texture, its .mtl and image, else colours behind the positions.

    Raises:
        TwofoldError: a file cannot be written.
    """
    atlas = character.atlas if character.texture is not None else None
    lines = ["# metres, y up"]
    if atlas is not None and character.texture is not None:
        material, image = path.with_suffix(".mtl"), path.with_suffix(f".{options.image}")
        write_bytes(image, encoded(character.texture, options.image))
        write_bytes(material, f"newmtl surface\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nmap_Kd {image.name}\n".encode())
        lines += [f"mtllib {material.name}", "usemtl surface"]
        lines += ["v {:.6f} {:.6f} {:.6f}".format(*row) for row in character.vertices.tolist()]
        lines += [f"vt {u:.6f} {1 - v:.6f}" for u, v in atlas.uv.tolist()]
    else:
        rows = np.concatenate([character.vertices, character.colors], 1).tolist()
        lines += ["v {:.6f} {:.6f} {:.6f} {:.4f} {:.4f} {:.4f}".format(*row) for row in rows]
    normals = normals_of(character.vertices, character.faces)
    lines += ["vn {:.4f} {:.4f} {:.4f}".format(*row) for row in normals.tolist()]
    own = (character.faces + 1).tolist()
    if atlas is None:
        lines += [f"f {a}//{a} {b}//{b} {c}//{c}" for a, b, c in own]
    else:
        flat = (atlas.faces + 1).tolist()
        lines += [f"f {a}/{p}/{a} {b}/{q}/{b} {c}/{r}/{c}" for (a, b, c), (p, q, r) in zip(own, flat, strict=True)]
    write_bytes(path, ("\n".join(lines) + "\n").encode())
