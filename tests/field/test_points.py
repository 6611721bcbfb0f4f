import math

import pytest
import torch
from small_cloud import JOINTS_64, posed_cloud, random_pose, small_cloud

from twofold.errors import TwofoldError
from twofold.field.bone_boxes import (
    RIGID_PARTS,
    TWO_HOPS,
    assign_to_boxes,
    bone_frames,
    box_coordinates,
    initial_half_sizes,
)
from twofold.field.points import (
    PointCloud,
    PointDeformation,
    choose_positions,
    farthest_points,
    nearest_neighbours,
)


def test_points_are_chosen_farthest_first(generator):
    points = torch.randn(30, 3, generator=generator)
    chosen = farthest_points(points, 8).tolist()
    assert chosen[0] == 0
    for n in range(1, 8):
        distances = [min(math.dist(p, points[c].tolist()) for c in chosen[:n]) for p in points.tolist()]
        assert distances[chosen[n]] == pytest.approx(max(distances), abs=1e-6)


def test_too_few_points_are_refused():
    with pytest.raises(ValueError, match="5 points cannot be chosen from 3"):
        farthest_points(torch.zeros(3, 3), 5)


def test_positions_are_the_farthest_points_of_each_part(generator):
    half_sizes = initial_half_sizes(JOINTS_64)[list(RIGID_PARTS)]
    frames = bone_frames(JOINTS_64)
    inside = 1.8 * torch.rand(40, 19, 3, generator=generator, dtype=torch.float64) - 0.9
    rest = (frames.rotations[list(RIGID_PARTS)].mT @ (inside * half_sizes)[..., None])[..., 0]
    rest = (rest + frames.origins[list(RIGID_PARTS)]).flatten(0, 1)
    to_frame = frames.world_to_frame(torch.eye(4, dtype=torch.float64).repeat(24, 1, 1))[list(RIGID_PARTS)]
    coordinates = box_coordinates(rest, to_frame, half_sizes)
    part = assign_to_boxes(coordinates, half_sizes)
    fewest = int(torch.bincount(part[part >= 0], minlength=19).min())
    positions = choose_positions(coordinates, half_sizes, fewest)
    for k in range(19):
        own = coordinates[part == k, k]
        chosen = own[farthest_points(own * half_sizes[k], fewest)]
        assert torch.equal(positions[:, k], chosen)
    with pytest.raises(TwofoldError, match=f"needs {fewest + 1} surface points for each body part, the .* has"):
        choose_positions(coordinates, half_sizes, fewest + 1)
    # Of parts that no image shows the other points are taken, and of these parts alone.
    other = choose_positions(coordinates.flip(0), half_sizes, fewest)
    mixed = choose_positions(coordinates, half_sizes, fewest, {3, 7}, coordinates.flip(0))
    assert not torch.equal(other, positions)
    for k in range(19):
        assert torch.equal(mixed[:, k], (other if k in (3, 7) else positions)[:, k])


def test_neighbours_are_the_nearest_and_begin_with_the_point_itself(generator):
    points = torch.randn(20, 3, generator=generator)
    for n, row in enumerate(nearest_neighbours(points, 4).tolist()):
        by_distance = sorted(range(20), key=lambda k: math.dist(points[n].tolist(), points[k].tolist()))
        assert row == by_distance[:4]


def test_rest_points_lie_in_their_boxes(generator):
    cloud, frames, sizes = small_cloud(generator), bone_frames(JOINTS_64), initial_half_sizes(JOINTS_64)
    for k, part in enumerate(RIGID_PARTS):
        rest = cloud.rest_points()[:, k]
        local = (rest - frames.origins[part]) @ frames.rotations[part].T / sizes[part]
        torch.testing.assert_close(local, cloud.positions[:, k])


def test_cloud_starts_as_described(generator):
    cloud = small_cloud(generator)
    torch.testing.assert_close(cloud.squared_radii(), torch.full_like(cloud.squared_radii(), 5e-4))
    distance = math.dist(cloud.rest_points()[2, 5].tolist(), JOINTS_64[7].tolist())
    assert cloud.logits[2, 5, 7].item() == pytest.approx(1 / math.sqrt(distance), rel=1e-6)


