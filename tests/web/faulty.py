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
from http import HTTPStatus
from socketserver import StreamRequestHandler, ThreadingTCPServer

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

    etag, ranges: whether it sends the one and heeds the other. link: what all bodies cross.
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
        link: Link | None = None,
    ):
        super().__init__(("127.0.0.1", 0), _Handler)
        self.content, self.faults, self.etag, self.ranges = content, list(faults or []), etag, ranges
        self.link = link or Link()
        self.heeds_if_range = True
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


class _Handler(StreamRequestHandler):
    server: FaultyServer
    disable_nagle_algorithm = True

    def handle(self) -> None:
        while self._request():
            pass

    def _request(self) -> bool:
        if not self.rfile.readline().strip():
            return False
        asked = {}
        while line := self.rfile.readline().strip().decode():
            name, _, value = line.partition(":")
            asked[name.lower()] = value.strip()
        server = self.server
        server.requests.append(asked)
        fault = server.faults.pop(0) if server.faults else Fault()
        content = server.content
        tag = f'"{hashlib.sha256(content).hexdigest()[:16]}"'
        same = asked.get("if-range") in ((None, tag) if server.etag else (None,)) or not server.heeds_if_range
        holds = server.ranges and same
        try:
            part = requested_range(asked.get("range"), len(content)) if holds else None
        except Unsatisfiable:
            part, fault = None, Fault(status=416)
        start, end = part or (0, len(content))
        body, status = content[start:end], fault.status if fault.status != 200 else 206 if part else 200
        if fault.status != 200:
            body = b"no\n"
        headers: dict[str, str | None] = {"Content-Length": str(len(body))}
        if server.etag:
            headers["ETag"] = tag
        if part:
            headers["Content-Range"] = f"bytes {start}-{end - 1}/{len(content)}"
        lines = [f"{name}: {value}" for name, value in {**headers, **fault.headers}.items() if value is not None]
        self.wfile.write("\r\n".join([f"HTTP/1.1 {status} {HTTPStatus(status).phrase}", *lines, "", ""]).encode())
        sent = body[: fault.after]
        server.sent += len(sent)
        fault.then(server)  # not after the body: the client may ask again before it is through
        self.server.link.send(sent, self.wfile.write)
        if fault.after is None:
            return fault.headers.get("Connection") != "close"
        if fault.how == "stall":
            server.stopped.wait(20)
        elif fault.how == "reset":
            with contextlib.suppress(OSError):
                self.request.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                self.request.close()
        return False


@dataclass(frozen=True)
class Answer:
    status: int
    headers: http.client.HTTPMessage
    body: bytes


def ask(server: Server, target: str, method: str = "GET", **headers: str) -> Answer:
    """One request on a connection of its own; If_Range="..." sends If-Range."""
    host, port = server.server_address[:2]
    connection = http.client.HTTPConnection(host, port, timeout=10)
    try:
        connection.putrequest(method, target, skip_host=True, skip_accept_encoding=True)
        connection.putheader("Host", f"{host}:{port}")
        for name, value in headers.items():
            connection.putheader(name.replace("_", "-"), value)
        connection.endheaders()
        response = connection.getresponse()
        return Answer(response.status, response.headers, response.read())
    finally:
        connection.close()
