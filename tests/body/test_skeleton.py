"""The posed body: forward kinematics and skinning against a plain loop, and what must hold for every pose."""

import math

import numpy as np
import pytest
import scipy.spatial.transform
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from little_body import little_body

from twofold.body.blending import in_pytorch
from twofold.body.skeleton import (
    JOINT_NAMES,
    PARENTS,
    Body,
    canonical_pose,
    joint_transforms,
    joint_transforms_of_rotations,
    movements,
    pose_body,
    shape_body,
    skin,
)
from twofold.errors import TwofoldError
from twofold.geometry.rotations import axis_angle_to_matrix

seeds = st.integers(0, 2**31)


def random_body(seed, vertices=40, pose_columns=207):
    """A cloud of points with smooth weights; nothing about it is symmetric."""
    random = np.random.default_rng(seed)
    weights = random.dirichlet(np.full(24, 0.2), vertices)
    return Body.from_arrays(
        {
            "name": np.array("cloud"),
            "template": 0.4 * random.normal(size=(vertices, 3)),
            "faces": random.integers(0, vertices, (60, 3)),
            "weights": weights,
            "joints": random.normal(size=(24, 3)),
            "shape_basis": random.normal(size=(vertices, 3, 10)) / 10,
            "joint_basis": random.normal(size=(24, 3, 10)) / 10,
            "pose_basis": random.normal(size=(vertices, 3, pose_columns)) / 100,
        }
    )


def random_pose(seed, size=1.0):
    random = np.random.default_rng(seed + 1)
    pose, shift, betas = random.normal(size=(24, 3)) * size, random.normal(size=3), random.normal(size=10)
    return tuple(torch.from_numpy(x.astype(np.float32)) for x in (pose, shift, betas))


def plain_loop(body, betas, pose, shift):
    """Joints and vertices as the SMPL paper tells it, one joint and one vertex after the other, in double precision."""
    arrays = {name: array.astype(np.float64) for name, array in body.arrays().items() if name != "name"}
    betas, pose, shift = (x.numpy().astype(np.float64) for x in (betas, pose, shift))
    rest = arrays["joints"] + sum(b * arrays["joint_basis"][:, :, k] for k, b in enumerate(betas))
    shaped = arrays["template"] + sum(b * arrays["shape_basis"][:, :, k] for k, b in enumerate(betas))
    local = [scipy.spatial.transform.Rotation.from_rotvec(p).as_matrix() for p in pose]
    blend = [local[j][r, c] - (r == c) for j in range(1, 24) for r in range(3) for c in range(3)]
    if arrays["pose_basis"].shape[-1]:
        shaped = shaped + sum(b * arrays["pose_basis"][:, :, k] for k, b in enumerate(blend))
    turns, places = [local[0]], [rest[0] + shift]
    for j in range(1, 24):
        p = PARENTS[j]
        turns.append(turns[p] @ local[j])
        places.append(places[p] + turns[p] @ (rest[j] - rest[p]))
    vertices = np.zeros_like(shaped)
    for v, point in enumerate(shaped):
        for j in range(24):
            vertices[v] += arrays["weights"][v, j] * (turns[j] @ (point - rest[j]) + places[j])
    return np.stack(places), vertices


@pytest.mark.parametrize("pose_columns", [0, 207])
@pytest.mark.parametrize("seed", [1, 2])
def test_joints_and_vertices_agree_with_a_plain_loop(seed, pose_columns):
    body = random_body(seed, pose_columns=pose_columns)
    pose, shift, betas = random_pose(seed)
    posed = pose_body(shape_body(body, betas), pose, shift)
    joints, vertices = plain_loop(body, betas, pose, shift)
    np.testing.assert_allclose(posed.joints.numpy(), joints, atol=1e-5)
    np.testing.assert_allclose(posed.vertices.numpy(), vertices, atol=1e-5)
    _, canonical = plain_loop(body, betas, canonical_pose(), torch.zeros(3))
    np.testing.assert_allclose(posed.canonical_vertices.numpy(), canonical, atol=1e-5)


@settings(max_examples=8)
@given(seeds)
def test_the_rest_pose_moves_nothing(seed):
    body = random_body(seed)
    transforms = joint_transforms(body.joints, torch.zeros(24, 3), torch.zeros(3))
    torch.testing.assert_close(transforms, torch.eye(4).expand(24, 4, 4), atol=2e-6, rtol=0)


@settings(max_examples=8)
@given(seeds)
def test_a_translation_moves_everything_by_itself(seed):
    body = random_body(seed)
    pose, shift, betas = random_pose(seed)
    shaped = shape_body(body, betas)
    here, there = (pose_body(shaped, pose, t) for t in (torch.zeros(3), shift))
    torch.testing.assert_close(there.vertices, here.vertices + shift, atol=2e-5, rtol=0)
    torch.testing.assert_close(there.joints, here.joints + shift, atol=2e-5, rtol=0)
    torch.testing.assert_close(there.canonical_vertices, here.canonical_vertices)


