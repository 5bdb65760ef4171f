"""What an exploration has published last, and the pages that listen."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

Message = dict[str, Any]


@dataclass(frozen=True)
class Published:
    """A message with its pictures, and a number that no other message has."""

    serial: int
    message: Message
    buffers: tuple[bytes, ...] = ()


@dataclass(eq=False)
class Listener:
    """A page: the keys of the messages that it has not received yet, in the order in which they came."""

    pending: dict[str, None] = field(default_factory=dict)


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
        """Replace the message under a key."""
        with self.changed:
            self.latest[key] = Published(next(self._serials), message, tuple(buffers))
            for listener in self.listeners:
                listener.pending.pop(key, None)
                listener.pending[key] = None
            self.changed.notify_all()

    def known(self) -> list[str]:
        """Return the keys of all messages."""
        with self.changed:
            return list(self.latest)

    def message(self, key: str) -> Message:
        """Return the message under a key, empty if there is none."""
        with self.changed:
            return self.latest[key].message if key in self.latest else {}

    def withdraw(self, key: str) -> None:
        """Forget the message under a key."""
        with self.changed:
            self.latest.pop(key, None)

    def listen(self) -> Listener:
        """Add a page, which receives everything that is known now."""
        with self.changed:
            listener = Listener(dict.fromkeys(self.latest))
            self.listeners.append(listener)
            self.changed.notify_all()
            return listener

    def listen_once(self) -> list[Published]:
        """Return everything that is known now."""
        with self.changed:
            return list(self.latest.values())

    def repeat(self, listener: Listener) -> None:
        """Let a page receive everything again."""
        with self.changed:
            listener.pending = dict.fromkeys(self.latest)
            self.changed.notify_all()

    def leave(self, listener: Listener) -> None:
        """Remove a page."""
        with self.changed:
            if listener in self.listeners:
                self.listeners.remove(listener)
            self.changed.notify_all()

    def take(self, listener: Listener, timeout: float) -> list[Published] | None:
        """Wait for messages and return them, none after the timeout; None once the exploration has ended."""
        with self.changed:
            self.changed.wait_for(lambda: self.closed or listener.pending, timeout)
            if self.closed:
                return None
            taken = [self.latest[key] for key in listener.pending if key in self.latest]
            listener.pending.clear()
            return taken

    def buffer(self, serial: int, index: int) -> bytes | None:
        """Return a picture of a message, None if it has been replaced."""
        with self.changed:
            for one in self.latest.values():
                if one.serial == serial and index < len(one.buffers):
                    return one.buffers[index]
        return None

    def close(self) -> None:
        """End it for all pages and the worker."""
        with self.changed:
            self.closed = True
            self.changed.notify_all()
