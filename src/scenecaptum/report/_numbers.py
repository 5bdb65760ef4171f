"""Write the numbers of a result as JSON and as CSV."""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Mapping
from typing import Any

import torch

from ..attr import SceneAttribution
from ..files import atomic_write
from ..visualization import attributed_name, metric_unit, row_cautions
from ._data import metric_caution, plain

# Of the numbers of a row, those of which each channel has a column in CSV.
_LISTS = ("total", "total_error", "value", "range")


def write_json(attribution: SceneAttribution, path: str | os.PathLike[str]) -> None:
    """Write the metric with its error, the ranking and all settings as JSON.

    Parameters
    ----------
    attribution
        The result.
    path
        The file to write, atomically.

    Raises
    ------
    SceneCaptumError
        If the file cannot be written.
    """
    with atomic_write(path) as partial:
        partial.write_text(json_text(attribution) + "\n", encoding="utf-8")


def json_text(attribution: SceneAttribution) -> str:
    """Return the text of ``write_json``."""
    info = attribution.info
    numbers = {
        "metric": {
            "name": info["metric"],
            "measure": attributed_name(attribution),
            "unit": metric_unit(attribution),
            "value": attribution.metric_value,
            "standard_error": attribution.metric_standard_error,
            "bias": info.get("metric_bias"),
            "interval_95": attribution.metric_interval(0.95),
            "caution": metric_caution(info),
        },
        "ranking": _rows(attribution),
        "info": info,
    }
    return json.dumps(plain(numbers), indent=1, ensure_ascii=False, allow_nan=False)


def _rows(attribution: SceneAttribution) -> list[dict[str, Any]]:
    """Return the rows of the ranking with the values in the scene, the ranges, and what puts a row in doubt."""
    cautions = row_cautions(attribution)

    def numbers(tensors: Mapping[str, torch.Tensor], name: str) -> list[float]:
        return tensors[name].reshape(-1).tolist() if name in tensors else []

    return [
        {
            **row._asdict(),
            "value": numbers(attribution.parameter_values, row.name),
            "range": numbers(attribution.extents, row.name),
            "caution": cautions.get(row.name),
        }
        for row in attribution.ranking()
    ]


def write_csv(attribution: SceneAttribution, path: str | os.PathLike[str]) -> None:
    """Write the ranking as CSV: one row for each parameter, with the total of each channel and its error.

    The columns are named as in the JSON: ``total_1`` is the attribution summed over the texels of a texture, that
    is a gradient per unit, a contribution or an effect of ablation, depending on the method. ``value_1`` is the
    value in the scene, of a texture the mean, and ``range_1`` the length of the range over which the effect is.
    ``caution`` says what puts a row in doubt, such as an unreliable standard error (``?``). The columns of the
    metric, its name, value, standard error, unit and what puts it in doubt, are the same in every row.

    ``attribution``, ``path`` and the errors are as for ``write_json``.
    """
    rows = _rows(attribution)
    counts = {column: max((len(row[column] or ()) for row in rows), default=0) for column in _LISTS}
    counts["total_error"] = counts["total"]  # empty where a result has no error bars
    of_metric = {
        "metric": attributed_name(attribution),
        "metric_value": attribution.metric_value,
        "metric_error": attribution.metric_standard_error,
        "metric_unit": metric_unit(attribution),
        "metric_caution": metric_caution(attribution.info),
    }
    columns = [
        *("rank", "name", "label", "effect", "effect_error"),
        *(f"{column}_{c + 1}" for column, count in counts.items() for c in range(count)),
        *("caution", *of_metric),
    ]
    with atomic_write(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, extrasaction="ignore")
        writer.writeheader()
        for row in rows:
            numbered = {f"{column}_{c + 1}": n for column in _LISTS for c, n in enumerate(row[column] or ())}
            writer.writerow({**row, **numbered, **of_metric})
