"""Decodes a `.pd4` file at once or as its bytes arrive. Needs only numpy, constriction and msgpack."""

from collections.abc import Iterator
from os import PathLike
from pathlib import Path

from pd4dgs_codec.entropy.priors import Prior
from pd4dgs_codec.errors import DecodeError, Malformed, Truncated, UnsupportedFeature
from pd4dgs_codec.format.container import CHUNK_OVERHEAD, Chunk, read_chunk, read_preamble
from pd4dgs_codec.format.header import Header, scene_id_of, unpack_header
from pd4dgs_codec.format.payload import Declared, Past, read_layer
from pd4dgs_codec.format.registry import BY_CHUNK_TYPE, LayerKind
from pd4dgs_codec.format.symbols import GrowingScene, LayerSymbols, SceneSymbols, TakenVoxels, check_slice, merged
from pd4dgs_codec.scene import Scene


class LayerReader:
    """Reads a file's chunks in order. It keeps neither bytes nor slices: each call gets the bytes from the next chunk
    on and returns one slice. A fault leaves the reader as it was before the slice.
    """

    def __init__(self) -> None:
        self.header: Header | None = None
        self.offset = 0  #: of the next chunk
        self.count = 0  #: slices read
        self._scene: GrowingScene | None = None
        self._layer, self._number = -1, -1  # of the latest slice
        self._following: list[int | None] = []  # by chunk, the layer of the first slice from it on
        self._index = 0
        self._scene_id = b""
        self._declared = Declared()
        self._taken = TakenVoxels()
        self._past = Past[Prior]()  # copied for each slice, so that a fault leaves it unchanged

    @property
    def complete(self) -> bool:
        """Whether every chunk in the header's list has been read."""
        return self.header is not None and self._index == len(self.header.chunks)

    @property
    def scene(self) -> GrowingScene:
        """The scene of the slices read so far; requires that the header has been read."""
        assert self._scene is not None
        return self._scene

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
        following: list[int | None] = [None]
        for kind, _ in reversed(header.chunks):
            following.append(kind if kind in BY_CHUNK_TYPE else following[-1])
        self.header, self._following = header, following[::-1]
        self._scene = GrowingScene(header.info, header.grid)

    def _read_chunk(self, data: bytes | bytearray, start: int) -> LayerSymbols | None:
        """Reads the next chunk: a slice, or None for an ancillary chunk."""
        assert self.header is not None
        offset, (kind_of, length) = self.offset, self.header.chunks[self._index]
        place = {"type": kind_of, "length": length, "index": self._index, "start": start}
        chunk = read_chunk(data, offset, scene_id=self._scene_id, **place)
        kind, part = BY_CHUNK_TYPE.get(chunk.type), None
        if kind is None and not chunk.ancillary:
            message = f"critical chunk of unknown type {chunk.type}"
            raise UnsupportedFeature(message, offset=offset, chunk=self._index)
        if kind is not None and chunk.ancillary:
            message = f"layer {kind.layer} is flagged ancillary, expected a critical chunk"
            raise Malformed(message, offset=offset, chunk=self._index)
        if kind is not None:
            self._check_place(chunk, kind.layer)
            try:
                part = self._read_slice(chunk, kind, self.header)
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

    def _read_slice(self, chunk: Chunk, kind: LayerKind, header: Header) -> LayerSymbols:
        later = kind.layer == self._layer
        past = self._past.copy() if later else Past[Prior]()
        part, declared = read_layer(chunk.payload, kind, header.grid.widths, self._declared, header.mode, later, past)
        check_slice(part, self.scene.codes, header.info.voxel_size, header.grid)
        missing = [name for name in part.steps if name not in header.error_bounds]
        if missing:
            raise Malformed(f"layer {kind.layer}: no error bound of {missing[0]} in the header, expected one")
        self._taken.take(part.anchor_q)
        self._declared, self._past = declared, past if chunk.more else Past()
        self._layer, self._number, self.count = kind.layer, chunk.slice, self.count + 1
        self.scene.add(part, not later)
        if self._following[self._index + 1] != kind.layer:
            self.scene.sort()
        return part


def read_layers(data: bytes, *, max_layer: int | None = None) -> tuple[Header, SceneSymbols]:
    """Returns (header, symbols) of a complete file, or of its layers <= max_layer. Raises as `decode` does."""
    reader, layers = LayerReader(), dict[int, list[LayerSymbols]]()
    while (part := reader.next_slice(data, max_layer)) is not None:
        layers.setdefault(part.kind.layer, []).append(part)
    assert reader.header is not None
    header = reader.header
    return header, SceneSymbols(header.info, header.grid, [merged(parts) for parts in layers.values()])


