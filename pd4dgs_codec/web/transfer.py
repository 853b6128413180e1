"""The beginning of one remote file, growing: what has arrived is never asked for again unless the file changes.

HTTP itself comes from the standard library; connections are direct (no proxies), kept open between requests, and follow
redirects.
"""

from __future__ import annotations

import http.client
import math
import queue
import socket
import ssl
import threading
import time
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any
from urllib.parse import quote, urljoin, urlsplit

from pd4dgs_codec.errors import DeliveryError, one_line
from pd4dgs_codec.web.patience import Patient
from pd4dgs_codec.web.ranges import content_range, strong_etag
from pd4dgs_codec.web.urls import is_url

BLOCK = 1 << 16
MAX_REDIRECTS = 5
#: Changes of the file during one transfer after which it counts as one that never holds still.
MAX_CHANGES = 4
BACKOFF_SECONDS = 0.2
#: Answers that may be another one a moment later; other errors are final.
PASSING = {408, 425, 429, 500, 502, 503, 504}
#: Of what a server says, at most so many characters are shown.
SHOWN = 80
REDIRECTS = {301, 302, 303, 307, 308}


class Changed(Exception):
    """The file is another one now: what had arrived is gone, and the transfer stands at byte 0."""


class OutOfTime(Exception):
    """The seconds allowed are over; what has arrived stays."""


class _Cut(Exception):
    """The connection ended before what it promised, or an answer makes no sense; asking again may help."""


@dataclass(frozen=True)
class _Place:
    """Where to send a request. target: path and query, quoted."""

    url: str
    secure: bool
    host: str
    port: int | None
    target: str

    @staticmethod
    def of(url: str) -> _Place:
        try:
            parts = urlsplit(url)
            if not is_url(url) or not parts.hostname or "@" in parts.netloc:
                raise ValueError
            target = quote(parts.path or "/", safe="/%:=&~+!$,;'@()*") + (
                f"?{quote(parts.query, safe='/%:=&?~+!$,;@()*')}" if parts.query else ""
            )
            return _Place(url, parts.scheme.lower() == "https", parts.hostname, parts.port, target)
        except ValueError:
            raise DeliveryError(f"found {url!r}, expected http://HOST/PATH or https://HOST/PATH") from None


