"""What the page knows: results, pictures and objects as plain data."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ...errors import SceneCaptumError
from ...projection import heatmap, shared_maximum
from .._figures import LOWERS, RAISES, UNCLEAR, colour_of
from .._numbers import with_error
from .._words import (
    axis_words,
    caution_groups,
    convergence_words,
    doubt_groups,
    method_name,
    metric_name,
    quantity,
    sampling_words,
    scene_cautions,
    sign_words,
)
from ._pixels import colour_maps, encode_map, encode_picture, encode_surfaces

if TYPE_CHECKING:
    from ...attr import Ranked, SceneAttribution
    from ...scene import SurfaceMap

_DIGITS = 9  # all that single precision has
_MOST_CHANNELS = 64
_SIGNS = {RAISES: 1, LOWERS: -1, UNCLEAR: 0}
_COLOURS = ("reflectance", "radiance", "irradiance", "color", "transmittance", "albedo")


def report_data(attributions: Sequence[SceneAttribution], titles: Sequence[str]) -> dict[str, Any]:
    """Return everything that the page shows; what results have in common is there once."""
    shared: dict[str, list[Any]] = {"views": [], "pictures": []}
    seen: dict[int, tuple[int, NDArray[np.int64]]] = {}
    results = []
    for attribution, title in zip(attributions, titles, strict=True):
        surfaces = attribution.surfaces
        assert surfaces is not None, "write_report asks for it"
        assert attribution.image is not None, "write_report asks for it"
        if id(surfaces) not in seen:
            view, shown = _view(surfaces)
            seen[id(surfaces)] = _place(shared["views"], view), shown
        index, shown = seen[id(surfaces)]
        picture = _place(shared["pictures"], encode_picture(attribution.image))
        results.append({"view": index, "picture": picture, **_result(attribution, title, surfaces, shown)})
    return {"results": results, **shared, "maps": colour_maps()}


def _place(known: list[Any], one: Any) -> int:
    """Return the index of something in a list, to which it is added where it is new."""
    if one not in known:
        known.append(one)
    return known.index(one)


def _view(surfaces: SurfaceMap) -> tuple[dict[str, Any], NDArray[np.int64]]:
    planes, shown = encode_surfaces(surfaces)
    height, width = surfaces.shape
    return {
        "width": width,
        "height": height,
        "names": [surfaces.objects[index] for index in shown],
        **planes,
    }, shown


def _result(
    attribution: SceneAttribution, title: str, surfaces: SurfaceMap, shown: NDArray[np.int64]
) -> dict[str, Any]:
    ranking = attribution.ranking()
    cautions = caution_groups(attribution, (row.name for row in ranking))
    number = {name: index for index, names in enumerate(cautions.values()) for name in names}
    doubts = doubt_groups(attribution)
    doubt = {name: index for index, names in enumerate(doubts.values()) for name in names}
    below = _rows_below(attribution, ranking, surfaces)
    objects = [_painted(ranking, rows) for rows in below]
    value, error = with_error(attribution.metric_value, attribution.metric_standard_error, digits=3)
    return {
        "title": title,
        "metric": metric_name(attribution),
        "quantity": quantity(attribution),
        "axis": axis_words(attribution),
        "signs": sign_words(attribution),
        "value": _number(attribution.metric_value),
        "error": _number(attribution.metric_standard_error),
        "written": [value, error],
        "method": method_name(attribution),
        "sampling": sampling_words(attribution),
        "convergence": convergence_words(attribution),
        "cautions": list(cautions),
        "sceneCautions": scene_cautions(attribution),
        "doubts": list(doubts),
        "rows": [
            {
                **_row(attribution, row),
                "caution": number.get(row.name),
                "doubt": doubt.get(row.name),
            }
            for row in ranking
        ],
        "objects": [
            {"rows": below[i], "magnitude": _number(abs(objects[i])), "signed": _number(objects[i])}
            for i in shown
        ],
        # Set by what is out of sight too, as in ``heatmap``.
        "largest": _number(max([row.saliency for row in ranking] + list(map(abs, objects)), default=0.0)),
        "texels": _texels(attribution, surfaces),
        "info": _plain(attribution.info),
    }


def _texels(attribution: SceneAttribution, surfaces: SurfaceMap) -> dict[str, Any] | None:
    """Return the maps that show textures texel by texel, where there are any."""
    if not any(name in surfaces.texels for name in attribution):
        return None
    maps = {"magnitude": False, "signed": True}
    return {
        "largest": _number(shared_maximum([attribution], texels=True)),
        **{
            name: encode_map(heatmap(attribution, texels=True, signed=signed), signed=signed)
            for name, signed in maps.items()
        },
    }


def _rows_below(
    attribution: SceneAttribution, ranking: Sequence[Ranked], surfaces: SurfaceMap
) -> list[list[int]]:
    """Return for each object the rows that it shows, by rank; a group's where the attribution is to groups."""
    place = {row.name: row.rank - 1 for row in ranking}
    groups = attribution.info.get("groups") or {name: [name] for name in place}
    row_of = {name: place[group] for group, members in groups.items() if group in place for name in members}
    return [sorted({row_of[name] for name in names if name in row_of}) for names in surfaces.parameters]


