"""The field on grids against its formulas written out, in every ablation."""

import copy
import functools
from dataclasses import replace

import pytest
import torch
from little_body import ball

from twofold.body.skeleton import JOINT_NAMES, PosedBody, canonical_pose
from twofold.field.factorized_grid import GridFieldConfig, points_of
from twofold.field.grids import Lattices, interpolate

SMALL = GridFieldConfig(
    low_voxels=(0.2, 0.11), high_voxels=(0.07,), features=2, width=10, shared=3, pose_code=3, radius=0.08
)
ABLATIONS = {
    "whole": SMALL,
    "plain sum": replace(SMALL, gate_width=None),
    "w/o {s1, c1}": replace(SMALL, branches="high"),
    "w/o {s2, c2}": replace(SMALL, branches="low"),
    "w/o feat": replace(SMALL, share_features=False),
    "Pose_lf": replace(SMALL, pose_into="low"),
    "Pose_lf, one branch": replace(SMALL, pose_into="low", branches="low"),
    "Pose_lf, without low branch": replace(SMALL, pose_into="low", branches="high"),
    "w/o comm": replace(SMALL, branches="high_rendered"),
    "bands by part": replace(SMALL, detail_voxels=(0.05,), detail_parts=("head",)),
}
POSE_SIZE = 6
HEAD = JOINT_NAMES.index("head")


def ball_body():
    points, faces = ball(1200, 0.2)
    vertices = torch.from_numpy(points)
    return PosedBody(
        vertices=vertices,
        canonical_vertices=vertices,
        faces=torch.from_numpy(faces),
        weights=torch.nn.functional.one_hot(torch.where(vertices[:, 1] > -0.02, HEAD, 0), 24).to(vertices),
        bones=torch.eye(4).expand(24, 4, 4),
        joints=torch.zeros(24, 3),
        pose=canonical_pose(),
    )


BODY = ball_body()


@functools.cache
def built(config, seed):
    return config.build(BODY, POSE_SIZE, torch.Generator().manual_seed(seed))


def make(config, seed=1):
    return copy.deepcopy(built(config, seed))


def off_the_start(field):
    """No weight zero and no branch negligible, so that every connection counts."""
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for name, parameter in field.named_parameters():
            size = 1.0 if "grid" in name else 0.3
            parameter.add_(size * torch.randn(parameter.shape, generator=generator))
    return field


@pytest.fixture(params=ABLATIONS.values(), ids=ABLATIONS.keys())
def config(request):
    return request.param


def inputs(count=40, dtype=torch.float64):
    generator = torch.Generator().manual_seed(7)
    which = torch.randint(len(BODY.vertices), (count,), generator=generator)
    x = BODY.vertices[which] + 0.03 * torch.randn(count, 3, generator=generator)
    turns = torch.eye(3) + 0.3 * torch.randn(count, 3, 3, generator=generator)
    return x.to(dtype), torch.randn(POSE_SIZE, generator=generator).to(dtype), turns.to(dtype)


def literal_net(net, columns, code):
    """Two hidden layers on the columns, the pose code beside them."""
    weight = net.first.weight
    if net.condition is not None:
        columns, weight = [*columns, code.expand(len(columns[0]), -1)], torch.cat([weight, net.condition.weight], 1)
    hidden = torch.cat(columns, -1) @ weight.T + net.first.bias
    hidden = hidden.clamp_min(0) @ net.second.weight.T + net.second.bias
    return hidden.clamp_min(0) @ net.last.weight.T + net.last.bias


def gradient_by(x, values):
    return torch.autograd.grad(values.sum(), x, create_graph=True)[0]


