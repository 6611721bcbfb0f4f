"""A first guess from landmarks in space: exact where nothing is noisy, and never lost where something is unknown."""

import numpy as np
import pytest
import torch
from acting import needs_anny, random_motion, standing_camera, the_body
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from twofold.body.skeleton import JOINT_NAMES
from twofold.geometry.cameras import project
from twofold.geometry.rotations import axis_angle_to_matrix
from twofold.prepare.detections import LANDMARKS
from twofold.prepare.fitting.body_landmarks import body_points
from twofold.prepare.fitting.initialization import first_pose, first_translation, register, shortest_turns, twisted
from twofold.prepare.fitting.parameters import FittedMotion, place_points, pose_motion

seeds = st.integers(0, 10**6)
TURNED = ("hip", "knee", "ankle", "shoulder", "elbow")
BONES = [
    (f"{side}_{start}", f"{side}_{end}")
    for side in ("left", "right")
    for start, end in (("hip", "knee"), ("knee", "ankle"), ("heel", "foot_index"), ("shoulder", "elbow"),
                       ("elbow", "wrist"))
]  # fmt: skip


def posed(body, root, pose, translation=None):
    """Landmarks of the mean body, exact."""
    count = len(root)
    still = torch.zeros(count, 3)
    motion = FittedMotion(
        guess=root, root=still, pose=pose, translation=still if translation is None else translation,
        betas=torch.zeros(body.shape_basis.shape[-1]), marks=torch.zeros(33, 3), log_focal=torch.zeros(()),
        log_distance=torch.zeros(()),
    )  # fmt: skip
    points = body_points(body)
    return place_points(pose_motion(body, motion), points, motion)


def limb_poses(count, seed, size=0.8):
    """Turns of hips, knees, ankles, shoulders and elbows, at random."""
    generator = torch.Generator().manual_seed(seed)
    pose = torch.zeros(count, 23, 3)
    for side in ("left", "right"):
        for part in TURNED:
            pose[:, JOINT_NAMES.index(f"{side}_{part}") - 1] = size * torch.randn(count, 3, generator=generator)
    return axis_angle_to_matrix(2 * torch.randn(count, 3, generator=generator)), pose.clamp(-1.3, 1.3)


def directions(places):
    """Unit vectors along the limbs, (t, 10, 3)."""
    start, end = ([LANDMARKS.index(bone[k]) for bone in BONES] for k in (0, 1))
    return torch.nn.functional.normalize(places[:, end] - places[:, start], dim=-1)


@given(seed=seeds, count=st.integers(4, 12))
def test_registration_is_scipys(seed, count):
    rng = np.random.default_rng(seed)
    source, target = rng.standard_normal((2, 3, count, 3))
    weight = rng.uniform(0.1, 2, (3, count))
    turns = register(*(torch.from_numpy(x) for x in (source, target, weight)))
    for k, turn in enumerate(turns.numpy()):
        share = weight[k, :, None] / weight[k].sum()
        a, b = (points[k] - (share * points[k]).sum(0) for points in (source, target))
        expected, _ = Rotation.align_vectors(b, a, weight[k])
        np.testing.assert_allclose(turn, expected.as_matrix(), atol=1e-6)


def test_registration_never_mirrors():
    """Flat points, seen in a mirror: the best match of all would be a reflection."""
    points = torch.tensor([[1.0, 0, 0], [-1, 0, 0.1], [0, 1, 0], [0, -1, 0], [0.3, 0.2, 0.5]])[None]
    turn = register(points, points * torch.tensor([-1.0, 1, 1]), torch.ones(1, 5))
    torch.testing.assert_close(torch.linalg.det(turn), torch.ones(1))
    torch.testing.assert_close(turn @ turn.transpose(1, 2), torch.eye(3)[None])


@pytest.mark.parametrize("name", ["sausages", pytest.param("anny", marks=needs_anny)])
def test_root_and_limbs_of_any_pose_come_back(name):
    body = the_body(name)
    root, pose = limb_poses(60, 0)
    there = posed(body, root, pose) + torch.randn(60, 1, 3)
    found, guess, known = first_pose(body_points(body), there)
    assert known.all()
    torch.testing.assert_close(found, root, atol=1e-4, rtol=0)
    joints = [JOINT_NAMES.index(f"{side}_{part}") - 1 for side in ("left", "right") for part in TURNED]
    turned = guess[:, joints].norm(dim=-1) > 0  # a foot that seems to point backwards is left alone
    assert turned.float().mean() > 0.99
    own, other = directions(posed(body, found, guess)), directions(there)
    torch.testing.assert_close(own[turned], other[turned], atol=2e-3, rtol=0)


@given(seed=seeds, bend=st.floats(0.7, 2.0))
def test_a_bent_limb_is_guessed_bent_the_way_it_can(seed, bend):
    """Wherever upper arm and thigh point and however they are twisted, elbows and knees bend about one axis."""
    body = the_body()
    root, pose = limb_poses(4, seed)
    natural = {"left_elbow": (0, -bend, 0), "right_elbow": (0, bend, 0), "left_knee": (bend, 0, 0),
               "right_knee": (bend, 0, 0)}  # fmt: skip
    for joint, turn in natural.items():
        pose[:, JOINT_NAMES.index(joint) - 1] = torch.tensor(turn)
    _, guess, _ = first_pose(body_points(body), posed(body, root, pose))
    for joint, turn in natural.items():
        found = guess[:, JOINT_NAMES.index(joint) - 1]
        torch.testing.assert_close(found, torch.tensor(turn).expand(4, 3), atol=0.25, rtol=0)


