from __future__ import annotations

import importlib.util
from collections import OrderedDict
from pathlib import Path

import pytest
import torch
from seeds import shifted

from scenecaptum import SceneCaptumError, metrics
from scenecaptum.estimation import TargetedMetric
from scenecaptum.metrics._picture import srgb_picture

WEIGHTS = Path(metrics.__file__).with_name("shape_classifier.pt")


def ordinary(height: int = 16, width: int = 20, seed: int = 0) -> torch.Tensor:
    """Return random radiance between black and white, excluding both."""
    generator = torch.Generator().manual_seed(shifted(seed))
    return torch.rand(height, width, 3, dtype=torch.float64, generator=generator) * 0.8 + 0.1


def backbone(dtype: torch.dtype = torch.float64) -> torch.nn.Module:
    torch.manual_seed(shifted())
    return torch.nn.Sequential(
        torch.nn.Conv2d(3, 6, 3), torch.nn.ReLU(inplace=True), torch.nn.Conv2d(6, 8, 3, stride=2)
    ).to(dtype)


def every_comparison(reference: torch.Tensor) -> list[torch.nn.Module]:
    return [
        metrics.MeanSquaredError(reference),
        metrics.StructuralSimilarity(reference),
        metrics.PerceptualDistance(reference, backbone()),
        metrics.PerceptualDistance(reference, backbone(), layers=["0", "1", "2"]),
    ]


def gradient(metric: torch.nn.Module, image: torch.Tensor) -> torch.Tensor:
    leaf = image.detach().clone().requires_grad_()
    (result,) = torch.autograd.grad(metric(leaf), leaf)
    return result


# --- The picture ----------------------------------------------------------------------------------


def test_srgb_has_the_values_of_the_standard():
    radiance = torch.tensor([0.0, 0.0031308, 0.18, 0.5, 1.0]).reshape(5, 1, 1).expand(5, 1, 3)
    expected = torch.tensor([0.0, 0.04045, 0.46135, 0.73536, 1.0])
    torch.testing.assert_close(srgb_picture(radiance)[0, 0, :, 0], expected, atol=2e-5, rtol=0)


def test_the_picture_keeps_the_order_of_rows_columns_and_channels():
    image = torch.zeros(4, 7, 3)
    image[1, 5, 2] = 1.0
    picture = srgb_picture(image)
    assert picture.shape == (1, 3, 4, 7)
    assert picture[0, 2, 1, 5].item() == pytest.approx(1.0)
    assert (picture > 0).sum() == 1


def test_exposure_multiplies_radiance():
    image = ordinary()
    torch.testing.assert_close(srgb_picture(image, 0.5), srgb_picture(0.5 * image))


def test_the_gradient_of_the_picture_is_finite_from_black_to_far_above_white():
    image = torch.tensor([0.0, 1e-30, 0.5, 1.0, 2.0, 1e30]).reshape(6, 1, 1).repeat(1, 1, 3).requires_grad_()
    (slope,) = torch.autograd.grad(srgb_picture(image, 2.0).sum(), image)
    assert torch.isfinite(slope).all()
    assert slope[0, 0, 0].item() == pytest.approx(2 * 12.92)
    assert (slope[-2:] == 0).all()


@pytest.mark.parametrize("value", [-0.1, float("nan"), float("inf")])
def test_invalid_radiance_is_refused(value):
    image = torch.ones(4, 6, 3)
    image[2, 3, 1] = value
    with pytest.raises(SceneCaptumError, match="on 1 of 24 pixels"):
        metrics.StructuralSimilarity(torch.ones(4, 6, 3), window=3)(image)


# --- Comparisons with a reference -----------------------------------------------------------------


def test_a_picture_equals_itself():
    image = ordinary()
    mse, ssim, *perceptual = (metric(image) for metric in every_comparison(image))
    assert mse == 0
    assert ssim.item() == pytest.approx(1.0, abs=1e-12)
    assert all(abs(distance.item()) < 1e-20 for distance in perceptual)


@pytest.mark.parametrize("level", [0.0, 0.3, 1.0, 7.0])
def test_flat_and_black_pictures_equal_themselves_with_finite_gradients(level):
    image = torch.full((16, 20, 3), level, dtype=torch.float64)
    for metric in every_comparison(image):
        value = metric(image)
        expected = 1.0 if isinstance(metric, metrics.StructuralSimilarity) else 0.0
        assert value.item() == pytest.approx(expected, abs=1e-9), metric
        assert torch.isfinite(gradient(metric, image)).all(), metric


