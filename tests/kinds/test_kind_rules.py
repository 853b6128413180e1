"""Kinds: tensors decode whatever their kind, a scene is made of known kinds alone, and only if their rules hold."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from strategies import assert_same_scene, small_file

from pd4dgs_codec import decode, open_stream
from pd4dgs_codec.errors import DecodeError, Malformed, UnsupportedFeature
from pd4dgs_codec.format.container import slice_flags, write_chunk, write_preamble
from pd4dgs_codec.format.header import pack_header, scene_id_of
from pd4dgs_codec.format.info import hashes, info
from pd4dgs_codec.format.options import EncodeOptions
from pd4dgs_codec.format.payload import write_slice
from pd4dgs_codec.format.reader import decode_tensors, read_layers
from pd4dgs_codec.tensors.quantise import Rows, RowTable
from pd4dgs_codec.tensors.tables import Chain, Grid, Tables, Tensors


@cache
def symbols():
    """(header, layers) of the small file."""
    return read_layers(small_file())


def file_of(layers, **changes):
    """A file of these layers. changes: of the small file's header."""
    parts = [(part.layer, write_slice(part, EncodeOptions(effort=1))[0]) for part in layers]
    chunks = tuple((layer, len(payload)) for layer, payload in parts)
    header = replace(symbols()[0], chunks=chunks, **changes)
    packed = pack_header(header)
    written = [write_chunk(layer, slice_flags(0, 1), scene_id_of(packed), payload) for layer, payload in parts]
    return write_preamble(packed) + b"".join(written)


def zeros(tables):
    """Tensors of these tables."""
    shapes = [np.zeros(shape, np.int32) for shape in (*tables.planes, *tables.weights)]
    return Tensors(tables, shapes[: len(tables.planes)], shapes[len(tables.planes) :])


def with_tables(layer, **changes):
    """The small file, with other tables in a layer."""
    header, layers = symbols()
    tables = replace(layers[layer].tensors.tables, **changes)
    tensors, rows = (
        zeros(tables),
        layers[layer].rows[:1, :1].repeat(len(layers[layer].rises) + len(layers[layer].codes), 1),
    )
    changed = replace(layers[layer], tensors=tensors, **({"layer_rows": rows} if tables.rows else {}))
    return file_of([changed if part.layer == layer else part for part in layers])


def test_tensors_are_those_of_the_scene():
    scene, layers = decode(small_file()), decode_tensors(small_file())
    first = 0
    for layer, rows in zip(layers, scene.rows, strict=True):
        own, first = slice(first, rows), rows
        np.testing.assert_array_equal(layer.voxels, scene.anchor_q[own])
        np.testing.assert_array_equal(layer.positions, scene.anchor[own])
        np.testing.assert_array_equal(layer.codes, scene.mask[layer.layer])
        assert list(layer.rows) == [0, 1, 2] and not layer.classes.any()
        for values, expected in zip(layer.rows.values(), scene.attributes.values(), strict=True):
            np.testing.assert_array_equal(values, expected[own].reshape(len(values), -1))
    assert [layer.kind for layer in layers] == [(), (0,), (0,)]
    for layer, field in ((1, scene.global_deformation), (2, scene.local_deformation)):
        np.testing.assert_equal(list(layers[layer].grids[0]), list(field.planes[0].values()))
        names = ("trunk", "position", "feature", "scaling", "offset")
        np.testing.assert_equal([*layers[layer].chains.values()], [field.networks[name] for name in names])
    assert [layer.layer for layer in decode_tensors(small_file(), max_layer=1)] == [0, 1]


