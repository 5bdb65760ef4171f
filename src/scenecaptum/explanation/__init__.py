"""The answer in sentences: what a metric says of a scene, what causes it, and what would change it."""

# What users see; the other name is for the rooms above.
__all__ = ["explain"]

from ._definition import definition_of as definition_of
from ._definition import half_sample_error as half_sample_error
from ._explain import explain as explain
