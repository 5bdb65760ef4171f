"""What was measured of a setting and of the reference."""

from __future__ import annotations

from dataclasses import dataclass

from ._settings import Setting
from ._statistics import Bias, Estimate


@dataclass(frozen=True)
class Measured:
    """Cost and accuracy of one setting.

    Attributes
    ----------
    varied
        The option that differs from the renderer's own setting; empty for the own setting.
    setting
        The complete setting.
    seconds
        Median time of one attribution.
    relative_error
        Root mean square over the runs of ``‖g − g_ref‖ / ‖g_ref‖``.
    bias
        ``‖mean(g) − g_ref‖ / ‖g_ref‖``, corrected for the noise of both.
    spearman, kendall
        Mean rank correlation with the reference over all parameters; Kendall's is τ-b.
    kendall_resolved
        Kendall's τ over the pairs that differ by more than two standard errors in the reference; NaN if none does.
    top
        Fraction of the reference's top five parameters that are among the top five.
    """

    varied: str
    setting: Setting
    seconds: float
    relative_error: Estimate
    bias: Bias
    spearman: Estimate
    kendall: Estimate
    kendall_resolved: Estimate
    top: Estimate


@dataclass(frozen=True)
class Reference:
    """Cost and accuracy of the reference.

    Attributes
    ----------
    setting
        Its setting.
    seconds
        Its time.
    relative_error
        Its standard error, relative to ``‖g_ref‖``.
    kendall_of_halves
        Kendall's τ-b between the rankings of the two halves of its replicates: higher correlations are not
        meaningful.
    """

    setting: Setting
    seconds: float
    relative_error: float
    kendall_of_halves: float
