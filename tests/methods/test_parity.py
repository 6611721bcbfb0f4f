"""`released()` against slow literal forms of what the authors' program does in its scene units."""

import math
from dataclasses import replace

import pytest
import torch
from small_recipes import CASES
from torch.nn import functional as F

from twofold.body.skeleton import joint_transforms, pose_body, shape_body
from twofold.geometry.cameras import Rays, pixel_grid, pixel_rays
from twofold.geometry.rotations import rigid_inverse
from twofold.methods.base import EVALUATION, Mode
from twofold.methods.factorized_recipes import paper, released
from twofold.methods.subject import Subject

METHOD = CASES["released"].method
BLACK = torch.zeros(3)
SCALE = 0.7


@pytest.fixture(scope="module")
def subject(person):
    return replace(Subject.of(person), scene_scale=SCALE)


@pytest.fixture(scope="module")
def avatar(subject):
    """With corrections of every kind, and a density that is not all haze."""
    avatar = METHOD.build(subject, 3)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        avatar.raw_beta.fill_(0.03)
        for table in (avatar.refinement.root, avatar.refinement.body, avatar.refinement.translation):
            table.copy_(0.03 * torch.randn(table.shape, generator=generator))
        avatar.refinement.shape.fill_(0.3)
    return avatar.eval()


@pytest.fixture(scope="module")
def rays(person):
    camera = person.train[1].camera.resized(8, 8)
    camera.intrinsics[:2, :2] *= 0.6
    return pixel_rays(camera, pixel_grid(camera).flatten(0, 1))


