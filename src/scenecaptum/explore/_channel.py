"""What an exploration has published last, and the pages that listen."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

# A page: the keys of the messages that it has not received yet, in the order in which they came.
Listener: TypeAlias = dict[str, None]


class Published(NamedTuple):
    """A message with its pictures, and a number that no other message has."""

    serial: int
    message: dict[str, Any]
    buffers: Sequence[bytes]


class Channel:
    """The latest message under each key; what a page was too slow for is replaced by what is newer.

    ``changed`` guards all of it, and wakes the pages and the worker of the exploration.
    """

    def __init__(self) -> None:
        self.changed = threading.Condition()
        self.latest: dict[str, Published] = {}
        self.listeners: list[Listener] = []
        self.closed = False
        self._serials = itertools.count(1)

    def publish(self, key: str, buffers: Sequence[bytes] = (), **message: Any) -> None:
        """Replace the message under a key, whose first word is the type of the message."""
        with self.changed:
            self.latest[key] = Published(
                next(self._serials), {"type": key.partition(" ")[0], **message}, buffers
            )
            for listener in self.listeners:
                listener.pop(key, None)
                listener[key] = None
            self.changed.notify_all()

    def message(self, key: str) -> dict[str, Any]:
        """Return the message under a key, empty if there is none."""
        found = self.latest.get(key)
        return {} if found is None else found.message

    def listen(self) -> Listener:
        """Add a page, which receives everything that is known now."""
        with self.changed:
            listener = dict.fromkeys(self.latest)
            self.listeners.append(listener)
            self.changed.notify_all()
            return listener

    def leave(self, listener: Listener) -> None:
        """Remove a page."""
        with self.changed:
            self.listeners = [one for one in self.listeners if one is not listener]
            self.changed.notify_all()

    def take(self, listener: Listener, timeout: float) -> list[Published] | None:
        """Wait for messages and return them, none after the timeout; None once the exploration has ended."""
        with self.changed:
            self.changed.wait_for(lambda: self.closed or listener, timeout)
            taken = [self.latest[key] for key in listener if key in self.latest]
            listener.clear()
            return None if self.closed else taken

    def buffer(self, serial: int, index: int) -> bytes | None:
        """Return a picture of a message, None if it has been replaced."""
        with self.changed:
            found = [one.buffers for one in self.latest.values() if one.serial == serial]
        return found[0][index] if found and index < len(found[0]) else None

    def close(self) -> None:
        """End it for all pages and the worker."""
        with self.changed:
            self.closed = True
            self.changed.notify_all()
