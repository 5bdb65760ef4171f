"""A luminaire's luminous intensity by direction, and the exact integral of its interpolation."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from ...errors import SceneCaptumError


@dataclass(frozen=True, eq=False)
class Photometry:
    """Luminous intensity by direction, interpolated bilinearly in the two angles.

    The angles are those of type C photometry: γ is 0 along −z, the nadir of the luminaire, and C is 0 along +x and
    90° along +y.

    Example
    -------
    >>> uniform = Photometry(torch.tensor([0.0, 180.0]), torch.tensor([0.0, 360.0]), torch.full((2, 2), 100.0))
    >>> uniform.candela(torch.tensor([[0.0, 0.0, -1.0]]))
    tensor([100.], dtype=torch.float64)
    >>> round(uniform.lumens)  # 4π · 100 cd
    1257

    Attributes
    ----------
    vertical
        The angles γ in degrees, ascending, ``(V,)``. There is no light outside of them.
    horizontal
        The angles C in degrees, ascending over a full turn, ``(H,)``: the last is the first plus 360°.
    table
        Luminous intensities in candela, ``(H, V)``.
    rated_lumens
        The rated luminous flux of all its lamps outside the luminaire; None for absolute photometry.
    size
        Width, length and height of the luminous opening in metres, negative where it is round, as in the file.
    watts
        The electric power.
    """

    vertical: torch.Tensor
    horizontal: torch.Tensor
    table: torch.Tensor
    rated_lumens: float | None = None
    size: tuple[float, float, float] = (0.0, 0.0, 0.0)
    watts: float = 0.0

    @property
    def lumens(self) -> float:
        """The luminous flux of the luminaire: the exact integral of the interpolated intensities."""
        vertical, horizontal = torch.deg2rad(self.vertical.double()), torch.deg2rad(self.horizontal.double())
        by_vertical = torch.trapezoid(self.table.double(), horizontal, dim=0)
        low, high = _linear_weights(vertical)
        return float(by_vertical[:-1] @ low + by_vertical[1:] @ high)

    @property
    def light_output_ratio(self) -> float | None:
        """The luminaire's flux over that of its lamps; more than 1 means that the file contradicts itself."""
        return None if self.rated_lumens is None else self.lumens / self.rated_lumens

    def candela(self, directions: torch.Tensor) -> torch.Tensor:
        """Return the luminous intensities, ``(…,)`` in candela, in directions of any length, ``(…, 3)``.

        Raises
        ------
        SceneCaptumError
            If a direction has not three numbers, is 0, or is not finite.
        """
        if directions.ndim < 1 or directions.shape[-1] != 3:
            raise SceneCaptumError(f"directions must have shape (…, 3), not {tuple(directions.shape)}.")
        x, y, z = directions.double().unbind(-1)
        length = directions.double().norm(dim=-1)
        if not bool(((length > 0) & length.isfinite()).all()):
            raise SceneCaptumError("directions must be finite and not 0.")
        gamma = torch.rad2deg(torch.atan2(torch.hypot(x, y), -z))
        first = self.horizontal[0].double()
        azimuth = first + (torch.rad2deg(torch.atan2(y, x)) - first).remainder(360.0)
        row, column = _place(self.horizontal, azimuth), _place(self.vertical, gamma)
        table = self.table.double()
        below = torch.lerp(table[row.low, column.low], table[row.low + 1, column.low], row.weight)
        above = torch.lerp(table[row.low, column.low + 1], table[row.low + 1, column.low + 1], row.weight)
        outside = (gamma < self.vertical[0]) | (gamma > self.vertical[-1])
        return torch.lerp(below, above, column.weight).masked_fill(outside, 0.0)


@dataclass(frozen=True)
class _Place:
    """Where angles lie in a table: the index of the angle below, and the weight of the one above."""

    low: torch.Tensor
    weight: torch.Tensor


def _place(angles: torch.Tensor, at: torch.Tensor) -> _Place:
    angles = angles.double()
    low = (torch.searchsorted(angles, at, right=True) - 1).clamp(0, len(angles) - 2)
    return _Place(low, ((at - angles[low]) / (angles[low + 1] - angles[low])).clamp(0, 1))


def _linear_weights(gamma: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the integrals of ``sin γ`` times the two hat functions of each interval, ``(V − 1,)`` each.

    ∫ γ sin γ dγ = sin γ − γ cos γ, so what is linear in γ has an exact integral over the sphere.
    """
    slope = gamma.sin().diff() / gamma.diff()
    return gamma[:-1].cos() - slope, slope - gamma[1:].cos()
