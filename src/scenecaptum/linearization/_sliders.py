"""Sliders: the numbers by which a parameter is moved, and the values that they stand for."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import torch

from ..errors import SceneCaptumError
from ..scene import MOVING_KINDS, OPEN_MARGIN, Parameter

Form: TypeAlias = Literal["color", "channels", "vector", "scalar", "dimmer", "offset"]
Place: TypeAlias = "tuple[float, ...]"
Design: TypeAlias = dict[str, Place]

# Properties of emitters in which a picture is linear.
BRIGHTNESS = ("radiance", "irradiance", "intensity", "scale", "sun_scale", "sky_scale", "data", "flux")
STEP = 0.02  # of a difference, as a fraction of the way that a slider goes
FAR = 10.0  # how far poses go, in units of the range over which their effects are compared
CHANNELS = 3


@dataclass(frozen=True)
class Slider:
    """A parameter as it is moved: a few numbers between two ends.

    Attributes
    ----------
    name, label, kind
        As in ``Parameter``.
    form
        ``"color"`` and ``"channels"``: a number for each channel of the picture. ``"vector"``: one for each
        direction. ``"scalar"``: one number. ``"dimmer"``: a factor of the scene's own value. ``"offset"``: a
        number that is added to every texel.
    low, high
        Where it ends.
    start
        Where it stands in the scene.
    value
        The scene's own value.
    bounds
        The physical bounds of values.
    """

    name: str
    label: str
    kind: str
    form: Form
    low: float
    high: float
    start: Place
    value: torch.Tensor
    bounds: tuple[float, float]

    @property
    def by_channel(self) -> bool:
        """Whether each number changes one channel of the picture, so that one image has all derivatives."""
        return self.form in ("color", "channels")

    @property
    def is_shown(self) -> bool:
        """Whether the predicted picture shows what it does: not of a move, which would be ghosts and noise."""
        return self.kind not in MOVING_KINDS

    def tensor(self, place: Place) -> torch.Tensor:
        """Return the value of the parameter where the slider stands at a place."""
        if self.form == "dimmer":
            return self.value * place[0]
        if self.form == "offset":
            return (self.value + place[0]).clamp(*self.bounds)
        return self.value.new_tensor(place).reshape(self.value.shape)

    def checked(self, numbers: Any) -> Place:
        """Return numbers from outside as a place.

        Raises
        ------
        SceneCaptumError
            If they are no numbers, or are not between the ends.
        """
        try:
            # Booleans and strings are no numbers, and integers may be too large.
            place = tuple(float(n) for n in numbers if type(n) in (int, float))
        except (TypeError, OverflowError):
            place = ()
        if len(place) != len(self.start) or len(numbers) != len(place):
            raise SceneCaptumError(
                f"{self.name!r} needs {len(self.start)} finite numbers, not {_short(numbers)}."
            )
        slack = 1e-6 * (self.high - self.low)
        if not all(self.low - slack <= n <= self.high + slack for n in place):
            raise SceneCaptumError(
                f"{self.name!r} goes from {self.low:g} to {self.high:g}; {_short(numbers)} is outside."
            )
        return tuple(min(max(n, self.low), self.high) for n in place)

    def steps(self, place: Place) -> list[Place]:
        """Return the steps of the differences at a place, each of which changes one number or all channels.

        A dimmer goes to off, since the picture is linear in it; others go a little towards the farther end.
        """
        if self.form == "dimmer":
            return [(-place[0],) if place[0] > 0 else (1.0,)]
        length = STEP * (self.high - self.low)
        step = [length if self.high - n >= n - self.low else -length for n in place]
        if self.by_channel:
            return [tuple(step)]
        return [tuple(n if k == j else 0.0 for k, n in enumerate(step)) for j in range(len(step))]

    def weights(self, way: torch.Tensor) -> torch.Tensor:
        """Return the weight of each channel of each derivative image on a way, ``(images, 3)``."""
        if not self.is_shown:
            return way.new_zeros(0, CHANNELS)
        return way[None] if self.by_channel else way[:, None].expand(-1, CHANNELS)

    def rows(self, totals: torch.Tensor) -> torch.Tensor | None:
        """Return channel totals of gradients, ``(replicates, C)``, per unit of the slider, or None."""
        if self.form == "dimmer":
            return None  # its derivatives have all replicates of the start, and the noise of these
        return totals.sum(1, keepdim=True) if self.form == "offset" else totals


def make_slider(parameter: Parameter, own: torch.Tensor, value: torch.Tensor | None = None) -> Slider:
    """Return the slider of a parameter with a ``value``, by default the scene's ``own``."""
    value = own if value is None else value
    form, bounds = _form(parameter, value), (_lowest(parameter), parameter.bounds.high)
    low, high = _ends(parameter, value, own)
    start = tuple(value.reshape(-1).tolist())
    if form == "dimmer":
        low, high, start = 0.0, 2.0, (1.0,)
    elif form == "offset":
        mean = value.mean().item()
        low, high, start = low - mean, high - mean, (0.0,)
    return Slider(parameter.name, parameter.label, parameter.kind, form, low, high, start, value, bounds)


def _lowest(parameter: Parameter) -> float:
    """Return the lowest value, at a small distance from an open bound."""
    return parameter.bounds.low + (OPEN_MARGIN if parameter.bounds.open_low else 0.0)


def _form(parameter: Parameter, value: torch.Tensor) -> Form:
    if parameter.moves:
        return "vector" if value.ndim else "scalar"
    if parameter.kind == "emitters" and parameter.role in BRIGHTNESS and bool(value.any()):
        return "dimmer"
    if value.ndim == 1 and len(value) == CHANNELS:
        return "color" if (parameter.bounds.low, parameter.bounds.high) == (0.0, 1.0) else "channels"
    return "offset" if value.ndim else "scalar"


def _ends(parameter: Parameter, value: torch.Tensor, own: torch.Tensor) -> tuple[float, float]:
    """Return the ends of a slider: the bounds, the range of effects if those are infinite, or twice the value.

    What was switched off goes to twice its own value, so that it can be switched on again.
    """
    bounds, over = parameter.bounds, parameter.range
    low = _lowest(parameter)
    if parameter.moves:
        middle = value.mean().item()  # 0 but for a field of view
        return max(middle + FAR * over.low, low), min(middle + FAR * over.high, bounds.high)
    if math.isfinite(low) and math.isfinite(bounds.high):
        return low, bounds.high
    reached = value if value.any() else own
    least, most = (float(extreme) for extreme in (reached.min(), reached.max()))
    if math.isfinite(over.low) and math.isfinite(over.high):
        return min(over.low, least), max(over.high, most)
    return low if math.isfinite(low) else min(0.0, 2 * least), 2 * most if most > 0 else 1.0


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:60]}…"
