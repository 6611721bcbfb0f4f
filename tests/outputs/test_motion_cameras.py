import pytest
import torch
from little_body import little_body
from motion_rigs import stick_body

from twofold.body.builtin_motions import BUILTIN_MOTIONS
from twofold.body.motion import Motion, as_single, joint_frames
from twofold.body.skeleton import pose_body, shape_body
from twofold.geometry.cameras import project
from twofold.outputs.motion_cameras import motion_cameras

BODY = shape_body(little_body(), torch.zeros(1))
MOTIONS = {name: as_single(make(BODY)) for name, make in BUILTIN_MOTIONS.items()}


@pytest.mark.parametrize("follow", [False, True])
@pytest.mark.parametrize("name", MOTIONS)
def test_the_whole_body_is_in_every_image_and_fills_it_somewhere(name, follow):
    motion = MOTIONS[name]
    cameras = motion_cameras(BODY, motion, 100, follow)
    assert len(cameras) == len(motion)
    heights, edge = [], 100.0
    for index in range(0, len(motion), 7):
        vertices = pose_body(BODY, motion.poses[index], motion.translations[index]).vertices
        pixels, depth = project(cameras[index], vertices)
        assert depth.min() > 1
        edge = min(edge, float(pixels.min()), float(99 - pixels.max()))
        heights.append(float(pixels[:, 1].amax() - pixels[:, 1].amin()))
    assert edge > 1
    assert max(heights) > (65 if follow or name != "walk" else 45)


def test_a_camera_that_does_not_follow_stands_still():
    cameras = motion_cameras(BODY, MOTIONS["walk"], 64)
    assert all(torch.equal(camera.world_to_camera, cameras[0].world_to_camera) for camera in cameras)


def test_a_camera_that_stands_still_has_the_motion_in_its_middle():
    motion = MOTIONS["walk"]
    cameras = motion_cameras(BODY, motion, 100)
    posed = [pose_body(BODY, *frame).vertices for frame in zip(motion.poses, motion.translations, strict=True)]
    pixels = torch.cat([project(cameras[0], vertices)[0] for vertices in posed[::5]])
    assert ((pixels.amax(0) + pixels.amin(0)) / 2 - 49.5).abs().max() < 6


def test_a_camera_that_follows_keeps_its_direction_and_moves_smoothly():
    cameras = motion_cameras(BODY, MOTIONS["walk"], 64, follow=True)
    centers = torch.stack([camera.center for camera in cameras])
    assert all(torch.equal(c.world_to_camera[:3, :3], cameras[0].world_to_camera[:3, :3]) for c in cameras)
    assert torch.diff(centers, n=2, dim=0).norm(dim=-1).max() < 0.002
    assert (centers[-1] - centers[0]).norm() > 3


@pytest.mark.parametrize("yaw", [0.0, 1.0, -2.5])
def test_the_person_is_seen_from_the_front_and_upright(yaw):
    body = stick_body()
    poses = torch.zeros(3, 24, 3)
    poses[:, 0, 1] = yaw
    motion = Motion("still", poses, torch.zeros(3, 3), 30.0)
    camera = motion_cameras(body, motion, 64)[0]
    rotations, positions = joint_frames(body.joints, motion)
    toward = torch.nn.functional.normalize(camera.center.double() - positions[0, 0], dim=0)
    assert toward @ rotations[0, 0, :, 2] > 0.85
    pixels, _ = project(camera, positions[0].float())
    assert pixels[15, 1] < pixels[0, 1] < pixels[7, 1]
    assert pixels[20, 0] > pixels[21, 0]  # a face's left is on the viewer's right
