"""Scores on the pixels of an object: closed forms, the geometry of the mask, and bad input."""

from __future__ import annotations

import pytest
import torch
from networks import UNCHANGED, gradient, ordinary
from seeds import shifted

from scenecaptum import SceneCaptumError
from scenecaptum.metrics import ResizeCropNormalize, SegmentationScore, Smoothed
from scenecaptum.metrics._picture import srgb_picture


def small_segmenter(classes: int = 4, stride: int = 1) -> torch.nn.Module:
    torch.manual_seed(shifted(2))
    return torch.nn.Sequential(
        torch.nn.Conv2d(3, 5, 3, padding=1, stride=stride), torch.nn.Tanh(), torch.nn.Conv2d(5, classes, 1)
    ).double()


def corner(height: int = 16, width: int = 20) -> torch.Tensor:
    """Return the mask of an object at the top left, with a half covered column at its edge."""
    mask = torch.zeros(height, width)
    mask[:5, :6] = 1.0
    mask[:5, 6] = 0.5
    return mask


def colors(pictures: torch.Tensor) -> torch.Tensor:
    """Return the picture itself: its channels are the logits of three classes."""
    return pictures


def test_a_score_is_the_mean_over_the_mask():
    image, mask = ordinary(), corner()
    picture = srgb_picture(image)[0]
    expected = (picture * mask).sum((1, 2)) / mask.sum()
    torch.testing.assert_close(SegmentationScore(colors, None, mask, UNCHANGED)(image), expected)
    torch.testing.assert_close(SegmentationScore(colors, 2, mask, UNCHANGED)(image), expected[2])
    torch.testing.assert_close(
        SegmentationScore(colors, 2, mask > 0.9, UNCHANGED)(image), picture[2, :5, :6].mean()
    )
    logs = (picture.log_softmax(0) * mask).sum((1, 2)) / mask.sum()
    metric = SegmentationScore(colors, 1, mask, UNCHANGED, score="log_probability")
    torch.testing.assert_close(metric(image), logs[1])


def test_the_dict_of_torchvision_is_understood():
    image, mask = ordinary(), corner()
    plain = SegmentationScore(small_segmenter(), 1, mask)
    nested = SegmentationScore(lambda x: {"out": small_segmenter()(x), "aux": None}, 1, mask)
    torch.testing.assert_close(nested(image), plain(image))


def test_a_negative_target_is_the_class_that_it_counts_to():
    metric = SegmentationScore(small_segmenter(), None, corner(), UNCHANGED)
    assert metric.verdict(ordinary(), -1) == metric.verdict(ordinary(), 3)
    assert metric.measure_of(-1).name == "mean logit of class 3 on the mask"


def test_a_network_that_ends_in_a_softmax_warns():
    probabilities = torch.nn.Sequential(small_segmenter(), torch.nn.Softmax(1))
    with pytest.warns(UserWarning, match="The output of Sequential looks like probabilities"):
        SegmentationScore(probabilities, 1, corner(), UNCHANGED)(ordinary())


@pytest.mark.parametrize("stride", [1, 3])
def test_derivatives_agree_with_finite_differences(stride):
    mask = torch.zeros(6, 7)
    mask[2:5, 1:4] = torch.rand(3, 3)
    for score in ("logit", "log_probability"):
        metric = SegmentationScore(small_segmenter(stride=stride), 0, mask, score=score)
        assert torch.autograd.gradcheck(metric, (ordinary(6, 7).requires_grad_(),))


def test_only_the_pixels_of_the_object_have_a_gradient_for_a_network_without_neighbours():
    slope = gradient(SegmentationScore(colors, 0, corner(), UNCHANGED), ordinary())
    assert ((slope[..., 0] != 0) == (corner() > 0)).all()


# --- The mask follows the picture -----------------------------------------------------------------


def painted(mask: torch.Tensor) -> torch.Tensor:
    """Return an image that is white on the object and black elsewhere."""
    return mask.double()[..., None].expand(-1, -1, 3).contiguous()


def flip_and_pad(pictures: torch.Tensor) -> torch.Tensor:
    return torch.nn.functional.pad(pictures.flip(3), (4, 0, 2, 2), value=0.5)


NORMALIZED = {"mean": (0.5, 0.4, 0.3), "std": (0.2, 0.3, 0.1)}


@pytest.mark.parametrize(
    "transform",
    [
        ResizeCropNormalize(32, None, **NORMALIZED),  # enlarged by an integer
        ResizeCropNormalize(None, 12, **NORMALIZED),  # shows 10 of the object's 30 pixels
        ResizeCropNormalize(32, 28, **NORMALIZED),
        flip_and_pad,
    ],
    ids=["resize", "crop", "both", "flip and pad"],
)
def test_the_mask_is_where_the_network_sees_the_object(transform):
    mask = corner().round()
    inside = SegmentationScore(colors, 0, mask, transform)(painted(mask)).item()
    white = transform(torch.ones(1, 3, 16, 20, dtype=torch.float64))[0, 0].max().item()
    black = transform(torch.zeros(1, 3, 16, 20, dtype=torch.float64))[0, 0].min().item()
    if isinstance(transform, ResizeCropNormalize) and transform.resize:
        # Interpolation blurs the edge of the object, in the picture and in the mask.
        assert inside > black + 0.85 * (white - black)
    else:
        assert inside == pytest.approx(white)
        outside = SegmentationScore(colors, 0, mask, transform)(painted(1 - mask)).item()
        assert outside == pytest.approx(black)