def decode(
    data: bytes | bytearray | memoryview | str | PathLike[str],
    *,
    max_layer: int | None = None,
    max_bytes: int | None = None,
    allow_partial: bool = False,
) -> Scene:
    """Decodes a file, its layers <= max_layer, or the slices within its first max_bytes bytes, at least one. Later
    bytes are ignored.

    data: the bytes of the file, or its path; one that cannot be read raises OSError. A cut file raises Truncated,
    unless allow_partial is set and the file holds at least one slice: then its longest valid prefix of slices is
    decoded. Other faults raise other DecodeErrors; max_layer < 0 raises ValueError.
    """
    data = Path(data).read_bytes() if isinstance(data, (str, PathLike)) else bytes(data)
    return decode_partial(data, max_layer=max_layer, max_bytes=max_bytes, allow_partial=allow_partial)[0]


def decode_partial(
    data: bytes, *, max_layer: int | None = None, max_bytes: int | None = None, allow_partial: bool = True
) -> tuple[Scene, bool]:
    """Returns (scene as from `decode`, whether every requested slice was there)."""
    reader, complete = LayerReader(), True
    try:
        while reader.next_slice(data, max_layer, max_bytes) is not None:
            pass
        if not reader.count:
            raise Truncated(f"{max_bytes} bytes end before the first slice is complete", offset=max_bytes)
    except Truncated:
        if not (allow_partial and reader.count):
            raise
        complete = False
    reader.scene.sort()
    return reader.scene.scene(), complete


# -- incremental decoding ----------------------------------------------------------------------------------------------


class Stream:
    """Decodes a file that arrives in pieces of any size, in about the time of `decode`. The scenes do not depend on
    where the pieces are cut."""

    def __init__(self) -> None:
        self._reader = LayerReader()
        self._buffer = bytearray()  # from byte `consumed` of the file on
        self._needs = 0  # bytes of the file that the next step requires
        self._error: DecodeError | None = None

    @property
    def complete(self) -> bool:
        """Whether every chunk in the header's list has arrived."""
        return self._reader.complete

    @property
    def consumed(self) -> int:
        """Bytes of the file that are decoded and no longer held."""
        return self._reader.offset

    @property
    def slices(self) -> int:
        """Number of slices that are complete so far."""
        return self._reader.count

    def feed(self, data: bytes) -> list[Scene]:
        """Decodes further bytes; returns the newest scene of each layer of which they complete a slice.

        The rows of a layer are in order of arrival until its last slice, and then in the order of `decode`. Scenes
        share their arrays, which are read-only. `every_prefix` yields a scene for each slice.

        A fault raises its DecodeError now, or at the next call if this one completes a slice before it, and at every
        later call until `rewind`. Scenes returned earlier stay valid.
        """
        if self._error is not None:
            raise self._error
        self._buffer.extend(data)  # `+=` with a numpy array would add numbers
        if self.consumed + len(self._buffer) < self._needs:
            return []
        scenes, pending = list[Scene](), False
        try:
            while self._next() is not None:
                pending = not self._reader.whole  # a scene of each slice would keep arrays that are about to be copied
                scenes += [] if pending else [self._scene()]
        except Truncated as error:
            self._needs = error.needs
        except DecodeError as error:
            self._error = error
            if not (scenes or pending):
                raise
        return [*scenes, self._scene()] if pending else scenes

    def _scene(self) -> Scene:
        return self._reader.scene.scene(writeable=False)

    def finish(self) -> None:
        """Ends the stream: raises the pending fault, or Truncated if a chunk is missing."""
        if self._error is not None:
            raise self._error
        self._next()

    def rewind(self) -> None:
        """Forgets a fault and all bytes not yet decoded. Then feed the file from byte `consumed` on."""
        self._buffer, self._needs, self._error = bytearray(), 0, None

    def _next(self) -> LayerSymbols | None:
        start = self.consumed
        try:
            return self._reader.next_slice(self._buffer, start=start)
        finally:
            del self._buffer[: self.consumed - start]


def every_prefix(data: bytes) -> Iterator[Scene]:
    """Yields the scene after each slice of a complete file, in the row order of `Stream.feed`. Raises DecodeError."""
    reader = LayerReader()
    while reader.next_slice(data) is not None:
        yield reader.scene.scene(writeable=False)


def open_stream() -> Stream:
    """Returns an empty stream, ready to be fed."""
    return Stream()
