"""The data of the page: results, images and objects as JSON values."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..attr import Explanation
from ..errors import SceneCaptumError
from ..estimation import student_t
from ..projection import (
    SurfaceMap,
    clear_sum,
    heatmap,
    mapped_parameters,
    shared_maximum,
    used_by_objects,
    views_without_map,
)
from ..protocols import Attribution, RankedParameter, ResultKind
from ..scene import with_unit
from ..visualization import (
    LOWERS,
    RAISES,
    TEXEL_MEANING,
    UNCLEAR,
    Format,
    arrows,
    attributed_name,
    automatic_exposure,
    axis_label,
    baseline_notes,
    caution_groups,
    color_of,
    convergence_notes,
    findings,
    group_notes,
    is_denoised,
    is_of_camera,
    jump_notes,
    kept_channels,
    light_notes,
    method_name,
    metric_name,
    metric_symbol,
    metric_unit,
    noise_notes,
    pose_notes,
    range_notes,
    rating,
    rounded,
    row_cautions,
    sampling_notes,
    scene_cautions,
    shown_render,
    sign_labels,
    signed_with_error,
    unit_notes,
    unit_of_change,
    untrusted_groups,
    with_error,
)
from ._pixels import PLAN_DPI, color_maps, encode_figure, encode_map, encode_picture, encode_surfaces

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_DIGITS = 9  # of single precision
_MAX_CHANNELS = 64
_FALSE_ALARMS = 0.05  # for all effects of a map together
_SIGNS = {RAISES: 1, LOWERS: -1, UNCLEAR: 0}
_COLOR_PARAMETERS = ("reflectance", "radiance", "irradiance", "color", "transmittance", "albedo")


@dataclass(frozen=True)
class Table:
    """A table of text below the change of a metric.

    Attributes
    ----------
    caption
        What its numbers are.
    columns
        The heads of its columns.
    rows
        Rows of as many texts as there are columns; the first names the row.
    notes
        Sentences below it.
    """

    caption: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    notes: Sequence[str] = ()


@dataclass(frozen=True)
class Comparison:
    """The change of a metric from the first of two results to the second, which stands on top of the page.

    Attributes
    ----------
    change, standard_error
        The change, and its standard error if it is known.
    notes
        Sentences below it, such as how it was measured.
    effects
        How the effects changed, as a table.
    """

    change: float
    standard_error: float | None = None
    notes: Sequence[str] = ()
    effects: Table | None = None


def report_data(
    attributions: Sequence[Attribution],
    titles: Sequence[str],
    explanations: Sequence[Explanation | None],
    plans: Sequence[Figure | None],
    comparison: Comparison | None,
    *,
    denoised: bool,
) -> dict[str, Any]:
    """Return the data of the page; views and images that results share are stored once."""
    shared: dict[str, list[Any]] = {"views": [], "pictures": []}
    views: dict[int, tuple[int, NDArray[np.int64]]] = {}
    # That of the first picture of each camera: designs are to be compared, also where they move the camera.
    exposures: dict[Any, float] = {}
    results = []
    for attribution, title, explanation, plan in zip(attributions, titles, explanations, plans, strict=True):
        camera = None if comparison is not None else repr(attribution.info.get("sensor"))
        encoded, surfaces = _picture(attribution, plan, exposures, camera, denoised=denoised)
        if id(surfaces) not in views:
            view, shown = _view(surfaces)
            views[id(surfaces)] = _index_in(shared["views"], view), shown
        index, shown = views[id(surfaces)]
        picture = _index_in(shared["pictures"], encoded)
        results.append(
            {
                "view": index,
                "picture": picture,
                "isDenoised": plan is None and (denoised or is_denoised(attribution)),
                **_result(attribution, title, surfaces, shown, explanation),
            }
        )
    compared = None
    if comparison is not None:
        compared = _comparison(attributions[0], attributions[1], comparison)
        for result in results:
            result["arrows"] = []  # of gradients: between two designs they would look like what was moved
    return {"results": results, "comparison": compared, **shared, "maps": color_maps()}


def _comparison(before: Attribution, after: Attribution, comparison: Comparison) -> dict[str, Any]:
    """Return the change, and the values that differ."""
    return {
        "change": _number(comparison.change),
        "error": _number(comparison.standard_error),
        "written": signed_with_error(comparison.change, comparison.standard_error),
        "unit": unit_of_change(metric_unit(before)),
        "notes": findings(comparison.notes),
        "effects": None
        if comparison.effects is None
        else {**vars(comparison.effects), "notes": findings(comparison.effects.notes)},
        "values": [
            {
                "name": name,
                "label": with_unit(before.labels.get(name, name), name),
                "texture": _is_texture(before, name),
                "values": [_written_value(one, name, one.parameter_values[name]) for one in (before, after)],
            }
            for name in different_values(before, after)
        ],
    }


def different_values(before: Attribution, after: Attribution) -> list[str]:
    """Return the parameters that have different values in two results."""
    values, others = before.parameter_values, after.parameter_values
    return [name for name in values if name in others and not torch.equal(values[name], others[name])]


def describe_objects(
    surfaces: SurfaceMap, movable: Collection[str], attributions: Sequence[Attribution]
) -> dict[str, Any]:
    """Return what each pixel shows, which of some parameters change it, and the signed effects of each object.

    Effects that say little of their ranges, those of ``ranked_last``, are no part of an object's.
    """
    view, shown = _view(surfaces)
    signed = []
    for attribution in attributions:
        last = attribution.ranked_last()
        effects = {name: 0.0 if name in last else one for name, one in attribution.effects().items()}
        used = used_by_objects(attribution, surfaces, mapped_parameters(attribution))
        signed.append([sum(effects[name] for name in used[index]) for index in shown])
    parameters = [[name for name in surfaces.parameters[index] if name in movable] for index in shown]
    return {**view, "parameters": parameters, "effects": signed, "maps": color_maps()}


def _picture(
    attribution: Attribution,
    plan: Figure | None,
    exposures: dict[Any, float],
    camera: str | None,
    *,
    denoised: bool,
) -> tuple[str, SurfaceMap]:
    """Return the encoded picture and what its pixels show, which is nothing if it is a plan."""
    if plan is not None:
        encoded, shape = encode_figure(plan, PLAN_DPI)
        return encoded, _nothing(shape)
    assert attribution.surfaces is not None, "write_report checks it"
    image = shown_render(attribution, denoised=denoised)
    exposure = exposures.setdefault(camera, automatic_exposure(image))
    return encode_picture(image, exposure), attribution.surfaces


def _nothing(shape: tuple[int, int]) -> SurfaceMap:
    none: NDArray[np.int32] = np.zeros(0, np.int32)
    return SurfaceMap(shape, none, none, np.zeros(0, np.float32), (), ())


def _index_in(items: list[Any], item: Any) -> int:
    """Return the index of an item in a list; append it if it is new."""
    if item not in items:
        items.append(item)
    return items.index(item)


def _view(surfaces: SurfaceMap) -> tuple[dict[str, Any], NDArray[np.int64]]:
    planes, shown = encode_surfaces(surfaces)
    height, width = surfaces.shape
    names = [surfaces.objects[index] for index in shown]
    return {"width": width, "height": height, "names": names, **planes}, shown


def _result(
    attribution: Attribution,
    title: str,
    surfaces: SurfaceMap,
    shown: NDArray[np.int64],
    explanation: Explanation | None,
) -> dict[str, Any]:
    ranking = attribution.ranking()
    cautions = caution_groups(attribution, (row.name for row in ranking))
    caution_index = {name: index for index, names in enumerate(cautions.values()) for name in names}
    untrusted = untrusted_groups(attribution)
    untrusted_index = {name: index for index, names in enumerate(untrusted.values()) for name in names}
    of_range = range_notes(attribution)
    in_doubt = row_cautions(attribution)
    row_index = {row.name: row.rank - 1 for row in ranking}
    used = used_by_objects(attribution, surfaces, row_index)
    object_rows = [sorted(row_index[name] for name in names) for names in used]
    colored = {row_index[name] for name in mapped_parameters(attribution)}
    mapped = [[index for index in rows if index in colored] for rows in object_rows]
    saliencies = [math.hypot(*(ranking[index].saliency for index in rows)) for rows in mapped]
    sums = [clear_sum(attribution, [ranking[index] for index in rows]) for rows in mapped]
    has_definition = explanation is not None and explanation.definition is not None
    return {
        "title": title,
        "metric": metric_name(attribution),
        # The headline may state the value by the definition; files have the one that is attributed.
        "valueOf": f"relaxed {metric_name(attribution)}" if has_definition else attributed_name(attribution),
        "unit": metric_unit(attribution),
        "verdict": rating(attribution) if explanation is None else explanation.rating(),
        "premises": [] if explanation is None else _premises(explanation),
        "ranked": "Norm" if attribution.ranks_by_norm() else "Effect",
        "rankedUnit": _effect_unit(attribution),
        # The first section is the headline, which stands on top anyway.
        "explanation": []
        if explanation is None
        else [(heading, findings(lines)) for heading, lines in explanation.sections()[1:]],
        "quantity": attribution.kind.value,
        # The effects are those of the relaxed metric, too.
        "axis": axis_label(attribution, width=None, is_relaxed=has_definition),
        "signs": sign_labels(attribution),
        "value": _number(attribution.metric_value),
        "error": _number(attribution.metric_standard_error),
        "written": _headline(attribution, explanation),
        "isRelaxed": bool(attribution.info.get("relaxed")) and not has_definition,
        "method": method_name(attribution),
        "sampling": findings(sampling_notes(attribution)),
        "convergence": findings([*convergence_notes(attribution), *baseline_notes(attribution)]),
        "groupNotes": group_notes(attribution, attribution),
        "rowNotes": [
            *unit_notes(attribution, ranking),
            *findings(light_notes(attribution, ranking)),
            *pose_notes(attribution, ranking),
        ],
        "cautions": list(cautions),
        "rangeNotes": findings(of_range),
        "jumps": jump_notes(attribution),
        "sceneCautions": scene_cautions(attribution),
        "doubts": list(untrusted),
        "rows": [
            {
                **_row(attribution, row),
                "caution": caution_index.get(row.name),
                "doubt": untrusted_index.get(row.name),
                "inDoubt": in_doubt.get(row.name),
                "rangeNotes": [index for index, names in enumerate(of_range.values()) if row.name in names],
            }
            for row in ranking
        ],
        "objects": [
            {
                "rows": object_rows[i],
                "mapped": len(mapped[i]),
                "magnitude": _number(saliencies[i]),
                # As in ``heatmap``.
                "signed": _number(math.copysign(saliencies[i], sums[i]) if sums[i] else 0.0),
            }
            for i in shown
        ],
        # Including objects that no pixel shows, as in ``heatmap``.
        "largest": _number(max([*(ranking[index].saliency for index in colored), *saliencies], default=0.0)),
        "isNoise": _is_noise(attribution, ranking, {row for i in shown for row in mapped[i]}),
        "texels": _texels(attribution, surfaces),
        "arrows": [arrow._asdict() for arrow in arrows(attribution)],
        "caution": metric_caution(_without_advice(attribution.info)),
        "info": plain(_without_advice(attribution.info)),
    }


def metric_caution(info: Mapping[str, Any]) -> str | None:
    """Return what puts the value of the metric in doubt."""
    of_picture = (info.get("picture") or {}).get("caution")
    return "; ".join(filter(None, [of_picture, *info.get("metric_cautions", ())])) or None


def _without_advice(info: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings without what a metric and a noisy picture advise to do: a page is for others, too."""
    return {
        key: _without_advice(value) if key == "picture" and isinstance(value, Mapping) else value
        for key, value in info.items()
        if key != "advice"
    }


