"""``python -m scenecaptum.cli``."""

import sys

from ._main import run

sys.exit(run())
