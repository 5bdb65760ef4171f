"""Minimize a metric by changing the few most salient parameters within their bounds."""

# What users see; the other names are for the rooms above.
__all__ = ["Measured", "Moved", "Optimization", "minimize"]

from ._bounds import BOUND_MARGIN as BOUND_MARGIN
from ._bounds import construction as construction
from ._bounds import design_bounds as design_bounds
from ._bounds import first_of_each_light as first_of_each_light
from ._minimize import Search as Search
from ._minimize import SearchOptions as SearchOptions
from ._minimize import minimize as minimize
from ._minimize import warn_if_more_is_better as warn_if_more_is_better
from ._result import Measured as Measured
from ._result import Moved as Moved
from ._result import Optimization as Optimization
