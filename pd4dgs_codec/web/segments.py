"""Fetches a scene that is cut in time: the segment that shows a time, with its base, and nothing else."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from functools import partial
from urllib.parse import urljoin

from pd4dgs_codec.errors import DataError, DecodeError, DeliveryError
from pd4dgs_codec.format.decoder import decode
from pd4dgs_codec.format.reader import Base, read_base
from pd4dgs_codec.kinds import AnyScene
from pd4dgs_codec.segments import MOST_BYTES, File, Index, check, parse
from pd4dgs_codec.web.client import Changed, Transfer, fetch


@dataclass(frozen=True, eq=False)
class Part:
    """What shows a time. number: of the segment. scene: of the segment; if it has a problem, of its base alone, or None
    without one. problem: why it did not come, in one line, "" if it did."""

    number: int
    scene: AnyScene | None
    problem: str = ""


class SegmentsClient:
    """Decodes the segments of an index at one address. It holds one base, so memory does not grow.

    max_layer: of segments. stall, attempts: see `client.Transfer`. received: bytes so far.
    """

    def __init__(self, url: str, *, max_layer: int | None = None, stall: float = 10.0, attempts: int = 5):
        self.url, self.max_layer, self.received = url, max_layer, 0
        self._transfer = partial(Transfer, stall=stall, attempts=attempts)
        self._index: Index | None = None
        self._base: tuple[int, Base, AnyScene] | None = None

    @property
    def index(self) -> Index:
        """The index, fetched at first use. Raises DeliveryError, DataError."""
        if self._index is None:
            with contextlib.closing(self._transfer(self.url)) as transfer:
                while len(transfer.data) <= MOST_BYTES:
                    with contextlib.suppress(Changed):
                        if not transfer.read(MOST_BYTES + 1):
                            break
                self.received += len(transfer.data)
                found = parse(bytes(transfer.data), self.url)
            if not found.segments:
                raise DataError(f"{self.url}: lists no segments, expected one at least")
            self._index = found
        return self._index

    def at(self, seconds: float) -> Part:
        """Fetches what shows a time, seconds; times outside the scene are moved into it. Of two segments that show it,
        the one of larger weight. A segment that is missing, damaged or of another scene leaves its base. Raises as
        `index` does."""
        return self._part(self.index.at(seconds))

    def shown(self, seconds: float) -> list[tuple[Part, float]]:
        """Fetches all that `Index.shown` says, with weights. A part with a problem has weight 0 beside one without; of
        two with problems, the earlier one has. Raises as `index` does."""
        parts = [(self._part(number), weight) for number, weight in self.index.shown(seconds)]
        alone = next((part for part, _ in parts if not part.problem), parts[-1][0])
        return [(p, float(p is alone)) for p, _ in parts] if any(p.problem for p, _ in parts) else parts

    def _part(self, number: int) -> Part:
        segment, base, scene = self.index.segments[number], None, None
        try:
            if segment.base is not None:
                base, scene = self._based(segment.base)
            data = self._fetched(segment, self.max_layer)
            return Part(number, decode(data, max_layer=self.max_layer, base=base))
        except (DeliveryError, DecodeError, DataError) as error:
            named = segment.file in str(error)
            return Part(number, scene, str(error) if named else f"{segment.file}: {error}")

    def _based(self, number: int) -> tuple[Base, AnyScene]:
        if self._base is None or self._base[0] != number:
            data = self._fetched(self.index.bases[number], 0)
            self._base = number, read_base(data), decode(data, max_layer=0)
        return self._base[1:]

    def _fetched(self, file: File, max_layer: int | None) -> bytes:
        url = urljoin(self.url, file.file)
        with contextlib.closing(self._transfer(url)) as transfer:
            data = fetch(transfer, max_layer)
            self.received += len(transfer.data)
        if max_layer is None:
            check(file, data, url)
        return data
