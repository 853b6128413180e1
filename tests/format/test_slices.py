"""Layers in slices: any prefix of slices is a scene, and the whole is what one slice per layer holds."""

from dataclasses import replace
from functools import cache
from itertools import accumulate

import numpy as np
import pytest
from strategies import assert_same_scene, make_scene, slice_ends
from vectors.blocks import read_file

from pd4dgs_codec import decode, encode
from pd4dgs_codec.errors import DecodeError, EncodeError, Truncated
from pd4dgs_codec.format import encoder
from pd4dgs_codec.format.container import CHUNK_OVERHEAD, read_preamble
from pd4dgs_codec.format.decoder import decode_partial, every_prefix, open_stream
from pd4dgs_codec.format.encoder import encode_with_report
from pd4dgs_codec.format.info import hashes, info
from pd4dgs_codec.morton import morton_order


@cache
def scene():
    return make_scene(3, anchors=300)


@cache
def one_slice():
    return encode(scene(), effort=2)


@cache
def with_report():
    """(file in slices, report)."""
    return encode_with_report(scene(), effort=2, slices=1750)


def sliced():
    return with_report()[0]


def test_all_slices_are_what_one_slice_per_layer_holds():
    kinds = [chunk.type for chunk in read_file(sliced()).chunks]
    assert kinds == sorted(kinds) and all(kinds.count(layer) > 1 for layer in (0, 1, 2))
    assert hashes(sliced()) == hashes(one_slice())
    assert_same_scene(decode(sliced()), decode(one_slice()))
    assert len(sliced()) < 1.3 * len(one_slice())  # of 1 kB each


def test_every_prefix_of_slices_is_a_scene_by_every_door():
    """Cut off, as a file of its own, from a stream: the same scene, of rows that the whole has too."""
    whole, parts, ends = decode(sliced()), read_file(sliced()), slice_ends(sliced())
    streamed = list(every_prefix(sliced()))
    assert len(streamed) == len(ends)
    rows = {tuple(q): i for i, q in enumerate(whole.anchor_q.tolist())}
    for count, (end, from_stream) in enumerate(zip(ends, streamed, strict=True), start=1):
        if count < len(ends):
            with pytest.raises(Truncated):
                decode(sliced()[:end])
        prefix, complete = decode_partial(sliced()[:end])
        assert complete == (count == len(ends))
        assert sorted(from_stream.anchor_q.tolist()) == sorted(prefix.anchor_q.tolist())
        assert_same_scene(prefix, decode(replace(parts, chunks=parts.chunks[:count]).data()))
        at = [rows[tuple(q)] for q in prefix.anchor_q.tolist()]
        np.testing.assert_array_equal(prefix.feature, whole.feature[at])
        assert prefix.level == parts.chunks[count - 1].type
        for first, last in zip((0, *prefix.rows[:-1]), prefix.rows, strict=True):
            np.testing.assert_array_equal(morton_order(prefix.anchor_q[first:last]), np.arange(last - first))
        for extra in (0, 1):
            assert_same_scene(prefix, decode(sliced() + b"x", max_bytes=end + extra))
        with pytest.raises(DecodeError):
            decode(sliced()[: end - 1], max_bytes=end)
    with pytest.raises(Truncated, match=f"{ends[0] - 1} bytes end before the first slice"):
        decode(sliced(), max_bytes=ends[0] - 1)
    for level in (0, 1):
        assert_same_scene(decode(sliced(), max_layer=level), decode(one_slice(), max_layer=level))


def test_utility_decides_what_comes_first():
    def utility(scene):
        values = np.arange(len(scene.anchor_q), dtype=float)[::-1].copy()
        values[7] = 1e9
        return values

    data = encode(scene(), effort=2, slices=2000, utility=utility)
    whole = decode(data)
    first = decode_partial(data[: slice_ends(data)[0]])[0].anchor_q.tolist()
    expected = sorted(range(whole.rows[0]), key=lambda i: -utility(whole)[i])[: len(first)]
    assert sorted(first) == sorted(whole.anchor_q[expected].tolist())


