"""A server that explores a tiny cornell box, and its page in a browser window."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from browsers import browser
from seeds import shifted

from scenecaptum import SceneRenderer, metrics
from scenecaptum.explore import Exploration, Server
from scenecaptum.explore._session import RECIPE

from .windows import served

__all__ = ["browser"]


@pytest.fixture(scope="session")
def tiny() -> SceneRenderer:
    return SceneRenderer("cornell-box", inputs="all", resolution=(24, 24), spp=16, max_depth=3)


@pytest.fixture(scope="session")
def exploration(tiny: SceneRenderer) -> Exploration:
    named = {"brightness": metrics.MeanLuminance(), "highlights": metrics.LuminancePercentile()}
    python = (
        "import torch\n\nfrom scenecaptum import SceneRenderer, VanillaSceneGradient, metrics\n\n"
        "renderer = SceneRenderer('cornell-box', {inputs}, resolution=(24, 24), spp=64, max_depth=3)\n"
        "values = renderer.inputs"
    )
    words = "attribute cornell-box --metric luminance --metric percentile --resolution 24x24 --max-depth 3"
    code = ["metrics.MeanLuminance()", "metrics.LuminancePercentile()"]
    recipe = dict(RECIPE, python=python, metrics=code, command=f"scenecaptum {words}")
    return Exploration(tiny, named, seed=shifted(), spp=64, recipe=recipe)


@pytest.fixture(scope="session")
def server(exploration: Exploration) -> Iterator[Server]:
    with served(exploration) as started:
        yield started
