import math

import pytest
import torch
from small_cloud import posed_cloud, small_cloud

from twofold.field.bone_boxes import RIGID_PARTS, TWO_HOPS, box_coordinates
from twofold.field.encoding import fourier_encoding
from twofold.field.point_features import PointFeatures, PointRadiance, QueriedFeatures, nearest_posed_points


@pytest.fixture
def scene(generator):
    cloud = small_cloud(generator)
    with torch.no_grad():
        cloud.radii += 4  # influences that do not vanish between so few points
    posed = posed_cloud(cloud, generator)
    net = PointFeatures(generator).double()
    near = posed.positions[torch.randint(76, (12,), generator=generator)]
    queries = near + 0.02 * torch.randn(12, 3, generator=generator, dtype=torch.float64)
    return cloud, posed, net, queries.detach()


def coordinates_of(queries, cloud, posed):
    return box_coordinates(queries, posed.world_to_frame, cloud.half_sizes)


def literal_nearest(query, coordinates, positions):
    sizes = coordinates.norm(dim=1).tolist()
    closest = sizes.index(min(sizes))
    reach = [RIGID_PARTS.index(part) for part in TWO_HOPS[RIGID_PARTS[closest]]]
    boxes = sorted(reach, key=lambda k: sizes[k])[:3]
    candidates = [n for n in range(len(positions)) if n % 19 in boxes]
    return min(candidates, key=lambda n: math.dist(query.tolist(), positions[n].tolist()))


def test_nearest_point_is_that_of_three_reachable_parts(scene, generator):
    cloud, posed, _, queries = scene
    low, high = posed.positions.detach().amin(0), posed.positions.detach().amax(0)
    anywhere = low + (high - low) * torch.rand(100, 3, generator=generator, dtype=torch.float64)
    queries = torch.cat([queries, anywhere])
    coordinates = coordinates_of(queries, cloud, posed)
    found = nearest_posed_points(queries, coordinates, posed.positions)
    expected = [literal_nearest(q, c, posed.positions) for q, c in zip(queries, coordinates, strict=True)]
    assert found.tolist() == expected


def line(table, x):
    """Linear interpolation in a table [f k 3] whose ends lie at -1 and 1, by axis and then by feature."""
    bins, values = table.shape[1], []
    for axis in range(3):
        place = (min(max(x[axis].item(), -1), 1) + 1) / 2 * (bins - 1)
        low = min(math.floor(place), bins - 2)
        values += [(low + 1 - place) * t[low, axis] + (place - low) * t[low + 1, axis] for t in table]
    return torch.stack(values)


def literal_query(q, view, nearest, cloud, posed, net, drop):
    neighbours = cloud.neighbours[nearest].tolist()
    if drop:
        neighbours = neighbours[1:]
    beta = cloud.squared_radii()
    a = [torch.exp(-(posed.positions[k] - q).square().sum() / beta[k]) for k in neighbours]
    total = sum(a)
    f = {"point": 0, "pose": 0, "bone": 0, "distance": 0, "view": 0}
    for weight, k in zip(a, neighbours, strict=True):
        slot, part = divmod(k, 19)
        p = cloud.positions[slot, part]
        first, _, second = net.canonical
        h = (line(net.canonical_lines[part], p) @ first.weight[part] + first.bias[part]).relu()
        canonical = h @ second.weight[part] + second.bias[part]
        f["point"] = f["point"] + weight * torch.cat([cloud.features[slot, part], canonical])
        f["pose"] = f["pose"] + weight * posed.pose_features[k]
        code = net.bone_codes[part] @ net.bone_lines.weight[part] + net.bone_lines.bias[part]
        frame = posed.world_to_frame[part]
        x = (frame[:3, :3] @ q + frame[:3, 3]) / cloud.half_sizes[part]
        b = [net.bone_map(line(code.reshape(2, 16, 3), y)) for y in (p, x)]
        f["bone"] = f["bone"] + weight / total * (b[0] - b[1])
        f["distance"] = f["distance"] + weight / total * ((q - posed.positions[k]) @ posed.directions[k])
        f["view"] = f["view"] + weight / total * (view @ posed.directions[k])
    return {"influence": total, **f}


