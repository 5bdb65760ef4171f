"""Measures whose classes start at a limit."""

from __future__ import annotations

from dataclasses import dataclass

from ..metrics import Measure


@dataclass(frozen=True)
class LowerLimits(Measure):
    """A measure of which at least a limit has to be reached: the limit is part of the class above it."""

    def verdict(self, value: float) -> str:
        """Return the meaning of the class that a value is in."""
        return next((band.meaning for band in self.bands if value < band.upper), self.above)
