"""Uniformity of the illuminance on a sensor grid."""

from __future__ import annotations

import math
from numbers import Real

import torch

from ..errors import SceneCaptumError
from ..grid import GridPoints
from ..visualization import pluralize
from ._checks import cast_like
from ._grid_metric import GridMetric
from ._measure import Measure

# Relative to the mean: keeps the logarithm and its derivative finite at a point without light.
DARKEST = 1e-9


class Uniformity(GridMetric):
    """Uniformity of the illuminance on a sensor grid, the smallest over the mean, from 0 to 1.

    Example
    -------
    >>> image = torch.ones(4, 8, 3)
    >>> image[0, 0] = 0.5
    >>> uniformity = Uniformity()
    >>> uniformity(image), uniformity.hard(image)
    (tensor(0.5444), tensor(0.5079))

    A minimum depends on one point alone, which changes from render to render. It is relaxed: ``U = M / mean(E)``
    with the power mean ``M = mean(E^(−1/relaxation))^(−relaxation)``. This is a soft minimum of ``ln E``, for n
    points ``min(E) ≤ M ≤ min(E) · n^relaxation``, so that it is the minimum for small widths. ``hard`` is the
    value by the definition, to compare with a limit.

    Parameters
    ----------
    grid
        The points of the renderer, ``renderer.grid``: those that are not inside the room do not count. By default
        every pixel counts.
    relaxation
        Width of the soft minimum in units of ``ln E``; 0 is the minimum itself. The default raises the uniformity
        by at most 10 % with 100 points.

    Raises
    ------
    SceneCaptumError
        If no point is inside, or ``relaxation`` is negative. From ``forward``, if the picture does not have the
        shape of the grid, has values that are negative or not finite, or has no light.

    References
    ----------
    EN 12464-1:2021: ``Uo``, minimum illuminance over mean illuminance.
    """

    measure = Measure("uniformity of illuminance", better="higher")
    relaxation: float

    def __init__(self, grid: GridPoints | None = None, *, relaxation: float = 0.02) -> None:
        super().__init__(grid, efficacy=1.0)
        if not isinstance(relaxation, Real) or not 0 <= relaxation < math.inf:
            raise SceneCaptumError(f"relaxation must be at least 0, not {relaxation!r}.")
        self.relaxation: float = float(relaxation)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Return the relaxed uniformity of a picture ``(H, W, 3)``, a 0-d tensor."""
        relative = self._relative(image)
        return cast_like(_power_mean(relative, self.relaxation), image)

    def hard(self, image: torch.Tensor) -> torch.Tensor:
        """Return the smallest over the mean, by the definition and without a derivative."""
        with torch.no_grad():
            return cast_like(self._relative(image).min(), image)

    def verdict(self, image: torch.Tensor, target: object = None) -> str:
        """Return the value without relaxation of a picture ``image`` in words; there is no ``target``."""
        return f"{self.hard(image).item():.3g} without relaxation"

    def _relative(self, image: torch.Tensor) -> torch.Tensor:
        values = self.illuminance(image)
        mean = values.mean()
        if not mean > 0:
            raise SceneCaptumError("No point of the grid has any light, so its uniformity is undefined.")
        return values / mean

    def extra_repr(self) -> str:
        """Show the number of points and the relaxation."""
        points = "" if self.inside is None else f"{pluralize(int(self.inside.sum()), 'point')}, "
        return f"{points}relaxation={self.relaxation:g}"


def _power_mean(values: torch.Tensor, relaxation: float) -> torch.Tensor:
    """Return ``mean(values^(−1/relaxation))^(−relaxation)``."""
    if relaxation == 0:
        return values.min()
    exponents = -(values + DARKEST).log() / relaxation
    log_mean = exponents.logsumexp(0) - math.log(len(values))
    return (-relaxation * log_mean).exp() - DARKEST
