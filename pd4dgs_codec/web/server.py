"""A small web server for one folder: ranges, validators, CORS, and a simulated slow link.

It is meant for trials, measurements and demonstrations; docs/player-and-delivery.md configures nginx or Caddy for the
same folder.
"""

from __future__ import annotations

import contextlib
import gzip
import html
import io
import os
import socket
import stat
import sys
import threading
import time
from collections.abc import Callable, Iterator
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from socketserver import ThreadingTCPServer
from typing import BinaryIO
from urllib.parse import quote, unquote, urlsplit

from pd4dgs_codec.errors import DeliveryError, printable
from pd4dgs_codec.web import PAGE
from pd4dgs_codec.web.headers import Unsatisfiable, cache_control, lists_etag, media_type, requested_range

#: Files up to MAX_ZIPPED bytes with these suffixes are sent with gzip to clients that accept it.
ZIPPED, MAX_ZIPPED = {".html", ".js", ".json"}, 1 << 20
METHODS = "GET, HEAD, OPTIONS"
CORS = {
    "Access-Control-Allow-Origin": "*",
    "Access-Control-Expose-Headers": "Accept-Ranges, Content-Length, Content-Range, ETag, Last-Modified",
    "Cross-Origin-Resource-Policy": "cross-origin",
    "Timing-Allow-Origin": "*",
}
#: For pages of this server alone.
OWN = {"Cross-Origin-Resource-Policy": "same-origin"}
PREFLIGHT = {
    "Access-Control-Allow-Methods": METHODS,
    "Access-Control-Allow-Headers": "Range, If-Range, If-None-Match, If-Modified-Since",
    "Access-Control-Max-Age": "86400",
}
#: Flags against links and pipes that replace a file just before it is opened. Windows has neither flag.
FILE_ITSELF = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
#: Time limit for a client to send its next request, and to accept each block of the response.
IDLE_SECONDS = 60.0
#: Link time of a block: shorter than the times to be measured, longer than waking a thread takes.
QUANTUM_SECONDS = 0.005
MIN_BLOCK, MAX_BLOCK = 64, 1 << 18
MOST_LISTED = 1000  #: entries of a folder whose page is made here
#: A late transfer catches up by at most this; further capacity that a slow reader leaves unused is lost.
CATCH_UP_SECONDS = 0.05


class Link:
    """A simulated link that all transfers share in turn, block by block.

    rate: bits per second of payload (protocol headers are free), or None for no limit.
    """

    def __init__(self, rate: float | None = None):
        self.rate = rate
        #: Bytes to send at a time.
        self.block = MAX_BLOCK if rate is None else int(min(max(rate * QUANTUM_SECONDS / 8, MIN_BLOCK), MAX_BLOCK))
        self._lock = threading.Lock()
        self._transfers = 0
        self._free_at = 0.0  # when the last block granted will have crossed

    @contextlib.contextmanager
    def transfer(self) -> Iterator[None]:
        """Encloses one response. A link that was idle starts without saved capacity."""
        with self._lock:
            if not self._transfers:
                self._free_at = max(self._free_at, time.monotonic())
            self._transfers += 1
        try:
            yield
        finally:
            with self._lock:
                self._transfers -= 1

    def cross(self, size: int) -> None:
        """Sleeps until `size` more bytes have crossed. Deadlines are absolute, so that delays do not accumulate."""
        if self.rate is None:
            return
        with self._lock:
            start = max(self._free_at, time.monotonic() - CATCH_UP_SECONDS)
            self._free_at = done_at = start + 8 * size / self.rate
        wait = done_at - time.monotonic()
        if wait > 0:
            time.sleep(wait)


