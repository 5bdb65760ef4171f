"""What tables and figures say in words about a result."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from ._numbers import shorten, with_error

if TYPE_CHECKING:
    from ..attr import SceneAttribution


_MOST_CAUTIONS = 5
_ROUNDING = 1e-6  # of what is explained
METRIC_WIDTH = 36  # letters of a metric's name in a figure


def metric_line(attribution: SceneAttribution, width: int | None = None) -> str:
    """``'MeanLuminance = 2.336942 ± 0.000533'``, the name in at most so many letters."""
    error = attribution.metric_standard_error
    value, bar = with_error(attribution.metric_value, error, digits=3)
    return f"{metric_name(attribution, width)} = {value}{f' ± {bar}' if bar else ''}"


def metric_name(attribution: SceneAttribution, width: int | None = None) -> str:
    """Return the metric's name, in at most so many letters."""
    name = str(attribution.info.get("metric", "metric"))
    return name if width is None else shorten([name], width)[0]


def method_name(attribution: SceneAttribution) -> str:
    """Return the attribution method's name."""
    return str(attribution.info.get("method", "unknown method"))


def quantity(attribution: SceneAttribution) -> str:
    """Say what the attributions are: gradients, or shares of a difference where a method explains one."""
    shares = attribution.convergence_delta is not None
    return str(attribution.info.get("quantity", "contribution" if shares else "gradient per unit"))


def axis_words(attribution: SceneAttribution) -> str:
    """Say on an axis what a saliency is the size of."""
    measure = _MEASURES.get(quantity(attribution), f"{quantity(attribution)}, {{}}")
    return f"saliency: {measure.format(metric_name(attribution, METRIC_WIDTH))}"


def sign_words(attribution: SceneAttribution) -> tuple[str, str] | None:
    """Say what a positive and a negative attribution mean; None where attributions have no sign.

    A gradient says what raising the parameter would do; a contribution, what its being there does.
    """
    what, subject = quantity(attribution), "difference" if "minus" in attribution.info else "metric"
    if what.startswith(("mean squared gradient", "variance")):
        return None
    if "per unit" in what or what == "gradient × range":
        return f"raising it raises the {subject}", f"raising it lowers the {subject}"
    return f"adds to the {subject}", f"takes from the {subject}"


_MEASURES = {
    "gradient per unit": "change of {} per unit of the parameter",
    "gradient × range": "change of {} over the parameter's range, at its gradient",
    "mean gradient per unit": "mean change of {} per unit of the parameter",
    "mean squared gradient per unit": "mean squared change of {} per unit of the parameter",
    "variance of the gradient per unit": "variance of the change of {} per unit of the parameter",
    "gradient × value": "gradient of {} × value of the parameter",
    "input × gradient": "value of the parameter × gradient of {}",
    "contribution": "contribution to {}",
    "effect of ablation": "change of {} by ablation",
    "effect of occlusion": "change of {} by occlusion",
    "Shapley value": "Shapley value for {}",
}


def sampling_words(attribution: SceneAttribution) -> list[str]:
    """Say how many samples there were, why error bars are missing, and whether it was interrupted."""
    spp, passes = attribution.info.get("spp"), attribution.info.get("passes")
    counted = None if passes is None else f"{passes} pass{'' if passes == 1 else 'es'}"
    interrupted = attribution.info.get("interrupted", False)
    words = [] if spp is None else [f"{spp} spp"]
    if interrupted:
        words.append(f"interrupted after {counted}" if counted else "interrupted")
    elif counted:
        words = [f"{' '.join([*words, 'in'])} {counted}" if words else counted]
    words += goal_words(attribution) + against_words(attribution) + picture_words(attribution)
    if attribution.covariance is None:
        words.append(f"no error bars: {counted}" if passes == 1 else "no error bars")
    return words


def picture_words(attribution: SceneAttribution) -> list[str]:
    """Say whether the metric saw a denoised picture, and whether the picture is too noisy for it."""
    picture = attribution.info.get("picture") or {}
    samples = "" if picture.get("spp") is None else f" of {picture['spp']} spp"
    return [*([f"denoised picture{samples}"] if picture.get("denoised") else []), *noise_words(attribution)]


