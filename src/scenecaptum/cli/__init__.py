"""The command line, ``scenecaptum COMMAND``: one file per command."""

from ._main import main as main
from ._main import parser as parser
from ._main import run as run
