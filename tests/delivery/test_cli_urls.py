"""`pd4dgs-info URL` and `pd4dgs-decode URL`: the same results as from the file, from as few bytes as they need."""

from __future__ import annotations

import json
from importlib import import_module

import pytest
from faulty import Fault, FaultyServer

from pd4dgs_codec.delivery.prefix import HEADER_GUESS, header_size, layer_ends


@pytest.fixture
def call(capfdbinary):
    """call(verb, *argv) -> (exit code, stdout, stderr)."""

    def run(verb: str, *argv: object) -> tuple[int, bytes, str]:
        code = import_module(f"pd4dgs_codec.cli.{verb}").main([str(a) for a in argv])
        out, err = capfdbinary.readouterr()
        return code, out, err.decode()

    return run


def test_info_reads_the_header_alone(call, folder, scene_bytes):
    with FaultyServer(scene_bytes) as server:
        code, out, err = call("info", server.url, "--json")
        assert server.sent == HEADER_GUESS and len(server.requests) == 1
    assert code == 0 and err == ""
    there, here = json.loads(out), json.loads(call("info", folder / "scene.pd4", "--json")[1])
    assert there["available"] == there["bytes"] == len(scene_bytes)
    for key in ("format_version", "header_bytes", "steps", "first_frame_seconds"):
        assert there[key] == here[key]
    places = [
        [{key: row[key] for key in ("layer", "offset", "bytes", "end")} for row in x["layers"]] for x in (there, here)
    ]
    assert places[0] == places[1]


def test_info_tells_of_a_file_that_is_cut_on_the_server(call, scene_bytes):
    with FaultyServer(scene_bytes[:1000]) as server:
        code, out, _ = call("info", server.url)
    assert code == 0 and b"of which 1,000 are here" in out


def test_info_checks_and_hashes_the_whole_remote_file(call, folder, scene_bytes):
    with FaultyServer(scene_bytes, [Fault(700)]) as server:
        code, out, _ = call("info", server.url, "--check", "--hashes", "--json")
        assert server.sent == len(scene_bytes)
    assert code == 0
    assert (
        json.loads(out)["hashes"] == json.loads(call("info", folder / "scene.pd4", "--hashes", "--json")[1])["hashes"]
    )


@pytest.mark.parametrize("layer", [0, 1, 2])
def test_decode_fetches_the_prefix_and_nothing_more(call, folder, tmp_path, scene_bytes, layer):
    end = dict(layer_ends(scene_bytes))[layer]
    with FaultyServer(scene_bytes, [Fault(100), Fault(), Fault(1234)]) as server:
        code, _, err = call("decode", server.url, "--max-layer", layer, "-o", tmp_path / "there.npz", "-v")
        assert server.sent == end
    assert code == 0 and f"{end:,} bytes in 4 requests, 2 cuts" in err
    assert call("decode", folder / "scene.pd4", "--max-layer", layer, "-o", tmp_path / "here.npz")[0] == 0
    assert (tmp_path / "there.npz").read_bytes() == (tmp_path / "here.npz").read_bytes()


def test_decode_of_the_whole_file_is_one_request(call, scene_bytes):
    with FaultyServer(scene_bytes) as server:
        code, out, _ = call("decode", server.url, "--json")
        assert len(server.requests) == 1 and "range" not in server.requests[0]
    assert code == 0 and json.loads(out)["complete"] is True and json.loads(out)["bytes"] == len(scene_bytes)
    with FaultyServer(scene_bytes + b"x" * 100_000) as server:
        code, out, err = call("decode", server.url)
    assert code == 1 and "bytes follow the last chunk" in err and server.url in err


def test_a_server_without_ranges_serves_prefixes_too(call, scene_bytes):
    with FaultyServer(scene_bytes, ranges=False) as server:
        code, out, _ = call("decode", server.url, "--max-layer", 0, "--json")
        assert len(server.requests) == 1
    assert code == 0 and json.loads(out)["bytes"] == layer_ends(scene_bytes)[0][1]


def test_partial_files_and_failing_links(call, scene_bytes, monkeypatch):
    monkeypatch.setattr("pd4dgs_codec.delivery.transfer.BACKOFF_SECONDS", 0.0)
    cut = layer_ends(scene_bytes)[1][1] + 5
    with FaultyServer(scene_bytes[:cut]) as server:
        assert call("decode", server.url)[0] == 1
        code, out, _ = call("decode", server.url, "--allow-partial", "--json")
        assert code == 3 and [row["layer"] for row in json.loads(out)["layers"]] == [0, 1]
    for options, expected in (([], 1), (["--allow-partial"], 3)):
        with FaultyServer(scene_bytes, [Fault(cut), *[Fault(status=503)] * 9]) as server:
            code, out, err = call("decode", server.url, *options)
        assert code == expected and f"answers 503 Service Unavailable ({cut:,} bytes are here)" in err


@pytest.mark.parametrize("verb", ["info", "decode"])
def test_bad_urls_and_missing_files_are_one_line(call, scene_bytes, verb):
    with FaultyServer(scene_bytes, [Fault(status=404)]) as server:
        code, out, err = call(verb, server.url)
    assert (code, out) == (1, b"") and err == f"pd4dgs-{verb}: error: {server.url}: the server answers 404 Not Found\n"
    code, out, err = call(verb, "http://")
    assert (code, out) == (1, b"") and len(err.splitlines()) == 1
    with FaultyServer(b"<html>") as server:
        code, out, err = call(verb, server.url)
    assert code == 1 and "begins with 3c 68 74 6d 6c 3e" in err
    with FaultyServer(b"") as server:
        code, out, err = call(verb, server.url)
    assert code == 1 and f"{server.url}: 0 bytes end inside the preamble" in err


def test_the_header_is_found_where_it_ends(scene_bytes):
    size = header_size(scene_bytes)
    assert size is not None and header_size(scene_bytes[: size - 1]) is None
    assert [layer for layer, _ in layer_ends(scene_bytes[:size])] == [0, 1, 2] and layer_ends(scene_bytes[:9]) == []
