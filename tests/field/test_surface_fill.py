"""Completed values over the surface of a body."""

import dataclasses

import numpy as np
import torch
from tiny_person import person_body

from twofold.body.skeleton import shape_body
from twofold.field.surface_fill import HEAD, LEGS, TRUNK, SurfaceFill, body_parts, cotangent_laplacian
from twofold.geometry.surfaces import face_areas, vertex_normals

BODY = person_body()
# This body has no vertices that follow the head most; those above the neck do from here on.
ABOVE = BODY.template[:, 1] > 0.24
BODY = dataclasses.replace(BODY, weights=torch.where(ABOVE[:, None], torch.eye(24)[15], BODY.weights))
SHAPED = shape_body(BODY, torch.zeros(1))
REST, NORMALS = SHAPED.vertices.numpy(), vertex_normals(SHAPED.vertices, SHAPED.faces).numpy()
COUNT = len(REST)
MIDDLE = float(SHAPED.joints[0, 0])


def areas():
    area = torch.zeros(COUNT)
    for corner in range(3):
        area.index_add_(0, SHAPED.faces[:, corner], face_areas(SHAPED.vertices, SHAPED.faces) / 3)
    return area.numpy()


def filled(weight, values):
    """Completed values at points of the surface, and where these lie."""
    surface = SurfaceFill(SHAPED, weight.astype(np.float32), areas(), NORMALS[:, 2], 6000)
    return surface(surface.samples.at(values.astype(np.float32))), surface


FRONT = (NORMALS[:, 2] > 0.1).astype(float)


def test_mirrored_vertices_lie_on_the_other_side():
    mirrored = REST[body_parts(SHAPED).mirrored]
    off = mirrored - np.stack([2 * MIDDLE - REST[:, 0], REST[:, 1], REST[:, 2]], -1)
    assert np.linalg.norm(off, axis=1).max() < 0.05


def test_laplacian_annuls_constants_and_is_that_of_the_energy():
    laplacian = cotangent_laplacian(REST.astype(np.float64), SHAPED.faces.numpy())
    assert np.abs(laplacian @ np.ones(COUNT)).max() < 1e-9
    # The Dirichlet energy of a coordinate is the integral of 1 - n_x^2 over the surface.
    flat = SHAPED.vertices[SHAPED.faces].double()
    normals = torch.linalg.cross(flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0])
    size = normals.norm(dim=-1)
    expected = float((0.5 * size * (1 - (normals[:, 0] / size) ** 2)).sum())
    x = REST[:, 0].astype(np.float64)
    assert abs(x @ (laplacian @ x) / expected - 1) < 0.25  # marching cubes make needles, whose weights are bounded


def test_observed_values_stay():
    values = REST @ np.array([[1.0], [0.3], [0.2]], np.float32)
    found, surface = filled(np.ones(COUNT), values)
    assert np.abs(found - surface.samples.at(values)).max() < 0.01


def test_a_constant_stays_a_constant_whatever_was_observed():
    assert np.abs(filled(FRONT, np.full((COUNT, 2), 0.37))[0] - 0.37).max() < 1e-3


def test_a_side_that_was_not_seen_mirrors_the_one_that_was():
    left = (REST[:, 0] > MIDDLE + 0.02).astype(float)
    values = np.sin(6 * REST[:, 1:2] + 3 * np.abs(REST[:, :1] - MIDDLE) + 2 * REST[:, 2:])
    found, surface = filled(left, np.where(left[:, None] > 0, values, 5.0))
    hidden = surface.samples.at(REST)[:, 0] < MIDDLE - 0.06
    hairless = hidden & (surface.group != HEAD)
    assert np.abs(found - surface.samples.at(values))[hairless].mean() < 0.05


def test_the_back_takes_the_colour_of_the_same_height_and_no_small_emblem():
    shirt = (REST[:, 1:2] > -0.2).astype(float)
    emblem = (np.linalg.norm(REST - [MIDDLE, 0.05, 0.11], axis=1) < 0.05)[:, None]
    found, surface = filled(FRONT, np.where(emblem, 3.0, shirt))
    at = surface.samples.at(REST)
    back = surface.samples.at(NORMALS)[:, 2] < -0.5
    far = np.abs(at[:, 1] + 0.2) > 0.08
    expected = (at[:, 1:2] > -0.2).astype(float)
    assert np.abs(found - expected)[back & (surface.group != HEAD) & far].max() < 0.3


