"""What only one slice needs, at the start of its payload: rows and section lengths; in a layer's first slice steps,
plane sizes and network widths as well."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

from pd4dgs_codec.errors import LimitExceeded, Malformed
from pd4dgs_codec.format import canonical
from pd4dgs_codec.format.fields import Fields, as_integer, as_list, as_registered
from pd4dgs_codec.format.kinds import LayerKind
from pd4dgs_codec.format.limits import (
    MAX_ANCHORS,
    MAX_NETWORK_LAYERS,
    MAX_NETWORK_WIDTH,
    MAX_PAYLOAD,
    MAX_PLANE_CELLS,
    MAX_PLANE_CHANNELS,
    MAX_PLANE_SCALES,
    MAX_PLANE_SIDE,
)
from pd4dgs_codec.format.planes import PREDICTORS
from pd4dgs_codec.format.quantise import is_step
from pd4dgs_codec.scene import PLANES, TRUNK, Widths


class Section(IntEnum):
    """Parts of a payload, in order; one without symbols is absent. SYMBOLS (mode lzma) stands for 1..4 together."""

    POSITIONS = 0
    MASKS = 1
    ATTRIBUTES = 2
    PLANES = 3
    WEIGHTS = 4
    SYMBOLS = 5


# Keys of the map.
ROWS, SECTIONS, STEPS, SCALES, NETWORKS = range(1, 6)

#: A file of S symbols has at least (S - FREE_SYMBOLS) / SYMBOLS_PER_BYTE bytes, so that a few bytes that declare
#: constant channels cannot make a decoder allocate without end. Real scenes spend over 0.1 bit per symbol.
FREE_SYMBOLS = 1 << 22
SYMBOLS_PER_BYTE = 256
#: An anchor may cost next to nothing and its position takes up to 42 symbols; real anchors take tens of bytes.
FREE_ROWS = 1 << 13
ROWS_PER_BYTE = 2


@dataclass(frozen=True)
class Declared:
    """What the slices of a file declare so far: rows, symbols, and the bytes of their payloads."""

    rows: int = 0
    symbols: int = 0
    payload_bytes: int = 0

    def and_slice(self, rows: int, symbols: int, payload_bytes: int) -> Declared:
        """With one more slice."""
        return Declared(self.rows + rows, self.symbols + symbols, self.payload_bytes + payload_bytes)


@dataclass(frozen=True)
class ScaleMeta:
    """One HexPlane scale: channels, resolution along x, y, z, t, and a predictor id per plane in PLANES' order."""

    channels: int
    sides: tuple[int, int, int, int]
    predictors: tuple[int, ...]

    def shapes(self) -> list[tuple[int, int, int]]:
        """[C, H, W] of the six planes."""
        return [(self.channels, self.sides[b], self.sides[a]) for _, a, b in PLANES]


@dataclass(frozen=True)
class LayerMeta:
    """rows: the slice's own anchors. sections: length in bytes by Section. steps: by field of Steps.

    networks: per name the outputs of its linear layers; the first input follows from the layer (input_width). widths:
    those of the scene's anchors.
    """

    rows: int
    sections: dict[int, int]
    steps: dict[str, float]
    scales: tuple[ScaleMeta, ...]
    networks: dict[str, tuple[int, ...]]
    widths: Widths

    def input_width(self, name: str, kind: LayerKind) -> int:
        """Inputs of network `name`: the scaffold's fixed ones, the sampled planes' or the trunk's outputs."""
        if kind.layer == 0:
            return self.widths.inputs
        return sum(s.channels for s in self.scales) if name == TRUNK else self.networks[TRUNK][-1]

    def weight_shapes(self, kind: LayerKind) -> list[tuple[int, ...]]:
        """Shapes of weight, bias, weight, bias ... of all networks in order."""
        shapes: list[tuple[int, ...]] = []
        for name, widths in self.networks.items():
            inputs = (self.input_width(name, kind), *widths[:-1])
            for wide_in, wide_out in zip(inputs, widths, strict=True):
                shapes += [(wide_out, wide_in), (wide_out,)]
        return shapes

    def plane_shapes(self) -> list[tuple[int, int, int]]:
        """[C, H, W] of all planes, scale by scale."""
        return [shape for scale in self.scales for shape in scale.shapes()]


def pack_meta(meta: LayerMeta, kind: LayerKind) -> bytes:
    """Canonical msgpack of `meta`; what is empty is absent."""
    fields: dict[int, object] = {ROWS: meta.rows, SECTIONS: {int(k): meta.sections[k] for k in sorted(meta.sections)}}
    if meta.networks:
        fields[STEPS] = [meta.steps[name] for name in kind.step_names]
    if meta.scales:
        fields[SCALES] = [[s.channels, *s.sides, *s.predictors] for s in meta.scales]
    if meta.networks:
        fields[NETWORKS] = [[kind.network_ids[name], *widths] for name, widths in meta.networks.items()]
    return canonical.pack(fields)


