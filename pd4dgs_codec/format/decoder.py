"""Bytes of a `.pd4` file -> Scene. Takes bytes and nothing else; needs numpy, constriction and the standard library."""

from __future__ import annotations

from pd4dgs_codec.entropy.priors import Prior
from pd4dgs_codec.errors import DecodeError, Malformed, Truncated, UnsupportedFeature
from pd4dgs_codec.format.attribute_section import Past
from pd4dgs_codec.format.container import CHUNK_OVERHEAD, PREAMBLE_SIZE, Chunk, read_chunk, read_preamble
from pd4dgs_codec.format.header import Header, layers_of, scene_id_of, unpack_header
from pd4dgs_codec.format.kinds import BY_CHUNK_TYPE, LayerKind
from pd4dgs_codec.format.layer_meta import Declared
from pd4dgs_codec.format.payload import read_layer
from pd4dgs_codec.format.symbols import (
    LayerSymbols,
    TakenVoxels,
    assemble,
    check_last_layer,
    merged,
)
from pd4dgs_codec.scene import Scene


class LayerReader:
    """Walks a file's chunks in order. It holds no bytes: every call gets all that has arrived. Its lists are replaced
    and never changed, so that a copy stays what it is."""

    def __init__(self) -> None:
        self.header: Header | None = None
        self.offset = 0  #: of the next chunk
        self.slices: list[list[LayerSymbols]] = []  #: of each layer
        self._merged: list[LayerSymbols | None] = []  # each layer, None until somebody asks for it as it is now
        self._index = 0
        self._scene_id = b""
        self._declared = Declared()
        self._taken = TakenVoxels()
        self._past: Past[Prior] | None = None

    @property
    def layers(self) -> list[LayerSymbols]:
        """The layers read so far; slices of the last one may be missing."""
        layers = [layer or merged(parts) for layer, parts in zip(self._merged, self.slices, strict=True)]
        self._merged = [*layers]
        return layers

    @property
    def latest(self) -> LayerSymbols:
        """The slice read last."""
        return self.slices[-1][-1]

    @property
    def complete(self) -> bool:
        """Whether every chunk that the header lists has been read."""
        return self.header is not None and self._index == len(self.header.chunks)

    def scene(self) -> Scene:
        """The scene of the layers read so far, at least one."""
        assert self.header is not None
        return assemble(self.header.info, self.header.grid, self.layers)

    def next_slice(self, data: bytes | bytearray, max_layer: int | None = None, max_bytes: int | None = None) -> bool:
        """Read on to the end of one more slice of a layer <= max_layer that ends within the first max_bytes; whether
        the file has one more (clause "decoding process").

        Raises Truncated, with nothing consumed that a later call would miss, if `data` ends before; Malformed if
        bytes follow the last chunk of a file that is read whole (neither limit).
        """
        if self.header is None:
            preamble = read_preamble(data)
            self.header, self.offset = unpack_header(preamble.header, offset=PREAMBLE_SIZE), preamble.size
            self._scene_id = scene_id_of(preamble.header)
        chunks = self.header.chunks
        while self._index < len(chunks):
            if max_layer is not None and all(layer > max_layer for layer in layers_of(chunks[self._index :])):
                return False
            if max_bytes is not None and self.offset + CHUNK_OVERHEAD + chunks[self._index][1] > max_bytes:
                return False
            if self._read_chunk(data):
                return True
        if max_layer is None and max_bytes is None and len(data) > self.offset:
            raise Malformed(f"{len(data) - self.offset} bytes follow the last chunk, expected none", offset=self.offset)
        return False

    def _read_chunk(self, data: bytes | bytearray) -> bool:
        """Whether the next chunk is a slice, not an ancillary chunk."""
        assert self.header is not None
        expected_type, length = self.header.chunks[self._index]
        chunk = read_chunk(
            data, self.offset, type=expected_type, length=length, scene_id=self._scene_id, index=self._index
        )
        kind = BY_CHUNK_TYPE.get(chunk.type)
        if kind is None and not chunk.ancillary:
            message = f"critical chunk of unknown type {chunk.type}"
            raise UnsupportedFeature(message, offset=self.offset, chunk=self._index)
        if kind is not None and chunk.ancillary:
            message = f"layer {kind.layer} is flagged ancillary, expected a critical chunk"
            raise Malformed(message, offset=self.offset, chunk=self._index)
        if kind is not None:
            self._check_place(chunk, kind.layer)
            try:
                self._read_slice(chunk, kind)
            except DecodeError as error:
                raise _located(error, self._index, self.offset) from None
        self._index += 1
        self.offset = chunk.end
        return kind is not None

    def _goes_on(self, layer: int) -> bool:
        """Whether a slice of `layer` before was read."""
        return bool(self.slices) and self.slices[-1][0].kind.layer == layer

    def _check_place(self, chunk: Chunk, layer: int) -> None:
        """Raise Malformed unless the slice's flags fit its place (clause "slices")."""
        assert self.header is not None
        expected, message = len(self.slices[-1]) if self._goes_on(layer) else 0, ""
        following = layers_of(self.header.chunks[self._index + 1 :])[:1]
        if chunk.slice != expected:
            message = f"slice {chunk.slice} of layer {layer}, expected {expected}"
        elif following and chunk.more != (following == [layer]):
            told = "announces a further slice" if chunk.more else "ends its layer"
            message = f"slice {expected} of layer {layer} {told}, but layer {following[0]} follows"
        if message:
            raise Malformed(message, offset=self.offset + 2, chunk=self._index)

    def _read_slice(self, chunk: Chunk, kind: LayerKind) -> None:
        assert self.header is not None
        later = self._goes_on(kind.layer)
        past = self._past if later else Past[Prior]() if chunk.more else None
        header = self.header
        read = read_layer(chunk.payload, kind, header.widths, self._declared, header.mode, later, past)
        before = self.layers if read.mask_increase.size else []
        check_last_layer([*before, read], self._taken, header.info.voxel_size, header.grid)
        _check_bounded(read, header)
        symbols = sum(a.size for a in read.arrays())
        self._declared = self._declared.and_slice(len(read.anchor_q), symbols, len(chunk.payload))
        self._past = past
        at = -1 if later else len(self.slices)
        self.slices = [*self.slices[:at], [*(self.slices[-1] if later else ()), read]]
        self._merged = [*self._merged[:at], None]


