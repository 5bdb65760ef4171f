"""``scenecaptum doctor``: check the rendering backends."""

from __future__ import annotations

from typing import Any

from .. import backend


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    parser = commands.add_parser(
        "doctor", help="check whether this machine can render, and how to fix problems"
    )
    parser.set_defaults(run=lambda _: backend.main())
