"""Entry point of the command line, and its exit status."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from .. import __version__
from ..errors import SceneCaptumError
from . import (
    _attribute,
    _compare,
    _demo,
    _doctor,
    _explain,
    _optimize,
    _parameters,
    _render,
    _tradeoff,
    _validate,
)

COMMANDS = (
    _explain,
    _attribute,
    _compare,
    _optimize,
    _validate,
    _tradeoff,
    _parameters,
    _render,
    _demo,
    _doctor,
)

BAD_INPUT, INTERRUPTED = 2, 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status: 0 success, 1 not confirmed, 2 bad input, 130 interrupted."""
    options = parser().parse_args(arguments)
    try:
        status: int = options.run(options)
    except SceneCaptumError as error:
        print(f"scenecaptum: error: {error}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print(f"scenecaptum: interrupted; {_kept(options)}.", file=sys.stderr)
        return INTERRUPTED
    return status


def _kept(options: argparse.Namespace) -> str:
    """Return what an interrupted command has left."""
    checkpoint, folder = getattr(options, "checkpoint", None), getattr(options, "out", None)
    if checkpoint is not None and checkpoint.exists():
        return f"run the same command again to resume from {checkpoint}"
    if folder is not None and folder.exists():
        return f"finished results are in {folder}"
    return "nothing was kept; --checkpoint DIR keeps finished replicates"


def parser() -> argparse.ArgumentParser:
    """Return the parser of the whole command line."""
    whole = argparse.ArgumentParser(
        prog="scenecaptum",
        description="Attribute any metric of a rendered image to the parameters of the scene.",
    )
    whole.add_argument("--version", action="version", version=f"scenecaptum {__version__}")
    commands = whole.add_subparsers(required=True, metavar="COMMAND")
    for command in COMMANDS:
        command.add(commands)
    return whole
