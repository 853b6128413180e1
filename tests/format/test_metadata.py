"""Metadata comes back as it was given, within its limits, and nothing hostile gets through or costs much."""

from dataclasses import replace

import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from strategies import flipped

from pd4dgs_codec.errors import DecodeError, EncodeError, LimitExceeded, Malformed, UnsupportedFeature
from pd4dgs_codec.format import canonical, metadata
from pd4dgs_codec.format.metadata import Metadata, read_metadata, write_metadata

PNG = metadata.STILL_SIGNATURES[0]
FULL = Metadata("Kitchen", "a phone, 12 seconds", "CC BY 4.0", "pd4dgs-encode m.pt", {0: 24.5, 2: 31.25}, PNG + b"x")

TEXT = st.text(st.characters(exclude_categories=("C", "Z")), max_size=40)


@given(
    st.builds(
        Metadata,
        title=TEXT,
        source=TEXT,
        licence=TEXT,
        command=TEXT,
        quality=st.dictionaries(st.integers(0, 2), st.floats(0, 99, width=32)),
        still=st.sampled_from((b"", *(s + b"rest" for s in metadata.STILL_SIGNATURES))),
        slices=st.lists(st.floats(0, 99, width=32), max_size=5).map(tuple),
    )
)
def test_what_is_written_comes_back(given_one):
    assert read_metadata(write_metadata(given_one)) == given_one


@pytest.mark.parametrize(
    "changes, says",
    [
        ({"title": "two\nlines"}, "title, expected one line"),
        ({"source": "\x1b[31m"}, "source, expected one line"),
        ({"command": "x" * 4097}, "4097, expected at most 4096"),
        ({"quality": {3: 1.0}}, "level: 3, expected at most 2"),
        ({"quality": {0: float("nan")}}, "not a finite binary32"),
        ({"slices": (1.0,) * 1025}, "1025, (expected at most|limit) 1024"),
        ({"still": b"GIF89a"}, "PNG, JPEG or WebP"),
        ({"still": PNG.ljust((1 << 17) + 1)}, "131073, expected at most 131072"),
    ],
)
def test_what_is_over_a_limit_is_not_written(changes, says):
    with pytest.raises(EncodeError, match=says):
        write_metadata(replace(FULL, **changes))


def frame(content, **options):
    return zstandard.ZstdCompressor(**options).compress(content)


def stream(content):
    compressor = zstandard.ZstdCompressor(write_content_size=False).compressobj()
    return compressor.compress(content) + compressor.flush()


WHOLE = write_metadata(FULL)
FAULTY = {
    "nothing": (b"", Malformed, "not one whole zstd frame"),
    "no frame": (b"no frame at all", Malformed, "not one whole zstd frame"),
    "cut": (WHOLE[:-1], Malformed, "not one whole zstd frame"),
    "bytes behind": (WHOLE + b"\0", Malformed, "not one whole zstd frame"),
    "no declared size": (stream(canonical.pack({1: "a"})), Malformed, "declares no size"),
    "a bomb": (frame(bytes((1 << 18) + 1)), LimitExceeded, "262145 bytes declared"),
    "too long": (bytes((1 << 18) + 1), LimitExceeded, "262145 bytes compressed"),
    "not canonical": (frame(b"\xda\x00\x01a"), Malformed, "shortest form"),
    "a list": (frame(canonical.pack([1])), Malformed, "list, expected a map"),
    "an unknown key": (frame(canonical.pack({9: 1})), UnsupportedFeature, "unknown critical key 9"),
    "a title of bytes": (frame(canonical.pack({1: b"a"})), Malformed, "title, expected one line"),
    "an empty title": (frame(canonical.pack({1: ""})), Malformed, "title, expected one line"),
    "quality in a list": (frame(canonical.pack({5: [1.0]})), Malformed, "by level"),
    "whole dB": (frame(canonical.pack({5: {0: 31}})), Malformed, "by level"),
    "a level too high": (frame(canonical.pack({5: {7: 31.0}})), LimitExceeded, "level: 7"),
    "a picture of text": (frame(canonical.pack({6: "a"})), Malformed, "PNG, JPEG or WebP"),
}


@pytest.mark.parametrize("fault", FAULTY)
def test_what_is_no_metadata_is_refused(fault):
    data, error, says = FAULTY[fault]
    with pytest.raises(error, match=says):
        read_metadata(data)


def test_unknown_keys_that_may_be_ignored_are():
    assert read_metadata(frame(canonical.pack({1: "a", 64: [1, 2]}))) == Metadata("a")


@given(st.integers(0, len(WHOLE) - 1), st.integers(1, 255))
def test_damage_is_refused_or_gives_other_metadata(at, flip):
    try:
        assert isinstance(read_metadata(flipped(WHOLE, at, flip)), Metadata)
    except DecodeError as error:
        assert "\n" not in str(error)
