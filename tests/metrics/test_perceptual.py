import pytest
import torch
from torch.nn import functional as F

from twofold.errors import TwofoldError
from twofold.metrics.perceptual import (
    ALEX_FILE,
    ALEX_LINEAR_FILE,
    FILES,
    LINEAR_FILE,
    LPIPS,
    VGG_FILE,
    load_lpips,
    lpips_cell,
    weights_hint,
)
from twofold.metrics.published_weights import find_weights, read_weights

NUMBERS = (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)
"""Convolutions in torchvision's list of VGG16's layers."""
CHANNELS = (64, 64, 128, 128, 256, 256, 256, 512, 512, 512, 512, 512, 512)
POOLINGS = (4, 9, 16, 23)
ENDS = (3, 8, 15, 22, 29)
"""Layers after which features are compared: relu1_2, relu2_2, relu3_3, relu4_3, relu5_3."""


@pytest.fixture(scope="module")
def published():
    """Both files' contents, with random numbers in the real layers' shapes."""
    generator = torch.Generator().manual_seed(0)
    vgg, inputs = {}, 3
    for number, outputs in zip(NUMBERS, CHANNELS, strict=True):
        spread = (2 / (9 * inputs)) ** 0.5
        vgg[f"features.{number}.weight"] = spread * torch.randn(outputs, inputs, 3, 3, generator=generator)
        vgg[f"features.{number}.bias"] = 0.1 * torch.randn(outputs, generator=generator)
        inputs = outputs
    vgg["classifier.0.weight"] = torch.zeros(2, 2)
    sizes = (64, 128, 256, 512, 512)
    linear = {f"lin{i}.model.1.weight": torch.rand(1, n, 1, 1, generator=generator) for i, n in enumerate(sizes)}
    return vgg, linear


@pytest.fixture(scope="module")
def folder(published, tmp_path_factory):
    """Both files as they are published; torchvision's is in the format from before torch 1.6."""
    folder = tmp_path_factory.mktemp("weights")
    torch.save(published[0], folder / VGG_FILE, _use_new_zipfile_serialization=False)  # noqa: TID251
    torch.save(published[1], folder / LINEAR_FILE)  # noqa: TID251
    return folder


def literal_lpips(first, second, vgg, linear, kept=None):
    """Layer by layer through torchvision's numbering, one image at a time; `kept` is what a dropout of half keeps."""

    def features(image):
        shift, scale = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
        x = ((2 * image - 1) - shift[:, None, None]) / scale[:, None, None]
        x, found = x[None], []
        for number in range(30):
            if number in NUMBERS:
                x = F.conv2d(x, vgg[f"features.{number}.weight"], vgg[f"features.{number}.bias"], padding=1)
            elif number in POOLINGS:
                x = F.max_pool2d(x, kernel_size=2, stride=2)
            else:
                x = x.clamp_min(0)
            if number in ENDS:
                found.append(x[0] / (x[0].square().sum(0).sqrt() + 1e-10))
        return found

    total = 0.0
    for i, (a, b) in enumerate(zip(features(first), features(second), strict=True)):
        squared = (a - b)[None].square()
        squared = squared if kept is None else torch.where(kept[i], 2 * squared, 0)
        total += F.conv2d(squared, linear[f"lin{i}.model.1.weight"]).mean().item()
    return total


def test_distance_is_the_layer_by_layer_reference(published, folder):
    model = load_lpips(folder, unverified=True)
    first, second = torch.rand(2, 3, 24, 20), torch.rand(2, 3, 24, 20)
    found = model(first, second)
    for i in range(2):
        assert found[i].item() == pytest.approx(literal_lpips(first[i], second[i], *published), rel=1e-4)