def literal_field(field, x, pose, to_observation):
    """Distances, gradients and colours as the paper tells them: s, g, c, and s1, g1, c1 (None without low branch)."""
    config, x = field.config, x.clone().requires_grad_()
    lattices = Lattices(field.prior_rows, field.prior_place, field.prior_shape)
    prior = interpolate(field.prior, x, lattices)[:, 0]
    code = field.pose_code(pose) if hasattr(field, "pose_code") else None
    has_low, has_high = config.branches != "high", config.branches != "low"
    s1 = g1 = c1 = None

    def light(gradient):
        turned = (to_observation @ gradient.detach()[..., None])[..., 0]
        x, y, z = (turned / turned.norm(dim=-1, keepdim=True)).unbind(-1)
        return torch.exp(torch.stack([x, y, z, x * x, y * y, z * z, x * z, y * x, z * y], -1) @ field.light.weight.T)

    if has_low:
        low = field.low_grid(x)
        answer = literal_net(field.low_sdf, [low], code)
        s1, f1 = prior + 0.1 * answer[:, 0], answer[:, 1:]
        g1 = gradient_by(x, s1)
        answer = literal_net(field.low_color, [low, f1], code)
        c1, h1 = torch.sigmoid(answer[:, :3]), answer[:, 3:]
        if not has_high:
            return s1, g1, c1 * light(g1), s1, g1, c1 * light(g1)
    shared = has_low and config.share_features
    high = field.high_grid(x)
    answer = literal_net(field.high_sdf, [high, f1] if shared else [high], code)
    s2, f2 = 0.1 * answer[:, 0], answer[:, 1:]
    alone = config.branches != "both"
    gated = not alone and config.gate_width is not None
    gate = (1 / (1 + (s1 / config.gate_width) ** 4)).detach() if gated else torch.ones_like(s2)
    s = (prior if alone else s1) + gate * s2
    g = gradient_by(x, s)
    c2 = literal_net(field.high_color, [high, f2, *([h1.clamp_min(0)] if shared else [])], code)
    c = torch.sigmoid(c2) if alone else c1 + gate[:, None] * c2
    return s, g, c * light(g), s1, g1, None if c1 is None else c1 * light(g1)


def test_field_is_its_formulas_written_out(config):
    field = off_the_start(make(config)).double()
    x, pose, turns = inputs()
    out = field(x, pose, turns)
    s, g, c, s1, g1, c1 = literal_field(field, x, pose, turns)
    torch.testing.assert_close([out.sdf, out.gradient, out.color], [s, g, c])
    assert (out.base is None) == (config.branches in ("low", "high"))
    if out.base is not None:
        torch.testing.assert_close([out.base.sdf, out.base.gradient, out.base.color], [s1, g1, c1])
        assert (s - s1).abs().max() > 1e-3, "the test has something to see"


def parameter_gradients(field, loss):
    named = list(field.named_parameters())
    found = torch.autograd.grad(loss, [p for _, p in named], allow_unused=True)
    return {name: torch.zeros_like(p) if g is None else g for (name, p), g in zip(named, found, strict=True)}


def test_rendered_values_train_every_parameter_as_the_formulas_do(config):
    field = off_the_start(make(config)).double()
    x, pose, turns = inputs()
    out = field(x, pose, turns)
    values = [(out.sdf, out.color), *([(out.base.sdf, out.base.color)] if out.base else [])]
    found = parameter_gradients(field, sum(torch.sin(5 * s).sum() + torch.cos(c).sum() for s, c in values))
    s, _, c, s1, _, c1 = literal_field(field, x, pose, turns)
    values = [(s, c), *([(s1, c1)] if out.base else [])]
    expected = parameter_gradients(field, sum(torch.sin(5 * s).sum() + torch.cos(c).sum() for s, c in values))
    torch.testing.assert_close(found, expected)
    unused = {name for name, gradient in found.items() if not gradient.any()}
    assert not unused


