"""The resuming client: whatever the server does, only complete slices of one file are yielded."""

import http.client
import math
import random
import shutil
import ssl
import struct
import subprocess
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from urllib.parse import urlsplit

import pytest
from faulty import Fault, FaultyServer
from strategies import assert_same_scene, flipped, small_file
from vectors.blocks import read_file

from pd4dgs_codec import decode, encode, open_stream
from pd4dgs_codec.errors import (
    BadSignature,
    ChecksumMismatch,
    DeliveryError,
    LimitExceeded,
    Malformed,
    Pd4Error,
    Truncated,
)
from pd4dgs_codec.format import canonical
from pd4dgs_codec.format.container import read_preamble, write_preamble
from pd4dgs_codec.format.header import scene_id_of
from pd4dgs_codec.scene import Scene
from pd4dgs_codec.web.client import MAX_CHANGES, SceneClient, Transfer, fetch, slice_ends
from pd4dgs_codec.web.server import Link, Server

SAME, WEAK = {"ETag": '"same"'}, {"ETag": 'W/"a"'}
#: `decode`, once for all tests that compare with a scene.
decoded = cache(decode)


class File:
    """A file of three layers; `other` is the same scene with coarser steps, which may replace it on the server."""

    def __init__(self, data: bytes):
        self.data = data
        self.other = encode(decode(data), effort=1, step_scale=1.25, verify=False)
        self.ends = [end for _, end in slice_ends(data)]
        self.middle = (self.ends[0] + self.ends[1]) // 2

    def levels(self, data: bytes | None = None, size: float = math.inf) -> list[Scene]:
        """The scenes of the prefixes that end within `size` bytes."""
        data = self.data if data is None else data
        return [decoded(data, max_layer=layer) for layer, end in slice_ends(data) if end <= size]

    def damaged(self, layer: int) -> bytes:
        """One bit of the layer differs."""
        return flipped(self.data, self.ends[layer] - 30)


@pytest.fixture(scope="module")
def file(scene_bytes) -> File:
    return File(scene_bytes)


@pytest.fixture(scope="module")
def levels(file):
    return file.levels()


def check(scenes, levels):
    assert [scene.layers for scene in scenes] == [level.layers for level in levels]
    for scene, level in zip(scenes, levels, strict=True):
        assert_same_scene(scene, level)


# -- a table of faults -------------------------------------------------------------------------------------------------


@dataclass
class Case:
    """The server's faults, one per request, and its content and options; what the client yields, and the error that
    ends it, the changes of the file and the requests that it counts."""

    faults: Callable[[File], list[Fault]] = lambda f: []
    shown: Callable[[File], list[Scene]] = File.levels
    content: Callable[[File], bytes] = lambda f: f.data
    server: dict[str, bool] = field(default_factory=dict)
    error: type[Pd4Error] | None = None
    says: str = ""
    changes: int = 0
    requests: int | None = None


def becomes(content: bytes) -> Callable[[FaultyServer], None]:
    return lambda server: setattr(server, "content", content)


def each_in_turn(f: File) -> list[Scene]:
    contents = [(f.data, f.other)[i % 2] for i in range(MAX_CHANGES + 1)]
    return [scene for content in contents for scene in f.levels(content, f.middle)]


def alternate(f: File) -> Callable[[FaultyServer], None]:
    return lambda server: setattr(server, "content", f.other if server.content == f.data else f.data)


