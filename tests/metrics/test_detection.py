"""Scores of object detectors: closed forms, derivatives, torchvision's interface, and bad input."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from networks import gradient, ordinary
from seeds import shifted

from scenecaptum import SceneCaptumError
from scenecaptum.metrics import DetectionScore, ResizeCropNormalize, Smoothed

BOXES = [[2.0, 2.0, 10.0, 6.0], [6.0, 4.0, 14.0, 12.0], [0.0, 0.0, 20.0, 16.0]]


def detector(labels: list[int], scores: list[float]) -> Callable[[list[torch.Tensor]], Any]:
    """Return a detector that always finds the same boxes."""
    found = {
        "boxes": torch.tensor(BOXES[: len(labels)]).reshape(-1, 4),
        "labels": torch.tensor(labels, dtype=torch.long),
        "scores": torch.tensor(scores),
    }
    return lambda pictures: [found for _ in pictures]


class SmallDetector(torch.nn.Module):
    """A smooth random detector with torchvision's interface: four boxes, of the classes 1 and 2 in turn."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(shifted(4))
        self.features = torch.nn.Conv2d(3, 8, 3, stride=2, dtype=torch.float64)
        self.head = torch.nn.Linear(8, 4 * 5, dtype=torch.float64)

    def forward(self, pictures: list[torch.Tensor]) -> list[dict[str, torch.Tensor]]:
        if self.training:
            raise RuntimeError("a detector needs targets in training mode")
        return [self.detect(picture) for picture in pictures]

    def detect(self, picture: torch.Tensor) -> dict[str, torch.Tensor]:
        features = self.features(picture[None]).tanh().mean((2, 3))
        scores, *sides = self.head(features).reshape(4, 5).sigmoid().unbind(1)
        left, top, width, height = (10 * side for side in sides)
        boxes = torch.stack([left, top, left + width, top + height], 1)
        return {"boxes": boxes, "labels": torch.tensor([1, 2, 1, 2]), "scores": scores}


def test_the_best_score_of_the_class_counts():
    image = ordinary()
    model = detector([1, 2, 1], [0.3, 0.9, 0.5])
    assert DetectionScore(model, 1)(image).item() == pytest.approx(0.5)
    assert DetectionScore(model, 2)(image).item() == pytest.approx(0.9)


def test_scores_are_multiplied_by_the_overlap_with_the_box():
    image, model = ordinary(), detector([1, 1, 1], [0.9, 0.8, 1.0])
    box = (6, 2, 14, 6)  # 16 of 48 pixels with the first, 16 of 80 with the second, 32 of 320 with the third
    assert DetectionScore(model, 1, box)(image).item() == pytest.approx(0.9 * 16 / 48)
    assert DetectionScore(model, 1, BOXES[1])(image).item() == pytest.approx(0.8)
    apart = DetectionScore(detector([1], [0.9]), 1, (12, 8, 14, 10))
    assert apart(image) == 0


def test_a_mask_stands_for_its_box():
    mask = torch.zeros(16, 20)
    mask[2, 2:10] = 0.4
    mask[2:6, 5] = 1.0
    assert DetectionScore(detector([1], [0.7]), 1, mask)(ordinary()).item() == pytest.approx(0.7)


def test_boxes_follow_a_transform_that_resizes():
    double = ResizeCropNormalize(32, None, mean=(0, 0, 0), std=(1, 1, 1))
    small = [side / 2 for side in BOXES[1]]
    metric = DetectionScore(detector([0, 1], [0.1, 0.6]), 1, small, double)
    assert metric(ordinary()).item() == pytest.approx(0.6)


def test_without_a_detection_value_and_gradient_are_zero():
    for model in (detector([], []), detector([2], [0.9])):
        metric = DetectionScore(model, 1)
        assert metric(ordinary()) == 0
        assert not gradient(metric, ordinary()).any()


