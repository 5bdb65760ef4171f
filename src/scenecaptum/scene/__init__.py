"""What is in a scene: loading it, its parameters with kind, bounds and owner, and the bundled rooms."""

# What users see; the other names are for the rooms above.
__all__ = [
    "BUNDLED",
    "Parameter",
    "Photometry",
    "SceneParameters",
    "discover",
    "ies_lamp",
    "load_scene",
    "read_ies",
    "select",
]

from ._checks import check_scale as check_scale
from ._checks import check_spectra as check_spectra
from ._graph import SceneGraph as SceneGraph
from ._graph import children as children
from ._loading import SceneLike as SceneLike
from ._loading import XmlParameters as XmlParameters
from ._loading import format_parameters as format_parameters
from ._loading import hashable_source as hashable_source
from ._loading import load_scene as load_scene
from ._loading import named_integrator as named_integrator
from ._loading import scene_heading as scene_heading
from ._loading import scene_name as scene_name
from ._naming import plugin_name as plugin_name
from ._naming import without_addresses as without_addresses
from ._objects import Objects as Objects
from ._objects import SceneObject as SceneObject
from ._objects import camera_object as camera_object
from ._objects import find_objects as find_objects
from ._objects import has_point_lamps as has_point_lamps
from ._objects import touching as touching
from ._parameter_table import MOVING_KINDS as MOVING_KINDS
from ._parameter_table import Parameter as Parameter
from ._parameter_table import SceneParameters as SceneParameters
from ._parameters import discover as discover
from ._parameters import discover_in as discover_in
from ._portable import portable as portable
from ._portable import restored as restored
from ._poses import Moved as Moved
from ._poses import camera_parameters as camera_parameters
from ._poses import moved_pivot as moved_pivot
from ._poses import overlaps as overlaps
from ._poses import placement as placement
from ._poses import pose_component as pose_component
from ._poses import pose_name as pose_name
from ._poses import pose_parameters as pose_parameters
from ._poses import with_unit as with_unit
from ._ranges import choose_ranges as choose_ranges
from ._reflection import OPEN_MARGIN as OPEN_MARGIN
from ._reflection import clamp_inside as clamp_inside
from ._reflection import reflect as reflect
from ._selection import KINDS as KINDS
from ._selection import Selection as Selection
from ._selection import is_of_kind as is_of_kind
from ._selection import near_names as near_names
from ._selection import select as select
from .bundled import BUNDLED as BUNDLED
from .bundled import rgb_film as rgb_film
from .photometry import Photometry as Photometry
from .photometry import ies_lamp as ies_lamp
from .photometry import read_ies as read_ies