NONE: Callable[[File], list[Scene]] = lambda f: []  # noqa: E731
BEFORE: Callable[[File], list[Scene]] = lambda f: f.levels(size=f.middle)  # noqa: E731
BOTH: Callable[[File], list[Scene]] = lambda f: BEFORE(f) + f.levels(f.other)  # noqa: E731
NO_CONDITION = {"heeds_if_range": False}
CASES = {
    "nothing": Case(requests=1),
    "bytes behind the file": Case(content=lambda f: f.data + b"more", requests=1),
    "silence": Case(lambda f: [Fault(f.middle, "stall")], requests=2),
    "closed": Case(lambda f: [Fault(f.middle)], requests=2),
    "reset": Case(lambda f: [Fault(f.middle, "reset")], requests=2),
    "three resets and a silence": Case(lambda f: [*[Fault(999, "reset")] * 3, Fault(9, "stall")], requests=5),
    "no ranges": Case(lambda f: [Fault(f.middle), Fault(10)], server={"ranges": False}, requests=3),
    "no validator": Case(lambda f: [Fault(f.middle)], server={"etag": False}, requests=2),
    "no ranges, no validator": Case(
        lambda f: [Fault(f.middle), Fault(10)], server={"ranges": False, "etag": False}, requests=3
    ),
    "a weak tag": Case(lambda f: [Fault(f.middle, headers=WEAK), Fault(headers=WEAK)], requests=2),
    "another weak tag": Case(
        lambda f: [Fault(f.middle, headers=WEAK, then=becomes(f.other)), Fault(headers={"ETag": 'W/"b"'})],
        BOTH,
        changes=1,
    ),
    "another file, no validator": Case(
        lambda f: [Fault(f.middle, then=becomes(f.other))], BOTH, server={"etag": False}, changes=1
    ),
    "another file, no validator, no ranges": Case(
        lambda f: [Fault(f.middle, then=becomes(f.other))], BOTH, server={"etag": False, "ranges": False}, changes=1
    ),
    "a part of a file of unknown length": Case(
        lambda f: [Fault(600), Fault(headers={"Content-Range": f"bytes 600-{len(f.data) - 1}/*"})], requests=2
    ),
    "a length beyond the file": Case(
        lambda f: [Fault(len(f.data), headers={"Content-Length": str(len(f.data) + 9)})], requests=1
    ),
    "another file": Case(lambda f: [Fault(f.middle, then=becomes(f.other))], BOTH, changes=1, requests=2),
    "another file, no ranges": Case(
        lambda f: [Fault(f.middle, then=becomes(f.other))], BOTH, server={"ranges": False}, changes=1
    ),
    "a shorter file": Case(
        lambda f: [Fault(len(f.data) - 5, headers=SAME, then=becomes(f.other))],
        lambda f: f.levels()[:2] + f.levels(f.other),
        server=NO_CONDITION,
        changes=1,
        requests=3,  # cut, 416, the new file
    ),
    "a part of another file": Case(lambda f: [Fault(600), Fault(headers={"ETag": '"other"'})], changes=1),
    "another file every time": Case(
        lambda f: [Fault(f.middle, then=alternate(f))] * (MAX_CHANGES + 2),
        each_in_turn,
        error=DeliveryError,
        says="changed 5 times",
        changes=MAX_CHANGES + 1,
    ),
    "compressed": Case(lambda f: [Fault(headers={"Content-Encoding": "gzip"})], NONE, error=DeliveryError, says="gzip"),
    "a page": Case(shown=NONE, content=lambda f: b"<html>not found</html>", error=BadSignature, requests=1),
    "a short file": Case(shown=BEFORE, content=lambda f: f.data[: f.middle], error=Truncated),
    **{f"{n} bytes": Case(shown=NONE, content=lambda f, n=n: f.data[:n], error=Truncated) for n in (0, 5, 100)},
    **{
        f"layer {n} damaged on the way": Case(
            lambda f: [Fault(headers=SAME, then=becomes(f.data)), Fault(headers=SAME)],
            content=lambda f, n=n: f.damaged(n),
            server=NO_CONDITION,
            requests=2,
        )
        for n in range(3)
    },
    **{
        f"layer {n} damaged in the file": Case(
            shown=lambda f, n=n: f.levels()[:n], content=lambda f, n=n: f.damaged(n), error=ChecksumMismatch, requests=2
        )
        for n in range(3)
    },
    "layer 1 damaged in the file, no validator": Case(
        shown=lambda f: f.levels()[:1],
        content=lambda f: f.damaged(1),
        server={"etag": False},
        error=ChecksumMismatch,
        requests=2,
    ),
    **{
        f"Content-Range {value}": Case(
            lambda f, value=value: [Fault(600), Fault(headers={"Content-Range": value, "Connection": "close"})],
            requests=3,
        )
        for value in ("bytes 0-9/99999", None, "bytes 9-5/3", "bytes 601-700/*")
    },
    **{f"{n} once": Case(lambda f, n=n: [Fault(status=n)], requests=2) for n in (408, 429, 500, 502, 503, 504)},
    **{
        f"{n}": Case(lambda f, n=n: [Fault(status=n)], NONE, error=DeliveryError, says=f"answered {n}", requests=1)
        for n in (400, 401, 403, 404, 410, 501)
    },
}


