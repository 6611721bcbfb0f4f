"""How well training images observed a surface, against rays that are cast one by one."""

import dataclasses

import numpy as np
import pytest
import torch
import trimesh
from little_body import little_body
from tiny_person import person_body, ring_camera

from twofold.body.skeleton import pose_body, shape_body
from twofold.capture.coverage import (
    BEHIND,
    Coverage,
    coverage_of,
    distant_camera,
    measure_coverage,
    outer_area,
    visible_vertices,
    weights_at,
)
from twofold.errors import TwofoldError
from twofold.geometry.cameras import project
from twofold.geometry.surfaces import face_areas


def posed_person(bend=0.0):
    body = person_body(spacing=0.03)
    pose = torch.zeros(24, 3)
    pose[16, 1] = bend  # an arm before the trunk
    return pose_body(shape_body(body, torch.zeros(1)), pose, torch.zeros(3))


def cast(camera, vertices, faces, start=2e-3):
    """Whether the way from each vertex to the camera is free after the first `start` metres; the literal form."""
    mesh = trimesh.Trimesh(vertices.numpy(), faces.numpy(), process=False)
    caster = trimesh.ray.ray_pyembree.RayMeshIntersector(mesh)
    towards = camera.center.numpy() - vertices.numpy()
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    pixels, depth = project(camera, vertices)
    inside = (pixels >= -0.5).all(-1) & (pixels < camera.width - 0.5).all(-1) & (depth > 0)
    return inside.numpy() & ~caster.intersects_any(vertices.numpy() + start * towards, towards)


@pytest.mark.parametrize("angle", [0.0, 1.0, 2.5])
def test_visible_vertices_are_those_whose_way_to_the_camera_is_free(angle):
    body, camera = posed_person(bend=1.3), ring_camera(angle, 300)
    seen, cosine, resolution = visible_vertices(camera, body.vertices, body.faces)
    free = cast(camera, body.vertices, body.faces)
    # On the outline a vertex's own triangles decide; what is closely covered counts as seen.
    plain = (cosine.abs() > 0.2).numpy() & (free | ~cast(camera, body.vertices, body.faces, 2 * BEHIND))
    assert 0.2 < free.mean() < 0.6
    assert plain.mean() > 0.8
    assert (seen.numpy() == free)[plain].mean() > 0.99
    depth = project(camera, body.vertices)[1]
    assert torch.allclose(resolution, 375 / depth)


def test_what_lies_beyond_the_image_is_not_seen():
    body, camera = posed_person(), ring_camera(0.0, 64)
    moved = camera.intrinsics.clone()
    moved[1, 2] -= 40  # the upper part leaves the image
    away = dataclasses.replace(camera, intrinsics=moved)
    high = project(away, body.vertices)[0][:, 1] < -1
    assert high.any()
    assert not visible_vertices(away, body.vertices, body.faces)[0][high].any()


def test_a_person_filmed_from_the_front_is_observed_in_front(person):
    coverage = measure_coverage(person)
    body = pose_body(shape_body(person.body, person.betas), person.train[0].pose, torch.zeros(3))
    normals = trimesh.Trimesh(body.canonical_vertices.numpy(), body.faces.numpy(), process=False).vertex_normals
    weight = coverage.weight.numpy()
    assert weight[normals[:, 2] > 0.9].min() > 0.4
    assert weight[normals[:, 2] < -0.9].max() == 0
    assert 0.3 < coverage.share < 0.75
    assert coverage.sentence() == f"coverage: {100 * coverage.share:.0f} % of the surface"
    assert coverage.images == len(person.train) >= int(coverage.count.max())
    assert ((coverage.count > 0) == (coverage.cosine > 0)).all()


def test_one_image_more_never_lowers_what_was_observed(person):
    fewer = dataclasses.replace(person, splits={**person.splits, "train": person.train[:2]})
    assert (measure_coverage(person).weight >= measure_coverage(fewer).weight - 1e-6).all()


