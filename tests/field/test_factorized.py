import math
import subprocess
import sys
import textwrap
from dataclasses import replace

import pytest
import torch
from torch.nn import functional as F

from twofold.field.factorized import FactorizedField, FactorizedFieldConfig

RELEASED = FactorizedFieldConfig()
PAPER = FactorizedFieldConfig(
    include_pi=True,
    gate_width=None,
    base_color="linear",
    sdf_head="linear",
    color_sees_position=False,
    normals="canonical",
    pose_code=None,
    feature_code=None,
    activation="relu",
)
ABLATIONS = {
    "released": RELEASED,
    "paper": PAPER,
    "paper with softplus": replace(PAPER, activation="softplus"),
    "w/o {s1, c1}": replace(RELEASED, branches="high"),
    "w/o {s2, c2}": replace(RELEASED, branches="low"),
    "w/o feat": replace(RELEASED, share_features=False),
    "Pose_lf": replace(RELEASED, pose_into="low"),
    "Pose_lf, one branch": replace(RELEASED, pose_into="low", branches="low"),
    "w/o comm": replace(RELEASED, branches="high_rendered"),
    "w/o comm, as printed": replace(PAPER, activation="softplus", branches="high_rendered"),
    "no weight norm, no skip": replace(RELEASED, weight_norm=False, high_skip=None),
}
POSE_SIZE = 6


def small(config: FactorizedFieldConfig) -> FactorizedFieldConfig:
    return replace(
        config,
        low_octaves=2,
        high_octaves=3,
        width=26,
        low_sdf_depth=2,
        low_color_depth=1,
        high_sdf_depth=4,
        high_skip=None if config.high_skip is None else 2,
        high_color_depth=2,
        pose_code=None if config.pose_code is None else 4,
        feature_code=None if config.feature_code is None else 5,
    )


def off_the_start(field: FactorizedField) -> FactorizedField:
    """In double precision, and no weight zero, so that every connection counts."""
    field = field.double()
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for parameter in field.parameters():
            noise = torch.randn(parameter.shape, generator=generator, dtype=torch.float64)
            parameter.add_(0.3 * noise * parameter.abs().mean().clamp_min(0.1))
    return field


@pytest.fixture(params=ABLATIONS.values(), ids=ABLATIONS.keys())
def config(request):
    return small(request.param)


@pytest.fixture
def inputs():
    generator = torch.Generator().manual_seed(7)

    def random(*shape):
        return torch.randn(*shape, dtype=torch.float64, generator=generator)

    return [0.3 * random(5, 3), random(POSE_SIZE), torch.eye(3, dtype=torch.float64) + 0.3 * random(5, 3, 3)]


def make(config: FactorizedFieldConfig) -> FactorizedField:
    return off_the_start(config.build(None, POSE_SIZE, torch.Generator().manual_seed(1)))


def literal_encoding(x, octaves, include_pi):
    """Equations 2 and 4, term by term."""
    terms = [x]
    for k in range(octaves):
        terms += [f(2**k * (math.pi if include_pi else 1) * x) for f in (torch.sin, torch.cos)]
    return torch.cat(terms, -1)


def literal_mlp(network, columns):
    """The concatenated form; returns the answer and the last hidden layer."""
    config, h = network.config, torch.cat(columns, -1)
    for i, layer in enumerate(network.layers):
        if i == config.skip_layer:
            h = torch.cat([h, columns[0]], -1) / math.sqrt(2)
        matrix = layer.direction
        if config.weight_norm:
            matrix = layer.gain * matrix / matrix.norm(dim=1, keepdim=True)
        last, h = h, h @ matrix.T + layer.bias
        if i < config.depth:
            h = F.softplus(h, beta=100) if config.activation == "softplus" else h.relu()
    return h.tanh() if config.head == "tanh" else h, last


