import math

import pytest
import torch
from little_body import JOINTS
from torch.nn import functional as F

from twofold.body.skeleton import PARENTS, joint_transforms
from twofold.deform.weight_volume import (
    CanonicalBox,
    Upsampling,
    WeightVolume,
    _bone_weights,
    _looked_up,
    bone_prior,
    canonical_box,
    skeletal_backward,
    skeletal_forward,
)
from twofold.geometry.rotations import rigid_inverse

JOINTS = torch.tensor(JOINTS, dtype=torch.float64)
TORSO = (0, 3, 6, 9, 13, 14)


def turn_from_y(direction):
    """The shortest rotation that takes +y to a direction."""
    y = torch.tensor([0.0, 1, 0], dtype=torch.float64)
    axis, cosine = torch.linalg.cross(y, direction), direction[1]
    k = torch.tensor([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]], dtype=torch.float64)
    return torch.eye(3, dtype=torch.float64) + k + k @ k / (1 + cosine)


def literal_prior(joint, p):
    """exp(-(p - m)^T R S^2 R^T (p - m)), summed over the child bones."""
    children = [child for child in range(24) if PARENTS[child] == joint]
    if not children:
        s = 1 / 0.12 if joint == 15 else 1 / 0.04
        return math.exp(-float((p - JOINTS[joint]) @ (p - JOINTS[joint])) * s * s)
    total = 0.0
    for child in children:
        bone = JOINTS[child] - JOINTS[joint]
        r = turn_from_y(bone / bone.norm())
        s = torch.tensor([1 / 0.06, 1 / 0.12, 1 / 0.06], dtype=torch.float64)
        if joint in TORSO:
            s = s / torch.tensor([1.5, 1, 1.5], dtype=torch.float64)
        d = p - (JOINTS[joint] + JOINTS[child]) / 2
        total += math.exp(-float(d @ r @ torch.diag(s * s) @ r.T @ d))
    return total


def test_prior_is_the_printed_quadratic_form():
    box = canonical_box(JOINTS)
    prior = bone_prior(JOINTS, box, size=6)
    for z, y, x in [(0, 0, 0), (2, 3, 3), (3, 4, 2), (3, 1, 3), (2, 5, 1)]:
        p = box.low + (box.high - box.low) * torch.tensor([x, y, z], dtype=torch.float64) / 5
        bones = [literal_prior(joint, p) for joint in range(24)]
        all_channels = [*bones, 1 - min(max(sum(bones), 0), 1)]
        expected = [b / max(sum(all_channels), 1e-3) for b in all_channels]
        torch.testing.assert_close(prior[:, z, y, x], torch.tensor(expected, dtype=torch.float64))


def test_prior_of_a_bone_along_minus_y_is_finite():
    joints = JOINTS.clone()
    joints[4] = joints[1] - torch.tensor([0, 0.4, 0])
    assert bone_prior(joints, canonical_box(joints), size=8).isfinite().all()


def small_volume(generator, channels=25, size=5):
    return torch.rand(channels, size, size, size, generator=generator, dtype=torch.float64).softmax(0)


def literal_lookup(volume, box, p):
    """Trilinear interpolation, corner by corner; corners outside the volume are zero."""
    size = volume.shape[0]
    where = [(float(p[i] - box.low[i]) / float(box.high[i] - box.low[i])) * (size - 1) for i in range(3)]
    total = 0.0
    for corner in range(8):
        weight, index = 1.0, []
        for axis in range(3):
            low = math.floor(where[axis])
            up = corner >> axis & 1
            weight *= where[axis] - low if up else 1 - (where[axis] - low)
            index.append(low + up)
        if all(0 <= i < size for i in index):
            total = total + weight * volume[index[2], index[1], index[0]]
    return total


def transforms(generator):
    pose = 0.4 * torch.randn(24, 3, generator=generator, dtype=torch.float64)
    return joint_transforms(JOINTS, pose, torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64))