@pytest.mark.parametrize("drop", [False, True])
def test_features_are_blended_as_printed(scene, drop, generator):
    cloud, posed, net, queries = scene
    nearest = nearest_posed_points(queries, coordinates_of(queries, cloud, posed), posed.positions)
    views = torch.randn(12, 3, generator=generator, dtype=torch.float64)
    dropped = torch.full((12,), True) if drop else None
    found = net(queries, views, nearest, cloud, posed, net.tables(cloud), dropped)
    for n in range(12):
        expected = literal_query(queries[n], views[n], nearest[n], cloud, posed, net, drop)
        for name, value in expected.items():
            torch.testing.assert_close(getattr(found, name)[n], value, msg=lambda m, name=name: f"{name}: {m}")


def test_only_the_given_queries_lose_their_nearest_point(scene):
    cloud, posed, net, queries = scene
    nearest = nearest_posed_points(queries, coordinates_of(queries, cloud, posed), posed.positions)
    tables, views = net.tables(cloud), torch.ones_like(queries)
    dropped = torch.arange(12) % 2 == 0
    whole, some = (net(queries, views, nearest, cloud, posed, tables, d) for d in (None, dropped))
    torch.testing.assert_close(some.point[~dropped], whole.point[~dropped])
    assert (some.influence[dropped] < whole.influence[dropped]).all()
    assert whole.bone.requires_grad
    assert not some.bone.requires_grad


def test_queries_are_twice_differentiable(scene):
    cloud, posed, net, queries = scene
    nearest = nearest_posed_points(queries, coordinates_of(queries, cloud, posed), posed.positions)[:2]
    tables, views = net.tables(cloud), torch.ones(2, 3, dtype=torch.float64)

    def answer(q):
        found = net(q, views, nearest, cloud, posed, tables)
        return found.point.sum(1), found.bone.sum(1), found.distance

    q = queries[:2].requires_grad_()
    assert torch.autograd.gradcheck(answer, q)
    assert torch.autograd.gradgradcheck(answer, q)


def test_far_queries_stay_finite(scene):
    cloud, posed, net, queries = scene
    far = (queries + 5).requires_grad_()
    found = net(far, torch.ones_like(far), torch.zeros(12, dtype=torch.long), cloud, posed, net.tables(cloud))
    (found.point.sum() + found.bone.sum() + found.distance.sum()).backward()
    assert found.influence.max() < 1e-6
    assert far.grad.isfinite().all()


def test_heads_see_the_weighted_encodings(generator):
    net = PointRadiance(generator).double()

    def random(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    f = QueriedFeatures(random(3, 36), random(3, 8), random(3, 6), random(3), random(3), random(3).abs())
    encoded = fourier_encoding(f.point, 6, include_pi=False)
    encoded[:, 36:] *= f.influence[:, None]
    h = torch.cat([encoded, f.bone, f.pose, f.distance[:, None]], 1)
    assert h.shape[1] == 483
    for layer in net.distance.layers[:3]:
        h = layer(h).relu()
    view = fourier_encoding(f.view[:, None], 2, include_pi=False)
    view[:, 1:] *= f.influence[:, None]
    code = random(128)
    sdf, color = net(f, code)
    torch.testing.assert_close(sdf, net.distance.layers[3](h)[:, 0])
    torch.testing.assert_close(net.sdf(f), sdf)
    torch.testing.assert_close(color, net.color(h, view, code))


def test_parameter_counts_are_the_authors():
    def count(module):
        return sum(p.numel() for p in module.parameters())

    net = PointRadiance()
    assert (count(net.distance), count(net.color)) == (255_745, 116_099)
    assert count(PointFeatures()) + 381_425 + 34_409 + 9 * 3800 == 550_985
