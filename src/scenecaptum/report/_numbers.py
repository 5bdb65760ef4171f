"""Write the numbers of a result as JSON and as CSV."""

from __future__ import annotations

import csv
import json
import os

from ..attr import SceneAttribution
from ..files import atomic_write
from ._data import plain


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
            "value": attribution.metric_value,
            "standard_error": attribution.metric_standard_error,
            "bias": info.get("metric_bias"),
            "interval_95": attribution.metric_interval(0.95),
            "caution": _metric_caution(attribution),
        },
        "ranking": [row._asdict() for row in attribution.ranking()],
        "info": info,
    }
    return json.dumps(plain(numbers), indent=1, ensure_ascii=False, allow_nan=False)


def write_csv(attribution: SceneAttribution, path: str | os.PathLike[str]) -> None:
    """Write the ranking as CSV: one row for each parameter, with the total of each channel and its error.

    The columns are named as in the JSON: ``total_1`` is the attribution summed over the texels of a texture, that
    is a gradient per unit, a contribution or an effect of ablation, depending on the method.

    ``attribution``, ``path`` and the errors are as for ``write_json``.
    """
    rows = attribution.ranking()
    channels = range(max((len(row.total) for row in rows), default=0))
    caution = _metric_caution(attribution) or ""
    with atomic_write(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        columns = ["rank", "name", "label", "effect", "effect_error"]
        totals = [f"{column}_{c + 1}" for column in ("total", "total_error") for c in channels]
        writer.writerow([*columns, *totals, "metric_caution"])
        for row in rows:
            padding = [""] * (len(channels) - len(row.total))
            errors = ("",) * len(row.total) if row.total_error is None else row.total_error
            head = [row.rank, row.name, row.label, row.effect, row.effect_error]
            writer.writerow([*head, *row.total, *padding, *errors, *padding, caution])


def _metric_caution(attribution: SceneAttribution) -> str | None:
    caution: str | None = (attribution.info.get("picture") or {}).get("caution")
    return caution
