"""A small web server for one folder: ranges, validators, CORS, and a slow link to try things over.

It is for trying, measuring and showing; `pd4dgs-serve --help` says how nginx or Caddy serve the same folder.
"""

from __future__ import annotations

import contextlib
import gzip
import os
import socket
import stat
import threading
import time
from collections.abc import Callable, Iterator
from email.utils import formatdate
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from socketserver import ThreadingTCPServer
from typing import BinaryIO
from urllib.parse import quote, unquote, urlsplit

from pd4dgs_codec.errors import DeliveryError
from pd4dgs_codec.web.link import Link
from pd4dgs_codec.web.names import cache_control
from pd4dgs_codec.web.page import PAGE
from pd4dgs_codec.web.patience import Patient
from pd4dgs_codec.web.ranges import Unsatisfiable, http_time, lists_etag, requested_range

MEDIA_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".jpg": "image/jpeg",
    ".js": "text/javascript; charset=utf-8",
    ".json": "application/json",
    ".m3u8": "application/vnd.apple.mpegurl",
    ".mp4": "video/mp4",
    ".mpd": "application/dash+xml",
    ".pd4": "application/octet-stream",
    ".png": "image/png",
    ".wasm": "application/wasm",
}
#: Sent compressed to who takes that, up to a size in bytes, as any server of pages does.
ZIPPED, MAX_ZIPPED = {".html", ".js", ".json"}, 1 << 20
METHODS = "GET, HEAD, OPTIONS"
CORS = {
    "Access-Control-Allow-Origin": "*",
    "Access-Control-Expose-Headers": "Accept-Ranges, Content-Length, Content-Range, ETag, Last-Modified",
    "Cross-Origin-Resource-Policy": "cross-origin",
    "Timing-Allow-Origin": "*",
}
PREFLIGHT = {
    "Access-Control-Allow-Methods": METHODS,
    "Access-Control-Allow-Headers": "Range, If-Range, If-None-Match, If-Modified-Since",
    "Access-Control-Max-Age": "86400",
}
#: Within which a client must have sent its next request, all of it, and taken each block of the answer.
IDLE_SECONDS = 60.0


def locate(root: Path, target: str) -> Path | None:
    """The file under `root` that a request target names; None for all else: no such file, hidden names, ways out.

    A target that ends in a slash names the folder's page.
    root: absolute and free of links. Links inside it count if what they lead to lies inside it as well.
    """
    try:
        path = unquote(urlsplit(target).path, errors="strict")
        names = path.split("/")[1:]
        names[-1:] = [names[-1] or PAGE] if names else []
        if not path.startswith("/") or any(n.startswith(".") or not n or "\\" in n or "\0" in n for n in names):
            return None
        found = root.joinpath(*names).resolve(strict=True)
    except (OSError, ValueError, RuntimeError):  # RuntimeError: links in a circle, before Python 3.13
        return None
    return found if found.is_relative_to(root) else None