def noise_words(attribution: SceneAttribution) -> list[str]:
    """Say that the picture is too noisy for the metric, where it is."""
    caution = (attribution.info.get("picture") or {}).get("caution")
    return [f"caution: {caution}"] if caution else []


def convergence_words(attribution: SceneAttribution) -> list[str]:
    """Say whether contributions add up to the difference that they explain; nothing where they explain none."""
    delta, error = attribution.convergence_delta, attribution.convergence_delta_error
    if delta is None:
        return []
    verdict, explained = attribution.info.get("convergence"), attribution.info.get("explained")
    if verdict is None or explained is None:
        unknown = f"{verdict}: the metric is not finite at the baseline" if not math.isfinite(delta) else ""
        return [unknown or f"convergence delta {delta:.2g}"]
    if abs(delta) <= _ROUNDING * abs(explained):
        delta = 0.0
    value, bar = with_error(delta, error)
    words = f"{verdict}: delta {value}{f' ± {bar}' if bar else ''} of {with_error(explained, error)[0]}"
    quadrature = attribution.info.get("quadrature_error")
    if error and quadrature and quadrature > error / 2:
        words += ", mostly by quadrature: more steps help"
    return [words]


def against_words(attribution: SceneAttribution) -> list[str]:
    """Say what another renderer would have changed, where that was measured."""
    found = (attribution.info.get("planner") or {}).get("against")
    if not found or found["relative_change"] is None:
        return []
    names = [f"depth {found['max_depth']}"] if "max_depth" in found else []
    names += ["×".join(map(str, found["resolution"]))] if "resolution" in found else []
    change, width = 100 * found["relative_change"], 100 * found["relative_half_width"]
    return [f"{' at '.join(names) or 'the other renderer'} changes ≤ {change:.2g} ± {width:.2g} %"]


def goal_words(attribution: SceneAttribution) -> list[str]:
    """Say how near a result came to what it was asked to reach; nothing where its samples were fixed."""
    planner = attribution.info.get("planner")
    if planner is None:
        return []
    top, tolerance, width = planner["top"], planner["tolerance"], planner["relative_half_width"]
    unless = "" if planner["reached"] else f", stopped by {planner['stopped']}"
    if top is not None:
        tied = sum(len(tier) > 1 for tier in planner["order"] or [])
        ties = f" but for {count_words(tied, 'tie')}" if tied else ""
        return [f"order of the first {top} {f'clear{ties}' if planner['reached'] else f'not clear{unless}'}"]
    known = "unknown" if width is None else f"{100 * width:.2g} %"
    if tolerance is None:
        return [f"95 % half-widths ≤ {known} in {planner['time_limit']:g} s"]
    return [f"95 % half-widths ≤ {known} (asked: {100 * tolerance:g} %{unless})"]


def caution_groups(attribution: SceneAttribution, names: Iterable[str]) -> dict[str, list[str]]:
    """Group those of the named parameters whose derivative is known to be wrong by what is wrong with it."""
    cautions = attribution.info.get("cautions") or {}
    groups: dict[str, list[str]] = {}
    for name in names:
        if name in cautions:
            groups.setdefault(cautions[name], []).append(name)
    return groups


def scene_cautions(attribution: SceneAttribution) -> list[str]:
    """Name the parameters that are left out because of the scene's own value, and say what is wrong with it."""
    left_out = attribution.info.get("left_out") or {}
    said = [f"{name} is left out: {fault}" for name, fault in left_out.items()]
    more = len(said) - _MOST_CAUTIONS
    return (
        said if more <= 0 else [*said[:_MOST_CAUTIONS], f"{more} more are left out; renderer.plan lists all"]
    )


def doubt_groups(attribution: SceneAttribution) -> dict[str, list[str]]:
    """Group the parameters whose error bars cannot be trusted by the reason."""
    groups: dict[str, list[str]] = {}
    for name, reason in attribution.untrusted_errors().items():
        groups.setdefault(reason, []).append(name)
    return groups


def count_words(count: int, noun: str) -> str:
    """``'1 parameter'``, ``'3 parameters'``."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def pack(parts: Sequence[str], width: int) -> list[str]:
    """Join parts with dots, beginning a new line where the next would not fit."""
    lines = [parts[0]]
    for part in parts[1:]:
        joined = f"{lines[-1]} · {part}"
        if len(joined) <= width:
            lines[-1] = joined
        else:
            lines.append(part)
    return lines
