"""Cost and accuracy of gradients by setting: seconds, error, bias and stability of the ranking."""

# What users see; the other names are for the command line.
__all__ = ["Measured", "Reference", "Setting", "Tradeoff", "measure"]

from ._measure import measure as measure
from ._result import TOLERANCE as TOLERANCE
from ._result import Measured as Measured
from ._result import Reference as Reference
from ._result import Tradeoff as Tradeoff
from ._settings import KEYS as KEYS
from ._settings import Setting as Setting
from ._statistics import Bias as Bias
from ._statistics import Estimate as Estimate