@pytest.mark.parametrize("index", range(4))
def test_derivatives_agree_with_finite_differences(index):
    reference, image = ordinary(seed=shifted(1)), ordinary(seed=shifted(2))
    metric = every_comparison(reference[:12, :12])[index]
    leaf = image[:12, :12].clone().requires_grad_()
    # Along random directions, because element by element it would take minutes.
    assert torch.autograd.gradcheck(metric, (leaf,), fast_mode=True)
    assert torch.autograd.gradcheck(metric, (reference[:12, :12].clone().requires_grad_(),), fast_mode=True)


@pytest.mark.parametrize("index", range(4))
def test_identical_pictures_are_a_stationary_point(index):
    reference = ordinary()
    slope = gradient(every_comparison(reference)[index], reference)
    assert slope.abs().max() < 1e-10


@pytest.mark.parametrize("index", range(4))
def test_derivatives_on_black_regions_are_finite_and_one_sided(index):
    reference, image = ordinary(seed=shifted(1)), ordinary(seed=shifted(2))
    image[4:12, 5:15] = 0.0
    metric = every_comparison(reference)[index]
    slope = gradient(metric, image)
    assert torch.isfinite(slope).all()
    step = torch.zeros_like(image)
    step[8, 10, 1] = 1e-7
    measured = (metric(image + step) - metric(image)) / 1e-7
    assert measured.item() == pytest.approx(slope[8, 10, 1].item(), rel=1e-3, abs=1e-8)


def test_mean_squared_error_is_that_of_radiance():
    image = ordinary()
    assert metrics.MeanSquaredError(image)(image + 3.0).item() == pytest.approx(9.0)


def test_structural_similarity_falls_with_noise():
    image = ordinary(32, 32)
    metric = metrics.StructuralSimilarity(image)
    noise = torch.randn(image.shape, dtype=image.dtype, generator=torch.Generator().manual_seed(shifted(3)))
    values = [metric((image + sigma * noise).clamp(min=0)).item() for sigma in (0.0, 0.05, 0.2)]
    assert values[0] > values[1] + 0.01 > values[2] + 0.02


def test_perceptual_distance_is_that_of_unit_features():
    reference, image, network = ordinary(seed=shifted(1)), ordinary(seed=shifted(2)), backbone()
    metric = metrics.PerceptualDistance(reference, network, layers=["2"])
    a, b = (network(metric.transform(srgb_picture(x))) for x in (image, reference))
    cosine = torch.nn.functional.cosine_similarity(a, b, dim=1)
    assert metric(image).item() == pytest.approx((2 - 2 * cosine).mean().item(), rel=1e-6)


def test_perceptual_distance_averages_over_layers_and_takes_features_before_in_place_activations():
    reference, image = ordinary(seed=shifted(1)), ordinary(seed=shifted(2))

    def distance(*layers):
        return metrics.PerceptualDistance(reference, backbone(), layers=layers)(image).item()

    assert distance("0", "2") == pytest.approx((distance("0") + distance("2")) / 2)
    assert distance("0") != pytest.approx(distance("1"))


def test_a_backbone_may_return_several_feature_maps():
    class Pyramid(torch.nn.Module):
        def forward(self, x):
            return {"fine": x, "coarse": torch.nn.functional.avg_pool2d(x, 4)}

    image = ordinary()
    assert metrics.PerceptualDistance(image, Pyramid())(image.flip(0)) > 0
    assert len(metrics.PerceptualDistance(image, Pyramid()).features(image)) == 2


def test_comparisons_refuse_what_they_cannot_compare():
    image = ordinary()
    for metric in every_comparison(image):
        with pytest.raises(SceneCaptumError, match="Render both at the same resolution"):
            metric(image[:12])
    with pytest.raises(SceneCaptumError, match="no layer 'layr1'"):
        metrics.PerceptualDistance(image, backbone(), layers=["layr1"])
    with pytest.raises(SceneCaptumError, match="features of shape"):
        metrics.PerceptualDistance(image, torch.nn.Sequential(backbone(), torch.nn.Flatten(0)))(image)
    with pytest.raises(SceneCaptumError, match="more than 5 pixels on each side"):
        metrics.StructuralSimilarity(torch.ones(4, 20, 3))
    with pytest.raises(SceneCaptumError, match="exposure must be"):
        metrics.StructuralSimilarity(image, exposure=0.0)
    with pytest.raises(SceneCaptumError, match="not finite"):
        metrics.MeanSquaredError(image / 0)


