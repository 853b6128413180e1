"""Faulty files: every one raises the package's own error, and never anything else."""

import struct
import tracemalloc
from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import make_scene, small_file

from pd4dgs_codec.bitstream import canonical
from pd4dgs_codec.bitstream.container import (
    FLAG_ANCILLARY,
    read_chunk,
    read_preamble,
    write_chunk,
    write_preamble,
)
from pd4dgs_codec.codec import header as header_module
from pd4dgs_codec.codec import layer_meta
from pd4dgs_codec.codec.decoder import decode, decode_layers
from pd4dgs_codec.codec.encoder import encode
from pd4dgs_codec.codec.header import scene_id_of, unpack_header
from pd4dgs_codec.codec.options import EncodeOptions
from pd4dgs_codec.codec.payload import write_layer
from pd4dgs_codec.errors import DecodeError, LimitExceeded, Malformed, Pd4Error, Truncated, UnsupportedFeature


@cache
def tiny_file():
    return encode(make_scene(1, layers=(0, 1), anchors=2, kind="constant", hidden=(), extent=1), layers=2, effort=1)


def take_apart(data):
    """(header map, [(type, flags, payload)])"""
    preamble = read_preamble(data)
    chunks, offset = [], preamble.size
    while offset < len(data):
        chunk = read_chunk(data, offset)
        chunks.append((chunk.type, chunk.flags, chunk.payload))
        offset = chunk.end
    return canonical.unpack(preamble.header), chunks


def put_together(header, chunks, scene_id=None):
    """A file with right lengths, ids and CRCs, whatever its payloads say."""
    header = {**header, header_module.CHUNKS: [[t, len(p)] for t, _, p in chunks]}
    packed = canonical.pack(header)
    scene_id = scene_id or scene_id_of(packed, chunks[0][2])
    framed = [write_chunk(t, f, scene_id, p) for t, f, p in chunks]
    return b"".join([write_preamble(packed), *framed])


def with_meta(payload, change):
    """`payload` with its parameter map changed."""
    (length,) = struct.unpack_from("<I", payload)
    meta = canonical.unpack(payload[4 : 4 + length])
    packed = canonical.pack(change(meta))
    return struct.pack("<I", len(packed)) + packed + payload[4 + length :]


def test_putting_together_what_was_taken_apart_changes_nothing():
    assert put_together(*take_apart(small_file())) == small_file()


