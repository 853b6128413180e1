"""Decodes a `.pd4` file to a scene, at once or as its bytes arrive."""

from collections.abc import Iterator

from pd4dgs_codec import kinds
from pd4dgs_codec.errors import DecodeError, Truncated
from pd4dgs_codec.format.reader import Base, LayerReader, Source, bytes_of
from pd4dgs_codec.kinds import AnyScene
from pd4dgs_codec.tensors.symbols import LayerSymbols


def decode(
    data: Source,
    *,
    max_layer: int | None = None,
    max_bytes: int | None = None,
    allow_partial: bool = False,
    base: Source | Base | None = None,
) -> AnyScene:
    """Decodes a file, its layers <= max_layer, or the slices within its first max_bytes bytes, at least one. Later
    bytes are ignored.

    data: the bytes of the file, or its path; one that cannot be read raises OSError. A cut file raises Truncated,
    unless allow_partial is set and the file holds at least one slice: then its longest valid prefix of slices is
    decoded. Other faults raise other DecodeErrors; a scene or deformation of an unknown kind is an UnsupportedFeature,
    see `decode_tensors`. max_layer < 0 raises ValueError.

    base: for a file that names one (BaseMissing without, BaseMismatch for another), in the same forms or, for many
    files, from `read_base`. Its anchors come first, and alone where no slice of the file is there.
    """
    options = {"max_layer": max_layer, "max_bytes": max_bytes}
    return decode_partial(bytes_of(data), allow_partial=allow_partial, base=base, **options)[0]


def decode_partial(
    data: bytes,
    *,
    max_layer: int | None = None,
    max_bytes: int | None = None,
    allow_partial: bool = True,
    base: Source | Base | None = None,
) -> tuple[AnyScene, bool]:
    """Returns (scene as from `decode`, whether every requested slice was there)."""
    reader, complete = LayerReader(kinds.check, base), True
    try:
        while reader.next_slice(data, max_layer, max_bytes) is not None:
            pass
        if not reader.showable:
            raise Truncated(f"{max_bytes} bytes end before the first slice is complete", offset=max_bytes)
    except Truncated:
        if not (allow_partial and reader.showable):
            raise
        complete = False
    reader.grown.sort()
    return _scene(reader), complete


def _scene(reader: LayerReader, writeable: bool = True) -> AnyScene:
    assert reader.header is not None
    header = reader.header
    return kinds.scene_of(header.kind, header.table, header.info, reader.grown, writeable)


# -- incremental decoding ----------------------------------------------------------------------------------------------


class Stream:
    """Decodes a file that arrives in pieces of any size, in about the time of `decode`. The scenes do not depend on
    where the pieces are cut. base: as in `decode`."""

    def __init__(self, base: Source | Base | None = None) -> None:
        self._reader = LayerReader(kinds.check, base)
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

    def feed(self, data: bytes) -> list[AnyScene]:
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
        scenes, pending = list[AnyScene](), False
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

    def _scene(self) -> AnyScene:
        return _scene(self._reader, writeable=False)

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


def every_prefix(data: bytes, base: Source | Base | None = None) -> Iterator[AnyScene]:
    """Yields the scene after each slice of a complete file, in the row order of `Stream.feed`. base: as in `decode`.
    Raises DecodeError."""
    reader = LayerReader(kinds.check, base)
    while reader.next_slice(data) is not None:
        yield _scene(reader, writeable=False)


def open_stream(base: Source | Base | None = None) -> Stream:
    """Returns an empty stream, ready to be fed. base: as in `decode`."""
    return Stream(base)
