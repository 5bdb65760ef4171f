"""``scenecaptum parameters``: every parameter of a scene."""

from __future__ import annotations

import argparse
import json
from fnmatch import fnmatchcase
from typing import Any

from ..scene import Parameter, SceneParameters, discover_in
from ..visualization import pluralize
from . import _arguments
from ._once import named_once


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    parser = commands.add_parser(
        "parameters",
        help="list the parameters of a scene",
        description="List the parameters of a scene that can be inputs, with kind, shape, bounds and owner. Those "
        "that a GLOB matches, or all with --all, are also listed where they cannot, with the reason.",
        epilog="example: scenecaptum parameters office 'desk.*'",
    )
    _arguments.add_file(parser)
    parser.add_argument("filters", nargs="*", metavar="GLOB", help="only names that match one of these")
    parser.add_argument("--kind", metavar="KIND", help="only this kind, such as reflectance or emitters")
    parser.add_argument(
        "--all", action="store_true", help="also those that cannot be inputs, with the reasons"
    )
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    found = discover_in(options.scene, named_once(options.parameters, "-D"))
    chosen = [
        parameter
        for name, parameter in found.items()
        if (not options.filters or any(fnmatchcase(name, glob) for glob in options.filters))
        and options.kind in (None, parameter.kind)
    ]
    if options.json:
        print(json.dumps([_row(parameter) for parameter in chosen], indent=1))
        return 0
    shown = [one for one in chosen if options.all or options.filters or one.moves or not one.problem]
    print(SceneParameters(shown))
    if len(shown) < len(chosen):
        print(
            f"\n{pluralize(len(chosen) - len(shown), 'other')} cannot be inputs: --all lists them with the reasons"
        )
    return 0


def _row(parameter: Parameter) -> dict[str, Any]:
    return {
        "name": parameter.name,
        "label": parameter.label,
        "kind": parameter.kind,
        "shape": list(parameter.shape),
        "bounds": str(parameter.bounds),
        "range": str(parameter.range),
        "owners": list(parameter.owners),
        "status": parameter.status,
    }
