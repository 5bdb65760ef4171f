"""What is left when the user stops an attribution."""

from __future__ import annotations

from typing import Any


class AttributionInterrupted(KeyboardInterrupt):
    """Ctrl-C during an attribution whose finished passes already give a result.

    Attributes
    ----------
    partial
        The attribution from the passes that were finished; its bars are as wide as that makes them. For a list
        of targets a list of attributions.
    """

    def __init__(self, partial: Any) -> None:
        super().__init__("interrupted; .partial holds the result of the finished passes")
        self.partial = partial
