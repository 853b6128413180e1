"""Reads the slices of a `.pd4` file as tensors, without their meaning. Needs only numpy, constriction and msgpack."""

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

from pd4dgs_codec.entropy.priors import Prior
from pd4dgs_codec.errors import BaseMismatch, BaseMissing, DecodeError, Malformed, Truncated, UnsupportedFeature
from pd4dgs_codec.format.container import CHUNK_OVERHEAD, Chunk, read_chunk, read_preamble
from pd4dgs_codec.format.header import Header, Reference, identity_of, scene_id_of, unpack_header
from pd4dgs_codec.format.payload import read_slice
from pd4dgs_codec.format.registry import LAYERS
from pd4dgs_codec.tensors.quantise import RowTable
from pd4dgs_codec.tensors.symbols import Growing, LayerSymbols, LayerTensors, TakenVoxels, check_slice, merged
from pd4dgs_codec.tensors.tables import Kind, Tables, Tensors

#: Checks a header's kind and rows and the last of the layers so far, by number: see `kinds.check`.
Check = Callable[[Kind, RowTable, Mapping[int, Tensors]], None]
#: The bytes of a file, or its path.
Source = bytes | bytearray | memoryview | str | PathLike[str]


@dataclass(frozen=True, eq=False)
class Base:
    """The layer 0 of a file, decoded once for all files that name it as their base (clause 5.6)."""

    header: Header
    reference: Reference
    grown: Growing
    taken: TakenVoxels


def read_base(data: Source | Base) -> Base:
    """Decodes the layer 0 of a file for those whose base it is. data: the bytes of the file, or its path; what follows
    its layer 0 is not read. Raises DecodeError, Malformed for a file that cannot be a base, and OSError."""
    if isinstance(data, Base):
        return data
    file = bytes_of(data)
    preamble = read_preamble(file)
    if unpack_header(preamble.header).base is not None:
        raise Malformed("the base names a base itself, expected a file that holds its scene whole")
    reader, offset, parts = LayerReader(), preamble.size, [identity_of(preamble.header)]
    while reader.next_slice(file, 0) is not None:
        pass
    assert reader.header is not None
    if reader.grown.tensors[0].tables.rows:
        raise Malformed("the base has layer rows in layer 0, expected none")
    for kind, length in reader.header.chunks:
        end = offset + CHUNK_OVERHEAD + length
        parts += [file[offset:end]] if kind == 0 else []
        offset = end
    digest = hashlib.sha256(b"".join(hashlib.sha256(part).digest() for part in parts)).digest()
    rows, size = len(reader.grown.codes), sum(map(len, parts))
    reference = Reference(scene_id_of(preamble.header), digest, rows, size)
    return Base(reader.header, reference, reader.grown, reader.taken)


def _checked_base(header: Header, given: Source | Base | None) -> Base | None:
    """Returns the base that a header names, None if it names none. Raises DecodeError for another one."""
    if header.base is None:
        return None
    wanted = header.base.scene_id.hex()
    if given is None:
        raise BaseMissing(f"the file adds to layer 0 of scene {wanted}: give this file as its base")
    try:
        base = read_base(given)
    except DecodeError as error:  # its place is none in this file, of which no bytes are missing
        of = BaseMismatch if isinstance(error, Truncated) else type(error)
        raise of(f"the base: {error}") from None
    found = base.reference
    if (found.scene_id, found.digest) != (header.base.scene_id, header.base.digest):
        same = "another layer 0 of it" if found.scene_id == header.base.scene_id else f"scene {found.scene_id.hex()}"
        raise BaseMismatch(f"the file adds to layer 0 of scene {wanted}, its base is {same}")
    if found != header.base:
        stated = f"{header.base.rows} anchors and {header.base.bytes} bytes"
        raise Malformed(f"header: a base of {stated}, expected {found.rows} and {found.bytes}")
    if header.of_rows != base.header.of_rows:
        raise Malformed("header: kind, rows, centres or voxel size, expected those of the base")
    return base


