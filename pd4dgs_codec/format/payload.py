"""A slice's symbols <-> the payload of its chunk (clause 6).

A payload is the u32 length of the parameters, the parameters as canonical msgpack, the codes, and the stream. Mode ans
codes the channels in batches whose lengths follow from what is decoded before; mode lzma codes all of them at once.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from pd4dgs_codec.entropy.channels import ChannelReader, ChannelWriter, Places, split
from pd4dgs_codec.entropy.fitting import Fitted, entropy_bits, histogram
from pd4dgs_codec.entropy.lzma_mode import decode_channels_lzma, encode_channels_lzma
from pd4dgs_codec.entropy.positions import decode_positions, encode_positions
from pd4dgs_codec.entropy.priors import Prior
from pd4dgs_codec.errors import Malformed
from pd4dgs_codec.format.options import EncodeOptions
from pd4dgs_codec.format.parameters import Declared, Parameters, pack_parameters, read_parameters
from pd4dgs_codec.morton import AXIS_BITS, MAX_VOXEL, morton_codes
from pd4dgs_codec.scene import MASK_MIN_CODE, MAX_CLASS
from pd4dgs_codec.tensors.planes import choose_predictor, read_planes, restore, write_planes
from pd4dgs_codec.tensors.quantise import MAX_SYMBOL, NO_CLASSES, RowTable, magnitude
from pd4dgs_codec.tensors.symbols import NO_LAYER_ROWS, LayerSymbols
from pd4dgs_codec.tensors.tables import Tables, Tensors

#: Groups of channels in reports, in coding order, and the one of mode lzma.
GROUPS = ("positions", "masks", "attributes", "planes", "weights")
LZMA_GROUP = "symbols"
GROUPS_OF_ROWS = 2 * (MAX_CLASS + 1)  #: step classes, of the base's rows and of others


@dataclass(frozen=True, eq=False)
class Residuals:
    """Planes as they are coded. planes: int32 [C, H, W]. tables: with a predictor per plane."""

    planes: list[np.ndarray]
    tables: Tables

    @staticmethod
    def of(tensors: Tensors) -> Residuals:
        """Applies to each plane the predictor with the fewest estimated bits."""
        chosen = [choose_predictor(plane) for plane in tensors.planes]
        left = iter(predictor for predictor, *_ in chosen)
        grids = [replace(grid, predictors=tuple(next(left) for _ in grid.planes)) for grid in tensors.tables.grids]
        return Residuals([residuals for _, residuals, _ in chosen], replace(tensors.tables, grids=tuple(grids)))


# -- writing -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class StreamReport:
    """A group of channels. payload_bits: in codes and stream, but for its rounding to words. rate_bits: sum of R(a),
    the cost in the trainer's rate model; 0 for positions."""

    name: str
    payload_bits: int
    rate_bits: float
    symbols: int


def write_slice(
    symbols: LayerSymbols, options: EncodeOptions, later: bool = False, known: list[Fitted] | None = None
) -> tuple[bytes, list[StreamReport]]:
    """Returns (payload of a slice, a report per group of channels). The inverse of read_slice.

    later: whether it is not the first slice of its layer. known: the priors of the layer's earlier slices; it grows.
    """
    coded = Residuals.of(symbols.tensors)
    tables = Tables() if later else coded.tables
    write = _write_lzma if options.mode == "lzma" else _write_ans
    codes, stream, reports = write(symbols, coded, options, known)
    head = pack_parameters(len(symbols.anchor_q), len(codes), symbols.fill, tables)
    return b"".join([head, codes, stream]), reports


def _write_ans(
    symbols: LayerSymbols, coded: Residuals, options: EncodeOptions, known: list[Fitted] | None
) -> tuple[bytes, bytes, list[StreamReport]]:
    writer = ChannelWriter(options.priors, options.effort, known)
    encode_positions(symbols.anchor_q, writer)
    masks = writer.write([symbols.rises, symbols.codes])
    writer.write([symbols.classes])
    rows = writer.write(list(_row_channels(symbols))) + entropy_bits(symbols.classes)
    planes = write_planes(coded.planes, writer)
    weights = writer.write([array.ravel() for array in symbols.tensors.weights])
    codes, stream, bits = writer.finish()
    groups = (
        (bits[:1], 0.0, [symbols.anchor_q]),
        (bits[1:2], masks, [symbols.rises, symbols.codes]),
        (bits[2:4], rows, [symbols.classes, symbols.rows, symbols.layer_rows]),
        (bits[4:-1], planes, coded.planes),
        (bits[-1:], weights, symbols.tensors.weights),
    )
    reports = [
        StreamReport(name, sum(own), rate, sum(array.size for array in arrays))
        for name, (own, rate, arrays) in zip(GROUPS, groups, strict=True)
    ]
    return codes, stream, [report for report in reports if report.symbols]


