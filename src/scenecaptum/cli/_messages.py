"""Messages of the library in the words of the command line."""

from __future__ import annotations

import argparse
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

from ..errors import SceneCaptumError
from ._design import designed_names

# Of keywords whose options have other names.
RENAMED = {"parameters": "-D", "objects": "--object", "metrics": "--metric"}
OF_COMMANDS = re.compile(r"(?:^|\s)--?[A-Za-z]")
KEYWORD = re.compile(
    r"\b(?:SceneRenderer|SensorGrid)\((?:…, )?(?P<name>\w+)=(?P<value>[^()]*)\)|\b(?P<alone>\w+)=(\S?)"
)
# A sentence of advice that ends with a call in Python.
IN_PYTHON = re.compile(r" [A-Z][^.]*\brenderer\.\w+\([^()]*\)\.")
IN_CODE = re.compile(r'^"(\w+)"$')  # a word of advice; what was given is in single quotes
VALUE = re.compile(r"[\w'\"\[{(−-]")


def in_options(message: str, options: argparse.Namespace) -> str:
    """Return a message with ``--spacing`` for ``spacing=``, of the options that a command has.

    Example
    -------
    >>> in_options("inputs='wal*' matches nothing: choose another with inputs=.", argparse.Namespace(inputs=None))
    "--inputs 'wal*' matches nothing: choose another with --inputs."

    A message that names options already is returned as it is. Advice to call a method of the renderer is left out.
    """

    def written(found: re.Match[str]) -> str:
        name = found["name"] or found["alone"]
        if not hasattr(options, name):
            return found[0]
        option = RENAMED.get(name, f"--{name.replace('_', '-')}")
        value = IN_CODE.sub(r"\1", found["value"].strip("…")) if found["name"] else found[4]
        return f"{option} {value}" if VALUE.match(value) else f"{option}{value}"

    message = IN_PYTHON.sub("", message)
    for name in _designed(options):  # which are looked up as inputs are
        message = message.replace(f"inputs={name!r}", f"the design's {name!r}")
    return message if OF_COMMANDS.search(message) else KEYWORD.sub(written, message)


def _designed(options: argparse.Namespace) -> list[str]:
    try:
        return designed_names(options)
    except SceneCaptumError:  # the message is about the design itself
        return []


@contextmanager
def warnings_in_options(options: argparse.Namespace) -> Iterator[None]:
    """Show the warnings of a block in the words of a command, on one line.

    The place in the source code is left out: it means nothing to users of a command. Of two renderers of a scene
    that warn alike, one is enough.
    """
    shown = set[str]()

    def one_line(message: Warning | str, *_: object, **__: object) -> str:
        line = f"scenecaptum: warning: {in_options(str(message), options)}\n"
        if line in shown:
            return ""
        shown.add(line)
        return line

    original = warnings.formatwarning
    warnings.formatwarning = one_line
    try:
        yield
    finally:
        warnings.formatwarning = original


@contextmanager
def warnings_after_checks() -> Iterator[None]:
    """Show the warnings of a block at its end, each once; an error stands alone, without what led there."""
    with warnings.catch_warnings(record=True) as held:
        yield
    for one in {str(found.message): found for found in held}.values():
        warnings.warn_explicit(one.message, one.category, one.filename, one.lineno)
