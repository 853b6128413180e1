"""A web server that cuts, resets, stalls, lies or changes its file as told; and one plain HTTP request."""

from __future__ import annotations

import contextlib
import hashlib
import http.client
import socket
import struct
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler
from socketserver import ThreadingTCPServer
from types import SimpleNamespace

from pd4dgs_codec.web.headers import Unsatisfiable, requested_range
from pd4dgs_codec.web.server import Link, Server


@dataclass
class Fault:
    """What one request meets: after `after` bytes of the body the connection ends as `how` says.

    how: "close", "reset" or "stall" (silence until the server stops). status: answer this instead of the file.
    then: called before the body crosses, to change the server for the next request. headers: replace or (None)
    remove those of the answer.
    """

    after: int | None = None
    how: str = "close"
    status: int = 200
    then: Callable[[FaultyServer], None] = lambda server: None
    headers: dict[str, str | None] = field(default_factory=dict)


class FaultyServer(ThreadingTCPServer):
    """Serves `content` at `url` on loopback inside a `with` block, one of `faults` per request, then without.

    etag, ranges, heeds_if_range: whether it sends the first and heeds the others. link: what all bodies cross.
    """

    daemon_threads = True
    allow_reuse_address = True

    def __init__(
        self,
        content: bytes,
        faults: list[Fault] | None = None,
        *,
        etag: bool = True,
        ranges: bool = True,
        heeds_if_range: bool = True,
        link: Link | None = None,
    ):
        super().__init__(("127.0.0.1", 0), _Handler)
        self.content, self.faults, self.etag, self.ranges = content, list(faults or []), etag, ranges
        self.link = link or Link()
        self.heeds_if_range = heeds_if_range
        self.requests: list[dict[str, str]] = []  # their headers, names in lower case
        self.sent = 0  # bytes of bodies
        self.stopped = threading.Event()

    @property
    def url(self) -> str:
        """Of the one file."""
        return f"http://127.0.0.1:{self.server_address[1]}/scene.pd4"

    def __enter__(self) -> FaultyServer:
        self._thread = threading.Thread(target=self.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stopped.set()
        self.shutdown()
        self.server_close()
        self._thread.join()

    def handle_error(self, *_: object) -> None:
        """Clients that go away are what it is for."""


class _Handler(BaseHTTPRequestHandler):
    server: FaultyServer
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True

    def do_GET(self) -> None:
        server = self.server
        asked = {name.lower(): value for name, value in self.headers.items()}
        server.requests.append(asked)
        fault = server.faults.pop(0) if server.faults else Fault()
        tag = f'"{hashlib.sha256(server.content).hexdigest()[:16]}"'
        same = asked.get("if-range") in ((None, tag) if server.etag else (None,)) or not server.heeds_if_range
        size, part = len(server.content), None
        try:
            part = requested_range(asked.get("range"), size) if server.ranges and same else None
        except Unsatisfiable:
            fault = Fault(status=416)
        start, end = part or (0, size)
        body, status = server.content[start:end], 206 if part else 200
        if fault.status != 200:
            body, status = b"no\n", fault.status
        headers: dict[str, str | None] = {"Content-Length": str(len(body)), "ETag": tag if server.etag else None}
        if part:
            headers["Content-Range"] = f"bytes {start}-{end - 1}/{size}"
        self.send_response(status)
        for name, value in (headers | fault.headers).items():
            if value is not None:
                self.send_header(name, value)
        self.end_headers()
        sent = body[: fault.after]
        server.sent += len(sent)
        fault.then(server)  # not after the body: the client may ask again before it is through
        with server.link.transfer():
            for at in range(0, len(sent), server.link.block):
                server.link.cross(server.link.block)
                self.wfile.write(sent[at : at + server.link.block])
        if fault.after is not None:
            self._end(fault.how)

    def _end(self, how: str) -> None:
        self.close_connection = True
        if how == "stall":
            self.server.stopped.wait(20)
        elif how == "reset":
            with contextlib.suppress(OSError):
                self.request.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                self.request.close()

    def log_message(self, *_: object) -> None:
        """The server is silent."""


def ask(server: Server, target: str, method: str = "GET", **headers: str) -> SimpleNamespace:
    """status, headers and body of one request on a connection of its own; If_Range="..." sends If-Range."""
    host, port = server.server_address[:2]
    given = {"Host": f"{host}:{port}", **{name.replace("_", "-"): value for name, value in headers.items()}}
    with contextlib.closing(http.client.HTTPConnection(host, port, timeout=10)) as connection:
        connection.request(method, target, headers=given)
        response = connection.getresponse()
        return SimpleNamespace(status=response.status, headers=response.headers, body=response.read())
