"""Where weights are found, and which are taken for the published ones."""

import hashlib

import pytest
import torch

from twofold.errors import TwofoldError
from twofold.metrics.published_weights import WeightFile, find_weights, missing_sentence, read_weights, weights_folder


@pytest.fixture
def file(tmp_path):
    """A small file of weights and its description."""
    torch.save({"a": torch.arange(3.0)[None, :, None]}, tmp_path / "small.pth")  # noqa: TID251
    digest = hashlib.sha256((tmp_path / "small.pth").read_bytes()).hexdigest()
    return WeightFile("small.pth", digest[:8], "a small network", "https://example.org/small.pth")


@pytest.fixture(autouse=True)
def elsewhere(monkeypatch, tmp_path):
    """No weights of this machine."""
    for name in ("TWOFOLD_WEIGHTS", "TORCH_HOME", "TWOFOLD_UNVERIFIED_WEIGHTS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def test_folder_follows_the_environment(monkeypatch, tmp_path):
    assert weights_folder() == tmp_path / "cache" / "twofold" / "weights"
    monkeypatch.setenv("TWOFOLD_WEIGHTS", str(tmp_path / "mine"))
    assert weights_folder() == tmp_path / "mine"


def test_a_file_is_known_by_its_hash(file, tmp_path):
    found = find_weights(file, tmp_path)
    assert found.verified
    assert read_weights(found, {"a": (3,)})["a"].tolist() == [0, 1, 2]
    other = WeightFile("small.pth", "00000000", file.what, file.address)
    with pytest.raises(TwofoldError, match=r"not the published a small network: .* expected 00000000"):
        find_weights(other, tmp_path)
    assert not find_weights(other, tmp_path, unverified=True).verified


@pytest.mark.parametrize("home", ["cache/torch", "elsewhere"])
def test_torchs_cache_is_searched_where_no_folder_is_given(home, file, tmp_path, monkeypatch):
    if home == "elsewhere":
        monkeypatch.setenv("TORCH_HOME", str(tmp_path / home))
    assert find_weights(file) is None
    place = tmp_path / home / "hub" / "checkpoints"
    place.mkdir(parents=True)
    (place / "small.pth").write_bytes(b"another file of that name")
    assert find_weights(file) is None
    (place / "small.pth").write_bytes((tmp_path / "small.pth").read_bytes())
    assert find_weights(file).path == place / "small.pth"
    assert find_weights(file, tmp_path / "cache") is None


def test_what_is_missing_is_one_sentence(file, tmp_path):
    sentence = missing_sentence("KID", (file,), tmp_path)
    assert "put small.pth from https://example.org/small.pth there" in sentence
