"""Messages of the library in the words of the command line."""

from __future__ import annotations

import argparse
import re

# Of keywords whose options have other names.
RENAMED = {"parameters": "-D", "objects": "--object", "metrics": "--metric"}
OF_COMMANDS = re.compile(r"(?:^|\s)--?[A-Za-z]")
KEYWORD = re.compile(
    r"\b(?:SceneRenderer|SensorGrid)\((?:…, )?(?P<name>\w+)=(?P<value>[^()]*)\)|\b(?P<alone>\w+)=(\S?)"
)
VALUE = re.compile(r"[\w'\"\[{(−-]")


def in_options(message: str, options: argparse.Namespace) -> str:
    """Return a message with ``--spacing`` for ``spacing=``, of the options that a command has.

    Example
    -------
    >>> in_options("inputs='wal*' matches nothing: choose another with inputs=.", argparse.Namespace(inputs=None))
    "--inputs 'wal*' matches nothing: choose another with --inputs."

    A message that names options already is returned as it is.
    """

    def written(found: re.Match[str]) -> str:
        name = found["name"] or found["alone"]
        if not hasattr(options, name):
            return found[0]
        option = RENAMED.get(name, f"--{name.replace('_', '-')}")
        value = (found["value"] or "").strip("…") if found["name"] else found[4]
        return f"{option} {value}" if VALUE.match(value) else f"{option}{value}"

    return message if OF_COMMANDS.search(message) else KEYWORD.sub(written, message)
