import numpy as np
import pytest
import torch

from twofold.body.skeleton import canonical_pose, pose_body, shape_body
from twofold.geometry.surfaces import face_areas, point_to_mesh
from twofold.studio.anatomy import arm_reach, bearing, leg_reach, survey
from twofold.studio.appearance import HAIRS, SHIRTS, sample_look
from twofold.studio.clothing import HAIR, SHIRT, SHOES, SKIN, SOLES, TROUSERS, dress
from twofold.studio.figure import build_figure
from twofold.studio.texture import linear, paint
from twofold.studio.wrinkles import bending, displacement, lay_folds

pytest.importorskip("anny")


@pytest.fixture(scope="module")
def shaped():
    from twofold.body.anny import anny_body

    return shape_body(anny_body(), torch.tensor([0.5, -0.5, 0.3]))


@pytest.fixture(scope="module")
def look():
    # Long sleeves and trousers, so that there is cloth at every joint.
    return sample_look(3)


@pytest.fixture(scope="module")
def figure(shaped, look):
    return build_figure(shaped, look)


@pytest.fixture(scope="module")
def folds(figure):
    return lay_folds(figure, 3)


def bent(joint, *angles):
    pose = np.zeros((24, 3))
    pose[joint] = angles
    return pose


def test_the_outer_surface_is_one_closed_piece_facing_outward(figure):
    f = figure.faces
    edges = np.concatenate([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]])
    forward = np.sort(edges[:, 0] * len(figure.vertices) + edges[:, 1])
    backward = np.sort(edges[:, 1] * len(figure.vertices) + edges[:, 0])
    assert (np.diff(forward) > 0).all()
    assert (forward == backward).all()
    assert len(np.unique(f)) == len(figure.vertices)
    a, b, c = figure.vertices[f].astype(np.float64).transpose(1, 0, 2)
    litres = (np.cross(a, b) * c).sum() / 6 * 1000
    assert 50 < litres < 130


def test_triangles_are_small_enough_for_wrinkles(figure):
    areas = face_areas(torch.from_numpy(figure.vertices), torch.from_numpy(figure.faces)).numpy()
    assert np.sqrt(areas.max()) < 0.008
    assert 60_000 < len(figure.vertices) < 200_000


def test_weights_are_shares_of_at_most_four_joints(figure):
    assert figure.weights.shape == (len(figure.vertices), 24)
    assert np.allclose(np.asarray(figure.weights.sum(1)), 1, atol=1e-5)
    assert figure.weights.data.min() > 0
    assert np.diff(figure.weights.indptr).max() <= 4


def test_every_layer_is_worn_where_it_belongs(figure):
    layer, p, a = figure.layers.argmin(1), figure.rest, figure.anatomy
    assert set(np.unique(layer)) == {SKIN, SHIRT, TROUSERS, SHOES, SOLES, HAIR}
    joints = a.joints
    assert p[layer == HAIR, 1].min() > joints[9, 1]
    assert p[layer == SOLES, 1].max() < a.floor + 0.03
    assert p[layer == SHOES, 1].max() < joints[7, 1] + 0.08
    assert (p[layer == SHIRT, 1].min() > a.crotch - 0.01) & (p[layer == SHIRT, 1].max() < joints[15, 1])
    assert p[layer == TROUSERS, 1].max() < joints[6, 1]
    hands = np.abs(p[:, 0]) > abs(joints[20, 0])
    assert (layer[hands] == SKIN).all()
    face = (np.abs(p - a.eyes.mean(0)) < 0.03).all(1)
    assert (layer[face] == SKIN).all()


