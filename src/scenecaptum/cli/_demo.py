"""``scenecaptum demo``: ``scenecaptum attribute`` on the bundled office."""

from __future__ import annotations

import argparse
from typing import Any

from ._attribute import add_options, add_results, attribute

ARGUMENTS = ("office", "--resolution", "320x180", "--spp", "64")
NEXT = "What causes the glare in this office? scenecaptum explain office --metric ugr --resolution 160x90 --spp 64"


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    parser = commands.add_parser(
        "demo",
        help="attribute the mean luminance of a bundled office scene in about a minute",
        epilog="example: scenecaptum demo --out out",
    )
    add_results(parser)
    complete = argparse.ArgumentParser()
    add_options(complete)
    parser.set_defaults(**vars(complete.parse_args(ARGUMENTS)), run=run)


def run(options: argparse.Namespace) -> int:
    """Run the command, and say what to try next."""
    status = attribute(options)
    if not options.json:
        print(f"\n{NEXT}")
    return status
