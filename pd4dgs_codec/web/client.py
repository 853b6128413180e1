"""Fetches `.pd4` files from web servers: whole files, prefixes, and scenes while their slices arrive.

Bytes that have arrived are never requested again unless the file changes. HTTP comes from the standard library.
Connections are direct (no proxies), stay open between requests, and follow redirects.
"""

from __future__ import annotations

import contextlib
import http.client
import io
import math
import socket
import ssl
import threading
import time
from collections.abc import Callable, Iterator
from concurrent import futures
from functools import partial
from http import HTTPStatus
from typing import Any
from urllib.parse import SplitResult, quote, urljoin, urlsplit

from pd4dgs_codec.errors import (
    BadSignature,
    DecodeError,
    DeliveryError,
    LimitExceeded,
    Truncated,
    UnsupportedVersion,
    one_line,
)
from pd4dgs_codec.format.container import PREAMBLE_SIZE, read_preamble
from pd4dgs_codec.format.decoder import open_stream
from pd4dgs_codec.format.info import info
from pd4dgs_codec.format.registry import MAX_HEADER
from pd4dgs_codec.kinds import AnyScene
from pd4dgs_codec.web import is_url
from pd4dgs_codec.web.headers import content_range, strong_etag

BLOCK = 1 << 16
MAX_REDIRECTS = 5
#: A transfer fails if the file changes more often than this.
MAX_CHANGES = 4
BACKOFF_SECONDS = 0.2
#: Temporary errors; all others are final.
TEMPORARY = {408, 425, 429, 500, 502, 503, 504}
REDIRECTS = {301, 302, 303, 307, 308}
#: Characters of a server's text that an error message quotes.
SHOWN = 80
#: Bytes of the first request for a prefix. Most headers have some 300; a longer one costs a second request.
HEADER_GUESS = 512
LONGEST_HEADER = PREAMBLE_SIZE + MAX_HEADER
#: Limit of the bytes fetched if no budget is given: a header of a few bytes may promise terabytes.
MOST_BYTES = 1 << 28


class Changed(Exception):
    """The file has changed: its earlier bytes are discarded, and the transfer restarts at byte 0."""


class _Cut(Exception):
    """The connection ended early, or the response is invalid: a new request may help."""


class _Reader(io.RawIOBase):
    """Reads a response until a time.monotonic() that `until` gives: a socket limits the time of each read alone, and a
    line may take many. raw: what it reads from, whose socket is `sock`."""

    def __init__(self, raw: io.RawIOBase, sock: socket.socket, until: Callable[[], float]):
        self._raw, self._sock, self._until = raw, sock, until

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int | None:
        left = self._until() - time.monotonic()
        if left <= 0:
            raise TimeoutError
        self._sock.settimeout(left)
        return self._raw.readinto(buffer)

    def close(self) -> None:
        self._raw.close()
        super().close()


class _Response(http.client.HTTPResponse):
    """A response with time limits, see _Reader."""

    def __init__(self, sock: socket.socket, *args: Any, until: Callable[[], float], **options: Any):
        super().__init__(sock, *args, **options)
        self.fp: Any = io.BufferedReader(_Reader(self.fp.detach(), sock, until))