def literal_field(field, x, pose, matrix):
    """Equations 2 to 6 as printed, with the released program's differences where the configuration asks for them."""
    config, x = field.config, x.detach().requires_grad_() if not x.requires_grad else x
    poses = [pose.expand(len(x), -1)]
    position = [x] if config.color_sees_position else []
    released_color = torch.sigmoid if config.base_color == "sigmoid" else lambda c: c

    def normal(gradient):
        turned = gradient if config.normals == "canonical" else torch.einsum("sij,sj->si", matrix, gradient)
        return turned / turned.norm(dim=1, keepdim=True)

    def slope(s):
        return torch.autograd.grad(s.sum(), x, create_graph=True)[0]

    def code(branch):
        return poses if branch.pose_code is None else [branch.pose_code(poses[0])]

    answer = {}
    low_posed, high_posed = config.pose_into == "low", config.pose_into == "high"
    if field.low is not None:
        encoded = literal_encoding(x, config.low_octaves, config.include_pi)
        out, _ = literal_mlp(field.low.sdf, [encoded, *(poses if low_posed else [])])
        s1, f_sdf, g1 = out[:, 0], out[:, 1:], slope(out[:, 0])
        c1, f_c = literal_mlp(field.low.color, [*position, normal(g1), f_sdf, *(code(field.low) if low_posed else [])])
        answer["base"] = s1, released_color(c1), g1
    if field.high is None:
        return answer.pop("base"), None
    encoded = literal_encoding(x, config.high_octaves, config.include_pi)
    handed = field.low is not None and config.share_features
    columns = [encoded, *([f_sdf] if handed else []), *(poses if high_posed else [])]
    out, _ = literal_mlp(field.high.sdf, columns)
    s2, f, g2 = out[:, 0], out[:, 1:], slope(out[:, 0])
    both = config.branches == "both"
    w = 1.0
    if both and config.gate_width is not None:
        w = (1 / (1 + (s1 / config.gate_width) ** 4)).detach()
    g = slope(s1 + w * s2) if both else g2
    told = [] if not handed else [f_c if field.high.feature_code is None else field.high.feature_code(f_c)]
    columns = [*position, normal(g), f, *told, *(code(field.high) if high_posed else [])]
    c2, _ = literal_mlp(field.high.color, columns)
    if not both:
        return (s2, released_color(c2), g2), answer.get("base")
    weight = w if isinstance(w, float) else w[:, None]
    return (s1 + w * s2, answer["base"][1] + weight * c2, g), answer["base"]


def test_field_is_the_papers_equations(config, inputs):
    field = make(config)
    output = field(*inputs)
    whole, base = literal_field(field, *inputs)
    for part, expected in [(output, whole), *([] if base is None else [(output.base, base)])]:
        for ours, theirs in zip((part.sdf, part.color, part.gradient), expected, strict=True):
            torch.testing.assert_close(ours, theirs)
    assert (output.base is None) == (base is None)


def random_loss(outputs):
    generator = torch.Generator().manual_seed(11)
    total = torch.zeros((), dtype=torch.float64)
    for output in outputs:
        weight = torch.randn(output.shape, dtype=torch.float64, generator=generator)
        total = total + (weight * output.square()).sum()
    return total


def everything(field, inputs):
    output = field(*inputs)
    parts = [output.sdf, output.color, output.gradient]
    if output.base is not None:
        parts += [output.base.sdf, output.base.color, output.base.gradient]
    return [*parts, *field.distance_and_gradient(*inputs[:2]), field.sdf(*inputs[:2])]


def test_hand_written_gradients_equal_automatic_ones_in_value_and_in_training(config, inputs):
    by_hand = make(config)
    automatic = make(replace(config, gradients="autograd"))
    automatic.load_state_dict(by_hand.state_dict())
    results = []
    for field in (by_hand, automatic):
        given = [t.clone().requires_grad_() for t in inputs]
        outputs = everything(field, given)
        gradients = torch.autograd.grad(random_loss(outputs), [*field.parameters(), *given], allow_unused=True)
        results.append((outputs, gradients))
    for a, b in zip(results[0][0], results[1][0], strict=True):
        torch.testing.assert_close(a, b, rtol=1e-7, atol=1e-9)
    used = 0
    for a, b in zip(results[0][1], results[1][1], strict=True):
        assert (a is None or not a.any()) == (b is None or not b.any())
        if a is not None and b is not None:
            torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-7)
            used += 1
    assert used >= len(list(by_hand.parameters()))


def test_parts_of_the_interface_agree(config, inputs):
    field = make(config)
    output = field(*inputs)
    sdf, gradient = field.distance_and_gradient(*inputs[:2])
    for other in (sdf, field.sdf(*inputs[:2])):
        torch.testing.assert_close(other, output.sdf)
    torch.testing.assert_close(gradient, output.gradient)