class Transfer:
    """Fetches one URL front to back, as far as asked, and goes on after cuts.

    data: what has arrived, from byte 0. total: length of the file, None until told. stall: seconds within which a
    connection must stand, an answer's whole header be here, and the next block of its body; else it counts as cut.
    attempts: failures in a row, without a byte between them, before giving up. requests, cuts, changes: how often each
    happened.
    """

    def __init__(self, url: str, *, stall: float = 10.0, attempts: int = 5):
        self.url, self.stall, self.attempts = url, stall, attempts
        self.data = bytearray()
        self.total: int | None = None
        self.requests = self.cuts = self.changes = 0
        self._home = self._place = _Place.of(url)
        self._validator: str | None = None
        self._connection: http.client.HTTPConnection | None = None
        self._socket: Patient | None = None  # http.client forgets it once an answer is the last
        self._response: http.client.HTTPResponse | None = None
        self._response_end: int | None = None  # of the part in the answer being read; None: not told
        self._skip = 0  # bytes of the answer that are here already

    def read(self, end: int | None = None, *, reach: int | None = None, seconds: float = math.inf) -> bytes:
        """The next bytes to arrive, none beyond `end` (None: the end of the file); empty if all are here.

        reach: how far one request may go, so that later reads need no further one; None asks for the whole rest.
        Raises Changed, OutOfTime after `seconds`, or DeliveryError if the file cannot be had.
        """
        until, failures = time.monotonic() + seconds, 0
        while not self._here(end):
            try:
                if self._response is None:
                    self._request(reach, until)
                    continue  # an answer may also say that there is nothing to read
                block = self._receive(end, until)
            except (OSError, http.client.HTTPException, _Cut) as error:
                self.close()
                if time.monotonic() >= until:
                    raise OutOfTime from None
                self.cuts += 1
                failures += 1
                if failures >= self.attempts or isinstance(error, ssl.SSLCertVerificationError):
                    message = f"{self.url}: {_reason(error)} ({len(self.data):,} bytes are here)"
                    raise DeliveryError(message) from None
                if failures > 1:
                    time.sleep(max(0.0, min(BACKOFF_SECONDS * 2 ** (failures - 2), until - time.monotonic())))
                continue
            if block:
                return block
        return b""

    def rewind(self, size: int) -> None:
        """Forgets all but the first `size` bytes."""
        del self.data[size:]
        self.close()

    def close(self) -> None:
        """Ends the connection; what has arrived stays, and a later read opens another."""
        if self._response is not None:
            self._response.close()
        if self._connection is not None:
            self._connection.close()
        self._connection = self._socket = self._response = None
        self._skip = 0
        self._place = self._home

    def _here(self, end: int | None) -> bool:
        size = len(self.data)
        return (end is not None and size >= end) or (self.total is not None and size >= self.total)

    def _receive(self, end: int | None, until: float) -> bytes:
        """One block of the answer, or b"" at its proper end or within what is skipped."""
        assert self._response is not None
        start = len(self.data) - self._skip
        limit = BLOCK if end is None or self._skip else min(BLOCK, end - len(self.data))
        if self._response_end is not None:
            limit = min(limit, self._response_end - start)
        if self._skip:
            limit = min(limit, self._skip)
        self._wait_at_most(until)
        block = self._response.read1(limit) if limit else b""
        if self._skip:
            self._skip -= len(block)
            if not block:
                raise _Cut("the connection ended early")
            return b""
        self.data += block
        if len(self.data) == self._response_end:
            self._response.close()  # all of it was read, so the connection can be used again
            self._response = None
        elif not block:
            if self._response_end is not None:
                raise _Cut(f"the connection ended at byte {len(self.data):,} of {self._response_end:,}")
            self._response, self.total = None, len(self.data)  # a length never told ends with the connection
        return block

    # -- requests ------------------------------------------------------------------------------------------------------

    def _request(self, reach: int | None, until: float) -> None:
        start = len(self.data)
        headers = {"Accept-Encoding": "identity", "User-Agent": "pd4dgs"}
        if start and self._validator is None:  # the rest could be that of another file, so all of it once more
            headers["Cache-Control"] = "no-cache"
        elif start:
            headers["Range"] = f"bytes={start}-" + ("" if reach is None else str(reach - 1))
            headers["If-Range"] = str(self._validator)
        elif reach is not None:
            headers["Range"] = f"bytes=0-{reach - 1}"
        for _ in range(MAX_REDIRECTS + 1):
            response = self._send(headers, until)
            if response.status not in REDIRECTS:
                break
            here, place = self._place.url, response.headers.get("Location")
            self.close()  # which goes back to where it all began
            if place is None:
                raise DeliveryError(f"{self.url}: a redirect that leads nowhere")
            try:
                self._place = _Place.of(urljoin(here, place))
            except ValueError:
                raise DeliveryError(
                    f"{self.url}: a redirect to {one_line(place, SHOWN)!r}, which is no address"
                ) from None
        else:
            raise DeliveryError(f"{self.url}: more than {MAX_REDIRECTS} redirects")
        self._response = response
        self._accept(response, start, "Range" in headers)

    def _send(self, headers: dict[str, str], until: float) -> http.client.HTTPResponse:
        if self._connection is None:
            kind = http.client.HTTPSConnection if self._place.secure else http.client.HTTPConnection
            self._connection = kind(self._place.host, self._place.port)
        if self._connection.sock is None:  # new, or closed by the server after its last answer
            self._socket = Patient(_connect(self._place, min(until, time.monotonic() + self.stall)))
            self._connection.sock = self._socket
        self._wait_at_most(until)
        self.requests += 1
        self._connection.request("GET", self._place.target, headers=headers)
        return self._connection.getresponse()

    def _wait_at_most(self, until: float) -> None:
        """All that is read or written next must be done within the stall limit and before `until`."""
        assert self._socket is not None
        self._socket.until = min(until, time.monotonic() + self.stall)

    def _accept(self, response: http.client.HTTPResponse, start: int, asked_range: bool) -> None:
        """Takes an answer for bytes from `start` on; raises Changed where it is about another file than before."""
        status, part = response.status, content_range(response.headers.get("Content-Range"))
        if status == HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE and asked_range:
            if start == 0:
                self.close()
                self.total = 0
                return
            self._restart()  # the file has become shorter than what is here
        if status not in (HTTPStatus.OK, HTTPStatus.PARTIAL_CONTENT):
            said = f"the server answers {status} {one_line(response.reason, SHOWN)}".rstrip()
            if status in PASSING:
                raise _Cut(said)
            self.close()
            raise DeliveryError(f"{self.url}: {said}")
        if response.headers.get("Content-Encoding", "identity").lower() != "identity":
            self.close()
            coding = one_line(response.headers["Content-Encoding"], SHOWN)
            raise DeliveryError(f"{self.url}: sent as {coding}, expected the bytes as such")
        tag = strong_etag(response.headers.get("ETag"))
        validator = tag or response.headers.get("Last-Modified")
        if status == HTTPStatus.PARTIAL_CONTENT:
            if not asked_range or part is None or part.start != start or part.total is None:
                raise _Cut(
                    f"found Content-Range {one_line(response.headers.get('Content-Range') or 'none', SHOWN)}, "
                    f"expected bytes from {start}"
                )
            other = start and validator is not None and validator != self._validator
            if other or (start and part.total != self.total):
                self._restart()
            self.total, self._response_end = part.total, part.end
        else:
            self._response_end = self.total = response.length
            if start and tag is not None and tag == self._validator:
                self._skip = start  # the same file from a server without ranges
            elif start:
                self._restart(keep_answer=True)
        self._validator = validator or self._validator

    def _restart(self, keep_answer: bool = False) -> None:
        """Back to byte 0. keep_answer: the answer at hand begins there."""
        self.data.clear()
        self.changes += 1
        if keep_answer and self._response is not None:
            tag = strong_etag(self._response.headers.get("ETag"))
            self._validator = tag or self._response.headers.get("Last-Modified")
        else:
            self.close()
            self._validator = self.total = None
        if self.changes > MAX_CHANGES:
            self.close()
            raise DeliveryError(f"{self.url}: began anew {self.changes} times while it was fetched")
        raise Changed


