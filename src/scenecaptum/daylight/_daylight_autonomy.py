"""Daylight autonomy and continuous daylight autonomy."""

from __future__ import annotations

import torch

from ..metrics import Measure
from ._checks import positive
from ._metric import RELAXATION, Hours, PointMetric, mean_over_hours
from ._sky_matrix import SkyMatrix
from ._step import step


class DaylightAutonomy(PointMetric):
    """Daylight autonomy in %: share of the hours with at least ``threshold`` lx, as the mean over the points.

    Example
    -------
    >>> sky = SkyMatrix.uniform(horizontal_illuminance=10_000.0)
    >>> factors = torch.tensor([0.01, 0.02, 0.04, 0.08])
    >>> coefficients = factors[:, None, None] * sky.patches.projected_solid_angles[:, None].expand(146, 3)
    >>> DaylightAutonomy(sky, during="all").hard(coefficients)
    tensor(50., dtype=torch.float64)

    Parameters
    ----------
    sky, during, relaxation
        See `DaylightMetric`.
    threshold
        In lx.

    References
    ----------
    Reinhart and Walkenhorst, "Validation of dynamic RADIANCE-based daylight simulations for a test office with
    external blinds", 2001.
    """

    def __init__(
        self,
        sky: SkyMatrix,
        threshold: float = 300.0,
        *,
        during: Hours = "occupied",
        relaxation: float = RELAXATION,
    ) -> None:
        super().__init__(sky, during=during, relaxation=relaxation)
        self.threshold = positive("threshold", threshold)

    @property
    def measure(self) -> Measure:
        """Name and unit."""
        return Measure(
            f"daylight autonomy at {self.threshold:g} lx",
            "DA",
            unit="%",
            better="higher",
            definition=f"share of the {self._period_in_full} with at least {self.threshold:g} lx, mean over "
            "the points",
        )

    def _of_points(self, values: torch.Tensor, relaxation: float) -> torch.Tensor:
        return 100 * mean_over_hours(step(values, self.threshold, relaxation))

    def extra_repr(self) -> str:
        """Show the settings."""
        return f"{super().extra_repr()}, threshold={self.threshold:g}"


class ContinuousDaylightAutonomy(PointMetric):
    """Continuous daylight autonomy in %: like daylight autonomy, with a share for hours below the threshold.

    An hour with an illuminance E counts ``min(E / threshold, 1)``. This is continuous, and not relaxed.

    Parameters
    ----------
    sky, during
        See `DaylightMetric`.
    threshold
        In lx.

    References
    ----------
    Rogers, "Daylighting metric development using daylight autonomy calculations in the sensor placement
    optimization tool", 2006.
    """

    def __init__(self, sky: SkyMatrix, threshold: float = 300.0, *, during: Hours = "occupied") -> None:
        super().__init__(sky, during=during, relaxation=0.0)
        self.threshold = positive("threshold", threshold)

    @property
    def measure(self) -> Measure:
        """Name and unit."""
        return Measure(
            f"continuous daylight autonomy at {self.threshold:g} lx",
            "cDA",
            unit="%",
            better="higher",
            definition=f"share of the {self._period_in_full} with at least {self.threshold:g} lx, where "
            "darker hours count in part; mean over the points",
        )

    def _of_points(self, values: torch.Tensor, relaxation: float) -> torch.Tensor:
        return 100 * mean_over_hours((values / self.threshold).clamp(max=1))

    def extra_repr(self) -> str:
        """Show the sky and the threshold."""
        return f"{self.sky!r}, threshold={self.threshold:g}"
