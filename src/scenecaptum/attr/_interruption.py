"""What is left when the user stops an attribution."""

from __future__ import annotations

from ._attribution import SceneAttribution


class AttributionInterrupted(KeyboardInterrupt):
    """Ctrl-C during an attribution whose finished passes already give a result.

    Attributes
    ----------
    partial
        The attribution from the passes that were finished; its bars are as wide as that makes them.
    partials
        One such attribution for each target, where there are several; ``partial`` is the first.
    """

    def __init__(self, partial: SceneAttribution, *others: SceneAttribution) -> None:
        super().__init__("interrupted; .partial holds the result of the finished passes")
        self.partial = partial
        self.partials = (partial, *others)
