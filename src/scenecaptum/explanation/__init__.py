"""The answer in sentences: what a metric says of a scene, what causes it, and what would change it."""

# What users see; the other names are for the rooms above.
__all__ = ["explain"]

from ._definition import definition_of as definition_of
from ._definition import difference_by_definition as difference_by_definition
from ._definition import states_definition as states_definition
from ._explain import explain as explain
from ._explain import photometric_premises as photometric_premises
from ._explain import rated_image as rated_image
from ._threshold import FACTOR as FACTOR
from ._threshold import other_threshold as other_threshold
