"""Attributions to pixels, summed over objects and given to parameters."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np
import pytest
import torch

from scenecaptum import SceneCaptumError
from scenecaptum.projection import SurfaceMap, project_pixels


class Shown:
    """What a renderer offers: a 1×2 picture of a table (left), half a table and half the sky (right)."""

    inputs: ClassVar = {name: torch.zeros(()) for name in ("wood", "legs", "sky", "lamp")}
    surfaces = SurfaceMap(
        shape=(1, 2),
        pixel=np.array([0, 1, 1, 0], np.int32),
        object_index=np.array([0, 0, 2, 1], np.int32),
        fraction=np.array([1.0, 0.5, 0.5, 0.0], np.float32),
        objects=("table", "lamp", "background"),
        parameters=(("wood", "legs", "other"), ("lamp",), ("sky", "wood")),
    )


def test_pixels_are_summed_over_objects_by_coverage():
    projected = project_pixels(Shown(), torch.tensor([[3.0, -8.0]]))
    assert projected.objects == {"table": -1.0, "lamp": 0.0, "background": -4.0}
    # The wood of the table is also that of the background.
    assert dict(projected) == {"wood": -5.0, "legs": -1.0, "sky": -4.0, "lamp": 0.0}
    assert projected.invisible == ("lamp",)
    assert str(projected).splitlines() == [
        "wood  -5",
        "sky   -4",
        "legs  -1",
        "1 of 4 parameters belong to no visible object: their importance is 0.",
    ]


@pytest.mark.parametrize("shape", [(1, 2), (1, 2, 3), (1, 1, 2, 3), (1, 1, 2)])
def test_channels_and_a_batch_of_one_are_summed(shape):
    pixels = torch.arange(math.prod(shape), dtype=torch.float32).reshape(shape).requires_grad_()
    left, right = pixels.detach().reshape(2, -1).sum(1).tolist()
    assert project_pixels(Shown(), pixels)["legs"] == left + right / 2


def test_another_surface_map_counts_where_it_is_given():
    other = SurfaceMap(
        shape=(1, 1),
        pixel=np.zeros(1, np.int32),
        object_index=np.array([1], np.int32),
        fraction=np.ones(1, np.float32),
        objects=Shown.surfaces.objects,
        parameters=Shown.surfaces.parameters,
    )
    projected = project_pixels(Shown(), torch.ones(1, 1), surfaces=other)
    assert dict(projected) == {"wood": 0, "legs": 0, "sky": 0, "lamp": 1}


def test_the_sum_over_all_objects_is_that_of_the_pixels(mi, cornell):
    height, width = cornell.surfaces.shape
    pixels = torch.linspace(-1, 2, height * width * 3).reshape(1, height, width, 3)
    projected = project_pixels(cornell, pixels)
    assert sum(projected.objects.values()) == pytest.approx(pixels.sum().item(), rel=1e-4)
    assert list(projected) == list(cornell.inputs)


@pytest.mark.parametrize(
    "pixels", [torch.ones(2, 1), torch.ones(3, 1, 2), torch.ones(2, 1, 2, 3), [[1.0, 2.0]]]
)
def test_what_is_not_this_picture_is_refused(pixels):
    with pytest.raises(SceneCaptumError, match=r"shape \(1, 2\) or \(1, 2, 3\)"):
        project_pixels(Shown(), pixels)


def test_unknown_surfaces_and_infinite_values_are_refused():
    with pytest.raises(SceneCaptumError, match="Only a SceneRenderer knows"):
        project_pixels(object(), torch.ones(1, 2))
    with pytest.raises(SceneCaptumError, match="not finite"):
        project_pixels(Shown(), torch.tensor([[1.0, math.inf]]))
