"""Options of which a command takes one value: a second is an error, where argparse would drop the first."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any, TypeVar

from ..errors import SceneCaptumError

T = TypeVar("T")


class Once(argparse.Action):
    """Stores the value of an option that a command takes once; argparse would silently take the last one."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        """Store a value; end with an error if there is one already."""
        given: set[str] = namespace.__dict__.setdefault("given_once", set())
        if self.dest in given:
            first = getattr(namespace, self.dest)
            command = parser.prog.rpartition(" ")[2]
            advice = getattr(parser, "twice", {}).get(option_string, "run it once for each")
            parser.error(f"{command} takes one {option_string}, not both {first} and {values}: {advice}")
        given.add(self.dest)
        setattr(namespace, self.dest, values)


def named_once(pairs: Sequence[tuple[str, T]] | None, option: str) -> dict[str, T]:
    """Return the values of ``NAME=VALUE`` by name; raise if a name has two, of which one would be dropped."""
    found: dict[str, T] = {}
    for name, value in pairs or ():
        if name in found:
            raise SceneCaptumError(f"{option} {name}= is given twice: remove one of the two.")
        found[name] = value
    return found