class Transfer:
    """Fetches one URL from byte 0 up to the requested offset, and resumes after interruptions.

    data: bytes from byte 0 on that have arrived. total: length of the file, None until known. stall: seconds without a
    complete response header, or a further byte of the body, after which a connection counts as interrupted. attempts:
    failures without a byte between them after which it gives up. requests, cuts (interruptions), changes: counts.
    """

    def __init__(self, url: str, *, stall: float = 10.0, attempts: int = 5):
        self.url, self.stall, self.attempts = url, stall, attempts
        self.data = bytearray()
        self.total: int | None = None
        self.requests = self.cuts = self.changes = 0
        self._home = self._place = _parsed(url)
        self._tag: str | None = None  # the file's ETag and date
        self._date: str | None = None
        self._connection: http.client.HTTPConnection | None = None
        self._until = math.inf  # until when the connection may be silent, time.monotonic()
        self._response: http.client.HTTPResponse | None = None
        self._at = 0  # offset in the file of the next byte of the response; bytes already in `data` are skipped
        self._response_end: int | None = None  # offset in the file where the response ends, if known

    def read(self, end: int | None = None, *, reach: int | None = None, attempts: int | None = None) -> bytes:
        """Returns the next bytes to arrive, none beyond `end` (None: the end of the file); empty if all have arrived.

        reach: offset up to which a request asks for bytes, so that later reads need no other; None: the file's end.
        attempts: in place of those of the transfer. Raises Changed, or DeliveryError if the file is not available.
        """
        failures, attempts = 0, attempts or self.attempts
        while not any(most is not None and len(self.data) >= most for most in (end, self.total)):
            try:
                if self._response is None:
                    self._request(reach)
                    continue  # the response may say that there is nothing to read
                block = self._receive(end)
            except (OSError, http.client.HTTPException, _Cut) as error:
                self.close()
                self.cuts += 1
                failures += 1
                if failures >= attempts or isinstance(error, ssl.SSLCertVerificationError):
                    message = f"{self.url}: {_reason(error)} ({len(self.data):,} bytes received)"
                    raise DeliveryError(message) from None
                if failures > 1:
                    time.sleep(BACKOFF_SECONDS * 2 ** (failures - 2))
                continue
            except DeliveryError as error:
                self.close()
                raise DeliveryError(f"{self.url}: {error}") from None
            if block:
                return block
        return b""

    def rewind(self, size: int) -> None:
        """Discards all but the first `size` bytes."""
        del self.data[size:]
        self.close()

    def close(self) -> None:
        """Closes the connection. Bytes that have arrived stay; a later read connects again."""
        if self._response is not None:
            self._response.close()
        if self._connection is not None:
            self._connection.close()
        self._connection = self._response = None
        self._place = self._home

    def _receive(self, end: int | None) -> bytes:
        """Reads a block of the response; returns b"" at its regular end and for bytes that are skipped."""
        response, skipped = self._response, len(self.data) - self._at
        assert response is not None
        limits = [BLOCK]
        if skipped:
            limits.append(skipped)
        elif end is not None:
            limits.append(end - self._at)
        if self._response_end is not None:
            limits.append(self._response_end - self._at)
        self._until = time.monotonic() + self.stall
        block = response.read1(min(limits))
        self._at += len(block)
        if not skipped:
            self.data += block
        if self._at == self._response_end:
            response.close()  # it is read completely, so the connection can be used again
            self._response = None
        elif not block:
            if skipped or self._response_end is not None:
                raise _Cut(f"the connection closed early, at byte {self._at:,}")
            self._response, self.total = None, self._at  # of unknown length: it ends with the connection
        return b"" if skipped else block

    # -- requests ------------------------------------------------------------------------------------------------------

    def _request(self, reach: int | None) -> None:
        start = len(self.data)
        headers = {"Accept-Encoding": "identity", "User-Agent": "pd4dgs"}
        if start or reach is not None:
            headers["Range"] = f"bytes={start}-" + ("" if reach is None else str(reach - 1))
        if start and (validator := strong_etag(self._tag) or self._date):
            headers["If-Range"] = validator
        for _ in range(MAX_REDIRECTS + 1):
            response = self._send(headers)
            if response.status not in REDIRECTS:
                self._accept(response, start, "Range" in headers)
                return
            here, target = self._place.geturl(), response.headers.get("Location")
            self.close()
            if target is None:
                raise DeliveryError("found a redirect without a Location")
            self._place = _parsed(target, here)
        raise DeliveryError(f"found more than {MAX_REDIRECTS} redirects")

    def _send(self, headers: dict[str, str]) -> http.client.HTTPResponse:
        """Sends a request. The time limit covers name resolution, connection, TLS and all headers of the response."""
        if self._connection is None:
            secure = self._place.scheme == "https"
            kind = http.client.HTTPSConnection if secure else http.client.HTTPConnection
            port = self._place.port or kind.default_port  # HTTPConnection would seek one in an IPv6 address
            self._connection = kind(str(self._place.hostname), port, timeout=self.stall)
            until = partial(_Response, until=lambda: self._until)
            self._connection.response_class = until  # type: ignore[assignment]
        connection = self._connection
        self.requests += 1
        self._until = time.monotonic() + self.stall
        if connection.sock is None:  # new, or closed by the server after its last response
            _connect(connection, self.stall)
        connection.sock.settimeout(self.stall)
        connection.request("GET", _target(self._place), headers=headers)
        return connection.getresponse()

    def _accept(self, response: http.client.HTTPResponse, start: int, asked_range: bool) -> None:
        """Checks a response for bytes from `start` on. Raises Changed if the file is no longer the same."""
        status, part = response.status, content_range(response.headers.get("Content-Range"))
        if status == HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE and asked_range:
            if start:
                self._restart()  # the file is now shorter than the bytes that have arrived
            self.close()
            self.total = 0
            return
        if status not in (HTTPStatus.OK, HTTPStatus.PARTIAL_CONTENT):
            said = f"the server answered {status} {one_line(response.reason, SHOWN)}".rstrip()
            raise (_Cut if status in TEMPORARY else DeliveryError)(said)
        coding = response.headers.get("Content-Encoding", "identity")
        if coding.lower() != "identity":
            raise DeliveryError(f"found Content-Encoding {one_line(coding, SHOWN)}, expected identity")
        tag, date = response.headers.get("ETag"), response.headers.get("Last-Modified")
        # what is not known of both answers does not differ; if the bytes do, the slices' checksums tell
        same = [(tag.removeprefix("W/"), self._tag.removeprefix("W/"))] if tag and self._tag else [(date, self._date)]
        self._response, self._at = response, start
        if status == HTTPStatus.PARTIAL_CONTENT:
            if not asked_range or part is None or part[0] != start:
                found = one_line(response.headers.get("Content-Range") or "none", SHOWN)
                raise _Cut(f"found Content-Range {found}, expected bytes from {start}")
            _, self._response_end, total = part
        else:
            self._response_end = total = response.length
            self._at = 0  # a server without ranges sends all of it
        changed = start > 0 and any(None not in pair and pair[0] != pair[1] for pair in (*same, (total, self.total)))
        self.total = self.total if total is None and not changed else total
        self._tag, self._date = (tag, date) if changed else (tag or self._tag, date or self._date)
        if changed:
            self._restart(keep_response=self._at == 0)

    def _restart(self, keep_response: bool = False) -> None:
        """Restarts at byte 0 and raises Changed. keep_response: the response begins at byte 0."""
        self.data.clear()
        self.changes += 1
        if not keep_response:
            self.close()
            self.total = self._tag = self._date = None
        if self.changes > MAX_CHANGES:
            raise DeliveryError(f"the file changed {self.changes} times during the transfer")
        raise Changed


