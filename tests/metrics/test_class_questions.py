"""Differences of logits and probabilities, against closed forms and finite differences."""

from __future__ import annotations

import math
import warnings

import pytest
import torch
from networks import UNCHANGED, WHITE, gradient, logits_of, ordinary, small_network

from scenecaptum import SceneCaptumError
from scenecaptum.metrics import ClassLogit, ClassProbability, Smoothed

VALUES = [1.0, 4.0, 2.5]


def logit(target: int | str | None = None, **options: object) -> ClassLogit:
    return ClassLogit(logits_of(VALUES), target, UNCHANGED, **options)


# --- Differences of logits ------------------------------------------------------------------------


def test_a_contrast_is_the_difference_of_two_logits():
    assert logit(0, against=2)(WHITE).item() == pytest.approx(-1.5)
    torch.testing.assert_close(logit(against=2)(WHITE), torch.tensor([-1.5, 1.5, 0.0]).double())
    image, model = ordinary(), small_network()
    contrast = gradient(ClassLogit(model, 1, UNCHANGED, against=3), image)
    parts = [gradient(ClassLogit(model, target, UNCHANGED), image) for target in (1, 3)]
    torch.testing.assert_close(contrast, parts[0] - parts[1])


def test_a_margin_is_the_distance_to_the_best_other_class():
    torch.testing.assert_close(logit(against="best")(WHITE), torch.tensor([-3.0, 1.5, -1.5]).double())
    assert logit(1, against="best")(WHITE).item() == pytest.approx(1.5)
    equal = ClassLogit(logits_of([2.0, 2.0, 1.0]), None, UNCHANGED, against="best")
    torch.testing.assert_close(equal(WHITE), torch.tensor([0.0, 0.0, -1.0]).double())


def test_derivatives_of_differences_agree_with_finite_differences():
    for against in (2, "best"):
        metric = ClassLogit(small_network(), 0, UNCHANGED, against=against)
        assert torch.autograd.gradcheck(metric, (ordinary(6, 7).requires_grad_(),))


def test_a_class_may_be_called_best():
    names = ["worst", "best", "other"]
    metric = logit("worst", against="best", classes=names)
    assert metric.against == 1
    assert metric(WHITE).item() == pytest.approx(-3.0)
    assert metric.measure.name == "logit of worst minus that of best"
    assert logit(0, against="best", classes=["a", "b", "c"]).against == "best"


def test_names_say_what_is_compared():
    names = ["chair", "lamp", "desk"]
    assert logit("lamp", against="desk", classes=names).measure.name == "logit of lamp minus that of desk"
    margin = logit(against="best", classes=names, smoothing=0.1)
    assert margin.measure_of(1).name == "smoothed margin of lamp over the best other class"
    assert margin.verdict(WHITE, 1).startswith("1.5 without smoothing, on one noisy render; probability")
    assert "against=2 (desk)" in repr(logit(0, against="desk", classes=names))
    assert "against=best" in repr(margin)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"target": 1, "against": 1}, "against=1 is the target itself"),
        ({"target": 1, "against": -1}, "against must be a whole number"),
        ({"target": "a", "against": "bb", "classes": ["a", "b"]}, "no class called 'bb'"),
        ({"target": 0, "against": "lamp"}, "classes="),
    ],
)
def test_a_class_to_compare_with_must_be_another_class(options, message):
    with pytest.raises(SceneCaptumError, match=message):
        logit(**options)


def test_classes_that_the_model_lacks_are_named():
    with pytest.raises(SceneCaptumError, match="against=7 is not a class of Fixed: it has 3 classes"):
        logit(0, against=7)(WHITE)
    with pytest.raises(SceneCaptumError, match="needs at least two classes"):
        ClassLogit(logits_of([1.0]), 0, UNCHANGED, against="best")(WHITE)


def test_a_pretrained_model_can_be_compared_by_names(torchvision, monkeypatch):
    tiny = torch.nn.Sequential(torch.nn.AdaptiveAvgPool2d(1), torch.nn.Flatten(), torch.nn.Linear(3, 1000))
    monkeypatch.setattr(torchvision.models, "get_model", lambda name, weights: tiny)
    metric = ClassLogit.pretrained("resnet50", target="folding chair", against="rocking chair")
    assert (metric.target, metric.against) == (559, 765)


