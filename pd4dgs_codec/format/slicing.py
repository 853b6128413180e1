"""Encoder: a layer's payload in one piece, or in slices of about equal size, the most useful anchors first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pd4dgs_codec.entropy.fitting import Fitted
from pd4dgs_codec.format.attributes import Past
from pd4dgs_codec.format.container import CHUNK_OVERHEAD
from pd4dgs_codec.format.options import EncodeOptions
from pd4dgs_codec.format.payload import StreamReport, write_layer
from pd4dgs_codec.format.symbols import LayerSymbols, sliced

TRIES = 4  #: most encodes of one slice to reach its size
SLACK = 0.97  #: share of the size that a slice aims at
FULL = 0.92  #: share of the size that is large enough


@dataclass(frozen=True, eq=False)
class Slice:
    """A slice as written. anchors: its number of anchors."""

    anchors: int
    payload: bytes
    streams: list[StreamReport]


def whole_layer(layer: LayerSymbols, options: EncodeOptions) -> Slice:
    """A layer in one slice."""
    return Slice(len(layer.anchor_q), *write_layer(layer, options))


def write_slices(layer: LayerSymbols, options: EncodeOptions, utility: np.ndarray, reserved: int = 0) -> list[Slice]:
    """The slices of a layer, in order, of about options.slices bytes at most.

    utility: float [n], of the layer's anchors; the highest come first. reserved: bytes before the first slice that
    count as part of it. A first slice that planes and networks alone make larger has no anchors, except in layer 0,
    where a picture needs some.
    """
    rows = np.argsort(-utility, kind="stable")
    costs = np.cumsum(bits_per_row(layer)[rows]) / 8
    done, found, past = 0, list[Slice](), Past[Fitted]()
    scale = 1.0  # bytes that a slice takes per byte expected
    while done < len(rows) or not found:
        room = options.slices - CHUNK_OVERHEAD - (0 if found else reserved)
        least = 1 if found or layer.kind.layer == 0 else 0
        before = costs[done - 1] if done else 0.0
        fixed = 0 if found else len(write_layer(sliced(layer, rows[:0], True), options)[0])
        if not found and layer.kind.layer == 0:
            room = max(room, 2 * fixed)
        tries: list[tuple[bool, int, Slice, Past[Fitted]]] = []  # fits, anchors, slice, state for the next slice
        for _ in range(TRIES):
            expected = (costs[done:] - before) * scale + fixed
            likely = int(np.searchsorted(expected, room * SLACK, side="right"))
            count = min(max(likely, least), len(rows) - done)
            trial = past.copy()
            payload, streams = write_layer(sliced(layer, rows[done : done + count], not found), options, trial, layer)
            if count:
                scale *= max(len(payload) - fixed, 1) / max(expected[count - 1] - fixed, 1)
            fits = len(payload) <= room or count <= least
            tries.append((fits, count, Slice(count, payload, streams), trial))
            if fits and (len(payload) >= room * FULL or count in (least, len(rows) - done)):
                break
        _, count, made, past = max(tries, key=lambda tried: (tried[0], tried[1] if tried[0] else -tried[1]))
        found.append(made)
        done += count
    return found


def bits_per_row(layer: LayerSymbols) -> np.ndarray:
    """float64 [n]: about the bits that each anchor takes, by the frequencies of its symbols in their channels."""
    n = len(layer.anchor_q)
    bits = np.full(n, 3.0 * max(n, 2).bit_length())  # of a position
    for channel in (layer.mask_own, *layer.attributes):
        _, index, counts = np.unique(channel, return_inverse=True, return_counts=True)
        bits += np.log2(n / counts)[index]
    return bits
