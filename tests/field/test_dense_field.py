"""What dense fields share, on a sphere whose radius is learned."""

import pytest
import torch

from twofold.field.dense_field import DenseField
from twofold.field.output import FieldOutput

POSE = torch.zeros(69)


class Sphere(DenseField):
    def __init__(self, gradients):
        super().__init__(gradients)
        self.radius = torch.nn.Parameter(torch.tensor(0.5))

    def sdf(self, x_canonical, pose):
        return x_canonical.norm(dim=-1) - self.radius

    def _distance_and_gradient(self, x, pose):
        sdf = self.sdf(x, pose)
        if self.analytic:
            return sdf, x / x.norm(dim=-1, keepdim=True)
        return sdf, torch.autograd.grad(sdf.sum(), x, create_graph=True)[0]

    def _evaluate(self, x, pose, to_observation):
        sdf, gradient = self._distance_and_gradient(x, pose)
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