# --- Class logits ---------------------------------------------------------------------------------


def small_classifier(classes: int = 5) -> torch.nn.Module:
    torch.manual_seed(shifted(1))
    return torch.nn.Sequential(
        torch.nn.Conv2d(3, 4, 3, stride=2),
        torch.nn.BatchNorm2d(4),
        torch.nn.Dropout(0.5),
        torch.nn.AdaptiveAvgPool2d(1),
        torch.nn.Flatten(),
        torch.nn.Linear(4, classes),
    )


def test_a_logit_is_an_element_of_the_vector_of_logits():
    model, image = small_classifier(), ordinary(40, 60).float()
    logits = metrics.ClassLogit(model)(image)
    assert logits.shape == (5,)
    for target in range(5):
        torch.testing.assert_close(metrics.ClassLogit(model, target)(image), logits[target])


def test_the_model_is_not_changed():
    model, image = small_classifier().train(), ordinary(40, 60).float().requires_grad_()
    model[1].eval()  # a user may freeze the batch normalization alone
    state = {name: value.clone() for name, value in model.state_dict().items()}
    metric = metrics.ClassLogit(model, target=2)
    first = metric(image)
    first.backward()
    assert torch.equal(first, metric(image))  # no dropout
    assert image.grad.abs().sum() > 0
    assert all(p.grad is None and p.requires_grad for p in model.parameters())
    assert [module.training for module in model] == [True, False, True, True, True, True]
    for name, value in model.state_dict().items():
        assert torch.equal(value, state[name]), name


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_scripted_models_and_other_precisions_work():
    model, image = small_classifier().eval(), ordinary(40, 60).float()
    expected = metrics.ClassLogit(model, 1)(image)
    scripted = metrics.ClassLogit(torch.jit.trace(model, torch.rand(1, 3, 224, 224)), 1)
    torch.testing.assert_close(scripted(image), expected)
    assert torch.isfinite(gradient(scripted, image)).all()
    torch.testing.assert_close(metrics.ClassLogit(model, 1)(image.double()), expected)
    torch.testing.assert_close(
        metrics.ClassLogit(model.bfloat16(), 1)(image).float(), expected, atol=0.02, rtol=0.02
    )


def test_class_logits_have_the_derivative_of_finite_differences():
    model = small_classifier().double()
    metric = metrics.ClassLogit(model, 3, metrics.ResizeCropNormalize(16, 12))
    assert torch.autograd.gradcheck(metric, (ordinary(10, 14).requires_grad_(),))


def test_class_logits_work_under_torch_func():
    metric, image = metrics.ClassLogit(small_classifier(), 3), ordinary(20, 30).float()
    torch.testing.assert_close(torch.func.grad(metric)(image), gradient(metric, image))


def test_gradients_are_finite_at_black_and_at_white():
    metric = metrics.ClassLogit(small_classifier(), 0)
    for level in (0.0, 1.0, 1e6):
        assert torch.isfinite(gradient(metric, torch.full((20, 30, 3), level))).all()


def test_a_class_may_be_named():
    model = small_classifier(2)
    named = metrics.ClassLogit(model, "chair", classes=["lamp", "chair"])
    assert named.target == 1
    assert "chair" in repr(named)
    with pytest.raises(SceneCaptumError, match=r"no class called 'chiar'.*Did you mean 'chair'"):
        metrics.ClassLogit(model, "chiar", classes=["lamp", "chair"])
    with pytest.raises(SceneCaptumError, match="classes="):
        metrics.ClassLogit(model, "chair")


@pytest.mark.parametrize("target", [-1, 1.5, True])
def test_a_target_must_be_a_class(target):
    with pytest.raises(SceneCaptumError, match="target must be a whole number"):
        metrics.ClassLogit(small_classifier(), target)


