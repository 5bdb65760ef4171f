"""``scenecaptum demo``: ``scenecaptum attribute`` on the bundled office."""

from __future__ import annotations

from typing import Any

from . import _arguments
from ._attribute import add_report, attribute


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    parser = commands.add_parser(
        "demo", help="attribute the mean luminance of a bundled office scene in about a minute"
    )
    _arguments.add_output(parser)
    add_report(parser)
    parser.set_defaults(
        run=attribute,
        scene="office",
        parameters=None,
        metrics=None,
        inputs=None,
        threshold_factor=None,
        sensor="0",
        target=None,
        resolution=(320, 180),
        spp=64,
        max_depth=6,
        seed=0,
        checkpoint=None,
        picture_spp=None,
        replicates=8,
        denoise="auto",
        tolerance=None,
        time_limit=None,
    )
