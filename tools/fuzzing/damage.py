"""Damage to whole files of any size, checksums left as they are: nothing may be decoded to other symbols.

Decoding is a function of a layer's payload, so a payload that is still whole need not be decoded again: files of a
megabyte take a millisecond or two each.
"""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any
from unittest import mock

from fuzzing.check import DECODED, Finding
from fuzzing.mutate import CHANGES, truncate
from pd4dgs_codec.bitstream.container import CHUNK_OVERHEAD, read_preamble
from pd4dgs_codec.codec import decoder
from pd4dgs_codec.codec.header import unpack_header
from pd4dgs_codec.codec.kinds import BY_CHUNK_TYPE
from pd4dgs_codec.codec.symbols import LayerSymbols
from pd4dgs_codec.errors import DecodeError, Truncated

BOUNDARY = 8  #: bytes to each side of a boundary
CUTS_PER_CHANGE = 0.02

Layers = Sequence[LayerSymbols]


@contextmanager
def whole_payloads_known(files: Sequence[bytes]) -> Iterator[Mapping[bytes, Layers]]:
    """The layers of each file; while this holds, the decoder takes those of an unchanged payload from here."""
    known: dict[Any, LayerSymbols] = {}
    read_layer = decoder.read_layer  # type: ignore[attr-defined]

    def remember(payload: bytes, kind: Any, *rest: Any) -> LayerSymbols:
        return known.setdefault((payload, kind.layer, *rest), read_layer(payload, kind, *rest))

    def recall(payload: bytes, kind: Any, *rest: Any) -> LayerSymbols:
        return known.get((payload, kind.layer, *rest)) or read_layer(payload, kind, *rest)

    with mock.patch.object(decoder, "read_layer", remember):
        layers = {data: decoder.decode_layers(data)[1] for data in files}
    with mock.patch.object(decoder, "read_layer", recall):
        yield layers


def chunk_ends(data: bytes) -> list[tuple[int, bool]]:
    """(offset of the first byte after it, whether it is a layer) of header and chunks."""
    preamble = read_preamble(data)
    ends = [(preamble.size, False)]
    for kind, length in unpack_header(preamble.header).chunks:
        ends.append((ends[-1][0] + CHUNK_OVERHEAD + length, kind in BY_CHUNK_TYPE))
    return ends


def check_change(data: bytes, originals: Mapping[bytes, Layers]) -> str:
    """What a damaged file ends in; Finding if it decodes and is none of the originals."""
    try:
        decoder.decode_layers(data)
    except DecodeError as error:
        return type(error).__name__
    if data not in originals:
        raise Finding("silent", "a damaged file decodes")
    return DECODED


def check_cut(data: bytes, size: int, layers: Layers, ends: Sequence[tuple[int, bool]]) -> str:
    """A cut file is Truncated, and with allow_partial its whole layers and no others come back, flagged."""
    whole = sum(end <= size for end, is_layer in ends if is_layer)
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
    if complete or len(got) != whole or any(a is not b for a, b in zip(got, layers, strict=False)):
        raise Finding("silent", f"the first {size} bytes give {len(got)} layers, complete {complete}; meant {whole}")
    return Truncated.__name__


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
