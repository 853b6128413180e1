"""The resuming client: whatever the server does, only complete slices of one file are yielded.

Cuts at random, silence, a slump of the link and files that change are cases of test_client_faults.py.
"""

from __future__ import annotations

import math
import shutil
import ssl
import subprocess
import time
from collections import deque
from types import SimpleNamespace

import pytest
from faulty import Fault, FaultyServer
from strategies import assert_same_scene, make_scene

from pd4dgs_codec import decode, encode
from pd4dgs_codec.errors import BadSignature, ChecksumMismatch, DeliveryError, Truncated
from pd4dgs_codec.web import client as client_module
from pd4dgs_codec.web.client import Budget, SceneClient, next_end, recent_rate
from pd4dgs_codec.web.server import Server
from pd4dgs_codec.web.transfer import slice_ends


@pytest.fixture(scope="module")
def levels(scene_bytes):
    """The scene of each prefix."""
    return [decode(scene_bytes, max_layer=layer) for layer in range(3)]


def check(scenes, levels):
    assert [scene.layers for scene in scenes] == [level.layers for level in levels]
    for scene, level in zip(scenes, levels, strict=True):
        assert_same_scene(scene, level)


def test_one_open_get_gives_every_layer(scene_bytes, levels):
    with FaultyServer(scene_bytes) as server, SceneClient(server.url) as client:
        check(list(client.scenes()), levels)
    assert len(server.requests) == 1 and "range" not in server.requests[0]
    assert server.requests[0]["accept-encoding"] == "identity"


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
        check(list(client.scenes(Budget(max_layer=0))), levels[:1])
        check(list(client.scenes(Budget(max_layer=0))), [])
        check(list(client.scenes(Budget(max_layer=2))), levels[1:])
    ends = [end for _, end in slice_ends(scene_bytes)]
    assert [r.get("range") for r in server.requests] == [None, f"bytes={ends[0]}-{ends[2] - 1}"]