class Server(ThreadingTCPServer):
    """Serves `folder` on host:port (0: any free port) as soon as serve_forever runs.

    link: what all bodies cross. latency: seconds of a round trip; a new connection waits for one, each request for
    another. log: called with one line per request. Raises DeliveryError for a folder or an address it cannot use.
    """

    daemon_threads = True
    allow_reuse_address = True
    request_queue_size = 256

    def __init__(
        self,
        folder: str | os.PathLike[str],
        host: str = "127.0.0.1",
        port: int = 0,
        *,
        link: Link | None = None,
        latency: float = 0.0,
        log: Callable[[str], None] | None = None,
    ):
        self.root = Path(folder).resolve()
        if not self.root.is_dir():
            raise DeliveryError(f"{folder}: is no folder, expected one to serve")
        self.link, self.latency, self.log = link or Link(), latency, log
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        try:
            super().__init__((host, port), _Handler)
        except (OSError, OverflowError) as error:
            raise DeliveryError(f"{host}:{port}: cannot listen here: {getattr(error, 'strerror', error)}") from None

    @property
    def url(self) -> str:
        """Where the folder is, with a final slash."""
        host, port = self.server_address[:2]
        name = str(host)
        return f"http://{f'[{name}]' if ':' in name else name}:{port}/"

    def url_of(self, name: str) -> str:
        """The URL of a file in the folder."""
        return self.url + quote(name)

    @contextlib.contextmanager
    def running(self) -> Iterator[Server]:
        """Serves from a thread of its own inside the `with` block."""
        thread = threading.Thread(target=self.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
        thread.start()
        try:
            yield self
        finally:
            self.shutdown()
            self.server_close()
            thread.join()

    def handle_error(self, request: object, client_address: object) -> None:
        """Clients that go away in the middle are everyday life; anything else is a fault of ours and stays loud."""
        import sys

        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(request, client_address)  # type: ignore[arg-type]


class _Handler(BaseHTTPRequestHandler):
    server: Server
    server_version, sys_version = "pd4dgs", ""
    protocol_version = "HTTP/1.1"
    timeout = IDLE_SECONDS
    disable_nagle_algorithm = True

    def setup(self) -> None:
        super().setup()
        self._patient = Patient(self.connection)
        self.rfile = self._patient.makefile()
        time.sleep(self.server.latency)

    def handle_one_request(self) -> None:
        self._patient.until = time.monotonic() + IDLE_SECONDS
        super().handle_one_request()

    def do_GET(self) -> None:
        self._answer(body=True)

    def do_HEAD(self) -> None:
        self._answer(body=False)

    def do_OPTIONS(self) -> None:
        self._begin(HTTPStatus.NO_CONTENT, {"Allow": METHODS, **PREFLIGHT})

    def _refuse(self) -> None:
        self.close_connection = True  # a body may follow that nobody reads
        self._fail(HTTPStatus.METHOD_NOT_ALLOWED, {"Allow": METHODS})

    do_POST = do_PUT = do_PATCH = do_DELETE = _refuse

    def _answer(self, body: bool) -> None:
        if "Content-Length" in self.headers or "Transfer-Encoding" in self.headers:
            self.close_connection = True  # a body that nobody reads must not be taken for the next request
        path = locate(self.server.root, self.path)
        file = None if path is None else _open_regular(path)
        if path is None or file is None:
            self._fail(HTTPStatus.NOT_FOUND)
            return
        with file:
            self._send_file(file, path, body)

    def _send_file(self, file: BinaryIO, path: Path, body: bool) -> None:
        suffix = path.suffix.lower()
        state = os.fstat(file.fileno())
        size, etag = state.st_size, _etag(state)
        zipped = suffix in ZIPPED and size <= MAX_ZIPPED and self._takes_gzip()
        if zipped:  # another representation: neither its ranges nor its ETag are those of the plain one
            etag = etag[:-1] + '-gzip"'
        headers = {"Accept-Ranges": "bytes", "Cache-Control": cache_control(path.name), "ETag": etag}
        headers["Last-Modified"] = formatdate(state.st_mtime, usegmt=True)
        if suffix in ZIPPED:
            headers["Vary"] = "Accept-Encoding"
        if self._unchanged(etag, state.st_mtime):
            self._begin(HTTPStatus.NOT_MODIFIED, headers)
            return
        headers["Content-Type"] = MEDIA_TYPES.get(suffix, "application/octet-stream")
        if zipped:
            self._send_zipped(file, headers, body)
            return
        try:
            # HTTP defines ranges for GET alone
            part = requested_range(self.headers.get("Range"), size) if body and self._range_holds(etag, state) else None
        except Unsatisfiable:
            self._fail(HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE, {**headers, "Content-Range": f"bytes */{size}"})
            return
        start, end = part or (0, size)
        headers["Content-Length"] = str(end - start)
        if part:
            headers["Content-Range"] = f"bytes {start}-{end - 1}/{size}"
        self._begin(HTTPStatus.PARTIAL_CONTENT if part else HTTPStatus.OK, headers)
        if body:
            file.seek(start)
            self._send_body(file, end - start, etag)

    def _takes_gzip(self) -> bool:
        listed = self.headers.get("Accept-Encoding", "").lower().replace(" ", "").split(",")
        return "gzip" in listed and "Range" not in self.headers

    def _send_zipped(self, file: BinaryIO, headers: dict[str, str], body: bool) -> None:
        content = gzip.compress(file.read(MAX_ZIPPED), 9, mtime=0)
        self._begin(HTTPStatus.OK, {**headers, "Content-Encoding": "gzip", "Content-Length": str(len(content))})
        if body:
            self.server.link.send(content, self.wfile.write)

    def _send_body(self, file: BinaryIO, left: int, etag: str) -> None:
        link = self.server.link
        with link.transfer():
            while left:
                block = file.read(min(left, link.block))
                # a file rewritten in place: what was promised no longer exists, and a cut makes the client ask again
                if not block or _etag(os.fstat(file.fileno())) != etag:
                    self.close_connection = True
                    return
                link.cross(len(block))
                self.wfile.write(block)
                left -= len(block)

    def _unchanged(self, etag: str, modified: float) -> bool:
        tags = self.headers.get("If-None-Match")
        if tags is not None:
            return lists_etag(tags, etag)
        since = http_time(self.headers.get("If-Modified-Since"))
        return since is not None and int(modified) <= since

    def _range_holds(self, etag: str, state: os.stat_result) -> bool:
        """Whether If-Range, where given, names this very file; a date counts only if nothing could follow within it."""
        condition = self.headers.get("If-Range")
        if condition is None or condition == etag:
            return True
        return http_time(condition) == int(state.st_mtime) and time.time() - state.st_mtime > 2

    def _fail(self, status: HTTPStatus, headers: dict[str, str] | None = None) -> None:
        text = f"{status.value} {status.phrase}\n".encode()
        kind = {"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(text))}
        self._begin(status, {**(headers or {}), **kind})
        if self.command != "HEAD":
            self.wfile.write(text)

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Called for what is no request: answered like any other refusal, whatever version it spoke."""
        self.request_version, self.close_connection = self.protocol_version, True
        self._fail(HTTPStatus(code))

    def _begin(self, status: HTTPStatus, headers: dict[str, str]) -> None:
        time.sleep(self.server.latency)
        self.send_response(status)
        for name, value in {**headers, **CORS, "X-Content-Type-Options": "nosniff"}.items():
            self.send_header(name, value)
        if self.close_connection:
            self.send_header("Connection", "close")
        self.end_headers()

    def log_message(self, format: str, *args: object) -> None:
        if self.server.log:
            self.server.log(f"{self.client_address[0]} {format % args}".translate(_PRINTABLE))


#: Control characters of a request line would act on the terminal that shows it.
_PRINTABLE = {code: "?" for code in [*range(32), *range(127, 160)]}


def _open_regular(path: Path) -> BinaryIO | None:
    """The file opened, or None if it cannot be or is something else: a folder, a pipe, a link put there meanwhile."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError:
        return None
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        return None
    return os.fdopen(descriptor, "rb")


def _etag(state: os.stat_result) -> str:
    return f'"{state.st_ino:x}-{state.st_size:x}-{state.st_mtime_ns:x}"'
