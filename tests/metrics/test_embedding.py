"""Distances of embeddings, against closed forms and finite differences."""

from __future__ import annotations

import pytest
import torch
from networks import UNCHANGED, gradient, ordinary, small_network

from scenecaptum import SceneCaptumError
from scenecaptum.metrics import EmbeddingDistance
from scenecaptum.metrics._picture import srgb_picture

DISTANCES = ("cosine", "euclidean")


def mean_color(pictures: torch.Tensor) -> torch.Tensor:
    return pictures.mean((2, 3))


def embedding(image: torch.Tensor) -> torch.Tensor:
    return mean_color(srgb_picture(image))[0]


def test_distances_are_those_of_the_embeddings():
    image, reference = ordinary(seed=1), ordinary(9, 7, seed=2)
    x, y = embedding(image), embedding(reference)
    expected = {"cosine": 1 - x @ y / (x.norm() * y.norm()), "euclidean": (x - y).norm()}
    for distance in DISTANCES:
        for given in (reference, y):
            metric = EmbeddingDistance(given, mean_color, UNCHANGED, distance=distance)
            torch.testing.assert_close(metric(image), expected[distance])


def test_several_embeddings_give_a_vector():
    image, targets = ordinary(), torch.eye(3, dtype=torch.float64)
    metric = EmbeddingDistance(targets, mean_color, UNCHANGED)
    expected = 1 - embedding(image) / embedding(image).norm()
    torch.testing.assert_close(metric(image), expected)
    smoothed = EmbeddingDistance(targets, mean_color, UNCHANGED, smoothing=1e-6)
    torch.testing.assert_close(smoothed(image), expected, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("distance", DISTANCES)
def test_derivatives_agree_with_finite_differences(distance):
    metric = EmbeddingDistance(ordinary(seed=1), small_network(), UNCHANGED, distance=distance)
    assert torch.autograd.gradcheck(metric, (ordinary(6, 7, seed=2).requires_grad_(),))


@pytest.mark.parametrize("distance", DISTANCES)
def test_the_reference_is_a_stationary_point(distance):
    reference = ordinary()
    metric = EmbeddingDistance(reference, small_network(), UNCHANGED, distance=distance)
    assert metric(reference).item() == pytest.approx(0, abs=1e-12)
    assert gradient(metric, reference).abs().max() < 1e-10
    assert metric.measure.better == "lower"
    assert metric(ordinary(seed=3)) > 0


def test_encoders_of_low_precision_work():
    image, reference = ordinary(seed=1).float(), ordinary(seed=2).float()
    exact = EmbeddingDistance(reference, small_network().float(), distance="euclidean")(image)
    rough = EmbeddingDistance(reference, small_network().bfloat16(), distance="euclidean")(image)
    assert rough.dtype == torch.float32
    torch.testing.assert_close(rough, exact, atol=0.02, rtol=0.1)


@pytest.mark.parametrize(
    ("encoder", "message"),
    [
        (lambda x: x.mean((0, 2, 3)), r"returned shape \(3,\)\. Keep the batch dimension"),
        (lambda x: x, r"returned shape \(1, 3, 16, 20\)\. Reduce it"),
        (lambda x: {"pooled": x}, r"returned a dict with 'pooled'\. .*self\.model\(x\)\['pooled'\]"),
        (
            lambda x: x.mean((2, 3)).repeat(1, 2),
            "The reference has 3 numbers, but function returns embeddings of 6",
        ),
    ],
)
def test_an_encoder_that_returns_no_embeddings_is_refused(encoder, message):
    with pytest.raises(SceneCaptumError, match=message):
        EmbeddingDistance(torch.ones(3), encoder, UNCHANGED)(ordinary())


@pytest.mark.parametrize(
    ("reference", "message"),
    [
        (torch.zeros(3), "not all 0"),
        (torch.tensor([1.0, torch.nan]), "finite"),
        (torch.ones(4, 5, 2), r"\(H, W, 3\)"),
        (torch.ones(1, 4, 5, 3), r"an image \(H, W, 3\) or an embedding"),
        ([1.0, 2.0], "not list"),
    ],
)
def test_a_reference_must_be_an_image_or_an_embedding(reference, message):
    with pytest.raises(SceneCaptumError, match=message):
        EmbeddingDistance(reference, mean_color)


def test_an_unknown_distance_is_named():
    with pytest.raises(SceneCaptumError, match="'cosine' or 'euclidean', not 'manhattan'"):
        EmbeddingDistance(torch.ones(3), mean_color, distance="manhattan")