def test_gradient_is_the_slope_of_the_distance_where_no_gate_is_held_fixed(inputs):
    field = make(small(replace(PAPER, activation="softplus")))
    x, pose, _ = inputs
    x.requires_grad_()
    (slope,) = torch.autograd.grad(field.sdf(x, pose).sum(), x)
    torch.testing.assert_close(field.distance_and_gradient(x, pose)[1], slope)


def test_gradcheck(inputs):
    # The gate would be held fixed by the one side and not by the other.
    config = replace(small(RELEASED), low_octaves=1, high_octaves=1, width=11, gate_width=None)
    field = make(config)
    points, matrix = inputs[0][:2].requires_grad_(), inputs[2][:2].requires_grad_()

    def color(points, pose, matrix, parameter):
        given = {"low.sdf.layers.0.gain": parameter}
        return torch.func.functional_call(field, given, (points, pose, matrix)).color

    parameter = field.low.sdf.layers[0].gain
    assert torch.autograd.gradcheck(color, (points, inputs[1].requires_grad_(), matrix, parameter), atol=1e-4)


TABLE = {
    "full": (RELEASED, 1_305_571),
    "w/o {s1, c1}": (replace(RELEASED, branches="high"), 815_803),
    "w/o {s2, c2}": (replace(RELEASED, branches="low"), 407_817),
    "w/o L_com": (RELEASED, 1_305_571),
    "w/o feat": (replace(RELEASED, share_features=False), 1_223_619),
    "Pose_lf": (replace(RELEASED, pose_into="low"), 1_305_571),
    "w/o comm": (replace(RELEASED, branches="high_rendered"), 1_305_571),
    "[5]": (replace(RELEASED, branches="high", high_octaves=5), 815_863),
    "[6]": (replace(RELEASED, branches="high", high_octaves=6), 815_851),
    "[8]": (replace(RELEASED, branches="high", high_octaves=8), 815_827),
    "[10]": (replace(RELEASED, branches="high", high_octaves=10), 815_803),
    "[6,6]": (replace(RELEASED, low_octaves=6, high_octaves=6), 1_307_155),
    "[6,8]": (replace(RELEASED, low_octaves=6, high_octaves=8), 1_307_131),
    "[6,10]": (replace(RELEASED, low_octaves=6, high_octaves=10), 1_307_107),
    "[8,8]": (replace(RELEASED, low_octaves=8, high_octaves=8), 1_310_203),
    "[8,10]": (replace(RELEASED, low_octaves=8, high_octaves=10), 1_310_179),
    "[10,10]": (replace(RELEASED, low_octaves=10, high_octaves=10), 1_313_251),
}


@pytest.mark.parametrize(("config", "count"), TABLE.values(), ids=TABLE.keys())
def test_parameters_are_as_many_as_released(config, count):
    """The counts include the density's scale beta, one number, which the method holds and not the field."""
    field = config.build()
    groups = field.parameter_groups()
    assert sum(p.numel() for p in field.parameters()) + 1 == count
    assert sum(p.numel() for group in groups.values() for p in group) + 1 == count


def test_networks_have_the_released_sizes():
    field = RELEASED.build()
    sizes = {
        "low sdf": (field.low.sdf, 273_410),
        "low colour": (field.low.color, 134_406),
        "high sdf": (field.high.sdf, 612_228),
        "pose code": (field.high.pose_code, 560),
        "feature code": (field.high.feature_code, 8_224),
        "high colour": (field.high.color, 285_526 - 560 - 8_224),
    }
    assert {name: sum(p.numel() for p in m.parameters()) for name, (m, _) in sizes.items()} == {
        name: count for name, (_, count) in sizes.items()
    }
    assert field.high.sdf.config.layer_sizes()[:4] == [(388, 256), (256, 256), (256, 193), (256, 256)]