def _effect_unit(attribution: Attribution) -> str:
    """Return the unit of effects, where it is that of the metric: not of a change per unit, or of its square."""
    kind = attribution.kind.in_scale(attribution.scale_or_default())
    return (
        unit_of_change(metric_unit(attribution)) if kind is ResultKind.EFFECT or kind.is_contribution else ""
    )


def _premises(explanation: Explanation) -> list[str]:
    """Return the notes on the value without those on noise, which every result has in another place."""
    noise = findings(noise_notes(explanation.attribution))
    return [note for note in findings(explanation.notes()) if note not in noise]


def _headline(attribution: Attribution, explanation: Explanation | None) -> tuple[str, str]:
    """Return the value of the metric and its error; that by the definition, of an explained relaxed metric."""
    if explanation is not None:
        value, _, error = explanation.value().partition(" ± ")
        return value, error
    return with_error(attribution.metric_value, attribution.metric_standard_error)


def _texels(attribution: Attribution, surfaces: SurfaceMap) -> dict[str, Any] | None:
    """Return the maps with single texels, if there are textures."""
    if not any(name in surfaces.texels for name in attribution):
        return None
    maps = {"magnitude": False, "signed": True}
    return {
        "meaning": TEXEL_MEANING,
        "largest": _number(shared_maximum([attribution], texels=True)),
        **{
            name: encode_map(heatmap(attribution, texels=True, signed=signed, norm="linear"), signed=signed)
            for name, signed in maps.items()
        },
    }


