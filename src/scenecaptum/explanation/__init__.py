"""The answer in sentences: what a metric says of a scene, what causes it, and what would change it."""

# What users see; the other names are for the rooms above.
__all__ = ["explain"]

from ._definition import class_by_definition as class_by_definition
from ._definition import definition_of as definition_of
from ._definition import states_definition as states_definition
from ._explain import AT_THE_GOAL as AT_THE_GOAL
from ._explain import explain as explain
from ._explain import missing_at_edges as missing_at_edges
from ._explain import photometric_premises as photometric_premises
from ._explain import rated_image as rated_image
from ._explain import values_of as values_of
from ._premises import depth_premises as depth_premises
from ._premises import grid_premises as grid_premises
from ._premises import grid_size as grid_size
from ._premises import sky_premises as sky_premises
from ._threshold import FACTOR as FACTOR
from ._threshold import TOO_LOW as TOO_LOW
from ._threshold import has_absolute_threshold as has_absolute_threshold
from ._threshold import near_threshold_note as near_threshold_note
from ._threshold import relative_rating as relative_rating
