"""Where landmarks sit on a body: on the right side, on the right part, and wherever the shape takes them."""

from dataclasses import replace

import pytest
import torch
from acting import needs_anny, the_body
from hypothesis import given
from hypothesis import strategies as st

from twofold.body.skeleton import JOINT_NAMES, Body
from twofold.prepare.detections import LANDMARKS, mirrored_landmarks
from twofold.prepare.fitting.body_landmarks import body_points

MIRROR = torch.tensor([-1.0, 1.0, 1.0])
OTHER_JOINT = [
    JOINT_NAMES.index(n.replace("left", "x").replace("right", "left").replace("x", "right")) for n in JOINT_NAMES
]
SIDES = list(mirrored_landmarks())
ON_SKIN = [k for k, n in enumerate(LANDMARKS) if any(w in n for w in ("nose", "eye", "ear", "mouth", "heel", "foot"))]
BODIES = ["sausages", pytest.param("anny", marks=needs_anny)]


def a_body(name, seed=None):
    """With `seed` all vertices a little elsewhere, so that none is as far as another, and a shape basis of noise."""
    body = the_body(name)
    if seed is None:
        return body
    generator = torch.Generator().manual_seed(seed)
    return replace(
        body,
        template=body.template + 1e-3 * torch.randn(body.template.shape, generator=generator),
        shape_basis=torch.randn(*body.template.shape, 3, generator=generator),
        joint_basis=torch.randn(24, 3, 3, generator=generator),
    )


def mirrored(body: Body) -> Body:
    return replace(
        body,
        template=body.template * MIRROR,
        faces=body.faces.flip(1),
        weights=body.weights[:, OTHER_JOINT],
        joints=body.joints[OTHER_JOINT] * MIRROR,
        shape_basis=body.shape_basis * MIRROR[:, None],
        joint_basis=body.joint_basis[OTHER_JOINT] * MIRROR[:, None],
    )


@pytest.mark.parametrize("name", BODIES)
def test_landmarks_of_the_mirror_image_are_the_mirror_image_of_the_landmarks(name):
    body = a_body(name, seed=0)
    points, seen = body_points(body), body_points(mirrored(body))
    torch.testing.assert_close(seen.place[SIDES] * MIRROR, points.place)
    torch.testing.assert_close(seen.basis[SIDES] * MIRROR[:, None], points.basis)
    assert seen.joint[SIDES].tolist() == [OTHER_JOINT[j] for j in points.joint.tolist()]


@needs_anny
def test_landmarks_of_anny_are_as_symmetric_as_she_is():
    points = body_points(the_body("anny"))
    torch.testing.assert_close(points.place[SIDES] * MIRROR, points.place, atol=1e-4, rtol=0)


@given(seed=st.integers(0, 10**6))
def test_landmarks_go_where_the_shape_takes_their_vertices_and_joints(seed):
    body = a_body("sausages", seed)
    points = body_points(body)
    betas = torch.randn(3, generator=torch.Generator().manual_seed(seed))
    there = points.place + points.basis @ betas
    vertices = body.template + body.shape_basis @ betas
    for k in ON_SKIN:
        vertex = int((body.template - points.place[k]).norm(dim=1).argmin())
        torch.testing.assert_close(there[k], vertices[vertex])
    joints = body.joints + body.joint_basis @ betas
    for side in ("left", "right"):
        for part in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle"):
            k = LANDMARKS.index(f"{side}_{part}")
            torch.testing.assert_close(there[k], joints[JOINT_NAMES.index(f"{side}_{part}")])
            assert JOINT_NAMES[points.joint[k]] == f"{side}_{part}"
        wrist, hand = (joints[JOINT_NAMES.index(f"{side}_{part}")] for part in ("wrist", "hand"))
        index = there[LANDMARKS.index(f"{side}_index")] - hand
        torch.testing.assert_close(index, torch.tensor([0.0, 0.0, 0.022]), atol=1e-5, rtol=0)
        assert (there[LANDMARKS.index(f"{side}_thumb")] - wrist).norm() < 0.6 * (hand - wrist).norm() + 0.046


@pytest.mark.parametrize("name", BODIES)
def test_a_body_off_the_origin_has_its_landmarks_as_far_off(name):
    body, shift = a_body(name, seed=1), torch.tensor([0.3, -0.7, 0.9])
    moved = replace(body, template=body.template + shift, joints=body.joints + shift)
    torch.testing.assert_close(body_points(moved).place, body_points(body).place + shift, atol=1e-5, rtol=0)


@pytest.mark.parametrize("name", BODIES)
def test_left_is_at_the_left_and_toes_are_before_heels(name):
    points = body_points(a_body(name))
    at = {name: points.place[k] for k, name in enumerate(LANDMARKS)}
    for part in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle", "heel", "index", "thumb"):
        assert at[f"left_{part}"][0] > at[f"right_{part}"][0]
    for side in ("left", "right"):
        assert at[f"{side}_foot_index"][2] > at[f"{side}_heel"][2] + 0.05
        assert at[f"{side}_thumb"][2] > at[f"{side}_index"][2] > at[f"{side}_pinky"][2]
        assert at[f"{side}_heel"][1] < at[f"{side}_knee"][1] < at[f"{side}_hip"][1] < at["nose"][1]


@needs_anny
def test_the_face_of_anny_is_where_faces_are():
    points = body_points(the_body("anny"))
    at = {name: points.place[k] for k, name in enumerate(LANDMARKS)}
    for side, sign in (("left", 1), ("right", -1)):
        eyes = [at[f"{side}_eye{end}"] for end in ("_inner", "", "_outer")]
        across = [sign * float(eye[0]) for eye in eyes]
        assert across == sorted(across)
        assert across[0] > 0.005
        mouth = at["mouth_left" if side == "left" else "mouth_right"]
        assert all(eye[1] > at["nose"][1] + 0.02 for eye in eyes)
        assert mouth[1] < at["nose"][1] - 0.01
        assert sign * mouth[0] > 0.01
        assert 0.05 < sign * float(at[f"{side}_ear"][0]) < 0.12
        assert at[f"{side}_ear"][2] < at["nose"][2] - 0.05
