"""Adam on the values of a scene, within bounds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeAlias

import torch

from ..attr import range_lengths
from ..errors import SceneCaptumError
from ..estimation import channel_totals
from ..protocols import Capabilities, Renderer
from ..scene import clamp_inside
from ._bounds import BOUND_MARGIN, design_bounds, lamps

Offsets: TypeAlias = "dict[str, torch.Tensor]"

LEARNING_RATE = 0.05  # of Adam: approximate step size as a fraction of a parameter's range or limits


class BoundedAdam:
    """Adam on offsets from ``start`` by channel, in units of the ranges or, where there are some, of the limits.

    They stay within bounds, and within ``change`` or limits. A step that moves an object into another is refused
    for that object.
    """

    def __init__(
        self,
        renderer: Renderer,
        start: Mapping[str, torch.Tensor],
        change: float,
        limits: Mapping[str, tuple[torch.Tensor, torch.Tensor]],
    ) -> None:
        self.start = start
        self._collisions = Capabilities(renderer).collisions
        self._touching = self._pairs({name: torch.zeros_like(value) for name, value in start.items()})
        self._check_start()
        # Limits say how far to go: for a pose, farther than the range over which its effect is measured.
        spans = {name: float((high - low).max()) for name, (low, high) in limits.items()}
        self._ranges = {
            name: spans.get(name) or length.item() for name, length in range_lengths(renderer, start).items()
        }
        bounds = design_bounds(renderer, {n: value for n, value in start.items() if n not in limits})
        self._bounds = {name: bounds[name] for name in start}
        self._lamps = lamps(renderer) - limits.keys()
        self._directions = {
            name: value / self._ranges[name]
            if name in self._lamps and value.any()
            else torch.ones_like(value)
            for name, value in start.items()
        }
        self._offsets = {
            name: value.new_zeros(1 if name in self._lamps else channel_totals(value).shape).requires_grad_()
            for name, value in start.items()
        }
        self._before = self.offsets()
        self._after = self._before
        self._limits = {
            name: [(limit - value) / self._ranges[name] for limit in limits[name]]
            if name in limits
            else [torch.tensor(-change), torch.tensor(change)]
            for name, value in start.items()
        }
        self._adam = torch.optim.Adam(self._offsets.values(), lr=LEARNING_RATE)

    def values(self) -> dict[str, torch.Tensor]:
        """Return the current values as functions of the offsets."""
        current = {}
        for name, value in self.start.items():
            margin = BOUND_MARGIN * self._ranges[name]
            current[name] = clamp_inside(self._unbounded(name), value, *self._bounds[name], margin)
        return current

    def _unbounded(self, name: str) -> torch.Tensor:
        """Return a parameter's value at its offset, which may be outside the physical bounds."""
        value = self.start[name]
        change = self._ranges[name] * self._directions[name] * self._offsets[name]
        return value + change.reshape(value.shape)

    def step(self, image: torch.Tensor, adjoint: torch.Tensor) -> None:
        """Take one descent step, given the gradient of the metric with respect to the image."""
        self._adam.zero_grad()
        image.backward(adjoint)
        self._before = self.offsets()
        self._adam.step()
        with torch.no_grad():
            for name, offset in self._offsets.items():
                low, high = (limit.reshape(-1).expand_as(offset) for limit in self._limits[name])
                offset.copy_(offset.clamp(low, high))
            for name in self.colliding():
                self._offsets[name].copy_(self._before[name])
        self._after = self.offsets()

    def offsets(self) -> Offsets:
        """Return a copy of the current offsets."""
        return {name: offset.detach().clone() for name, offset in self._offsets.items()}

    def go_to(self, offsets: Offsets) -> None:
        """Go to other offsets."""
        with torch.no_grad():
            for name, offset in self._offsets.items():
                offset.copy_(offsets[name])

    def shorten_last_step(self, fraction: float) -> None:
        """Go back to a fraction of the last step."""
        with torch.no_grad():
            for name, offset in self._offsets.items():
                offset.copy_(torch.lerp(self._before[name], self._after[name], fraction))

    def _pairs(self, values: Mapping[str, torch.Tensor]) -> set[tuple[str, str]]:
        """Return the inputs that move objects into others, each with the name of the other."""
        if self._collisions is None:
            return set()
        return set(self._collisions({name: value.detach() for name, value in values.items()}))

    def _check_start(self) -> None:
        for name, other in sorted(self._pairs(self.start) - self._touching):
            raise SceneCaptumError(
                f"{name!r} starts with its object inside the bounds of {other!r}, which it does not touch as "
                "loaded: start from other values."
            )

    def colliding(self) -> set[str]:
        """Return the inputs that have moved an object into another."""
        return {name for name, _ in self._pairs(self.values()) - self._touching}

    def at_limits(self) -> list[str]:
        """Return the parameters that have gone as far as change, limits or bounds let them, with all channels."""
        found, current = [], self.values()
        for name, offset in self._offsets.items():
            low, high = (limit.reshape(-1).expand_as(offset) for limit in self._limits[name])
            clamped = (current[name] != self._unbounded(name)).reshape(-1, offset.numel()).all(0)
            if bool(((offset <= low) | (offset >= high) | clamped).all()):
                found.append(name)
        return found
