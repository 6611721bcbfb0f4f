"""Unobserved regions of an avatar take on what was observed elsewhere."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from small_recipes import CASES
from tiny_person import completing_recipe, tiny_recipe

from twofold.capture.coverage import coverage_of, mean_facing
from twofold.errors import TwofoldError
from twofold.field.output import FieldOutput
from twofold.field.surface_fill import LEGS, TRUNK
from twofold.methods.base import Mode
from twofold.methods.completion import Completion, CompletionConfig
from twofold.methods.factorized_recipes import fast, paper, quick, released
from twofold.methods.skinned_config import COMPLETING
from twofold.methods.subject import Subject
from twofold.methods.table import RECIPES, with_completion
from twofold.training.loop import train
from twofold.training.run import load, load_state, read_coverage, write_checkpoint

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def runs(person, tmp_path_factory):
    """The tiny person trained with completion and without; the avatars by that."""
    folder = tmp_path_factory.mktemp("completion")
    recipes = {True: completing_recipe(20), False: tiny_recipe(20)}
    return {on: train(person, recipe, folder / str(on), CPU) for on, recipe in recipes.items()}


def not_outlining(method):
    """The method with its shape completed where no image shows it alone."""
    return replace(method, completion=replace(method.completion, outlines=0.0))


def prepared(person, change=lambda method: method):
    """An untrained avatar whose completion has taken on the person's coverage."""
    avatar = change(completing_recipe(1).method).build(Subject.of(person))
    avatar.completion.prepare(coverage_of(person), mean_facing(person))
    return avatar


def striped(completion, slope, change=0.2):
    """Its colours at all samples, and a field 1 cm outside the body with them; nonsense where nothing was observed.

    Stripes go around the body, and all is brighter towards the cameras; half as much so where it is turned away.
    """
    on = completion._on_surface()
    height, facing = on.fill.samples.at(on.fill.rest)[:, 1], on.fill.facing
    stripes = 0.3 + change * (height / 0.1 % 1 < 0.5)
    color = torch.from_numpy(stripes * np.exp(slope * np.where(facing < 0, facing / 2, facing))).float()
    seen = torch.from_numpy(on.fill.weight > 0)

    def answer(x, vertex):
        away = ((x - on.points) * on.normals).sum(-1)
        shown = torch.where(seen, color, 0.9)[:, None].expand(-1, 3)
        return FieldOutput(torch.where(seen, away - 0.01, away + 0.03), shown, None)

    return color, answer


def test_stripes_and_brightness_go_on_where_nothing_was_observed(person):
    completion = prepared(person).completion
    on = completion._on_surface()
    expected, answer = striped(completion, 0.2)
    completion.refresh(answer, torch.ones(len(on.points), 3))
    unseen = torch.from_numpy((on.fill.weight == 0) & np.isin(on.fill.group, (TRUNK, LEGS)) & (on.fill.facing < -0.3))
    assert unseen.sum() > 500
    assert (completion.target[:, 0] - expected)[unseen].abs().mean() < 0.04
    assert abs(float(completion.target[unseen].mean() - expected[unseen].mean())) < 0.02
    assert (completion.offset[unseen] - 0.01).abs().mean() < 0.003


def test_what_a_law_of_light_adds_is_taken_out_of_the_targets(person):
    completion = prepared(person).completion
    on = completion._on_surface()
    light = torch.full((len(on.points), 3), 1.25)
    completion.refresh(striped(completion, 0.0)[1], light)
    unseen = torch.from_numpy(on.fill.weight == 0)
    assert abs(float(completion.target[unseen].mean()) - 0.4) < 0.03


def test_the_field_is_pulled_to_the_targets_in_every_pose(person, generator):
    avatar = prepared(person)
    completion = avatar.completion
    on = completion._on_surface()
    completion.refresh(striped(completion, 0.2, 0.0)[1], torch.ones(len(on.points), 3))
    optimizer = torch.optim.Adam(avatar.field.parameters(), 1e-2)
    poses = [avatar.pose(frame.pose, frame.translation) for frame in person.train[:2]]
    at = on.points + completion.offset[:, None] * on.normals
    unseen = torch.from_numpy(on.fill.weight == 0)
    errors = []
    for step in range(61):
        if step in (0, 60):
            with torch.no_grad():
                answers = [avatar.answer_beside(at, on.nearest, posed) for posed in poses]
            colors = [(answer.color - completion.target)[unseen].abs().mean() for answer in answers]
            errors.append((*colors, *(answer.sdf[unseen].abs().mean() for answer in answers)))
        condition = poses[step % 2].own.condition
        terms = completion.terms(lambda x, v, c=condition: avatar.field.unlit(x, c), 10, generator)
        optimizer.zero_grad()
        sum(terms.values()).backward()
        optimizer.step()
    for before, after, share in zip(*errors, (0.35, 0.35, 0.85, 0.85), strict=True):
        assert after < share * before


