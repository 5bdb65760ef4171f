"""``scenecaptum parameters``: every parameter of a scene."""

from __future__ import annotations

import argparse
import json
from fnmatch import fnmatchcase
from typing import Any

from ..errors import SceneCaptumError, near_misses
from ..rendering import register_integrators
from ..scene import KINDS, Parameter, SceneParameters, discover_in, is_of_kind, near_names
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
    register_integrators()
    found = discover_in(options.scene, named_once(options.parameters, "-D"))
    _check_filters(found, options)
    chosen = [
        parameter
        for name, parameter in found.items()
        if (not options.filters or any(fnmatchcase(name, glob) for glob in options.filters))
        and (options.kind is None or is_of_kind(parameter, options.kind))
    ]
    if not chosen:
        which = " that these globs match" if options.filters else ""
        raise SceneCaptumError(f"The scene has no parameter of the kind {options.kind!r}{which}.")
    if options.json:
        print(json.dumps([_row(parameter) for parameter in chosen], indent=1))
        return 0
    shown = [one for one in chosen if options.all or options.filters or not one.problem]
    print(SceneParameters(shown))
    if len(shown) < len(chosen):
        print(
            f"\n{pluralize(len(chosen) - len(shown), 'other')} cannot be inputs: --all lists them with the reasons"
        )
    return 0


def _check_filters(found: SceneParameters, options: argparse.Namespace) -> None:
    """Raise if a glob matches nothing, or there is no such kind."""
    for glob in options.filters:
        if not any(fnmatchcase(name, glob) for name in found):
            raise SceneCaptumError(
                f"{glob!r} matches no parameter of the scene.{near_names(glob, list(found))} "
                f"`scenecaptum parameters {options.scene} --all` lists every name."
            )
    kinds = list(dict.fromkeys([*KINDS, *(parameter.kind for parameter in found.values())]))
    if options.kind not in (None, *kinds):
        raise SceneCaptumError(
            f"There is no kind {options.kind!r} of parameters.{near_misses(options.kind, kinds)} "
            f"Kinds are {', '.join(kinds)}."
        )


def _row(parameter: Parameter) -> dict[str, Any]:
    return {
        "name": parameter.name,
        "label": parameter.label,
        "kind": parameter.kind,
        "shape": list(parameter.shape),
        "bounds": str(parameter.bounds),
        "range": str(parameter.range),
        "unit": parameter.unit,
        "owners": list(parameter.owners),
        "status": parameter.status,
    }