def _is_noise(attribution: Attribution, ranking: Sequence[RankedParameter], rows: Collection[int]) -> bool:
    """Whether none of the rows is clear of its error, at a false alarm rate of 5 % for all of them together."""
    numbers: list[tuple[float, float | None]] = []
    for row in (ranking[index] for index in rows):
        if attribution.ranks_by_norm():
            numbers += kept_channels(attribution, row)
        else:
            numbers.append((row.effect, row.effect_error))
    errors = [error for _, error in numbers if error is not None]
    if len(errors) < len(numbers) or not any(errors):
        return False
    freedom = attribution.info.get("degrees_of_freedom", attribution.info["replicates"] - 1)
    allowed = student_t(1 - _FALSE_ALARMS / len(numbers), freedom)
    return all(abs(value) <= allowed * error for (value, _), error in zip(numbers, errors, strict=True))


def _row(attribution: Attribution, row: RankedParameter) -> dict[str, Any]:
    errors: Sequence[float | None] = row.total_error or [None] * len(row.total)
    kept = attribution.info.get("kept_directions", {}).get(row.name) or [1] * len(row.total)
    few = len(row.total) <= _MAX_CHANNELS
    members = (attribution.info.get("groups") or {}).get(row.name)
    return {
        "name": row.name,
        "label": row.label,
        "effect": _number(row.effect),
        "saliency": _number(row.saliency),
        "error": _number(row.saliency_error),
        "effectError": _number(row.effect_error),
        "written": with_error(row.saliency, row.saliency_error)
        if attribution.ranks_by_norm()
        else _format_signed(row.effect, row.effect_error),
        "sign": _SIGNS[color_of(row, attribution)],
        # A direction in which a pose has no derivative has no number.
        "total": [_number(value) if k else None for value, k in zip(row.total, kept, strict=True)]
        if few
        else [],
        "totalError": [_number(error) if k else None for error, k in zip(errors, kept, strict=True)]
        if few and row.total_error
        else [],
        "totalWritten": [
            _format_signed(value, error) if k else ("–", "")
            for value, error, k in zip(row.total, errors, kept, strict=True)
        ]
        if few
        else [],
        "seenThrough": bool({row.name, *(members or ())} & set(attribution.info.get("seen_through") or ())),
        **({"isCamera": True} if is_of_camera(row.name) else {}),
        **({"isLast": True} if row.name in attribution.ranked_last() else {}),
        "channels": len(row.total),
        **({"isVector": True} if row.name in (attribution.info.get("vectors") or ()) else {}),
        "texture": _is_texture(attribution, row.name),
        **_value(attribution, row.name, members),
        "range": _numbers(attribution.extents, row.name),
    }