def test_dropout_leaves_out_half_of_the_squared_differences_and_doubles_the_rest(published, folder):
    first, second = torch.rand(2, 3, 24, 24), torch.rand(2, 3, 24, 24)
    found = load_lpips(folder, unverified=True)(first, second, 0.5, torch.Generator().manual_seed(5))
    source = torch.Generator().manual_seed(5)
    shapes = [(2, n, 24 // 2**i, 24 // 2**i) for i, n in enumerate((64, 128, 256, 512, 512))]
    kept = [torch.rand(shape, generator=source) >= 0.5 for shape in shapes]
    for i in range(2):
        exact = literal_lpips(first[i], second[i], *published, [k[i : i + 1] for k in kept])
        assert found[i].item() == pytest.approx(exact, rel=1e-4)
        assert exact != pytest.approx(literal_lpips(first[i], second[i], *published), rel=1e-3)


def small():
    model = LPIPS(((4,), (4, 6), (6,), (8,), (8,)))
    generator = torch.Generator().manual_seed(1)
    for parameter in [*model.blocks.parameters(), *model.linear.parameters()]:
        parameter.copy_(0.3 * torch.randn(parameter.shape, generator=generator).abs())
    return model


def test_distance_is_symmetric_and_zero_only_for_equal_images():
    model, first, second = small(), torch.rand(3, 3, 16, 16), torch.rand(3, 3, 16, 16)
    torch.testing.assert_close(model(first, second), model(second, first))
    assert (model(first, second) > 0).all()
    assert (model(first, first) == 0).all()


def test_gradients_reach_the_images_and_not_the_weights():
    model = small().double()
    first, second = torch.rand(1, 3, 16, 16, dtype=torch.float64).requires_grad_(), torch.rand(1, 3, 16, 16).double()
    model(first, second).sum().backward()
    assert first.grad.abs().sum() > 0
    assert all(not p.requires_grad for p in model.parameters())


def test_images_without_features_have_zero_distance_and_finite_gradients():
    model = small()
    for convolution in model.blocks.modules():
        if isinstance(convolution, torch.nn.Conv2d):
            convolution.bias.fill_(-100.0)
    first = torch.zeros(1, 3, 16, 16, requires_grad=True)
    distance = model(first, torch.zeros(1, 3, 16, 16)).sum()
    distance.backward()
    assert distance.item() == 0
    assert first.grad.isfinite().all()


def test_small_images_are_refused():
    with pytest.raises(ValueError, match="16 x 16"):
        small()(torch.zeros(1, 3, 8, 32), torch.zeros(1, 3, 8, 32))


def test_absent_files_give_none_and_a_hint_that_names_them(tmp_path):
    assert load_lpips(tmp_path) is None
    hint = weights_hint(tmp_path)
    assert all(word in hint for word in (str(tmp_path), VGG_FILE, LINEAR_FILE, "TWOFOLD_WEIGHTS"))
    assert "\n" not in hint


class Trap:
    """What a file of code looks like: unpickling it would raise the alarm."""

    def __reduce__(self):
        return (pytest.fail, ("code was run",))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "cannot be read as torchvision's VGG16"),
        (Trap(), "cannot be read as torchvision's VGG16"),
        ({"features.0.weight": torch.zeros(1)}, r"features.0.weight is of shape \(1,\), not of shape \(64, 3, 3, 3\)"),
        ({"other": torch.zeros(1)}, "features.0.weight is missing"),
        ([torch.zeros(1)], "features.0.weight is missing"),
    ],
    ids=["damaged", "code", "wrong size", "wrong names", "no names"],
)
def test_wrong_files_get_one_sentence_and_run_no_code(content, words, published, tmp_path):
    if content is None:
        (tmp_path / VGG_FILE).write_bytes(b"\x80\x02not a file of tensors")
    else:
        torch.save(content, tmp_path / VGG_FILE)  # noqa: TID251
    torch.save(published[1], tmp_path / LINEAR_FILE)  # noqa: TID251
    with pytest.raises(TwofoldError, match=words):
        load_lpips(tmp_path, unverified=True)


def test_weights_given_as_the_other_file_are_refused(published, folder, tmp_path):
    (tmp_path / VGG_FILE).symlink_to(folder / VGG_FILE)
    (tmp_path / LINEAR_FILE).symlink_to(folder / VGG_FILE)
    with pytest.raises(TwofoldError, match=r"lin0.model.1.weight is missing"):
        load_lpips(tmp_path, unverified=True)


