"""The command line: ``scenecaptum attribute``, ``scenecaptum demo`` and ``scenecaptum doctor``."""

from ._main import main as main