def test_directions_point_away_from_the_bone(generator):
    cloud, sizes = small_cloud(generator), initial_half_sizes(JOINTS_64)
    found = cloud.directions()
    for k, part in enumerate(RIGID_PARTS):
        vector = cloud.positions[1, k] * sizes[part]
        if part not in (0, 9, 15):
            vector = vector * torch.tensor([1, 1, 0], dtype=torch.float64)
        torch.testing.assert_close(found[1, k], vector / vector.norm())
    assert not found.requires_grad


def literal_point(cloud, net, features, posed, slot, k):
    """One point in the pose, as printed: position, offset, pose feature."""
    part, p = RIGID_PARTS[k], cloud.positions[slot, k]

    def node(layer, x):
        return x @ layer.weight[k] + layer.bias[k]

    blend = node(net.blending[4], node(net.blending[2], node(net.blending[0], p).relu()).relu())
    reach = [RIGID_PARTS.index(other) for other in TWO_HOPS[part]]
    exponentials = {i: torch.exp(cloud.logits[slot, k, i] + blend[i]) for i in reach}
    rest = cloud.rest_points()[slot, k]
    skinned = 0
    for i, value in exponentials.items():
        t = posed[RIGID_PARTS[i]]
        skinned = skinned + value / sum(exponentials.values()) * (t[:3, :3] @ rest + t[:3, 3])
    film = net.pose_graph(features)[k]
    z = node(net.first, p).relu() * film[:96] + film[96:]
    for layer in net.hidden:
        z = node(layer, z).relu()
    out = node(net.last, z)
    frame_to_world = posed[part][:3, :3] @ bone_frames(JOINTS_64).rotations[part].T
    offset = frame_to_world @ (0.01 * out[8:])
    return skinned + (offset if offset.norm() < 0.04 else 0), offset, out[:8]


def test_posed_points_are_skinned_and_offset_as_printed(generator):
    cloud, net = small_cloud(generator), PointDeformation(generator).double()
    net.last.weight.data.mul_(500)
    features, posed = random_pose(generator)
    result = net(cloud, features, posed)
    lengths = result.offsets.norm(dim=1)
    assert 0.1 < (lengths < 0.04).double().mean() < 0.95
    for slot in range(4):
        for k in range(19):
            position, offset, feature = literal_point(cloud, net, features, posed, slot, k)
            n = slot * 19 + k
            torch.testing.assert_close(result.positions[n], position)
            torch.testing.assert_close(result.offsets[n], offset)
            torch.testing.assert_close(result.pose_features[n], feature)


def test_frames_and_directions_follow_the_pose(generator):
    cloud, (features, posed) = small_cloud(generator), random_pose(generator)
    result = PointDeformation(generator).double()(cloud, features, posed)
    expected = bone_frames(JOINTS_64).world_to_frame(posed)[list(RIGID_PARTS)]
    torch.testing.assert_close(result.world_to_frame, expected)
    turned = expected[5, :3, :3].T @ cloud.directions()[2, 5]
    torch.testing.assert_close(result.directions[2 * 19 + 5], turned)


def test_gradients_reach_every_parameter_but_not_the_directions(generator):
    cloud, net = small_cloud(generator), PointDeformation(generator).double()
    features, posed = random_pose(generator)
    result = net(cloud, features, posed.requires_grad_())
    (result.positions.sum() + result.pose_features.sum() + result.offsets.sum()).backward()
    for name, parameter in [*net.named_parameters(), *cloud.named_parameters()]:
        assert parameter.grad is not None or name in ("radii", "features"), name
    assert not result.directions.requires_grad
    assert posed_cloud(cloud, generator).positions.isfinite().all()


def test_parameter_counts_are_the_authors():
    net = PointDeformation()
    cloud = PointCloud(torch.rand(200, 19, 3), JOINTS_64.float(), initial_half_sizes(JOINTS_64).float())

    def count(module):
        return sum(p.numel() for p in module.parameters())

    assert count(net.pose_graph) == 1_464_256
    assert count(net) - count(net.pose_graph) == 381_425 + 34_409
    assert count(cloud) == 87_400 + 9 * 3800
