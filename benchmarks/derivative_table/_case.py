"""Cases of the table, and the steps of their finite differences."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

Scene = dict[str, Any]

CENTRAL, ABOVE, BELOW = 0, 1, -1


@dataclass(frozen=True)
class Row:
    """A parameter, and the step of its finite difference.

    Attributes
    ----------
    parameter
        Its ``mi.traverse`` name; a trailing ``.value`` or ``.data`` may be omitted.
    step
        Step of the difference; None if the image is not a continuous function of the parameter (a pose, a sampling
        rate), so that only the error message is recorded.
    side
        Whether the difference is central, or from above or below the value to second order.
    scaled
        Whether the elements of a texture move in proportion to their values instead of equally: raising a bump map
        as a whole changes nothing.
    """

    parameter: str
    step: float | None
    side: int = CENTRAL
    scaled: bool = False


@dataclass(frozen=True)
class Case:
    """One scene, and its rows of the table.

    Attributes
    ----------
    plugin
        The plugin in whose section the rows are.
    title
        Name of the scene, unique for the plugin.
    build
        Function that returns the Mitsuba dict; called when Mitsuba is active.
    rows
        The parameters.
    """

    plugin: str
    title: str
    build: Callable[[], Scene]
    rows: tuple[Row, ...]

    @property
    def name(self) -> str:
        """Unique among the cases."""
        return f"{self.plugin}/{self.title}"


_ROUGHNESSES = ("alpha", "alpha_u", "alpha_v", "roughness", "longitudinal_roughness", "azimuthal_roughness")
_LINEAR = ("radiance", "intensity", "irradiance", "sky_scale", "sun_scale", "texture", "values")
_DENSITIES = ("sigma_t", "sigma_a", "eumelanin", "pheomelanin", "scale")
_ANGLES = ("cutoff_angle", "beam_width", "scale_tilt", "theta", "delta", "turbidity")


def row(parameter: str, value: float) -> Row:
    """Return the row of a parameter with a step suitable for its value."""
    role = next(part for part in reversed(parameter.split(".")) if part not in ("value", "data"))
    if role in _ROUGHNESSES:
        return Row(parameter, 0.03 * value, BELOW if value >= 1 else CENTRAL)
    if role == "eta" and 1 <= value < 1.02:
        # The reflectance at an index near 1 grows with a power of its distance from 1.
        return Row(parameter, 0.004, ABOVE)
    if role in ("eta", "k"):
        return Row(parameter, 0.02) if value > 0.02 else Row(parameter, 0.01, ABOVE)
    if role in _LINEAR:
        return Row(parameter, 0.25 * value) if value else Row(parameter, 0.5, ABOVE)
    if role in _DENSITIES:
        return Row(parameter, 0.05 * value) if value else Row(parameter, 0.05, ABOVE)
    if role in _ANGLES:
        return Row(parameter, 0.05 * value)
    if role == "g":
        return Row(parameter, 0.05 * (1 - abs(value)))
    # These vary fast for strong lobes, or (specular) like a square root near 0.
    sharp = {"anisotropic": 0.01, "clearcoat_gloss": 0.05 * (1 - value), "specular": min(0.2 * value, 0.05)}
    step = sharp.get(role, 0.05)
    top = 2.0 if role == "diff_trans" else 1.0
    return Row(parameter, step, ABOVE if value < step else BELOW if value > top - step else CENTRAL)


def rows(owner: str, values: Mapping[str, float]) -> tuple[Row, ...]:
    """Return the rows of several parameters of one object, given their values."""
    return tuple(row(f"{owner}.{name}", value) for name, value in values.items())


def message_rows(*parameters: str) -> tuple[Row, ...]:
    """Return the rows of unsupported parameters, for which only the error message is recorded."""
    return tuple(Row(parameter, None) for parameter in parameters)
