"""Bytes of a `.pd4` file -> Scene, at once or as they arrive. Needs numpy, constriction, msgpack and nothing else."""

from __future__ import annotations

from collections.abc import Iterator
from copy import copy

from pd4dgs_codec.entropy.priors import Prior
from pd4dgs_codec.errors import DecodeError, Malformed, Truncated, UnsupportedFeature
from pd4dgs_codec.format.attributes import Past
from pd4dgs_codec.format.container import CHUNK_OVERHEAD, PREAMBLE_SIZE, Chunk, read_chunk, read_preamble
from pd4dgs_codec.format.header import Header, layers_of, scene_id_of, unpack_header
from pd4dgs_codec.format.payload import Declared, read_layer
from pd4dgs_codec.format.registry import BY_CHUNK_TYPE, LayerKind
from pd4dgs_codec.format.symbols import LayerSymbols, SceneSymbols, TakenVoxels, check_slice, merged
from pd4dgs_codec.scene import Scene


class LayerReader:
    """Reads a file's chunks in order. It holds no bytes: each call gets all that have arrived. Its lists are replaced
    and never changed, so a copy keeps its state."""

    def __init__(self) -> None:
        self.header: Header | None = None
        self.offset = 0  #: of the next chunk
        self.slices: list[list[LayerSymbols]] = []  #: by layer
        self._merged: list[LayerSymbols | None] = []  # by layer, None until it is asked for
        self._index = 0
        self._scene_id = b""
        self._declared = Declared()
        self._taken = TakenVoxels()
        self._past: Past[Prior] | None = None

    @property
    def layers(self) -> list[LayerSymbols]:
        """The layers read so far; the last one may lack slices."""
        layers = [layer or merged(parts) for layer, parts in zip(self._merged, self.slices, strict=True)]
        self._merged = [*layers]
        return layers

    @property
    def latest(self) -> LayerSymbols:
        """The slice read last."""
        return self.slices[-1][-1]

    @property
    def complete(self) -> bool:
        """Whether every chunk in the header's list has been read."""
        return self.header is not None and self._index == len(self.header.chunks)

    @property
    def symbols(self) -> SceneSymbols:
        """The symbols of the layers read so far, at least one."""
        assert self.header is not None
        return SceneSymbols(self.header.info, self.header.grid, self.layers)

    def scene(self) -> Scene:
        """The scene of the layers read so far, at least one."""
        return self.symbols.scene()

    def next_slice(self, data: bytes | bytearray, max_layer: int | None = None, max_bytes: int | None = None) -> bool:
        """Read one more slice of a layer <= max_layer that ends within the first max_bytes (clause 12); whether there
        was one.

        Raises Truncated, with nothing consumed that a later call would miss, if `data` ends before its end. Raises
        Malformed if bytes follow the last chunk of a file that is read whole (without either limit).
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
        """Read the next chunk; whether it is a slice, not an ancillary chunk."""
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
                self._read_slice(chunk, kind, self.header)
            except DecodeError as error:
                # A payload is whole, so a fault inside it is not Truncated.
                of = Malformed if isinstance(error, Truncated) else type(error)
                raise of(error.message, offset=self.offset, chunk=self._index) from None
        self._index += 1
        self.offset = chunk.end
        return kind is not None

    def _goes_on(self, layer: int) -> bool:
        """Whether a slice of `layer` was read before."""
        return bool(self.slices) and self.slices[-1][0].kind.layer == layer

    def _check_place(self, chunk: Chunk, layer: int) -> None:
        """Raise Malformed unless the slice's flags fit its place (clause 3.6)."""
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

    def _read_slice(self, chunk: Chunk, kind: LayerKind, header: Header) -> None:
        later = self._goes_on(kind.layer)
        past = self._past if later else Past[Prior]() if chunk.more else None
        read, declared = read_layer(chunk.payload, kind, header.grid.widths, self._declared, header.mode, later, past)
        before = self.layers if read.mask_increase.size else []
        check_slice([*before, read], header.info.voxel_size, header.grid)
        missing = [name for name in read.steps if name not in header.error_bounds]
        if missing:
            raise Malformed(f"layer {kind.layer}: no error bound of {missing[0]} in the header, expected one")
        self._taken.take(read.anchor_q)
        self._declared, self._past = declared, past
        at = -1 if later else len(self.slices)
        self.slices = [*self.slices[:at], [*(self.slices[-1] if later else ()), read]]
        self._merged = [*self._merged[:at], None]


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
        if not reader.slices:
            raise Truncated(f"{max_bytes} bytes end before the first slice does", offset=max_bytes)
    except Truncated:
        if not (allow_partial and reader.slices):
            raise
        return reader, False
    return reader, True


def decode(
    data: bytes, *, max_layer: int | None = None, max_bytes: int | None = None, allow_partial: bool = False
) -> Scene:
    """The scene of a file, of its layers <= max_layer, or of the slices within its first max_bytes bytes, at least one.
    Bytes after those are not looked at.

    A cut file raises Truncated; with allow_partial it returns the longest valid prefix of slices, at least one. Other
    faults raise the other DecodeErrors.
    """
    return decode_partial(data, max_layer=max_layer, max_bytes=max_bytes, allow_partial=allow_partial)[0]


def decode_partial(
    data: bytes, *, max_layer: int | None = None, max_bytes: int | None = None, allow_partial: bool = True
) -> tuple[Scene, bool]:
    """(scene, complete): as `decode`, and whether every slice asked for was there."""
    reader, complete = read_layers(data, max_layer=max_layer, max_bytes=max_bytes, allow_partial=allow_partial)
    return reader.scene(), complete


# -- incremental decoding ----------------------------------------------------------------------------------------------


class Stream:
    """Decodes a file fed in pieces of any size. The scenes do not depend on where the pieces are cut."""

    def __init__(self) -> None:
        self._reader = LayerReader()
        self._buffer = bytearray()
        self._error: DecodeError | None = None
        self.slices = 0  #: completed so far

    @property
    def complete(self) -> bool:
        """Whether every chunk in the header's list has arrived."""
        return self._reader.complete

    def feed(self, data: bytes) -> list[Scene]:
        """The newest scene of each layer that `data` completes a slice of, with all slices up to there.

        Slices that arrive together give one scene: a small file may have a thousand slices, and each scene takes memory
        and time for all of its rows. `every_prefix` has a scene for each slice.

        A fault raises its DecodeError now, or at the next call if this one completes a slice before it, and at every
        later call. Scenes returned before stay valid.
        """
        if self._error is not None:
            raise self._error
        self._buffer += data
        newest: dict[int, LayerReader] = {}
        try:
            while self._reader.next_slice(self._buffer):
                self.slices += 1
                newest[self._reader.latest.kind.layer] = copy(self._reader)
        except Truncated:
            pass
        except DecodeError as error:
            self._error = error
            if not newest:
                raise
        return [reader.scene() for reader in newest.values()]

    def finish(self) -> None:
        """End the stream: raises the pending fault, or Truncated if a chunk is missing."""
        if self._error is not None:
            raise self._error
        self._reader.next_slice(self._buffer)


def every_prefix(data: bytes) -> Iterator[Scene]:
    """The scene after each slice of a whole file. Raises DecodeError."""
    reader = LayerReader()
    while reader.next_slice(data):
        yield reader.scene()


def open_stream() -> Stream:
    """An empty stream, ready to be fed."""
    return Stream()
