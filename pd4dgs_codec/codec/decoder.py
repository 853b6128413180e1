"""Bytes of a `.pd4` file -> Scene. Takes bytes and nothing else; needs numpy, constriction and the standard library."""

from __future__ import annotations

from pd4dgs_codec.bitstream.container import PREAMBLE_SIZE, read_chunk, read_preamble
from pd4dgs_codec.codec.header import Header, scene_id_of, unpack_header
from pd4dgs_codec.codec.kinds import BY_CHUNK_TYPE
from pd4dgs_codec.codec.layer_meta import Declared
from pd4dgs_codec.codec.payload import read_layer
from pd4dgs_codec.codec.symbols import LayerSymbols, assemble, check_last_layer
from pd4dgs_codec.errors import DecodeError, Malformed, Truncated, UnsupportedFeature
from pd4dgs_codec.scene import Scene


class LayerReader:
    """Walks a file's chunks in order. It holds no bytes: every call gets all that has arrived."""

    def __init__(self) -> None:
        self.header: Header | None = None
        self.layers: list[LayerSymbols] = []
        self.offset = 0  #: of the next chunk
        self._index = 0
        self._scene_id = b""
        self._declared = Declared()

    @property
    def complete(self) -> bool:
        """Whether every chunk that the header lists has been read."""
        return self.header is not None and self._index == len(self.header.chunks)

    def scene(self) -> Scene:
        """The scene of the layers read so far, at least one."""
        assert self.header is not None
        return assemble(self.header.info, self.header.grid, self.layers)

    def next_layer(self, data: bytes | bytearray, max_layer: int | None = None) -> LayerSymbols | None:
        """Read on to the end of one more layer <= max_layer; None if the file has no more (clause "decoding process").

        Raises Truncated, with nothing consumed that a later call would miss, if `data` ends before; Malformed if
        bytes follow the last chunk of a file that is read whole (max_layer None).
        """
        if self.header is None:
            preamble = read_preamble(data)
            self.header, self.offset = unpack_header(preamble.header, offset=PREAMBLE_SIZE), preamble.size
            self._scene_id = scene_id_of(preamble.header)
        chunks = self.header.chunks
        while self._index < len(chunks):
            if max_layer is not None and not _any_layer(chunks[self._index :], max_layer):
                return None
            layer = self._read_chunk(data)
            if layer is not None:
                self.layers.append(layer)
                return layer
        if max_layer is None and len(data) > self.offset:
            raise Malformed(f"{len(data) - self.offset} bytes follow the last chunk, expected none", offset=self.offset)
        return None

    def _read_chunk(self, data: bytes | bytearray) -> LayerSymbols | None:
        """The layer in the next chunk, or None if it is an ancillary one that is not known."""
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
        layer = None
        if kind is not None:
            try:
                layer = read_layer(
                    chunk.payload,
                    kind,
                    self.header.widths,
                    self._declared,
                    self.header.mode,
                    self.header.raw_deformation,
                )
                check_last_layer([*self.layers, layer], self.header.info.voxel_size, self.header.grid)
                _check_bounded(layer, self.header)
            except DecodeError as error:
                raise _located(error, self._index, self.offset) from None
            symbols = sum(a.size for a in layer.arrays())
            self._declared = self._declared.and_layer(len(layer.anchor_q), symbols, len(chunk.payload))
        self._index += 1
        self.offset = chunk.end
        return layer


def _any_layer(chunks: tuple[tuple[int, int], ...], max_layer: int) -> bool:
    return any(kind in BY_CHUNK_TYPE and BY_CHUNK_TYPE[kind].layer <= max_layer for kind, _ in chunks)


def _check_bounded(layer: LayerSymbols, header: Header) -> None:
    """Raise Malformed unless the header has an error bound for every class of tensors in `layer`."""
    missing = [name for name in layer.steps if name not in header.error_bounds]
    if missing:
        raise Malformed(f"layer {layer.kind.layer}: no error bound of {missing[0]} in the header, expected one")


def _located(error: DecodeError, chunk: int, offset: int) -> DecodeError:
    """`error` from inside a payload, placed in the file. A payload is complete, so it cannot be Truncated."""
    kind = Malformed if isinstance(error, Truncated) else type(error)
    return kind(error.message, offset=offset, chunk=chunk)


def read_layers(data: bytes, *, max_layer: int | None = None, allow_partial: bool = False) -> tuple[LayerReader, bool]:
    """(reader that holds the layers asked for, whether none of them is missing); arguments as in `decode`."""
    if max_layer is not None and max_layer < 0:
        raise ValueError(f"max_layer must be 0 or more, found {max_layer}")
    reader = LayerReader()
    try:
        while reader.next_layer(data, max_layer) is not None:
            pass
    except Truncated:
        if not (allow_partial and reader.layers):
            raise
        return reader, False
    return reader, True


def decode_layers(
    data: bytes, *, max_layer: int | None = None, allow_partial: bool = False
) -> tuple[Header, list[LayerSymbols], bool]:
    """(header, symbols per layer, whether nothing asked for is missing)."""
    reader, complete = read_layers(data, max_layer=max_layer, allow_partial=allow_partial)
    assert reader.header is not None
    return reader.header, reader.layers, complete


def decode(data: bytes, *, max_layer: int | None = None, allow_partial: bool = False) -> Scene:
    """The scene of a file, or of its layers <= max_layer (bytes after those are not looked at).

    A cut file raises Truncated, or yields its longest valid prefix of layers if allow_partial, which still needs
    layer 0. Other faults raise the other DecodeErrors.
    """
    return decode_partial(data, max_layer=max_layer, allow_partial=allow_partial)[0]


def decode_partial(data: bytes, *, max_layer: int | None = None, allow_partial: bool = True) -> tuple[Scene, bool]:
    """(scene, complete): as decode, and whether every layer asked for was there."""
    reader, complete = read_layers(data, max_layer=max_layer, allow_partial=allow_partial)
    return reader.scene(), complete
