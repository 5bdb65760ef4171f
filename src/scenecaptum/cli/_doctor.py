"""``scenecaptum doctor``."""

from __future__ import annotations

from typing import Any

from .. import backend


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    parser = commands.add_parser("doctor", help="say whether this machine can render, and what to do if not")
    parser.set_defaults(run=lambda _: backend.main())
