"""Every plot function and method: the same parameters, and drawing into given axes or a given figure."""

from __future__ import annotations

import functools
import importlib
import inspect
import pkgutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from matplotlib.figure import Figure
from results import make
from studies import made

import scenecaptum
from scenecaptum import SceneCaptumError, metrics, optimize, studies, tradeoff, visualization
from scenecaptum.validation import (
    Ablated,
    AblationTest,
    DeletionInsertion,
    Infidelity,
    Interactions,
    RandomizationCheck,
    Scalar,
    SensitivityComparison,
    SensitivityIndex,
    SensitivityN,
)

NAMES = {"metric": "Glare", "method": "VanillaSceneGradient"}
SPREAD = torch.linspace(-0.01, 0.01, 8).double()
VALUES = torch.linspace(-1.0, 1.0, 6).double()
FOLDER = tempfile.TemporaryDirectory()
PLAN = torch.stack(torch.meshgrid(torch.arange(6.0), torch.arange(4.0), indexing="xy"), -1)


def ablation() -> AblationTest:
    rows = tuple(Ablated(name, name, 2.0, 0.1, 2.1, 0.1, -0.1, 0.0, 7, 1.9, 0.1) for name in ("lamp", "wall"))
    return AblationTest(rows, "Glare")


def curves() -> DeletionInsertion:
    curve = torch.tensor([3.0, 1.0, 0.0]).double()[:, None] + SPREAD
    random = torch.stack([curve, curve + 0.5])
    return DeletionInsertion(
        ("a", "b"), ("lamp", "wall"), torch.arange(3), curve, curve.flip(0), random, **NAMES
    )


def missed() -> Infidelity:
    return Infidelity(VALUES, VALUES[:, None] + SPREAD, **NAMES)


def correlated() -> SensitivityN:
    return SensitivityN(9, (1, 3), (VALUES, VALUES), (VALUES[:, None] + SPREAD,) * 2, **NAMES)


def interacting() -> Interactions:
    matrix = torch.tensor([[2.0, 0.1], [0.1, 0.0]]).double() + SPREAD[:, None, None]
    names = ("lamp", "wall")
    return Interactions(names, names, matrix, torch.zeros(2, 2), (0.1, 0.1), metric="Glare", scale="unit")


def randomized() -> RandomizationCheck:
    correlations = torch.tensor([[0.9, 0.8], [0.1, -0.2]])
    return RandomizationCheck(("last",), (0, 1), correlations, -correlations, **NAMES)


def compared() -> SensitivityComparison:
    scalars = tuple(Scalar(name, name, 0.0, 1.0, torch.ones(())) for name in "abc")
    values, errors = {"a": 3.0, "b": 2.0, "c": 1.0}, dict.fromkeys("abc", 0.1)
    methods = ("gradient × range", "DGSM bound", "Morris μ*", "Sobol total")
    indices = [SensitivityIndex(name, values, errors, 8, 4, True, ("a",), True, 1.0) for name in methods]
    return SensitivityComparison(scalars, *indices, metric="Glare")


def traded() -> tradeoff.Tradeoff:
    one, bias = tradeoff.Estimate(0.9, 0.01), tradeoff.Bias(0.0, 0.01, 0.1)
    rows = [
        tradeoff.Measured(
            varied,
            tradeoff.Setting(spp, spp),
            spp / 16,
            tradeoff.Estimate(1 / spp, 0.01),
            0.5 / spp,
            bias,
            *4 * [one],
        )
        for varied, spp in (("", 16), ("spp", 64))
    ]
    reference = tradeoff.Reference(tradeoff.Setting(512, 512), 9.0, 0.001, 1.0)
    return tradeoff.Tradeoff(tuple(rows), reference, 4, 3, "Glare", "office")


def optimized() -> optimize.Optimization:
    before, after = (optimize.Measured(value, 0.1, torch.ones(4, 6, 3)) for value in (9.0, 3.0))
    return optimize.Optimization({}, (), before, after, (9.0, 6.0, 3.0), 5.0, "Glare")


@functools.cache
def rooms() -> studies.StudyResult:
    """A study of two rooms, from two cameras each."""
    cells = made.cells(["office", "attic"], ["front", "left"])
    return made.study(Path(FOLDER.name), made.random_effects(cells, 0))