@pytest.mark.parametrize("compiled", [False, True], ids=["double", "compiled"])
def test_eikonal_loss_trains_the_parameters_as_autograd_does(config, compiled):
    field = off_the_start(make(config))
    x, pose, turns = inputs()
    if compiled:
        _, g = field.distance_and_gradient(x.float(), pose.float())
        found = parameter_gradients(field, ((g.norm(dim=-1) - 1) ** 2).mean())
        field = field.double()
    else:
        field = field.double()
        _, g = field.distance_and_gradient(x, pose)
        found = parameter_gradients(field, ((g.norm(dim=-1) - 1) ** 2).mean())
    g = literal_field(field, x, pose, turns)[1]
    expected = parameter_gradients(field, ((g.norm(dim=-1) - 1) ** 2).mean())
    assert any(gradient.any() for gradient in expected.values())
    for name, gradient in expected.items():
        error = (found[name].double() - gradient).abs().max()
        assert error <= (2e-3 if compiled else 1e-9) * max(float(gradient.abs().max()), 1e-6), name


def test_gradient_is_the_slope_of_the_distance_where_no_gate_is_held_fixed(config):
    field = off_the_start(make(replace(config, gate_width=None))).double()
    x, pose, _ = inputs()
    slopes = []
    for axis in torch.eye(3, dtype=torch.float64):
        ahead, behind = (field.sdf(x + sign * 1e-7 * axis, pose) for sign in (1, -1))
        slopes.append((ahead - behind) / 2e-7)
    _, gradient = field.distance_and_gradient(x, pose)
    torch.testing.assert_close(gradient, torch.stack(slopes, -1), atol=1e-5, rtol=0)


def test_all_ways_to_ask_give_the_same_distance(config):
    field = off_the_start(make(config))
    x, pose, turns = inputs(dtype=torch.float32)
    s, gradient = field.distance_and_gradient(x, pose)
    out = field(x, pose, turns)
    assert torch.equal(field.sdf(x, pose), s)
    assert torch.equal(out.sdf, s)
    assert torch.equal(out.gradient, gradient)
    assert gradient.requires_grad
    assert not out.gradient.requires_grad, "rendered normals are constants"
    with torch.no_grad():
        assert not field.distance_and_gradient(x, pose)[1].requires_grad
        assert torch.equal(field(x, pose, turns).color, out.color)