@pytest.mark.parametrize("box", [None, (1.0, 2.0, 12.0, 11.0)])
def test_derivatives_agree_with_finite_differences(box):
    metric = DetectionScore(SmallDetector(), 2, box)
    assert torch.autograd.gradcheck(metric, (ordinary(6, 7).requires_grad_(),))
    assert gradient(metric, ordinary(6, 7)).any()


def test_the_detector_is_not_changed():
    model = SmallDetector().train()
    metric = DetectionScore(model, 1, smoothing=0.2)
    leaf = ordinary().requires_grad_()
    metric(leaf).backward()
    assert leaf.grad.any()
    assert model.training
    assert all(p.grad is None and p.requires_grad for p in model.parameters())


def test_a_smoothed_score_is_the_mean_of_scores():
    image = ordinary()
    smoothed, plain = DetectionScore(SmallDetector(), 1, smoothing=0.3), DetectionScore(SmallDetector(), 1)
    torch.testing.assert_close(smoothed(image), smoothed.noise.mean(plain.of_batch, image))
    assert smoothed.n_draws == Smoothed(torch.mean).n_draws


def test_names_and_verdicts_say_what_is_found():
    image, model = ordinary(), detector([1, 2, 1], [0.3, 0.9, 0.5])
    metric = DetectionScore(model, "chair", classes=["background", "chair", "desk"])
    assert metric.measure.name == "detection score of chair"
    assert metric.verdict(image) == "2 detections of chair, the best with score 0.5"
    in_box = DetectionScore(model, 2, BOXES[1], smoothing=0.1)
    assert in_box.measure.name == "smoothed detection score of class 2 in the box"
    seen = "1 detection of class 2, the best with score 0.9 and overlap 1"
    assert in_box.verdict(image) == f"0.9 without smoothing, on one noisy render; {seen}"
    assert DetectionScore(model, 3).verdict(image) == "0 detections of class 3"
    assert "target=1 (chair), box=None" in repr(metric)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"box": (4, 2, 3, 6)}, "right > left"),
        ({"box": (4, 2, 3)}, "must be \\(left, top, right, bottom\\)"),
        ({"box": torch.zeros(16, 20)}, "mask selects no pixel"),
        ({"target": "chiar", "classes": ["chair"]}, "Did you mean 'chair'"),
        ({"target": -1}, "target must be a whole number"),
    ],
)
def test_bad_settings_are_named(options, message):
    with pytest.raises(SceneCaptumError, match=message):
        DetectionScore(detector([1], [0.5]), **{"target": 1, **options})


@pytest.mark.parametrize(
    ("output", "message"),
    [
        (lambda pictures: {"boxes": 1}, "returned a dict"),
        (lambda pictures: [{"boxes": torch.ones(1, 4)}], "returned a list of 'boxes'"),
        (lambda pictures: [torch.ones(1, 4)], "returned a list without dicts"),
        (lambda pictures: [], "returned a list"),
    ],
)
def test_a_model_that_returns_no_detections_is_refused(output, message):
    with pytest.raises(SceneCaptumError, match=message):
        DetectionScore(output, 1)(ordinary())


def test_a_mask_of_another_size_is_refused():
    metric = DetectionScore(detector([1], [0.5]), 1, torch.ones(8, 8))
    with pytest.raises(SceneCaptumError, match=r"mask has shape \(8, 8\); the image is \(16, 20\)"):
        metric(ordinary())


def test_a_detector_of_torchvision_has_a_score_and_its_gradient(torchvision, monkeypatch):
    # The compiled operator is missing where torchvision does not match torch.
    monkeypatch.setattr(
        torchvision.ops.boxes, "nms", lambda boxes, scores, _: scores.argsort(descending=True)
    )
    torch.manual_seed(shifted())
    build = torchvision.models.detection.ssdlite320_mobilenet_v3_large
    model = build(weights=None, weights_backbone=None, num_classes=2)  # a background and one class
    metric = DetectionScore(model, 1, (0, 0, 40, 30))
    image = ordinary(48, 64).float()
    slope = gradient(metric, image)
    assert 0 < metric(image) < 1
    assert slope.isfinite().all()
    assert slope.any()