# By qualified name; each takes ``ax`` or ``figure``.
PLOTS: dict[str, Callable[..., Figure]] = {
    "SceneAttribution.plot_bars": lambda **where: make().plot_bars(**where),
    "SceneAttribution.plot_heatmap": lambda **where: make().plot_heatmap(**where),
    "SceneAttribution.plot_overlay": lambda **where: make().plot_overlay(**where),
    "plot_bars": lambda **where: visualization.plot_bars(make(), **where),
    "plot_heatmap": lambda **where: visualization.plot_heatmap(make(), **where),
    "plot_overlay": lambda **where: visualization.plot_overlay(make(), **where),
    "plot_plan": lambda **where: visualization.plot_plan(torch.ones(4, 6), PLAN, **where),
    "plot_rank_comparison": lambda **where: visualization.plot_rank_comparison(make(), make(), **where),
    "plot_luminance": lambda **where: metrics.plot_luminance(torch.ones(4, 6, 3), **where),
    "AblationTest.plot": lambda **where: ablation().plot(**where),
    "Infidelity.plot": lambda **where: missed().plot(**where),
    "SensitivityN.plot": lambda **where: correlated().plot(**where),
    "Interactions.plot": lambda **where: interacting().plot(**where),
    "RandomizationCheck.plot": lambda **where: randomized().plot(**where),
    "Tradeoff.plot": lambda **where: traded().plot(**where),
    "plot_specificity": lambda **where: visualization.plot_specificity([make(), make()], **where),
    "DeletionInsertion.plot": lambda **where: curves().plot(**where),
    "SensitivityComparison.plot": lambda **where: compared().plot(**where),
    "Optimization.plot": lambda **where: optimized().plot(**where),
    "plot_effect_by_room": lambda **where: studies.plot_effect_by_room(rooms().summary(), **where),
    "plot_rank_stability": lambda **where: studies.plot_rank_stability(rooms(), None, **where),
    "plot_gallery": lambda **where: studies.plot_gallery(rooms(), **where),
    "StudyResult.plot_effects": lambda **where: rooms().plot_effects(**where),
    "StudyResult.plot_stability": lambda **where: rooms().plot_stability(None, **where),
    "StudyResult.plot_gallery": lambda **where: rooms().plot_gallery(**where),
}
SEVERAL_PANELS = {
    "plot_specificity",
    "DeletionInsertion.plot",
    "SensitivityComparison.plot",
    "Optimization.plot",
    "plot_gallery",
    "StudyResult.plot_gallery",
}


def public_plots() -> dict[str, Any]:
    """Return every plot function and method of the library by qualified name."""
    found = {}
    for module in pkgutil.iter_modules(scenecaptum.__path__, "scenecaptum."):
        if "._" not in module.name and module.name != "scenecaptum.cli":
            for thing in vars(importlib.import_module(module.name)).values():
                members = vars(thing).values() if inspect.isclass(thing) else [thing]
                found |= {f.__qualname__: f for f in members if getattr(f, "__name__", "").startswith("plot")}
    return found


def test_every_plot_is_tried_here() -> None:
    assert public_plots().keys() == PLOTS.keys()


@pytest.mark.parametrize("name", PLOTS)
def test_plots_have_the_same_parameters_in_the_same_order(name: str) -> None:
    signature = inspect.signature(public_plots()[name])
    where = "figure" if name in SEVERAL_PANELS else "ax"
    keywords = [p for p in signature.parameters.values() if p.kind is p.KEYWORD_ONLY]
    assert (keywords[0].name, keywords[0].default) == (where, None)
    assert signature.return_annotation == "Figure"
    if "top" in signature.parameters:
        assert signature.parameters["top"].default == visualization.DEFAULT_TOP


@pytest.mark.parametrize("name", PLOTS)
def test_plots_draw_into_what_they_are_given_and_return_its_figure(name: str) -> None:
    assert isinstance(PLOTS[name](), Figure)
    figure = Figure(figsize=(9, 6), layout="constrained")
    beside, part = figure.subfigures(1, 2)
    if name in SEVERAL_PANELS:
        assert PLOTS[name](figure=part) is figure
    else:
        ax = part.subplots()
        assert PLOTS[name](ax=ax) is figure
        assert ax.has_data() or ax.texts
    figure.canvas.draw()
    assert figure.axes
    assert not beside.axes


@pytest.mark.parametrize("name", PLOTS)
def test_plots_show_at_least_one_parameter(name: str) -> None:
    if "top" in inspect.signature(public_plots()[name]).parameters:
        PLOTS[name](top=None)
        with pytest.raises(SceneCaptumError, match="top must be a whole number of at least 1, not 0"):
            PLOTS[name](top=0)
