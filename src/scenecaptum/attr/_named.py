"""Attribution methods by name."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class NamedMethod:
    """An attribution method and what it shows.

    Attributes
    ----------
    create
        From a renderer and a metric to an object with ``attribute``.
    description
        A few words for a help text.
    """

    create: Any
    description: str