class LayerReader:
    """Reads a file's chunks in order. It keeps neither bytes nor slices: each call gets the bytes from the next chunk
    on and returns one slice. A fault leaves the reader as it was before the slice.

    check: called with the header, and again with the first slice of each layer; raises a DecodeError. base: for a file
    that names one; else it is not looked at.
    """

    def __init__(self, check: Check = lambda kind, table, layers: None, base: Source | Base | None = None) -> None:
        self.header: Header | None = None
        self._check = check
        self._base = base
        self.offset = 0  #: of the next chunk
        self.count = 0  #: slices read
        self._grown: Growing | None = None
        self._layer, self._number = -1, -1  # of the latest slice
        self._following: list[int | None] = []  # by chunk, the layer of the first slice from it on
        self._index = 0
        self._scene_id = b""
        self.taken = TakenVoxels()
        self._tables = Tables()  # of the first slice of the layer in progress
        # of the layer in progress; copied for each slice, so that a fault leaves it unchanged
        self._known: list[Prior] = []

    @property
    def complete(self) -> bool:
        """Whether every chunk in the header's list has been read."""
        return self.header is not None and self._index == len(self.header.chunks)

    @property
    def grown(self) -> Growing:
        """The values of the slices read so far; requires that the header has been read."""
        assert self._grown is not None
        return self._grown

    @property
    def showable(self) -> bool:
        """Whether a scene can be made of what has been read: of a slice, or of the base alone."""
        return self.count > 0 or (self._grown is not None and bool(self._grown.tensors))

    @property
    def whole(self) -> bool:
        """Whether the layer of the latest slice has no further slices."""
        return self._following[self._index] != self._layer

    def next_slice(
        self, data: bytes | bytearray, max_layer: int | None = None, max_bytes: int | None = None, start: int = 0
    ) -> LayerSymbols | None:
        """Returns the next slice of a layer <= max_layer that ends within the first max_bytes (clause 12), or None.

        start: offset of `data` in the file, at most `offset`. Raises Truncated if `data` ends before the slice does; a
        call with more bytes can then go on. Raises Malformed if neither limit is given and bytes follow the last chunk.
        Raises ValueError if max_layer < 0.
        """
        if max_layer is not None and max_layer < 0:
            raise ValueError(f"max_layer must be 0 or more, found {max_layer}")
        if self.header is None:
            preamble = read_preamble(data)
            self._begin(unpack_header(preamble.header))
            self.offset, self._scene_id = preamble.size, scene_id_of(preamble.header)
        assert self.header is not None
        chunks = self.header.chunks
        while self._index < len(chunks):
            layer = self._following[self._index]
            if max_layer is not None and (layer is None or layer > max_layer):
                return None
            if max_bytes is not None and self.offset + CHUNK_OVERHEAD + chunks[self._index][1] > max_bytes:
                return None
            if (part := self._read_chunk(data, start)) is not None:
                return part
        left = start + len(data) - self.offset
        if max_layer is None and max_bytes is None and left:
            raise Malformed(f"{left} bytes follow the last chunk, expected none", offset=self.offset)
        return None

    def _begin(self, header: Header) -> None:
        base = _checked_base(header, self._base)
        self._check(header.kind, header.table, base.grown.tensors if base else {})
        self._base, self._declared = base, header.declared
        following: list[int | None] = [None]
        for kind, _ in reversed(header.chunks):
            following.append(kind if kind in LAYERS else following[-1])
        self.header, self._following = header, following[::-1]
        self._grown = Growing(header.table, header.info.voxel_size, base.grown if base else None)
        self.taken = base.taken.copy() if base else self.taken

    def _read_chunk(self, data: bytes | bytearray, start: int) -> LayerSymbols | None:
        """Reads the next chunk: a slice, or None for an ancillary chunk."""
        assert self.header is not None
        offset, (kind_of, length) = self.offset, self.header.chunks[self._index]
        place = {"type": kind_of, "length": length, "index": self._index, "start": start}
        chunk = read_chunk(data, offset, scene_id=self._scene_id, **place)
        layer, part = chunk.type, None
        if layer not in LAYERS and not chunk.ancillary:
            message = f"critical chunk of unknown type {chunk.type}"
            raise UnsupportedFeature(message, offset=offset, chunk=self._index)
        if layer in LAYERS and chunk.ancillary:
            message = f"layer {layer} is flagged ancillary, expected a critical chunk"
            raise Malformed(message, offset=offset, chunk=self._index)
        if layer in LAYERS:
            self._check_place(chunk, layer)
            try:
                part = self._read_slice(chunk, layer, self.header)
            except DecodeError as error:
                # A payload is whole, so a fault inside it is not Truncated.
                of = Malformed if isinstance(error, Truncated) else type(error)
                raise of(error.message, offset=offset, chunk=self._index) from None
        self._index += 1
        self.offset = chunk.end
        return part

    def _check_place(self, chunk: Chunk, layer: int) -> None:
        """Raises Malformed unless the slice's flags fit its place (clause 3.6)."""
        expected, message = self._number + 1 if layer == self._layer else 0, ""
        following = self._following[self._index + 1]
        if chunk.slice != expected:
            message = f"slice {chunk.slice} of layer {layer}, expected {expected}"
        elif following is not None and chunk.more != (following == layer):
            told = "announces a further slice" if chunk.more else "ends its layer"
            message = f"slice {expected} of layer {layer} {told}, but layer {following} follows"
        if message:
            raise Malformed(message, offset=self.offset + 2, chunk=self._index)

    def _read_slice(self, chunk: Chunk, layer: int, header: Header) -> LayerSymbols:
        later = layer == self._layer
        known = list(self._known) if later else []
        of, earlier = self._tables if later else None, self.grown.classes
        base_rows = header.base.rows if header.base else 0
        table, before = header.table, self._declared
        part, declared = read_slice(chunk.payload, layer, table, header.mode, before, of, earlier, known, base_rows)
        check_slice(part, self.grown.codes, header.info.voxel_size)
        if not later and layer not in self.grown.tensors:
            self._check(header.kind, table, {**self.grown.tensors, layer: part.tensors})
        self.taken.take(part.anchor_q)
        self._tables = self._tables if later else part.tensors.tables
        self._declared, self._known = declared, known if chunk.more else []
        self._layer, self._number, self.count = layer, chunk.slice, self.count + 1
        self.grown.add(part, not later)
        if self._following[self._index + 1] != layer:
            self.grown.sort()
        return part