def test_every_single_bit_flip_is_caught():
    for i in range(8 * len(tiny_file())):
        data = bytearray(tiny_file())
        data[i // 8] ^= 1 << i % 8
        with pytest.raises(DecodeError):
            decode(bytes(data))


def test_every_cut_is_caught():
    for size in range(len(tiny_file())):
        with pytest.raises(Truncated):
            decode(tiny_file()[:size])


@given(st.integers(0, 2), st.integers(0, 10**6), st.integers(1, 255), st.booleans())
@settings(max_examples=150)
def test_changed_payloads_behind_right_checksums_raise_only_our_errors(which, place, mask, cut):
    header, chunks = take_apart(small_file())
    kind, flags, payload = chunks[which]
    changed = bytearray(payload)
    place %= len(changed)
    if cut:
        del changed[place:]
    else:
        changed[place] ^= mask
    chunks[which] = (kind, flags, bytes(changed))
    try:
        scene = decode(put_together(header, chunks))
    except DecodeError as error:
        assert not isinstance(error, Truncated), "a payload is complete: no more bytes would help"
    else:  # some changes only change symbols
        assert np.isfinite(scene.feature).all()


@given(st.binary(max_size=200))
def test_arbitrary_bytes_raise_only_our_errors(junk):
    for data in (junk, small_file()[:20] + junk, small_file()[:8] + junk):
        with pytest.raises(Pd4Error):
            decode(data)


def test_a_layer_of_another_scene_is_refused():
    header, chunks = take_apart(small_file())
    other = encode(make_scene(8, anchors=20), layers=2, effort=1)
    mixed = [chunks[0], *take_apart(other)[1][1:]]
    header = {**header, header_module.CHUNKS: [[t, len(p)] for t, _, p in mixed]}
    first, *rest = (read_chunk(data, read_preamble(data).size) for data in (small_file(), other))
    framed = [write_chunk(t, f, (first, *rest)[i > 0].scene_id, p) for i, (t, f, p) in enumerate(mixed)]
    with pytest.raises(Malformed, match="belongs to scene"):
        decode(b"".join([write_preamble(canonical.pack(header)), *framed]))
    with pytest.raises(Malformed, match="layer-0 payload"):
        decode(put_together(*take_apart(small_file()), scene_id=b"12345678"))


def test_a_header_of_another_scene_is_refused():
    """Even one whose chunks have the same types and lengths, with a right CRC-32."""
    header, chunks = take_apart(small_file())
    for key, value in ((header_module.VOXEL_SIZE, 0.5), (64, "a key that decoders ignore")):
        front = write_preamble(canonical.pack({**header, key: value}))
        with pytest.raises(Malformed, match="from the header and the layer-0 payload"):
            decode(front + small_file()[read_preamble(small_file()).size :])


def test_a_scene_keeps_its_id_when_chunks_come_and_go():
    header, chunks = take_apart(small_file())
    extra = [(99, FLAG_ANCILLARY, b"x")] * 20  # a chunk list in its longer form
    ids = {
        read_chunk(data, read_preamble(data).size).scene_id
        for data in (small_file(), put_together(header, chunks[:2]), put_together(header, [*chunks, *extra]))
    }
    assert len(ids) == 1
    many = {**header, **{64 + i: i for i in range(10)}}  # a map in its longer form
    assert decode(put_together(many, chunks)).layers == (0, 1, 2)


def test_unknown_chunks_are_refused_if_critical_and_skipped_if_ancillary():
    header, chunks = take_apart(small_file())
    extra = [(99, FLAG_ANCILLARY, b"preview"), (98, FLAG_ANCILLARY, b"")]
    skipped = put_together(header, [chunks[0], extra[0], *chunks[1:], extra[1]])
    assert decode(skipped).layers == (0, 1, 2)
    assert decode(skipped, max_layer=0).layers == (0,)
    critical = put_together(header, [*chunks[:2], (99, 0, b"needed"), chunks[2]])
    with pytest.raises(UnsupportedFeature, match="type 99"):
        decode(critical)
    assert decode(critical, max_layer=1).layers == (0, 1)


def test_a_layer_is_critical_even_if_it_says_otherwise():
    header, chunks = take_apart(small_file())
    flagged = [chunks[0], (1, FLAG_ANCILLARY, chunks[1][2]), chunks[2]]
    with pytest.raises(Malformed, match="layer 1 is flagged ancillary"):
        decode(put_together(header, flagged))


def test_layer_order_is_checked():
    header, chunks = take_apart(small_file())
    for wrong in ([chunks[1]], [chunks[0], chunks[2], chunks[1]], [chunks[0], chunks[1], chunks[1]]):
        with pytest.raises(Malformed, match="layer 0 first"):
            decode(put_together(header, wrong))


def test_unknown_header_keys():
    header, chunks = take_apart(small_file())
    assert decode(put_together({**header, 64: "later", 1000: [1]}, chunks)).layers == (0, 1, 2)
    with pytest.raises(UnsupportedFeature, match="key 63"):
        decode(put_together({**header, 63: 1}, chunks))


def test_the_header_is_a_map():
    _, chunks = take_apart(small_file())
    framed = write_chunk(0, 0, bytes(8), chunks[0][2])
    with pytest.raises(Malformed, match="header: list, expected a map"):
        decode(write_preamble(canonical.pack([1, 2])) + framed)


CAMERA = {1: [1.0] * 12, 2: [500.0, 0.0, 320.0, 240.0], 3: 640, 4: 480}  # a focal length of 0


@pytest.mark.parametrize(
    "key, value, message",
    [
        (header_module.BOX, [0.0, 0.0, 1.0, 1.0, 1.0, 0.5], "lower corner"),
        (header_module.TIME_RANGE, [2.0, 1.0], "time range 2.0..1.0"),
        (header_module.BACKGROUND, [0.0, 1.5, 0.0], "expected 0..1"),
        (header_module.NEAR_FAR, [4.0, 4.0], "near 4.0 and far 4.0"),
        (header_module.UNIT, -1.0, "unit -1.0"),
        (header_module.CAMERA, CAMERA, "focal lengths"),
        (header_module.ERROR_BOUNDS, dict.fromkeys(range(8), -0.5), "error bound -0.5 of feature"),
    ],
)
def test_values_that_no_player_could_use_are_malformed(key, value, message):
    header, chunks = take_apart(small_file())
    with pytest.raises(Malformed, match=message):
        decode(put_together({**header, key: value}, chunks))


HEADER_FAULTS = {
    header_module.MODE: (7, UnsupportedFeature),
    header_module.DEFORMATION: (2, UnsupportedFeature),
    header_module.STEPS: ([0.0, 1.0, 1.0], Malformed),
    header_module.VOXEL_SIZE: (-1.0, Malformed),
    header_module.BOX: ([1.0] * 5, Malformed),
    header_module.BACKGROUND: ([1, 2, 3], Malformed),
    header_module.NEAR_FAR: (1.0, Malformed),
    header_module.UNIT: (True, Malformed),
    header_module.CAMERA: ({1: [0.0] * 12}, Malformed),
    header_module.ERROR_BOUNDS: ({0: 0.5, 1: 0.5, 2: 0.5}, Malformed),
}


@pytest.mark.parametrize("key", HEADER_FAULTS)
def test_header_fields_are_checked(key):
    header, chunks = take_apart(small_file())
    value, error = HEADER_FAULTS[key]
    with pytest.raises(error):
        decode(put_together({**header, key: value}, chunks))
    if key != header_module.CAMERA:
        del header[key]
        with pytest.raises(Malformed, match="missing"):
            decode(put_together(header, chunks))


def with_networks(meta, change):
    return {**meta, layer_meta.NETWORKS: [change(network) for network in meta[layer_meta.NETWORKS]]}


META_FAULTS = {
    "rows": (lambda m: {**m, layer_meta.ROWS: 1 << 25}, LimitExceeded),
    "more rows": (lambda m: {**m, layer_meta.ROWS: m[layer_meta.ROWS] + 1}, DecodeError),
    "negative rows": (lambda m: {**m, layer_meta.ROWS: -1}, Malformed),
    "section": (lambda m: {**m, layer_meta.SECTIONS: {**m[layer_meta.SECTIONS], 1: 5}}, Malformed),
    "unknown section": (lambda m: {**m, layer_meta.SECTIONS: {**m[layer_meta.SECTIONS], 9: 1}}, UnsupportedFeature),
    "step": (lambda m: {**m, layer_meta.STEPS: [0.0] * len(m[layer_meta.STEPS])}, Malformed),
    "networks": (lambda m: {**m, layer_meta.NETWORKS: m[layer_meta.NETWORKS][::-1]}, Malformed),
    "network": (lambda m: {**m, layer_meta.NETWORKS: [[9, 3]]}, UnsupportedFeature),
    "width": (lambda m: with_networks(m, lambda n: [n[0], 5000, *n[1:]]), LimitExceeded),
    "outputs": (lambda m: with_networks(m, lambda n: [n[0], n[-1] + 1]), DecodeError),
    "unknown key": (lambda m: {**m, 9: 1}, UnsupportedFeature),
}


@pytest.mark.parametrize("which", [0, 2])
@pytest.mark.parametrize("name", META_FAULTS)
def test_layer_parameters_are_checked(name, which):
    change, error = META_FAULTS[name]
    header, chunks = take_apart(small_file())
    kind, flags, payload = chunks[which]
    chunks[which] = (kind, flags, with_meta(payload, change))
    with pytest.raises(error) as caught:
        decode(put_together(header, chunks))
    assert caught.value.chunk == which


def without(meta, key):
    return {k: v for k, v in meta.items() if k != key}


DEFORMATION_FAULTS = {
    "missing without reason": (lambda m: without(m, layer_meta.NETWORKS), "key 3 is there without reason"),
    "no scales": (lambda m: without(m, layer_meta.SCALES), "key 4 is missing"),
    "other channels": (lambda m: {**m, layer_meta.SCALES: [[2, *[1] * 4, *[0] * 6], [3, *[1] * 4, *[0] * 6]]}, "3 cha"),
    "empty network": (lambda m: {**m, layer_meta.NETWORKS: [[0, 3], []]}, "an empty network entry"),
    "no head": (lambda m: {**m, layer_meta.NETWORKS: m[layer_meta.NETWORKS][:1]}, "at least one head"),
    "outputs of a head": (lambda m: {**m, layer_meta.NETWORKS: [[0, 3], [1, 4]]}, "4 outputs, expected 3"),
}


@pytest.mark.parametrize("name", DEFORMATION_FAULTS)
def test_deformations_are_whole(name):
    change, message = DEFORMATION_FAULTS[name]
    header, chunks = take_apart(small_file())
    chunks[1] = (1, 0, with_meta(chunks[1][2], change))
    with pytest.raises(Malformed, match=message):
        decode(put_together(header, chunks))


def test_scaffold_networks_are_all_there():
    header, chunks = take_apart(small_file())
    changed = with_meta(chunks[0][2], lambda m: {**m, layer_meta.NETWORKS: m[layer_meta.NETWORKS][:2]})
    with pytest.raises(Malformed, match="expected .'opacity', 'covariance', 'color'"):
        decode(put_together(header, [(0, 0, changed), *chunks[1:]]))


def test_float32_planes_have_no_predictor():
    header, chunks = take_apart(encode(make_scene(7, anchors=3), layers=2, effort=1, deformation="float32"))
    rows = [[2, 3, 2, 4, 5, 0, 0, 1, 0, 0, 0]]
    chunks[1] = (1, 0, with_meta(chunks[1][2], lambda m: {**m, layer_meta.SCALES: rows}))
    with pytest.raises(Malformed, match="predictor 1 on float32 planes"):
        decode(put_together(header, chunks))


def test_planes_are_bounded_however_long_the_payload(monkeypatch):
    monkeypatch.setattr(layer_meta, "MAX_PLANE_CELLS", 100)
    with pytest.raises(LimitExceeded, match="planes of 142 cells, limit 100"):
        decode(small_file())


@pytest.mark.parametrize(
    "payload, message",
    [
        (b"\0\0\0", "payload of 3 bytes, expected at least 4"),
        (b"\5\0\0\0\x80", "parameters of 5 bytes in a payload of 5"),
    ],
)
def test_a_payload_holds_its_parameters(payload, message):
    header, chunks = take_apart(small_file())
    with pytest.raises(Malformed, match=message):
        decode(put_together(header, [(0, 0, payload), *chunks[1:]]))


def test_sections_fill_the_payload_and_belong_to_the_mode():
    header, chunks = take_apart(small_file())
    longer = [(0, 0, chunks[0][2] + b"?"), *chunks[1:]]
    with pytest.raises(Malformed, match="sections of"):
        decode(put_together(header, longer))
    section = {int(layer_meta.Section.FLOATS): 1}
    change = partial(with_meta, change=lambda m: {**m, 2: {**m[2], **section}})
    with pytest.raises(Malformed, match="section 6 is there, but nothing is left"):
        decode(put_together(header, [(0, 0, change(chunks[0][2]) + b"?"), *chunks[1:]]))
    with pytest.raises(Malformed, match="section symbols is missing"):
        decode(put_together({**header, header_module.MODE: header_module.MODES["lzma"]}, chunks))


def written(which, **changes):
    """small_file() with arrays of one layer replaced before they are coded, by the layer writer itself."""
    header, layers, _ = decode_layers(small_file())
    fields, chunks = take_apart(small_file())
    changed = replace(layers[which], **{name: change(getattr(layers[which], name)) for name, change in changes.items()})
    chunks[which] = (which, 0, write_layer(changed, EncodeOptions(effort=1))[0])
    return put_together(fields, chunks)


def with_first(value):
    def change(array):
        array = array.copy()
        array.flat[0] = value
        return array

    return change


SYMBOL_FAULTS = {
    "a voxel index over 1048576": (0, {"anchor_q": lambda a: (a + (1 << 20)).astype(np.int32)}),
    "rise of a mask code in -1": (1, {"mask_increase": with_first(-1)}),
    "layer 0: mask code in 2": (0, {"mask_own": with_first(2)}),
    "layer 1: mask code in .*256, expected 3..255": (1, {"mask_own": with_first(256)}),
    "layer 2: mask code .*, expected at most 255": (2, {"mask_increase": lambda a: np.full_like(a, 255)}),
    "a symbol over 8388608 in magnitude": (0, {"attributes": with_first((1 << 23) + 1)}),
}


@pytest.mark.parametrize("message", SYMBOL_FAULTS)
def test_symbols_out_of_range_are_malformed(message):
    which, changes = SYMBOL_FAULTS[message]
    with pytest.raises(Malformed, match=message):
        decode(written(which, **changes))


@pytest.mark.parametrize(
    "row", [[2, 1, 1, 1], [2, 9999, 1, 1, 1, *[0] * 6], [0, 1, 1, 1, 1, *[0] * 6], [2, 3, 2, 4, 5, *[77] * 6]]
)
def test_plane_parameters_are_checked(row):
    header, chunks = take_apart(small_file())
    chunks[1] = (1, 0, with_meta(chunks[1][2], lambda m: {**m, layer_meta.SCALES: [row]}))
    with pytest.raises((Malformed, LimitExceeded, UnsupportedFeature)):
        decode(put_together(header, chunks))


def test_a_few_bytes_cannot_ask_for_gigabytes():
    """Constant channels cost nothing to code, so the declared sizes themselves are bounded by the payload."""
    header, chunks = take_apart(small_file())
    bombs = (
        lambda m: {**m, layer_meta.ROWS: (1 << 24) - 100},
        lambda m: {**m, layer_meta.ROWS: (1 << 13) + 2 * len(chunks[1][2]) + 40},
        lambda m: {**m, layer_meta.SCALES: [[256, 1000, 1000, 1, 1, *[0] * 6]]},
    )
    for bomb in bombs:
        data = put_together(header, [chunks[0], (1, 0, with_meta(chunks[1][2], bomb)), chunks[2]])
        tracemalloc.start()
        try:
            with pytest.raises(LimitExceeded):
                decode(data)
            assert tracemalloc.get_traced_memory()[1] < 4 << 20
        finally:
            tracemalloc.stop()


def test_parameters_are_small():
    """msgpack takes up to 130 times its bytes in memory."""
    header, chunks = take_apart(small_file())
    changed = [(0, 0, with_meta(chunks[0][2], lambda m: {**m, 64: [[]] * 4096})), *chunks[1:]]
    with pytest.raises(LimitExceeded, match="parameters of 4"):
        decode(put_together(header, changed))


def test_values_that_overflow_float32_are_malformed():
    header, chunks = take_apart(small_file())
    with pytest.raises(Malformed, match="not finite"):
        decode(put_together({**header, header_module.STEPS: [2.0**127] * 3}, chunks))


def test_a_voxel_in_two_layers_is_malformed():
    scene = make_scene(7, layers=(0, 1), anchors=20)
    header, chunks = take_apart(encode(replace(scene, mask=(scene.mask[1], scene.mask[1])), layers=2, effort=1))
    both = [chunks[0], (1, 0, _same_anchors_again(scene))]
    with pytest.raises(Malformed, match="more than one anchor"):
        decode(put_together(header, both))


def _same_anchors_again(scene):
    """A layer-1 payload whose own anchors are those of layer 0, made by the layer writer itself."""
    from pd4dgs_codec.codec.plan import plan
    from pd4dgs_codec.codec.symbols import layer_symbols

    planned, _ = plan(replace(scene, mask=(scene.mask[1], scene.mask[1])), EncodeOptions(layers=2))
    first, second = (layer_symbols(planned, i) for i in (0, 1))
    again = replace(second, anchor_q=first.anchor_q, mask_own=first.mask_own, attributes=first.attributes)
    return write_layer(again, EncodeOptions(effort=1))[0]


def test_the_header_is_small():
    assert len(read_preamble(small_file()).header) < 512
    assert unpack_header(read_preamble(small_file()).header).mode == "ans"