def test_only_features_learn_from_completion(person, generator):
    """Networks that learned what was observed would forget a little of it."""
    avatar = prepared(person)
    posed = avatar.pose(person.train[0].pose, person.train[0].translation)
    terms = avatar.completion.terms(lambda x, v: avatar.answer_beside(x, v, posed), 1000, generator)
    sum(terms.values()).backward()
    learning = {name for name, p in avatar.field.named_parameters() if p.grad is not None and p.grad.any()}
    assert learning == {"low_grid.table", "high_grid.table"}
    assert all(p.requires_grad for p in avatar.field.parameters())


def test_a_stored_avatar_is_the_same_again(runs, person, tmp_path):
    from twofold.training.run import read_recipe, start_folder

    avatar = runs[True]
    recipe = replace(completing_recipe(20), name="again")
    start_folder(tmp_path / "run", recipe, avatar.subject, person.folder, coverage=coverage_of(person))
    optimizer = torch.optim.Adam([torch.nn.Parameter(torch.zeros(1))])
    write_checkpoint(tmp_path / "run", avatar, optimizer, 20)
    again, _ = load(tmp_path / "run")
    assert read_recipe(tmp_path / "run").method.completion.active
    x = avatar.canonical_points
    posed, twin = (a.pose(person.train[0].pose, person.train[0].translation) for a in (avatar, again))
    with torch.no_grad():
        assert torch.equal(avatar.query(x, posed).color, again.query(x, twin).color)
    assert torch.equal(read_coverage(tmp_path / "run", person).weight, coverage_of(person).weight)


def test_a_checkpoint_of_a_run_without_completion_still_loads(runs, person, tmp_path):
    avatar = runs[False]
    assert not any("completion" in name or "observed" in name for name in avatar.state_dict())
    fresh = tiny_recipe(20).method.build(Subject.of(person))
    load_state(fresh, {name: t.clone() for name, t in avatar.state_dict().items()}, tmp_path)


def test_releases_and_the_paper_complete_nothing_and_the_quick_recipe_does():
    assert [recipe().method.completion.active for recipe in (quick, released, paper)] == [True, False, False]
    assert with_completion(fast(), on=True).method.completion == COMPLETING
    assert with_completion(quick(), on=False).method.completion == CompletionConfig()


@pytest.mark.parametrize("name", ["humannerf_fast", "npc_fast", "danbo_fast", "pm_avatar_fast", "monohuman_fast"])
def test_methods_that_cannot_complete_say_so(name):
    recipe = RECIPES[name]()
    assert with_completion(recipe, on=False) == recipe
    with pytest.raises(TwofoldError, match="does not complete unobserved regions"):
        with_completion(recipe, on=True)


@pytest.mark.parametrize("name", ["fast", "vid2avatar_mask_fast"])
def test_dense_networks_are_pulled_to_the_targets_too(name, person, generator):
    recipe = with_completion(CASES[name], on=True)
    config = replace(recipe.method.completion, start=0, points=32)
    avatar = replace(recipe.method, completion=config).build(Subject.of(person))
    avatar.prepare_training(person, 0, generator)
    avatar.before_step(Mode(step=0))
    frame = person.train[0]
    posed = avatar.pose(frame.pose, frame.translation, frame.frame_index, Mode(step=0))
    completion = avatar.completion
    answers = []

    def record(x, vertex):
        answers.append((x, vertex))
        return avatar.answer_beside(x, vertex, posed)

    terms = completion.terms(record, 0, generator)
    assert set(terms) == {"completion_color", "completion_shape"}
    sum(terms.values()).backward()
    assert any(p.grad is not None and p.grad.any() for p in avatar.field.parameters())
    ((x, vertex),) = answers
    # First those of the colour, then those of the shape.
    points = completion.config.points
    assert (completion.weight[vertex[:points]] < 1).all()
    assert (completion.weight[vertex[points:]] < 1).all()
    on = completion._on_surface()
    nearest = (x[:, None] - on.points).norm(dim=-1).argmin(1)
    along = ((x - on.points[nearest]) * on.normals[nearest]).sum(-1) - completion.offset[nearest]
    assert along.min() < 0.0
    assert along.max() > 0.03


