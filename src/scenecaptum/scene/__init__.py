"""What is in a scene: loading it, its parameters with kind, bounds and owner, and the bundled rooms."""

# What users see; the other names are for the rooms above.
__all__ = [
    "BUNDLED",
    "Parameter",
    "SceneParameters",
    "discover",
    "load_scene",
    "select",
]

from ._loading import load_scene as load_scene
from ._parameter_table import Parameter as Parameter
from ._parameter_table import SceneParameters as SceneParameters
from ._parameters import discover as discover
from ._reflection import OPEN_MARGIN as OPEN_MARGIN
from ._reflection import reflect as reflect
from ._selection import select as select
from .bundled import BUNDLED as BUNDLED