def test_an_unknown_scene_of_any_forms_decodes_to_tensors():
    """Grids in layer 0, of one to three axes; rows and chains that no kind of today has."""
    header, layers = symbols()
    grids, chains = (Grid(3, 2, (4,)), Grid(9, 5, (2, 3, 4))), (Chain(200, (7, 2)),)
    tables = Tables(grids, chains, 0.5, 0.25, (65535, 1), (Rows(8, 2, 0.5),))
    rows = RowTable((Rows(17, 1, 2.0), Rows(255, 3, 0.25, 1)))
    first = replace(layers[0], table=rows, tensors=zeros(tables), rows=layers[0].rows[:4])
    first = replace(first, layer_rows=layers[0].rows[4:6])
    data = file_of([first], kind=(7, 3), table=rows)
    (found,) = decode_tensors(data)
    assert {i: [p.shape for p in planes] for i, planes in found.grids.items()} == {
        3: [(2, 1, 4)],
        9: [(5, 3, 2), (5, 4, 2), (5, 4, 3)],
    }
    assert found.kind == (65535, 1) and [w.shape for w, _ in found.chains[200]] == [(2, 7)]
    np.testing.assert_array_equal(found.rows[255], first.rows[1:].T * np.float32(0.25))
    np.testing.assert_array_equal(found.layer_rows[8], first.layer_rows.T * np.float32(0.5))
    told = info(data)
    assert told["kind"] == [7, 3] and told["rows"] == [[17, 1, 2.0, 0], [255, 3, 0.25, 1]] and "slots" not in told
    assert told["layers"][0]["grids"] == [[3, 2, 4], [9, 5, 2, 3, 4]]
    assert told["layers"][0]["layer_rows"] == [[8, 2, 0.5, 0]]
    assert told["layers"][0]["chains"] == [[200, 7, 2]] and told["layers"][0]["kind"] == [65535, 1]
    assert len(hashes(data)) == 1
    for door in (decode, open_stream().feed):
        with pytest.raises(UnsupportedFeature, match=r"^scene of kind 7, expected 0 \(scaffold\)"):
            door(data)


def test_an_unknown_deformation_ends_the_scene_at_its_layer():
    data = with_tables(1, kind=(4,))
    assert len(decode_tensors(data)) == 3 and info(data)["layers"][1]["kind"] == [4]
    assert_same_scene(decode(data, max_layer=0), decode(small_file(), max_layer=0))
    with pytest.raises(UnsupportedFeature, match=r"layer 1: deformation of kind 4, expected 0 \(hexplane\)") as caught:
        decode(data)
    assert caught.value.chunk == 1
    stream = open_stream()
    assert [scene.layers for scene in stream.feed(data)] == [(0,)]
    with pytest.raises(UnsupportedFeature):
        stream.finish()


def chains(*widths):
    return tuple(Chain(i, own) for i, own in widths)


WIDE, TRUNK, POSITION = Grid(0, 2, (3, 2, 4, 5)), (0, (2, 3)), (1, (3, 3))
#: Rule -> (layer, what is other in its tables, what the error says).
BROKEN = {
    "layer 0 with a grid": (0, {"grids": (Grid(0, 1, (2,)),), "grid_step": 1.0}, "layer 0: grids, layer rows or"),
    "layer 0 with a deformation": (0, {"kind": (0,)}, "layer 0: grids, layer rows or a deformation"),
    "layer 0 with layer rows": (0, {"rows": (Rows(0, 1, 1.0),)}, "layer 0: grids, layer rows or a deformation"),
    "layer 1 with layer rows": (1, {"rows": (Rows(0, 1, 1.0),)}, "layer 1: a deformation of rows, or without"),
    "layer 0 without a network": (0, {"chains": chains((0, (35, 10)), (1, (35, 70)))}, r"layer 0: chains \[\(0, "),
    "layer 0 with another input": (
        0, {"chains": chains((0, (32, 10)), (1, (35, 70)), (2, (35, 30)))}, r"expected \[\(0, 35, 10\)",
    ),
    "no kind": (1, {"kind": ()}, "layer 1: deformation without a kind, expected hexplane"),
    "no grids": (1, {"grids": ()}, "layer 1: a deformation of rows, or without"),
    "no chains": (2, {"chains": ()}, "layer 2: a deformation of rows, or without"),
    "a kind of three integers": (1, {"kind": (0, 1, 2)}, r"layer 1: deformation \[0, 1, 2\]"),
    "three axes": (1, {"grids": (Grid(0, 2, (3, 2, 4)),)}, "layer 1 grid 0: 3 sides and 2 channels, expected 4 and 2"),
    "other channels than below": (2, {"grids": (Grid(0, 3, (1, 1, 1, 1)),)}, "layer 2 grid 0: .* expected 4 and 2"),
    "nine grids": (1, {"grids": tuple(Grid(i, 1, (1,) * 4) for i in range(9))}, "9 grids, expected at most 8"),
    "no trunk": (1, {"chains": chains(POSITION, (2, (3, 32)))}, r"chains \[1, 2\], expected 0 \(trunk\) and"),
    "no head": (1, {"chains": chains(TRUNK)}, r"chains \[0\], expected 0 \(trunk\) and"),
    "a chain of no meaning": (1, {"chains": chains(TRUNK, (5, (3, 3)))}, r"chains \[0, 5\], expected"),
    "a trunk of other inputs": (2, {"chains": chains(TRUNK, POSITION)}, "layer 2 trunk: 2 inputs, expected 4"),
    "a head of other inputs": (1, {"chains": chains(TRUNK, (1, (4, 3)))}, r"position: .* \(4, 3\), expected \(3, 3\)"),
    "a head of other outputs": (1, {"chains": chains(TRUNK, (3, (3, 30)))}, r"scaling: .* expected \(3, 6\)"),
}  # fmt: skip


