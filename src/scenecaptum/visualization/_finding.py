"""What a figure's title says: the finding of a result."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

from ..projection import TEXTURE_NDIM
from ..protocols import Attribution, RankedParameter, Scale
from ..student import clear_from
from ._effect_notes import range_marked, range_notes
from ._layout import first_few
from ._numbers import shorten
from ._text import FINDING_WIDTH, metric_name


def finding(
    attribution: Attribution,
    scale: Scale | None = None,
    *,
    metric: str | None = None,
    texels: bool = False,
) -> str:
    """Return ``'UGR depends most on sky: radiance'``, or the first two if the errors do not tell them apart.

    Of squares and variances it says what is largest, and of a difference of one metric what its sides differ in.

    "and others" follows if more are as large as the last that may be the first. It names only effects that are
    clear of their noise, and says so if the largest is not, or if one within its noise may be larger. Where
    nothing has an effect it names the poses that have no derivative. It names no effect with a note (``~``), which
    may be far off. ``metric`` is by default its name. A picture of single ``texels`` may show clear ones whose
    sum is not.
    """
    metric, ranking = metric or metric_name(attribution, FINDING_WIDTH), attribution.ranking(scale=scale)
    most, none = _findings(attribution, metric)
    allowed = clear_from(attribution.info)
    noted = range_marked(range_notes(attribution, scale))
    if not ranking or (not noted and not any(row.saliency for row in ranking)):
        jumps = [attribution.labels.get(name, name) for name in attribution.info.get("jumps", {})]
        named = first_few(shorten(jumps, FINDING_WIDTH), ", ")
        return f"{metric}: no derivative with respect to {named}" if jumps else none
    if ranking[0].saliency and not _is_clear(ranking[0], allowed):
        is_sum = texels and attribution[ranking[0].name].ndim == TEXTURE_NDIM
        largest = f"sum over the texels of {ranking[0].label}" if is_sum else "largest effect"
        return f"{metric}: the {largest} is within the noise"
    unmarked = [row for row in ranking if row.name not in noted]
    if not unmarked or not _is_clear(unmarked[0], allowed):
        return f"{metric}: see the notes on the effects marked ~"
    clear = [row for row in unmarked if _is_clear(row, allowed)]
    first = clear[0]
    noisy = [
        row for row in unmarked if not _is_clear(row, allowed) and _upper_end(row, allowed) > first.saliency
    ]
    if noisy:
        largest = "which effect is largest is uncertain"
        if first is not ranking[0]:
            largest = "effects marked ~ aside, which is largest is uncertain"
        return f"{metric}: {largest}; {_too_large(noisy, allowed)}"
    # One with a small error may be apart from the first, and larger than another that may be the first.
    leading = 1 + max(rank for rank, row in enumerate(clear) if not _are_apart(first, row, allowed))
    names = shorten([row.label for row in clear[: min(leading, 2)]], FINDING_WIDTH)
    listed = ", ".join(names) + " and others" if leading > 2 else " and ".join(names)
    larger = [row for row in ranking if row.name in noted and _upper_end(row, allowed) > first.saliency]
    aside = ", effects marked ~ aside" if larger else ""
    return f"{most} {listed}{aside}"


def _findings(attribution: Attribution, metric: str) -> tuple[str, str]:
    """Return what precedes the names of the largest effects, and what is said where all are 0."""
    kind, terms = attribution.kind, attribution.info.get("terms") or ()
    if kind.has_sign and "minus" in attribution.info and len(terms) == 1:
        # Two results of one metric: not it, but their difference is what the effects are of.
        return "the two results differ most in", "the two results differ in none of these parameters"
    return kind.finding.format(metric), kind.finding_of_none.format(metric)


def _is_clear(row: RankedParameter, allowed: float) -> bool:
    """Whether a saliency is not 0 and more than the ``allowed`` standard errors from it."""
    return not row.saliency <= allowed * (row.saliency_error or 0.0)


def _upper_end(row: RankedParameter, allowed: float) -> float:
    """Return the saliency plus the ``allowed`` standard errors."""
    return row.saliency + allowed * (row.saliency_error or 0.0)


def _too_large(noisy: Sequence[RankedParameter], allowed: float) -> str:
    """Return ``'the error of sky: radiance is too large'``; of several, that of the largest upper end is first."""
    ordered = sorted(noisy, key=partial(_upper_end, allowed=allowed), reverse=True)
    named = shorten([row.label for row in ordered[: 1 if len(noisy) > 2 else 2]], FINDING_WIDTH)
    if len(noisy) == 1:
        return f"the error of {named[0]} is too large"
    others = [f"{len(noisy) - 1} others"] if len(noisy) > 2 else []
    return f"the errors of {' and '.join(named + others)} are too large"


def _are_apart(larger: RankedParameter, smaller: RankedParameter, allowed: float) -> bool:
    """Whether two saliencies differ by more than the ``allowed`` standard errors."""
    errors = (larger.saliency_error or 0.0, smaller.saliency_error or 0.0)
    return larger.saliency - smaller.saliency > allowed * math.hypot(*errors)
