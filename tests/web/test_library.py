"""Names that never change, what caches are told, and the index of a library."""

import hashlib
import json
import re
from dataclasses import replace

import pytest
from faulty import ask
from test_package import fake_video

from pd4dgs_codec.errors import DeliveryError
from pd4dgs_codec.web.headers import CHANGES, IMMUTABLE, cache_control
from pd4dgs_codec.web.package import addressed, library, package
from pd4dgs_codec.web.server import Server

VIDEO = replace(fake_video(), poster=b"\xff\xd8 a picture")


@pytest.fixture(scope="module")
def packages(scene_bytes):
    """Two, one with names that never change."""
    return {"a b": package(scene_bytes, lambda scene, share: VIDEO, immutable=True), "c": package(scene_bytes)}


@pytest.fixture
def shelf(tmp_path, packages):
    """A folder of both, which a test may damage."""
    for name, files in packages.items():
        (tmp_path / name).mkdir()
        for file, content in files.items():
            (tmp_path / name / file).write_bytes(content)
    return tmp_path


def test_what_others_name_carries_its_digest(scene_bytes, packages):
    files = packages["a b"]
    plain = package(scene_bytes, lambda scene, share: VIDEO)
    named = {name: found for name in files if (found := re.search("-([0-9a-f]{16})[.]", name))}
    assert len(named) == 4 and len(files) == len(plain) and all(files.values())
    for name, found in named.items():
        assert hashlib.sha256(files[name]).hexdigest().startswith(found[1])
        assert files[name] == plain[re.sub("-[0-9a-f]{16}", "", name)]
    for name in ("scene.mpd", "fallback.m3u8", "index.json", "index.html"):  # these name them
        assert re.sub(b"-[0-9a-f]{16}(?=[.])", b"", files[name]).count(b"scene.") >= plain[name].count(b"scene.")
    text = b"".join(files[name] for name in files if name not in named)
    assert all(name.encode() in text for name in named)
    assert package(scene_bytes, lambda scene, share: VIDEO, immutable=True) == files


def test_the_index_says_what_caches_may_keep_and_when_a_picture_is_there(scene_bytes, packages):
    files = package(scene_bytes, immutable=True)
    index = json.loads(files["index.json"])
    assert set(index["cache_control"]) == set(files)
    assert index["cache_control"][index["file"]] == IMMUTABLE and index["cache_control"]["index.html"] == CHANGES
    first = index["layers"][0]["range"][1]
    assert index["first_frame_seconds"]["2M"] == pytest.approx(8 * first / 2e6)
    assert set(json.loads(packages["c"]["index.json"])["cache_control"].values()) == {CHANGES}


def test_a_library_lists_its_packages(shelf, scene_bytes):
    files = library(shelf)
    listed = json.loads(files["library.json"])
    assert listed["bytes"] == 2 * len(scene_bytes)
    first, second = listed["scenes"]
    assert (first["name"], second["name"]) == ("a b", "c") and second["poster"] is None
    assert first["page"] == "a%20b/index.html" and first["bytes"] == len(scene_bytes)
    assert first["layers"][-1]["end"] == len(scene_bytes) and set(first["first_frame_seconds"]) == {"2M", "10M", "50M"}
    page = files["index.html"].decode()
    assert first["poster"] in page and "c/index.html" in page
    for name, content in files.items():
        (shelf / name).write_bytes(content)
    assert library(shelf) == files  # its own files are no packages


def test_a_server_tells_caches_what_never_changes(shelf):
    first = json.loads(library(shelf)["library.json"])["scenes"][0]
    with Server(shelf) as server, server.running():
        for target, wanted in ((first["file"], IMMUTABLE), (first["page"], CHANGES), ("c/scene.pd4", CHANGES)):
            answer = ask(server, f"/{target}", "HEAD")
            assert answer.status == 200 and answer.headers["Cache-Control"] == wanted


def test_a_folder_without_packages_and_a_broken_index_are_named(tmp_path):
    with pytest.raises(DeliveryError, match="found no packages"):
        library(tmp_path)
    (tmp_path / "x").mkdir()
    (tmp_path / "x" / "index.json").write_text("{}")
    with pytest.raises(DeliveryError, match="x/index.json.*KeyError"):
        library(tmp_path)


def test_the_command_writes_a_library_beside_its_packages(cli, shelf):
    assert cli("package", shelf, "-o", shelf / "elsewhere").code == 1
    done = cli("package", shelf, "-o", shelf, "--json")
    assert done.code == 0, done.err
    assert {row["name"] for row in done.json["files"]} == {"library.json", "index.html"}
    assert len(json.loads((shelf / "library.json").read_text())["scenes"]) == 2


@pytest.mark.parametrize("name", ["scene.pd4", "scene-0123.pd4", "0123456789abcdef.pd4", "x-0123456789abcdeF.pd4"])
def test_other_names_may_change(name):
    assert cache_control(name) == CHANGES
    assert cache_control(addressed(name, b"x")) == IMMUTABLE


def rewritten(folder, **changes):
    """Changes keys of a package's index."""
    path = folder / "c" / "index.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


EVIL = "<img src=x onerror=alert(1)>"


def test_nothing_that_a_package_says_becomes_part_of_the_page(shelf):
    rewritten(
        shelf, file=f'"{EVIL}', poster=f'"{EVIL}', sha256=EVIL, format_version=EVIL, first_frame_seconds={EVIL: 1}
    )
    (shelf / "c").rename(shelf / f"{EVIL.replace('/', '')}\x1b[2J")
    files = library(shelf)
    page = files["index.html"].decode()
    assert "<img src=x" not in page and "alert(1)&gt;" in page and "\x1b" not in page
    for scene in json.loads(files["library.json"])["scenes"]:  # others make pages of it
        assert "<" not in f"{scene['page']}{scene['file']}{scene['poster']}"


WRONG = {
    "bytes": [None, "1", -1, True, 1.5e308, [1]],
    "seconds": [None, "<b>", float("nan"), float("inf"), -1],
    "first_frame_seconds": [None, [1, 2], {"2M": "<b>"}, {"x" * 300: 1}, {"a\nb": 1}, {"\x1b": 1}, 5],
    "file": [None, 5, "", "\x1b[2J", "x" * 300, "\ud800"],
    "poster": [5, "\x07", ["x"]],
    "sha256": [5, None, {}],
    "format_version": [3.0, None],
    "layers": [None, {}, 5, [{}], [{"layer": 0, "range": [1]}], [{"layer": "<b>", "range": [0, 1]}], "ab"],
}


@pytest.mark.parametrize("key, value", [(key, value) for key, values in WRONG.items() for value in values])
def test_an_index_that_says_something_else_is_named(shelf, key, value):
    rewritten(shelf, **{key: value})
    if key == "layers" and value == {}:
        assert library(shelf)
        return
    with pytest.raises(DeliveryError, match="c/index.json: invalid package index") as caught:
        library(shelf)
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("text", ["[]", "5", "[" * 100_000, '{"bytes": 1' + "0" * 5000 + "}", "\x00"])
def test_an_index_that_is_none_is_named(shelf, text):
    (shelf / "c" / "index.json").write_text(text)
    with pytest.raises(DeliveryError, match="c/index.json: invalid package index"):
        library(shelf)
