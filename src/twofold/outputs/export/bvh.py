"""BVH: the skeleton and one motion, without the surface."""

from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation, Slerp

from twofold.body import bvh as body_bvh
from twofold.body.motion import Motion
from twofold.errors import TwofoldError
from twofold.outputs.export.character import Animation, Character
from twofold.outputs.export.options import ExportOptions
from twofold.outputs.export.rig import joint_names


def write_bvh(character: Character, path: Path, options: ExportOptions) -> None:
    """Writes the first clip of a character as BVH (`twofold.body.bvh`), centimetres, y up.

    Frames are evenly spaced in a BVH, so a clip that lacks some is interpolated there.

    Raises:
        TwofoldError: the character has no clip, or the file cannot be written.
    """
    if not character.clips:
        raise TwofoldError("A BVH holds a motion, and none was chosen; leave --motion out, or name one.")
    clip = evenly_spaced(character.clips[0])
    poses, translations = torch.from_numpy(clip.poses), torch.from_numpy(clip.translations)
    motion = Motion(clip.name, poses, translations, 1 / _spacing(clip))
    body_bvh.write_bvh(path, torch.from_numpy(character.joints), motion, joint_names(options.rig))


def evenly_spaced(clip: Animation) -> Animation:
    """The clip at its usual (median) frame distance throughout; rotations by slerp, translations linear."""
    if len(clip.times) < 3 or np.allclose(np.diff(clip.times), clip.times[1] - clip.times[0], rtol=1e-3):
        return clip
    begun, ended = float(clip.times[0]), float(clip.times[-1])
    times = np.linspace(begun, ended, round((ended - begun) / float(np.median(np.diff(clip.times)))) + 1)
    turned = [Slerp(clip.times, Rotation.from_rotvec(clip.poses[:, j]))(times).as_rotvec() for j in range(24)]
    places = [np.interp(times, clip.times, clip.translations[:, axis]) for axis in range(3)]
    dtype = clip.poses.dtype
    return Animation(
        clip.name, times.astype(clip.times.dtype), np.stack(turned, 1).astype(dtype), np.stack(places, 1).astype(dtype)
    )


def _spacing(clip: Animation) -> float:
    return float(clip.times[1] - clip.times[0]) if len(clip.times) > 1 else 1 / 30
