"""The answer in sentences: what a metric says of a scene, what causes it, and what would change it."""

# What users see.
__all__ = ["explain"]

from ._explain import explain as explain
