"""The index of a folder of segments: what it says, and what it refuses."""

import json

import pytest

from pd4dgs_codec.errors import DataError
from pd4dgs_codec.segments import INDEX, MOST_BYTES, File, Index, Segment, check, file_of, is_folder, parse, read_index

DIGEST = "0" * 64
INDEX_OF_THREE = Index(
    (File("base.pd4", 100, DIGEST),),
    (
        Segment("a.pd4", 10, DIGEST, (0.0, 2.0), 0),
        Segment("b.pd4", 20, DIGEST, (2.0, 4.0), 0),
        Segment("c.pd4", 30, DIGEST, (3.5, 6.0)),
    ),
    {"psnr": 40},
)


def changed(*path, to):
    """The bytes of the index with another value at a path of keys."""
    content = json.loads(INDEX_OF_THREE.packed())
    place = content
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = to
    return json.dumps(content).encode()


def test_what_is_written_is_read_back():
    assert parse(INDEX_OF_THREE.packed(), "it") == INDEX_OF_THREE
    assert INDEX_OF_THREE.time_range == (0, 6) and len(INDEX_OF_THREE.files) == 4


def test_a_time_belongs_to_the_last_segment_that_has_begun_and_while_two_last_to_the_nearer_one():
    times = {-1: 0, 0: 0, 1.9: 0, 2: 1, 3.4: 1, 3.5: 1, 3.7: 1, 3.8: 2, 4: 2, 6: 2, 99: 2}
    assert {t: INDEX_OF_THREE.at(t) for t in times} == times


def test_weights_of_two_segments_are_linear_in_time():
    assert INDEX_OF_THREE.shown(2) == [(1, 1.0)]
    assert [INDEX_OF_THREE.shown(t) for t in (3.5, 3.625, 3.75)] == [[(1, 1 - w), (2, w)] for w in (0, 0.25, 0.5)]
    assert INDEX_OF_THREE.shown(4) == INDEX_OF_THREE.shown(99) == [(2, 1.0)]


def test_members_that_are_not_known_are_skipped():
    content = json.loads(INDEX_OF_THREE.packed()) | {"later": 1}
    content["segments"][0]["layers"] = []
    assert parse(json.dumps(content).encode(), "it") == INDEX_OF_THREE


FAULTS = {
    "not JSON": (b"\xff", "cannot be read as JSON"),
    "deep": (b"[" * 100_000, "cannot be read as JSON"),
    "a list": (b"[]", "segments_version None, expected 1"),
    "version 2": (changed("segments_version", to=2), "segments_version 2, expected 1"),
    "version true": (changed("segments_version", to=True), "segments_version True, expected 1"),
    "bases": (changed("bases", to={}), "bases: found dict, expected a list"),
    "too many": (changed("segments", to=[0] * 70_000), "segments: found 70,000 of them"),
    "number": (changed("segments", 1, to=3), "segments 1: found int"),
    "made": (changed("made", to=[]), "made is a list"),
    "folder": (changed("segments", 0, "file", to="../a.pd4"), "segments 0: file '../a.pd4'"),
    "address": (changed("bases", 0, "file", to="http://x/y.pd4"), "bases 0: file"),
    "long": (changed("bases", 0, "file", to="x" * 121), "bases 0: file"),
    "twice": (changed("bases", 0, "file", to="a.pd4"), "names a file twice"),
    "bytes": (changed("segments", 0, "bytes", to=1.5), "segments 0: bytes 1.5"),
    "digest": (changed("segments", 0, "sha256", to="A" * 64), "segments 0: sha256"),
    "base": (changed("segments", 0, "base", to=1), "segments 0: base 1, expected null or 0 to 0"),
    "base true": (changed("segments", 0, "base", to=False), "segments 0: base False"),
    "range": (changed("segments", 0, "time_range", to=[0, "1"]), "segments 0: time_range"),
    "NaN": (changed("segments", 0, "time_range", to=[0, float("nan")]), "segments 0: time_range"),
    "backwards": (changed("segments", 0, "time_range", to=[2, 0]), "segments 0: time_range"),
    "gap": (changed("segments", 1, "time_range", to=[2.5, 4]), "expected one that begins by its end"),
    "three at a time": (changed("segments", 0, "time_range", to=[0, 3.6]), "begins at 3.5 s, expected 3.6 s or later"),
    "within": (changed("segments", 2, "time_range", to=[2.5, 4]), "expected one that begins by its end"),
}


@pytest.mark.parametrize("data, message", FAULTS.values(), ids=FAULTS)
def test_faults_are_named_in_one_line(data, message):
    with pytest.raises(DataError, match=message.replace("(", r"\(")) as raised:
        parse(data, "it")
    assert "\n" not in str(raised.value) and len(str(raised.value)) < 250


def test_a_large_index_is_not_parsed():
    with pytest.raises(DataError, match="expected at most"):
        parse(b" " * (MOST_BYTES + 1), "it")


def test_a_folder_is_known_by_its_index(tmp_path):
    assert not is_folder(tmp_path)
    (tmp_path / INDEX).write_bytes(INDEX_OF_THREE.packed())
    for place in (tmp_path, tmp_path / INDEX):
        assert is_folder(place) and read_index(place) == (tmp_path, INDEX_OF_THREE)
    (tmp_path / INDEX).write_bytes(changed("segments", to=[]))
    with pytest.raises(DataError, match="lists no segments"):
        read_index(tmp_path)


def test_a_file_is_checked_against_its_digest():
    file = file_of("a.pd4", b"abc")
    check(file, b"abc", "it")
    for data, found in ((b"abd", "other bytes"), (b"ab", "2 bytes")):
        with pytest.raises(DataError, match=f"it: has {found}, expected the 3 bytes"):
            check(file, data, "it")
