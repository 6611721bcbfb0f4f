"""A small rigged character with everything that one may have, made without training."""

from dataclasses import replace

import numpy as np
import torch
from tiny_person import person_body

from twofold.outputs.export.atlas import as_bytes_image, paint_texture, unwrap
from twofold.outputs.export.character import Animation, Character
from twofold.outputs.export.lattice import build_lattice
from twofold.outputs.export.rig import keep_largest_weights

FRAMES, TARGETS = 9, 3


def random_clip(seed: int = 0, frames: int = FRAMES, targets: int = TARGETS, fps: float = 12) -> Animation:
    """Large rotations of every joint, far from home."""
    random = np.random.default_rng(seed)
    poses = random.normal(0, 0.5, (frames, 24, 3)).astype(np.float32)
    poses[:, 0] *= 3
    places = random.normal(0, 1, (frames, 3)).astype(np.float32)
    weights = random.normal(0, 1, (frames, targets)).astype(np.float32)
    return Animation("random", (np.arange(frames) / fps).astype(np.float32), poses, places, weights)


def small_character(texture: int = 64, targets: int = TARGETS, lit: bool = False) -> Character:
    """The tiny person's body as a character; `texture` 0 leaves it with colours at the vertices."""
    body, random = person_body(), np.random.default_rng(1)
    vertices, faces = body.template.numpy(), body.faces.numpy()
    colors = (0.5 + 0.5 * np.sin(9 * vertices)).astype(np.float32)
    character = Character(
        name="tiny",
        vertices=vertices,
        faces=faces,
        joints=body.joints.numpy(),
        weights=keep_largest_weights(body.weights).numpy(),
        targets=random.normal(0, 0.01, (targets, len(vertices), 3)).astype(np.float32),
        clips=(random_clip(targets=targets),),
        colors=colors,
        lit=lit,
        observed=random.random(len(vertices)).astype(np.float32),
    )
    if not texture:
        return character
    atlas, lattice = unwrap(vertices, faces, texture), build_lattice(len(vertices), faces, 1)
    image, _ = paint_texture(atlas, lattice, colors, texture)
    flat = np.zeros((texture, texture, 3), dtype=np.float32)
    flat[:] = (0.5, 0.5, 1)
    return replace(character, atlas=atlas, texture=as_bytes_image(image), normal_map=as_bytes_image(flat))


def as_still(character: Character) -> Character:
    """The same mesh without its rig."""
    return replace(character, targets=character.targets[:0], clips=(), rigged=False)


def pose_tensors(clip: Animation, frame: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Pose and translation of a frame."""
    return torch.from_numpy(clip.poses[frame]), torch.from_numpy(clip.translations[frame])