def _row_symbols(symbols: LayerSymbols) -> tuple[np.ndarray, np.ndarray]:
    """Returns the symbols of the rows and of the layer rows, int32 [channels, rows]."""
    own = symbols.table.symbols(symbols.rows, symbols.classes)
    return own, symbols.layer_table.symbols(symbols.layer_rows, symbols.all_classes)


def _row_channels(symbols: LayerSymbols) -> Iterator[np.ndarray]:
    """Yields the coded channels of rows and layer rows, int [any]: of each group, if there are any."""
    own, layer_rows = _row_symbols(symbols)
    groups = _groups(symbols.all_classes, symbols.base_rows, layer_rows.shape[1])
    for k, classes in ((own, symbols.classes), (layer_rows, groups)):
        yield from Places.by(classes, GROUPS_OF_ROWS).parts(k) if classes.size else k


def _groups(classes: np.ndarray, base_rows: int, n: int) -> np.ndarray:
    """Returns the group of each of n layer rows, each of which is a coded channel: by step class int32 [n], those of
    the base apart; NO_CLASSES for one group. classes: int32 [n] or NO_CLASSES."""
    if not base_rows:
        return classes
    groups: np.ndarray = (classes if classes.size else np.zeros(n, np.int32)) + GROUPS_OF_ROWS // 2
    groups[:base_rows] -= GROUPS_OF_ROWS // 2
    return groups


def _write_lzma(
    symbols: LayerSymbols, coded: Residuals, options: EncodeOptions, known: list[Fitted] | None
) -> tuple[bytes, bytes, list[StreamReport]]:
    """All channels in one group. Its rate leaves out positions and masks and splits rows by step class."""
    morton_codes(symbols.anchor_q)  # raises EncodeError for cells too far apart
    steps = np.diff(symbols.anchor_q, axis=0, prepend=0).T if len(symbols.anchor_q) else []
    rest = [*(channel.ravel() for plane in coded.planes for channel in plane), *map(np.ravel, symbols.tensors.weights)]
    classes = [symbols.classes] if len(symbols.classes) else []
    channels = [*steps, symbols.rises, symbols.codes, *classes, *chain(*_row_symbols(symbols)), *rest]
    codes, stream = encode_channels_lzma(channels, options.effort)
    counted = [channel for channel in (*_row_channels(symbols), *rest) if channel.size]
    rate = sum(histogram(channel).rate_bits for channel in counted) + entropy_bits(symbols.classes)
    count = sum(channel.size for channel in channels)
    return codes, stream, [StreamReport(LZMA_GROUP, 8 * (len(codes) + len(stream)), rate, count)]


# -- reading -----------------------------------------------------------------------------------------------------------


def read_slice(
    payload: bytes | memoryview,
    layer: int,
    table: RowTable,
    mode: str,
    before: Declared,
    of: Tables | None = None,
    earlier: np.ndarray = NO_CLASSES,
    known: list[Prior] | None = None,
    base_rows: int = 0,
) -> tuple[LayerSymbols, Declared]:
    """Returns (symbols, sums with this slice) of a payload. Arguments as in read_parameters.

    earlier: int32 [rows before], the step classes of the rows of all layers before; NO_CLASSES without any. known: the
    priors of the layer's earlier slices; it grows. base_rows: of the file's base. Raises subclasses of DecodeError;
    nothing is allocated for a count beyond the limits or the payload.
    """
    parameters, start, declared = read_parameters(payload, layer, table, before, of)
    if of:
        earlier, base_rows = NO_CLASSES, 0
    codes, stream = payload[start : start + parameters.codes], bytes(payload[start + parameters.codes :])
    if mode == "lzma":
        coded = _read_lzma(codes, stream, table, parameters)
    else:
        reader = ChannelReader(codes, stream, declared.symbols, known)
        coded = _read_ans(reader, table, parameters, earlier, base_rows)
    voxels, rises, own, classes, k, layer_k, residuals, weights, bits = coded
    where, tables = f"layer {layer}", parameters.tables
    rise = ("rise of a mask code", rises, 0, 255 if layer else 1)
    for name, found, low, high in (rise, ("mask code", own, MASK_MIN_CODE, 255)):
        if found.size and not (low <= found.min() and found.max() <= high):
            raise Malformed(f"{where}: {name} in {int(found.min())}..{int(found.max())}, expected {low}..{high}")
    if any(magnitude(array) > MAX_SYMBOL for array in weights):
        raise Malformed(f"{where}: a symbol of a chain over {MAX_SYMBOL} in magnitude")
    predictors = [predictor for grid in tables.grids for predictor in grid.predictors]
    samples = restore(list(zip(predictors, residuals, strict=True)))
    arrays = [array.reshape(shape) for array, shape in zip(weights, tables.weights, strict=True)]
    tensors, fill = Tensors(tables, samples, arrays), parameters.fill
    part = LayerSymbols(layer, table, voxels, rises, own, classes, k, tensors, fill, earlier, layer_k, bits, base_rows)
    try:
        rows, layer_rows = table.values(k, classes), part.layer_table.values(layer_k, part.all_classes)
    except Malformed as error:
        raise Malformed(f"{where}: {error.message}") from None
    return replace(part, rows=rows, layer_rows=layer_rows), declared