def _format_signed(value: float, error: float | None) -> tuple[str, str]:
    style = Format.of(value, error)
    return style.write_signed(value), "" if error is None else style.write_error(error)


def _value(attribution: Attribution, name: str, members: Sequence[str] | None) -> dict[str, Any]:
    """Return a parameter's value if it is known, or a group's members."""
    if members is not None and list(members) != [name]:
        return {"members": list(members)}
    tensor = attribution.parameter_values.get(name)
    if tensor is None:
        return {}
    return _written_value(attribution, name, tensor)


def _written_value(attribution: Attribution, name: str, tensor: torch.Tensor) -> dict[str, Any]:
    textured = _is_texture(attribution, name)
    numbers = [float(number) for number in tensor.flatten().tolist()]
    parts = set(name.replace("_", ".").split("."))
    is_color = len(numbers) == 3 and bool(parts & set(_COLOR_PARAMETERS))
    return {
        "value": [_number(number) for number in numbers],
        "valueWritten": [rounded(number, 3 if textured else 4) for number in numbers],
        **({"swatch": _swatch(numbers)} if is_color else {}),
    }


def _is_texture(attribution: Attribution, name: str) -> bool:
    return name in attribution and attribution[name].ndim > 1  # a group has other names than its parameters


def _numbers(tensors: Mapping[str, torch.Tensor], name: str) -> list[float | None]:
    return [_number(number) for number in tensors[name].flatten().tolist()] if name in tensors else []