@settings(max_examples=8)
@given(seeds)
def test_the_root_turns_the_body_about_its_own_joint(seed):
    body = random_body(seed)
    pose, shift, betas = random_pose(seed)
    still = pose.clone()
    still[0] = 0
    shaped = shape_body(body, betas)
    turn = torch.from_numpy(scipy.spatial.transform.Rotation.from_rotvec(pose[0].numpy()).as_matrix()).float()
    pivot = shaped.joints[0]
    expected = (pose_body(shaped, still, torch.zeros(3)).vertices - pivot) @ turn.T + pivot + shift
    torch.testing.assert_close(pose_body(shaped, pose, shift).vertices, expected, atol=5e-5, rtol=0)


@settings(max_examples=8)
@given(seeds)
def test_bones_are_the_identity_in_the_canonical_pose(seed):
    body = random_body(seed)
    posed = pose_body(shape_body(body, torch.zeros(10)), canonical_pose(), torch.zeros(3))
    torch.testing.assert_close(posed.bones, torch.eye(4).expand(24, 4, 4), atol=5e-6, rtol=0)
    torch.testing.assert_close(posed.vertices, posed.canonical_vertices)


@settings(max_examples=8)
@given(seeds)
def test_bones_carry_canonical_points_to_posed_ones(seed):
    # With one bone a vertex, blending is exact and the bones alone must do it (pose blend shapes aside).
    body = random_body(seed, pose_columns=0)
    pose, shift, betas = random_pose(seed)
    shaped = shape_body(body, betas)
    single = torch.nn.functional.one_hot(shaped.weights.argmax(1), 24).float()
    rigid = type(shaped)(shaped.vertices, shaped.joints, shaped.faces, single, shaped.pose_basis)
    posed = pose_body(rigid, pose, shift)
    carried = skin(posed.canonical_vertices, single, posed.bones)
    torch.testing.assert_close(carried, posed.vertices, atol=5e-5, rtol=0)


@settings(max_examples=8)
@given(seeds)
def test_bones_keep_their_lengths(seed):
    body = random_body(seed)
    pose, shift, betas = random_pose(seed)
    shaped = shape_body(body, betas)
    posed = pose_body(shaped, pose, shift)
    rest = (shaped.joints[1:] - shaped.joints[list(PARENTS[1:])]).norm(dim=1)
    moved = (posed.joints[1:] - posed.joints[list(PARENTS[1:])]).norm(dim=1)
    torch.testing.assert_close(moved, rest, atol=2e-5, rtol=0)


def test_a_joint_moves_only_what_hangs_on_it():
    body = random_body(0, pose_columns=0)
    pose = torch.zeros(24, 3)
    elbow = JOINT_NAMES.index("left_elbow")
    pose[elbow] = torch.tensor([0.3, -1.0, 0.2])
    posed = pose_body(shape_body(body, torch.zeros(10)), pose, torch.zeros(3))
    moved = (posed.joints - body.joints).norm(dim=1) > 1e-5
    assert {JOINT_NAMES[j] for j in range(24) if moved[j]} == {"left_wrist", "left_hand"}


def test_the_canonical_pose_spreads_the_legs_by_thirty_degrees():
    joints = torch.zeros(24, 3)
    joints[4], joints[5] = torch.tensor([0.0, -1, 0]), torch.tensor([0.0, -1, 0])  # knees straight below the hips
    transforms = joint_transforms(joints, canonical_pose(), torch.zeros(3))
    knees = (transforms[:, :3, :3] @ joints[:, :, None])[[4, 5], :, 0] + transforms[[4, 5], :3, 3]
    expected = torch.tensor([[0.5, -math.cos(math.pi / 6), 0], [-0.5, -math.cos(math.pi / 6), 0]])
    torch.testing.assert_close(knees, expected)


def test_posing_has_its_gradient():
    body = random_body(3, vertices=5)
    pose, shift, betas = (x.double() for x in random_pose(3))
    names = ("template", "weights", "joints", "shape_basis", "joint_basis", "pose_basis")
    double = Body(name="cloud", faces=body.faces, **{n: getattr(body, n).double() for n in names})
    pose[5] = 0  # where the plain formula of a rotation divides by zero

    def vertices(pose, shift, betas):
        return pose_body(shape_body(double, betas), pose, shift).vertices

    inputs = tuple(x.requires_grad_() for x in (pose, shift, betas))
    assert torch.autograd.gradcheck(vertices, inputs, fast_mode=True)