def unpack_meta(data: bytes, kind: LayerKind, widths: Widths, rows_before: int, later: bool) -> LayerMeta:
    """The inverse of pack_meta (clause "layer parameters"); every count is within its limit afterwards.

    later: whether it is a slice behind the layer's first."""
    where = f"layer {kind.layer}"
    fields = Fields(canonical.unpack(data), where, set(range(ROWS, NETWORKS + 1)))
    known_sections = {int(s) for s in Section}
    sections = Fields(fields.get(SECTIONS), f"{where} sections", known_sections)
    networks = {} if later else _unpack_networks(fields, kind, widths, where)
    meta = LayerMeta(
        rows=fields.integer(ROWS, MAX_ANCHORS - rows_before),
        sections={s: sections.integer(s, MAX_PAYLOAD, low=1) for s in known_sections if s in sections},
        steps=_unpack_steps(fields, kind, where) if networks else {},
        scales=_unpack_scales(fields, where) if networks and kind.layer > 0 else (),
        networks=networks,
        widths=widths,
    )
    for key, expected in ((STEPS, bool(networks)), (SCALES, bool(meta.scales)), (NETWORKS, bool(networks))):
        if (key in fields) != expected:
            raise Malformed(f"{where}: key {key} is {'missing' if expected else 'there'} without reason")
    return meta


def declared_symbols(meta: LayerMeta, kind: LayerKind, rises: int) -> int:
    """Symbols that the parameters say the slice has, voxel indices and masks included."""
    cells = sum(math.prod(shape) for shape in meta.plane_shapes())
    weights = sum(math.prod(shape) for shape in meta.weight_shapes(kind)) if meta.networks else 0
    return rises + meta.rows * (meta.widths.channels + meta.widths.graded + 4) + cells + weights


def check_symbol_count(meta: LayerMeta, kind: LayerKind, before: Declared, payload_bytes: int, rises: int) -> Declared:
    """What the file declares with this slice; LimitExceeded if that is more than its payloads could reasonably hold."""
    cells = sum(math.prod(shape) for shape in meta.plane_shapes())
    if cells > MAX_PLANE_CELLS:
        raise LimitExceeded(f"layer {kind.layer}: planes of {cells} cells, limit {MAX_PLANE_CELLS}")
    return check_declared(before.and_slice(meta.rows, declared_symbols(meta, kind, rises), payload_bytes), kind)


def check_declared(total: Declared, kind: LayerKind) -> Declared:
    """`total`; LimitExceeded if the slices so far, of which this layer has the last, cannot hold so much."""
    for what, found, free, per_byte in (
        ("anchors", total.rows, FREE_ROWS, ROWS_PER_BYTE),
        ("symbols", total.symbols, FREE_SYMBOLS, SYMBOLS_PER_BYTE),
    ):
        limit = free + per_byte * total.payload_bytes
        if found > limit:
            size = f"{total.payload_bytes} bytes of payload so far"
            raise LimitExceeded(f"layer {kind.layer}: {found} {what} in {size}, limit {limit}")
    return total


def _unpack_steps(fields: Fields, kind: LayerKind, where: str) -> dict[str, float]:
    steps = dict(zip(kind.step_names, fields.reals(STEPS, len(kind.step_names)), strict=True))
    for name, step in steps.items():
        if not is_step(step):
            raise Malformed(f"{where}: step {step!r} of {name}, expected a positive normal binary32 value")
    return steps


def _unpack_scales(fields: Fields, where: str) -> tuple[ScaleMeta, ...]:
    rows = fields.sequence(SCALES)
    as_integer(len(rows), MAX_PLANE_SCALES, f"{where}: number of scales", low=1)
    scales: list[ScaleMeta] = []
    for i, row in enumerate(rows):
        channels, *rest = as_list(row, f"{where} scale {i}", 5 + len(PLANES))
        as_integer(channels, MAX_PLANE_CHANNELS, f"{where} scale {i} channels", low=1)
        if scales and channels != scales[0].channels:
            raise Malformed(f"{where} scale {i}: {channels} channels, expected {scales[0].channels} as in scale 0")
        for side in rest[:4]:
            as_integer(side, MAX_PLANE_SIDE, f"{where} scale {i} side", low=1)
        for predictor in rest[4:]:
            as_registered(predictor, PREDICTORS, f"{where} scale {i} predictor")
        scales.append(ScaleMeta(channels, tuple(rest[:4]), tuple(rest[4:])))
    return tuple(scales)


def _unpack_networks(fields: Fields, kind: LayerKind, widths: Widths, where: str) -> dict[str, tuple[int, ...]]:
    rows = fields.sequence(NETWORKS) if NETWORKS in fields else []
    names, heads = {number: name for name, number in kind.network_ids.items()}, kind.heads(widths)
    if NETWORKS in fields and not rows:
        raise Malformed(f"{where}: an empty list of networks, expected some or no list")
    networks: dict[str, tuple[int, ...]] = {}
    last = -1
    for row in rows:
        entry = as_list(row, f"{where} network")
        if not entry:
            raise Malformed(f"{where}: an empty network entry, expected an id and widths")
        number, *outputs = entry
        if as_registered(number, names, f"{where} network id") <= last:
            raise Malformed(f"{where}: network {number} after {last}, expected ascending ids")
        last, name = number, names[number]
        as_integer(len(outputs), MAX_NETWORK_LAYERS, f"{where} network {name} layers", low=1)
        for width in outputs:
            as_integer(width, MAX_NETWORK_WIDTH, f"{where} network {name} width", low=1)
        if outputs[-1] != heads.get(name, outputs[-1]):
            raise Malformed(f"{where} network {name}: {outputs[-1]} outputs, expected {heads[name]}")
        networks[name] = tuple(outputs)
    if kind.layer == 0 and len(networks) != len(names):
        raise Malformed(f"{where}: networks {list(networks)}, expected {list(kind.network_ids)}")
    if networks and kind.layer > 0 and (TRUNK not in networks or len(networks) == 1):
        raise Malformed(f"{where}: networks {list(networks)}, expected '{TRUNK}' and at least one head")
    return networks
