"""Rotations: group laws, exponential and logarithm, gradients at the hard places."""

import math

import numpy as np
import pytest
import scipy.spatial.transform
import torch
from hypothesis import given
from hypothesis import strategies as st

from twofold.geometry.rotations import (
    axis_angle_to_matrix,
    cross_matrix,
    matrix_to_axis_angle,
    rigid_inverse,
    rigid_transform,
)

coordinates = st.floats(-1, 1, allow_subnormal=False)
directions = st.tuples(coordinates, coordinates, coordinates).filter(lambda v: math.hypot(*v) > 1e-2)
angles = st.one_of(
    st.floats(0, math.pi, allow_subnormal=False),
    st.sampled_from([0.0, 1e-12, 1e-8, 9.9e-5, 1.01e-4, 1e-3, math.pi - 1e-3, math.pi - 1e-7]),
)


@st.composite
def vectors(draw, angles=angles):
    """Axis-angle vectors, with those near the identity and near half a turn among them."""
    axis = torch.tensor(draw(directions), dtype=torch.float64)
    return axis / axis.norm() * draw(angles)


@st.composite
def transforms(draw):
    shift = torch.tensor(draw(st.tuples(coordinates, coordinates, coordinates)), dtype=torch.float64)
    return rigid_transform(axis_angle_to_matrix(draw(vectors())), shift)


def identity(n):
    return torch.eye(n, dtype=torch.float64)


@given(vectors())
def test_the_exponential_is_a_rotation(vector):
    matrix = axis_angle_to_matrix(vector)
    torch.testing.assert_close(matrix @ matrix.T, identity(3), atol=1e-12, rtol=0)
    assert torch.linalg.det(matrix).item() == pytest.approx(1, abs=1e-12)


@given(vectors())
def test_the_exponential_agrees_with_scipy(vector):
    expected = scipy.spatial.transform.Rotation.from_rotvec(vector.numpy()).as_matrix()
    np.testing.assert_allclose(axis_angle_to_matrix(vector).numpy(), expected, atol=1e-12)


@given(vectors())
def test_the_logarithm_undoes_the_exponential(vector):
    # Half a turn about v and about -v are the same, so that close to it only the matrix can be compared.
    back = matrix_to_axis_angle(axis_angle_to_matrix(vector))
    torch.testing.assert_close(axis_angle_to_matrix(back), axis_angle_to_matrix(vector), atol=1e-11, rtol=0)
    if vector.norm() < math.pi - 1e-5:
        torch.testing.assert_close(back, vector, atol=1e-9, rtol=0)


@given(vectors(), vectors())
def test_angles_of_the_logarithm_are_at_most_half_a_turn(a, b):
    product = axis_angle_to_matrix(a) @ axis_angle_to_matrix(b)
    logarithm = matrix_to_axis_angle(product)
    assert logarithm.norm() <= math.pi + 1e-9
    torch.testing.assert_close(axis_angle_to_matrix(logarithm), product, atol=1e-11, rtol=0)


@given(vectors())
def test_the_opposite_vector_is_the_inverse(vector):
    product = axis_angle_to_matrix(vector) @ axis_angle_to_matrix(-vector)
    torch.testing.assert_close(product, identity(3), atol=1e-12, rtol=0)


@given(vectors(), st.floats(-2, 2), st.floats(-2, 2))
def test_turns_about_one_axis_add_up(vector, s, t):
    product = axis_angle_to_matrix(s * vector) @ axis_angle_to_matrix(t * vector)
    torch.testing.assert_close(product, axis_angle_to_matrix((s + t) * vector), atol=1e-11, rtol=0)


@given(vectors())
def test_the_axis_stays_where_it_is(vector):
    torch.testing.assert_close(axis_angle_to_matrix(vector) @ vector, vector, atol=1e-12, rtol=0)


@given(vectors(), vectors())
def test_the_cross_matrix_is_the_cross_product(a, b):
    torch.testing.assert_close(cross_matrix(a) @ b, torch.linalg.cross(a, b), atol=1e-12, rtol=0)


def test_a_quarter_turn_about_z_takes_x_to_y():
    matrix = axis_angle_to_matrix(torch.tensor([0, 0, math.pi / 2]))
    torch.testing.assert_close(matrix @ torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 1, 0]))


@pytest.mark.parametrize("axis", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0, -0.8], [-0.6, 0.48, 0.64]])
def test_the_logarithm_of_half_a_turn_is_exact(axis):
    axis = torch.tensor(axis, dtype=torch.float64)
    half = 2 * axis[:, None] * axis - identity(3)
    logarithm = matrix_to_axis_angle(half)
    assert logarithm.norm().item() == pytest.approx(math.pi, abs=1e-12)
    torch.testing.assert_close((logarithm @ axis).abs() / math.pi, torch.ones((), dtype=torch.float64))


@pytest.mark.parametrize("angle", [0.0, 1e-9, 9.9e-5, 1.01e-4, 1e-2, 1.0, math.pi])
def test_the_exponential_has_its_gradient_everywhere(angle):
    vector = torch.tensor([0.6, -0.48, 0.64], dtype=torch.float64) * angle
    assert torch.autograd.gradcheck(axis_angle_to_matrix, vector.requires_grad_())
    assert torch.autograd.gradgradcheck(axis_angle_to_matrix, vector)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 9.9e-5, 1.01e-4, 1e-2, 1.0, 3.0])
def test_the_logarithm_has_its_gradient_along_rotations(angle):
    start = axis_angle_to_matrix(torch.tensor([0.6, -0.48, 0.64], dtype=torch.float64) * angle)
    step = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda s: matrix_to_axis_angle(axis_angle_to_matrix(s) @ start), step)


@pytest.mark.parametrize("angle", [0.0, 1e-5, 1.1e-4, 3e-4, 1e-3, 1e-2])
def test_gradients_near_identity_are_accurate_in_single_precision(angle):
    def gradient(dtype):
        vector = (torch.tensor([0.6, -0.48, 0.64], dtype=torch.float64) * angle).to(dtype).requires_grad_()
        weights = torch.arange(9, dtype=dtype).reshape(3, 3)
        ((axis_angle_to_matrix(vector) - torch.eye(3)) * weights).sum().backward()
        return vector.grad.double()

    torch.testing.assert_close(gradient(torch.float32), gradient(torch.float64), atol=2e-6, rtol=2e-6)


@given(transforms(), transforms(), transforms())
def test_rigid_transforms_form_a_group(a, b, c):
    torch.testing.assert_close(rigid_inverse(a) @ a, identity(4), atol=1e-12, rtol=0)
    torch.testing.assert_close(a @ rigid_inverse(a), identity(4), atol=1e-12, rtol=0)
    torch.testing.assert_close((a @ b) @ c, a @ (b @ c), atol=1e-12, rtol=0)
    torch.testing.assert_close(rigid_inverse(a @ b), rigid_inverse(b) @ rigid_inverse(a), atol=1e-12, rtol=0)


def test_batches_are_done_one_by_one():
    vectors = torch.linspace(-2, 2, 18, dtype=torch.float64).reshape(2, 3, 3)
    matrices = axis_angle_to_matrix(vectors)
    assert matrices.shape == (2, 3, 3, 3)
    torch.testing.assert_close(matrices[1, 2], axis_angle_to_matrix(vectors[1, 2]))
    torch.testing.assert_close(matrix_to_axis_angle(matrices)[1, 2], matrix_to_axis_angle(matrices[1, 2]))