@pytest.mark.parametrize("name", CASES)
def test_scenes_are_those_of_the_file_whatever_the_server_does(file, name):
    case = CASES[name]
    error: Pd4Error | None = None
    shown: list[Scene] = []
    with FaultyServer(case.content(file), case.faults(file), **case.server) as server:
        with SceneClient(server.url, stall=0.3) as client:
            try:
                shown.extend(client.scenes())
            except Pd4Error as caught:
                error = caught
    assert type(error) is (case.error or type(None)) and case.says in str(error), error
    check(shown, case.shown(file))
    assert client.transfer.changes == case.changes
    assert case.requests in (None, len(server.requests))
    if name == "layer 1 damaged on the way":  # valid bytes are not requested again
        assert server.requests[1]["range"] == f"bytes={file.ends[0]}-{file.ends[2] - 1}"


# -- requests ----------------------------------------------------------------------------------------------------------


def test_layers_appear_before_the_file_is_whole_and_each_end_is_a_cut(scene_bytes, levels):
    ends = [end for _, end in slice_ends(scene_bytes)]
    faults = [Fault(ends[0], "stall"), Fault(ends[1] - ends[0], "stall", then=lambda server: server.stopped.clear())]
    with FaultyServer(scene_bytes, faults) as server, SceneClient(server.url) as client:
        shown = []
        for scene in client.scenes():
            shown.append(scene)
            server.stopped.set()  # the connection was silent until this layer had come; now it ends
        check(shown, levels)
    ranges = [None, f"bytes={ends[0]}-{ends[2] - 1}", f"bytes={ends[1]}-{ends[2] - 1}"]
    assert [r.get("range") for r in server.requests] == ranges and server.sent == ends[2]
    assert ["if-range" in r for r in server.requests] == [False, True, True]


def test_upgrades_fetch_the_missing_layers_only(scene_bytes, levels):
    with FaultyServer(scene_bytes) as server, SceneClient(server.url) as client:
        check(list(client.scenes(max_layer=0)), levels[:1])
        check(list(client.scenes(max_layer=0)), [])
        check(list(client.scenes(max_layer=2)), levels[1:])
    ends = [end for _, end in slice_ends(scene_bytes)]
    assert [r.get("range") for r in server.requests] == [None, f"bytes={ends[0]}-{ends[2] - 1}"]
    assert server.requests[0]["accept-encoding"] == "identity"


def test_redirects_are_followed(scene_bytes, levels):
    """A relative one starts from the server that gave it."""
    with FaultyServer(scene_bytes, [Fault(status=302, headers={"Location": "scene.pd4"})]) as second:
        with FaultyServer(b"", [Fault(status=301, headers={"Location": second.url})]) as first:
            with SceneClient(first.url) as client:
                check(list(client.scenes()), levels)
    assert (len(first.requests), len(second.requests)) == (1, 2)


