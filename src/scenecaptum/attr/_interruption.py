"""The exception for an interrupted attribution, with the partial result."""

from __future__ import annotations

from ._attribution import SceneAttribution


class AttributionInterrupted(KeyboardInterrupt):
    """Raised on Ctrl-C during an attribution if the finished replicates already give a result.

    Attributes
    ----------
    partial
        The attribution from the finished replicates, with its standard errors.
    partials
        One such attribution for each target; ``partial`` is the first.
    """

    def __init__(self, partial: SceneAttribution, *others: SceneAttribution) -> None:
        super().__init__("interrupted; .partial has the result of the finished replicates")
        self.partial = partial
        self.partials = (partial, *others)
