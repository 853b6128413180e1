"""Low bits of attributes that come at the end: the whole is what it is without, and a prefix as near as it says."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import assert_same_scene, make_scene, scenes

from pd4dgs_codec import decode, encode
from pd4dgs_codec.entropy.channels import decode_channels
from pd4dgs_codec.errors import EncodeError, LimitExceeded, Malformed, Truncated
from pd4dgs_codec.format import decoder
from pd4dgs_codec.format.decoder import LayerReader, decode_layers, decode_partial
from pd4dgs_codec.format.encoder import encode_with_report
from pd4dgs_codec.format.info import hashes, info
from pd4dgs_codec.format.limits import MAX_LOW_BITS
from pd4dgs_codec.format.options import EncodeOptions
from pd4dgs_codec.format.plan import plan
from pd4dgs_codec.format.quantise import MAX_SYMBOL, quantise
from pd4dgs_codec.format.refining import coarse, read_refinement, shifted, write_refinement
from pd4dgs_codec.format.stream import every_prefix, open_stream
from pd4dgs_codec.format.symbols import layer_symbols, sliced
from pd4dgs_codec.format.table import Grid
from pd4dgs_codec.scene import Grading, Widths

ALL_BITS = range(MAX_LOW_BITS + 1)
TINY = {"extent": 9, "hidden": ()}


@cache
def scene(graded=False):
    return make_scene(3, anchors=200, kind="gaussian", layers=(0, 1), widths=Widths(3, 2, graded), **TINY)


@cache
def low(bits=2, slices=1200, graded=False):
    return encode_with_report(scene(graded), effort=2, layers=2, slices=slices, low_bits=bits)


def ends_of(data):
    """Where each slice ends, and how many of them bring low bits."""
    reader, ends, refining = LayerReader(), [], 0
    while reader.next_slice(data):
        ends.append(reader.offset)
        refining += reader.latest.refines is not None
    return ends, refining


def symbols_of(scene):
    """int32 [channels, n], and int32 [n] step classes."""
    classes = np.zeros(len(scene.anchor_q), np.int32) if scene.grading is None else scene.grading.classes.astype(int)
    return Grid.of(scene).quantise(scene.attributes, classes if scene.grading is not None else classes[:0]), classes


@given(scenes(), st.sampled_from(ALL_BITS), st.sampled_from((0, 1000, 2500)), st.sampled_from((1, 3)))
@settings(max_examples=25, deadline=None)
def test_any_scene_comes_back_as_it_does_without(scene, bits, slices, effort):
    options = EncodeOptions(layers=2, omit="nothing")  # which effort decides as well
    whole = encode(scene, options, effort=1)
    data = encode(scene, options, effort=effort, slices=slices, low_bits=bits)
    assert hashes(data) == hashes(whole)
    assert_same_scene(decode(data), decode(whole))
    if not bits:
        assert data == encode(scene, options, effort=effort, slices=slices)


@pytest.mark.parametrize("graded", [False, True])
@pytest.mark.parametrize("bits", ALL_BITS[1:])
def test_every_prefix_decodes_by_every_door_and_lies_as_near_as_it_says(bits, graded):
    data = low(bits, graded=graded)[0]
    (ends, refining), whole = ends_of(data), decode(data)
    assert refining > 1 and len(ends) > refining + 2
    exact, classes = symbols_of(whole)
    row = {tuple(cell): i for i, cell in enumerate(whole.anchor_q.tolist())}
    off = []
    for end, streamed in zip(ends, every_prefix(data), strict=True):
        prefix, complete = decode_partial(data[:end])
        assert complete == (end == ends[-1])
        assert_same_scene(prefix, streamed)
        assert_same_scene(prefix, decode(data, max_bytes=end))
        at = [row[tuple(cell)] for cell in prefix.anchor_q.tolist()]
        found, _ = symbols_of(prefix)
        far = np.abs(found - exact[:, at])
        assert far.max(initial=0) <= 1 << bits - 1
        off.append(int(far.any(axis=0).sum()))
        if end < ends[-1]:
            with pytest.raises(Truncated):
                decode(data[:end])
    first = len(ends) - refining
    assert off[first - 1] > 0.5 * len(whole.anchor_q) and off[-1] == 0
    assert all(a > b for a, b in zip(off[first - 1 :], off[first:], strict=False))
    stream = open_stream()
    assert_same_scene(stream.feed(data)[-1], whole)


def test_slices_keep_to_their_size_and_the_report_has_the_low_bits():
    data, report = low(2)
    ends, refining = ends_of(data)
    rows = [row for layer in report.layers for row in layer.slices]
    assert np.cumsum([row.bytes for row in rows])[-1] == ends[-1] - (ends[0] - rows[0].bytes)
    assert all(row.bytes <= 1200 and row.anchors == 0 for row in rows[-refining:])
    (streams,) = ([s for s in layer.streams if s.name == "low_bits"] for layer in report.layers[-1:])
    assert streams[0].symbols == scene().widths.channels * sum(layer.anchors for layer in report.layers)
    assert [layer.symbols for layer in report.layers] == [layer.symbols for layer in low(0)[1].layers]
    assert 0 < streams[0].payload_bits < 8 * len(data) / 2
    assert [row["anchors"] for row in info(data)["layers"]] == [layer.anchors for layer in report.layers]
    assert len(data) < 1.15 * len(low(0)[0])


def test_what_is_left_out_would_have_cost_its_low_bits_too():
    plain, late = ([row["bytes"] for row in low(bits)[1].left_out if "anchors" in row["what"]] for bits in (0, 2))
    assert len(plain) == len(late) == 1 and plain[0] < late[0] < 1.3 * plain[0]


def test_without_slices_each_layer_is_refined_at_once():
    data, report = low(1, 0)
    assert [len(layer.slices) for layer in report.layers] == [1, 3] and ends_of(data)[1] == 2
    assert decode(data, max_layer=0).rows == decode(low(0, 0)[0], max_layer=0).rows
    assert hashes(data, 0) != hashes(low(0, 0)[0], 0) and hashes(data) == hashes(low(0, 0)[0])


# -- coarse symbols and their rests ------------------------------------------------------------------------------------


def layer_of(*rows, graded=False):
    """A layer whose attributes begin with these rows of symbols, and are 0 behind them."""
    layer = layer_symbols(
        plan(make_scene(1, anchors=60, layers=(0,), widths=Widths(1, 1), **TINY), EncodeOptions())[0], 0
    )
    n = len(rows[0])
    (layer,) = sliced(layer, [np.arange(n)])
    attributes = np.zeros((10, n), np.int32)
    attributes[: len(rows)] = rows
    return replace(layer, attributes=attributes)


def test_coarse_symbols_are_rounded_to_nearest_and_halves_to_even():
    layer = layer_of(range(-6, 7))
    expected = {
        0: list(range(-6, 7)),
        1: [-3, -2, -2, -2, -1, 0, 0, 0, 1, 2, 2, 2, 3],
        2: [-2, -1, -1, -1, 0, 0, 0, 0, 0, 1, 1, 1, 2],
        3: [-1, -1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1, 1],
        4: [0] * 13,
    }
    for bits, row in expected.items():
        k = coarse(layer, bits)
        assert k.attributes[0].tolist() == row and not k.attributes[1:].any()
        assert shifted(k, bits).attributes[0].tolist() == [v << bits for v in row]
    assert coarse(layer, 0) is layer and shifted(layer, 0) is layer


@pytest.mark.parametrize("bits", ALL_BITS)
def test_coarse_symbols_have_their_range(bits):
    most = MAX_SYMBOL >> bits
    assert shifted(layer_of([most, -most]), bits).attributes[0].tolist() == [MAX_SYMBOL, -MAX_SYMBOL]
    assert (
        np.abs(shifted(coarse(layer_of([MAX_SYMBOL - 1, 1 - MAX_SYMBOL]), bits), bits).attributes).max() <= MAX_SYMBOL
    )
    for k in (most + 1, -most - 1):
        with pytest.raises(Malformed, match=f"a coarse symbol over {most} in magnitude"):
            shifted(layer_of([0, k]), bits)


def test_the_example_of_the_specification():
    """Rests of zeros first, then of what is odd, then of the others, mirrored by their sign."""
    layer = layer_of([-6, -1, 0, 1, 3, 7])
    section = write_refinement([layer], 2, EncodeOptions()).payload
    k = coarse(layer, 2).attributes
    assert k[0].tolist() == [-2, 0, 0, 0, 1, 2]
    rests = decode_channels(section, [3, 1, 2] + [6, 0, 0] * 9)
    assert [channel.tolist() for channel in rests[:3]] == [[-1, 0, 1], [-1], [-2, -1]]
    (got,) = read_refinement(section, [shifted(coarse(layer, 2), 2)], 2)
    np.testing.assert_array_equal(got.attributes, layer.attributes)


@given(st.integers(1, MAX_LOW_BITS), st.lists(st.integers(0, 9), min_size=1, max_size=4), st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_refinement_of_any_slices_is_read_as_it_was_written(bits, sizes, seed):
    rng = np.random.default_rng(seed)
    if not sum(sizes):
        sizes = [*sizes, 1]
    spread = 10 ** rng.uniform(0, 6)
    rows = np.clip(np.rint(rng.normal(size=(10, sum(sizes))) * spread), -MAX_SYMBOL, MAX_SYMBOL).astype(np.int32)
    parts = sliced(layer_of(*rows), np.split(np.arange(sum(sizes)), np.cumsum(sizes)[:-1]))
    section = write_refinement(parts, bits, EncodeOptions(effort=int(rng.integers(1, 6)))).payload
    got = read_refinement(section, [shifted(coarse(part, bits), bits) for part in parts], bits)
    for part, fine in zip(parts, got, strict=True):
        np.testing.assert_array_equal(fine.attributes, part.attributes)


def test_tables_of_low_bits_are_small():
    """Of 17 entries at most for each of 236 channels, and 2^10 and one per symbol in all."""
    rng = np.random.default_rng(0)
    wide = make_scene(1, anchors=30, layers=(0,), kind="gaussian", widths=Widths(64, 16), **TINY)
    layer = layer_symbols(plan(wide, EncodeOptions())[0], 0)
    for rows in (1, 2, 4, 9):
        q = rng.integers(-200, 201, (layer.widths.channels, rows), dtype=np.int32)
        (part,) = sliced(replace(layer, attributes=np.resize(q, layer.attributes.shape)), [np.arange(rows)])
        section = write_refinement([part], 4, EncodeOptions(effort=5)).payload
        (got,) = read_refinement(section, [shifted(coarse(part, 4), 4)], 4)
        np.testing.assert_array_equal(got.attributes, part.attributes)


# -- what is refused ---------------------------------------------------------------------------------------------------


def test_options_that_cannot_be():
    for bits in (-1, MAX_LOW_BITS + 1):
        with pytest.raises(EncodeError, match=f"low_bits {bits}, expected one of"):
            EncodeOptions(low_bits=bits)
    with pytest.raises(EncodeError, match="low bits in mode lzma, expected mode ans or none"):
        EncodeOptions(low_bits=1, mode="lzma")


@pytest.mark.parametrize("verify", [False, True])
def test_coarse_attributes_over_the_range_are_refused_by_the_encoder(verify):
    """An attribute of step class 6 that lies within its range, and whose coarse symbol does not."""
    given_one = make_scene(2, anchors=3, layers=(0,), widths=Widths(1, 1, True), **TINY)
    k, n = (MAX_SYMBOL >> 6) - 1, len(given_one.anchor_q)
    step = given_one.steps.feature
    far = replace(
        given_one,
        feature=np.full((n, 1), (k << 6) * step, np.float32),
        grading=Grading(np.full(n, 6, np.uint8), np.zeros(given_one.widths.channels, np.float32)),
        mask=(np.full(n, 255, np.uint8),),
    )
    centre = quantise(np.float32([63 * step]), step, "feature")
    far = replace(far, grading=replace(far.grading, centre=np.r_[centre * step, far.grading.centre[1:]].astype("f4")))
    far = replace(far, feature=far.feature + np.float32(63 * step))
    assert decode(encode(far, omit="nothing", verify=verify)).rows == (n,)
    with pytest.raises(EncodeError, match="more than 8388608 steps from 0"):
        encode(far, omit="nothing", low_bits=1, verify=verify)


def test_symbols_of_low_bits_count_with_those_that_a_file_may_declare(monkeypatch):
    data = low(2)[0]
    _, layers, _ = decode_layers(data)
    declared = sum(a.size for layer in layers for a in layer.arrays())
    refined = sum(layer.attributes.size for layer in layers)
    monkeypatch.setattr("pd4dgs_codec.format.layer_meta.SYMBOLS_PER_BYTE", 0)
    monkeypatch.setattr("pd4dgs_codec.format.layer_meta.FREE_SYMBOLS", declared + refined - 1)
    with pytest.raises(LimitExceeded, match=f"{declared + refined} symbols in .* bytes"):
        decode(data)
    monkeypatch.setattr("pd4dgs_codec.format.layer_meta.FREE_SYMBOLS", declared + refined)
    decode(data)


def test_a_layer_is_merged_when_it_is_asked_for_and_not_at_each_refining_slice(monkeypatch):
    """Else a thousand refining slices of a large layer sort it a thousand times."""
    calls, merged = [], decoder.merged
    monkeypatch.setattr(decoder, "merged", lambda slices: calls.append(len(slices)) or merged(slices))
    many = make_scene(3, anchors=800, kind="gaussian", layers=(0, 1), widths=Widths(3, 2), **TINY)
    data = encode(many, effort=1, layers=2, slices=1000, low_bits=4)
    assert ends_of(data)[1] > 3
    calls.clear()
    decode(data)
    assert len(calls) == 3  # layer 0 for the rises of layer 1, and both at the end


def test_a_copy_of_a_reader_stays_what_it_is():
    from copy import copy

    data, reader, copies = low(2)[0], LayerReader(), []
    while reader.next_slice(data):
        copies.append((copy(reader), reader.scene()))
    for other, was in copies:
        assert_same_scene(other.scene(), was)