def at(step):
    """Of a training whose epochs have three steps."""
    return Mode(step, step // 3, step % 3 == 0)


def in_training(avatar, person, step):
    frame = person.train[1]
    with torch.no_grad():
        return avatar.pose(frame.pose, frame.translation, frame.frame_index, at(step))


def scene_matrices(avatar, person):
    """T_b of the program: bones of the corrected pose and shape in scene units, from the canonical pose of the given
    shape; and its posed vertices."""
    frame, refinement = person.train[1], avatar.refinement
    with torch.no_grad():
        pose, translation = refinement(frame.frame_index, frame.pose, frame.translation)
        given = shape_body(person.body, person.betas)
        shaped = shape_body(person.body, person.betas + refinement.shape)
        bones = joint_transforms(shaped.joints, pose, torch.zeros(3)).clone()
        bones[:, :3] *= SCALE
        bones[:, :3, 3] += SCALE * translation
        canonical = torch.zeros(24, 3)
        canonical[1, 2], canonical[2, 2] = math.pi / 6, -math.pi / 6
        matrices = bones @ joint_transforms(given.joints, canonical, torch.zeros(3)).inverse()
        vertices = SCALE * pose_body(shaped, pose, torch.zeros(3)).vertices + SCALE * translation
    return matrices.double(), vertices.double(), shaped


def weights_of(points, vertices, table, k):
    """The program's skinning weights: K nearest vertices by brute force, exp(-min(d^2, 4)), normalised."""
    found = []
    for point in points:
        squared = (vertices - point).square().sum(-1)
        order = squared.argsort()[:k]
        shares = torch.exp(-squared[order].clamp_max(4))
        found.append((shares / shares.sum()) @ table[order].double())
    return torch.stack(found)


@pytest.mark.parametrize(("step", "k"), [(3, 1), (3 * 100, 7)])
def test_points_and_normals_move_by_the_programs_matrices(avatar, person, step, k):
    """Shape corrections leave the canonical side alone; K is 7 after epoch 100, in scene units; normals turn by the
    nearest canonical vertices."""
    posed = in_training(avatar, person, step)
    assert posed.own.surface.neighbours == k
    matrices, vertices, _ = scene_matrices(avatar, person)
    generator = torch.Generator().manual_seed(1)
    which = torch.randint(len(vertices), (60,), generator=generator)
    x_scene = vertices[which] + 0.06 * torch.randn(60, 3, generator=generator).double()
    blended = torch.einsum("nb,bij->nij", weights_of(x_scene, vertices, person.body.weights, k), matrices)
    x_c = torch.linalg.solve(blended, torch.cat([x_scene, torch.ones(60, 1).double()], 1)[..., None])[:, :3, 0]
    found, turn = avatar.to_canonical((x_scene / SCALE).float(), posed)
    torch.testing.assert_close(found.double(), x_c, atol=1e-5, rtol=0)
    canonical = avatar.canonical_points.double()
    forward = torch.einsum("nb,bij->nij", weights_of(found.double(), canonical, person.body.weights, k), matrices)
    gradient = torch.randn(60, 3, generator=generator).double()
    expected = torch.linalg.solve(forward[:, :3, :3].transpose(1, 2), gradient[..., None])[..., 0]
    normals = F.normalize((turn.double() * gradient[:, None]).sum(-1), dim=-1)
    torch.testing.assert_close(normals, F.normalize(expected, dim=-1, eps=1e-6), atol=1e-5, rtol=0)
    by_posed = torch.linalg.solve(blended[:, :3, :3].transpose(1, 2), gradient[..., None])[..., 0]
    assert (F.normalize(by_posed, dim=-1) - normals).norm(dim=-1).max() > 0.01, "no other vertex was found"


def test_neighbours_are_one_in_tests_and_before_the_first_validation(avatar, person):
    frame = person.train[1]
    assert [in_training(avatar, person, step).own.surface.neighbours for step in (0, 299, 300, 5000)] == [1, 1, 7, 7]
    assert avatar.pose(frame.pose, frame.translation).own.surface.neighbours == 1
    assert avatar.pose(frame.pose, frame.translation, frame.frame_index).own.surface.neighbours == 1


def test_canonical_vertices_of_normals_follow_the_shape_at_each_validation_and_are_stored(subject, person):
    avatar = METHOD.build(subject, 3)
    anchors = {}
    for step in range(0, 605, 5):
        with torch.no_grad():
            avatar.refinement.shape.fill_(step / 1000)
        for each in range(step, step + 5):
            avatar.before_step(at(each))
        if step in (0, 295, 300, 595, 600):
            anchors[step] = in_training(avatar, person, step).own.anchors
    given, start = shape_body(person.body, person.betas), torch.zeros(24, 3)
    for step, shape in ((0, 0.0), (295, 0.0), (300, 0.3), (595, 0.3), (600, 0.6)):
        shaped = shape_body(person.body, person.betas + shape) if shape else given
        torch.testing.assert_close(anchors[step], pose_body(shaped, start, start[0]).canonical_vertices)
    resumed = METHOD.build(subject, 4)
    resumed.load_state_dict(avatar.state_dict())
    assert torch.equal(resumed.late_shape, avatar.late_shape)
    assert avatar.late_shape.max() > 0
    assert torch.equal(avatar.pose(start, start[0]).own.anchors, avatar.canonical_points), "tests begin anew"


def test_tests_have_the_shape_as_given_and_training_frames_the_corrected_one(avatar, person):
    frame = person.train[1]
    given = pose_body(shape_body(person.body, person.betas), frame.pose, frame.translation)
    with torch.no_grad():
        torch.testing.assert_close(avatar.pose(frame.pose, frame.translation).body.vertices, given.vertices)
        moved = avatar.pose(frame.pose, frame.translation, frame.frame_index).body.vertices
    _, vertices, _ = scene_matrices(avatar, person)
    torch.testing.assert_close(moved.double(), vertices / SCALE, atol=1e-5, rtol=0)


def test_box_is_around_the_joints_as_given_by_30_centimetres_and_a_hundredth_of_a_unit(avatar, person):
    frame = person.train[1]
    joints = pose_body(shape_body(person.body, person.betas), frame.pose, frame.translation).joints
    low = [min(joint[i] for joint in joints.tolist()) - 0.3 - 0.01 / SCALE for i in range(3)]
    high = [max(joint[i] for joint in joints.tolist()) + 0.3 + 0.01 / SCALE for i in range(3)]
    posed = in_training(avatar, person, 50)
    torch.testing.assert_close(posed.own.surface.box, torch.tensor([low, high]), atol=1e-6, rtol=0)
    moved = posed.body.joints.amin(0) - torch.tensor(low)
    assert (moved - 0.3 - 0.01 / SCALE).abs().max() > 0.003, "the pose was not corrected"


def literal_opacity(avatar, person, rays, training, seed):
    """Shading of one ray after the other in scene units, with the depths of the sampler run there as well."""
    matrices, vertices, _ = scene_matrices(avatar, person)
    table, beta = person.body.weights, avatar.beta.detach()
    posed = in_training(avatar, person, 0)

    def canonical(points):
        weights = weights_of(points.double(), vertices, table, 1)
        blended = torch.einsum("nb,bij->nij", weights, matrices)
        whole = torch.cat([points.double(), torch.ones(len(points), 1).double()], 1)
        return torch.linalg.solve(blended, whole[..., None])[:, :3, 0].float()

    def sdf(points):
        values = avatar.field.sdf(canonical(points), posed.own.condition)
        if training:
            return values
        away = torch.cdist(points.double(), vertices).amin(1)
        return torch.where(away > 0.1, 4.0, values)

    frame = person.train[1]
    joints = SCALE * pose_body(shape_body(person.body, person.betas), frame.pose, frame.translation).joints
    low, high = joints.amin(0) - 0.3 * SCALE - 0.01, joints.amax(0) + 0.3 * SCALE + 0.01
    kept, near, far = [], [], []
    directions = torch.where(rays.directions.abs() < 1e-5, 1e-5, rays.directions)
    for ray in range(len(rays)):
        hits = []
        for axis in range(3):
            for plane in (low[axis], high[axis]):
                depth = (plane - SCALE * rays.origins[ray, axis]) / directions[ray, axis]
                point = SCALE * rays.origins[ray] + depth * directions[ray]
                if (point >= low - 1e-6).all() and (point <= high + 1e-6).all():
                    hits.append(float(depth))
        if len(hits) == 2:
            kept.append(ray)
            near.append(min(hits))
            far.append(max(hits))
    seen = Rays(SCALE * rays.origins[kept], directions[kept], torch.tensor(near), torch.tensor(far))
    noise = torch.Generator().manual_seed(seed) if training else None
    with torch.no_grad():
        samples = METHOD.sampler.sample(seen, sdf, beta, noise, training)
        depth, delta = (t.unflatten(0, (len(kept), -1)) for t in (samples.depth, samples.delta))
        opacity = torch.zeros(len(rays))
        for row, ray in enumerate(kept):
            points = seen.origins[row] + depth[row][:, None] * seen.directions[row]
            values, passed = avatar.field.sdf(canonical(points), posed.own.condition), 1.0
            for s, length in zip(values.tolist(), delta[row].tolist(), strict=True):
                tail = 0.5 * math.exp(-abs(s) / float(beta))
                alpha = 1 - math.exp(-(tail if s > 0 else 1 - tail) / float(beta) * length)
                opacity[ray] += passed * alpha
                passed *= 1 - alpha
    return opacity, torch.tensor(kept), depth, delta


@pytest.mark.parametrize("training", [True, False])
def test_rays_are_sampled_and_shaded_in_scene_units(avatar, person, rays, training):
    opacity, kept, depth, delta = literal_opacity(avatar, person, rays, training, 5)
    assert 10 < len(kept) < len(rays)
    posed = in_training(avatar, person, 0)
    noise = torch.Generator().manual_seed(5) if training else None

    mode = at(0) if training else EVALUATION
    with torch.no_grad():
        placed = avatar.place(rays, posed, mode, noise)
        noise = torch.Generator().manual_seed(5) if training else None
        found = avatar.render(rays, posed, BLACK, mode, noise).opacity
    assert torch.equal(placed.samples.ray_index, kept.repeat_interleave(depth.shape[1]))
    torch.testing.assert_close(SCALE * placed.samples.depth, depth.flatten(), atol=2e-5, rtol=0)
    torch.testing.assert_close(SCALE * placed.samples.delta, delta.flatten(), atol=2e-5, rtol=0)
    torch.testing.assert_close(found, opacity, atol=1e-5, rtol=0)
    assert opacity.max() > 0.5
    assert float(depth.min()) == 0
    assert float((depth + delta).max()) == pytest.approx(6)


@pytest.mark.parametrize("recipe", [released, paper])
def test_density_scale_starts_at_the_programs_number(recipe, subject):
    method = replace(METHOD, beta=recipe().method.beta, beta_form=recipe().method.beta_form)
    avatar = method.build(subject)
    assert avatar.raw_beta.item() == pytest.approx(0.1, abs=1e-8)
    assert avatar.beta.item() == pytest.approx(0.1 + 1e-4, abs=1e-8)


def test_tiny_components_of_rays_are_replaced_before_anything_else(avatar, person, rays):
    frame = person.train[1]
    posed = avatar.pose(frame.pose, frame.translation)
    straight = F.normalize(torch.tensor([[0.0, -0.05, -1.0], [-9e-6, -0.1, -1.0]]), dim=-1)
    origins = torch.tensor([[0.03, -0.2, 2.5], [0.03, -0.2, 2.5]])
    given = Rays(origins, straight, torch.zeros(2), torch.full((2,), torch.inf))
    moved = torch.tensor([[1e-5 if abs(d) < 1e-5 else d for d in ray] for ray in straight.tolist()])
    with torch.no_grad():
        found = avatar.render(given, posed, BLACK)
        expected = avatar.render(Rays(origins, moved, given.near, given.far), posed, BLACK)
    assert torch.equal(found.color, expected.color)
    assert found.opacity.max() > 0.1


def test_bones_are_those_of_the_refined_shape_over_the_given_one(person):
    given, refined = (shape_body(person.body, person.betas + change) for change in (0.0, 0.4))
    frame = person.train[1]
    body = pose_body(refined, frame.pose, frame.translation, given.joints)
    canonical = pose_body(given, torch.zeros(24, 3), torch.zeros(3)).pose * 0
    canonical[1, 2], canonical[2, 2] = math.pi / 6, -math.pi / 6
    for bone in range(24):
        to_world = joint_transforms(refined.joints, frame.pose, frame.translation)[bone]
        back = rigid_inverse(joint_transforms(given.joints, canonical, torch.zeros(3))[bone])
        torch.testing.assert_close(body.bones[bone], to_world @ back)
