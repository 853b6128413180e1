"""Attributes whose low bits come late: slices hold coarse symbols, and later slices the bits that refine them.

With `bits` low bits a symbol q is coded as k, its nearest multiple of 2**bits, and as what is left. Until the rest has
come a decoder shows k * 2**bits. Halves go to even k: rounded away from zero, all that is odd would grow, and the
networks add such errors up (with one bit, shelf-hand's level 0 had 33.0 dB instead of 35.2). By the sign of k the rest
is mirrored, so that it leans to zero, and it stands in three channels each: where k is 0 most of it is 0 too, and odd k
have fewer rests than even ones, with one bit none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pd4dgs_codec.entropy.channels import CodedChannels, decode_channels, encode_channels
from pd4dgs_codec.entropy.priors import MORE_ENTRIES
from pd4dgs_codec.errors import Malformed
from pd4dgs_codec.format.options import EncodeOptions
from pd4dgs_codec.format.quantise import MAX_SYMBOL, magnitude
from pd4dgs_codec.format.symbols import LayerSymbols


def coarse(layer: LayerSymbols, bits: int) -> LayerSymbols:
    """The layer with attributes in units of 2**bits, rounded to nearest, halves to even."""
    q = layer.attributes
    return replace(layer, attributes=np.rint(q * 2.0**-bits).astype(np.int32)) if bits else layer


def shifted(layer: LayerSymbols, bits: int) -> LayerSymbols:
    """The layer of coarse attributes as it is shown until they are refined. Raises Malformed."""
    k = layer.attributes
    if magnitude(k) > MAX_SYMBOL >> bits:
        raise Malformed(f"layer {layer.kind.layer}: a coarse symbol over {MAX_SYMBOL >> bits} in magnitude")
    return replace(layer, attributes=k << bits) if bits else layer


def unrefined(layer: LayerSymbols, bits: int) -> LayerSymbols:
    """The layer as it is shown before its low bits have come. Raises Malformed."""
    return shifted(coarse(layer, bits), bits)


def write_refinement(parts: Sequence[LayerSymbols], bits: int, options: EncodeOptions) -> CodedChannels:
    """The low bits of these slices' attributes. Inverse: read_refinement."""
    q = np.concatenate([part.attributes for part in parts], axis=1)
    k = np.concatenate([coarse(part, bits).attributes for part in parts], axis=1)
    rest = np.where(k < 0, -1, 1).astype(np.int32) * (q - (k << bits))
    channels = [row[chosen] for row, own in zip(rest, k, strict=True) for chosen in _classes(own)]
    return encode_channels(channels, priors=options.priors, effort=options.effort, entries=MORE_ENTRIES)


def read_refinement(section: bytes, parts: Sequence[LayerSymbols], bits: int) -> list[LayerSymbols]:
    """The slices, as `shifted` left them, with their low bits. Raises DecodeError's subclasses."""
    k = np.concatenate([part.attributes for part in parts], axis=1)
    classes = [_classes(row >> bits) for row in k]
    counts = [int(chosen.sum()) for own in classes for chosen in own]
    found = iter(decode_channels(section, counts, entries=MORE_ENTRIES))
    for row, own in zip(k, classes, strict=True):
        for chosen in own:
            rest = next(found)
            if magnitude(rest) > 1 << bits >> 1:
                raise Malformed(f"low bits over {1 << bits >> 1} in magnitude, of {bits} bits")
            row[chosen] += np.where(row[chosen] < 0, -rest, rest)
    if magnitude(k) > MAX_SYMBOL:
        raise Malformed(f"a refined symbol over {MAX_SYMBOL} in magnitude")
    ends = np.cumsum([part.attributes.shape[1] for part in parts])[:-1]
    return [replace(part, attributes=refined) for part, refined in zip(parts, np.split(k, ends, axis=1), strict=True)]


def _classes(k: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where coarse symbols are 0, where they are odd, and where they are even and not 0: bool [n] each."""
    zero, odd = k == 0, k & 1 == 1
    return zero, odd, ~(zero | odd)
