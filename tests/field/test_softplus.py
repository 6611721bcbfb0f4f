"""The rounded rectifier against its formula, compiled and in PyTorch."""

import pytest
import torch

from twofold.field import softplus as module
from twofold.field.softplus import softplus


def test_softplus_is_accurate_to_3e7():
    z = torch.cat([torch.linspace(-3, 3, 100_001), torch.tensor([0.0, 1e-8, -1e-8, 40.0, -40.0, 1e4, -1e4])])
    value, slope = softplus(z)
    exact = torch.logaddexp(z.double() * 100, torch.zeros(())) / 100
    assert ((value - exact).abs() / z.abs().clamp_min(1)).max() < 3e-7
    assert (slope - torch.sigmoid(100 * z.double())).abs().max() < 3e-7
    assert value.isfinite().all()
    assert slope.isfinite().all()


def test_softplus_gives_nothing_denormal():
    parts = softplus(torch.linspace(-2, 2, 100_001))
    for part in parts:
        assert not ((part != 0) & (part.abs() < torch.finfo(torch.float32).tiny)).any()


def test_softplus_is_differentiable_twice():
    z = torch.linspace(-0.05, 0.05, 21, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(softplus, (z,))
    assert torch.autograd.gradgradcheck(softplus, (z,))


@pytest.mark.parametrize("shape", [(3, 7), (40, 33), (1, 16)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_compiled_loops_are_their_twins_in_torch(shape, dtype, monkeypatch):
    """Values, slopes, and gradients by either or both of them; also of tensors that do not lie in one piece."""
    generator = torch.Generator().manual_seed(0)
    z = (0.03 * torch.randn(shape[::-1], generator=generator)).to(dtype).T
    weights = torch.randn(2, *shape, generator=generator).to(dtype)

    def parts():
        leaf = z.clone().requires_grad_()
        value, slope = softplus(leaf)
        both = (value * weights[0] + slope * weights[1]).sum()
        found = [torch.autograd.grad(total, leaf, retain_graph=True)[0] for total in (value.sum(), slope.sum(), both)]
        return [value.detach(), slope.detach(), *found]

    ours = parts()
    assert all(part.dtype == dtype for part in ours)
    monkeypatch.setattr(module, "_has_kernel", lambda z: False)
    for mine, twin in zip(ours, parts(), strict=True):
        # bfloat16 has eight bits, and the twin rounds in between.
        tolerance = 2e-6 if dtype == torch.float32 else 2e-2
        torch.testing.assert_close(mine, twin, atol=tolerance * float(twin.abs().max()), rtol=tolerance)


def test_what_is_no_number_stays_none():
    z = torch.full((20,), torch.nan)
    for dtype in (torch.float32, torch.bfloat16):
        assert softplus(z.to(dtype))[0].isnan().all()
