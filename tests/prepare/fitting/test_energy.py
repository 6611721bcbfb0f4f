"""What a fit makes small: right in its gradients, nothing at the truth, and blind to what does not matter."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from acting import (
    acted,
    evidence_of,
    joints_of,
    needs_anny,
    random_motion,
    silhouettes,
    standing_camera,
    the_body,
    with_numbers,
)

from twofold.body.skeleton import JOINT_NAMES
from twofold.geometry.cameras import project
from twofold.prepare.fitting.body_landmarks import body_points
from twofold.prepare.fitting.energy import (
    PriorWeights,
    direction_term,
    landmark_term,
    match_rims,
    outline_term,
    prior,
    project_all,
)
from twofold.prepare.fitting.observations import gather
from twofold.prepare.fitting.outlines import trace_outlines
from twofold.prepare.fitting.parameters import choose, pose_motion
from twofold.prepare.video.clips import longer

FREE = ("root", "pose", "translation", "betas", "marks", "log_focal", "log_distance")
MOMENTS = 4


class Scene:
    """A body with known motion before two cameras, in double precision."""

    def __init__(self):
        plain = the_body()
        truth = acted(plain, MOMENTS)
        evidence = [evidence_of(plain, truth, standing_camera(azimuth)) for azimuth in (0.3, 1.6)]
        outlines = [trace_outlines(e.masks) for e in evidence]
        self.body, self.truth, self.points = with_numbers(plain), with_numbers(truth), with_numbers(body_points(plain))
        self.outlines = [with_numbers(o) for o in outlines]
        self.seen = with_numbers(gather(evidence, outlines, None))
        self.skin = choose(self.body, torch.arange(0, len(plain.template), 5))
        self.everything = choose(self.body, torch.arange(len(plain.template)))

    def off_by(self, seed=0, size=0.1):
        """The truth with everything a little off."""
        generator = torch.Generator().manual_seed(seed)
        return replace(
            self.truth,
            **{
                name: value + size * (0.2 if name == "marks" else 1) * torch.randn(value.shape, generator=generator)
                for name, value in ((name, getattr(self.truth, name)) for name in FREE)
            },
        )

    def landmarks(self, motion, **changes):
        seen = replace(self.seen, **changes)
        return landmark_term(pose_motion(self.body, motion), self.points, motion, seen, 1.2)

    def directions(self, motion, **changes):
        seen = replace(self.seen, **changes)
        return direction_term(pose_motion(self.body, motion), self.points, motion, seen, 0.35)

    def prior(self, motion, fps=10.0, **weights):
        return prior(self.body, pose_motion(self.body, motion), motion, fps, PriorWeights(**weights))

    def outline(self, motion, matched=None, k=0):
        rims, weight = matched or match_rims(self.body, motion, self.seen, k, self.outlines[k], self.everything)
        posed = pose_motion(self.body, motion)
        return outline_term(posed, motion, self.seen, k, self.outlines[k], rims, weight.double(), self.skin, 1.0)


@pytest.fixture(scope="module")
def scene():
    return Scene()


@pytest.mark.parametrize("term", ["landmarks", "directions", "prior", "outline"])
def test_gradients_are_differences(scene, term):
    motion = scene.off_by(seed=3)
    function = getattr(scene, term)
    if term == "outline":
        matched = match_rims(scene.body, motion, scene.seen, 0, scene.outlines[0], scene.everything)
        function = lambda motion: scene.outline(motion, matched)  # noqa: E731
    live = replace(motion, **{name: getattr(motion, name).clone().requires_grad_() for name in FREE})
    function(live).backward()
    generator = torch.Generator().manual_seed(5)
    touched = []
    for name in FREE:
        value, slope = getattr(motion, name), getattr(live, name).grad
        step = 1e-6 * torch.randn(value.shape, generator=generator, dtype=torch.float64)
        ahead, behind = (function(replace(motion, **{name: value + sign * step})) for sign in (1, -1))
        found = 0.0 if slope is None else float((slope * step).sum()) * 2
        assert float(ahead - behind) == pytest.approx(found, rel=1e-3, abs=1e-10), name
        touched += [name] if found else []
    assert len(touched) >= 5


def test_projections_are_the_cameras(scene):
    camera = standing_camera(0.3)
    points = torch.randn(3, 7, 3, generator=torch.Generator().manual_seed(0))
    for log_focal in (0.0, 0.2):
        own = project_all(points, camera.world_to_camera, camera.intrinsics, torch.tensor(log_focal))
        torch.testing.assert_close(own, project(longer(camera, float(np.exp(log_focal))), points)[0])
    behind = project_all(points - 100, camera.world_to_camera, camera.intrinsics, torch.tensor(0.0))
    assert behind.isfinite().all()


def test_the_truth_costs_nothing(scene):
    assert float(scene.landmarks(scene.truth)) < 1e-6
    assert float(scene.directions(scene.truth)) < 1e-6
    off = scene.off_by()
    assert float(scene.landmarks(off)) > 0.1
    assert float(scene.directions(off)) > 0.01


def test_what_is_unknown_does_not_count(scene):
    off = scene.off_by()
    weight, pixels = scene.seen.weight.clone(), scene.seen.pixels.clone()
    weight[:, 1, 4:9] = 0
    before = scene.landmarks(off, weight=weight)
    pixels[:, 1, 4:9] += 1000
    torch.testing.assert_close(scene.landmarks(off, weight=weight, pixels=pixels), before)
    known, space = scene.seen.space_weight.clone(), scene.seen.space.clone()
    known[:, 2, 13] = 0
    before = scene.directions(off, space_weight=known)
    space[:, 2, 13] = 50
    torch.testing.assert_close(scene.directions(off, space_weight=known, space=space), before)


def test_one_wild_landmark_costs_little(scene):
    pixels = scene.seen.pixels.clone()
    pixels[0, 1, 15] += 1e5
    wild = scene.landmarks(scene.truth, pixels=pixels)
    assert float(wild) <= 1.2 * float(scene.seen.weight[0, 1, 15]) / MOMENTS + 1e-6


def test_errors_count_by_the_size_of_the_person_in_the_image(scene):
    off = scene.off_by()
    double = {"pixels": 2 * scene.seen.pixels, "size": 2 * scene.seen.size}
    intrinsics = scene.seen.intrinsics.clone()
    intrinsics[:, :2] *= 2
    torch.testing.assert_close(scene.landmarks(off, **double, intrinsics=intrinsics), scene.landmarks(off))


def test_directions_know_no_lengths(scene):
    off = scene.off_by()
    torch.testing.assert_close(scene.directions(off, space=3 * scene.seen.space), scene.directions(off))


@pytest.mark.parametrize("name", ["sausages", pytest.param("anny", marks=needs_anny)])
@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize(("joint", "end", "natural"), [("knee", "ankle", -1), ("elbow", "wrist", 1)])
def test_joints_bend_one_way_only(name, side, joint, end, natural):
    """The heel goes backwards, the hand forwards: whatever does the opposite costs."""
    body = the_body(name)
    index, tip = JOINT_NAMES.index(f"{side}_{joint}"), JOINT_NAMES.index(f"{side}_{end}")
    motion = acted(body, 1, betas=0.0)
    costs = {}
    for angle in (-0.8, 0.0, 0.8):
        pose = torch.zeros_like(motion.pose)
        pose[0, index - 1, 0 if joint == "knee" else 1] = angle
        bent = replace(motion, pose=pose)
        cost = prior(body, pose_motion(body, bent), bent, 10.0, PriorWeights())
        usual = float(cost - 0.05 * (pose / 1.2).square().sum())  # the spread of everyday poses is another matter
        costs[angle] = usual, float(joints_of(body, bent)[0, tip, 2])
    still = costs.pop(0.0)
    (right, there), (wrong, elsewhere) = sorted(costs.values())
    assert right == pytest.approx(still[0], abs=1e-5)
    assert wrong > still[0] + 1
    assert natural * (there - still[1]) > 0.1
    assert natural * (elsewhere - still[1]) < -0.1


@pytest.mark.parametrize(("joint", "axis", "sign"), [("left_knee", 0, 1), ("right_elbow", 1, 1), ("left_elbow", 1, -1)])
def test_no_joint_folds_through_itself(scene, joint, axis, sign):
    def cost(angle):
        pose = torch.zeros_like(scene.truth.pose)
        pose[:, JOINT_NAMES.index(joint) - 1, axis] = sign * angle
        usual = 0.05 * float((pose / 1.2).square().sum((1, 2)).mean())
        return float(scene.prior(replace(scene.truth, pose=pose), smoothness=0.0)) - usual

    assert cost(2.5) == pytest.approx(cost(0.0), abs=1e-6)
    assert cost(3.1) > cost(0.0) + 2


def test_sideways_knees_and_twisted_elbows_cost(scene):
    def cost(joint, turn):
        pose = torch.zeros_like(scene.truth.pose)
        pose[:, JOINT_NAMES.index(joint) - 1] = torch.tensor(turn).double()
        usual = 0.05 * float((pose / 1.2).square().sum((1, 2)).mean())
        return float(scene.prior(replace(scene.truth, pose=pose), smoothness=0.0)) - usual

    for turn in ((0, 0.5, 0), (0, 0, 0.5), (0, -0.5, 0)):
        assert cost("left_knee", turn) > cost("left_knee", (0, 0, 0)) + 1
    assert cost("right_elbow", (0, 0, 0.8)) > cost("right_elbow", (0, 0, 0)) + 1


def smoothness(body, motion, fps):
    """What the prior takes for unrest."""
    costs = [prior(body, pose_motion(body, motion), motion, fps, PriorWeights(smoothness=s)) for s in (5.0, 0.0)]
    return float(costs[0] - costs[1])


def test_a_steady_walk_seen_at_uneven_times_is_no_unrest():
    body = with_numbers(the_body())
    still = with_numbers(replace(random_motion(the_body(), 6), betas=torch.zeros(1)))
    seconds = torch.tensor([0.0, 0.1, 0.2, 0.25, 0.55, 0.6]).double()
    level = still.guess[:1].expand(6, 3, 3), still.root[:1].expand(6, 3), still.pose[:1].expand(6, 23, 3)
    path = torch.tensor([1.4, 0.0, 0.0]).double() * seconds[:, None]
    walk = replace(still, guess=level[0], root=level[1], pose=level[2], translation=still.translation[:1] + path)
    posed, weights = pose_motion(body, walk), PriorWeights(smoothness=5.0)
    costs = [float(prior(body, posed, walk, 10.0, weights, None, times)) for times in (None, seconds)]
    calm = float(prior(body, posed, walk, 10.0, PriorWeights(smoothness=0.0)))
    assert costs[1] == pytest.approx(calm, abs=1e-6)
    assert costs[0] > calm + 0.1


def test_small_bodies_are_not_favoured():
    """A guess about motion must not be won by shrinking the person."""
    body = with_numbers(the_body())
    motion = with_numbers(replace(random_motion(the_body(), 6), log_distance=torch.zeros(()), betas=torch.zeros(1)))
    large = replace(body, template=1.5 * body.template, joints=1.5 * body.joints)
    there = replace(motion, translation=1.5 * motion.translation)
    small = smoothness(body, motion, 25.0)
    assert small > 1
    assert smoothness(large, there, 25.0) == pytest.approx(small, rel=1e-6)
    # By its shape as well.
    grown = replace(motion, betas=torch.tensor([5.0]).double(), translation=1.5 * motion.translation)
    assert smoothness(body, grown, 25.0) == pytest.approx(small, rel=1e-6)


@pytest.mark.parametrize("fps", [60.0, 120.0])
def test_unrest_of_a_second_is_the_same_however_often_one_looks(fps):
    body = the_body()
    costs = []
    for rate in (30.0, fps):
        motion = acted(body, round(2 * rate), rate)
        costs.append(smoothness(body, motion, rate) * len(motion))
    assert costs[0] > 1e-3
    assert costs[1] == pytest.approx(costs[0], rel=0.1)


def test_even_motion_is_free_and_short_clips_have_none(scene):
    still = replace(
        scene.truth, guess=scene.truth.guess[:1].expand(4, 3, 3), pose=scene.truth.pose[:1].expand(4, 23, 3)
    )
    along = replace(still, translation=torch.arange(4).double()[:, None] * torch.tensor([0.3, 0.1, 0.2]).double())
    assert smoothness(scene.body, along, 10.0) == pytest.approx(0, abs=1e-9)
    assert smoothness(scene.body, scene.truth, 10.0) > 0.01
    for count in (1, 2):
        assert smoothness(scene.body, scene.truth[:count], 10.0) == 0


def test_unlikely_people_cost(scene):
    start = float(scene.prior(scene.truth))
    assert float(scene.prior(replace(scene.truth, betas=scene.truth.betas + 2))) > start
    assert float(scene.prior(replace(scene.truth, marks=scene.truth.marks + 0.05))) > start + 1
    focal = float(scene.prior(replace(scene.truth, log_focal=torch.tensor(0.3).double()))) - start
    assert focal == pytest.approx(4)
    hand = scene.truth.pose.clone()
    hand[:, JOINT_NAMES.index("left_hand") - 1] += 0.2
    assert float(scene.prior(replace(scene.truth, pose=hand), smoothness=0.0)) > start + 0.5


@pytest.mark.parametrize("k", [0, 1])
def test_rims_are_found_at_the_outline(scene, k):
    rims, weight = match_rims(scene.body, scene.truth, scene.seen, k, scene.outlines[k], scene.everything)
    posed = pose_motion(scene.body, scene.truth)
    shown = project_all(
        posed.place(rims), scene.seen.world_to_camera[k], scene.seen.intrinsics[k], scene.truth.log_focal
    )
    away = (shown - scene.outlines[k].points).norm(dim=-1) / scene.seen.size[k]
    assert weight.mean() > 0.9
    # About as far as vertices are apart (6 cm of 1.7 m).
    assert away[weight > 0].mean() < 0.025
    assert away[weight > 0].quantile(0.9) < 0.05


def test_the_outline_pulls_the_body_back(scene):
    at_home = float(scene.outline(scene.truth))
    for shift in ([0.06, 0.0, 0.0], [0.0, -0.06, 0.0], [0.05, 0.05, 0.0]):
        aside = torch.tensor(shift).double() @ scene.seen.world_to_camera[0, :3, :3]
        off = replace(scene.truth, translation=(scene.truth.translation + aside).requires_grad_())
        cost = scene.outline(off)
        assert float(cost.detach()) > at_home + 0.2
        cost.backward()
        assert ((off.translation.grad * aside).sum(-1) > 0).all()


def test_frames_without_a_mask_are_left_alone(scene):
    plain = the_body()
    masks = silhouettes(plain, acted(plain, MOMENTS), standing_camera(0.3))
    masks[2] = np.zeros_like(masks[2])
    outlines = with_numbers(trace_outlines(masks))
    off = replace(scene.off_by(), translation=scene.truth.translation.clone().requires_grad_())
    rims, weight = match_rims(scene.body, off, scene.seen, 0, outlines, scene.everything)
    assert not weight[2].any()
    posed = pose_motion(scene.body, off)
    outline_term(posed, off, scene.seen, 0, outlines, rims, weight.double(), scene.skin, 1.0).backward()
    assert not off.translation.grad[2].any()
    assert off.translation.grad[[0, 1, 3]].any()


def test_a_body_behind_the_camera_gives_numbers(scene):
    behind = replace(scene.truth, translation=scene.truth.translation + torch.tensor([0.0, 0, 20]).double())
    assert scene.outline(behind).isfinite()
    assert scene.landmarks(behind).isfinite()