def _check_bounded(layer: LayerSymbols, header: Header) -> None:
    """Raise Malformed unless the header has an error bound for every class of tensors in `layer`."""
    missing = [name for name in layer.steps if name not in header.error_bounds]
    if missing:
        raise Malformed(f"layer {layer.kind.layer}: no error bound of {missing[0]} in the header, expected one")


def _located(error: DecodeError, chunk: int, offset: int) -> DecodeError:
    """`error` from inside a payload, placed in the file. A payload is complete, so it cannot be Truncated."""
    kind = Malformed if isinstance(error, Truncated) else type(error)
    return kind(error.message, offset=offset, chunk=chunk)


def read_layers(
    data: bytes, *, max_layer: int | None = None, max_bytes: int | None = None, allow_partial: bool = False
) -> tuple[LayerReader, bool]:
    """(reader that holds the layers asked for, whether none of them is missing); arguments as in `decode`."""
    if max_layer is not None and max_layer < 0:
        raise ValueError(f"max_layer must be 0 or more, found {max_layer}")
    reader = LayerReader()
    try:
        while reader.next_slice(data, max_layer, max_bytes):
            pass
        if not reader.layers:
            raise Truncated(f"{max_bytes} bytes end before the first slice does", offset=max_bytes)
    except Truncated:
        if not (allow_partial and reader.layers):
            raise
        return reader, False
    return reader, True


def decode_layers(
    data: bytes, *, max_layer: int | None = None, max_bytes: int | None = None, allow_partial: bool = False
) -> tuple[Header, list[LayerSymbols], bool]:
    """(header, symbols per layer, whether nothing asked for is missing)."""
    reader, complete = read_layers(data, max_layer=max_layer, max_bytes=max_bytes, allow_partial=allow_partial)
    assert reader.header is not None
    return reader.header, reader.layers, complete


def decode(
    data: bytes, *, max_layer: int | None = None, max_bytes: int | None = None, allow_partial: bool = False
) -> Scene:
    """The scene of a file, or of its layers <= max_layer, or of the slices within its first max_bytes bytes, at least
    one (bytes after those are not looked at).

    A cut file raises Truncated, or yields its longest valid prefix of slices if allow_partial, which still needs the
    first one. Other faults raise the other DecodeErrors.
    """
    return decode_partial(data, max_layer=max_layer, max_bytes=max_bytes, allow_partial=allow_partial)[0]


def decode_partial(
    data: bytes, *, max_layer: int | None = None, max_bytes: int | None = None, allow_partial: bool = True
) -> tuple[Scene, bool]:
    """(scene, complete): as decode, and whether every slice asked for was there."""
    reader, complete = read_layers(data, max_layer=max_layer, max_bytes=max_bytes, allow_partial=allow_partial)
    return reader.scene(), complete
