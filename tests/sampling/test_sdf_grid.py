"""A grid of distances never claims more than it knows."""

import numpy as np
import pytest
import torch
from little_body import ball

from twofold.sampling import search_kernels
from twofold.sampling.sdf_grid import KNOWN_BELOW, UNKNOWN, SdfGrid, grid_nodes, tabulate

POINTS = torch.from_numpy(ball()[0])
CENTER, RADIUS = POINTS.mean(0), float((POINTS - POINTS.mean(0)).norm(dim=1).mean())


def sphere(x):
    return (x - CENTER).norm(dim=-1) - RADIUS


def rippled(x):
    """A centimetre of detail, finer than the lattice can hold."""
    return sphere(x) + 0.01 * torch.sin(x * 700).prod(-1)


def around(count, spread, generator):
    return POINTS[torch.randint(len(POINTS), (count,), generator=generator)] + spread * torch.randn(
        count, 3, generator=generator
    )


@pytest.mark.parametrize(("field", "least", "most"), [(sphere, 0.0, 0.004), (rippled, 0.003, 0.04)])
def test_the_field_lies_between_the_bounds(field, least, most, device, generator):
    table = tabulate(lambda x: field(x.cpu()).to(device), POINTS.to(device), 0.02, 0.06)
    assert least < table.error < most
    x = around(20_000, 0.02, generator)
    nearer, further = (bound.cpu() for bound in table.bounds(x.to(device)))
    between = (nearer <= field(x)) & (field(x) <= further)
    assert between.float().mean() > 0.999
    known = nearer.isfinite()
    assert known.float().mean() > 0.95
    torch.testing.assert_close((further - nearer)[known], torch.full((int(known.sum()),), 2 * table.error))


def test_away_from_the_lattice_nothing_is_known():
    table = tabulate(sphere, POINTS, 0.02, 0.06)
    nearer, further = table.bounds(torch.stack([CENTER, CENTER + 10, CENTER - 3]))
    assert (nearer == -torch.inf).all()
    assert (further == torch.inf).all()


def test_every_node_is_asked_once_in_portions():
    asked = []
    table = tabulate(lambda x: asked.append(len(x)) or sphere(x), POINTS, 0.04, 0.06, chunk=100, trials=7)
    assert max(asked) == 100
    assert sum(asked) == int((table.values < KNOWN_BELOW).sum()) + 7


def test_a_field_without_a_surface_is_tabulated_too():
    table = tabulate(lambda x: torch.full((len(x),), 3.0), POINTS, 0.04, 0.06)
    nearer, further = table.bounds(POINTS)
    torch.testing.assert_close(nearer, further)
    torch.testing.assert_close(nearer, torch.full((len(POINTS),), 3.0))


def test_interpolation_is_exact_for_what_is_trilinear(device):
    """Products of linear functions, against their own values."""

    def trilinear(x):
        return (1 + x[:, 0]) * (2 - x[:, 1]) * (0.5 + 3 * x[:, 2])

    nodes = grid_nodes(POINTS.to(device), 0.03, 0.05)
    grid = nodes.filled(trilinear(nodes.positions), 0.0)
    x = around(500, 0.01, torch.Generator().manual_seed(0)).to(device)
    torch.testing.assert_close(grid.interpolate(x), trilinear(x), atol=2e-5, rtol=0)


def test_bounds_that_need_not_hold_everywhere_are_narrower(generator):
    strict, most = (tabulate(rippled, POINTS, 0.02, 0.06, covered=share) for share in (1.0, 0.9))
    assert 0 < most.error < 0.7 * strict.error
    x = around(20_000, 0.02, generator)
    nearer, further = most.bounds(x)
    assert 0.85 < ((nearer <= rippled(x)) & (rippled(x) <= further)).float().mean() < 0.999


def test_beside_a_node_that_is_not_known_nothing_is():
    values = torch.zeros(3, 3, 3)
    values[2, 2, 2] = UNKNOWN
    grid = SdfGrid(values, torch.zeros(3), 1.0, 0.0)
    x = torch.tensor(
        [[1.5, 1.5, 1.5], [1.02, 1.02, 1.02], [0.5, 0.5, 0.5], [-0.1, 0.5, 0.5], [1.9, 1.2, 2.1], [torch.nan, 1.0, 1.0]]
    )
    unknown = [True, True, False, True, True, True]
    assert grid.interpolate(x).isnan().tolist() == unknown
    # The compiled loop: 1 m outside the surface no sample counts, and where nothing is known every one may.
    outside = SdfGrid(torch.where(values == UNKNOWN, UNKNOWN, 1.0), torch.zeros(3), 1.0, 0.0)
    possible, number = np.empty(len(x), bool), np.arange(len(x))
    own = np.float32(0.01), np.float32(1e-3), np.float32(0.01)
    search_kernels.mark_possible(number, number, x.numpy(), outside.arrays(), *own, possible)
    assert possible.tolist() == unknown