Array = np.ndarray
#: Voxels, rises, own codes and step classes of a slice, the symbols of its rows and of its layer rows, the residuals of
#: its planes, its weights and biases, and the bits of its groups.
Coded = tuple[Array, Array, Array, Array, Array, Array, list[Array], list[Array], dict[str, int]]


def _read_ans(reader: ChannelReader, table: RowTable, parameters: Parameters, earlier: Array, base_rows: int) -> Coded:
    n, tables, marks = parameters.rows, parameters.tables, [reader.bits]
    voxels = decode_positions(reader, n)
    marks.append(reader.bits)
    rises, own = split(reader.read([parameters.rises, n]), [parameters.rises, n])
    marks.append(reader.bits)
    classes, width = reader.read([n] * table.graded), RowTable(tables.rows).channels
    _check_classes(classes)
    rows = _read_rows(reader, table.channels, n, classes)
    count = parameters.rises + n
    groups = _groups(np.concatenate([earlier, classes]), base_rows, count)
    layer_rows = _read_rows(reader, width, count, groups) if width else NO_LAYER_ROWS
    marks.append(reader.bits)
    residuals, sizes = read_planes(reader, tables.planes), [math.prod(shape) for shape in tables.weights]
    marks.append(reader.bits)
    weights = split(reader.read(sizes), sizes)
    marks.append(reader.bits)
    reader.finish()
    bits = dict(zip(GROUPS, np.diff(marks).tolist(), strict=True))
    return voxels, rises, own, classes, rows, layer_rows, residuals, weights, bits


def _read_rows(reader: ChannelReader, channels: int, n: int, groups: np.ndarray) -> np.ndarray:
    """Decodes the symbols int32 [channels, n] of rows of these groups, int32 [n] or NO_CLASSES."""
    if not groups.size:
        return reader.read([n] * channels).reshape(channels, n)
    places = Places.by(groups, GROUPS_OF_ROWS)
    rows = reader.read(places.sizes * channels).reshape(channels, n)
    places.put(rows, rows)
    return rows


def _read_lzma(codes: bytes | memoryview, stream: bytes, table: RowTable, parameters: Parameters) -> Coded:
    n, tables = parameters.rows, parameters.tables
    channels = [h * w for c, h, w in tables.planes for _ in range(c)]
    groups = [
        *([n] * 3, [parameters.rises, n], [n] * table.graded, [n] * table.channels),
        *([parameters.rises + n] * RowTable(tables.rows).channels, channels, list(map(math.prod, tables.weights))),
    ]
    left = iter(decode_channels_lzma(codes, stream, [size for sizes in groups for size in sizes]))
    steps, (rises, own), classes, rows, moved, planes, weights = ([next(left) for _ in sizes] for sizes in groups)
    _check_classes(*classes)
    ends = np.cumsum([0, *(c for c, _, _ in tables.planes)]).tolist()
    residuals = [
        np.concatenate(planes[first:end]).reshape(shape)
        for first, end, shape in zip(ends, ends[1:], tables.planes, strict=False)
    ]
    graded, layer_rows = [*classes, NO_CLASSES][0], np.stack(moved) if moved else NO_LAYER_ROWS
    bits = {LZMA_GROUP: 8 * (len(codes) + len(stream))}
    return _voxels(steps), rises, own, graded, np.stack(rows), layer_rows, residuals, weights, bits


def _voxels(steps: Sequence[np.ndarray]) -> np.ndarray:
    """Returns voxel indices int32 [n, 3] from their differences along each axis (clause 9.4)."""
    cells = np.cumsum(np.stack(steps, axis=1), axis=0, dtype=np.int64)
    if cells.size and (magnitude(cells) > MAX_VOXEL or int(np.ptp(cells, axis=0).max()) >> AXIS_BITS):
        found = f"{cells.min(axis=0).tolist()} to {cells.max(axis=0).tolist()}"
        raise Malformed(f"voxels from {found}, expected them within {MAX_VOXEL} in magnitude")
    if np.any(np.diff(morton_codes(cells)) <= 0):
        raise Malformed("voxels out of Morton order")
    return cells.astype(np.int32)


def _check_classes(classes: np.ndarray = NO_CLASSES) -> None:
    """Raises Malformed unless classes int32 [n] are in 0..MAX_CLASS."""
    if classes.size and not (0 <= classes.min() and classes.max() <= MAX_CLASS):
        raise Malformed(f"step classes in {int(classes.min())}..{int(classes.max())}, expected 0..{MAX_CLASS}")
