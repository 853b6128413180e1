"""`pd4dgs-info URL` and `pd4dgs-decode URL`: the same results as from the file, from as few bytes as they need."""

import pytest
from faulty import Fault, FaultyServer

from pd4dgs_codec.format.container import read_preamble
from pd4dgs_codec.web.client import HEADER_GUESS, slice_ends


def test_info_reads_the_header_alone(cli, folder, scene_bytes):
    with FaultyServer(scene_bytes) as server:
        done = cli("info", server.url, "--json")
        assert server.sent == HEADER_GUESS and len(server.requests) == 1
    assert done.code == 0 and done.err == ""
    there, here = done.json, cli("info", folder / "scene.pd4", "--json").json
    assert there["available"] == there["bytes"] == len(scene_bytes)
    for key in ("format_version", "header_bytes", "steps", "first_frame_seconds"):
        assert there[key] == here[key]
    places = [
        [{key: row[key] for key in ("layer", "offset", "bytes", "end")} for row in x["layers"]] for x in (there, here)
    ]
    assert places[0] == places[1]


def test_info_tells_of_a_file_that_is_cut_on_the_server(cli, scene_bytes):
    with FaultyServer(scene_bytes[:1000]) as server:
        done = cli("info", server.url)
    assert done.code == 0 and b"truncated to 1,000" in done.out


def test_info_checks_and_hashes_the_whole_remote_file(cli, folder, scene_bytes):
    with FaultyServer(scene_bytes, [Fault(700)]) as server:
        done = cli("info", server.url, "--check", "--hashes", "--json")
        assert server.sent == len(scene_bytes)
    assert done.code == 0
    assert done.json["hashes"] == cli("info", folder / "scene.pd4", "--hashes", "--json").json["hashes"]


@pytest.mark.parametrize("layer", [0, 1, 2])
def test_decode_fetches_the_prefix_and_nothing_more(cli, folder, tmp_path, scene_bytes, layer):
    end = dict(slice_ends(scene_bytes))[layer]
    with FaultyServer(scene_bytes, [Fault(100), Fault(), Fault(1234)]) as server:
        done = cli("decode", server.url, "--level", layer, "-o", tmp_path / "there.npz", "-v")
        assert server.sent == end
    assert done.code == 0 and f"{end:,} bytes in 4 requests, 2 interruptions" in done.err
    assert cli("decode", folder / "scene.pd4", "--level", layer, "-o", tmp_path / "here.npz").code == 0
    assert (tmp_path / "there.npz").read_bytes() == (tmp_path / "here.npz").read_bytes()


def test_decode_of_the_whole_file_is_one_request(cli, scene_bytes):
    with FaultyServer(scene_bytes) as server:
        done = cli("decode", server.url, "--json")
        assert len(server.requests) == 1 and "range" not in server.requests[0]
    assert done.code == 0 and done.json["complete"] is True and done.json["bytes"] == len(scene_bytes)
    with FaultyServer(scene_bytes + b"x" * 100_000) as server:
        done = cli("decode", server.url)
    assert done.code == 1 and "bytes follow the last chunk" in done.err and server.url in done.err


def test_a_server_without_ranges_serves_prefixes_too(cli, scene_bytes):
    with FaultyServer(scene_bytes, ranges=False) as server:
        done = cli("decode", server.url, "--level", 0, "--json")
        assert len(server.requests) == 1
    assert done.code == 0 and done.json["bytes"] == slice_ends(scene_bytes)[0][1]


def test_partial_files_and_failing_links(cli, scene_bytes, monkeypatch):
    monkeypatch.setattr("pd4dgs_codec.web.client.BACKOFF_SECONDS", 0.0)
    cut = slice_ends(scene_bytes)[1][1] + 5
    with FaultyServer(scene_bytes[:cut]) as server:
        assert cli("decode", server.url).code == 1
        done = cli("decode", server.url, "--allow-partial", "--json")
        assert done.code == 3 and [row["layer"] for row in done.json["layers"]] == [0, 1]
    for options, expected in (([], 1), (["--allow-partial"], 3)):
        with FaultyServer(scene_bytes, [Fault(cut), *[Fault(status=503)] * 9]) as server:
            done = cli("decode", server.url, *options)
        assert done.code == expected and f"answered 503 Service Unavailable ({cut:,} bytes received)" in done.err


@pytest.mark.parametrize("verb", ["info", "decode"])
def test_bad_urls_and_missing_files_are_one_line(cli, scene_bytes, verb):
    with FaultyServer(scene_bytes, [Fault(status=404)]) as server:
        done = cli(verb, server.url)
    says = f"pd4dgs-{verb}: error: {server.url}: the server answered 404 Not Found\n"
    assert (done.code, done.out, done.err) == (1, b"", says)
    done = cli(verb, "http://")
    assert (done.code, done.out) == (1, b"") and len(done.err.splitlines()) == 1
    with FaultyServer(b"<html>") as server:
        done = cli(verb, server.url)
    assert done.code == 1 and "begins with 3c 68 74 6d 6c 3e" in done.err
    with FaultyServer(b"") as server:
        done = cli(verb, server.url)
    assert done.code == 1 and f"{server.url}: truncated in the preamble: 0 bytes" in done.err


def test_the_header_is_found_where_it_ends(scene_bytes):
    size = read_preamble(scene_bytes).size
    assert [layer for layer, _ in slice_ends(scene_bytes[:size])] == [0, 1, 2]
    assert slice_ends(scene_bytes[: size - 1]) == []
