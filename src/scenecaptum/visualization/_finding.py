"""What a figure's title says: the finding of a result."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

from ..projection import TEXTURE_NDIM
from ..protocols import Attribution, RankedParameter, Scale
from ..student import clear_from, rankable
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

    "and others" follows if more than these may be the first. It names only effects that are clear enough to rank,
    and none that ranks below another that it could name. It says so if none is clear, or if one within its noise
    may be larger. Where nothing has an effect it names the poses that have no derivative. It names no effect with
    a note (``~``), which may be far off. ``metric`` is by default its name. A picture of single ``texels`` may
    show clear ones whose sum is not.
    """
    metric, ranking = metric or metric_name(attribution, FINDING_WIDTH), attribution.ranking(scale=scale)
    most, none = _findings(attribution, metric)
    allowed = clear_from(attribution.info)
    noted = range_marked(range_notes(attribution, scale))
    if not ranking or (not noted and not any(row.saliency for row in ranking)):
        jumps = [attribution.labels.get(name, name) for name in attribution.info.get("jumps", {})]
        listed = first_few(shorten(jumps, FINDING_WIDTH), ", ")
        return f"{metric}: no derivative with respect to {listed}" if jumps else none
    clear, largest = _clear(attribution, ranking, scale), ranking[0]
    if texels and largest.name not in clear and attribution[largest.name].ndim == TEXTURE_NDIM:
        return f"{metric}: the sum over the texels of {largest.label} is not clear of its noise"
    if largest.saliency and not clear:
        return f"{metric}: no effect is clear enough to rank"
    if clear <= noted:
        return f"{metric}: see the notes on the effects marked ~"
    unmarked = [row for row in ranking if row.name not in noted]
    first = next(row for row in unmarked if row.name in clear)
    noisy = [row for row in unmarked if row.name not in clear and _upper_end(row, allowed) > first.saliency]
    tied = [row for row in unmarked if row.name in clear and not _are_apart(first, row, allowed)]
    # Down to the last that may be the first.
    among = [first] if noisy else unmarked[: unmarked.index(tied[-1]) + 1]
    named = [row for row in among[:2] if row.name in clear]
    has_larger = any(row.name in noted and _upper_end(row, allowed) > named[-1].saliency for row in ranking)
    if noisy:
        uncertain = "effects marked ~ aside, which is" if has_larger else "which effect is"
        return f"{metric}: {uncertain} largest is uncertain; {_too_large(noisy, allowed)}"
    names = shorten([row.label for row in named], FINDING_WIDTH)
    listing = ", ".join(names) + " and others" if len(among) > len(named) else " and ".join(names)
    return f"{most} {listing}{', effects marked ~ aside' if has_larger else ''}"


def _clear(attribution: Attribution, ranking: Sequence[RankedParameter], scale: Scale | None) -> set[str]:
    """Return the parameters whose effects are clear enough to rank, as in an explanation."""
    last = attribution.ranked_last(scale)
    return rankable(
        {row.name: row.saliency for row in ranking if row.name not in last},
        {row.name: row.saliency_error for row in ranking},
        attribution.info,
    )


def _findings(attribution: Attribution, metric: str) -> tuple[str, str]:
    """Return what precedes the names of the largest effects, and what is said where all are 0."""
    kind, terms = attribution.kind, attribution.info.get("terms") or ()
    if kind.has_sign and "minus" in attribution.info and len(terms) == 1:
        # Two results of one metric: not it, but their difference is what the effects are of.
        return "the two results differ most in", "the two results differ in none of these parameters"
    return kind.finding.format(metric), kind.finding_of_none.format(metric)


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