def test_straight_limbs_keep_the_smallest_turn():
    """What does not bend tells no twist, and noise in it must not be taken for one."""
    bone = torch.tensor([[1.0, 0, 0]]).expand(20, 3)
    wanted = torch.nn.functional.normalize(torch.randn(20, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    turn = shortest_turns(bone, wanted)
    forward = torch.tensor([[0.0, 0, 1]]).expand(20, 3)
    nearly = torch.nn.functional.normalize(wanted + 0.05 * torch.randn(20, 3), dim=1)
    torch.testing.assert_close(twisted(turn, bone, forward, wanted, nearly), turn)


@given(seed=seeds)
def test_shortest_turns_are_shortest(seed):
    generator = torch.Generator().manual_seed(seed)
    start, end = torch.randn(2, 30, 3, generator=generator)
    turn = shortest_turns(start, end)
    a, b = (torch.nn.functional.normalize(v, dim=-1) for v in (start, end))
    cosine = (a * b).sum(-1)
    plain = cosine > -0.98
    torch.testing.assert_close((turn @ a[..., None])[plain, :, 0], b[plain], atol=1e-4, rtol=0)
    trace = turn.diagonal(dim1=1, dim2=2).sum(1)
    torch.testing.assert_close(trace[plain], 1 + 2 * cosine[plain], atol=1e-4, rtol=0)


def test_no_turn_where_a_direction_is_missing_or_opposite():
    start = torch.tensor([[1.0, 0, 0], [1, 0, 0], [0, 0, 0]])
    end = torch.tensor([[-1.0, 0, 0], [0, 0, 0], [1, 0, 0]])
    torch.testing.assert_close(shortest_turns(start, end)[:2], torch.eye(3).expand(2, 3, 3))
    assert shortest_turns(start, end).isfinite().all()


@given(seed=seeds, share=st.floats(0, 1))
def test_whatever_is_unknown_the_guess_is_a_pose(seed, share):
    body = the_body()
    root, pose = limb_poses(6, seed)
    there = posed(body, root, pose)
    generator = torch.Generator().manual_seed(seed)
    there[torch.rand(6, 33, generator=generator) < share] = torch.nan
    found, guess, known = first_pose(body_points(body), there)
    trunk = [LANDMARKS.index(f"{side}_{part}") for side in ("left", "right") for part in ("shoulder", "hip")]
    assert known.tolist() == there[:, trunk].isfinite().all(-1).all(-1).tolist()
    assert guess.isfinite().all()
    torch.testing.assert_close(found @ found.transpose(1, 2), torch.eye(3).expand(6, 3, 3), atol=1e-4, rtol=0)


def test_a_frame_without_a_trunk_turns_as_the_nearest_one():
    body = the_body()
    root, pose = limb_poses(6, 1)
    there = posed(body, root, pose)
    there[[0, 3, 4], LANDMARKS.index("left_hip")] = torch.nan
    found, guess, known = first_pose(body_points(body), there)
    assert known.tolist() == [False, True, True, False, False, True]
    for time, nearest in ((0, 1), (3, 2), (4, 5)):
        torch.testing.assert_close(found[time], found[nearest])
        assert not guess[time].any()


def test_a_limb_without_landmarks_hangs_as_in_the_t_pose():
    body = the_body()
    root, pose = limb_poses(3, 2)
    there = posed(body, root, pose)
    there[1, LANDMARKS.index("left_elbow")] = torch.nan
    _, guess, _ = first_pose(body_points(body), there)
    for joint in ("left_shoulder", "left_elbow"):
        assert not guess[1, JOINT_NAMES.index(joint) - 1].any()
        assert guess[0, JOINT_NAMES.index(joint) - 1].any()
    assert guess[1, JOINT_NAMES.index("right_elbow") - 1].any()


def test_nobody_anywhere_gives_the_t_pose():
    found, guess, known = first_pose(body_points(the_body()), torch.full((3, 33, 3), torch.nan))
    assert not known.any()
    assert not guess.any()
    torch.testing.assert_close(found, torch.eye(3).expand(3, 3, 3))


@given(seed=seeds, count=st.integers(1, 4))
def test_translations_are_exact_where_nothing_is_noisy(seed, count):
    body = the_body()
    motion = random_motion(body, 3, seed, dtype=torch.float64)
    generator = torch.Generator().manual_seed(seed)
    moved = torch.randn(3, 20, 3, generator=generator, dtype=torch.float64)
    shift = motion.translation * torch.tensor([0.1, 0.1, 0.0])
    cameras = [standing_camera(1.1 * k, distance=8.0, focal=1 + 0.2 * k) for k in range(count)]
    pixels = torch.stack([project(c, (moved + shift[:, None]).float())[0] for c in cameras]).double()
    weight = torch.rand(count, 3, 20, generator=generator, dtype=torch.float64)
    # Landmarks of no weight may be anywhere.
    weight[:, :, :8], pixels[:, :, :8] = 0, 1e4
    found = first_translation(
        moved, pixels, weight, torch.stack([c.world_to_camera for c in cameras]).double(),
        torch.stack([c.intrinsics for c in cameras]).double(),
    )  # fmt: skip
    torch.testing.assert_close(found, shift, atol=1e-3, rtol=0)


def test_translations_are_numbers_where_nothing_is_seen():
    camera = standing_camera()
    found = first_translation(
        torch.randn(2, 5, 3), torch.zeros(1, 2, 5, 2), torch.zeros(1, 2, 5), camera.world_to_camera[None],
        camera.intrinsics[None],
    )  # fmt: skip
    torch.testing.assert_close(found, torch.zeros(2, 3))