def test_backward_is_the_printed_sum_over_bones(generator):
    weights, box = small_volume(generator), canonical_box(JOINTS)
    to_canonical = rigid_inverse(transforms(generator))
    points = torch.randn(6, 3, generator=generator, dtype=torch.float64)
    result = skeletal_backward(weights, points, to_canonical, box)
    for n, x in enumerate(points):
        moved = [m[:3, :3] @ x + m[:3, 3] for m in to_canonical]
        w = [literal_lookup(weights[i], box, moved[i]) for i in range(24)]
        expected = sum(a * b for a, b in zip(w, moved, strict=True)) / max(sum(w), 1e-4)
        torch.testing.assert_close(result.points[n], torch.as_tensor(expected, dtype=torch.float64))
        assert result.likelihood[n].item() == pytest.approx(float(sum(w)))


def test_forward_is_the_printed_sum_over_bones(generator):
    weights, box = small_volume(generator), canonical_box(JOINTS)
    from_canonical = transforms(generator)
    points = 0.3 * torch.randn(6, 3, generator=generator, dtype=torch.float64)
    result = skeletal_forward(weights, points, from_canonical, box)
    for n, x in enumerate(points):
        w = [literal_lookup(weights[i], box, x) for i in range(24)]
        moved = [m[:3, :3] @ x + m[:3, 3] for m in from_canonical]
        expected = sum(a * b for a, b in zip(w, moved, strict=True)) / max(sum(w), 1e-4)
        torch.testing.assert_close(result[n], expected)


def test_forward_undoes_backward_where_one_bone_has_all_weight(generator):
    weights = torch.zeros(25, 4, 4, 4, dtype=torch.float64)
    weights[18] = 1
    bones, box = transforms(generator), canonical_box(JOINTS)
    x_canonical = 0.2 * torch.randn(9, 3, generator=generator, dtype=torch.float64)
    posed = skeletal_forward(weights, x_canonical, bones, box)
    back = skeletal_backward(weights, posed, rigid_inverse(bones), box)
    torch.testing.assert_close(back.points, x_canonical)
    torch.testing.assert_close(back.likelihood, torch.ones(9, dtype=torch.float64))


def test_only_likely_points_are_kept_and_these_are_unchanged(generator):
    weights, box = bone_prior(JOINTS, canonical_box(JOINTS), 16), canonical_box(JOINTS)
    to_canonical = rigid_inverse(transforms(generator))
    points = 0.5 * torch.randn(200, 3, generator=generator, dtype=torch.float64)
    everything = skeletal_backward(weights, points, to_canonical, box)
    kept = skeletal_backward(weights, points, to_canonical, box, min_likelihood=0.05)
    expected = (everything.likelihood > 0.05).nonzero()[:, 0]
    assert 0 < len(expected) < 200
    assert torch.equal(kept.index, expected)
    torch.testing.assert_close(kept.points, everything.points[expected])


def test_gradients_reach_weights_points_and_bones(generator):
    weights, box = small_volume(generator, size=3), canonical_box(JOINTS)
    bones = transforms(generator)
    points = 0.2 * torch.randn(2, 3, generator=generator, dtype=torch.float64)
    inputs = [t.clone().requires_grad_() for t in (weights[:, :2, :2, :2], points, bones)]

    def backward(w, p, b):
        result = skeletal_backward(w, p, rigid_inverse(b), box)
        return result.points, result.likelihood

    assert torch.autograd.gradcheck(backward, inputs, fast_mode=True)
    assert torch.autograd.gradcheck(lambda w, p, b: skeletal_forward(w, p, b, box), inputs, fast_mode=True)


def test_volume_lies_over_the_box_corner_to_corner():
    box = CanonicalBox(torch.tensor([0.0, 0, 0]), torch.tensor([1.0, 2, 3]))
    lattice = box.lattice(3)
    assert lattice[0, 0, 2].tolist() == [1, 0, 0]
    assert lattice[2, 1, 0].tolist() == [0, 1, 3]
    assert box.coordinates(lattice[2, 2, 2]).tolist() == [1, 1, 1]