def test_cloth_stands_off_the_skin_and_bare_skin_lies_on_it(figure, shaped):
    body = pose_body(shaped, canonical_pose(), torch.zeros(3))
    chosen = np.random.default_rng(0).permutation(len(figure.vertices))[:3000]
    distance = point_to_mesh(torch.from_numpy(figure.vertices[chosen]), body.canonical_vertices, body.faces)[0].numpy()
    layer = figure.layers.argmin(1)[chosen]
    torso = (np.abs(figure.rest[chosen, 0]) < 0.12) & (figure.rest[chosen, 1] > figure.anatomy.joints[3, 1])
    # Ears, lips and the webs of the fingers are a little rounder than the body's.
    assert np.median(distance[layer == SKIN]) < 0.001
    assert np.percentile(distance[layer == SKIN], 85) < 0.004
    assert np.percentile(distance[(layer == SHIRT) & torso], 5) > 0.004
    assert np.percentile(distance[layer == SHIRT], 95) < 0.045
    assert 0.004 < np.median(distance[layer == TROUSERS]) < 0.03


def test_the_t_pose_of_a_vertex_is_where_its_weights_carry_it(figure, shaped):
    body = pose_body(shaped, torch.zeros(24, 3), torch.zeros(3))
    from twofold.studio.generate import skin_sparsely

    carried = skin_sparsely(figure.vertices, figure.weights, body.bones.numpy())
    # Near the hips the two blend differently; patterns may slip there by a little.
    away = np.linalg.norm(carried - figure.rest, axis=1)
    assert np.median(away) < 0.002
    assert np.percentile(away, 99) < 0.03


def test_reach_counts_joints_along_the_limbs(figure):
    j, a = figure.anatomy.joints, figure.anatomy
    assert arm_reach(j[[16, 18, 20, 17, 19, 21]], a) == pytest.approx([0, 1, 2, 0, 1, 2], abs=0.05)
    assert leg_reach(j[[1, 4, 7]], a) == pytest.approx([0, 1, 2], abs=0.05)


def test_bearings_round_alike_wherever_their_memory_lies():
    # Results soon come to lie right behind their table, where NumPy alone rounds otherwise (with AVX-512).
    table = np.random.default_rng(0).normal(size=(5002, 3)).astype(np.float32)
    first, kept = bearing(table[:, 0].copy(), table[:, 2].copy()), []
    for _ in range(100):
        again = table.copy()
        kept += [again, bearing(again[:, 0], again[:, 2])]
        assert np.array_equal(kept[-1], first)
    np.testing.assert_allclose(first, np.angle(table[:, 2] + 1j * table[:, 0]), atol=1e-6)


def test_eyes_lie_in_the_head_left_on_the_left(shaped):
    a = survey(shaped)
    assert a.eyes[0, 0] > 0.02
    assert a.eyes[1, 0] < -0.02
    assert (a.eyes[:, 1] > a.joints[15, 1] - 0.05).all()
    assert 0.05 < a.spread < 0.08
    assert 0.03 < a.neck < 0.09


def test_folds_are_two_to_four_centimetres_from_crest_to_crest(figure, folds):
    edges = np.concatenate([figure.faces[:, [0, 1]], figure.faces[:, [1, 2]]])
    for fold in folds:
        phase = np.full(len(figure.vertices), np.nan)
        phase[fold.vertices] = fold.phase
        jump = np.abs(phase[edges[:, 0]] - phase[edges[:, 1]])
        length = np.linalg.norm(figure.rest[edges[:, 0]] - figure.rest[edges[:, 1]], axis=1)
        # The steepest edges run across the folds.
        slope = (jump / length)[np.isfinite(jump) & (length > 0.002) & (jump < 3)]
        assert 0.012 < 2 * np.pi / np.percentile(slope, 97) < 0.045


@pytest.mark.parametrize(
    ("joint", "angles", "near"),
    [(18, (0, -1.4, 0), 18), (19, (0, 1.4, 0), 19), (4, (1.3, 0, 0), 4), (6, (0.5, 0, 0), 3), (6, (0, 0, -0.4), 3)],
)
def test_folds_come_with_bending_near_the_bent_joint(figure, folds, joint, angles, near):
    count = len(figure.vertices)
    straight = displacement(folds, bent(joint, 0, 0, 0), count)
    change = displacement(folds, bent(joint, *angles), count) - straight
    distance = np.linalg.norm(figure.rest - figure.anatomy.joints[near], axis=1)
    assert 0.002 < np.abs(change).max() < 0.02
    moved = np.abs(change) > 0.002
    assert distance[moved].max() < 0.35
    a_little_bent = displacement(folds, bent(joint, *(0.2 * np.array(angles))), count) - straight
    assert np.abs(a_little_bent).sum() < 0.5 * np.abs(change).sum()