def _painted(ranking: Sequence[Ranked], rows: Sequence[int]) -> float:
    """Return an object's saliency, as ``heatmap`` paints it, with the sign of raising everything of it alike."""
    magnitude = math.hypot(*(ranking[index].saliency for index in rows))
    return math.copysign(magnitude, math.fsum(sum(ranking[index].total) for index in rows))


def _row(attribution: SceneAttribution, row: Ranked) -> dict[str, Any]:
    errors: Sequence[float | None] = row.total_error or [None] * len(row.total)
    few = len(row.total) <= _MOST_CHANNELS
    members = (attribution.info.get("groups") or {}).get(row.name)
    return {
        "name": row.name,
        "label": row.label,
        "saliency": _number(row.saliency),
        "error": _number(row.saliency_error),
        "written": with_error(row.saliency, row.saliency_error),
        "sign": _SIGNS[colour_of(row, attribution)],
        "total": [_number(one) for one in row.total] if few else [],
        "totalError": [_number(one) for one in errors] if few and row.total_error else [],
        "totalWritten": [_with_sign(value, error) for value, error in zip(row.total, errors, strict=True)]
        if few
        else [],
        "channels": len(row.total),
        "texture": attribution[row.name].ndim > 1,
        **_value(attribution, row.name, members),
    }


def _with_sign(value: float, error: float | None) -> tuple[str, str]:
    written, bar = with_error(value, error)
    return (f"+{written}" if value > 0 else written), bar


def _value(attribution: SceneAttribution, name: str, members: Sequence[str] | None) -> dict[str, Any]:
    """Return what is known of a parameter's value, or a group's members."""
    if members is not None and list(members) != [name]:
        return {"members": list(members)}
    tensor = attribution.parameter_values.get(name)
    if tensor is None:
        return {}
    textured = attribution[name].ndim > 1
    numbers = [float(one) for one in tensor.flatten().tolist()]
    parts = set(name.replace("_", ".").split("."))
    colour = len(numbers) == 3 and bool(parts & set(_COLOURS))
    return {
        "value": [_number(one) for one in numbers],
        "valueWritten": [f"{one:.3g}" if textured else f"{one:.4g}" for one in numbers],
        **({"swatch": _swatch(numbers)} if colour else {}),
    }


def _swatch(linear: Sequence[float]) -> str:
    """Return a linear RGB colour for the screen; a light's, whose size is open, at full brightness."""
    top = max(1.0, *linear)
    shares = [min(max(one / top, 0.0), 1.0) if math.isfinite(one) else 0.0 for one in linear]
    encoded = [12.92 * x if x <= 0.0031308 else 1.055 * x ** (1 / 2.4) - 0.055 for x in shares]
    return "#" + "".join(f"{round(255 * one):02x}" for one in encoded)


def _number(value: float | None) -> float | None:
    """Return a number that JSON has: no infinity, nothing that is not a number, no digits of mere rounding."""
    if value is None or not math.isfinite(value):
        return None
    return float(f"{value:.{_DIGITS}g}")


def _plain(info: Any) -> Any:
    """Return settings as JSON can hold them, whatever a renderer of one's own put there."""
    if isinstance(info, Mapping):
        return {str(key): _plain(value) for key, value in info.items()}
    if isinstance(info, (list, tuple)):
        return [_plain(one) for one in info]
    if isinstance(info, float):
        return info if math.isfinite(info) else str(info)
    return info if info is None or isinstance(info, (str, int, bool)) else str(info)


def default_titles(attributions: Sequence[SceneAttribution]) -> list[str]:
    """Name results by their metrics and, where these are alike, by what else tells them apart."""
    names = [metric_name(one) for one in attributions]
    for key in (None, "scene", "sensor", "method", "resolution", "seed"):
        titles = [_title(n, a, key) for n, a in zip(names, attributions, strict=True)]
        if len(set(titles)) == len(titles):
            return titles
    return [f"{name} ({index})" for index, name in enumerate(names, start=1)]


def _title(name: str, attribution: SceneAttribution, key: str | None) -> str:
    return name if key is None else f"{name} · {attribution.info.get(key)}"


def check(attributions: Sequence[SceneAttribution], titles: Sequence[str] | None) -> None:
    """Refuse what no report can be made of."""
    if not attributions:
        raise SceneCaptumError("A report needs at least one attribution; the list is empty.")
    if titles is not None and len(titles) != len(attributions):
        raise SceneCaptumError(
            f"titles must name each of the {len(attributions)} attributions, not {len(titles)} of them."
        )
    for attribution in attributions:
        which = f"The attribution of {metric_name(attribution)}"
        if attribution.surfaces is None:
            raise SceneCaptumError(
                f"{which} does not know which object each pixel shows, so a report cannot point at them: only a "
                "SceneRenderer does. Its tables and bars still draw."
            )
        if attribution.image is None:
            raise SceneCaptumError(f"{which} has no picture, so there is nothing for a report to show.")
        if tuple(attribution.image.shape) != (*attribution.surfaces.shape, 3):
            raise SceneCaptumError(
                f"{which} has a picture of shape {tuple(attribution.image.shape)}, but knows the objects of one "
                f"of shape {(*attribution.surfaces.shape, 3)}: a report needs one picture, not a stack of them."
            )
