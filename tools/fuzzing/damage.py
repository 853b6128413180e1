"""Damage to whole files of any size, checksums left as they are: nothing may be decoded to other symbols.

Decoding is a function of a layer's payload, so a payload that is still whole need not be decoded again: files of a
megabyte take a millisecond or two each.
"""

from __future__ import annotations

import random
import weakref
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any
from unittest import mock

import numpy as np

from fuzzing.check import DECODED, Finding
from fuzzing.mutate import CHANGES, truncate
from pd4dgs_codec.errors import DecodeError, Truncated
from pd4dgs_codec.format import decoder
from pd4dgs_codec.format.container import CHUNK_OVERHEAD, read_preamble
from pd4dgs_codec.format.header import unpack_header
from pd4dgs_codec.format.kinds import BY_CHUNK_TYPE
from pd4dgs_codec.format.symbols import LayerSymbols, merged

BOUNDARY = 8  #: bytes to each side of a boundary
CUTS_PER_CHANGE = 0.02

#: By the number of slices that have come, those of each layer as they are then.
Prefixes = Sequence[Sequence[Sequence[LayerSymbols]]]


class _Payloads:
    """A read_layer that remembers what payloads hold. A slice is read with the Past of its layer's slices before, so it
    is known by their payloads and its own."""

    def __init__(self) -> None:
        self._read = decoder.read_layer  # type: ignore[attr-defined]
        self._known: dict[Any, LayerSymbols] = {}
        self._before = weakref.WeakKeyDictionary[Any, tuple[Any, ...]]()

    def remember(self, payload: bytes, kind: Any, *rest: Any) -> LayerSymbols:
        return self._known.setdefault(self._key(payload, kind, rest), self._read(payload, kind, *rest))

    def recall(self, payload: bytes, kind: Any, *rest: Any) -> LayerSymbols:
        past, before = rest[-1], self._before.get(rest[-1], ()) if rest[-1] else ()
        found = self._known.get(self._key(payload, kind, rest))
        if found is None:
            for arguments in before:  # which were recalled, so that their priors are not in `past` yet
                self._read(*arguments, past)
            found = self._read(payload, kind, *rest)
        return found

    def _key(self, payload: bytes, kind: Any, rest: Sequence[Any]) -> Any:
        *rest, past = rest
        before = self._before.get(past, ()) if past else ()
        if past:
            self._before[past] = (*before, (payload, kind, *rest))
        return (payload, kind.layer, *rest, *(arguments[0] for arguments in before))


@contextmanager
def whole_payloads_known(files: Sequence[bytes]) -> Iterator[Mapping[bytes, Prefixes]]:
    """The prefixes of each file; while this holds, the decoder takes those of an unchanged payload from here."""
    payloads = _Payloads()
    with mock.patch.object(decoder, "read_layer", payloads.remember):
        prefixes = {data: list(_prefixes(data)) for data in files}
    with mock.patch.object(decoder, "read_layer", payloads.recall):
        yield prefixes


def _prefixes(data: bytes) -> Iterator[Sequence[Sequence[LayerSymbols]]]:
    reader = decoder.LayerReader()
    yield reader.slices
    while reader.next_slice(data):
        yield reader.slices


def chunk_ends(data: bytes) -> list[tuple[int, bool]]:
    """(offset of the first byte after it, whether it is a slice) of header and chunks."""
    preamble = read_preamble(data)
    ends = [(preamble.size, False)]
    for kind, length in unpack_header(preamble.header).chunks:
        ends.append((ends[-1][0] + CHUNK_OVERHEAD + length, kind in BY_CHUNK_TYPE))
    return ends


def check_change(data: bytes, originals: Mapping[bytes, Prefixes]) -> str:
    """What a damaged file ends in; Finding if it decodes and is none of the originals."""
    try:
        decoder.decode_layers(data)
    except DecodeError as error:
        return type(error).__name__
    if data not in originals:
        raise Finding("silent", "a damaged file decodes")
    return DECODED


def check_cut(data: bytes, size: int, prefixes: Prefixes, ends: Sequence[tuple[int, bool]]) -> str:
    """A cut file is Truncated, and with allow_partial its whole slices and no others come back, flagged."""
    whole = sum(end <= size for end, is_slice in ends if is_slice)
    layers = [merged(of_layer) for of_layer in prefixes[whole]]
    cut = data[:size]
    try:
        decoder.decode_layers(cut)
    except Truncated:
        pass
    else:
        raise Finding("silent", f"the first {size} bytes decode as a whole file")
    try:
        _, got, complete = decoder.decode_layers(cut, allow_partial=True)
    except Truncated:
        got, complete = [], False
    if complete or len(got) != len(layers) or not all(map(_alike, got, layers)):
        meant = f"{whole} slices of {len(layers)} layers"
        raise Finding("silent", f"the first {size} bytes give {len(got)} layers, complete {complete}; meant {meant}")
    return Truncated.__name__


def _alike(a: LayerSymbols, b: LayerSymbols) -> bool:
    """Whether two layers hold the same. One of a single slice is the slice itself."""
    return a is b or all(np.array_equal(x, y) for x, y in zip(a.arrays(), b.arrays(), strict=True))


def damage(files: Sequence[bytes], run: int, changes: int) -> tuple[Counter[str], list[str]]:
    """(what damaged files end in, findings in words) of `changes` random changes, a fiftieth as many cuts, and all cuts
    and single-bit flips within BOUNDARY bytes of the ends of header and chunks, over files in turn.
    """
    outcomes: Counter[str] = Counter()
    findings: list[str] = []
    kinds = [change for change in CHANGES if change is not truncate]
    rng = random.Random(run)
    with whole_payloads_known(files) as originals:

        def examine(what: str, check: Any, *args: Any) -> None:
            try:
                outcomes[check(*args)] += 1
            except Finding as finding:
                findings.append(f"{what}: {finding}")

        for index in range(changes):
            changed = bytearray(files[index % len(files)])
            change = rng.choice(kinds)
            change(rng, changed, rng.choice(files))
            examine(f"change {index}, {change.__name__}", check_change, bytes(changed), originals)
        for number, data in enumerate(files):
            ends = chunk_ends(data)
            near = [e + d for e, _ in ends for d in range(-BOUNDARY, BOUNDARY + 1) if 0 <= e + d < len(data)]
            cuts = int(changes * CUTS_PER_CHANGE / len(files))
            for size in [*near, *(rng.randrange(len(data)) for _ in range(cuts))]:
                examine(f"file {number} cut at {size}", check_cut, data, size, originals[data], ends)
            for bit in [8 * place + b for place in near for b in range(8)]:
                flipped = bytearray(data)
                flipped[bit // 8] ^= 1 << bit % 8
                examine(f"file {number}, bit {bit}", check_change, bytes(flipped), originals)
    return outcomes, findings
