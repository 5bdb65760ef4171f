"""Metrics of a stack of cameras: values, names, smoothing, and one set of renders for all of them."""

from __future__ import annotations

import pytest
import torch
from networks import UNCHANGED, ordinary, small_network
from refusals import message
from seeds import shifted

from scenecaptum import Camera, SceneCaptumError, SceneRenderer, VanillaSceneGradient, metrics
from scenecaptum.metrics import ClassLogit, MeanLuminance, PerCamera, Smoothed
from scenecaptum.report import write_report


def stack(count: int = 3) -> torch.Tensor:
    return torch.stack([ordinary(seed=seed) for seed in range(count)])


def test_every_camera_has_its_value():
    images = stack()
    metric = MeanLuminance()
    torch.testing.assert_close(PerCamera(metric)(images), torch.stack([metric(image) for image in images]))
    several = [MeanLuminance(1), MeanLuminance(2), MeanLuminance(3)]
    expected = torch.stack([one(image) for one, image in zip(several, images, strict=True)])
    torch.testing.assert_close(PerCamera(several)(images), expected)


def test_a_vector_of_each_camera_is_indexed_by_camera_and_element():
    images, logits = stack(2), ClassLogit(small_network(), None, UNCHANGED, classes=list("abcd"))
    metric = PerCamera(logits)
    assert metric(images).shape == (2, 4)
    torch.testing.assert_close(metric(images)[1, 2], logits(images[1])[2])
    assert metric.measure_of((1, 2)).name == "logit of c of camera 1"
    assert metric.verdict(images, (1, 2)) == logits.verdict(images[1], 2)


def test_names_and_verdicts_are_those_of_the_metric():
    images, camera = stack(2), Camera.perspective(20, 16, 60)
    metric = PerCamera([metrics.UnifiedGlareRating(camera), metrics.UnifiedGlareRating(camera)])
    assert metric.measure_of(1).name == "unified glare rating of camera 1"
    assert metric.verdict(images, 0) == "no glare source found"
    lit = torch.full_like(images, 0.5)
    lit[:, 4:6, 8:11] = 100.0
    assert metric.verdict(lit, 0) == metrics.UnifiedGlareRating.measure.verdict(metric(lit)[0].item())
    assert PerCamera(torch.mean).measure_of(0) is None
    assert PerCamera(torch.mean).verdict(images, 0) == ""
    assert metric.verdict(images) == ""
    assert metric.caution is None


def test_smoothing_is_forwarded_to_the_metric_of_each_camera():
    images = stack(2)
    inner = Smoothed(MeanLuminance(1), 0.3, n=8)
    metric = PerCamera([inner, MeanLuminance(1)])
    assert metric.n_draws == 8
    assert PerCamera(MeanLuminance()).n_draws == 0
    draws = {shifted(1): 4}
    other = metric.with_draws(draws)
    torch.testing.assert_close(other(images)[0], inner.with_draws(draws)(images[0]))
    torch.testing.assert_close(other(images)[1], metric(images)[1])
    torch.testing.assert_close(metric(images)[0], inner(images[0]))  # is not changed


def test_networks_inside_are_registered():
    network = small_network()
    assert set(PerCamera(ClassLogit(network, 0)).parameters()) == set(network.parameters())


@pytest.mark.parametrize(
    ("metric", "images", "message"),
    [
        (MeanLuminance(), ordinary(), r"a stack \(cameras, H, W, 3\), not \(16, 20, 3\)"),
        ([MeanLuminance()] * 2, stack(3), "2 metrics for 3 cameras"),
    ],
)
def test_stacks_that_do_not_fit_are_refused(metric, images, message):
    with pytest.raises(SceneCaptumError, match=message):
        PerCamera(metric)(images)


@pytest.mark.parametrize("metric", [0.3, [], [torch.mean, None]])
def test_what_is_no_metric_is_refused(metric):
    with pytest.raises(SceneCaptumError, match="metric must be a metric, or a list"):
        PerCamera(metric)


@pytest.fixture(scope="module")
def pair(mi) -> SceneRenderer:
    return SceneRenderer(
        "cornell-box",
        ["reflectance", "emitters"],
        resolution=(12, 12),
        spp=16,
        max_depth=3,
        sensor=[0, "fisheye"],
    )


def test_only_the_camera_of_the_target_is_differentiated(pair, monkeypatch):
    differentiated: list[int] = []
    for camera, view in enumerate(pair._views):
        replay = view.engine._replay_all_pixels
        monkeypatch.setattr(
            view.engine,
            "_replay_all_pixels",
            lambda *a, c=camera, f=replay: differentiated.append(c) or f(*a),
        )
    x = pair.leaves()
    value = PerCamera(MeanLuminance(1))(pair(x, seed=shifted()))[1]
    slopes = torch.autograd.grad(value, list(x.values()))
    assert differentiated == [1]
    assert any(slope.any() for slope in slopes)


def test_cameras_are_attributed_from_the_same_renders(pair):
    method = VanillaSceneGradient(pair, PerCamera(MeanLuminance(1)))
    first, second = method.attribute(target=[0, 1], seed=shifted(), replicates=2)
    for result, image in zip((first, second), first.image, strict=True):
        assert result.metric_value == pytest.approx(MeanLuminance(1)(image).item(), rel=1e-5)
    assert torch.equal(first.image, second.image)
    assert first.info["measure"]["name"] == "mean luminance of camera 0"
    both = [method.attribute(target=camera, seed=shifted(), replicates=2) for camera in (0, 1)]
    for alone, shared in zip(both, (first, second), strict=True):
        for name in alone:
            torch.testing.assert_close(alone[name], shared[name], rtol=1e-4, atol=1e-5)


def test_smoothed_logits_of_several_cameras_are_attributed(pair):
    logit = ClassLogit(metrics.ShapeClassifier.pretrained(), "cube", smoothing=0.3)
    method = VanillaSceneGradient(pair, PerCamera(logit))
    results = method.attribute(target=[0, 1], seed=shifted(), replicates=2)
    assert all(result.covariance is not None for result in results)
    assert results[0].info["measure"]["name"] == "smoothed logit of cube of camera 0"


def test_a_map_or_a_metric_of_one_picture_says_what_to_do_with_several(pair, tmp_path):
    result = VanillaSceneGradient(pair, PerCamera(MeanLuminance(1))).attribute(target=1, replicates=2)
    for draw in (result.heatmap, result.plot_heatmap, lambda: write_report(result, tmp_path / "report.html")):
        assert "of 2 sensors, and a map is of one: attribute each with a renderer of its own" in message(draw)
    network = ClassLogit(small_network(), 0, UNCHANGED)
    for metric in (MeanLuminance(), network, Smoothed(network)):
        assert "PerCamera(metric)" in message(lambda metric=metric: metric(result.image))
