"""Settings, their table and the recommendation in words."""

from __future__ import annotations

import math
from collections.abc import Sequence

from ..rendering import STOCK_INTEGRATORS
from ..visualization import grid
from ._rows import Measured, Reference
from ._settings import Setting

_HEADER = ("", "seconds", "error", "bias", "Spearman", "Kendall", "top 5")


def table_lines(rows: Sequence[Measured], front: Sequence[Measured]) -> list[str]:
    """Return a header and one line per setting; those on the front have an asterisk."""
    cells = [
        (
            _name(row, rows[0].setting),
            f"{row.seconds:.3g}",
            _percent(*row.relative_error),
            _bias(row),
            _correlation(row.spearman.value),
            _correlation(row.kendall.value),
            f"{100 * row.top.value:.0f} %",
        )
        for row in rows
    ]
    marks = ["", *("  *" if row in front else "" for row in rows)]
    return list(map(str.__add__, grid(_HEADER, cells, right=True), marks))


def reference_text(reference: Reference) -> str:
    """Describe the reference and its accuracy."""
    return (
        f"reference: {setting_text(reference.setting)}, relative error {_percent_of(reference.relative_error)}; "
        f"rankings of its halves have Kendall's τ {_correlation(reference.kendall_of_halves)}"
    )


def recommendation_text(rows: Sequence[Measured], best: Measured | None, tolerance: float) -> str:
    """Recommend ``best``, the fastest setting within the tolerance, or say why there is none."""
    if best is not None:
        return (
            f"For an error of {_percent_of(tolerance)}: {setting_text(best.setting)} ({best.seconds:.2g} s), "
            f"error {_percent(*best.relative_error)}, {100 * best.top.value:.0f} % of the top five correct."
        )
    closest = min(rows, key=lambda row: row.relative_error.value)
    error, bias = closest.relative_error.value, closest.bias.value if closest.bias.significant else 0.0
    start = f"No setting is within {_percent_of(tolerance)}: the best, {setting_text(closest.setting)},"
    if bias >= tolerance:
        return f"{start} has a bias of {_percent_of(bias)}, which more samples do not reduce."
    # The error without bias is proportional to 1/√spp.
    factor = ((error + closest.relative_error.error) ** 2 - bias**2) / (tolerance**2 - bias**2)
    spp = math.ceil(factor * max(closest.setting.primal_spp, closest.setting.gradient_spp))
    start += f" has an error of {_percent(*closest.relative_error)}"
    return f"{start}; about {_round_up(spp)} spp should suffice."


def setting_text(setting: Setting) -> str:
    """``'64 spp, depth 6, 320×180'``."""
    primal, gradient = setting.primal_spp, setting.gradient_spp
    words = [f"{primal} spp" if primal == gradient else f"{primal} spp primal and {gradient} gradient"]
    if setting.max_depth is not None:
        words.append("unlimited depth" if setting.max_depth == -1 else f"depth {setting.max_depth}")
    if setting.resolution is not None:
        words.append("×".join(map(str, setting.resolution)))
    if setting.replicates == 1:
        words.append("1 replicate")
    if setting.integrator in STOCK_INTEGRATORS:
        words.append(str(setting.integrator))
    return ", ".join(words)


def _name(row: Measured, own: Setting) -> str:
    if not row.varied:
        return setting_text(own)
    return f"  {row.varied.replace('_', ' ')} {value_text(row)}"


def value_text(row: Measured) -> str:
    """Return the value of the option that a row varies."""
    setting = row.setting
    if row.varied == "max_depth":
        return "unlimited" if setting.max_depth == -1 else str(setting.max_depth)
    if row.varied == "resolution":
        return "×".join(map(str, setting.resolution or ()))
    if row.varied == "spp":
        return str(setting.primal_spp)
    return str(getattr(setting, row.varied))


def _bias(row: Measured) -> str:
    if not row.bias.significant:
        return f"≤ {_percent_of(row.bias.upper_limit)}"
    return _percent(row.bias.value, row.bias.error)


def _percent(value: float, error: float) -> str:
    """``'4.1 ± 0.3 %'``, with one digit of the error."""
    value, error = 100 * value, 100 * error
    if error == 0 or not math.isfinite(error):
        return f"{value:.3g} %"
    places = min(max(-math.floor(math.log10(error)), 0), 4)
    return f"{value:.{places}f} ± {error:.{places}f} %"


def _percent_of(value: float) -> str:
    return f"{100 * value:.2g} %" if value < 0.995 else f"{100 * value:.0f} %"


def _correlation(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.3f}"


def _round_up(number: int) -> str:
    """Round up to two significant digits."""
    unit: int = 10 ** max(len(str(number)) - 2, 0)
    return str(-(-number // unit) * unit)
