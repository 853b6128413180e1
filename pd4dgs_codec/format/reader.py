"""Reads the slices of a `.pd4` file as tensors, without their meaning. Needs only numpy, constriction and msgpack."""

from collections.abc import Callable, Mapping
from os import PathLike
from pathlib import Path

from pd4dgs_codec.entropy.priors import Prior
from pd4dgs_codec.errors import DecodeError, Malformed, Truncated, UnsupportedFeature
from pd4dgs_codec.format.container import CHUNK_OVERHEAD, Chunk, read_chunk, read_preamble
from pd4dgs_codec.format.header import Header, scene_id_of, unpack_header
from pd4dgs_codec.format.parameters import Declared
from pd4dgs_codec.format.payload import Past, read_slice
from pd4dgs_codec.format.registry import LAYERS
from pd4dgs_codec.tensors.quantise import RowTable
from pd4dgs_codec.tensors.symbols import Growing, LayerSymbols, LayerTensors, TakenVoxels, check_slice, merged
from pd4dgs_codec.tensors.tables import Kind, Tables, Tensors

#: Checks a header's kind and rows and the last of the layers so far, by number: see `kinds.check`.
Check = Callable[[Kind, RowTable, Mapping[int, Tensors]], None]


class LayerReader:
    """Reads a file's chunks in order. It keeps neither bytes nor slices: each call gets the bytes from the next chunk
    on and returns one slice. A fault leaves the reader as it was before the slice.

    check: called with the header, and again with the first slice of each layer; raises a DecodeError.
    """

    def __init__(self, check: Check = lambda kind, table, layers: None) -> None:
        self.header: Header | None = None
        self._check = check
        self.offset = 0  #: of the next chunk
        self.count = 0  #: slices read
        self._grown: Growing | None = None
        self._layer, self._number = -1, -1  # of the latest slice
        self._following: list[int | None] = []  # by chunk, the layer of the first slice from it on
        self._index = 0
        self._scene_id = b""
        self._declared = Declared()
        self._taken = TakenVoxels()
        self._tables = Tables()  # of the first slice of the layer in progress
        self._past = Past[Prior]()  # copied for each slice, so that a fault leaves it unchanged

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
        self._check(header.kind, header.table, {})
        following: list[int | None] = [None]
        for kind, _ in reversed(header.chunks):
            following.append(kind if kind in LAYERS else following[-1])
        self.header, self._following = header, following[::-1]
        self._grown = Growing(header.table, header.info.voxel_size)

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
        past = self._past.copy() if later else Past[Prior]()
        of, earlier = self._tables if later else None, self.grown.classes
        found = read_slice(chunk.payload, layer, header.table, header.mode, self._declared, of, earlier, past)
        part, declared = found
        check_slice(part, self.grown.codes, header.info.voxel_size)
        if not later:
            self._check(header.kind, header.table, {**self.grown.tensors, layer: part.tensors})
        self._taken.take(part.anchor_q)
        self._tables = self._tables if later else part.tensors.tables
        self._declared, self._past = declared, past if chunk.more else Past()
        self._layer, self._number, self.count = layer, chunk.slice, self.count + 1
        self.grown.add(part, not later)
        if self._following[self._index + 1] != layer:
            self.grown.sort()
        return part


def read_layers(data: bytes, *, max_layer: int | None = None) -> tuple[Header, list[LayerSymbols]]:
    """Returns (header, symbols of each layer) of a complete file, or of its layers <= max_layer. Raises as
    `decode_tensors` does."""
    reader, layers = LayerReader(), dict[int, list[LayerSymbols]]()
    while (part := reader.next_slice(data, max_layer)) is not None:
        layers.setdefault(part.layer, []).append(part)
    assert reader.header is not None
    return reader.header, [merged(parts) for parts in layers.values()]


def decode_tensors(
    data: bytes | bytearray | memoryview | str | PathLike[str], max_layer: int | None = None
) -> list[LayerTensors]:
    """Decodes the layers of a file, or its layers <= max_layer, to tensors by form and id, whatever the kind of the
    scene. data: the bytes of the file, or its path. Raises DecodeError, OSError, and ValueError if max_layer < 0."""
    reader, file = LayerReader(), bytes_of(data)
    while reader.next_slice(file, max_layer) is not None:
        pass
    return reader.grown.layers()


def bytes_of(data: bytes | bytearray | memoryview | str | PathLike[str]) -> bytes:
    """Returns the bytes of a file given by them or by its path. Raises OSError for one that cannot be read."""
    return Path(data).read_bytes() if isinstance(data, (str, PathLike)) else bytes(data)
