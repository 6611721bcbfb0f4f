"""Unobserved regions of an avatar take on what was observed elsewhere."""

from dataclasses import replace

import pytest
import torch
from small_recipes import CASES
from tiny_person import completing_recipe, person_colors, tiny_recipe

from twofold.capture.coverage import coverage_of
from twofold.errors import TwofoldError
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
    recipes = {True: completing_recipe(150), False: tiny_recipe(150)}
    return {on: train(person, recipe, folder / str(on), CPU) for on, recipe in recipes.items()}


def unlit_on_surface(avatar, person, pose):
    """Colours at the canonical vertices in a pose, without light: of the whole and of the base branch."""
    posed = avatar.pose(pose, person.train[0].translation)
    with torch.no_grad():
        return avatar.query(avatar.canonical_points, posed, lit=False)


def test_colours_nobody_saw_are_nearer_to_the_truth(runs, person):
    """Of the channel that is the same all around the body; one that is not is beyond what can be known."""
    unseen = coverage_of(person).weight < 0.05
    truth = person_colors(person.body)[:, 0]
    assert unseen.float().mean() > 0.2
    for branch in ("full", "base"):
        errors = {}
        for on, avatar in runs.items():
            answer = unlit_on_surface(avatar, person, person.train[0].pose)
            color = (answer if branch == "full" else answer.base).color[:, 0]
            errors[on] = (color - truth)[unseen].abs().mean()
        assert errors[True] < 0.8 * errors[False]


def test_the_pose_hardly_changes_what_was_not_observed(runs, person):
    unseen = coverage_of(person).weight < 0.05
    changes = {}
    for on, avatar in runs.items():
        answers = [unlit_on_surface(avatar, person, person.train[i].pose) for i in (0, 2, 4)]
        changes[on] = torch.stack([answer.color for answer in answers]).std(0)[unseen].mean()
    assert changes[True] < 0.7 * changes[False]


def test_a_stored_avatar_is_the_same_again(runs, person, tmp_path):
    from twofold.training.run import read_recipe, start_folder

    avatar = runs[True]
    recipe = replace(completing_recipe(150), name="again")
    start_folder(tmp_path / "run", recipe, avatar.subject, person.folder, coverage=coverage_of(person))
    optimizer = torch.optim.Adam([torch.nn.Parameter(torch.zeros(1))])
    write_checkpoint(tmp_path / "run", avatar, optimizer, 150)
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
    fresh = tiny_recipe(150).method.build(Subject.of(person))
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
    assert (completion.weight[vertex] < 1).all()
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
        completion.prepare(replace(coverage, weight=(order <= share).float()), torch.zeros(len(order)))
        assert (completion.unobserved == 0) == left_alone
        assert bool((completion.weight == 1).all()) == left_alone
        assert completion.is_due(completion.config.start) != left_alone
