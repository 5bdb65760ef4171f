"""Base class of the metrics of sensor grids."""

from __future__ import annotations

import torch

from ..errors import SceneCaptumError
from ..grid import GridPoints
from ..images import check_image_shape
from ..visualization import pluralize
from ._checks import check_radiance
from ._luminance import luminance


class GridMetric(torch.nn.Module):
    """Base class of the metrics of a sensor grid: a number from the irradiance at its points.

    Parameters
    ----------
    grid
        The points of the renderer, ``renderer.grid``, some of which may lie outside the room; by default every
        pixel counts.
    efficacy
        Luminous efficacy in lm/W that converts irradiance to illuminance: 179 as in Radiance.

    Raises
    ------
    SceneCaptumError
        If no point is inside. From ``forward``, if the picture does not have the shape of the grid, or has values
        that are negative or not finite.
    """

    inside: torch.Tensor | None

    def __init__(self, grid: GridPoints | None, efficacy: float) -> None:
        super().__init__()
        if grid is not None and not grid.inside.any():
            raise SceneCaptumError("No point of the grid is inside the room, so there is nothing to measure.")
        self.efficacy = efficacy
        self.register_buffer("inside", None if grid is None else grid.inside.clone(), persistent=False)

    def irradiance(self, image: torch.Tensor) -> torch.Tensor:
        """Return the irradiance at the points inside, ``(points, 3)`` float64, of a picture ``(H, W, 3)``."""
        check_image_shape(image)
        check_radiance(image)
        if self.inside is None:
            return image.double().flatten(0, 1)
        if self.inside.shape != image.shape[:2]:
            raise SceneCaptumError(
                f"The picture is {tuple(image.shape[:2])} (rows, columns) and the grid "
                f"{tuple(self.inside.shape)}: create the metric with the grid of the renderer, renderer.grid."
            )
        return image[self.inside.to(image.device)].double()

    def illuminance(self, image: torch.Tensor) -> torch.Tensor:
        """Return the illuminance at the points inside, ``(points,)`` float64, of a picture ``(H, W, 3)``."""
        return self.efficacy * luminance(self.irradiance(image)[None])[0]

    def extra_repr(self) -> str:
        """Show the number of points and the efficacy."""
        points = "" if self.inside is None else f"{pluralize(int(self.inside.sum()), 'point')}, "
        return f"{points}efficacy={self.efficacy:g}"