def test_only_cloth_wrinkles(figure, folds):
    pose = np.random.default_rng(0).normal(0, 0.5, (24, 3))
    moved = displacement(folds, pose, len(figure.vertices)) != 0
    assert np.isin(figure.layers.argmin(1)[moved], (SHIRT, TROUSERS)).all()


def test_wrinkles_are_at_most_about_a_centimetre(figure, folds):
    for seed in range(5):
        moved = displacement(folds, np.random.default_rng(seed).normal(0, 1, (24, 3)), len(figure.vertices))
        assert moved.max() <= 0.011
        assert moved.min() >= -0.008


def test_bending_is_measured_for_each_side_and_direction():
    def raised(joint, *angles):
        return set(np.nonzero(bending(bent(joint, *angles)) - bending(np.zeros((24, 3))) > 0.05)[0])

    assert raised(18, 0, -1, 0) == {0}
    assert raised(19, 0, 1, 0) == {4}
    assert raised(16, 0, 0, -1.2) == {1}
    assert raised(17, 0, 0, 1.2) == {5}
    assert raised(4, 1, 0, 0) == {8}
    assert raised(2, -1, 0, 0) == {11}
    assert raised(6, 0.4, 0, 0) == {12}
    assert raised(6, 0, 0.4, 0) == {16}


def test_seeds_differ_in_what_they_wear():
    looks = [sample_look(seed) for seed in range(10)]
    assert len(set(looks)) == 10
    assert {look.shirt for look in looks} == set(SHIRTS)
    assert len({look.hair for look in looks}) >= 4
    assert {look.hair for look in map(sample_look, range(40))} == set(HAIRS)
    assert sample_look(4) == sample_look(4)


def test_each_layer_is_painted_in_its_own_colours(figure, look):
    layer = figure.layers.argmin(1)
    painted = paint(figure.rest, layer, figure.anatomy, look)
    assert np.isfinite(painted.color).all()
    assert painted.color.min() >= 0
    assert painted.color.max() <= 1
    for which, color in ((SHOES, look.shoe_color), (TROUSERS, look.trouser_color)):
        assert np.abs(np.median(painted.color[layer == which], 0) - linear(color)).max() < 0.12
    assert painted.gloss[layer == SKIN].min() > 0
    assert painted.gloss[layer == SHIRT].max() == 0


@pytest.mark.parametrize("shirt", SHIRTS)
@pytest.mark.parametrize("hair", HAIRS)
def test_every_pattern_and_every_hair_can_be_worn(figure, look, shirt, hair):
    import dataclasses

    other = dataclasses.replace(look, shirt=shirt, hair=hair, sleeve=0.6, trouser=0.85, beard=True)
    points = figure.rest[::50]
    smooth = [figure.layers[::50, 0]] * 3
    layers = dress(points, smooth, figure.anatomy, other)
    assert np.isfinite(layers).all()
    painted = paint(points, layers.argmin(1), figure.anatomy, other)
    assert np.isfinite(painted.color).all()


def test_a_pattern_has_two_colours_on_the_chest(figure, look):
    import dataclasses

    chest = figure.anatomy.joints[9] + np.array([0, 0, 0.1])
    g = np.random.default_rng(0).uniform([-0.1, -0.1, 0], [0.1, 0.1, 0], (4000, 3))
    points, layer = (chest + g).astype(np.float32), np.full(4000, SHIRT)
    for shirt in SHIRTS:
        color = paint(points, layer, figure.anatomy, dataclasses.replace(look, shirt=shirt)).color
        assert color.std(0).max() > 0.02
