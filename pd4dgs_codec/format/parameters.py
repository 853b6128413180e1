"""The parameters of a slice, from which its tensors follow, and the parts of tables that they share with the header
(clauses 5.4 to 6.5)."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from pd4dgs_codec.errors import LimitExceeded, Malformed
from pd4dgs_codec.format import canonical, registry
from pd4dgs_codec.format.canonical import Fields, as_integer, as_list, as_long, as_registered
from pd4dgs_codec.tensors.planes import PREDICTORS
from pd4dgs_codec.tensors.quantise import ROW_PREDICTORS, Rows, RowTable, is_step
from pd4dgs_codec.tensors.tables import Chain, Fill, Grid, Kind, Tables

# Keys of the parameters of a slice.
KEYS = OWN_ROWS, CODES, FILL, GRIDS, CHAINS, KIND, LAYER_ROWS = range(1, 8)

#: A file of S symbols has at least (S - FREE_SYMBOLS) / SYMBOLS_PER_BYTE bytes, so that a few bytes that declare
#: constant channels cannot make a decoder allocate without end. Real scenes spend over 0.1 bit per symbol.
FREE_SYMBOLS = 1 << 22
SYMBOLS_PER_BYTE = 256
#: The same bound for anchors, which may cost almost nothing each; a position takes up to 42 symbols.
FREE_ROWS = 1 << 13
ROWS_PER_BYTE = 2


@dataclass(frozen=True)
class Declared:
    """Sums over the slices of a file so far, and of its base: rows, symbols and bytes of payloads."""

    rows: int = 0
    symbols: int = 0
    payload_bytes: int = 0


@dataclass(frozen=True)
class Parameters:
    """The parameters of a slice. rows: its own anchors. rises: earlier anchors whose mask codes it raises. codes:
    length of its codes in bytes. tables: in a later slice, of the rows of its layer alone. symbols: number of all its
    symbols, those of voxel indices and masks included."""

    rows: int
    codes: int
    fill: Fill | None
    tables: Tables
    rises: int
    symbols: int


def pack_parameters(rows: int, codes: int, fill: Fill | None, tables: Tables) -> bytes:
    """Returns the bytes before the codes: the parameters behind their length."""
    fields: dict[int, object] = {OWN_ROWS: rows, CODES: codes}
    if fill:
        fields[FILL] = list(fill)
    if tables.grids:
        own = [[grid.id, grid.channels, list(grid.sides), list(grid.predictors)] for grid in tables.grids]
        fields[GRIDS] = [tables.grid_step, *own]
    if tables.chains:
        fields[CHAINS] = [tables.chain_step, *([chain.id, *chain.widths] for chain in tables.chains)]
    if tables.kind:
        fields[KIND] = list(tables.kind)
    if tables.rows:
        fields[LAYER_ROWS] = pack_rows(tables.rows)
    packed = canonical.pack(fields)
    return struct.pack("<I", len(packed)) + packed


def with_fill(payload: bytes, fill: Fill | None) -> bytes:
    """Returns a slice's payload with another fill, or with none."""
    start = 4 + struct.unpack_from("<I", payload)[0]
    fields: Any = canonical.unpack(payload[4:start])
    fields.pop(FILL, None)
    packed = canonical.pack(fields | ({FILL: list(fill)} if fill else {}))
    return struct.pack("<I", len(packed)) + packed + payload[start:]


def read_parameters(
    payload: bytes | memoryview, layer: int, table: RowTable, before: Declared, of: Tables | None = None
) -> tuple[Parameters, int, Declared]:
    """Returns (parameters, offset of the codes, sums with this slice) of a payload. Checks all lengths against the
    payload's size and all counts against their limits.

    table: of the header's rows. before: sums over earlier slices. of: in a later slice, the tables of its layer's first
    one. Raises subclasses of DecodeError.
    """
    where, later = f"layer {layer}", of is not None
    if len(payload) < 4:
        raise Malformed(f"{where}: payload of {len(payload)} bytes, expected at least 4")
    (length,) = struct.unpack_from("<I", payload)
    if length > registry.MAX_PARAMETERS:
        raise LimitExceeded(f"{where}: parameters of {length} bytes, limit {registry.MAX_PARAMETERS}")
    start = 4 + length
    if start > len(payload):
        raise Malformed(f"{where}: parameters of {length} bytes, expected at most {len(payload) - 4}")
    fields = Fields(canonical.unpack(payload[4:start]), where, set(KEYS))
    based = layer == 0 and before.payload_bytes > 0 and not later
    misplaced = [key for key in (GRIDS, CHAINS, KIND, LAYER_ROWS) if (later or based) and key in fields]
    if misplaced:
        place = "a file with a base, expected none" if based else "a later slice, expected it in the first one only"
        raise Malformed(f"{where}: key {misplaced[0]} in {place}")
    rows = fields.integer(OWN_ROWS, registry.MAX_ANCHORS - before.rows)
    codes = fields.integer(CODES, registry.MAX_PAYLOAD)
    if codes > len(payload) - start:
        raise Malformed(f"{where}: codes of {codes} bytes, expected at most {len(payload) - start}")
    fill = _unpack_fill(fields, f"{where} fill") if FILL in fields else None
    tables = Tables(rows=of.rows) if of else _unpack_tables(fields, where)
    rises, width = 0 if later else before.rows, RowTable(tables.rows).channels
    symbols = rises + (table.channels + table.graded + 4) * rows + width * (rises + rows) + tables.symbols
    total = Declared(before.rows + rows, before.symbols + symbols, before.payload_bytes + len(payload))
    _check_declared(tables.cells, total, where)
    return Parameters(rows, codes, fill, tables, rises, symbols), start, total


