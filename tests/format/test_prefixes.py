"""Layer prefixes, cut files and incremental decoding; tests/spec/test_vectors.py feeds faulty files to a stream."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import LAYER_SETS, assert_same_scene, flipped, scenes, small_file
from vectors.blocks import Chunk, File

from pd4dgs_codec import decode, encode, open_stream
from pd4dgs_codec.errors import BadSignature, ChecksumMismatch, DecodeError, Malformed, Truncated
from pd4dgs_codec.format.canonical import unpack
from pd4dgs_codec.format.container import read_preamble
from pd4dgs_codec.format.decoder import decode_partial
from pd4dgs_codec.format.header import pack_header
from pd4dgs_codec.format.info import hashes, info
from pd4dgs_codec.format.options import EncodeOptions
from pd4dgs_codec.format.payload import write_slice
from pd4dgs_codec.format.reader import decode_tensors, read_layers


@given(scenes())
@settings(max_examples=8)
def test_each_prefix_decodes_to_what_max_layer_gives(scene):
    data = encode(scene, layers=2, effort=1, verify=False)
    whole = decode(data)
    for row in info(data)["layers"]:
        prefix = data[: row["end"]]
        got = decode(prefix, max_layer=row["layer"])
        assert_same_scene(got, decode(data, max_layer=row["layer"]))
        assert_same_scene(got, whole.prefix(row["layer"]))
        if row["end"] < len(data):
            with pytest.raises(Truncated):
                decode(prefix)
        found, complete = decode_partial(prefix)
        assert complete == (row["end"] == len(data))
        assert_same_scene(found, got)


@pytest.mark.parametrize("layers", LAYER_SETS)
def test_every_cut_yields_the_longest_valid_prefix_or_truncated(layers):
    data = small_file(layers)
    ends = [row["end"] for row in info(data)["layers"]]
    for size in [*range(0, len(data), 101), *(e + d for e in ends for d in (-1, 0, 1) if e + d < len(data))]:
        if size < len(data):
            with pytest.raises(Truncated):
                decode(data[:size])
        whole_layers = sum(end <= size for end in ends)
        if whole_layers == 0:
            with pytest.raises(Truncated):
                decode(data[:size], allow_partial=True)
        else:
            assert decode(data[:size], allow_partial=True).layers == layers[:whole_layers]


def test_max_layer_does_not_look_beyond_its_prefix():
    data = small_file()
    end = info(data)["layers"][0]["end"]
    assert decode(data[:end] + b"garbage", max_layer=0).layers == (0,)
    assert decode(data, max_layer=7).layers == (0, 1, 2)
    assert decode(small_file((0, 2)), max_layer=1).layers == (0,)
    with pytest.raises(ValueError, match="max_layer"):
        decode(data, max_layer=-1)


def test_allow_partial_forgives_a_cut_and_nothing_else():
    with pytest.raises(ChecksumMismatch):
        decode(flipped(small_file((0, 1)), -10), allow_partial=True)
    with pytest.raises(Malformed, match="bytes follow"):
        decode(small_file((0, 1)) + b"\0", allow_partial=True)


@given(st.sampled_from(LAYER_SETS), st.lists(st.integers(0, 4000), max_size=8))
@settings(max_examples=15)
def test_a_stream_does_not_depend_on_where_it_is_cut(layers, cuts):
    data = small_file(layers)
    places = [0, *sorted(min(c, len(data)) for c in cuts), len(data)]
    stream, got = open_stream(), []
    for a, b in zip(places[:-1], places[1:], strict=True):
        got += stream.feed(data[a:b])
        assert len(got) == sum(row["end"] <= b for row in info(data)["layers"])
    assert stream.complete
    stream.finish()
    for layer, scene in zip(layers, got, strict=True):
        assert_same_scene(scene, decode(data, max_layer=layer))


def streamed(data):
    stream = open_stream()
    stream.feed(data)
    stream.finish()


def faults_by_every_door(data):
    """(class, message, chunk, offset) of what each entry point raises."""
    for door in (streamed, decode, partial(decode, allow_partial=True), decode_tensors, hashes):
        with pytest.raises(DecodeError) as caught:
            door(data)
        yield type(caught.value), str(caught.value), caught.value.chunk, caught.value.offset


@pytest.mark.parametrize("first", ["value", "mask code", "voxel"])
def test_of_two_faults_every_door_names_that_of_the_earlier_layer(first):
    """Values that are not finite, sums of masks and voxels taken twice, which a payload alone does not show; the file
    is whole, cut, or damaged in its last layer."""
    header, layers = read_layers(small_file())
    rows, which = header.table.tensors, 1
    if first == "value":
        rows, which = (*rows[:2], replace(rows[2], step=2.0**127)), 0
    elif first == "mask code":
        layers[1] = replace(layers[1], rises=np.full_like(layers[1].rises, 255))
    else:
        layers[1] = replace(layers[1], anchor_q=layers[0].anchor_q[: len(layers[1].anchor_q)])
    fields = unpack(pack_header(replace(header, table=replace(header.table, tensors=rows))))
    chunks = [Chunk(i, write_slice(layer, EncodeOptions(effort=1))[0]) for i, layer in enumerate(layers)]
    whole = File(chunks, {key: value for key, value in fields.items() if key != 1}).data()
    offset = info(whole[: read_preamble(whole).size])["layers"][which]["offset"]
    for data in (whole, whole[:-9], flipped(whole, -9)):
        ((error, _, *place),) = set(faults_by_every_door(data))
        assert (error, place) == (Malformed, [which, offset])


def test_a_stream_refuses_other_data_at_once():
    with pytest.raises(BadSignature):
        open_stream().feed(b"PNG")
