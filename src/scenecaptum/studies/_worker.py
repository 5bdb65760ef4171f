"""What a worker does: compute one cell, and write its file."""

from __future__ import annotations

import dataclasses
import platform
import time
import traceback
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from ..attr import METHODS, SceneAttribution
from ..backend import activate, use_threads
from ..designs import design_of
from ..errors import SceneCaptumError
from ..estimation import DEFAULT_REPLICATES, Metric, Sampling, TargetedMetric, input_values, metric_value
from ..executors import made
from ..explanation import grid_size, rated_image
from ..protocols import Capabilities
from ..rendering import SceneRenderer
from ..scene import restored
from ..visualization import class_doubt, metric_name, metric_unit, row_cautions
from ._folder import StudyFolder
from ._metrics import create_metric, renderer_options_for, target_of
from ._notes import convergence_of, described
from ._recipe import Recipe

VALUE = "value"  # the method that measures the metric, without derivatives


@dataclass(frozen=True)
class Outcome:
    """What became of a cell: its error if it failed, and how long it took."""

    key: str
    seconds: float
    error: str = ""
    host: str = ""  # the name of the worker's machine


def compute_cell(recipe: Recipe, folder: str, study: str, threads: int | None) -> Outcome:
    """Compute a cell and write its file; an exception becomes the error of the outcome."""
    started = time.perf_counter()
    error = ""
    try:
        opened = StudyFolder.of_worker(Path(folder), study)
        if threads is not None:
            use_threads(threads)
        numbers, attribution = _compute(recipe)
        numbers["seconds"] = time.perf_counter() - started
        opened.write(recipe, numbers, attribution)
    except SceneCaptumError as problem:
        error = str(problem)
    except Exception as problem:  # whatever the user's metric raises is the error of its cell
        *_, place = traceback.extract_tb(problem.__traceback__)
        error = f"{type(problem).__name__}: {problem} ({Path(place.filename).name}:{place.lineno})"
    return Outcome(recipe.key, time.perf_counter() - started, error, host_name())


def _compute(recipe: Recipe) -> tuple[dict[str, Any], SceneAttribution | None]:
    """Return the numbers of a cell, and its attribution if its method is one."""
    renderer = _renderer(recipe)
    metric = create_metric(recipe.metric, recipe.metric_options, renderer)
    values = design_of(renderer, recipe.design) if recipe.design else None
    options = {"seed": recipe.cell.seed, **recipe.method_options}
    if (target := target_of(recipe.metric, recipe.metric_options)) is not None:
        options["target"] = target
    if recipe.method == VALUE:
        return _measure(recipe, renderer, metric, values, options), None
    attribution = METHODS[recipe.method].create(renderer, metric).attribute(values, **options)
    assert attribution.image is not None, "every attribution of a SceneRenderer has its image"
    targeted = TargetedMetric(metric, options.get("target"))
    shown = rated_image(attribution, renderer)
    value, error = attribution.metric_value, attribution.metric_standard_error
    info, made_up = attribution.info, has_made_up_weather(recipe)
    said = described(
        targeted, attribution.image, shown, value, error, info, renderer, values=values, made_up=made_up
    )
    info = {**info, "measure": said["measure"], "verdict": said["verdict"], **_grid(renderer)}
    attribution = dataclasses.replace(attribution, info=info)
    table, cautions = renderer.parameters_table(), row_cautions(attribution)
    rows = [
        {
            "rank": row.rank,
            "name": row.name,
            "label": row.label,
            "kind": table[row.name].kind if row.name in table else "group",
            "effect": row.effect,
            "effect_error": row.effect_error,
            "saliency": row.saliency,
            "saliency_error": row.saliency_error,
            "caution": cautions.get(row.name, ""),
        }
        for row in attribution.ranking()
    ]
    numbers = {
        "measure": metric_name(attribution),
        "unit": metric_unit(attribution),
        "value": value,
        "standard_error": error,
        **_beside(said, value, error),
        **convergence_of(attribution),
        "max_depth": renderer.plan.max_depth,
        "host": host_name(),
        "rows": rows,
    }
    return numbers, attribution


def has_made_up_weather(recipe: Recipe) -> bool:
    """Return whether the weather of a metric of daylight is the year that stands for a file."""
    return isinstance(recipe.metric, str) and recipe.metric_options.get("weather") is None


def _grid(renderer: SceneRenderer) -> dict[str, str]:
    """Return what ``info`` says of a grid over a floor."""
    return {"sensor grid": grid_size(renderer.grid)} if renderer.has_grid and renderer.grid.sides else {}


def _beside(said: Mapping[str, Any], value: float, error: float | None) -> dict[str, Any]:
    """Return what stands beside the value of a cell: class, notes, cautions, and a rating by another threshold."""
    doubt = class_doubt(said, [(value, error)]) if said["verdict"] else ""
    verdict = "; ".join(filter(None, [said["verdict"], doubt]))
    return {**{name: item for name, item in said.items() if name != "measure"}, "verdict": verdict}


def _measure(
    recipe: Recipe, renderer: SceneRenderer, metric: Metric, values: Any, options: dict[str, Any]
) -> dict[str, Any]:
    """Return a metric with its standard error, as the method "gradient" measures it."""
    sampling = Sampling(
        options["seed"],
        options.get("spp") or Capabilities(renderer).spp,
        options.get("replicates", DEFAULT_REPLICATES),
        picture_spp=options.get("picture_spp"),
    )
    targeted = TargetedMetric(metric, options.get("target"))
    found = metric_value(
        renderer, targeted, input_values(renderer, values), sampling, options.get("denoise", "auto")
    )
    info = found.metric.describe(found.value, found.image)
    shown = found.metric.transform(found.image)
    made_up = has_made_up_weather(recipe)
    said = described(
        targeted, found.image, shown, found.value, found.error, info, renderer, values=values, made_up=made_up
    )
    measure = said["measure"] or {}
    return {
        "measure": measure.get("name", found.metric.name),
        "unit": measure.get("unit", ""),
        "value": found.value,
        "standard_error": found.error,
        **_beside(said, found.value, found.error),
        "max_depth": renderer.plan.max_depth,
        "host": host_name(),
        "rows": [],
    }


def _renderer(recipe: Recipe) -> SceneRenderer:
    """Return the renderer of a cell: kept from an earlier cell, or a new one."""
    if (
        isinstance(recipe.scene, str)
        and Path(recipe.scene).is_absolute()
        and not Path(recipe.scene).is_file()
    ):
        raise SceneCaptumError(
            f"The scene {recipe.scene} is not on this machine: put it into a folder that all machines share."
        )
    options = {
        **recipe.renderer_options,
        "sensor": recipe.sensor,
        **renderer_options_for(recipe.metric, recipe.metric_options),
    }
    renderer: SceneRenderer = made(partial(_make, recipe.scene, options))
    return renderer


def _make(scene: Any, options: dict[str, Any]) -> SceneRenderer:
    activate()
    return SceneRenderer(restored(scene), **options)


def host_name() -> str:
    return platform.node() or "unknown host"
