"""The files of the page, and the page as a section of a report."""

from __future__ import annotations

import base64
import json
import zlib
from importlib import resources

from ..errors import SceneCaptumError
from ..report import Section
from ._session import Exploration

KEPT = ("scene", "base", "objects", "slider")  # messages that predictions need


def page_text(name: str) -> str:
    """Return the text of a file of the page."""
    return resources.files(__package__).joinpath("page", name).read_text(encoding="utf-8")


def section(exploration: Exploration) -> Section:
    """Return predictions as a section for ``report.write_report``, which needs neither a server nor a network.

    Example
    -------
    >>> found = Exploration(renderer, metric)  # doctest: +SKIP
    >>> write_report(found.linearize().attributions, "report.html", sections=[section(found)])  # doctest: +SKIP

    Raises
    ------
    SceneCaptumError
        Without ``linearize()``: there is nothing to predict from.
    """
    if exploration.about is None:
        raise SceneCaptumError("The section has no predictions yet: call exploration.linearize() first.")
    messages = [
        {**message, "buffers": [base64.b64encode(zlib.compress(buffer, 9)).decode() for buffer in buffers]}
        for _, message, buffers in exploration.channel.latest.values()
        if message["type"] in KEPT
    ]
    data = json.dumps(messages, allow_nan=False)
    return Section("explore", "What if", page_text("explore.css"), page_text("explore.js"), data)
