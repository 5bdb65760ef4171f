"""θ → image as a torch function: the renderer, the plan it follows, and what each pixel shows.

Modules that import ``mitsuba`` at their top are imported only once a variant is active (see ``SceneRenderer``).
"""

# What users see; the other names are for the rooms above.
__all__ = ["RenderPlan", "SceneRenderer"]

from ._integrators import INTEGRATORS as INTEGRATORS
from ._integrators import STOCK_INTEGRATORS as STOCK_INTEGRATORS
from ._integrators import IntegratorKind as IntegratorKind
from ._integrators import register_integrators as register_integrators
from ._plan import RenderPlan as RenderPlan
from ._renderer import SceneRenderer as SceneRenderer
from ._seen_lamps import FILLED as FILLED
from ._seen_lamps import Reflection as Reflection
from ._seen_lamps import SmallLamp as SmallLamp
from ._sensors import SENSORS as SENSORS
from ._sensors import SensorType as SensorType
from ._sensors import named_sensors as named_sensors
