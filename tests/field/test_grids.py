"""Feature grids against a corner-by-corner loop, and the compiled loops against their twins in double precision."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from little_body import ball
from scipy import ndimage

from twofold.field.grids import (
    FeatureGrid,
    Lattices,
    body_distance,
    build_lattices,
    interpolate,
    interpolate_in_torch,
    interpolation_pullback,
    pullback_in_torch,
)
from twofold.geometry.surfaces import point_to_mesh

VOXELS, RADIUS, FEATURES = (0.11, 0.05), 0.08, 3


POINTS, FACES = ball()
LATTICES, POSITIONS = build_lattices(POINTS, VOXELS, RADIUS)


def case(seed=0, count=200, spread=0.02, dtype=torch.float64):
    """Table, points near the ball, cotangents."""
    generator = torch.Generator().manual_seed(seed)
    table = torch.randn(len(POSITIONS), FEATURES, generator=generator)
    which = torch.randint(len(POINTS), (count,), generator=generator)
    x = torch.from_numpy(POINTS)[which] + spread * torch.randn(count, 3, generator=generator)
    cotangent = torch.randn(count, FEATURES * len(VOXELS), generator=generator)
    return table.to(dtype), x.to(dtype), cotangent.to(dtype)


def in_double(lattices):
    return Lattices(lattices.rows, lattices.place.double(), lattices.shape)


def corner_by_corner(table, x, lattices):
    """Values and slopes [S, L*C] and [S, L*C, 3], one corner after the other."""
    levels, channels = len(lattices.place), table.shape[1]
    values = np.zeros((len(x), levels * channels))
    slopes = np.zeros((len(x), levels * channels, 3))
    for s, point in enumerate(x.numpy()):
        for level in range(levels):
            low, scale = lattices.place[level, :3].double().numpy(), float(lattices.place[level, 3])
            nx, ny, nz, begin = lattices.shape[level].tolist()
            rows = lattices.rows[begin : begin + nx * ny * nz].view(nx, ny, nz)
            cell = np.floor((point - low) * scale).astype(int)
            part = (point - low) * scale - cell
            here = slice(level * channels, (level + 1) * channels)
            for corner in np.ndindex(2, 2, 2):
                features = table[rows[tuple(cell + corner)]].numpy()
                factors = np.where(corner, part, 1 - part)
                values[s, here] += factors.prod() * features
                for axis in range(3):
                    others = np.delete(factors, axis).prod()
                    slopes[s, here, axis] += (scale if corner[axis] else -scale) * others * features
    return torch.from_numpy(values), torch.from_numpy(slopes)


FORMS = {
    "compiled": (interpolate, interpolation_pullback, torch.float32, 2e-5),
    "torch": (interpolate_in_torch, pullback_in_torch, torch.float64, 1e-10),
}


@pytest.fixture(params=FORMS.values(), ids=FORMS.keys())
def form(request):
    return request.param


def test_values_and_slopes_are_those_of_the_loop(form):
    forward, pullback, dtype, error = form
    table, x, cotangent = case(count=25)
    values, slopes = corner_by_corner(table, x, in_double(LATTICES))
    lattices = LATTICES if dtype == torch.float32 else in_double(LATTICES)
    table, x, cotangent = table.to(dtype), x.to(dtype), cotangent.to(dtype)
    torch.testing.assert_close(forward(table, x, lattices).double(), values, atol=error, rtol=error)
    expected = (slopes * cotangent.double()[..., None]).sum(1)
    torch.testing.assert_close(pullback(table, x, cotangent, lattices).double(), expected, atol=50 * error, rtol=error)


def test_linear_functions_come_out_exactly_with_their_slope(form):
    forward, pullback, dtype, _ = form
    matrix = torch.randn(3, FEATURES, generator=torch.Generator().manual_seed(1), dtype=dtype)
    _, x, cotangent = case(dtype=dtype)
    table = torch.from_numpy(POSITIONS).to(dtype) @ matrix
    lattices = LATTICES if dtype == torch.float32 else in_double(LATTICES)
    torch.testing.assert_close(forward(table, x, lattices), (x @ matrix).repeat(1, 2), atol=2e-6, rtol=0)
    slope = cotangent.view(len(x), 2, FEATURES).sum(1) @ matrix.T
    torch.testing.assert_close(pullback(table, x, cotangent, lattices), slope, atol=3e-4, rtol=0)


def compare_gradients(function, twin, arguments, which, rtol=1e-4):
    """Values and gradients of a compiled function and of its twin in double precision."""
    results = []
    for form, dtype in ((function, torch.float32), (twin, torch.float64)):
        given = [a.to(dtype).requires_grad_(i in which) for i, a in enumerate(arguments)]
        out = form(*given, LATTICES if dtype == torch.float32 else in_double(LATTICES))
        slopes = torch.linspace(-1, 1, out.numel(), dtype=dtype).view_as(out)
        gradients = torch.autograd.grad((slopes * out).sum(), [given[i] for i in which])
        results.append([out.detach().double(), *(g.double() for g in gradients)])
    for found, expected in zip(*results, strict=True):
        scale = float(expected.abs().max())
        torch.testing.assert_close(found, expected, atol=rtol * scale, rtol=rtol)


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("which", [(0,), (1,), (0, 1)], ids=["table", "points", "both"])
def test_compiled_interpolation_is_its_twin_with_all_gradients(which, threads, monkeypatch):
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    compare_gradients(interpolate, interpolate_in_torch, case(count=3500)[:2], which)


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("which", [(0,), (2,), (0, 2)], ids=["table", "cotangent", "both"])
def test_compiled_pullback_is_its_twin_with_all_gradients(which, threads, monkeypatch):
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    compare_gradients(interpolation_pullback, pullback_in_torch, case(count=3500), which)


def test_double_precision_goes_through_the_twin():
    table, x, cotangent = case()
    lattices = in_double(LATTICES)
    assert torch.equal(interpolate(table, x, lattices), interpolate_in_torch(table, x, lattices))
    found = interpolation_pullback(table, x, cotangent, lattices)
    assert torch.equal(found, pullback_in_torch(table, x, cotangent, lattices))


def test_gradients_of_the_twins_pass_gradcheck():
    table, x, cotangent = case(count=3)
    lattices = in_double(LATTICES)
    used = corner_rows(x)
    part = table[used].requires_grad_()

    def whole(rows):
        return table.index_put((used,), rows)

    arguments = (part, x.clone().requires_grad_())
    assert torch.autograd.gradcheck(lambda t, y: interpolate(whole(t), y, lattices), arguments, fast_mode=True)
    arguments = (part, cotangent.requires_grad_())
    assert torch.autograd.gradcheck(
        lambda t, u: interpolation_pullback(whole(t), x, u, lattices), arguments, fast_mode=True
    )


def corner_rows(x):
    table = torch.zeros(len(POSITIONS), 1, dtype=x.dtype, requires_grad=True)
    (gradient,) = torch.autograd.grad(interpolate(table, x, in_double(LATTICES)).sum(), table)
    return gradient.nonzero()[:, 0]


def test_pullback_is_the_gradient_that_autograd_finds():
    table, x, cotangent = case()
    lattices = in_double(LATTICES)
    (expected,) = torch.autograd.grad(
        (interpolate(table, x.requires_grad_(), lattices) * cotangent).sum(), x, create_graph=True
    )
    torch.testing.assert_close(interpolation_pullback(table, x, cotangent, lattices), expected)


def test_points_are_constants_of_the_pullback():
    for dtype in (torch.float32, torch.float64):
        table, x, cotangent = case(dtype=dtype)
        lattices = LATTICES if dtype == torch.float32 else in_double(LATTICES)
        out = interpolation_pullback(table.requires_grad_(), x.requires_grad_(), cotangent, lattices)
        assert torch.autograd.grad(out.sum(), x, allow_unused=True)[0] is None


@given(seed=st.integers(0, 9999), radius=st.floats(0.02, 0.15))
def test_every_point_within_the_radius_has_eight_nodes_of_its_own(seed, radius):
    generator = torch.Generator().manual_seed(seed)
    lattices, positions = build_lattices(POINTS, VOXELS, radius)
    offset = torch.nn.functional.normalize(torch.randn(len(POINTS), 3, generator=generator), dim=1)
    x = torch.from_numpy(POINTS) + radius * torch.rand(len(POINTS), 1, generator=generator) * offset
    shared = torch.zeros(len(positions), 1)
    for level in range(len(VOXELS)):
        begin = int(lattices.shape[level, 3])
        shared[int(lattices.rows[begin])] = 1
    assert int(shared.sum()) == len(VOXELS), "the first node is far away, and stands for all that are"
    assert (interpolate(shared, x, lattices) == 0).all()


def test_a_level_may_end_closer_to_the_body_than_others():
    points = np.random.default_rng(3).normal(size=(40, 3)).astype(np.float32) * 0.1
    lattices, nodes = build_lattices(points, (0.04, 0.02), [0.1, 0.03])
    wide, _ = build_lattices(points, (0.04, 0.02), 0.1)
    table = torch.ones(len(nodes), 1)
    first = lattices.rows[lattices.shape[1, 3]]  # what stands for everywhere else on the second level
    table[first] = 0
    near = torch.from_numpy(points + np.float32(0.01))
    far = torch.from_numpy(points.max(0, keepdims=True) + np.float32(0.075))
    torch.testing.assert_close(interpolate_in_torch(table, near, lattices)[:, 1], torch.ones(40))
    assert interpolate_in_torch(table, far, lattices)[:, 1].max() == 0
    assert interpolate_in_torch(table, torch.full((1, 3), 9.0), lattices)[:, 1].max() == 0
    assert interpolate_in_torch(table, far, lattices)[:, 0].min() > 0.999
    assert lattices.rows.max() < wide.rows.max()


def test_rows_number_the_nodes_near_the_body():
    assert int(LATTICES.rows.max()) + 1 == len(POSITIONS)
    for level, voxel in enumerate(VOXELS):
        nx, ny, nz, begin = LATTICES.shape[level].tolist()
        rows = LATTICES.rows[begin : begin + nx * ny * nz].view(nx, ny, nz)
        far = int(rows[0, 0, 0])
        own = (rows != far).nonzero()
        assert len(rows[rows != far].unique()) == len(own), "no two nodes share a row"
        nodes = LATTICES.place[level, :3] + voxel * own
        kept = torch.from_numpy(POSITIONS)[rows[own[:, 0], own[:, 1], own[:, 2]].long()]
        torch.testing.assert_close(nodes, kept, atol=1e-5, rtol=0)
        assert torch.cdist(nodes, torch.from_numpy(POINTS)).amin(1).max() < RADIUS + 4 * voxel


def test_points_outside_are_moved_to_the_border():
    table, x, cotangent = case(dtype=torch.float32)
    x[::2] *= 40
    assert interpolate(table, x, LATTICES).isfinite().all()
    assert interpolation_pullback(table, x, cotangent, LATTICES).isfinite().all()
    twin = interpolate_in_torch(table.double(), x.double(), in_double(LATTICES))
    torch.testing.assert_close(interpolate(table, x, LATTICES).double(), twin, atol=2e-4, rtol=0)


def test_no_points_give_no_features():
    table, _, _ = case(dtype=torch.float32)
    x = torch.zeros(0, 3, requires_grad=True)
    out = interpolate(table.requires_grad_(), x, LATTICES)
    assert out.shape == (0, 6)
    out.sum().backward()
    assert not table.grad.any()


def test_grid_starts_near_zero_and_is_decided_by_the_generator():
    first, second, third = (
        FeatureGrid(POINTS, VOXELS, FEATURES, RADIUS, torch.Generator().manual_seed(seed)) for seed in (1, 1, 2)
    )
    assert 0 < first.table.abs().max() <= 1e-3
    assert torch.equal(first.table, second.table)
    assert not torch.equal(first.table, third.table)
    assert first.size == FEATURES * len(VOXELS)
    assert list(first.state_dict()) == ["table"], "where the nodes lie follows from the body"


def test_grid_answers_alike_on_every_device_and_precision(device):
    grid = FeatureGrid(POINTS, VOXELS, FEATURES, RADIUS, torch.Generator().manual_seed(1))
    _, x, cotangent = case(dtype=torch.float32)
    expected = grid(x).detach().double(), grid.pullback(x, cotangent).detach().double()
    there = grid.double().to(device)
    found = there(x.double().to(device)), there.pullback(x.double().to(device), cotangent.double().to(device))
    for a, b in zip(expected, found, strict=True):
        torch.testing.assert_close(a, b.detach().cpu(), atol=2e-5 * float(a.abs().max()), rtol=1e-4)


def test_distance_to_the_body_is_exact_to_millimetres_near_it_and_signed_everywhere():
    vertices, faces = ball(3000)
    generator = torch.Generator().manual_seed(2)
    x = torch.from_numpy(vertices)[::5] + 0.03 * torch.randn(600, 3, generator=generator)
    found = torch.from_numpy(body_distance(x.numpy(), vertices, faces))
    exact, _, _ = point_to_mesh(x, torch.from_numpy(vertices), torch.from_numpy(faces))
    center = torch.tensor([0.2, -0.1, 0.4])
    exact = torch.where((x - center).norm(dim=1) < 0.3, -exact, exact)
    assert (found - exact).abs()[exact.abs() < 0.015].max() < 0.002
    assert (found - exact).abs().max() < 0.006
    assert (found.sign() == exact.sign())[exact.abs() > 0.002].all()


def test_bodies_with_hardly_any_vertices_have_distances_too():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=np.float32)
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    found = body_distance(np.array([[2, 2, 2], [0.2, 0.2, 0.2]], dtype=np.float32), vertices, faces)
    assert found[0] > 1
    assert found[1] < 0


@pytest.mark.parametrize("seed", range(4))
def test_rows_of_stored_features_never_change(seed):
    """A run's features belong to rows, so the corner and the size of a level are rounded as they always were."""
    points = np.random.default_rng(seed).uniform(-1.2, 0.9, (400, 3)).astype(np.float32)
    lattices, _ = build_lattices(points, (0.12, 0.06), 0.1)
    for level, voxel in enumerate((0.12, 0.06)):
        reach = 0.1 + np.sqrt(3) * voxel
        low = points.min(0) - reach - voxel
        assert np.array_equal(lattices.place[level, :3].numpy(), low.astype(np.float32))
        size = np.ceil((points.max(0) + reach + voxel - low) / voxel).astype(int) + 1
        assert lattices.shape[level, :3].tolist() == size.tolist()
        empty = np.ones(size, dtype=bool)
        empty[tuple(np.round((points - low) / voxel).astype(int).T)] = False
        near = np.asarray(ndimage.distance_transform_edt(empty)) * voxel <= reach + voxel
        begin = lattices.shape[level, 3]
        rows = lattices.rows[begin : begin + near.size].view(*size)
        assert np.array_equal((rows > rows.min()).numpy(), near)