def _swatch(linear: Sequence[float]) -> str:
    """Return a linear RGB colour as an sRGB hex code; colours brighter than 1 are scaled to full brightness."""
    largest = max(1.0, *linear)
    scaled = [min(max(x / largest, 0.0), 1.0) if math.isfinite(x) else 0.0 for x in linear]
    encoded = [12.92 * x if x <= 0.0031308 else 1.055 * x ** (1 / 2.4) - 0.055 for x in scaled]
    return "#" + "".join(f"{round(255 * x):02x}" for x in encoded)


def _number(value: float | None) -> float | None:
    """Return a number for JSON, rounded to single precision; None if it is not finite."""
    if value is None or not math.isfinite(value):
        return None
    return float(f"{value:.{_DIGITS}g}")


def plain(info: Any) -> Any:
    """Return settings as JSON values; objects of other types as strings."""
    if isinstance(info, Mapping):
        return {str(key): plain(value) for key, value in info.items()}
    if isinstance(info, (list, tuple)):
        return [plain(item) for item in info]
    if isinstance(info, float):
        return info if math.isfinite(info) else str(info)
    return info if info is None or isinstance(info, (str, int, bool)) else str(info)


def default_titles(attributions: Sequence[Attribution]) -> list[str]:
    """Return titles from the metrics and, if these are equal, from another setting that differs."""
    names = [metric_name(attribution) for attribution in attributions]
    for key in (None, "scene", "sensor", "method", "resolution", "seed"):
        details = [f" · {attribution.info.get(key)}" if key else "" for attribution in attributions]
        titles = [f"{name}{detail}" for name, detail in zip(names, details, strict=True)]
        if len(set(titles)) == len(titles):
            return titles
    values = [f"{metric_symbol(one)} {rounded(one.metric_value)}" for one in attributions]
    if len(set(values)) == len(values):
        return values
    return [f"{name} ({index})" for index, name in enumerate(names, start=1)]


def check(
    attributions: Sequence[Attribution],
    titles: Sequence[str] | None,
    plans: Sequence[Figure | None],
    comparison: Comparison | None,
) -> None:
    """Raise for results that a report cannot show."""
    if not attributions:
        raise SceneCaptumError("A report needs at least one attribution; the list is empty.")
    if titles is not None and len(titles) != len(attributions):
        raise SceneCaptumError(
            f"titles must have one title for each of the {len(attributions)} attributions, not {len(titles)}."
        )
    names = [metric_name(attribution) for attribution in attributions]
    if comparison is not None and (len(names) != 2 or names[0] != names[1]):
        raise SceneCaptumError(
            f"A comparison is of two results of one metric, not of {', '.join(map(repr, names))}: give these "
            "without comparison=."
        )
    if len(plans) != len(attributions):
        raise SceneCaptumError(
            f"plans must have a figure or None for each of the {len(attributions)} attributions, not {len(plans)}."
        )
    for attribution, plan in zip(attributions, plans, strict=True):
        if plan is not None:
            continue
        which = f"The attribution of {metric_name(attribution)}"
        if attribution.surfaces is None:
            why = views_without_map(attribution) or (
                "does not know which object each pixel shows, which a report needs: compute it with a "
                "SceneRenderer, or for a sensor grid give plans=."
            )
            raise SceneCaptumError(f"{which} {why} Its tables and bar charts work without.")
        if attribution.image is None:
            raise SceneCaptumError(f"{which} has no picture, which a report needs.")
        if tuple(attribution.image.shape) != (*attribution.surfaces.shape, 3):
            raise SceneCaptumError(
                f"{which} has a picture of shape {tuple(attribution.image.shape)}, but its map of objects is for "
                f"shape {(*attribution.surfaces.shape, 3)}: a report needs one picture, not a stack of them."
            )
