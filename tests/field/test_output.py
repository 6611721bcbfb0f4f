"""What follows from a field's answer."""

from dataclasses import replace

import pytest
import torch

from twofold.field.output import FieldOutput


def test_normals_are_the_turned_gradients_at_unit_length():
    gradient = torch.randn(6, 3, generator=torch.Generator().manual_seed(0))
    turn = torch.randn(6, 3, 3, generator=torch.Generator().manual_seed(1))
    answer = FieldOutput(torch.zeros(6), torch.zeros(6, 3), gradient)
    wanted = torch.einsum("sij,sj->si", turn, gradient)
    torch.testing.assert_close(answer.normals(turn), wanted / wanted.norm(dim=1, keepdim=True))
    with pytest.raises(ValueError, match="gradient"):
        replace(answer, gradient=None).normals(turn)


def test_compiled_normals_are_those_with_gradients():
    draw = torch.Generator().manual_seed(0)
    gradient, turn = torch.randn(50, 3, generator=draw), torch.randn(3, 50, 3, generator=draw).transpose(0, 1)
    gradient[3] = 0
    gradient[4] = 1e-8
    answer = FieldOutput(torch.zeros(50), torch.zeros(50, 3), gradient)
    with_gradient = answer.normals(turn.detach().requires_grad_())
    assert with_gradient.requires_grad
    torch.testing.assert_close(answer.normals(turn), with_gradient.detach())
    assert answer.normals(turn)[3].tolist() == [0, 0, 0]