def _reason(error: BaseException) -> str:
    if isinstance(error, TimeoutError):
        return "no byte arrived for too long"
    if isinstance(error, OSError):
        return error.strerror or str(error)
    if isinstance(error, _Cut):
        return str(error)
    return f"not an HTTP answer: {one_line(str(error), SHOWN)}".rstrip(": ")


def _connect(place: _Place, until: float) -> socket.socket:
    """A connection that stands before `until`, TLS included; OSError."""
    found: queue.Queue[list[Any] | OSError] = queue.Queue()

    def resolve() -> None:
        try:
            port = place.port or (443 if place.secure else 80)
            found.put(socket.getaddrinfo(place.host, port, type=socket.SOCK_STREAM))
        except (OSError, UnicodeError) as error:  # a label too long for a name is a UnicodeError
            found.put(error if isinstance(error, OSError) else OSError(f"{place.host} is no name of a host"))

    threading.Thread(target=resolve, daemon=True).start()  # the system's resolver takes no time limit
    try:
        addresses = found.get(timeout=max(0.0, until - time.monotonic()))
    except queue.Empty:
        raise TimeoutError from None
    if isinstance(addresses, OSError):
        raise addresses
    failure: OSError = TimeoutError()
    for family, kind, protocol, _, address in addresses:
        left = until - time.monotonic()
        if left <= 0:
            raise TimeoutError
        connection = socket.socket(family, kind, protocol)
        try:
            connection.settimeout(left)
            connection.connect(address)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if place.secure:
                connection.settimeout(max(1e-3, until - time.monotonic()))
                return ssl.create_default_context().wrap_socket(connection, server_hostname=place.host)
            return connection
        except OSError as error:
            connection.close()
            if isinstance(error, ssl.SSLError):
                raise
            failure = error
    raise failure