@pytest.mark.parametrize("rule", BROKEN)
def test_a_broken_rule_is_malformed_at_its_slice(rule):
    layer, changes, says = BROKEN[rule]
    data = with_tables(layer, **changes)
    assert len(hashes(data)) == len(decode_tensors(data)) == 3
    with pytest.raises(Malformed, match=says) as caught:
        decode(data)
    assert caught.value.chunk == layer and "\n" not in str(caught.value)
    assert "grids" in info(data)["layers"][layer], "info lists tensors that keep no kind's rules"
    if layer:
        assert decode(data, max_layer=layer - 1).level == layer - 1


@pytest.mark.parametrize(
    "kind, rows",
    [((0,), None), ((0, 10), None), ((0, 0, 7), None), ((0, 17, 7), None), ((0, 10, 8), None), ((0, 10, 7, 0), None)]
    + [((0, 10, 7), rows) for rows in ([(0, 65), (1, 6), (2, 30)], [(0, 32), (1, 6), (3, 30)], [(0, 32), (1, 6)])]
    + [((0, 9, 7), [(0, 32), (1, 6), (2, 30)]), ((0, 10, 7), [(0, 32), (1, 6), (2, 30), (3, 1)])],
)
def test_a_header_that_breaks_the_rules_of_its_kind(kind, rows):
    header, layers = symbols()
    table = header.table if rows is None else RowTable(tuple(Rows(i, c, 0.5) for i, c in rows))
    first = replace(layers[0], table=table, rows=np.zeros((table.channels, len(layers[0].codes)), np.int32))
    data = file_of([first], kind=kind, table=table)
    assert len(decode_tensors(data)) == 1
    with pytest.raises(Malformed, match="header: (kind|rows)"):
        decode(data)


def test_layers_without_grids_and_chains_have_no_deformation():
    header, layers = symbols()
    data = file_of([layers[0], replace(layers[1], tensors=Tensors(Tables()))])
    scene = decode(data)
    assert scene.layers == (0, 1) and scene.global_deformation is None
    assert info(data)["layers"][1]["networks"] == {}


def test_old_drafts_are_refused_in_one_line():
    data = bytearray(small_file())
    data[8] = 4
    with pytest.raises(DecodeError, match=r"format version 4.0, .* reads 5.x; drafts before 5.0 .* encode .* again"):
        decode(bytes(data))
    data[8] = 6
    with pytest.raises(DecodeError, match=r"format version 6.0, this decoder reads 5.x \(offset 8\)$"):
        decode(bytes(data))


def test_the_spread_of_the_highest_layer_holds():
    _, layers = symbols()
    data = file_of([replace(layers[0], fill=(51, 0, 255, 96)), layers[1], replace(layers[2], fill=(0, 0, 0, 255))])
    scene, spreads = decode(data), [2.5, 1.0, 1 + 255 / 64]
    assert scene.background(0) == (0.2, 0.0, 1.0) and scene.fills[0] == (51, 0, 255, 96)
    assert [scene.spread(level) for level in range(3)] == spreads
    assert [decode(data, max_layer=level).spread() for level in range(3)] == spreads
    assert hashes(data) == hashes(small_file())


def test_the_fill_of_the_highest_layer_is_its_background():
    header, layers = symbols()
    data = file_of([replace(layers[0], fill=(51, 0, 255)), layers[1], replace(layers[2], fill=(0, 0, 0))])
    scene = decode(data)
    assert scene.fills == ((51, 0, 255), None, (0, 0, 0))
    backgrounds = [(0.2, 0.0, 1.0), scene.info.background, (0.0, 0.0, 0.0)]
    assert [scene.background(level) for level in range(3)] == backgrounds
    assert [decode(data, max_layer=level).background() for level in range(3)] == backgrounds
    assert replace(scene, fills=()).background(0) == scene.info.background
    assert [layer.fill for layer in decode_tensors(data)] == [(51, 0, 255), None, (0, 0, 0)]
    assert [row["slices"][0]["fill"] for row in info(data)["layers"]] == [[51, 0, 255], None, [0, 0, 0]]
    assert hashes(data) == hashes(small_file())