def test_other_weights_are_refused_unless_they_are_meant_and_then_marked(folder, monkeypatch):
    monkeypatch.delenv("TWOFOLD_UNVERIFIED_WEIGHTS", raising=False)
    with pytest.raises(TwofoldError, match=r"is not the published torchvision's VGG16.*--unverified-weights"):
        load_lpips(folder)
    assert not load_lpips(folder, unverified=True).verified
    monkeypatch.setenv("TWOFOLD_UNVERIFIED_WEIGHTS", "1")
    assert not load_lpips(folder).verified


def test_feature_layers_of_an_installed_package_are_the_published_ones(tmp_path, monkeypatch):
    """Those that come with torchmetrics, in the real format and with the real hash."""
    monkeypatch.setenv("TWOFOLD_WEIGHTS", str(tmp_path))
    for network, file in FILES.items():
        found = find_weights(file[1])
        assert found.verified
        width = 64
        weights = read_weights(found, {"lin0.model.1.weight": (width,)})["lin0.model.1.weight"]
        assert (weights >= 0).all(), network
        assert weights.max() > 0


@pytest.fixture(scope="module")
def alex(tmp_path_factory):
    """AlexNet's two files with random numbers."""
    generator = torch.Generator().manual_seed(3)
    folder, network, linear, inputs = tmp_path_factory.mktemp("alex"), {}, {}, 3
    for i, (number, outputs, kernel) in enumerate(((0, 64, 11), (3, 192, 5), (6, 384, 3), (8, 256, 3), (10, 256, 3))):
        spread = (2 / (kernel**2 * inputs)) ** 0.5
        network[f"features.{number}.weight"] = spread * torch.randn(
            outputs, inputs, kernel, kernel, generator=generator
        )
        network[f"features.{number}.bias"] = 0.1 * torch.randn(outputs, generator=generator)
        linear[f"lin{i}.model.1.weight"] = torch.rand(1, outputs, 1, 1, generator=generator)
        inputs = outputs
    torch.save(network, folder / ALEX_FILE)  # noqa: TID251
    torch.save(linear, folder / ALEX_LINEAR_FILE)  # noqa: TID251
    return folder, network, linear


def test_alexnet_is_the_layer_by_layer_reference(alex):
    folder, network, linear = alex
    first, second = torch.rand(2, 3, 40, 35), torch.rand(2, 3, 40, 35)
    found = load_lpips(folder, "alex", unverified=True)(first, second)

    def features(image):
        shift, scale = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
        x, taps = ((2 * image - 1 - shift[:, None, None]) / scale[:, None, None])[None], []
        for number in range(12):
            if number in (0, 3, 6, 8, 10):
                stride, padding = (4, 2) if number == 0 else (1, 2 if number == 3 else 1)
                weight, bias = network[f"features.{number}.weight"], network[f"features.{number}.bias"]
                x = F.conv2d(x, weight, bias, stride=stride, padding=padding)
            elif number in (2, 5):
                x = F.max_pool2d(x, kernel_size=3, stride=2)
            else:
                x = x.clamp_min(0)
                taps.append(x[0] / (x[0].square().sum(0).sqrt() + 1e-10))
        return taps

    for i in range(2):
        total = sum(
            F.conv2d((a - b)[None].square(), linear[f"lin{k}.model.1.weight"]).mean().item()
            for k, (a, b) in enumerate(zip(features(first[i]), features(second[i]), strict=True))
        )
        assert found[i].item() == pytest.approx(total, rel=1e-4)
    with pytest.raises(ValueError, match="31 x 31"):
        load_lpips(folder, "alex", unverified=True)(first[:, :, :30], second[:, :, :30])


def test_a_cell_without_weights_says_what_to_put_where(tmp_path):
    assert lpips_cell(tmp_path, "alex") == f"n/a (put {ALEX_FILE} and {ALEX_LINEAR_FILE} in {tmp_path})"