@pytest.mark.parametrize("names", [["dark"], ["background", "dark", "light", "x", "y"]])
def test_there_is_one_name_for_each_logit(names):
    metric = metrics.ClassLogit(small_classifier(4), "dark", classes=names)
    with pytest.raises(
        SceneCaptumError, match=rf"returns 4 logits, but has {len(names)} name.*one name for each"
    ):
        metric(torch.rand(20, 30, 3))


def test_a_state_dict_is_no_network():
    with pytest.raises(SceneCaptumError, match=r"not OrderedDict.*network\.load_state_dict"):
        metrics.ClassLogit(small_classifier().state_dict(), 1)


def test_a_logit_of_one_class_has_no_elements():
    metric = TargetedMetric(metrics.ClassLogit(small_classifier(), 1), 0)
    with pytest.raises(SceneCaptumError, match="has a single value: leave out target="):
        metric.value(torch.rand(20, 30, 3))


def test_a_target_beyond_the_classes_is_refused():
    with pytest.raises(SceneCaptumError, match="target=5 is not a class of Sequential: it has 5 classes"):
        metrics.ClassLogit(small_classifier(), 5)(torch.rand(20, 30, 3))
    with pytest.raises(SceneCaptumError, match="from 0 to 2"):
        metrics.ClassLogit(metrics.ShapeClassifier(), 3)


@pytest.mark.parametrize(
    ("output", "message"),
    [
        (
            lambda x: {"maps": x, "shape": x.mean((2, 3))},
            r"returned a dict with 'maps', 'shape'\. Pass a torch\.nn\.Module that returns its logits, with "
            r"return self\.model\(x\)\['shape'\] in its forward",
        ),
        (lambda x: OrderedDict(out=x), r"returned an OrderedDict with 'out'\. .*self\.model\(x\)\['out'\]"),
        (lambda x: (x, x.mean((2, 3))), r"returned a tuple of 2\. .*self\.model\(x\)\[1\]"),
        (lambda x: object(), r"returned an object\. .*self\.model\(x\)\.logits"),
        (lambda x: x, r"returned shape \(1, 3, 224, 224\)\. Reduce it"),
        (lambda x: x.mean((0, 2, 3)), r"returned shape \(3,\)\. Pass a torch\.nn\.Module"),
    ],
)
def test_a_model_that_returns_no_logits_is_refused(output, message):
    with pytest.raises(SceneCaptumError, match=message):
        metrics.ClassLogit(output, 0)(torch.rand(20, 30, 3))


def wrong_order(pictures: torch.Tensor) -> torch.Tensor:
    return pictures.permute(0, 2, 3, 1)


@pytest.mark.parametrize("wrap", [lambda metric: metric, metrics.Smoothed])
def test_an_error_of_a_network_names_what_transform_made(wrap):
    network = backbone(torch.float32)
    image = torch.rand(32, 24, 3)
    for metric in (
        metrics.ClassLogit(network, 1, wrong_order),
        metrics.ClassLogit(lambda x: network(x), 1, wrong_order),  # noqa: PLW0108 -- no module
        metrics.EmbeddingDistance(torch.rand(4), network, wrong_order),
    ):
        with pytest.raises(
            SceneCaptumError,
            match=r"cannot take a tensor of shape \(\d, 32, 24, 3\), which transform= makes of the picture: .*"
            r"torch says: .*to have 3 channels",
        ) as caught:
            TargetedMetric(wrap(metric)).value(image)
        assert "use metrics.ClassLogit" not in str(caught.value)
    small = torch.nn.Sequential(torch.nn.Flatten(), torch.nn.Linear(12, 2))
    with pytest.raises(SceneCaptumError, match=r"shape \(1, 3, 32, 24\), which transform= .*1x2304 and 12x2"):
        metrics.ClassLogit(small, 1, lambda picture: picture)(image)


def test_an_error_of_a_transform_names_the_picture():
    metric = metrics.ClassLogit(backbone(torch.float32), 1, lambda picture: picture.permute(1, 2, 0))
    with pytest.raises(SceneCaptumError, match=r"transform= cannot take a tensor of shape \(1, 3, 32, 24\)"):
        metric(torch.rand(32, 24, 3))


