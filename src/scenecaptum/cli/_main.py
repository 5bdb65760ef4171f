"""Entry point of the command line, and its exit status."""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NoReturn

from .. import __version__
from ..errors import SceneCaptumError, near_misses
from . import (
    _attribute,
    _compare,
    _daylight,
    _demo,
    _doctor,
    _explain,
    _explore,
    _optimize,
    _parameters,
    _render,
    _study,
    _tradeoff,
    _validate,
)
from ._interrupt import INTERRUPTED, leave, prompt_exit
from ._messages import in_options, warnings_in_options

COMMANDS = (
    _explain,
    _explore,
    _daylight,
    _attribute,
    _compare,
    _optimize,
    _validate,
    _tradeoff,
    _study,
    _parameters,
    _render,
    _demo,
    _doctor,
)

BAD_INPUT = 2
UNREAD = 128 + 13  # as a shell says of a process that SIGPIPE ended


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status.

    0 is success, 1 not confirmed or a goal not reached, 2 bad input, 130 interrupted, and 141 that nobody reads
    its output.
    """
    options = parser().parse_args(arguments)
    say = partial(_say_interrupted, options, time.time())
    try:
        with prompt_exit(say), warnings_in_options(options):
            status: int = options.run(options)
            sys.stdout.flush()
    except SceneCaptumError as error:
        print(f"scenecaptum: error: {in_options(str(error), options)}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        say()
        return INTERRUPTED
    except BrokenPipeError:  # whoever reads what is printed has ended, such as ``head``
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # else Python complains at its exit
        return UNREAD
    return status


def run() -> int:
    """Run the command of this process; it ends within seconds of Ctrl-C."""
    status = main()
    if status == INTERRUPTED and "drjit" in sys.modules:  # whose kernels may still run
        leave(status)
    return status


def _say_interrupted(options: argparse.Namespace, started: float) -> None:
    print(f"\nscenecaptum: interrupted; {_kept(options, started)}.", file=sys.stderr)


def _kept(options: argparse.Namespace, started: float) -> str:
    """Return what an interrupted command has left."""
    checkpoint, folder = getattr(options, "checkpoint", None), getattr(options, "out", None)
    if checkpoint is not None and any(path.is_file() for path in checkpoint.rglob("*")):
        return f"run the same command again to resume from {checkpoint}"
    if folder is not None and any(path.stat().st_mtime >= started for path in folder.rglob("*.*")):
        return f"what was finished is in {folder}"
    if checkpoint is not None:
        return f"nothing is in {checkpoint} yet: no render was finished"
    if hasattr(options, "checkpoint"):
        return "nothing was kept; --checkpoint DIR keeps finished replicates"
    return "nothing was kept"


class _CommandParser(argparse.ArgumentParser):
    """Reports what is wrong in one line, in words; argparse puts the usage before it, which hides it.

    ``needless`` says of options of other commands why this one does not have them, and ``twice`` what to do of
    options that are given twice.
    """

    needless: Mapping[str, str] = {}
    twice: Mapping[str, str] = {}

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.register("type", int, _whole_number)  # what parses the text of an option of this type
        self.register("type", float, _number)

    def error(self, message: str) -> NoReturn:
        self.exit(BAD_INPUT, f"{self.prog}: error: {message}\n`{self.prog} --help` says what can be given.\n")

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[Any, list[str]]:
        options, unknown = super().parse_known_args(args, namespace)
        if unknown:
            if needless := [self.needless[one] for one in unknown if one in self.needless]:
                hint = f" {needless[0]}"
            elif any(one.startswith("-") for one in unknown):
                hint = near_misses(unknown[0], self._option_string_actions)
            else:
                hint = " What is not an option comes right after the scene, before all options."
            self.error(f"unrecognized arguments: {' '.join(unknown)}.{hint}")
        return options, unknown


def _whole_number(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number, such as 64") from None


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number, such as 0.5") from None


def parser() -> argparse.ArgumentParser:
    """Return the parser of the whole command line."""
    whole = _CommandParser(
        prog="scenecaptum",
        description="Attribute any metric of a rendered image to the parameters of the scene.",
    )
    whole.add_argument("--version", action="version", version=f"scenecaptum {__version__}")
    commands = whole.add_subparsers(required=True, metavar="COMMAND")
    for command in COMMANDS:
        command.add(commands)
    return whole