def test_compiled_form_is_its_double_twin(config):
    field = off_the_start(make(config))
    x, pose, turns = inputs()
    single = field(x.float(), pose.float(), turns.float())
    double = field.double()(x, pose, turns)
    torch.testing.assert_close(single.sdf.double(), double.sdf, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(single.gradient.double(), double.gradient, atol=1e-3, rtol=1e-3)
    torch.testing.assert_close(single.color.double(), double.color, atol=1e-3, rtol=1e-3)


def test_it_starts_as_the_naked_body_and_grey(config):
    field = make(config)
    x, pose, turns = inputs(dtype=torch.float32)
    # Poses are told as parts of half a turn.
    out = field(x, 0.1 * pose, turns)
    exact = (x - torch.tensor([0.2, -0.1, 0.4])).norm(dim=-1) - 0.2
    assert (out.sdf - exact).abs().max() < 0.01
    assert (out.sdf - exact).abs().mean() < 0.005
    assert (out.color - 0.5).abs().max() < 0.25
    assert (out.gradient.norm(dim=-1) - 1).abs().median() < 0.1


def test_only_the_branch_that_is_told_the_pose_depends_on_it(config):
    field = off_the_start(make(config))
    x, pose, turns = inputs(dtype=torch.float32)
    first, second = field(x, pose, turns), field(x, -pose, turns)
    told = config.branches != "low" or config.pose_into == "low"
    assert torch.equal(first.sdf, second.sdf) != told
    assert torch.equal(first.color, second.color) != told
    if first.base is not None:
        assert torch.equal(first.base.sdf, second.base.sdf) == (config.pose_into == "high")
        assert torch.equal(first.base.color, second.base.color) == (config.pose_into == "high")


def test_gate_is_half_open_at_its_width_and_closes_beyond():
    field, plain = (off_the_start(make(replace(SMALL, gate_width=w))).double() for w in (0.05, None))
    x, pose, turns = inputs(400)
    gated, summed = field(x, pose, turns), plain(x, pose, turns)
    detail = summed.sdf - summed.base.sdf
    s1 = summed.base.sdf
    share = (gated.sdf - gated.base.sdf) / detail
    torch.testing.assert_close(share, 1 / (1 + (s1 / 0.05) ** 4))
    assert (share[s1.abs() < 0.01] > 0.99).all()
    assert (share[(s1.abs() - 0.05).abs() < 0.002] - 0.5).abs().max() < 0.1
    assert (share[s1.abs() > 0.15] < 0.02).all()


def test_without_turning_colours_see_canonical_normals():
    field = off_the_start(make(SMALL))
    x, pose, _ = inputs(dtype=torch.float32)
    straight = field(x, pose, torch.eye(3).expand(len(x), 3, 3))
    torch.testing.assert_close(field(x, pose, None).color, straight.color)


def test_far_away_everything_is_finite(config):
    field = off_the_start(make(config))
    x, pose, turns = inputs(dtype=torch.float32)
    x = x * torch.logspace(0, 3, len(x))[:, None]
    out = field(x, pose, turns)
    for value in (out.sdf, out.color, out.gradient):
        assert value.isfinite().all()
    assert (make(config)(x, pose, turns).sdf[20:] > 0.03).all(), "empty space at the start"


def test_no_points_give_no_values(config):
    out = make(config)(torch.zeros(0, 3), torch.zeros(POSE_SIZE), torch.zeros(0, 3, 3))
    assert out.sdf.shape == (0,)
    assert out.color.shape == out.gradient.shape == (0, 3)


def test_parameter_groups_hold_each_parameter_once(config):
    field = make(config)
    grouped = [id(p) for group in field.parameter_groups().values() for p in group]
    assert sorted(grouped) == sorted(map(id, field.parameters()))
    tables = [p for name, p in field.named_parameters() if name.endswith("table")]
    assert list(map(id, field.parameter_groups()["grid"])) == list(map(id, tables))


def test_generator_decides_the_start_and_the_state_holds_parameters_only(config):
    first, second, other = (config.build(BODY, POSE_SIZE, torch.Generator().manual_seed(s)) for s in (1, 1, 2))
    assert list(first.state_dict()) == [name for name, _ in first.named_parameters()]
    for name, value in first.state_dict().items():
        assert torch.equal(value, second.state_dict()[name])
    assert any(not torch.equal(v, other.state_dict()[n]) for n, v in first.state_dict().items())


def test_field_answers_alike_on_every_device(device):
    x, pose, turns = inputs()
    expected = off_the_start(make(SMALL)).double()(x, pose, turns)
    there = off_the_start(make(SMALL)).double().to(device)
    found = there(x.to(device), pose.to(device), turns.to(device))
    torch.testing.assert_close([found.sdf.cpu(), found.color.cpu()], [expected.sdf, expected.color])


def test_fine_levels_of_the_base_branch_vary_near_the_named_parts_alone():
    field = off_the_start(make(replace(ABLATIONS["bands by part"], detail_voxels=(0.02,), radius=0.02)))
    x = BODY.vertices
    away = torch.cdist(x, x[x[:, 1] > -0.02]).amin(1)
    fine = field.low_grid(x)[:, -SMALL.features :]
    reach = 0.02 + 3 * 0.02 * 3**0.5
    assert (away > reach).any()
    far = fine[away > reach]
    torch.testing.assert_close(far, far[:1].expand_as(far))
    assert fine[away == 0].std(0).min() > 0.1


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"detail_parts": ("nose",)}, "names 'nose'; the joints are pelvis"),
        ({"detail_voxels": (0.02,), "detail_parts": ()}, "should name a joint or several"),
        ({"detail_voxels": (0.0,)}, "detail_voxels"),
    ],
)
def test_refuses_parts_and_spacings_that_do_not_exist(changes, said):
    with pytest.raises(ValueError, match=said):
        replace(SMALL, **changes)


def test_parts_without_a_vertex_are_named():
    with pytest.raises(ValueError, match="no vertex of the body belongs to left_hand"):
        points_of(BODY, ("left_hand",))
