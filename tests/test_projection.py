from __future__ import annotations

import numpy as np
import pytest
import torch

from scenecaptum import SceneAttribution, SceneCaptumError, VanillaSceneGradient, metrics
from scenecaptum.projection import heatmap
from scenecaptum.scene import SurfaceMap


def attribution(parameters: tuple[tuple[str, ...], ...], **saliency: float) -> SceneAttribution:
    """A 1×2 picture: the left pixel shows object 0, the right one half object 0 and half object 1."""
    surfaces = SurfaceMap(
        shape=(1, 2),
        pixel=np.array([0, 1, 1], np.int32),
        object_index=np.array([0, 0, 1], np.int32),
        fraction=np.array([1.0, 0.5, 0.5], np.float32),
        objects=tuple(f"object_{i}" for i in range(len(parameters))),
        parameters=parameters,
    )
    values = {name: torch.tensor(value) for name, value in saliency.items()}
    return SceneAttribution(values, standard_error=None, metric_value=1.0, surfaces=surfaces)


def test_pixels_mix_what_they_show_by_coverage():
    painted = heatmap(attribution((("a",), ("b",)), a=2.0, b=-1.0))
    torch.testing.assert_close(painted, torch.tensor([[1.0, 0.75]]))


def test_an_object_with_several_parameters_shows_their_norm():
    painted = heatmap(attribution((("a", "b"), ("c",)), a=3.0, b=4.0, c=5.0))
    torch.testing.assert_close(painted, torch.tensor([[1.0, 1.0]]))


def test_a_shared_parameter_paints_every_object_that_wears_it():
    painted = heatmap(attribution((("a",), ("a",)), a=0.5))
    torch.testing.assert_close(painted, torch.ones(1, 2))


def test_what_no_pixel_shows_sets_the_scale_and_stays_in_the_ranking():
    result = attribution((("a",), ("b",), ("hidden",)), a=1.0, b=2.0, hidden=4.0)
    torch.testing.assert_close(heatmap(result), torch.tensor([[0.25, 0.375]]))
    assert result.ranking()[0].name == "hidden"


def test_a_parameter_of_no_object_sets_the_scale_too():
    painted = heatmap(attribution((("a",), ("b",)), a=1.0, b=1.0, point_light=2.0))
    torch.testing.assert_close(painted, torch.full((1, 2), 0.5))


def test_parameters_that_were_not_asked_for_are_not_painted():
    painted = heatmap(attribution((("a",), ("not an input",)), a=1.0))
    torch.testing.assert_close(painted, torch.tensor([[1.0, 0.5]]))


def test_attributions_of_zero_give_a_black_map():
    assert not heatmap(attribution((("a",), ("b",)), a=0.0, b=0.0)).any()


def test_without_a_scene_there_is_no_map():
    with pytest.raises(SceneCaptumError, match="which object each pixel shows"):
        SceneAttribution({"a": torch.ones(())}, standard_error=None, metric_value=1.0).heatmap()


def test_map_of_a_real_scene_equals_the_saliency_of_the_object_at_each_pixel(cornell):
    result = VanillaSceneGradient(cornell, metrics.MeanLuminance()).attribute(replicates=1)
    painted, surfaces = result.heatmap(), cornell.surfaces
    assert painted.shape == (32, 32)
    assert 0 <= painted.min() < painted.max() <= 1
    saliency = result.saliency()
    (floor,) = (n for n in saliency if n.startswith("floor."))
    whole = (surfaces.object_index == surfaces.objects.index("floor_shape")) & (surfaces.fraction == 1)
    expected = saliency[floor] / max(saliency.values())
    np.testing.assert_allclose(painted.flatten()[surfaces.pixel[whole]], expected, rtol=1e-5)
    assert whole.sum() > 20