@pytest.mark.parametrize("etag", [True, False])
def test_servers_without_ranges_or_validators(scene_bytes, levels, etag):
    faults = [Fault(len(scene_bytes) // 2), Fault(10)]
    with FaultyServer(scene_bytes, faults, ranges=False, etag=etag) as server, SceneClient(server.url) as client:
        scenes = list(client.scenes())
    check(scenes[-3:], levels)
    assert len(server.requests) == 3 and client.transfer.changes == (0 if etag else 2)


def test_a_damaged_layer_is_fetched_again_and_never_shown(scene_bytes, levels):
    ends = [end for _, end in slice_ends(scene_bytes)]
    for layer in range(3):
        damaged = bytearray(scene_bytes)
        damaged[ends[layer] - 30] ^= 1
        fault = Fault(headers={"ETag": '"same"'}, then=lambda server: setattr(server, "content", scene_bytes))
        faults = [fault, Fault(headers={"ETag": '"same"'})]
        with FaultyServer(bytes(damaged), faults) as server, SceneClient(server.url) as client:
            server.heeds_if_range = False
            check(list(client.scenes()), levels)
        with FaultyServer(bytes(damaged)) as server, SceneClient(server.url) as client:
            shown = []
            with pytest.raises(ChecksumMismatch):
                shown.extend(client.scenes())
            check(shown, levels[:layer])
            assert len(server.requests) == 2


def test_a_damaged_layer_within_the_first_block():
    data = encode(make_scene(7, anchors=6), layers=2, effort=1)
    ends = [end for _, end in slice_ends(data)]
    assert ends[-1] < 4000
    damaged = bytearray(data)
    damaged[ends[1] - 30] ^= 1
    same = {"ETag": '"same"'}
    faults = [Fault(headers=same, then=lambda server: setattr(server, "content", data)), Fault(headers=same)]
    with FaultyServer(bytes(damaged), faults) as server, SceneClient(server.url) as client:
        server.heeds_if_range = False
        check(list(client.scenes()), [decode(data, max_layer=layer) for layer in range(3)])
    assert server.requests[1]["range"] == f"bytes={ends[0]}-{ends[2] - 1}"


@pytest.mark.parametrize("status", [500, 502, 503, 504, 429, 408])
def test_passing_errors_are_asked_again(scene_bytes, levels, status):
    with FaultyServer(scene_bytes, [Fault(status=status)]) as server, SceneClient(server.url) as client:
        check(list(client.scenes()), levels)


@pytest.mark.parametrize("status", [400, 401, 403, 404, 410, 501])
def test_final_errors_are_final(scene_bytes, status):
    with FaultyServer(scene_bytes, [Fault(status=status)]) as server, SceneClient(server.url) as client:
        with pytest.raises(DeliveryError, match=f"answers {status}"):
            list(client.scenes())
    assert len(server.requests) == 1


def test_redirects_are_followed_but_not_in_circles(scene_bytes, levels):
    with FaultyServer(scene_bytes) as server:
        with FaultyServer(b"", [Fault(status=302, headers={"Location": server.url})]) as first:
            with SceneClient(first.url) as client:
                check(list(client.scenes()), levels)
        for target, says in (
            ("/scene.pd4", "redirects"),
            ("file:///etc/passwd", "expected http"),
            (None, "without a Location"),
        ):
            faults = [Fault(status=301, headers={"Location": target}) for _ in range(9)]
            with FaultyServer(b"", faults) as first, SceneClient(first.url) as client:
                with pytest.raises(DeliveryError, match=says):
                    list(client.scenes())


def test_a_relative_redirect_starts_from_where_it_was_given(scene_bytes, levels):
    with FaultyServer(scene_bytes, [Fault(status=302, headers={"Location": "scene.pd4"})]) as second:
        with FaultyServer(b"", [Fault(status=301, headers={"Location": second.url})]) as first:
            with SceneClient(first.url) as client:
                check(list(client.scenes()), levels)
    assert (len(first.requests), len(second.requests)) == (1, 2)


LIES = {
    "a part from elsewhere": {"Content-Range": "bytes 0-9/99999"},
    "no Content-Range": {"Content-Range": None},
    "a Content-Range without sense": {"Content-Range": "bytes 9-5/3"},
    "no length": {"Content-Range": "bytes 600-700/*"},
}


@pytest.mark.parametrize("lie", LIES)
def test_answers_that_make_no_sense_are_asked_again(scene_bytes, levels, lie):
    faults = [Fault(600), Fault(headers={**LIES[lie], "Connection": "close"})]
    with FaultyServer(scene_bytes, faults) as server, SceneClient(server.url) as client:
        check(list(client.scenes()), levels)
    assert len(server.requests) == 3


def test_a_part_of_another_file_is_not_appended(scene_bytes, levels):
    faults = [Fault(600), Fault(headers={"ETag": '"other"'})]
    with FaultyServer(scene_bytes, faults) as server, SceneClient(server.url) as client:
        check(list(client.scenes()), levels)
        assert client.transfer.changes == 1


def test_a_file_that_is_shorter_now_begins_anew(scene_bytes, other_bytes):
    others = [decode(other_bytes, max_layer=layer) for layer in range(3)]
    size = slice_ends(scene_bytes)[1][1]
    assert len(other_bytes) < size
    fault = Fault(size, headers={"ETag": '"same"'}, then=lambda server: setattr(server, "content", other_bytes))
    with FaultyServer(scene_bytes, [fault]) as server, SceneClient(server.url) as client:
        server.heeds_if_range = False
        shown = list(client.scenes())
    check(shown[-3:], others)
    assert len(server.requests) == 3  # cut, 416, anew


def test_compressed_bytes_are_refused(scene_bytes):
    with FaultyServer(scene_bytes, [Fault(headers={"Content-Encoding": "gzip"})]) as server:
        with SceneClient(server.url) as client, pytest.raises(DeliveryError, match="gzip"):
            list(client.scenes())


def test_other_data_and_short_files(scene_bytes, levels):
    with FaultyServer(b"<html>not found</html>") as server, SceneClient(server.url) as client:
        with pytest.raises(BadSignature):
            list(client.scenes())
    ends = [end for _, end in slice_ends(scene_bytes)]
    for size in (0, 5, 100, ends[1] + 3):
        with FaultyServer(scene_bytes[:size]) as server, SceneClient(server.url) as client:
            shown = []
            with pytest.raises(Truncated):
                for scene in client.scenes():
                    shown.append(scene)
            check(shown, levels[:2] if size > ends[1] else [])
    with FaultyServer(scene_bytes + b"more") as server, SceneClient(server.url) as client:
        check(list(client.scenes()), levels)  # a viewer does not look beyond the last layer


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
            check(list(client.scenes(Budget(max_layer=0))) + list(client.scenes()), levels)


@pytest.mark.parametrize("url", ["ftp://host/x", "http://", "http:///x", "http://user@host/x", "http://h:99999/x", "x"])
def test_urls_that_cannot_be_fetched(url):
    with pytest.raises(DeliveryError, match="expected http"):
        SceneClient(url)


def test_stop_when_the_seconds_are_over_and_go_on_later(scene_bytes, levels, monkeypatch):
    """Nearly all of a minute is over once the first layer is shown; the rest of it goes by in silence."""
    over = 0.0
    monkeypatch.setattr(client_module, "time", SimpleNamespace(monotonic=lambda: time.monotonic() + over))
    ends = [end for _, end in slice_ends(scene_bytes)]
    with FaultyServer(scene_bytes, [Fault(ends[0] + 20, "stall")]) as server, SceneClient(server.url) as client:
        shown = []
        for scene in client.scenes(Budget(seconds=60)):
            shown.append(scene)
            over = 59.8
        check(shown, levels[:1])
        have = len(client.transfer.data)
        assert ends[0] <= have <= ends[0] + 20 and client.transfer.cuts == 0
        check(list(client.scenes()), levels[1:])
    assert server.requests[1]["range"] == f"bytes={have}-{ends[2] - 1}"


LAYERS = [(0, 1000), (1, 1500), (2, 3000)]


@pytest.mark.parametrize(
    ("have", "budget", "left", "rate", "expected"),
    [
        (0, Budget(), math.inf, None, 1000),
        (0, Budget(), 1e-3, 1.0, 1000),  # without the first layer there is no picture
        (0, Budget(seconds=1), 0.0, None, None),
        (1000, Budget(), math.inf, 1.0, 1500),
        (1000, Budget(max_layer=0), math.inf, 1e9, None),
        (1500, Budget(max_layer=1), math.inf, 1e9, None),
        (1200, Budget(bytes=1500), math.inf, 1e9, 1500),
        (1500, Budget(bytes=2999), math.inf, 1e9, None),
        (0, Budget(bytes=999), math.inf, None, None),
        (1000, Budget(seconds=9), 1.0, 500.0, 1500),
        (1000, Budget(seconds=9), 1.0, 499.0, None),
        (1400, Budget(seconds=9), 1.0, 100.0, 1500),  # what is here already counts
        (3000, Budget(), math.inf, 1e9, None),
    ],
)
def test_which_layer_next(have, budget, left, rate, expected):
    assert next_end(LAYERS, have, budget, left, rate) == expected


def test_the_rate_is_that_of_the_last_second():
    arrivals = deque([(10.0, 0)])
    assert recent_rate(arrivals) is None
    arrivals += [(10.1 + i / 10, 100 * (i + 1)) for i in range(10)]
    assert recent_rate(arrivals) == pytest.approx(1000)
    arrivals += [(11.1 + i / 10, 1010 + 10 * i) for i in range(20)]
    assert recent_rate(arrivals) == pytest.approx(100)
