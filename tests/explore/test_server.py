"""The server answers its own page only, and lives whatever it is sent."""

from __future__ import annotations

import http.client
import json
import math
import random
import socket
from typing import Any

import pytest
from seeds import shifted

from scenecaptum.errors import SceneCaptumError
from scenecaptum.explore import Server

LAMP = "light.emitter.radiance.value"


def ask(server: Server, method: str, path: str, body: Any = None, **headers: str) -> tuple[int, bytes]:
    """Return status and body of an answer."""
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=30)
    try:
        connection.request(method, path, body=body, headers={"Host": server.hosts[0], **headers})
        answer = connection.getresponse()
        return answer.status, answer.read()
    finally:
        connection.close()


def post(server: Server, message: Any) -> tuple[int, bytes]:
    text = message if isinstance(message, (str, bytes)) else json.dumps(message)
    return ask(server, "POST", f"/{server.token}/message", text)


def design(numbers: str) -> str:
    """Return the text of a message that moves the lamp."""
    return '{"type": "design", "design": {"' + LAMP + '": ' + numbers + "}}"


def test_only_this_machine_is_served(server):
    assert server.server_address[0] == "127.0.0.1"


@pytest.mark.parametrize(
    "path", ["/", "/explore.js", "/wrong/", "/wrong/explore.js", "//", "/%C3%A9/", "/%00/"]
)
def test_nothing_is_served_without_the_token(server, path):
    assert ask(server, "GET", path)[0] == 403
    assert ask(server, "POST", f"{path}message", "{}")[0] == 403


@pytest.mark.parametrize(
    "headers",
    [{"Host": "evil.example"}, {"Host": "127.0.0.1"}, {"Origin": "http://evil.example"}, {"Origin": "null"}],
    ids=str,
)
def test_pages_of_other_sites_are_refused(server, headers):
    assert ask(server, "GET", f"/{server.token}/", **headers)[0] == 403
    assert ask(server, "POST", f"/{server.token}/message", '{"type": "start"}', **headers)[0] == 403


@pytest.mark.parametrize(
    "path",
    [
        *("../page/page.html", "../../../etc/passwd", "%2e%2e/explore.js", "_server.py", "page/explore.js"),
        *("data", "data/1", "data/x/0", "data/-1/0", "data/1/0/0", "data/%C2%B2/0"),
    ],
)
def test_no_other_file_is_served(server, path):
    assert ask(server, "GET", f"/{server.token}/{path}")[0] == 404


def test_a_picture_that_was_replaced_has_no_content(server):
    assert ask(server, "GET", f"/{server.token}/data/999999999/0") == (204, b"")


def test_the_page_and_its_files_are_served_under_the_token(server):
    for name, word in (("", "<main"), ("explore.js", "export function render"), ("explore.css", ".explore")):
        status, body = ask(server, "GET", f"/{server.token}/{name}")
        assert status == 200
        assert word in body.decode()


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        ("", "finite"),
        ("{", "finite"),
        (b"\xff\xfe", "finite"),
        ("[" * 60000, "finite"),
        (design("[NaN]"), "finite"),
        (design("[1e999]"), "outside"),
        (design("[-1]"), "outside"),
        (design("[1, 2]"), "1 finite"),
        ('{"type": "design", "design": {"lamp": [1]}}', "lamp"),
        ('{"type": "design"}', "a type"),
        ('{"type": "add", "name": "light.emitter"}', "Did you mean"),
        ('{"type": "save", "name": " "}', "name"),
        ('{"type": "render"}', "a type"),
        ('"design"', "a type"),
        ("3", "a type"),
    ],
    ids=range(15),
)
def test_a_bad_message_is_refused_in_one_line(server, message, reason):
    status, body = post(server, message)
    assert status == 400
    error = json.loads(body)["error"]
    assert reason in error
    assert "\n" not in error


def test_bodies_that_are_huge_or_of_unknown_length_are_refused_unread(server):
    path = f"/{server.token}/message"
    assert ask(server, "POST", path, "x" * 70000)[0] == 413
    for length, status in ((str(10**12), 413), ("9" * 100, 413), ("-1", 411), ("x", 411), ("²", 411)):
        with socket.create_connection(("127.0.0.1", server.server_port), timeout=30) as sock:
            request = f"POST {path} HTTP/1.1\r\nHost: {server.hosts[0]}\r\nContent-Length: {length}\r\n\r\n"
            sock.sendall(request.encode("latin-1"))
            assert sock.recv(100).split()[1] == str(status).encode()


def test_the_server_lives_through_random_messages(server, exploration):
    """A thousand mutations of what a page sends, and random bytes on the wire: every one is answered."""
    chosen = random.Random(shifted())
    good = [
        {"type": "design", "design": {LAMP: [0.5]}, "origin": "a"},
        {"type": "add", "name": LAMP},
        {"type": "save", "name": "one"},
        {"type": "forget", "name": "one"},
    ]
    junk = [None, True, -1, 0.5, 1e308, 10**40, "", "\u0000", "é" * 99, [], {}, [[]], {"type": {}}, math.pi]
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=30)
    for _ in range(1000):
        message = dict(chosen.choice(good))
        message[chosen.choice([*message, "other"])] = chosen.choice(junk)
        text = json.dumps(message)
        if chosen.random() < 0.3:
            at = chosen.randrange(len(text))
            text = text[:at] + chosen.choice('{}[],:"\\x0') + text[at + chosen.randrange(4) :]
        connection.request("POST", f"/{server.token}/message", text, {"Host": server.hosts[0]})
        answer = connection.getresponse()
        assert answer.status in (200, 400), text
        answer.read()
    connection.close()
    for _ in range(50):
        with socket.create_connection(("127.0.0.1", server.server_port), timeout=30) as sock:
            sock.sendall(chosen.randbytes(100))
    assert post(server, {"type": "design", "design": {}})[0] == 200
    exploration.receive({"type": "forget", "name": "one"})


@pytest.mark.parametrize("port", [-1, 65536, 1.5])
def test_a_port_that_does_not_exist_is_refused(exploration, port):
    with pytest.raises(SceneCaptumError, match="port"):
        Server(exploration, port)


def test_a_port_in_use_is_refused(exploration, server):
    with pytest.raises(SceneCaptumError, match="--port"):
        Server(exploration, server.server_port)