def test_fewer_betas_are_the_same_as_zeros_behind_them():
    body = random_body(4)
    few = torch.tensor([0.5, -1.0])
    torch.testing.assert_close(
        shape_body(body, few).vertices, shape_body(body, torch.cat([few, torch.zeros(8)])).vertices
    )


def test_a_body_comes_back_from_its_arrays():
    body = random_body(5)
    again = Body.from_arrays(body.arrays())
    assert again.name == body.name
    for name, array in body.arrays().items():
        assert (array == again.arrays()[name]).all(), name


@pytest.mark.parametrize(
    ("name", "wrong", "message"),
    [
        ("weights", np.zeros((40, 23)), r"weights in the file should have the shape \(40, 24\), it has \(40, 23\)"),
        ("template", np.zeros((39, 3)), r"weights in the file should have the shape \(39, 24\), it has \(40, 24\)"),
        ("template", np.zeros(()), "template in the file should have the shape"),
        ("joint_basis", np.zeros((24, 3, 9)), r"should have the shape \(24, 3, 10\)"),
        ("joints", np.full((24, 3), np.nan), "joints in the file holds something that is no finite number"),
        ("joints", np.full((24, 3), "a"), "joints in the file holds something that is no finite number"),
        ("pose_basis", np.zeros((40, 3, 206)), "207 columns or none, it has 206"),
        ("faces", np.full((1, 3), 40), r"outside 0\.\.39"),
        ("faces", np.full((1, 3), -1), r"outside 0\.\.39"),
        ("faces", np.zeros((0, 3), dtype=int), "no vertices or no faces"),
        ("weights", np.zeros((40, 24)), r"row of weights in the file should sum to 1, row 0 sums to 0; divide"),
        ("weights", np.eye(40, 24) * 1.01, r"row of weights in the file should sum to 1"),
        ("weights", np.eye(40, 24) * 3 - 2 / 24, r"weights in the file should not be negative, the least is -0\.0833"),
        ("template", np.zeros((40, 3)), r"template in the file should make a body of 0\.3 to 3 metres, it measures 0;"),
        ("template", 100 * np.eye(40, 3), "to 3 metres, it measures 100; give metres"),
    ],
)
def test_a_fault_in_the_arrays_is_named(name, wrong, message):
    arrays = random_body(6).arrays() | {name: wrong}
    with pytest.raises(TwofoldError, match=message):
        Body.from_arrays(arrays, "the file")


def test_missing_arrays_are_named():
    arrays = random_body(6).arrays()
    del arrays["faces"], arrays["joints"]
    with pytest.raises(TwofoldError, match="the file lacks faces, joints"):
        Body.from_arrays(arrays, "the file")


def test_a_wrong_shape_is_refused_by_the_type_of_the_argument():
    with pytest.raises(Exception, match=r"pose"):
        joint_transforms(torch.zeros(24, 3), torch.zeros(23, 3), torch.zeros(3))


def test_parents_come_before_their_children():
    assert all(parent < j for j, parent in enumerate(PARENTS))
    assert len(PARENTS) == len(JOINT_NAMES) == 24
    for j, parent in enumerate(PARENTS):
        side = JOINT_NAMES[j].partition("_")[0]
        assert parent < 0 or side not in ("left", "right") or JOINT_NAMES[parent].partition("_")[0] in (
            side, "pelvis", "spine3",
        )  # fmt: skip


def test_rotation_matrices_pose_the_joints_as_their_axis_angles_do():
    generator = torch.Generator().manual_seed(3)
    joints, pose = torch.rand(24, 3, generator=generator), torch.randn(24, 3, generator=generator)
    translation = torch.rand(3, generator=generator)
    matrices = joint_transforms_of_rotations(joints, axis_angle_to_matrix(pose), translation)
    # The compiled loop turns axis-angle vectors into matrices in double precision.
    torch.testing.assert_close(matrices, joint_transforms(joints, pose, translation), atol=1e-6, rtol=1e-6)
    with in_pytorch():
        matrices = joint_transforms_of_rotations(joints, axis_angle_to_matrix(pose), translation)
        assert torch.equal(matrices, joint_transforms(joints, pose, translation))


def with_gradients(function, inputs, by_result):
    """What a function gives and its gradients, those of inputs that it is constant in included."""
    inputs = [x.detach().requires_grad_() for x in inputs]
    result = function(*inputs)
    return result.detach(), torch.autograd.grad(result, inputs, by_result.to(result.dtype))


def draw_inputs(batch, size, seed):
    generator = torch.Generator().manual_seed(seed)
    shapes = ((24, 3), (*batch, 24, 3), (*batch, 3), (*batch, 24, 4, 4))
    joints, pose, translation, by_result = (torch.randn(shape, generator=generator) for shape in shapes)
    return (joints, size * pose, translation), by_result