def _connect(connection: http.client.HTTPConnection, seconds: float) -> None:
    """Connects in a thread, since the system's resolver has no time limit. Raises TimeoutError after `seconds`."""
    result: futures.Future[None] = futures.Future()

    def run() -> None:
        try:
            connection.connect()
            result.set_result(None)
        except UnicodeError:  # a label too long for a host name
            result.set_exception(OSError(f"{connection.host} is not a host name"))
        except BaseException as error:
            result.set_exception(error)

    threading.Thread(target=run, daemon=True).start()
    try:
        result.result(timeout=seconds)
    except futures.TimeoutError:
        result.add_done_callback(lambda _: connection.close())
        raise TimeoutError from None


def _parsed(url: str, base: str = "") -> SplitResult:
    """Splits an HTTP address, which may be relative to `base`. Raises DeliveryError if it cannot be fetched."""
    with contextlib.suppress(ValueError):
        parts = urlsplit(urljoin(base, url))
        if is_url(parts.geturl()) and parts.hostname and "@" not in parts.netloc and parts.port != 0:
            return parts
    raise DeliveryError(f"found {url!r}, expected http://HOST/PATH or https://HOST/PATH")


def _target(place: SplitResult) -> str:
    query = f"?{quote(place.query, safe='/%:=&?~+!$,;@()*')}" if place.query else ""
    return quote(place.path or "/", safe="/%:=&~+!$,;'@()*") + query


def _reason(error: BaseException) -> str:
    if isinstance(error, TimeoutError):
        return "timed out waiting for data"
    if isinstance(error, OSError):
        return error.strerror or one_line(str(error), SHOWN)
    if isinstance(error, _Cut):
        return str(error)
    return f"invalid HTTP response: {one_line(str(error), SHOWN)}".rstrip(": ")


# -- prefixes of a .pd4 file -------------------------------------------------------------------------------------------


def described(data: bytes | bytearray) -> dict[str, Any] | None:
    """The `info` of a file by its header alone; None if `data`, its first bytes, ends within it."""
    try:
        return info(bytes(data[: read_preamble(data).size]))
    except Truncated:
        return None


def slice_ends(data: bytes | bytearray) -> list[tuple[int, int]]:
    """Reads (layer, end offset) of each slice in file order from a file's first bytes; empty if they end within the
    header."""
    about = described(data)
    return [(row["layer"], part["end"]) for row in about["layers"] for part in row["slices"]] if about else []


def prefix_end(slices: list[tuple[int, int]], max_layer: int | None = None, max_bytes: int | None = None) -> int:
    """Returns the end of the last slice within max_bytes that belongs to a layer up to max_layer; 0 if none does."""
    layer_limit, limit = (math.inf if most is None else most for most in (max_layer, max_bytes))
    return max((end for layer, end in slices if layer <= layer_limit and end <= limit), default=0)


def check_end(end: int) -> None:
    """Raises LimitExceeded if a file, or the requested prefix of it, ends beyond MOST_BYTES."""
    if end > MOST_BYTES:
        raise LimitExceeded(f"ends at byte {end:,}, limit {MOST_BYTES:,} without a byte budget")


