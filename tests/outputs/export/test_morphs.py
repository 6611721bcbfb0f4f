"""Surfaces pulled back through the rig, and their principal components."""

import dataclasses
import inspect

import pytest
import torch
from tiny_person import person_body

from twofold.body.skeleton import pose_body, shape_body, skin
from twofold.geometry.rotations import rigid_inverse
from twofold.geometry.surfaces import vertex_normals
from twofold.outputs.export.morphs import Skin, bounded_weights, fit_morphs, morph_errors, pull_back

GROWN = 0.006


class Grown:
    """Stands in for an avatar whose surface is the posed body, grown by a little along its normals."""

    def __init__(self, posed) -> None:
        self.posed = posed
        self.normals = vertex_normals(posed.vertices, posed.faces)

    def to_canonical(self, x, _posed):
        away = (x[:, None] - self.posed.vertices[None]).norm(dim=-1)
        nearest = away.argmin(-1)
        height = ((x - self.posed.vertices[nearest]) * self.normals[nearest]).sum(-1)
        self.height = height
        return self.posed.canonical_vertices[nearest], torch.eye(3).expand(len(x), 3, 3)

    def level(self, _x, _posed, _branch):
        return 1.4 * (self.height - GROWN)  # a slope that the search has to find


@dataclasses.dataclass
class Posed:
    body: object


def test_pulled_back_surface_skins_to_the_avatars_own() -> None:
    shaped = shape_body(person_body(), torch.zeros(1))
    generator = torch.Generator().manual_seed(0)
    pose = 0.2 * torch.randn(24, 3, generator=generator)
    rest = pose_body(shaped, torch.zeros(24, 3), torch.zeros(3))
    body = pose_body(shaped, pose, torch.tensor([0.3, 0.1, -2.0]))
    surface = Skin(shaped.vertices, rest.canonical_vertices, shaped.faces, shaped.weights, rest)
    avatar = Grown(body)
    # Without the check of types: the stand-in has only what is asked of an avatar here.
    back = inspect.unwrap(pull_back)(avatar, Posed(body), surface)
    assert back.found.float().mean() > 0.95
    transforms = body.bones @ rigid_inverse(rest.bones)
    shown = skin(shaped.vertices + back.displacement, shaped.weights, transforms)
    assert torch.allclose(shown, back.posed, atol=1e-5)
    height = ((shown - body.vertices) * avatar.normals).sum(-1)[back.found]
    # Where parts of the body meet, the surface nearest to a vertex belongs to another one.
    assert (height - GROWN).abs().quantile(0.97) < 1e-5


def made_of(components: int, frames: int, generator: torch.Generator) -> torch.Tensor:
    shapes = torch.randn(components, 50, 3, generator=generator)
    weights = torch.randn(frames, components, generator=generator)
    return 0.01 * torch.einsum("tk,kvc->tvc", weights, shapes) + 0.02


def test_twice_as_many_targets_as_there_are_shapes_explain_everything(generator) -> None:
    off = made_of(4, 20, generator)
    morphs = fit_morphs(off, torch.ones(20, 50, dtype=torch.bool), 16)
    assert len(morphs.targets) <= 8
    shown = morphs.mean + torch.einsum("tm,mvc->tvc", morphs.weights, morphs.targets)
    assert torch.allclose(shown, off, atol=1e-4)


@pytest.mark.parametrize("count", [1, 3, 6])
def test_weights_lie_between_zero_and_one_and_use_their_range(generator, count: int) -> None:
    morphs = fit_morphs(made_of(9, 30, generator), torch.ones(30, 50, dtype=torch.bool), count)
    assert morphs.weights.min() >= 0
    assert morphs.weights.amax(0).allclose(torch.ones(len(morphs.targets)))


def test_targets_are_as_near_as_half_as_many_principal_components(generator) -> None:
    off = made_of(9, 30, generator)
    morphs = fit_morphs(off, torch.ones(30, 50, dtype=torch.bool), 6)
    left = off - morphs.mean - torch.einsum("tm,mvc->tvc", morphs.weights, morphs.targets)
    values = torch.linalg.svdvals((off - off.mean(0)).flatten(1))
    assert values[6:].norm() <= left.norm() <= values[3:].norm()


def test_weights_of_a_surface_are_the_nearest_there_are(generator) -> None:
    targets, off = torch.randn(3, 40, 3, generator=generator), torch.randn(5, 40, 3, generator=generator)
    found = bounded_weights(targets, off)
    grid = torch.linspace(0, 1, 41)
    every = torch.cartesian_prod(grid, grid, grid)
    for row, wanted in zip(found, off, strict=True):
        errors = (torch.einsum("nm,mvc->nvc", every, targets) - wanted).flatten(1).norm(dim=1)
        own = (torch.einsum("m,mvc->vc", row, targets) - wanted).norm()
        assert own <= errors.min() + 1e-5
        assert (row - every[errors.argmin()]).abs().max() < 0.03


def test_errors_fall_with_targets_also_on_frames_left_out(generator) -> None:
    off = made_of(6, 40, generator)
    known = torch.ones(40, 50, dtype=torch.bool)
    few, many = (morph_errors(off, known, count) for count in (2, 12))
    assert many["fitted_with_mm"] < 0.01
    # Weights beyond those of the fitted frames are cut off.
    assert many["left_out_with_mm"] < 0.5 * many["left_out_without_mm"]
    assert few["fitted_with_mm"] < few["fitted_without_mm"]
    assert few["left_out_without_mm"] == many["left_out_without_mm"]


def test_places_without_a_surface_do_not_count(generator) -> None:
    off = made_of(2, 20, generator)
    known = torch.ones(20, 50, dtype=torch.bool)
    spoilt, known[3, 7] = off.clone(), False
    spoilt[3, 7] = 5.0
    assert torch.allclose(fit_morphs(spoilt, known, 2).mean[:7], off.mean(0)[:7], atol=1e-6)
    assert fit_morphs(spoilt, known, 2).mean[7].abs().max() < 0.2


def test_one_frame_gives_a_mean_and_no_targets(generator) -> None:
    off = made_of(1, 1, generator)
    morphs = fit_morphs(off, torch.ones(1, 50, dtype=torch.bool), 16)
    assert morphs.targets.shape == (0, 50, 3)
    assert torch.equal(morphs.mean, off[0])
    assert morphs.weights_of(off).shape == (1, 0)
