"""Antithetic samples of a microfacet lobe, for the derivative with respect to its roughness.

Let ``u`` be the part of the lobe of a GGX distribution that is closer to its centre than a normal:
``u = t / (1 + t)`` with ``t = tan²θ / α²``. Then ``∂ log D / ∂α = (2 / α) (2 u - 1)``: the derivative is negative
in the inner half of the lobe and positive in the outer half. Samples at ``u`` and ``1 - u`` have opposite
derivatives, so the light that they have in common cancels. Sampling in proportion to ``|2 u - 1|`` instead could
lower the second moment by a quarter at most.

Plugins map a point of the unit square to a visible normal by concentric discs: for GGX at normal incidence ``u``
is the area of the concentric square through the point. Elsewhere the pairs cancel less, and nothing else changes.

References
----------
Belhe and others, "Importance Sampling BRDF Derivatives", ACM Transactions on Graphics 43(3), 2024.
Zhang, Dong, Doggett and Zhao, "Antithetic Sampling for Monte Carlo Differentiable Rendering", ibid. 40(4), 2021.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi


def antithetic_point(random: Any, stratum: Any, strata: int, outer: Any) -> Any:
    """Return a point in the inner half of the unit square, or its partner in the outer half.

    ``random`` is a uniform point. The direction from the centre is stratified.
    """
    inner = 0.5 * random.x
    return _outline_point(dr.select(outer, 1 - inner, inner), (stratum + random.y) / strata)


def _outline_point(area: Any, position: Any) -> Any:
    """Return a point on the outline of a concentric square, from the square's area and the position along it."""
    side = mi.UInt32(4 * position)
    along = 2 * (4 * position - mi.Float(side)) - 1
    sign = dr.select(side < 2, 1, -1)
    even = (side & 1) == 0
    corner = mi.Point2f(dr.select(even, along, 1), dr.select(even, -1, along))
    return 0.5 + 0.5 * dr.sqrt(area) * sign * corner