def test_the_outline_is_where_the_surface_turns_away(person):
    """Filmed from the front its sides are on outlines; with cameras from all sides nearly everything is."""
    coverage = measure_coverage(person)
    body = pose_body(shape_body(person.body, person.betas), person.train[0].pose, torch.zeros(3))
    normals = trimesh.Trimesh(body.canonical_vertices.numpy(), body.faces.numpy(), process=False).vertex_normals
    outer = coverage.area > 0
    ahead, beside = (torch.from_numpy(normals[:, 2] > 0.9), torch.from_numpy(abs(normals[:, 2]) < 0.2))
    assert (coverage.outline[ahead & outer] >= 0.5).float().mean() < 0.3
    assert (coverage.outline[beside & outer] >= 0.5).float().mean() > 0.5
    assert 0 < coverage.outlined_share < 0.9
    both = dataclasses.replace(person, splits={"train": (*person.train, *person.splits["novel_view"])})
    assert measure_coverage(both).outlined_share > coverage.outlined_share + 0.1


def test_runs_of_before_knew_no_outlines(person):
    arrays = coverage_of(person).arrays()
    del arrays["outline"]
    assert (Coverage.from_arrays(arrays, "here").outline == 1).all()


def test_all_cameras_together_see_more(person):
    both = dataclasses.replace(person, splits={"train": (*person.train, *person.splits["novel_view"])})
    assert coverage_of(both).share > coverage_of(person).share


def test_it_is_measured_once_for_a_capture(person, monkeypatch):
    first = coverage_of(person)
    monkeypatch.setattr("twofold.capture.coverage.measure_coverage", lambda capture: pytest.fail("measured again"))
    assert coverage_of(person) is first


def test_inner_parts_have_no_area():
    shaped = shape_body(little_body(), torch.zeros(1))
    body = pose_body(shaped, torch.zeros(24, 3), torch.zeros(3))
    inner = 0.3 * (body.canonical_vertices - body.canonical_vertices.mean(0))
    ball = trimesh.creation.icosphere(2, 0.9)
    count = len(inner)
    vertices = torch.cat([inner, torch.from_numpy(np.asarray(ball.vertices)).float()])
    faces = torch.cat([body.faces, torch.from_numpy(np.asarray(ball.faces)) + count])
    weights = torch.eye(24)[:1].expand(len(vertices), 24)
    nested = dataclasses.replace(body, canonical_vertices=vertices, vertices=vertices, faces=faces, weights=weights)
    area = outer_area(nested)
    assert area[:count].sum() == 0
    assert torch.isclose(area.sum(), face_areas(vertices, faces)[len(body.faces) :].sum(), rtol=0.05)


def test_a_distant_camera_shows_everything_within_reach():
    middle = torch.tensor([0.3, -0.2, 0.1])
    for side in (torch.tensor([0.0, 0.0, 1.0]), torch.tensor([0.0, 1.0, 0.0]), torch.tensor([-1.0, 0.5, 0.2])):
        camera = distant_camera(middle, side, 0.7, 100)
        points = middle + 0.7 * torch.nn.functional.normalize(torch.randn(200, 3), dim=-1)
        pixels, depth = project(camera, points)
        assert (depth > 0).all()
        assert ((pixels > -0.5) & (pixels < 99.5)).all()
        assert torch.dot(camera.center - middle, side) > 0


def test_coverage_is_stored_and_damage_is_named(person):
    coverage = coverage_of(person)
    again = Coverage.from_arrays(coverage.arrays(), "here")
    assert all(torch.equal(vars(again)[name], value) for name, value in vars(coverage).items() if name != "images")
    assert again.images == coverage.images
    for broken in (
        {**coverage.arrays(), "weight": np.zeros(3)},
        {k: v for k, v in coverage.arrays().items() if k != "area"},
        {**coverage.arrays(), "cosine": np.full(len(coverage.weight), np.nan)},
        {**coverage.arrays(), "outline": np.full(len(coverage.weight), np.nan)},
        {**coverage.arrays(), "outline": np.ones(3)},
    ):
        with pytest.raises(TwofoldError, match="here does not hold the coverage"):
            Coverage.from_arrays(broken, "here")


def test_weights_between_vertices_are_between_those_of_the_vertices():
    vertices = torch.eye(3)
    weight = torch.tensor([0.0, 1.0, 0.5])
    assert torch.allclose(weights_at(weight, vertices, vertices, 3), weight, atol=0.01)
    middle = weights_at(weight, vertices, vertices.mean(0, keepdim=True), 3)
    assert torch.allclose(middle, torch.tensor([0.5]), atol=1e-4)