@pytest.mark.parametrize(
    ("location", "says"),
    [
        ("/scene.pd4", "more than 5 redirects"),
        ("http://", "more than 5 redirects"),
        (None, "without a Location"),
        ("http://[::1", "expected http"),
        ("file:///etc/passwd", "expected http"),
        ("http://a:99999/", "expected http"),
        ("http://user:password@a/", "expected http"),
    ],
)
def test_redirects_to_no_file(location, says):
    faults = [Fault(status=301, headers={"Location": location})] * 9
    with FaultyServer(b"", faults) as server, SceneClient(server.url) as client:
        with pytest.raises(DeliveryError) as caught:
            list(client.scenes())
    assert says in str(caught.value) and server.url in str(caught.value)


def test_nobody_there_is_one_clear_line():
    with FaultyServer(b"") as server:
        url = server.url
    for name in (url, "http://no-such-host.invalid/x"):
        with pytest.raises(DeliveryError) as told:
            list(SceneClient(name, attempts=2).scenes())
        assert str(told.value).startswith(name) and "\n" not in str(told.value)


def test_https_with_certificates_checked(folder, tmp_path, monkeypatch, levels):
    openssl = shutil.which("openssl")
    if openssl is None:
        pytest.skip("no openssl to make a certificate with")
    key, certificate = tmp_path / "key.pem", tmp_path / "certificate.pem"
    subject = ["-subj", "/CN=localhost", "-addext", "subjectAltName=IP:127.0.0.1"]
    kind = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-days", "2"]
    command = [openssl, "req", "-x509", *kind, *subject, "-keyout", str(key), "-out", str(certificate)]
    subprocess.run(command, check=True, capture_output=True)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate, key)
    server = Server(folder)
    server.socket = context.wrap_socket(server.socket, server_side=True)
    with server, server.running():
        url = server.url_of("scene.pd4").replace("http:", "https:")
        with SceneClient(url) as client, pytest.raises(DeliveryError, match="certificate verify failed"):
            list(client.scenes())
        assert client.transfer.cuts == 1  # nothing that asking again would change
        monkeypatch.setenv("SSL_CERT_FILE", str(certificate))
        with SceneClient(url) as client:
            check(list(client.scenes(max_layer=0)) + list(client.scenes()), levels)


@pytest.mark.parametrize("url", ["ftp://host/x", "http://", "http:///x", "http://user@host/x", "http://h:99999/x", "x"])
def test_urls_that_cannot_be_fetched(url):
    with pytest.raises(DeliveryError, match="expected http"):
        SceneClient(url)


@pytest.mark.parametrize(("limits", "expected"), [({"max_bytes": 999_999}, 3), ({"max_bytes": 600}, 0)])
def test_no_slice_ends_beyond_the_bytes_that_are_asked_for(scene_bytes, levels, limits, expected):
    with FaultyServer(scene_bytes) as server, SceneClient(server.url) as client:
        check(list(client.scenes(**limits)), levels[:expected])
        check(list(client.scenes(max_bytes=slice_ends(scene_bytes)[1][1])), levels[expected:2])