def test_an_error_of_a_network_that_is_not_of_its_input_is_its_own():
    def broken(pictures: torch.Tensor) -> torch.Tensor:
        raise RuntimeError("no weights")

    with pytest.raises(RuntimeError, match="no weights"):
        metrics.ClassLogit(broken, 1, lambda picture: picture)(torch.rand(32, 24, 3))


def test_a_network_as_a_metric_is_told_what_prepares_the_picture():
    metric = TargetedMetric(backbone(torch.float32))
    with pytest.raises(
        SceneCaptumError, match=r"image of shape \(32, 24, 3\) .* use metrics\.ClassLogit\(network\)"
    ):
        metric.value(torch.rand(32, 24, 3))


# --- torchvision ----------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [(180, 320), (320, 180), (300, 300), (233, 500), (97, 131)])
def test_preprocessing_equals_that_of_torchvision(torchvision, size):
    weights = torchvision.models.ResNet50_Weights.IMAGENET1K_V2
    picture = torch.rand(1, 3, *size, generator=torch.Generator().manual_seed(shifted(4)))
    torch.testing.assert_close(
        metrics.ResizeCropNormalize()(picture), weights.transforms()(picture), atol=1e-6, rtol=0
    )


@pytest.mark.parametrize("name", ["alexnet", "vit_b_16", "convnext_tiny", "efficientnet_b0"])
def test_preprocessing_of_other_models_can_be_stated(torchvision, name):
    theirs = torchvision.models.get_model_weights(name).DEFAULT.transforms()
    ours = metrics.ResizeCropNormalize(
        theirs.resize_size[0], theirs.crop_size[0], interpolation=theirs.interpolation.value
    )
    picture = torch.rand(1, 3, 300, 411, generator=torch.Generator().manual_seed(shifted(4)))
    torch.testing.assert_close(ours(picture), theirs(picture), atol=1e-5, rtol=0)


def test_resnet50_gives_a_logit_and_its_gradient(torchvision):
    torch.manual_seed(shifted())
    model = torchvision.models.resnet50(weights=None)
    transform = torchvision.models.ResNet50_Weights.IMAGENET1K_V2.transforms()
    image = ordinary(90, 160).float()
    metric = metrics.ClassLogit(model, 559, transform)
    torch.testing.assert_close(metric(image), metrics.ClassLogit(model, 559)(image), atol=1e-4, rtol=1e-4)
    with torch.no_grad():
        expected = model.eval()(transform(srgb_picture(image)))
    torch.testing.assert_close(metrics.ClassLogit(model)(image), expected[0], atol=1e-4, rtol=1e-4)
    slope = gradient(metric, image)
    assert torch.isfinite(slope).all()
    assert slope.abs().sum() > 0


def test_perceptual_distance_over_the_layers_of_a_torchvision_model(torchvision):
    torch.manual_seed(shifted())
    reference, image = ordinary(64, 80, seed=shifted(1)).float(), ordinary(64, 80, seed=shifted(2)).float()
    model = torchvision.models.resnet18(weights=None)
    metric = metrics.PerceptualDistance(reference, model, layers=["relu", "layer1", "layer2"])
    assert metric(reference).item() == pytest.approx(0, abs=1e-9)
    assert metric(image) > 0
    assert torch.isfinite(gradient(metric, reference)).all()


def test_a_default_that_enlarges_small_pictures_warns(recwarn):
    tiny = torch.nn.Sequential(torch.nn.AdaptiveAvgPool2d(1), torch.nn.Flatten(), torch.nn.Linear(3, 4))
    with pytest.warns(UserWarning, match="64×48 pixels are enlarged until their shorter side has 232"):
        metrics.ClassLogit(tiny, 1)(torch.rand(48, 64, 3))
    recwarn.clear()
    metrics.ClassLogit(tiny, 1)(torch.rand(120, 160, 3))
    metrics.ClassLogit(tiny, 1, metrics.ResizeCropNormalize())(torch.rand(48, 64, 3))
    metrics.ClassLogit(metrics.ShapeClassifier.pretrained(), 1)(torch.rand(48, 64, 3))
    assert not recwarn.list


