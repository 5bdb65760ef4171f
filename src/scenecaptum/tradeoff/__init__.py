"""What accuracy costs: seconds, error and bias of gradients, and stability of their ranking, by setting."""

from ._measure import measure as measure
from ._result import Measured as Measured
from ._result import Reference as Reference
from ._result import Tradeoff as Tradeoff
from ._settings import Setting as Setting
