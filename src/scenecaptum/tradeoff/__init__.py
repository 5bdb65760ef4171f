"""Cost and accuracy of gradients by setting: seconds, error, bias and stability of the ranking."""

from ._measure import measure as measure
from ._result import Measured as Measured
from ._result import Reference as Reference
from ._result import Tradeoff as Tradeoff
from ._settings import Setting as Setting