def _unpack_fill(fields: Fields, where: str) -> Fill:
    found = fields.sequence(FILL)
    as_integer(len(found), 4, f"{where}: integers", 3)
    return tuple(as_integer(code, 255, where) for code in found)


def _check_declared(cells: int, total: Declared, where: str) -> None:
    """Raises LimitExceeded if the slices so far are too short for what they declare (clause 6.5)."""
    if cells > registry.MAX_CELLS:
        raise LimitExceeded(f"{where}: planes of {cells} cells, limit {registry.MAX_CELLS}")
    for what, found, free, per_byte in (
        ("anchors", total.rows, FREE_ROWS, ROWS_PER_BYTE),
        ("symbols", total.symbols, FREE_SYMBOLS, SYMBOLS_PER_BYTE),
    ):
        limit = free + per_byte * total.payload_bytes
        if found > limit:
            size = f"{total.payload_bytes} bytes of payloads up to here"
            raise LimitExceeded(f"{where}: {found} {what} in {size}, limit {limit}")


def _unpack_tables(fields: Fields, where: str) -> Tables:
    found: dict[str, Any] = {}
    if KIND in fields:
        found["kind"] = unpack_kind(fields.get(KIND), f"{where} kind")
    if LAYER_ROWS in fields:
        found["rows"] = unpack_rows(fields.get(LAYER_ROWS), f"{where}: layer rows")
    grids, chains = ("grid", GRIDS, registry.MAX_GRIDS), ("chain", CHAINS, registry.MAX_CHAINS)
    for (name, key, most), unpack in ((grids, _unpack_grid), (chains, _unpack_chain)):
        if key in fields:
            step, *rows = as_long(fields.get(key), f"{where} {name}s", most + 1, 2)
            found[f"{name}_step"] = as_step(step, f"{where} {name}s")
            found[f"{name}s"] = _ascending([unpack(row, where) for row in rows], f"{where} {name}s")
    return Tables(**found)


def _unpack_grid(row: object, where: str) -> Grid:
    number, channels, sides, predictors = as_list(row, f"{where} grid", 4)
    where = f"{where} grid {as_integer(number, registry.MAX_ID, f'{where} grid id')}"
    as_integer(channels, registry.MAX_CHANNELS, f"{where} channels", 1)
    for side in as_long(sides, f"{where} sides", registry.MAX_AXES):
        as_integer(side, registry.MAX_SIDE, f"{where} side", 1)
    grid = Grid(number, channels, tuple(sides))
    for predictor in as_list(predictors, f"{where} predictors", len(grid.planes)):
        as_registered(predictor, PREDICTORS, f"{where} predictor")
    return replace(grid, predictors=tuple(predictors))


def _unpack_chain(row: object, where: str) -> Chain:
    number, *widths = as_long(row, f"{where} chain", registry.MAX_CHAIN_LAYERS + 2, 3)
    where = f"{where} chain {as_integer(number, registry.MAX_ID, f'{where} chain id')}"
    for width in widths:
        as_integer(width, registry.MAX_WIDTH, f"{where} width", 1)
    return Chain(number, tuple(widths))


def _ascending(tensors: Sequence[Any], where: str) -> tuple[Any, ...]:
    ids = [tensor.id for tensor in tensors]
    if any(a >= b for a, b in pairwise(ids)):
        raise Malformed(f"{where}: ids {ids}, expected them to ascend")
    return tuple(tensors)


def pack_rows(tensors: Iterable[Rows]) -> list[list[object]]:
    """Returns the records of tensors of rows."""
    return [[tensor.id, tensor.channels, float(np.float32(tensor.step)), tensor.predictor] for tensor in tensors]


def unpack_rows(value: object, where: str) -> tuple[Rows, ...]:
    """Returns the tensors of rows of these records. Raises subclasses of DecodeError."""
    tensors = []
    for row in as_long(value, where, registry.MAX_ROWS):
        number, channels, step, predictor = as_list(row, where, 4)
        as_integer(number, registry.MAX_ID, f"{where}: id")
        as_integer(channels, registry.MAX_CHANNELS, f"{where} {number}: channels", 1)
        as_registered(predictor, ROW_PREDICTORS, f"{where} {number}: predictor")
        tensors.append(Rows(number, channels, as_step(step, f"{where} {number}"), predictor))
    table = RowTable(_ascending(tensors, where))
    if table.channels > registry.MAX_ROWS_WIDTH:
        raise LimitExceeded(f"{where} of {table.channels} channels, limit {registry.MAX_ROWS_WIDTH}")
    return table.tensors


def unpack_kind(value: object, where: str) -> Kind:
    """Returns the integers of a kind. Raises Malformed or LimitExceeded for anything else."""
    return tuple(as_integer(part, registry.MAX_KIND, where) for part in as_long(value, where, registry.MAX_KIND_LENGTH))


def as_step(value: object, where: str) -> float:
    """Returns a step. Raises Malformed unless it is a positive normal binary32."""
    if not isinstance(value, float) or not is_step(value):
        raise Malformed(f"{where}: step {value!r}, expected a positive normal binary32 value")
    return value
