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
