"""Lower a metric by changing the few most salient parameters within their bounds."""

from ._minimize import minimize as minimize
from ._result import Measured as Measured
from ._result import Moved as Moved
from ._result import Optimization as Optimization
