"""The page as a notebook widget, in Jupyter, VS Code, Colab and marimo."""

from __future__ import annotations

import threading
from typing import Any

from ..errors import SceneCaptumError
from ._channel import Listener
from ._files import page_text
from ._session import Exploration


def widget(exploration: Exploration) -> Any:
    """Return a notebook widget that explores; show it as the last line of a cell. Its ``close()`` ends the work.

    Example
    -------
    >>> widget(Exploration(renderer, metrics.UnifiedGlareRating(renderer.camera)))  # doctest: +SKIP

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

    made, channel, views = Explore(), exploration.channel, list[Listener]()

    def send(listener: Listener) -> None:
        while any(listener is one for one in views) and (taken := channel.take(listener, 1.0)) is not None:
            for one in taken:
                made.send(one.message, list(one.buffers))

    def receive(_: Any, message: dict[str, Any], __: Any) -> None:
        if message.get("type") == "hello":
            views.append(channel.listen())
            threading.Thread(target=send, args=(views[-1],), daemon=True).start()
        elif message.get("type") == "bye":
            channel.leave(views.pop())  # any: all views receive what is sent
        else:
            try:
                exploration.receive(message)
            except SceneCaptumError as error:
                made.send({"type": "problem", "text": str(error)})

    made.on_msg(receive)
    exploration.start()
    return made
