"""What tables and figures say in words about a result."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from ._numbers import with_error

if TYPE_CHECKING:
    from ..attr import SceneAttribution


def metric_line(attribution: SceneAttribution) -> str:
    """``'MeanLuminance = 2.336942 ± 0.000533'``."""
    error = attribution.metric_standard_error
    value, bar = with_error(attribution.metric_value, error, digits=3)
    return f"{metric_name(attribution)} = {value}{f' ± {bar}' if bar else ''}"


def metric_name(attribution: SceneAttribution) -> str:
    """Return the metric's name."""
    return str(attribution.info.get("metric", "metric"))


def method_name(attribution: SceneAttribution) -> str:
    """Return the attribution method's name."""
    return str(attribution.info.get("method", "unknown method"))


def quantity(attribution: SceneAttribution) -> str:
    """Say what the attributions are: gradients, or shares of a difference where a method explains one."""
    shares = attribution.convergence_delta is not None
    return str(attribution.info.get("quantity", "contribution" if shares else "gradient per unit"))


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
    if attribution.covariance is None:
        words.append(f"no error bars: {counted}" if passes == 1 else "no error bars")
    return words


def caution_groups(attribution: SceneAttribution, names: Iterable[str]) -> dict[str, list[str]]:
    """Group those of the named parameters whose derivative is known to be wrong by what is wrong with it."""
    cautions = attribution.info.get("cautions") or {}
    groups: dict[str, list[str]] = {}
    for name in names:
        if name in cautions:
            groups.setdefault(cautions[name], []).append(name)
    return groups


def count_words(count: int, noun: str) -> str:
    """``'1 parameter'``, ``'3 parameters'``."""
    return f"{count} {noun}{'' if count == 1 else 's'}"