def test_a_score_map_of_lower_resolution_averages_the_mask():
    mask = torch.zeros(8, 12)
    mask[:4, :6] = 1.0
    mask[:4, 6:8] = 0.5
    pooled = SegmentationScore(lambda x: torch.nn.functional.avg_pool2d(x, 4), 0, mask, UNCHANGED)
    image = ordinary(8, 12)
    picture = torch.nn.functional.avg_pool2d(srgb_picture(image), 4)[0, 0]
    weight = torch.tensor([[1.0, 0.75, 0.0], [0.0, 0.0, 0.0]])
    assert pooled(image).item() == pytest.approx(((picture * weight).sum() / weight.sum()).item())


def test_a_mask_that_is_cropped_away_is_an_error():
    mask = torch.zeros(16, 20)
    mask[:2, :2] = 1
    with pytest.raises(SceneCaptumError, match="shows no pixel of the mask"):
        SegmentationScore(colors, 0, mask, ResizeCropNormalize(None, 8))(ordinary())


# --- Names, smoothing, bad input ------------------------------------------------------------------


def test_names_and_verdicts_say_what_the_network_sees():
    mask = corner().round()
    metric = SegmentationScore(colors, "sky", mask, UNCHANGED, classes=["chair", "desk", "sky"])
    assert metric.measure.name == "mean logit of sky on the mask"
    image = torch.zeros(16, 20, 3)
    image[..., 1] = 0.5
    assert metric.verdict(image) == "0 of the mask is sky; 1 is desk"
    smoothed = SegmentationScore(colors, None, mask, UNCHANGED, smoothing=0.3)
    assert smoothed.measure_of(1).name == "smoothed mean logit of class 1 on the mask"
    assert smoothed.verdict(image, 1).startswith(
        "0.74 without smoothing, on one noisy render; 1 of the mask is class 1"
    )
    assert smoothed.n_draws == Smoothed(torch.mean).n_draws
    assert "mask=(16, 20)" in repr(metric)
    assert metric.target_index("desk") == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"mask": torch.zeros(16, 20)}, "mask selects no pixel"),
        ({"mask": -corner()}, "mask selects no pixel"),
        ({"mask": torch.ones(2, 16, 20)}, r"mask must be a tensor \(H, W\).*PerCamera"),
        ({"mask": [[1.0]]}, "not list"),
        ({"target": 5, "classes": ["a", "b"]}, "target must be a whole number from 0 to 1"),
        ({"score": "probability"}, "score must be 'logit' or 'log_probability'"),
    ],
)
def test_bad_settings_are_named(options, message):
    given = {"target": 0, "mask": corner(), **options}
    with pytest.raises(SceneCaptumError, match=message):
        SegmentationScore(colors, **given)


def test_masks_and_networks_that_do_not_fit_are_named():
    with pytest.raises(SceneCaptumError, match=r"mask has shape \(16, 20\); the image is \(12, 20\)"):
        SegmentationScore(colors, 0, corner())(ordinary(12, 20))
    with pytest.raises(SceneCaptumError, match="target=3 is not a class of function: it has 3 classes"):
        SegmentationScore(colors, 3, corner())(ordinary())
    with pytest.raises(SceneCaptumError, match=r"returned shape \(1, 3\)"):
        SegmentationScore(lambda x: x.mean((2, 3)), 0, corner())(ordinary())
    with pytest.raises(
        SceneCaptumError, match=r"returned a dict with 'masks'\. .*self\.model\(x\)\['masks'\]"
    ):
        SegmentationScore(lambda x: {"masks": x}, 0, corner())(ordinary())


# --- Masks of a scene -----------------------------------------------------------------------------


def test_a_renderer_gives_the_masks_of_its_objects(cornell):
    mask = cornell.mask("tall_box_shape")
    assert mask.shape == (32, 32)
    assert 0.02 < mask.mean() < 0.3
    both = cornell.mask("*_box_shape")
    torch.testing.assert_close(both, mask + cornell.mask(["short_box_shape"]))
    torch.testing.assert_close(cornell.mask("*"), torch.ones(32, 32))
    with pytest.raises(SceneCaptumError, match=r"no object 'tall_bx'.*Did you mean 'tall_box_shape'"):
        cornell.mask("tall_bx")


def test_a_list_of_sensors_has_a_mask_for_each(mi):
    from scenecaptum import SceneRenderer, metrics

    pair = SceneRenderer("cornell-box", resolution=(16, 16), spp=4, sensor=[0, 0])
    masks = pair.mask("floor_shape")
    assert masks.shape == (2, 16, 16)
    metric = metrics.PerCamera([SegmentationScore(colors, 0, mask) for mask in masks])
    assert metric(pair(seed=shifted())).shape == (2,)
