"""What a metric measures: name, unit, direction, and the classes of its values."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, NamedTuple


class Band(NamedTuple):
    """A class of values, up to and including ``upper``, and its ``meaning``."""

    upper: float
    meaning: str


@dataclass(frozen=True)
class Measure:
    """What a metric measures.

    Attributes
    ----------
    name, symbol
        In words, as in ``"unified glare rating"``, and the usual abbreviation or None.
    unit
        Such as ``"cd/m²"``; empty for a dimensionless number.
    better
        ``"lower"`` or ``"higher"`` if one is better.
    bands
        The classes of the values, in ascending order.
    above
        The meaning of values above the last band.
    source
        Where the bands come from.
    definition
        What the symbol stands for, such as ``"share of the points with at least 300 lx …"``; empty where the name
        says it.
    """

    name: str
    symbol: str | None = None
    unit: str = ""
    better: Literal["lower", "higher"] | None = None
    bands: tuple[Band, ...] = ()
    above: str = ""
    source: str = ""
    definition: str = ""

    @property
    def half_class(self) -> float | None:
        """Half the width of the narrowest class; with a larger error the class is uncertain."""
        widths = [upper.upper - lower.upper for lower, upper in pairwise(self.bands)]
        return min(widths) / 2 if widths else None

    def verdict(self, value: float) -> str:
        """Return the meaning of the class that a value is in; empty without classes."""
        return next((band.meaning for band in self.bands if value <= band.upper), self.above)

    def describe(self) -> dict[str, object]:
        """Return all but the meanings of the classes, of which the limits, as plain values."""
        return {
            "name": self.name,
            "symbol": self.symbol,
            "unit": self.unit,
            "better": self.better,
            "limits": [band.upper for band in self.bands],
            "source": self.source,
            "definition": self.definition,
        }


def luminance_unit(efficacy: float) -> str:
    """Return the unit of radiance times a luminous efficacy."""
    return "W/(m² sr)" if efficacy == 1 else "cd/m²"


UGR = Measure(
    "unified glare rating",
    "UGR",
    better="lower",
    bands=(
        Band(13.0, "hardly perceptible"),
        Band(16.0, "within 16, the limit for technical drawing"),
        Band(19.0, "within 19, the limit for offices"),
        Band(22.0, "above 19, the limit for offices; within 22, for crafts, industry and reception desks"),
        Band(25.0, "above 19, the limit for offices; within 25, for heavy industry"),
        Band(28.0, "above 19, the limit for offices; within 28, for corridors"),
    ),
    above="above 19, the limit for offices, and above 28, the highest limit",
    source="CIE 117; limits of EN 12464-1",
)
DGP = Measure(
    "daylight glare probability",
    "DGP",
    better="lower",
    bands=(
        Band(0.35, "imperceptible glare"),
        Band(0.40, "perceptible glare"),
        Band(0.45, "disturbing glare"),
    ),
    above="intolerable glare",
    source="Wienold (2009); limits of EN 17037",
)
DGI = Measure(
    "daylight glare index",
    "DGI",
    better="lower",
    bands=(
        Band(16.0, "hardly perceptible glare"),
        Band(20.0, "perceptible glare"),
        Band(24.0, "glare that is no longer acceptable"),
        Band(28.0, "uncomfortable glare"),
    ),
    above="intolerable glare",
    source="Hopkinson (1972)",
)