def test_stripes_go_on_behind():
    surface = SurfaceFill(SHAPED, FRONT.astype(np.float32), areas(), NORMALS[:, 2], 20_000)
    height = surface.samples.at(REST)[:, 1]
    stripes = (height / 0.05 % 1 < 0.5).astype(float)[:, None]
    found = surface(np.where(surface.weight[:, None] > 0, stripes, 0.2))
    back = (surface.samples.at(NORMALS)[:, 2] < -0.3) & (surface.weight == 0) & np.isin(surface.group, (TRUNK, LEGS))
    assert back.sum() > 500
    assert np.abs(found - stripes)[back].mean() < 0.12  # 0.5 without stripes


def test_a_faint_shadow_at_the_sides_does_not_become_a_stripe():
    """Arms that hang down darken a few centimetres of both sides."""
    surface = SurfaceFill(SHAPED, FRONT.astype(np.float32), areas(), NORMALS[:, 2], 20_000)
    height, facing = surface.samples.at(REST)[:, 1], surface.samples.at(NORMALS)[:, 2]
    shadow = (np.abs(height - 0.1) < 0.025) & (facing < 0.6)
    values = np.where(shadow, 0.44, 0.5)[:, None]
    back = (facing < -0.5) & (surface.weight == 0) & (surface.group == TRUNK) & (np.abs(height - 0.1) < 0.02)
    assert back.sum() > 50
    assert np.abs(surface(values) - 0.5)[back].mean() < 0.01
    assert np.abs(surface(values, faint=None) - 0.5)[back].mean() > 0.03


def test_cloth_between_the_legs_in_front_does_not_thicken_the_buttocks():
    """At that height only the front of the trunk was seen, and thighs beside it."""
    surface = SurfaceFill(SHAPED, FRONT.astype(np.float32), areas(), NORMALS[:, 2], 20_000)
    height, facing = surface.samples.at(REST)[:, 1], surface.samples.at(NORMALS)[:, 2]
    lowest = height[(surface.group == TRUNK) & (surface.weight > 0)].min()
    trunk = (surface.group == TRUNK) & (height < lowest + 0.1)
    found = surface(np.where(trunk, 0.05, 0.0)[:, None], 0.02, None)[:, 0]
    behind = (facing < -0.5) & (surface.weight == 0) & trunk & (height < lowest + 0.06)
    assert behind.sum() > 50
    assert np.median(found[behind]) < 0.01


def test_an_open_collar_does_not_go_around_the_neck():
    neck = float(SHAPED.joints[12, 1])
    surface = SurfaceFill(SHAPED, FRONT.astype(np.float32), areas(), NORMALS[:, 2], 20_000)
    at = surface.samples.at(REST)
    skin = ((at[:, 1] > neck - 0.09) & (surface.group == TRUNK)).astype(float)[:, None]
    back = (surface.samples.at(NORMALS)[:, 2] < -0.5) & (skin[:, 0] == 1)
    assert back.sum() > 100
    found = surface(skin)[back]
    assert np.median(found) < 0.1


def test_the_back_of_the_head_takes_the_hair_and_not_the_face():
    head = body_parts(SHAPED).group == HEAD
    height = (REST[:, 1] - REST[head, 1].min()) / np.ptp(REST[head, 1])
    hair = (height > 0.85).astype(float)[:, None]
    found, surface = filled(FRONT, hair)
    height, facing = surface.samples.at(height), surface.samples.at(NORMALS)[:, 2]
    behind = (surface.group == HEAD) & (facing < -0.6) & (height > 0.5)
    assert behind.any()
    assert found[behind].min() > 0.8
    face = (surface.group == HEAD) & (facing > 0.8) & (height < 0.7)
    assert found[face].max() < 0.2