def test_a_failed_download_of_weights_names_the_fix(torchvision, monkeypatch, tmp_path):
    monkeypatch.setattr(torch.hub, "_hub_dir", str(tmp_path))

    def offline(*_args, **_kwargs):
        raise OSError("no route to host")

    monkeypatch.setattr(torch.hub, "download_url_to_file", offline)
    with pytest.raises(SceneCaptumError, match="no route to host") as caught:
        metrics.ClassLogit.pretrained(
            "resnet50", torchvision.models.ResNet50_Weights.IMAGENET1K_V2, target=559
        )
    message = str(caught.value)
    assert "https://download.pytorch.org/models/resnet50-11ad3fa6.pth" in message
    assert str(tmp_path / "checkpoints") in message
    assert "ShapeClassifier.pretrained()" in message


def test_pretrained_models_have_their_transform_and_classes(torchvision, monkeypatch):
    tiny = torch.nn.Sequential(torch.nn.AdaptiveAvgPool2d(1), torch.nn.Flatten(), torch.nn.Linear(3, 1000))
    monkeypatch.setattr(torchvision.models, "get_model", lambda name, weights: tiny)
    for weights in ("DEFAULT", "ResNet50_Weights.IMAGENET1K_V2"):
        metric = metrics.ClassLogit.pretrained("resnet50", weights, target="folding chair")
        assert metric.target == 559
        assert metric.transform.resize_size == [232]
        assert metric(torch.rand(40, 50, 3)).shape == ()


def test_unknown_models_and_weights_are_named(torchvision):
    with pytest.raises(SceneCaptumError, match=r"no model called 'resnet5'.*Did you mean 'resnet50'"):
        metrics.ClassLogit.pretrained("resnet5")
    with pytest.raises(SceneCaptumError, match="IMAGENET1K_V1, IMAGENET1K_V2"):
        metrics.ClassLogit.pretrained("resnet50", "IMAGENET1K_V3")


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (ImportError("No module named 'torchvision'"), r"scenecaptum\[vision\]"),
        (RuntimeError("operator torchvision::nms does not exist"), "does not match the installed torch"),
    ],
)
def test_a_missing_or_broken_torchvision_is_explained(monkeypatch, error, message):
    import builtins

    ordinary_import = builtins.__import__

    def failing(name, *args, **kwargs):
        if name.partition(".")[0] == "torchvision":
            raise error
        return ordinary_import(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", failing)
    with pytest.raises(SceneCaptumError, match=message):
        metrics.ClassLogit.pretrained("resnet50")


# --- The shape classifier -------------------------------------------------------------------------


@pytest.fixture(scope="module")
def trainer():
    path = Path(__file__).parents[2] / "examples" / "train_shape_classifier.py"
    spec = importlib.util.spec_from_file_location("train_shape_classifier", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_weights_of_the_shape_classifier_are_small():
    assert WEIGHTS.stat().st_size < 200_000
    assert sum(p.numel() for p in metrics.ShapeClassifier().parameters()) < 15_000


@pytest.mark.long
def test_the_shape_classifier_recognises_held_out_renders(mi, trainer):
    count = 120
    images, labels = trainer.dataset(2 * trainer.HELD_OUT, count)
    measured = trainer.accuracy(metrics.ShapeClassifier.pretrained(), images, labels)
    print(f"accuracy on {count} held-out renders: {measured:.1%}, allowed: 95 %")
    assert measured >= 0.95, f"measured {measured:.1%} on {count} renders, allowed 95 %"


def test_the_shape_classifier_is_a_metric_with_named_classes():
    image = ordinary(60, 90).float()
    model = metrics.ShapeClassifier.pretrained()
    logits = metrics.ClassLogit(model)(image)
    assert logits.shape == (3,)
    torch.testing.assert_close(metrics.ClassLogit(model, target="cylinder")(image), logits[2])
    torch.testing.assert_close(metrics.ClassLogit(model, target=0)(image), logits[0])
    assert torch.isfinite(gradient(metrics.ClassLogit(model, "cube"), image)).all()
    assert metrics.PerceptualDistance(image, model, layers=["features"])(image.flip(1)) >= 0


def test_the_named_logit_takes_a_class_and_smoothing() -> None:
    logit = metrics.BY_NAME["shape-logit"].create(target="cube", against="cylinder", smoothing=0.3)
    assert logit.measure.name == "smoothed logit of cube minus that of cylinder"
    assert metrics.BY_NAME["shape-logit"].create()(torch.ones(16, 16, 3)).shape == (3,)
