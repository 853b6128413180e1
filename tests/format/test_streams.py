"""A stream costs what decoding costs, however the bytes are split."""

import gc
import weakref
from collections import deque
from dataclasses import replace
from functools import cache
from itertools import chain

import numpy as np
import pytest
from strategies import assert_same_scene, by_voxel, slice_ends, small_file
from streams import cost
from vectors.blocks import ancillary, later, line, make_file, make_layer, pattern, read_file

from pd4dgs_codec import decode, open_stream
from pd4dgs_codec.errors import ChecksumMismatch

SLICES, ROWS = 120, 64


@cache
def many_slices():
    """Layer 0 in many slices, and layer 1, whose rises are in the order of all of them."""
    k, widths = np.resize(pattern(68, 7), (68, ROWS)), (32, 6, 30)
    first = make_layer(0, line(ROWS, z=900), rows=k, widths=widths)
    rest = [later(0, line(ROWS, z=(7 * i) % SLICES), rows=k, widths=widths) for i in range(1, SLICES)]
    anchors = SLICES * ROWS
    rises = (np.arange(anchors) % 50).tolist()
    return make_file(first, *rest, make_layer(1, line(3, z=-5), before=anchors, rises=rises, widths=widths)).data()


@cache
def ends():
    return slice_ends(many_slices())


@cache
def decoded(**options):
    """What decoding gives: its arrays cannot be written."""
    return decode(many_slices(), **options)


@cache
def cost_of_decoding():
    """(seconds, peak bytes), measured once for all splits."""
    decoded()
    return cost(lambda: decode(many_slices()), 3)


def streamed(cuts, keep=None):
    """The scenes of a stream that is fed these pieces, or the last ones alone."""
    data, stream, scenes = many_slices(), open_stream(), deque(maxlen=keep)
    for a, b in zip(chain([0], cuts), chain(cuts, [len(data)]), strict=True):
        scenes += stream.feed(data[a:b])
    stream.finish()
    return scenes


SPLITS = {
    "whole": lambda: (),
    "slices": lambda: ends()[:-1],
    "within slices": lambda: [end - 7 for end in ends()],
    "single bytes": lambda: range(1, len(many_slices())),
}


@pytest.mark.parametrize("split", SPLITS)
def test_any_split_takes_the_time_and_memory_of_decoding(split):
    """A scene of all rows for each slice once took time that grew with the square of their number."""
    cuts = SPLITS[split]()
    seconds, peak = cost_of_decoding()
    found_seconds, found_peak = cost(lambda: streamed(cuts, keep=1), 2)
    assert found_seconds <= 3 * seconds
    assert found_peak <= 1.5 * peak


def test_bytes_that_are_skipped_take_a_constant_a_piece():
    """Of a chunk of a type to come, decode takes the checksum alone, so that multiples of its time promise nothing."""
    file = read_file(small_file())
    data = replace(file, chunks=[*file.chunks, ancillary(99, bytes(300_000))]).data()

    def fed() -> None:
        stream = open_stream()
        for at in range(len(data)):
            stream.feed(data[at : at + 1])
        stream.finish()

    seconds, found = cost(lambda: decode(data), 3)[0], cost(fed, 1)[0]
    assert found <= 3 * seconds + 5e-6 * len(data)


@pytest.mark.parametrize("split", SPLITS)
def test_any_split_ends_in_the_scene_of_decoding(split):
    scenes = streamed(SPLITS[split]())
    assert split != "whole" or len(scenes) == 2, "a layer is one scene, however many of its slices come at once"
    assert_same_scene(scenes[-1], decoded())
    assert_same_scene(scenes[-2], decoded(max_layer=0))


@pytest.mark.parametrize("kind", [bytearray, memoryview, lambda piece: np.frombuffer(piece, np.uint8)])
def test_pieces_of_any_kind_of_bytes(kind):
    data, stream = small_file(), open_stream()
    scenes = [scene for at in range(0, len(data), 100) for scene in stream.feed(kind(data[at : at + 100]))]
    stream.finish()
    assert_same_scene(scenes[-1], decode(data))


def test_scenes_stay_as_they_were():
    scenes = streamed(SPLITS["slices"]())
    assert len(scenes) == len(ends())
    for scene, end in list(zip(scenes, ends(), strict=True))[::11]:
        expected = decode(many_slices(), max_bytes=end)
        for found, other in zip(by_voxel(scene), by_voxel(expected), strict=True):
            np.testing.assert_array_equal(found, other)
        with pytest.raises(ValueError, match="read-only"):
            scene.feature[:] = 0


def test_a_stream_is_freed_as_soon_as_nobody_holds_it():
    """An error for each piece held its frames, and so the stream's arrays, until the next collection of garbage."""
    stream = open_stream()
    held = weakref.ref(stream)
    gc.disable()
    try:
        assert stream.feed(many_slices()[: ends()[3] + 9])
        del stream
        assert held() is None
    finally:
        gc.enable()


def test_a_stream_goes_on_after_a_damaged_slice_is_fed_again():
    data, at = many_slices(), ends()[4]
    damaged = bytearray(data)
    damaged[at + 40] ^= 1
    stream = open_stream()
    assert len(stream.feed(damaged)) == 1 and stream.consumed == at and stream.slices == 5
    for piece in (b"", b"x"):
        with pytest.raises(ChecksumMismatch):
            stream.feed(piece)
    assert not stream.complete
    stream.rewind()
    assert_same_scene(stream.feed(data[at:])[-1], decoded())
    stream.finish()
