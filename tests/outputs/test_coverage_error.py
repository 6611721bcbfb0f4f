"""Errors apart by what training images had observed."""

import torch

from twofold.body.skeleton import pose_body, shape_body
from twofold.capture.coverage import coverage_of
from twofold.outputs.coverage_error import CoverageErrors, pixel_coverage
from twofold.outputs.views import RenderedImage


def image_of(color, mask):
    zeros = torch.zeros_like(color)
    return RenderedImage(color, mask, mask, zeros, color, zeros)


def test_pixels_of_an_image_show_what_its_vertices_have(person):
    frame = person.splits["novel_view"][0]
    body = pose_body(shape_body(person.body, person.betas), frame.pose, frame.translation)
    right = (body.vertices[:, 0] > 0.05).float()
    image = pixel_coverage(frame, body, right)
    assert image.shape == frame.mask().shape
    assert image.min() == 0
    assert abs(image.max() - 1) < 1e-5
    assert (pixel_coverage(frame, body, torch.full_like(right, 0.3)) - 0.3).max() < 1e-6


def test_errors_of_seen_and_unseen_pixels_are_told_apart(person):
    errors = CoverageErrors(person, coverage_of(person))
    shaped = shape_body(person.body, person.betas)
    for frame in person.splits["novel_view"]:
        body = pose_body(shaped, frame.pose, frame.translation)
        weight = torch.from_numpy(pixel_coverage(frame, body, coverage_of(person).weight))
        wrong = 0.1 * (weight < 0.1) + 0.02 * (weight >= 0.5)
        errors.add(frame, image_of(frame.composited(torch.tensor(person.background)) + wrong[..., None], frame.mask()))
    found = errors.metrics()
    assert abs(found["unobserved_error"] - 0.1) < 1e-5
    assert abs(found["unobserved_psnr"] - 20) < 1e-3
    assert abs(found["observed_error"] - 0.02) < 1e-5
    assert 0.05 < found["unobserved_pixels"] < 0.95


def test_without_images_there_is_nothing_to_tell(person):
    assert CoverageErrors(person, coverage_of(person)).metrics() == {}