def test_compiled_lookup_is_that_of_torch_in_value_and_gradient(generator):
    weights = torch.rand(25, 6, 5, 7, generator=generator)
    box = canonical_box(JOINTS.float())
    bones = rigid_inverse(transforms(generator)).float()
    points = 0.8 * torch.randn(3000, 3, generator=generator)
    mix = torch.randn(3000, 24, generator=generator)
    found = []
    for lookup, dtype in ((_bone_weights, torch.float32), (_looked_up, torch.float64)):
        inputs = [t.to(dtype).requires_grad_() for t in (weights, points, bones)]
        wide = CanonicalBox(box.low.to(dtype), box.high.to(dtype))
        values = lookup(*inputs, wide)
        found.append([values, *torch.autograd.grad((values * mix.to(dtype)).sum(), inputs)])
    for compiled, twin in zip(*found, strict=True):
        torch.testing.assert_close(compiled.double(), twin, atol=1e-4 * twin.abs().max().item(), rtol=1e-4)


@pytest.mark.parametrize("size", [1, 2, 4])
def test_upsampling_is_the_transposed_convolution(size, generator):
    layer = Upsampling(5, 3, 1.0, generator, from_one=size == 1).double()
    layer.taps.data.normal_(generator=generator)
    layer.bias.data.normal_(generator=generator)
    weight = torch.zeros(5, 4, 4, 4, 3, dtype=torch.float64)
    read = weight[:, 1:3, 1:3, 1:3] if size == 1 else weight
    read.copy_(layer.taps.detach())
    weight.requires_grad_()
    h = torch.randn(5, size, size, size, generator=generator, dtype=torch.float64, requires_grad=True)
    literal = F.conv_transpose3d(h[None], weight.movedim(4, 1), layer.bias, stride=2, padding=1)[0]
    found = layer(h.permute(1, 2, 3, 0)).permute(3, 0, 1, 2)
    torch.testing.assert_close(found, literal)
    mix = torch.randn(found.shape, generator=generator, dtype=torch.float64)
    by_h, by_taps, by_bias = torch.autograd.grad((found * mix).sum(), [h, layer.taps, layer.bias])
    expected = torch.autograd.grad((literal * mix).sum(), [h, weight, layer.bias])
    torch.testing.assert_close(by_h, expected[0])
    torch.testing.assert_close(by_bias, expected[2])
    torch.testing.assert_close(by_taps, expected[1][:, 1:3, 1:3, 1:3] if size == 1 else expected[1])


@pytest.fixture(scope="module")
def volume():
    joints = JOINTS.float()
    return WeightVolume(bone_prior(joints, canonical_box(joints)), torch.Generator().manual_seed(0))


def test_parameter_count_is_the_authors(volume):
    assert sum(p.numel() for p in volume.parameters()) == 63_589_145


def test_weights_are_the_prior_times_the_exponential_of_the_logits(volume):
    with torch.no_grad():
        weights, logits = volume(), volume.logits()
    expected = volume.log_prior.exp() * logits.exp()
    torch.testing.assert_close(weights, expected / expected.sum(0))
    torch.testing.assert_close(weights.sum(0), torch.ones(32, 32, 32))


def test_all_phases_of_a_convolution_start_alike(volume):
    taps = volume.upsampling[3].taps
    for phase in range(8):
        i, j, k = phase & 1, phase >> 1 & 1, phase >> 2 & 1
        assert torch.equal(taps[:, i::2, j::2, k::2], taps[:, ::2, ::2, ::2])
    bound = math.sqrt(3) * math.sqrt(2 / 1.04) * math.sqrt(2 / (8 * 256 + 8 * 256))
    assert 0.99 * bound < taps.abs().max() <= bound * (1 + 1e-6)


def test_taps_that_nothing_reads_are_not_trained(volume):
    frozen = {name for name, p in volume.named_parameters() if not p.requires_grad}
    assert frozen == {"upsampling.0.unread"}
