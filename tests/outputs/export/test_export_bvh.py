"""BVH: forward kinematics of the file, in plain loops, are twofold's own."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from characters import pose_tensors, random_clip, small_character
from scipy.spatial.transform import Rotation

from twofold.body.skeleton import joint_transforms
from twofold.errors import TwofoldError
from twofold.outputs.export.bvh import evenly_spaced, write_bvh
from twofold.outputs.export.character import Animation
from twofold.outputs.export.options import ExportOptions
from twofold.outputs.export.rig import joint_names


def positions(file: Path, frame: int) -> dict[str, np.ndarray]:
    """World position of each joint in centimetres, by reading the file line by line."""
    lines = [line.split() for line in file.read_text().splitlines()]
    start = lines.index(["MOTION"])
    numbers = iter([float(number) for number in lines[start + 3 + frame]])
    stack, world, found, name = [np.eye(4)], np.eye(4), {}, ""
    for words in lines[:start]:
        if words[0] in ("ROOT", "JOINT"):
            name = words[1]
        elif words[0] == "End":
            name = "end"
        elif words[0] == "{":
            stack.append(stack[-1])
        elif words[0] == "}":
            stack.pop()
        elif words[0] == "OFFSET":
            offset = np.array(words[1:], float)
        elif words[0] == "CHANNELS":
            world = np.eye(4)
            world[:3, 3] = offset
            for channel in words[2:]:
                axis, value = "XYZ".index(channel[0]), next(numbers)
                if channel.endswith("position"):
                    world[axis, 3] = value
                else:
                    turn = np.eye(4)
                    turn[:3, :3] = Rotation.from_euler("xyz"[axis], value, degrees=True).as_matrix()
                    world = world @ turn
            stack[-1] = stack[-1] @ world
            found[name] = stack[-1][:3, 3]
    return found


@pytest.mark.parametrize("rig", ["smpl", "mixamo", "vrm"])
def test_file_poses_the_joints_like_twofold(tmp_path, rig) -> None:
    character = small_character(texture=0)
    write_bvh(character, tmp_path / "a.bvh", ExportOptions(rig=rig))
    clip = character.clips[0]
    for frame in (0, 4, 8):
        found = positions(tmp_path / "a.bvh", frame)
        pose, translation = pose_tensors(clip, frame)
        transforms = joint_transforms(torch.from_numpy(character.joints), pose, translation).double().numpy()
        for joint, name in enumerate(joint_names(rig)):
            expected = transforms[joint, :3, :3] @ character.joints[joint] + transforms[joint, :3, 3]
            assert np.abs(found[name] / 100 - expected).max() < 1e-4


def test_missing_frames_are_interpolated() -> None:
    clip = random_clip(frames=5, fps=10)
    clip.poses[:] *= 0.3
    kept = [0, 1, 3, 4]
    gaps = Animation("gaps", clip.times[kept], clip.poses[kept], clip.translations[kept])
    filled = evenly_spaced(gaps)
    assert np.allclose(filled.times, clip.times)
    assert np.allclose(filled.poses[kept], clip.poses[kept], atol=1e-5)
    middle = Rotation.from_rotvec(clip.poses[1]).inv() * Rotation.from_rotvec(filled.poses[2])
    whole = Rotation.from_rotvec(clip.poses[1]).inv() * Rotation.from_rotvec(clip.poses[3])
    assert np.allclose(middle.magnitude(), whole.magnitude() / 2, atol=1e-5)


def test_frames_taken_at_a_varying_rate_are_sampled_at_the_usual_one() -> None:
    clip = random_clip(frames=40, fps=10)
    seconds = np.cumsum([0.0, *np.tile([0.1, 0.1, 0.001, 0.13], 10)[:39]]).astype(np.float32)
    even = evenly_spaced(replace(clip, times=seconds))
    gaps = np.diff(even.times)
    assert np.allclose(gaps, gaps[0], rtol=1e-3)
    assert 0.09 < gaps[0] < 0.11
    assert (even.times[0], even.times[-1]) == (seconds[0], seconds[-1])
    assert np.allclose(even.poses[[0, -1]], clip.poses[[0, -1]], atol=1e-5)


def test_character_without_motion_is_refused(tmp_path) -> None:
    with pytest.raises(TwofoldError, match="holds a motion"):
        write_bvh(replace(small_character(texture=0), clips=()), tmp_path / "a.bvh", ExportOptions())