def fetch(transfer: Transfer, max_layer: int | None = None, max_bytes: int | None = None) -> bytes:
    """Fetches a file, or its prefix: the header, and the slices of layers up to max_layer that end within max_bytes.
    Returns fewer bytes if the remote file ends early.

    A whole file takes one request, a prefix two (three with a long header). The header says where a file ends; of what
    follows, one byte is fetched, so that the decoder sees trailing data. Raises as Transfer.read does, DecodeError for
    an invalid header, and LimitExceeded for bytes beyond MOST_BYTES without max_bytes.
    """
    whole = max_layer is None and max_bytes is None

    def fill(end: int) -> bytes:
        while transfer.read(end, reach=None if whole else end):
            pass
        return bytes(transfer.data[:end])

    while True:
        with contextlib.suppress(Changed):
            about = described(fill(HEADER_GUESS)) or described(fill(LONGEST_HEADER))
            if about is None:
                return bytes(transfer.data)
            end = about["bytes"] if whole else prefix_end(slice_ends(transfer.data), max_layer, max_bytes)
            if max_bytes is None:
                check_end(end)
            data = fill(max(end, about["header_bytes"]))
            if whole and len(data) == end:
                with contextlib.suppress(DeliveryError, Changed):  # a length that is not that of the file
                    data += transfer.read(min(end + 1, MOST_BYTES), attempts=1)
            return data


# -- scenes as slices arrive -------------------------------------------------------------------------------------------


class SceneClient:
    """Decodes the scenes of one URL as early as possible. Use it in a `with` block, or close it.

    The first request is one open-ended GET, read as it arrives. After an interruption, and for slices requested later,
    Range with If-Range fetches the missing bytes only. If the file has changed, decoding restarts with its layer 0. A
    damaged slice is fetched once more and never yielded. transfer: bytes and counts, see Transfer. arrived_at:
    time.monotonic() of the latest bytes; when a scene is yielded, of the last byte of its slice.
    """

    def __init__(self, url: str, *, stall: float = 10.0, attempts: int = 5):
        self.transfer = Transfer(url, stall=stall, attempts=attempts)
        self.arrived_at = time.monotonic()
        self._repaired_at = -1
        self._begin()

    def __enter__(self) -> SceneClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Closes the connection; `scenes` may be called again and opens another."""
        self.transfer.close()

    def scenes(self, max_layer: int | None = None, max_bytes: int | None = None) -> Iterator[AnyScene]:
        """Yields the newest scene, with all slices so far, as slices arrive. Only slices of layers up to max_layer that
        end within the first max_bytes of the file (None: MOST_BYTES) are fetched.

        A further call continues after the last slice yielded. Raises DeliveryError if the file is not available,
        DecodeError if it is invalid or its first slice ends beyond MOST_BYTES; scenes yielded before stay valid.
        """
        limits = max_layer, MOST_BYTES if max_bytes is None else max_bytes
        while True:
            while ready := self._ready(*limits):  # until empty: a fault behind a slice is raised by the next feed
                yield from ready
            have = len(self.transfer.data)
            end, reach = (HEADER_GUESS if have < HEADER_GUESS else LONGEST_HEADER), None
            if self._slices:
                if max_bytes is None:
                    check_end(self._slices[0][1])
                reach = prefix_end(self._slices, *limits)
                if have >= reach:
                    break
                end = next(end for _, end in self._slices if end > have)
            try:
                block = self.transfer.read(end, reach=reach)
            except Changed:
                self._begin()
                continue
            if not block:
                self._stream.finish()  # raises Truncated: the file ends within this slice
            self.arrived_at = time.monotonic()
        self.close()

    def _begin(self) -> None:
        self._stream, self._fed = open_stream(), 0
        self._slices: list[tuple[int, int]] = []

    def _ready(self, max_layer: int | None, max_bytes: int) -> list[AnyScene]:
        """Feeds new bytes to the decoder. After a fault the transfer goes back to the end of the last valid slice."""
        data, end = self.transfer.data, len(self.transfer.data)
        try:
            if not self._slices:
                self._slices = slice_ends(data)
            if self._slices:  # the first bytes of a small file may hold more than requested
                end = min(end, prefix_end(self._slices, max_layer, max_bytes))
            block, self._fed = bytes(data[self._fed : end]), max(self._fed, end)
            return self._stream.feed(block)
        except (BadSignature, UnsupportedVersion):
            raise  # not a transmission error
        except DecodeError:
            good = self._stream.consumed
            if self._repaired_at == good:
                raise
            self._repaired_at = self._fed = good
            self.transfer.rewind(good)
            self._stream.rewind()
            return []
