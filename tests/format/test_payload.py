"""Slices as payloads: tensors of all forms and sizes come back in both modes; step classes and earlier slices pay."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import assert_same_symbols

from pd4dgs_codec.entropy.priors import K_MAX
from pd4dgs_codec.errors import EncodeError, Malformed
from pd4dgs_codec.format.options import EncodeOptions
from pd4dgs_codec.format.parameters import Declared, with_fill
from pd4dgs_codec.format.payload import read_slice, write_slice
from pd4dgs_codec.morton import MAX_VOXEL, morton_order
from pd4dgs_codec.scene import MAX_CLASS
from pd4dgs_codec.tensors.quantise import MAX_SYMBOL, NO_CLASSES, Rows, RowTable
from pd4dgs_codec.tensors.symbols import LayerSymbols, sliced
from pd4dgs_codec.tensors.tables import Chain, Grid, Tables, Tensors

FAST = EncodeOptions(effort=1)
LZMA = EncodeOptions(effort=1, mode="lzma")
START = Declared()


def rows_of(channels, predictors=(0,)):
    """Tensors of rows with these numbers of channels; predictors repeat."""
    return tuple(Rows(7 * i, c, 0.5, predictors[i % len(predictors)]) for i, c in enumerate(channels))


def table_of(channels, graded=False, predictors=(0,)):
    centre = np.arange(sum(channels), dtype=np.int32) % 5 - 2
    return RowTable(rows_of(channels, predictors), centre if graded else None)


def random_symbols(rng, shape, scale):
    """int32: constant, small, or with heavy tails up to the limit."""
    if rng.random() < 0.3:
        return np.full(shape, int(rng.integers(-5, 6)), np.int32)
    top = scale if rng.random() < 0.1 else min(scale, 3)  # fitting priors to wide channels takes time
    return np.clip(np.rint(rng.standard_t(2, shape) * top), -MAX_SYMBOL, MAX_SYMBOL).astype(np.int32)


def random_values(rng, table, classes, n, scale):
    """Values of n rows. Sums of symbols stay within the limit."""
    scale = min(scale, 50) if table.graded or any(tensor.predictor for tensor in table.tensors) else scale
    symbols = np.array([random_symbols(rng, n, scale) for _ in range(table.channels)], np.int32)
    return table.values(np.clip(symbols, -scale - 999, scale + 999).reshape(table.channels, n), classes)


def random_layer(rng, table, rows=30, rises=0, tables=None, scale=3, extent=9):
    """A layer with these tables."""
    cells = np.unique(rng.integers(-extent, extent + 1, (rows, 3), dtype=np.int32), axis=0)
    n, tables = len(cells), Tables() if tables is None else tables
    classes = rng.integers(0, MAX_CLASS + 1, rises + n, dtype=np.int32) if table.graded else NO_CLASSES
    layer = LayerSymbols(
        layer=1,
        table=table,
        anchor_q=cells[morton_order(cells)],
        rises=rng.integers(0, 9, rises, dtype=np.int32),
        codes=rng.integers(3, 256, n, dtype=np.int32),
        classes=classes[rises:],
        earlier=classes[:rises],
        rows=random_values(rng, table, classes[rises:], n, scale),
        tensors=Tensors(
            tables,
            [random_symbols(rng, shape, scale) for shape in tables.planes],
            [random_symbols(rng, shape, scale) for shape in tables.weights],
        ),
    )
    if not tables.rows:
        return layer
    return replace(layer, layer_rows=random_values(rng, layer.layer_table, classes, rises + n, scale))


def read(payload, layer, mode="ans", before=START, of=None, past=None):
    return read_slice(payload, layer.layer, layer.table, mode, before, of, layer.earlier, past)


def assert_comes_back(layer, options, before=START):
    found, declared = read(write_slice(layer, options)[0], layer, options.mode, before)
    assert_same_symbols(found.arrays(), layer.arrays())
    assert found.fill == layer.fill and found.tensors.tables.kind == layer.tensors.tables.kind
    assert declared.rows == before.rows + len(layer.codes)
    return found


@st.composite
def grids(draw):
    """Up to three grids of one to four axes, each with channels of its own."""
    sides = st.lists(st.integers(1, 6), min_size=1, max_size=4).map(tuple)
    drawn = draw(st.lists(st.tuples(st.integers(1, 9), sides), max_size=3))
    return tuple(Grid(5 * i, channels, sides) for i, (channels, sides) in enumerate(drawn))


@st.composite
def chains(draw):
    """Up to three chains of one to three linear layers."""
    drawn = draw(st.lists(st.lists(st.integers(1, 5), min_size=2, max_size=4), max_size=3))
    return tuple(Chain(2 * i, tuple(widths)) for i, widths in enumerate(drawn))


@given(grids(), chains(), st.data())
@settings(max_examples=40)
def test_tensors_of_any_tables_come_back(grids, chains, data):
    rng = np.random.default_rng(data.draw(st.integers(0, 1000)))
    widths, predictors = st.lists(st.integers(1, 6), max_size=3), data.draw(st.sampled_from(((0,), (1,), (0, 1))))
    table = table_of([2, *data.draw(widths)], data.draw(st.booleans()), predictors)
    more = {
        "kind": data.draw(st.sampled_from(((), (0,), (65535, 0, 7)))),
        "rows": rows_of(data.draw(widths), predictors),
    }
    tables = Tables(grids, chains, 0.5 if grids else 0.0, 0.25 if chains else 0.0, **more)
    scale = data.draw(st.sampled_from((1, 50, MAX_SYMBOL)))
    rows, extent = data.draw(st.integers(1, 40)), data.draw(st.sampled_from((2, 30, MAX_VOXEL // 2)))
    layer = random_layer(rng, table, rows, data.draw(st.integers(0, 20)), tables, scale, extent)
    layer = replace(layer, fill=data.draw(st.sampled_from((None, (0, 7, 255)))))
    if data.draw(st.booleans()):
        layer = sliced(layer, np.zeros(0, np.int64), True)
    options = data.draw(st.sampled_from((FAST, LZMA, EncodeOptions(effort=3), EncodeOptions(priors="gauss"))))
    given = write_slice(replace(layer, fill=data.draw(st.sampled_from((None, (9, 9, 9))))), options)[0]
    assert with_fill(given, layer.fill) == write_slice(layer, options)[0]
    found = assert_comes_back(layer, options, Declared(rows=len(layer.rises)))
    grids_of = found.tensors.grids
    assert [len(grids_of[grid.id]) for grid in grids] == [max(len(g.sides) * (len(g.sides) - 1) // 2, 1) for g in grids]
    for chain in chains:
        assert [w.shape[1] for w, _ in found.tensors.chains[chain.id]] == list(chain.widths[:-1])


def test_a_grid_has_a_plane_per_pair_of_axes():
    """In the order xy, xz, xt, yz, yt, zt, with the second axis along the rows."""
    assert Grid(0, 3, (2, 5, 7, 11)).planes == [(3, 5, 2), (3, 7, 2), (3, 11, 2), (3, 7, 5), (3, 11, 5), (3, 11, 7)]
    assert Grid(0, 3, (2, 5)).planes == [(3, 5, 2)] and Grid(0, 1, (6,)).planes == [(1, 1, 6)]


def test_without_symbols_nothing_follows_the_parameters():
    table = table_of([3])
    layer = random_layer(np.random.default_rng(0), table, 0)
    for options in (FAST, LZMA):
        payload, _ = write_slice(layer, options)
        assert payload == bytes.fromhex("05000000 82 0100 0200")
        assert_comes_back(layer, options)
        for fault in (payload + bytes(4), payload + b"\x00"):
            with pytest.raises(Malformed):
                read(fault, layer, options.mode)


def test_the_largest_residuals_and_differences_come_back():
    """Planes whose samples alternate between the limits, and voxels at both ends of an axis."""
    table, ends = table_of([1]), np.array([[-MAX_VOXEL, 0, 0], [MAX_VOXEL - 1, 0, 0]], np.int32)
    k = np.where(np.indices((2, 6, 6)).sum(axis=0) % 2, MAX_SYMBOL, -MAX_SYMBOL).astype(np.int32)
    layer = random_layer(np.random.default_rng(0), table, 2, tables=Tables((Grid(0, 2, (6, 6)),), grid_step=0.5))
    layer = replace(layer, tensors=replace(layer.tensors, planes=[k]), anchor_q=ends)
    for options in (FAST, LZMA):
        assert_comes_back(layer, options)
    wide = replace(layer, anchor_q=ends + np.array([[0, 0, 0], [1, 0, 0]], np.int32))
    for options in (FAST, LZMA):
        with pytest.raises(EncodeError, match="positions span 2097153 voxels on one axis"):
            write_slice(wide, options)


@pytest.mark.parametrize("cells", [[[0, 0, 0], [0, 0, 0]], [[1, 0, 0], [0, 0, 0]], [[0, 0, 0], [0, 0, MAX_VOXEL + 1]]])
def test_voxels_of_mode_lzma_ascend_within_their_range(cells, monkeypatch):
    table = table_of([1])
    layer = replace(random_layer(np.random.default_rng(0), table, 2), anchor_q=np.array(cells, np.int32))
    with pytest.raises(Malformed, match="voxels"):
        read(write_slice(layer, LZMA)[0], layer, "lzma")


def test_symbols_beyond_their_range_are_refused():
    table = table_of([2], graded=True)
    layer = random_layer(np.random.default_rng(0), table, 5, 3, Tables(chains=(Chain(0, (1, 1)),), chain_step=0.5))
    plain = random_layer(np.random.default_rng(0), table_of([2]), 5)
    wide = replace(plain, rows=np.full_like(plain.rows, MAX_SYMBOL + 1))
    for options in (FAST, LZMA):
        with pytest.raises(Malformed, match="a symbol of a row over 8388608"):
            read(write_slice(wide, options)[0], wide, options.mode)
    for name, value, says in (
        ("rises", -1, "rise of a mask code in -1"),
        ("codes", 2, "mask code in 2"),
        ("classes", 7, "step classes in"),
        ("weights", -K_MAX, "a symbol of a chain over 8388608"),
    ):
        if name == "weights":
            weights = [np.full((1, 1), value, np.int32), np.zeros(1, np.int32)]
            wrong = replace(layer, tensors=replace(layer.tensors, weights=weights))
        else:
            values = getattr(layer, name).copy()
            values.flat[0] = value
            wrong = replace(layer, **{name: values})
        if name == "classes":  # by which rows have no symbols, but for their centres
            wrong = replace(wrong, rows=np.broadcast_to(table.centre[:, None], wrong.rows.shape))
        for options in (FAST, LZMA):
            with pytest.raises(Malformed, match=says):
                read(write_slice(wrong, options)[0], layer, options.mode, Declared(rows=3))


# -- rows --------------------------------------------------------------------------------------------------------------


def gaussian_layer(spread, classes=None, rows=2000, seed=4):
    """A layer of Gaussian rows of 17 channels. spread: [n] or a number."""
    table, rng = table_of([5, 6, 6], classes is not None), np.random.default_rng(seed)
    layer = random_layer(rng, table, 2 * rows, extent=100)
    layer = sliced(layer, np.arange(rows), True)
    k, classes = (
        np.rint(rng.normal(size=(17, rows)) * spread).astype(np.int32),
        NO_CLASSES if classes is None else classes,
    )
    return replace(layer, rows=table.values(k, classes), classes=classes)


def without_classes(layer):
    """A layer with the same symbols."""
    rows = layer.table.symbols(layer.rows, layer.classes)
    return replace(layer, table=RowTable(layer.table.tensors), rows=rows, classes=NO_CLASSES)


def bits_of(layer, options, name="attributes"):
    (row,) = [row for row in write_slice(layer, options)[1] if row.name == name]
    return row.payload_bits, row.rate_bits


@pytest.mark.parametrize(("priors", "effort"), [("best", 3), ("best", 1), ("gauss", 3)])
def test_step_classes_split_the_channels(priors, effort):
    """Symbols shrink with the class: split by it they cost less than as they are."""
    options = EncodeOptions(priors=priors, effort=effort)
    classes = np.random.default_rng(4).integers(0, 7, 2000).astype(np.int32)
    layer = gaussian_layer(40 / 2.0**classes, classes)
    assert_comes_back(layer, options)
    (bits, rate), (plain, more) = bits_of(layer, options), bits_of(without_classes(layer), options)
    assert bits < 0.9 * plain and rate < 0.9 * more
    if priors == "gauss":
        assert bits <= 1.005 * rate + 24 * 7 * 18


def test_one_step_class_costs_a_few_bytes():
    options = EncodeOptions(effort=3)
    layer = gaussian_layer(9, np.full(500, 3, np.int32), 500)
    (bits, rate), (plain, same) = bits_of(layer, options), bits_of(without_classes(layer), options)
    assert bits <= plain + 8 * 10 and rate == pytest.approx(same)


def test_a_later_slice_refers_to_the_priors_of_the_first():
    options = EncodeOptions(effort=3)
    layer = gaussian_layer(5, rows=400)
    parts = [sliced(layer, np.arange(i, 400, 2), i == 0) for i in range(2)]
    written, known, past = list[bytes](), [], []
    for i, part in enumerate(parts):
        written.append(write_slice(part, options, i > 0, known)[0])
    assert len(written[1]) < len(write_slice(parts[1], options)[0])
    declared = Declared()
    for i, (part, payload) in enumerate(zip(parts, written, strict=True)):
        found, declared = read(payload, part, "ans", declared, Tables() if i else None, past)
        assert_same_symbols(found.arrays(), part.arrays())