def test_groups_name_the_branches():
    groups = RELEASED.build().parameter_groups()
    assert set(groups) == {"low", "high"}
    assert sum(p.numel() for p in groups["low"]) == 273_410 + 134_406
    assert replace(RELEASED, branches="low").build().parameter_groups()["high"] == []


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"branches": "high", "pose_into": "low"}, ["branches", "pose_into"]),
        ({"branches": "high_rendered", "share_features": False}, ["branches", "share_features"]),
        ({"high_skip": 8}, ["high_skip", "high_sdf_depth"]),
        ({"width": 63}, ["width=63", "high_octaves=10"]),
        ({"gate_width": 0.0}, ["gate_width"]),
    ],
)
def test_clashing_options_are_refused_by_name(options, named):
    with pytest.raises(ValueError) as caught:  # noqa: PT011
        replace(RELEASED, **options)
    assert all(word in str(caught.value) for word in named)


def test_base_branch_does_not_see_the_pose(inputs):
    field = make(small(RELEASED))
    x, pose, matrix = inputs
    first, second = field(x, pose, matrix), field(x, -pose, matrix)
    assert torch.equal(first.base.sdf, second.base.sdf)
    assert torch.equal(first.base.color, second.base.color)
    assert not torch.allclose(first.sdf, second.sdf)


def test_gate_closes_away_from_the_base_surface(inputs):
    field = make(small(RELEASED))
    base = torch.tensor([0.0, 0.05, -0.05, 0.1, 1.0], dtype=torch.float64, requires_grad=True)
    detail = torch.ones(5, dtype=torch.float64)
    share = field.combine(torch.zeros_like(detail), detail, base)
    torch.testing.assert_close(share, torch.tensor([1, 0.5, 0.5, 1 / 17, 1 / 160_001], dtype=torch.float64))
    assert not share.requires_grad


def test_field_is_the_same_on_every_device(config, inputs, device):
    field = make(config)
    expected = everything(field, inputs)
    found = everything(field.to(device), [t.to(device) for t in inputs])
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a.cpu(), b)


def test_no_points_give_no_answers(config, inputs):
    empty = [inputs[0][:0], inputs[1], inputs[2][:0]]
    assert make(config)(*empty).color.shape == (0, 3)


def test_automatic_twin_works_without_a_graph_outside(inputs):
    field = make(small(replace(RELEASED, gradients="autograd"))).eval()
    with torch.no_grad():
        output = field(*inputs)
        sdf, gradient = field.distance_and_gradient(*inputs[:2])
    assert not output.sdf.requires_grad
    assert not output.base.gradient.requires_grad
    assert not gradient.requires_grad
    torch.testing.assert_close(sdf, output.sdf)


def test_starts_near_a_sphere_and_repeats_by_seed():
    fields = [RELEASED.build(generator=torch.Generator().manual_seed(s)) for s in (0, 0)]
    x = torch.randn(300, 3, generator=torch.Generator().manual_seed(1))
    x = F.normalize(x, dim=1) * torch.linspace(0.1, 1.2, 300)[:, None]
    pose = torch.zeros(69)
    with torch.no_grad():
        first, second = (field(x, pose, None) for field in fields)
    assert torch.equal(first.color, second.color)
    assert (first.base.sdf - (x.norm(dim=1) - 0.6).tanh()).abs().mean() < 0.15


@pytest.mark.slow
def test_compiles_into_one_graph_with_first_order_training():
    """Runs by itself, since a compiler cannot look into functions whose shapes are being checked."""
    program = """
        import torch
        from twofold.field.factorized import FactorizedFieldConfig
        config = FactorizedFieldConfig(width=12, low_octaves=1, high_octaves=1, low_sdf_depth=1, low_color_depth=1,
                                       high_sdf_depth=2, high_skip=1, high_color_depth=1)
        field = config.build(None, 4, torch.Generator().manual_seed(0))
        x, pose, matrix = torch.randn(8, 3), torch.randn(4), torch.randn(8, 3, 3)
        def loss(field, x, pose, matrix):
            out = field(x, pose, matrix)
            return out.color.mean() + out.base.color.mean() + (out.gradient.norm(dim=1) - 1).square().mean()
        for dynamic in (None, True):
            torch._dynamo.reset()
            compiled = torch.compile(loss, backend="aot_eager", fullgraph=True, dynamic=dynamic)
            for rows in (8, 5):  # As many samples as a step happens to have.
                given = field, x[:rows], pose, matrix[:rows]
                pairs = [torch.autograd.grad(f(*given), list(field.parameters())) for f in (loss, compiled)]
                torch.testing.assert_close(*pairs)
    """
    subprocess.run([sys.executable, "-c", textwrap.dedent(program)], check=True, timeout=120)