def read_layers(
    data: bytes, *, max_layer: int | None = None, base: Source | Base | None = None
) -> tuple[Header, list[LayerSymbols]]:
    """Returns (header, symbols of each layer) of a complete file, or of its layers <= max_layer, without those of the
    base. Raises as `decode_tensors` does."""
    reader, layers = LayerReader(base=base), dict[int, list[LayerSymbols]]()
    while (part := reader.next_slice(data, max_layer)) is not None:
        layers.setdefault(part.layer, []).append(part)
    assert reader.header is not None
    return reader.header, [merged(parts) for parts in layers.values()]


def decode_tensors(data: Source, max_layer: int | None = None, base: Source | Base | None = None) -> list[LayerTensors]:
    """Decodes the layers of a file, or its layers <= max_layer, to tensors by form and id, whatever the kind of the
    scene. data: the bytes of the file, or its path. base: of a file that names one, in the same forms or from
    `read_base`; its layer 0 is the first part of layer 0. Raises DecodeError, OSError, and ValueError if max_layer < 0.
    """
    reader, file = LayerReader(base=base), bytes_of(data)
    while reader.next_slice(file, max_layer) is not None:
        pass
    return reader.grown.layers()


def bytes_of(data: Source) -> bytes:
    """Returns the bytes of a file given by them or by its path. Raises OSError for one that cannot be read."""
    return Path(data).read_bytes() if isinstance(data, (str, PathLike)) else bytes(data)