class Server(ThreadingTCPServer):
    """Serves `folder` on host:port (0: any free port) once serve_forever runs.

    private: answers only the requests that `is_own` accepts; otherwise pages of every site may read the files.
    link: carries all response bodies. latency: seconds of a round trip, for each new connection and each request.
    log: called with one line per request. Raises DeliveryError for an unusable folder or address.
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
        private: bool = False,
        link: Link | None = None,
        latency: float = 0.0,
        log: Callable[[str], None] | None = None,
    ):
        self.root = Path(folder).resolve()
        if not self.root.is_dir():
            raise DeliveryError(f"{folder}: is not a folder, expected one to serve")
        self.link, self.latency, self.log, self.private = link or Link(), latency, log, private
        #: Connections that owe a request, with the time.monotonic() of its deadline.
        self.waiting: dict[socket.socket, float] = {}
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        try:
            super().__init__((host, port), _Handler)
        except (OSError, OverflowError, TypeError) as error:  # TypeError: a name that IDNA cannot encode
            raise DeliveryError(
                f"cannot listen on {_authority(host, port)}: {getattr(error, 'strerror', error)}"
            ) from None

    @property
    def url(self) -> str:
        """Address of the folder, with a final slash, that this machine can open: where the server listens on all
        addresses, the loopback one."""
        host, port = self.server_address[:2]
        own = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(str(host), str(host))
        return f"http://{_authority(own, port)}/"

    def is_own(self, host: str | None, origin: str | None) -> bool:
        """Whether a request names this server, and comes from its own page or from none. A foreign site can point its
        own name at this machine, but its requests then carry that name (DNS rebinding)."""
        own, port = str(self.server_address[0]), self.server_address[1]
        names = {_authority(name, port) for name in {own, "localhost"}}
        names |= {name.removesuffix(":80") for name in names}
        return host is not None and host.lower() in names and origin in (None, f"http://{host.lower()}")

    def url_of(self, name: str) -> str:
        """Address of a file in the folder."""
        return self.url + quote(name)

    @contextlib.contextmanager
    def running(self) -> Iterator[Server]:
        """Serves from another thread inside the `with` block."""
        thread = threading.Thread(target=self.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
        thread.start()
        try:
            yield self
        finally:
            self.shutdown()
            self.server_close()
            thread.join()

    def service_actions(self) -> None:
        """Disconnects clients whose request is overdue: a socket's own time limit begins anew with every byte."""
        now = time.monotonic()
        for connection, until in list(self.waiting.items()):
            if now > until and self.waiting.pop(connection, 0.0):
                with contextlib.suppress(OSError):
                    connection.shutdown(socket.SHUT_RDWR)

    def handle_error(self, request: object, client_address: object) -> None:
        """Reports errors of this program; clients that disconnect are normal."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(request, client_address)  # type: ignore[arg-type]


def _authority(host: str, port: int) -> str:
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def _found(root: Path, target: str) -> Path | None:
    """Returns the file or folder under `root` that a request target names; None for missing and hidden ones, and paths
    outside `root`, which is absolute and free of links. Links are followed if they lead to a place inside `root`."""
    try:
        path = unquote(urlsplit(target).path, errors="strict")
        names = path.removesuffix("/").split("/")[1:]
        if not path.startswith("/") or any(n.startswith(".") or not n or "\\" in n or "\0" in n for n in names):
            return None
        found = root.joinpath(*names).resolve(strict=True)
    except (OSError, ValueError, RuntimeError):  # RuntimeError: a cycle of links, before Python 3.13
        return None
    inside = found.is_relative_to(root) and found.is_dir() >= path.endswith("/")
    return found if inside else None


def _opened(found: Path | None) -> BinaryIO | None:
    """Opens a file; returns None for all else, such as pipes."""
    if found is None:
        return None
    try:
        file = open(found, "rb", opener=lambda name, flags: os.open(name, flags | FILE_ITSELF))
    except OSError:
        return None
    if stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        return file
    file.close()
    return None


def _listing(folder: Path) -> bytes:
    """A page of links to the scenes and pages in a folder without a page; empty if there are none."""
    places = (path / PAGE if (path / PAGE).is_file() else path for path in sorted(folder.iterdir())[:MOST_LISTED])
    shown = [path.relative_to(folder).as_posix() for path in places if path.suffix in (".pd4", ".html")]
    links = (f'<li><a href="./{quote(n)}">{html.escape(printable(n, ""))}</a>' for n in shown if not n.startswith("."))
    head = '<!doctype html><html lang="en"><meta charset="utf-8"><title>Scenes</title>'
    return f"{head}<h1>Scenes</h1><ul>{''.join(links)}</ul>\n".encode() if shown else b""


def _etag(file: BinaryIO) -> str:
    state = os.fstat(file.fileno())
    return f'"{state.st_ino:x}-{state.st_size:x}-{state.st_mtime_ns:x}"'


class _Handler(BaseHTTPRequestHandler):
    server: Server
    server_version, sys_version = "pd4dgs", ""
    protocol_version = "HTTP/1.1"
    timeout = IDLE_SECONDS
    disable_nagle_algorithm = True

    def setup(self) -> None:
        super().setup()
        time.sleep(self.server.latency)

    def handle_one_request(self) -> None:
        self.server.waiting[self.connection] = time.monotonic() + IDLE_SECONDS
        try:
            super().handle_one_request()
        finally:
            self.server.waiting.pop(self.connection, None)

    def parse_request(self) -> bool:
        complete = super().parse_request()
        self.server.waiting.pop(self.connection, None)
        return complete and self._is_taken()

    def _is_taken(self) -> bool:
        """Sends an error and returns False for ambiguous or foreign requests. No body is read, or read as a request."""
        head = self.headers
        if "Content-Length" in head or "Transfer-Encoding" in head or self.command not in METHODS.split(", "):
            self.close_connection = True
        # lines that the parser could not read as header fields may announce a body, as may a folded line
        broken = head.defects or head.get_payload() or any("\n" in value or "\r" in value for value in head.values())
        if broken or any(len(head.get_all(name, [])) > 1 for name in ("Host", "Origin")):
            self.send_error(HTTPStatus.BAD_REQUEST)
            return False
        named = self.path.startswith("/") and self.server.is_own(head.get("Host"), head.get("Origin"))
        if self.server.private and not named:  # a target may name another host, too
            self.send_error(HTTPStatus.MISDIRECTED_REQUEST)
            return False
        return True

    def do_OPTIONS(self) -> None:
        self._begin(HTTPStatus.NO_CONTENT, {"Allow": METHODS, **({} if self.server.private else PREFLIGHT)})

    def _refuse(self) -> None:
        self._fail(HTTPStatus.METHOD_NOT_ALLOWED, {"Allow": METHODS})

    do_POST = do_PUT = do_PATCH = do_DELETE = _refuse

    def do_GET(self) -> None:
        found = _found(self.server.root, self.path)
        is_folder = found is not None and found.is_dir()
        place = urlsplit(self.path if is_folder else "")
        if is_folder and not place.path.endswith("/"):
            query = f"?{place.query}" if place.query else ""
            self._begin(HTTPStatus.FOUND, {"Location": f"{place.path}/{query}", "Content-Length": "0"})
            return
        file = _opened(_found(self.server.root, place.path + PAGE) if is_folder else found)
        if file is not None:
            with file:
                self._send_file(file)
        elif found is not None and is_folder and not self.server.private and (text := _listing(found)):
            self._answer(HTTPStatus.OK, text, {"Content-Type": media_type(PAGE)})
        else:
            self._fail(HTTPStatus.NOT_FOUND)

    do_HEAD = do_GET

    def _send_file(self, file: BinaryIO) -> None:
        path, etag, state = Path(file.name), _etag(file), os.fstat(file.fileno())
        suffix, body, size = path.suffix.lower(), file, state.st_size
        headers = {"Accept-Ranges": "bytes", "Cache-Control": cache_control(path.name)}
        headers["Last-Modified"] = self.date_time_string(state.st_mtime)
        if suffix in ZIPPED:
            headers["Vary"] = "Accept-Encoding"
        codings = self.headers.get("Accept-Encoding", "").lower().replace(" ", "").split(",")
        zipped = suffix in ZIPPED and size <= MAX_ZIPPED and "gzip" in codings and "Range" not in self.headers
        # another representation, with other ranges and another ETag
        headers["ETag"] = etag[:-1] + '-gzip"' if zipped else etag
        if lists_etag(self.headers.get("If-None-Match", ""), headers["ETag"]):
            self._begin(HTTPStatus.NOT_MODIFIED, headers)
            return
        headers["Content-Type"] = media_type(path.name)
        if zipped:
            body = io.BytesIO(gzip.compress(file.read(MAX_ZIPPED), 9, mtime=0))
            size, headers["Content-Encoding"] = body.getbuffer().nbytes, "gzip"
        part = None
        try:
            if self.command == "GET" and self.headers.get("If-Range") in (None, etag):  # HEAD has no ranges
                part = requested_range(self.headers.get("Range"), size)
        except Unsatisfiable:
            self._fail(HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE, {**headers, "Content-Range": f"bytes */{size}"})
            return
        start, end = part or (0, size)
        headers["Content-Length"] = str(end - start)
        if part:
            headers["Content-Range"] = f"bytes {start}-{end - 1}/{size}"
        self._begin(HTTPStatus.PARTIAL_CONTENT if part else HTTPStatus.OK, headers)
        if self.command == "GET":
            body.seek(start)
            self._send_body(body, end - start, lambda: _etag(file) == etag)

    def _send_body(self, body: BinaryIO, left: int, unchanged: Callable[[], bool]) -> None:
        link = self.server.link
        with link.transfer():
            while left:
                block = body.read(min(left, link.block))
                # a file rewritten in place: after a disconnection the client asks for the new one
                if not block or not unchanged():
                    self.close_connection = True
                    return
                link.cross(len(block))
                self.wfile.write(block)
                left -= len(block)

    def _fail(self, status: HTTPStatus, headers: dict[str, str] | None = None) -> None:
        kind = {"Content-Type": "text/plain; charset=utf-8"}
        self._answer(status, f"{status.value} {status.phrase}\n".encode(), {**(headers or {}), **kind})

    def _answer(self, status: HTTPStatus, text: bytes, headers: dict[str, str]) -> None:
        self._begin(status, {**headers, "Content-Length": str(len(text))})
        if self.command != "HEAD":
            self.wfile.write(text)

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Refuses an invalid request of any HTTP version as `_fail` does."""
        self.request_version, self.close_connection = self.protocol_version, True
        self._fail(HTTPStatus(code))

    def _begin(self, status: HTTPStatus, headers: dict[str, str]) -> None:
        time.sleep(self.server.latency)
        self.send_response(status)
        whose = OWN if self.server.private else CORS
        for name, value in {**headers, **whose, "X-Content-Type-Options": "nosniff"}.items():
            self.send_header(name, value)
        if self.close_connection:
            self.send_header("Connection", "close")
        self.end_headers()

    def log_message(self, format: str, *args: object) -> None:
        """One line for each request, in which control characters cannot act on the terminal."""
        if self.server.log:
            self.server.log(printable(f"{self.client_address[0]} {format % args}", ""))