def test_a_person_seen_from_all_sides_has_no_terms(generator):
    shaped = tiny_shape()
    completion = Completion(COMPLETING, shaped, shaped.vertices)
    assert completion.terms(lambda x, v: pytest.fail("asked"), 1000, generator) == {}


def tiny_shape():
    from tiny_person import person_body

    from twofold.body.skeleton import shape_body

    return shape_body(person_body(), torch.zeros(1))


def test_a_subject_that_is_nearly_all_observed_is_left_alone(person):
    shaped = Subject.of(person)
    avatar = completing_recipe(1).method.build(shaped)
    coverage, completion = coverage_of(person), avatar.completion
    for share, left_alone in ((0.95, True), (0.8, False)):
        order = coverage.area.cumsum(0) / coverage.area.sum()
        known = (order <= share).float()
        completion.prepare(replace(coverage, weight=known, outline=known), torch.zeros(len(order)))
        assert (completion.unobserved == 0) == left_alone
        assert bool((completion.weight == 1).all()) == left_alone
        assert completion.is_due(completion.config.start) != left_alone


def test_the_shape_of_what_was_seen_from_the_front_only_is_completed_from_the_outlines(person):
    """A front that bulges, as it may before one camera, where outlines say that the surface is 1 cm from the body."""
    completion = prepared(person).completion
    on = completion._on_surface()
    placed = torch.from_numpy(on.shape_fill.weight)
    on_outline = placed > 0
    assert 0.1 < on_outline.float().mean() < 0.9
    ahead = (placed == 0) & torch.from_numpy((on.fill.weight > 0.8) & np.isin(on.fill.group, (TRUNK, LEGS)))
    assert ahead.sum() > 300

    def answer(x, vertex):
        away = ((x - on.points) * on.normals).sum(-1)
        return FieldOutput(torch.where(on_outline, away - 0.01, away - 0.05), torch.full((len(x), 3), 0.5), None)

    completion.refresh(answer, torch.ones(len(on.points), 3))
    assert (completion.offset[ahead] - 0.01).abs().mean() < 0.004


def test_shape_is_completed_where_all_colours_were_observed_but_outlines_lack(person, generator):
    avatar = completing_recipe(1).method.build(Subject.of(person))
    coverage, completion = coverage_of(person), avatar.completion
    ones = torch.ones_like(coverage.weight)
    completion.prepare(replace(coverage, weight=ones), torch.zeros_like(ones))
    assert completion.unobserved == 0
    assert completion.unplaced > 0.1
    assert completion.is_due(completion.config.start)
    posed = avatar.pose(person.train[0].pose, person.train[0].translation)
    terms = completion.terms(lambda x, v: avatar.answer_beside(x, v, posed), 1000, generator)
    assert set(terms) == {"completion_shape"}


def test_a_share_too_small_for_targets_has_no_terms(person, generator):
    """Else the field would be pulled to targets that were never taken."""
    avatar = completing_recipe(1).method.build(Subject.of(person))
    completion = avatar.completion
    completion.prepare(coverage_of(person), torch.zeros(len(completion.weight)))
    for known in (completion.weight, completion.placed):
        known.fill_(1)
        # The vertex with the largest area below a thousandth of the whole.
        part = completion.area / completion.area.sum()
        known[torch.where(part < 9e-4, part, 0).argmax()] = 0
    assert 0 < completion.unobserved < 1e-3
    assert not completion.is_due(completion.config.start)
    assert completion.terms(lambda x, v: pytest.fail("queried"), 1000, generator) == {}


def test_without_that_setting_outlines_change_nothing(person):
    completion = prepared(person, not_outlining).completion
    on = completion._on_surface()
    assert on.shape_fill is on.fill
    assert torch.equal(on.shape_ends, on.ends)
    assert completion.unplaced == completion.unobserved
    assert prepared(person).completion.unplaced > completion.unobserved


def test_runs_of_before_complete_the_shape_where_they_complete_the_colours(person):
    completion = prepared(person).completion
    state = {f"completion.{name}": tensor for name, tensor in completion.state_dict().items() if name != "placed"}
    completion.take_on(state, "completion.")
    assert torch.equal(state["completion.placed"], completion.weight)