def test_slices_take_what_was_asked_and_the_report_says_so():
    data, report = with_report()
    rows = [row for layer in report.layers for row in layer.slices]
    assert [row.bytes for row in rows] == [CHUNK_OVERHEAD + len(chunk.payload) for chunk in read_file(data).chunks]
    assert all(row.bytes <= 1750 for row in rows)
    ends = [*accumulate((row.bytes for row in rows), initial=read_preamble(data).size)][1:]
    assert ends[0] <= 1750 and ends[-1] == len(data)
    assert [sum(s.anchors for s in layer.slices) for layer in report.layers] == [r.anchors for r in report.layers]
    told = info(data)["layers"]
    assert slice_ends(data) == ends
    assert [s["anchors"] for row in told for s in row["slices"]] == [row.anchors for row in rows]
    assert [(row["anchors"], row["bytes"]) for row in told] == [(r.anchors, r.bytes) for r in report.layers]
    assert "anchors" not in info(data[: ends[1]])["layers"][0]


def test_every_slice_but_the_last_has_the_fill_of_the_prefix_that_ends_with_it():
    asked = list[int]()

    def fill(prefix):
        asked.append(len(prefix.anchor_q))
        return (len(asked), 0, 255) if len(asked) % 3 else None

    filled = replace(scene(), fills=((1, 1, 1), None, (9, 9, 9)))  # of a file that is encoded again
    data, report = encode_with_report(filled, effort=2, slices=1750, fill=fill)
    prefixes, ends = list(every_prefix(data)), slice_ends(data)
    expected = [(i, 0, 255) if i % 3 else None for i in range(1, len(ends))] + [(9, 9, 9)]
    assert asked == [len(prefix.anchor_q) for prefix in prefixes[:-1]]
    assert [prefix.fills[-1] for prefix in prefixes] == expected
    assert [decode(data, max_bytes=end).fills[-1] for end in ends] == expected
    stream = open_stream()
    assert [stream.feed(data[a:b])[-1].fills[-1] for a, b in zip([0, *ends], ends, strict=False)] == expected
    rows = [row for layer in report.layers for row in layer.slices]
    assert [row.fill for row in rows] == expected and ends[0] <= 1750 and all(row.bytes <= 1750 for row in rows)
    told = [part["fill"] for row in info(data)["layers"] for part in row["slices"]]
    assert told == [code and list(code) for code in expected]
    numbers = np.cumsum([len(layer.slices) for layer in report.layers]) - 1
    assert decode(data).fills == tuple(expected[i] for i in numbers)
    assert hashes(data) == hashes(sliced())


def test_later_slices_are_smaller_and_none_is_a_small_rest():
    """Slices behind the first picture take two thirds at most; those behind the first of a layer are alike."""
    _, report = encode_with_report(make_scene(3, anchors=3000), effort=1, slices=4000)
    for layer in report.layers:
        first, *others = (row.bytes for row in layer.slices)
        assert len(others) > 3 and max(others) <= 2667 and min(others) > 0.75 * max(others)
        assert first <= (2667 if layer.layer else 4000)


def test_the_first_slice_with_the_header_takes_what_was_asked():
    """The header has an entry for each of some fifty slices."""
    data, report = encode_with_report(make_scene(3, anchors=6000), effort=1, slices=2500)
    assert report.first_bytes == slice_ends(data)[0]
    assert 0.95 * 2500 < report.first_bytes <= 2500


def test_slices_that_cannot_be_are_refused(monkeypatch):
    with pytest.raises(EncodeError, match="slices of 5 bytes, expected 0 or at least 1000"):
        encode(scene(), slices=5)
    with pytest.raises(EncodeError, match="slices in mode lzma"):
        encode(scene(), slices=5000, mode="lzma")
    monkeypatch.setattr(encoder, "MAX_CHUNKS", 5)
    with pytest.raises(EncodeError, match=r"\d slices, expected at most 5"):
        encode(scene(), effort=1, slices=2000)