@pytest.mark.parametrize("cuts", [20, pytest.param(1000, marks=pytest.mark.slow)])
def test_random_cuts_give_the_same_scenes(file, cuts):
    rng, made, expected = random.Random(4), 0, file.levels()
    while made < cuts:
        faults = [Fault(rng.randint(1, len(file.data) // 11), rng.choice(("close", "reset"))) for _ in range(10)]
        with FaultyServer(file.data, faults) as server, SceneClient(server.url) as client:
            shown = list(client.scenes())
        check(shown, expected)
        made += client.transfer.cuts


def promising(*sizes: int) -> bytes:
    """The header of a file of such chunks, and the head of the first of them."""
    header = canonical.pack(
        {**read_file(small_file()).header, 1: [[0 if i == 0 else 9, size] for i, size in enumerate(sizes)]}
    )
    return write_preamble(header) + struct.pack("<HHI8s", 0, 0, sizes[0], scene_id_of(header))


@pytest.mark.parametrize("sizes", [[(1 << 31) - 1] * 1001, [1 << 28], [(1 << 28) - 100]])
def test_a_header_that_promises_much_is_refused_before_its_bytes_arrive(monkeypatch, sizes):
    """1,001 chunks of 2 GiB and an endless body once held 3.9 GB after 20 seconds."""
    transfer = Transfer("http://nowhere.example/x.pd4")
    body = promising(*sizes) + bytes(1 << 20)

    def read(end=None, **_):
        block = body[len(transfer.data) : end][: 1 << 14]
        transfer.data += block
        assert len(transfer.data) < len(body)
        return block

    monkeypatch.setattr(transfer, "read", read)
    with pytest.raises(LimitExceeded, match="limit 268,435,456"):
        fetch(transfer)
    client = SceneClient("http://nowhere.example/x.pd4")
    client.transfer = transfer
    transfer.data.clear()
    with pytest.raises(LimitExceeded, match="limit 268,435,456"):
        list(client.scenes())


def test_the_header_says_where_a_file_ends(scene_bytes):
    """Not the server, which may tell the length of something else."""
    beyond = {"Content-Length": str(len(scene_bytes) + 9)}
    with FaultyServer(scene_bytes, [Fault(len(scene_bytes), headers=beyond)]) as server:
        assert fetch(Transfer(server.url)) == scene_bytes and len(server.requests) == 1


@pytest.mark.parametrize("max_layer", [None, 0])
def test_files_and_prefixes_may_end_at_the_limit_but_not_behind_it(scene_bytes, monkeypatch, max_layer):
    end = len(scene_bytes) if max_layer is None else slice_ends(scene_bytes)[0][1]
    with FaultyServer(scene_bytes) as server:
        monkeypatch.setattr("pd4dgs_codec.web.client.MOST_BYTES", end)
        assert fetch(Transfer(server.url), max_layer) == scene_bytes[:end]
        if max_layer is None:  # as much of a longer one is held, and no byte more
            server.content += b"more"
            assert fetch(Transfer(server.url)) == scene_bytes
        monkeypatch.setattr("pd4dgs_codec.web.client.MOST_BYTES", end - 1)
        with pytest.raises(LimitExceeded, match=f"ends at byte {end:,}"):
            fetch(Transfer(server.url), max_layer)


def test_a_frame_that_differs_from_the_list_is_refused_as_soon_as_it_is_there(scene_bytes):
    """Before the bytes of the chunk that it announces."""
    start = read_preamble(scene_bytes).size
    lying = scene_bytes[: start + 4] + struct.pack("<I", 5) + scene_bytes[start + 8 : start + 16]
    stream = open_stream()
    with pytest.raises(Malformed, match="payload length 5"):
        stream.feed(lying)


@pytest.mark.parametrize(
    "address", ["http://[::1]/x", "https://[::1]/x", "http://[2001:db8::2]/x", "http://[::1]:81/x"]
)
def test_an_ipv6_address_needs_no_port(monkeypatch, address):
    seen = []
    monkeypatch.setattr(
        http.client.HTTPConnection, "connect", lambda self: seen.append((self.host, self.port)) or 1 / 0
    )
    with pytest.raises(ZeroDivisionError):
        Transfer(address).read(5)
    parts = urlsplit(address)
    assert seen == [(parts.hostname, parts.port or {"http": 80, "https": 443}[parts.scheme])]


@pytest.mark.parametrize("clients", [4, pytest.param(64, marks=pytest.mark.slow)])
def test_many_clients_at_once_get_every_byte(folder, scene_bytes, clients):
    results: list[tuple[bytes, int]] = []
    with Server(folder, link=Link(200e6)) as server, server.running():

        def fetch() -> None:
            transfer = Transfer(server.url_of("scene.pd4"))
            while transfer.read():
                pass
            results.append((bytes(transfer.data), transfer.cuts))
            transfer.close()

        threads = [threading.Thread(target=fetch) for _ in range(clients)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert results == [(scene_bytes, 0)] * clients
