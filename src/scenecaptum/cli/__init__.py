"""The command line, ``scenecaptum COMMAND``: one file for each command."""

from ._main import main as main