@pytest.mark.parametrize("form", [joint_transforms, joint_transforms_of_rotations])
@pytest.mark.parametrize("size", [0, 1e-5, 6e-5, 1e-3, 0.1, 1.0, 4.0, 30.0])
@pytest.mark.parametrize("batch", [(), (3,), (2, 3), (0,)])
def test_compiled_kinematics_are_the_plain_ones_in_double_precision(form, batch, size):
    """Sizes lie below, around and above the angle of 1e-4 where the series for small angles ends."""
    inputs, by_result = draw_inputs(batch, size, seed=7)
    if form is joint_transforms_of_rotations:
        # Corrected rotations need not be orthonormal.
        turns = axis_angle_to_matrix(inputs[1])
        inputs = (inputs[0], turns + 0.1 * torch.sin(5 * turns), inputs[2])
    found, gradients = with_gradients(form, inputs, by_result)
    expected, true_gradients = with_gradients(form, [x.double() for x in inputs], by_result)
    assert found.dtype == torch.float32
    torch.testing.assert_close(found.double(), expected, atol=5e-6, rtol=1e-6)
    for one, true in zip(gradients, true_gradients, strict=True):
        scale = float(true.abs().max()) if true.numel() else 0.0
        torch.testing.assert_close(one.double(), true, atol=1e-6 * scale + 3e-6, rtol=0)


@settings(max_examples=20)
@given(seeds, st.floats(-6, 1))
def test_compiled_kinematics_have_the_gradient_of_the_plain_ones_for_any_pose(seed, power):
    inputs, by_result = draw_inputs((2,), 10.0**power, seed)
    _, gradients = with_gradients(joint_transforms, inputs, by_result)
    _, expected = with_gradients(joint_transforms, [x.double() for x in inputs], by_result)
    for one, true in zip(gradients, expected, strict=True):
        torch.testing.assert_close(one.double(), true, atol=1e-6 * float(true.abs().max()) + 3e-6, rtol=0)


@pytest.mark.parametrize("wanted", [(True, False, False), (False, True, False), (False, False, True)])
def test_a_single_gradient_is_that_among_all(wanted):
    inputs, by_result = draw_inputs((2,), 1.0, seed=8)
    _, every = with_gradients(joint_transforms, inputs, by_result)
    alone = [x.detach().requires_grad_(one) for x, one in zip(inputs, wanted, strict=True)]
    joint_transforms(*alone).backward(by_result)
    for x, gradient, one in zip(alone, every, wanted, strict=True):
        assert (x.grad is not None) == one
        assert not one or torch.equal(x.grad, gradient)


def test_compiled_kinematics_take_expanded_and_transposed_tensors():
    (joints, pose, translation), by_result = draw_inputs((24,), 1.0, seed=9)
    strided = (
        joints.T.contiguous().T,
        pose.transpose(0, 1).contiguous().transpose(0, 1),
        translation[:1].expand(24, 3),
    )
    assert not any(x.is_contiguous() for x in strided)
    by_strided = by_result.mT.contiguous().mT
    plain = (joints, pose, translation[:1].repeat(24, 1))
    found, expected = (
        with_gradients(joint_transforms, strided, by_strided),
        with_gradients(joint_transforms, plain, by_result),
    )
    assert torch.equal(found[0], expected[0])
    for one, other in zip(found[1], expected[1], strict=True):
        assert torch.equal(one, other)


def test_kinematics_work_within_functional_transforms():
    (joints, pose, translation), _ = draw_inputs((3,), 1.0, seed=10)
    pose.requires_grad_()
    each = torch.vmap(joint_transforms, in_dims=(None, 0, 0))(joints, pose, translation)
    torch.testing.assert_close(each, joint_transforms(joints, pose, translation), atol=5e-6, rtol=0)
    by_pose = torch.func.jacrev(joint_transforms, 1)(joints, pose[0], translation[0])
    alone = torch.autograd.functional.jacobian(lambda p: joint_transforms(joints, p, translation[0]), pose[0])
    torch.testing.assert_close(by_pose, alone, atol=5e-6, rtol=0)


def test_movement_is_the_largest_way_of_a_vertex():
    body = little_body()
    shaped = shape_body(body, torch.zeros(body.shape_basis.shape[-1]))
    generator = torch.Generator().manual_seed(2)
    pose, translation = 0.3 * torch.randn(2, 3, 24, 3, generator=generator), torch.randn(2, 3, 3, generator=generator)
    found = movements(shaped, (pose[0], translation[0]), (pose[1], translation[1]), every=1)
    for n in range(3):
        first, second = (pose_body(shaped, pose[i, n], translation[i, n]).vertices for i in (0, 1))
        torch.testing.assert_close(found[n], (first - second).norm(dim=-1).max())
