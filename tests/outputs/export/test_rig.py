"""Skinning weights and names of an exported rig."""

import pytest
import torch
from tiny_person import person_body

from twofold.body.skeleton import ShapedBody, pose_body, shape_body, skin
from twofold.geometry.rotations import rigid_inverse
from twofold.outputs.export.rig import INFLUENCES, joint_names, keep_largest_weights, to_rest, transfer_weights


@pytest.fixture(scope="module")
def shaped() -> ShapedBody:
    body = person_body()
    return shape_body(body, torch.zeros(1))


@pytest.mark.parametrize("rig", ["smpl", "mixamo", "vrm"])
def test_every_joint_has_a_name_of_its_own(rig) -> None:
    names = joint_names(rig)
    assert len(set(names)) == 24
    left, right = ([n for n in names if side in n.lower()] for side in ("left", "right"))
    assert {n.lower().replace("left", "right") for n in left} == {n.lower() for n in right}


def test_weights_are_those_of_the_body_nearby_but_smoother(shaped) -> None:
    rest = pose_body(shaped, torch.zeros(24, 3), torch.zeros(3))
    weights = transfer_weights(rest.canonical_vertices, rest.faces.numpy(), rest)
    assert torch.allclose(weights.sum(-1), torch.ones(len(weights)), atol=1e-6)
    assert ((weights > 0).sum(-1) <= INFLUENCES).all()
    assert weights.min() >= 0
    assert ((weights - rest.weights).abs().sum(-1) < 1.0).float().mean() > 0.9
    same = weights.argmax(-1) == rest.weights.argmax(-1)
    assert same.float().mean() > 0.7


def test_rest_vertices_skin_back_to_canonical_space(shaped) -> None:
    rest = pose_body(shaped, torch.zeros(24, 3), torch.zeros(3))
    weights = keep_largest_weights(rest.weights)
    there = to_rest(rest.canonical_vertices, weights, rest)
    back = skin(there, weights, rigid_inverse(rest.bones))
    assert torch.allclose(back, rest.canonical_vertices, atol=1e-5)


def test_rest_pose_is_the_bodys_own_where_weights_are(shaped) -> None:
    rest = pose_body(shaped, torch.zeros(24, 3), torch.zeros(3))
    there = to_rest(rest.canonical_vertices, shaped.weights, rest)
    assert (there - shaped.vertices).norm(dim=-1).max() < 1e-4