# --- Networks that return probabilities ---------------------------------------------------------------


@pytest.mark.parametrize("make", [ClassLogit, ClassProbability])
def test_a_network_that_ends_in_a_softmax_warns_once(make):
    probabilities = torch.nn.Sequential(small_network(), torch.nn.Softmax(1))
    metric = make(probabilities, 1, UNCHANGED)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        metric(ordinary())
        metric(ordinary(seed=1))
        metric.verdict(ordinary())
    (warning,) = caught
    assert "The output of Sequential looks like probabilities" in str(warning.message)
    assert "return what goes into the network's own softmax" in str(warning.message)


@pytest.mark.parametrize("values", [[1.0], [0.5, 0.6], [1.5, -0.5], [0.3, 0.6998]])
def test_logits_that_are_no_probabilities_do_not_warn(values, recwarn):
    ClassProbability(logits_of(values), 0, UNCHANGED)(WHITE)
    assert not recwarn.list


# --- Probabilities --------------------------------------------------------------------------------


def test_a_probability_is_the_softmax_of_the_logits():
    total = sum(map(math.exp, VALUES))
    metric = ClassProbability(logits_of(VALUES), 2, UNCHANGED)
    assert metric(WHITE).item() == pytest.approx(math.exp(VALUES[2]) / total)
    assert ClassProbability(logits_of(VALUES), None, UNCHANGED)(WHITE).sum().item() == pytest.approx(1.0)
    assert metric.measure.name == "probability of class 2"
    assert metric.verdict(WHITE) == "probability 0.18 of class 2, but 0.79 of class 1"


@pytest.mark.parametrize(
    ("probabilities", "verdict"),
    [
        ((0.01002, 0.01004, 0.97994), "probability 0.01 of class 0, but 0.98 of class 2"),
        ((0.331, 0.334, 0.335), "probability 0.33 of class 0, but 0.34 of class 2"),
        ((0.3312, 0.3341, 0.3347), "probability 0.331 of class 0, but 0.335 of class 2"),
        ((0.33330, 0.33334, 0.33336), "probability 0.33 of class 0, about equal to that of class 2"),
        ((0.35, 0.33, 0.32), "probability 0.35 of class 0"),
    ],
)
def test_a_verdict_writes_as_many_digits_as_tell_two_probabilities_apart(probabilities, verdict):
    logits = [math.log(share) for share in probabilities]
    assert ClassProbability(logits_of(logits), 0, UNCHANGED).verdict(WHITE) == verdict


def test_the_gradient_of_a_probability_is_p_times_q_that_of_the_contrast_with_all_others():
    image, model = ordinary(), small_network(3)

    def contrast(x: torch.Tensor) -> torch.Tensor:
        logits = ClassLogit(model, None, UNCHANGED)(x)
        return logits[0] - logits[1:].logsumexp(0)

    metric = ClassProbability(model, 0, UNCHANGED)
    p = metric(image).item()
    torch.testing.assert_close(gradient(metric, image), p * (1 - p) * gradient(contrast, image))
    assert torch.autograd.gradcheck(metric, (ordinary(6, 7).requires_grad_(),))


def test_a_certain_network_has_no_gradient_of_its_probability():
    certain = logits_of([100.0, 0.0])
    assert gradient(ClassProbability(certain, 0, UNCHANGED), WHITE * 0.9).abs().max() < 1e-30
    assert gradient(ClassLogit(certain, 0, UNCHANGED, against=1), WHITE * 0.9).abs().max() > 0.1


def test_a_smoothed_probability_is_the_mean_of_probabilities():
    image = ordinary()
    smoothed = ClassProbability(small_network(), 1, UNCHANGED, smoothing=0.3)
    plain = ClassProbability(small_network(), 1, UNCHANGED)
    torch.testing.assert_close(smoothed(image), smoothed.noise.mean(plain.of_batch, image))
    assert smoothed.n_draws == Smoothed(torch.mean).n_draws
    assert smoothed.measure.name == "smoothed probability of class 1"
    assert torch.autograd.gradcheck(smoothed, (ordinary(4, 5).requires_grad_(),), fast_mode=True)
