"""What dense fields share, on a sphere whose radius is learned."""

import pytest
import torch

from twofold.field import dense_field
from twofold.field.dense_field import DenseField
from twofold.field.output import FieldOutput

POSE = torch.zeros(69)


class Sphere(DenseField):
    def __init__(self, gradients):
        super().__init__(gradients)
        self.radius = torch.nn.Parameter(torch.tensor(0.5))

    def at(self, pose):
        return self.radius

    def _sdf(self, x, networks):
        return x.norm(dim=-1) - networks

    def _distance_and_gradient(self, x, networks):
        sdf = self._sdf(x, networks)
        if self.analytic:
            return sdf, x / x.norm(dim=-1, keepdim=True)
        return sdf, torch.autograd.grad(sdf.sum(), x, create_graph=True)[0]

    def _evaluate(self, x, networks, to_observation):
        sdf, gradient = self._distance_and_gradient(x, networks)
        base = FieldOutput(sdf - 1, x.sigmoid() * self.radius, gradient)
        return FieldOutput(sdf, x.sigmoid(), gradient, base)


@pytest.fixture
def points():
    return torch.randn(7, 3, generator=torch.Generator().manual_seed(0))


def test_both_kinds_of_gradients_give_the_same_answers(points):
    by_hand, plain = Sphere("analytic"), Sphere("autograd")
    one, two = by_hand(points, POSE), plain(points, POSE)
    for name in ("sdf", "color", "gradient"):
        torch.testing.assert_close(getattr(one, name), getattr(two, name))
    for mine, other in zip(by_hand.distance_and_gradient(points, POSE), (one.sdf, one.gradient), strict=True):
        torch.testing.assert_close(mine, other)
    torch.testing.assert_close(plain.sdf_at(POSE)(points), one.sdf)


def test_answers_keep_no_graph_where_nobody_asks_for_gradients(points):
    field = Sphere("autograd")
    assert field(points, POSE).base.color.requires_grad
    with torch.no_grad():
        output, pair = field(points, POSE), field.distance_and_gradient(points, POSE)
    parts = [output.sdf, output.color, output.gradient, output.base.sdf, output.base.color, output.base.gradient, *pair]
    assert not any(part.requires_grad for part in parts)
    assert not points.requires_grad


def test_points_that_depend_on_something_learned_pass_gradients_on(points):
    shift = torch.zeros(3, requires_grad=True)
    Sphere("autograd")(points + shift, POSE).sdf.sum().backward()
    assert shift.grad.abs().sum() > 0


@pytest.mark.parametrize("gradients", ["analytic", "autograd"])
@pytest.mark.parametrize("part", [1, 3, 7, 100])
@pytest.mark.parametrize("count", [0, 7])
def test_parts_give_what_all_points_at_once_give(points, gradients, part, count, monkeypatch):
    field, points = Sphere(gradients), points[:count]
    whole, pair = field(points, POSE), field.distance_and_gradient(points, POSE)
    monkeypatch.setattr(dense_field, "_PART", part)
    with torch.no_grad():
        output, sdf = field(points, POSE, torch.eye(3).expand(count, 3, 3)), field.sdf(points, POSE)
        answers = field.distance_and_gradient(points, POSE)
    for mine, other in ((output, whole), (output.base, whole.base)):
        for name in ("sdf", "color", "gradient"):
            torch.testing.assert_close(getattr(mine, name), getattr(other, name).detach())
    torch.testing.assert_close(sdf, whole.sdf.detach())
    for mine, other in zip(answers, pair, strict=True):
        torch.testing.assert_close(mine, other.detach())


def test_parts_are_for_evaluation_and_leave_the_number_of_threads(points, monkeypatch):
    seen, threads = [], torch.get_num_threads()
    field = Sphere("analytic")
    evaluate = field._evaluate
    monkeypatch.setattr(field, "_evaluate", lambda x, *rest: seen.append(len(x)) or evaluate(x, *rest))
    monkeypatch.setattr(dense_field, "_PART", 3)
    assert field(points, POSE).sdf.requires_grad
    assert seen == [7]
    with torch.no_grad():
        field(points, POSE)
    assert sum(seen) == 14
    assert max(seen[1:]) <= 3
    assert torch.get_num_threads() == threads
