"""The page as a notebook widget, in Jupyter, VS Code, Colab and marimo."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any

from ..errors import SceneCaptumError
from ._channel import Channel, Listener
from ._files import page_text
from ._session import Exploration


def widget(exploration: Exploration) -> Any:
    """Return a notebook widget that explores; show it as the last line of a cell.

    Example
    -------
    >>> widget(Exploration(renderer, metrics.UnifiedGlareRating(renderer.camera)))  # doctest: +SKIP

    Parameters
    ----------
    exploration
        What is explored; ``close()`` of the widget ends it.

    Returns
    -------
    anywidget.AnyWidget
        The widget.

    Raises
    ------
    SceneCaptumError
        If anywidget is not installed: ``pip install 'scenecaptum[explore]'``.
    """
    try:
        import anywidget
    except ImportError as error:
        raise SceneCaptumError("widget() needs anywidget: pip install 'scenecaptum[explore]'") from error

    class Explore(anywidget.AnyWidget):
        """The page; its views share the design."""

        _esm, _css = page_text("explore.js"), page_text("explore.css")

        def close(self) -> None:
            """End the exploration as well."""
            exploration.close()
            super().close()

    made = Explore()
    views = _Views(made, exploration)
    made.on_msg(lambda _, message, __: views.receive(message))
    exploration.start()
    return made


class _Views:
    """Passes messages between the views of a widget and an exploration, which rests without views."""

    def __init__(self, made: Any, exploration: Exploration) -> None:
        self.made, self.exploration = made, exploration
        self.count = 0
        self.listener: Listener | None = None

    def receive(self, message: Mapping[str, Any]) -> None:
        """Pass on what a view asks for."""
        kind, channel = message.get("type"), self.exploration.channel
        if kind == "hello":
            self.count += 1
            if self.listener is None:
                self.listener = channel.listen()
                threading.Thread(target=self._send, args=(channel, self.listener), daemon=True).start()
            else:
                channel.repeat(self.listener)
        elif kind == "bye":
            self.count -= 1
            if self.count == 0 and self.listener is not None:
                channel.leave(self.listener)
                self.listener = None
        else:
            try:
                self.exploration.receive(message)
            except SceneCaptumError as error:
                self.made.send({"type": "problem", "text": str(error)})

    def _send(self, channel: Channel, listener: Listener) -> None:
        while listener is self.listener and (taken := channel.take(listener, 1.0)) is not None:
            for one in taken:
                self.made.send(one.message, list(one.buffers))
