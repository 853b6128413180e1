"""Whatever a server answers instead of the file, the client ends in time, with scenes or with an error of one line."""

import contextlib
import random
import socket
import threading
import time
from collections.abc import Callable, Iterator

import pytest

from pd4dgs_codec.errors import DeliveryError, Pd4Error
from pd4dgs_codec.web.client import SceneClient

FILE = bytes(range(256)) * 4


@contextlib.contextmanager
def answering(talk: Callable[[socket.socket], None]) -> Iterator[str]:
    """The URL of a server that reads a request and then talks as told, on every connection."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        ended = threading.Event()

        def serve() -> None:
            while not ended.is_set():
                with contextlib.suppress(OSError):
                    connection, _ = server.accept()
                    with connection, contextlib.suppress(OSError):
                        connection.recv(1 << 16)
                        talk(connection)

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{server.getsockname()[1]}/scene.pd4"
        ended.set()
        with contextlib.suppress(OSError), socket.create_connection(server.getsockname()):
            pass


def drip(data: bytes) -> Callable[[socket.socket], None]:
    """A byte every 20 ms: never silent, never done."""

    def talk(connection: socket.socket) -> None:
        for byte in data:
            connection.sendall(bytes([byte]))
            time.sleep(0.02)

    return talk


DRIPPED = {
    "the header": b"HTTP/1.1 200 OK\r\n" + b"X-Filler: 1\r\n" * 1000,
    "one endless line": b"HTTP/1.1 200 " + b"O" * 20_000,
    "hundreds of provisional answers": b"HTTP/1.1 100 Continue\r\n\r\n" * 1000,
    "the length of a chunk": b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n" + b"0" * 20_000,
}


@pytest.mark.parametrize("what", DRIPPED)
def test_a_server_that_drips_is_left(what):
    """It counts as silent. The answer would take minutes."""
    with answering(drip(DRIPPED[what])) as url:
        start = time.monotonic()
        with SceneClient(url, stall=0.2, attempts=2) as client:
            with pytest.raises(DeliveryError, match="timed out waiting for data"):
                list(client.scenes())
        assert time.monotonic() - start < 20


def test_chunks_of_a_byte_take_no_thread_each(scene_bytes, monkeypatch):
    """55 kB of them once took 15 seconds of CPU."""
    started: list[object] = []
    start = threading.Thread.start
    body = b"".join(b"1\r\n%c\r\n" % byte for byte in scene_bytes) + b"0\r\n\r\n"
    reply = b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n" + body
    with answering(lambda c: c.sendall(reply)) as url, SceneClient(url, attempts=1) as client:
        monkeypatch.setattr(threading.Thread, "start", lambda thread: (started.append(thread), start(thread)))
        assert [scene.layers for scene in client.scenes()][-1] == (0, 1, 2)
    assert len(started) == 1  # it connects


@pytest.mark.parametrize("reply", [b"SSH-2.0\r\n", b"HTTP/1.1 404 \x1b[2Jgone\r\n\r\n", b"\x00" * 99, b"A" * 100_000])
def test_answers_of_other_protocols_are_one_plain_line(reply):
    with answering(lambda c: c.sendall(reply)) as url, SceneClient(url, attempts=1) as client:
        with pytest.raises(DeliveryError) as caught:
            list(client.scenes())
    assert str(caught.value).isprintable() and len(str(caught.value)) < 250


# -- replies at random -------------------------------------------------------------------------------------------------

STATUS = [
    *(b"HTTP/1.1 " + rest for rest in (b"200 OK", b"206 Partial Content", b"416 No", b"302 Found", b"503 Busy")),
    *(b"HTTP/1.1 " + rest for rest in (b"-1 x", b"99999 x", b"204 None", b"100 Continue", b"304 Same")),
    *(b"HTTP/1.0 200 OK", b"HTTP/9.9 200 OK", b"ICY 200 OK", b"", b"\xff\xfe"),
]
HEADERS = [
    *(b"Content-Length: " + value for value in (b"%d" % len(FILE), b"-1", b"1e3", b"9" * 5000)),
    *(b"Content-Range: bytes " + value for value in (b"0-1023/1024", b"5-1/1024", b"*/*", b"0-%s/9" % (b"9" * 300))),
    *(b"Location: " + value for value in (b"http://[::1", b"/b", b"http://\xff", b"//", b"http://a:b/")),
    *(b"Transfer-Encoding: chunked", b"Transfer-Encoding: gzip, chunked", b"Content-Encoding: gzip"),
    *(b'ETag: "a"', b"ETag: W/a", b"ETag: \xe9\x00", b"Last-Modified: never", b"Connection: close"),
    *(b": ", b"a" * 70_000, b" folded: x", b"X: \x00\x0b\x1c"),
]
BODIES = [FILE, b"", b"5\r\nabcde\r\n0\r\n\r\n", b"-5\r\n", b"fffffffffffffffff\r\nx", b"5;x=y\r\nabc", b"\x89PD4" * 9]


def reply_at_random(rng: random.Random) -> bytes:
    """An answer put together from odd parts, then perhaps cut, or with bytes of it changed."""
    lines = [rng.choice(STATUS), *rng.choices(HEADERS, k=rng.randrange(5))]
    data = bytearray(rng.choice([b"\r\n", b"\r\n", b"\n"]).join(lines) + b"\r\n\r\n" + rng.choice(BODIES))
    if rng.random() < 0.3:
        del data[rng.randrange(len(data) + 1) :]
    for _ in range(rng.choice([0, 0, 1, 4])):
        if data:
            data[rng.randrange(len(data))] = rng.randrange(256)
    return bytes(data)


@pytest.mark.parametrize(
    ("seed", "count"), [(1, 300), *(pytest.param(seed, 1000, marks=pytest.mark.slow) for seed in range(2, 12))]
)
def test_replies_at_random_end_with_the_file_or_an_error_of_one_line(seed, count, monkeypatch):
    rng = random.Random(seed)
    replies: list[bytes] = []
    monkeypatch.setattr("pd4dgs_codec.web.client.BACKOFF_SECONDS", 0.0)
    with answering(lambda c: c.sendall(replies.pop()) if replies else None) as url:
        for i in range(count):
            replies[:] = given = [reply_at_random(rng) for _ in range(3)]
            with SceneClient(url, attempts=2, stall=0.2) as client:
                try:
                    list(client.scenes())
                except Pd4Error as error:
                    assert str(error).isprintable(), (seed, i, str(error))
                except Exception as error:
                    raise AssertionError(f"seed {seed}, case {i}: {error!r} from {given}") from error
