"""A local page: a server on this machine alone, and only for those who know the token in its address."""

from __future__ import annotations

import hmac
import json
import secrets
import threading
import webbrowser
from collections.abc import Callable, Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, NoReturn

from ..errors import SceneCaptumError, whole_number
from ._files import page_text
from ._session import Exploration

ADDRESS = "127.0.0.1"
MAX_BODY = 65536  # bytes of a message
MAX_PAGES = 32
PATIENCE = 10.0  # seconds for a slow page
HEARTBEAT = 1.0  # seconds after which a closed page is noticed
FILES = {
    "": ("page.html", "text/html; charset=utf-8"),
    "explore.js": ("explore.js", "text/javascript; charset=utf-8"),
    "explore.css": ("explore.css", "text/css; charset=utf-8"),
}
HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "img-src 'self' data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


class Server(ThreadingHTTPServer):
    """Serves the page of an exploration at ``address``, on any port that is free or on a given one."""

    daemon_threads = True

    def __init__(self, exploration: Exploration, port: int = 0) -> None:
        self.exploration, self.token = exploration, secrets.token_urlsafe(32)
        try:
            super().__init__((ADDRESS, whole_number("port", port, 0, 65535)), _Handler)
        except OSError as error:
            raise SceneCaptumError(
                f"Port {port} of this machine cannot be used: {error.strerror}. Choose another with --port."
            ) from error

    @property
    def hosts(self) -> tuple[str, str]:
        """What a browser may call this server; another name means that a page of another site asks."""
        return f"{ADDRESS}:{self.server_port}", f"localhost:{self.server_port}"

    @property
    def address(self) -> str:
        """Where the page is, with the token."""
        return f"http://{self.hosts[0]}/{self.token}/"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Forget a connection that broke; the page connects again."""


class _RefusedError(Exception):
    """A request that is refused: status and reason."""


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    timeout = PATIENCE
    server: Server

    def do_GET(self) -> None:
        self._answer(self._get)

    def do_POST(self) -> None:
        self._answer(self._post)

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing: the address has the token."""

    def _answer(self, method: Callable[[str], None]) -> None:
        try:
            method(self._path())
        except _RefusedError as refusal:
            # What was not read of a body would be taken for the next request.
            self.close_connection = True
            status, reason = refusal.args
            self._send(status, json.dumps({"error": reason}).encode(), "application/json")

    def _path(self) -> str:
        """Return what follows the token; refuse requests without it, and those of other sites."""
        if self.headers.get("Host") not in self.server.hosts:
            _refuse(HTTPStatus.FORBIDDEN, "This server answers to its own address only.")
        origin = self.headers.get("Origin")
        if origin is not None and origin.removeprefix("http://") not in self.server.hosts:
            _refuse(HTTPStatus.FORBIDDEN, "This server answers its own page only.")
        _, _, rest = self.path.partition("/")
        token, _, path = rest.partition("/")
        if not hmac.compare_digest(token.encode("utf-8", "replace"), self.server.token.encode()):
            _refuse(
                HTTPStatus.FORBIDDEN, "The address has no token, or a wrong one: use that which was printed."
            )
        return path

    def _get(self, path: str) -> None:
        if path == "events":
            self._send_events()
        elif path in FILES:
            name, kind = FILES[path]
            self._send(HTTPStatus.OK, page_text(name).encode(), kind)
        else:
            found = self._buffer(path)
            self._send(HTTPStatus.OK if found else HTTPStatus.NO_CONTENT, found, "application/octet-stream")

    def _buffer(self, path: str) -> bytes:
        """Return a picture, empty if it has been replaced."""
        parts = path.split("/")
        numbers = [int(part) for part in parts[1:] if part.isascii() and part.isdigit() and len(part) < 16]
        if parts[0] == "data" and len(parts) == len(numbers) + 1 == 3:
            return self.server.exploration.channel.buffer(*numbers) or b""  # there is a newer picture
        _refuse(HTTPStatus.NOT_FOUND, "There is nothing at this address.")

    def _post(self, path: str) -> None:
        if path != "message":
            _refuse(HTTPStatus.NOT_FOUND, "There is nothing at this address.")
        length = self.headers.get("Content-Length", "")
        if not (length.isascii() and length.isdigit()):
            _refuse(HTTPStatus.LENGTH_REQUIRED, "A message needs its length.")
        if len(length) > 9 or int(length) > MAX_BODY:
            _refuse(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"A message has at most {MAX_BODY} bytes.")
        try:
            # int() refuses NaN and Infinity.
            message = json.loads(self.rfile.read(int(length)), parse_constant=int)
        except (ValueError, RecursionError):
            _refuse(HTTPStatus.BAD_REQUEST, "A message is JSON with finite numbers.")
        try:
            self.server.exploration.receive(message)
        except SceneCaptumError as error:
            _refuse(HTTPStatus.BAD_REQUEST, str(error))
        self._send(HTTPStatus.OK, b"{}", "application/json")

    def _send(self, status: HTTPStatus, body: bytes, kind: str) -> None:
        self.send_response(status)
        self._send_headers({"Content-Type": kind, "Content-Length": str(len(body))})
        self.wfile.write(body)

    def _send_headers(self, own: Mapping[str, str]) -> None:
        closing = {"Connection": "close"} if self.close_connection else {}
        for name, value in {**HEADERS, **own, **closing}.items():
            self.send_header(name, value)
        self.end_headers()

    def _send_events(self) -> None:
        """Send messages as they come; a page that has gone is noticed by the next heartbeat."""
        channel = self.server.exploration.channel
        if len(channel.listeners) >= MAX_PAGES:
            _refuse(HTTPStatus.SERVICE_UNAVAILABLE, f"There are {MAX_PAGES} pages already: close some.")
        self.close_connection = True
        self.send_response(HTTPStatus.OK)
        self._send_headers({"Content-Type": "text/event-stream"})
        listener = channel.listen()
        try:
            while (taken := channel.take(listener, HEARTBEAT)) is not None:
                for one in taken:
                    paths = [f"data/{one.serial}/{index}" for index in range(len(one.buffers))]
                    text = json.dumps({**one.message, "buffers": paths}, allow_nan=False)
                    self.wfile.write(f"data: {text}\n\n".encode())
                if not taken:
                    self.wfile.write(b": \n\n")
                self.wfile.flush()
        except OSError:
            pass
        finally:
            channel.leave(listener)


def _refuse(status: HTTPStatus, text: str) -> NoReturn:
    raise _RefusedError(status, text)


def serve(exploration: Exploration, *, port: int = 0, open_browser: bool = True) -> bool:
    """Explore in a browser until Ctrl-C, and return whether all work has ended by then.

    Example
    -------
    >>> serve(Exploration(renderer, metrics.UnifiedGlareRating(renderer.camera)))  # doctest: +SKIP

    Parameters
    ----------
    exploration
        What is explored.
    port
        Of this machine; 0 for any that is free.
    open_browser
        Whether to open the page in the user's browser; its address is printed.

    Raises
    ------
    SceneCaptumError
        If the port is invalid or in use.
    """
    with Server(exploration, port) as server:
        exploration.start()
        name = exploration.designs.renderer.name
        print(f"Explore {name} at {server.address} (Ctrl-C ends it)", flush=True)
        if open_browser:
            threading.Thread(target=webbrowser.open, args=(server.address,), daemon=True).start()
        try:
            server.serve_forever(poll_interval=0.1)
        except KeyboardInterrupt:
            pass
        finally:
            ended = exploration.close()
    return ended
