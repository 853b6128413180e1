"""The attributes of anchors <-> symbols, channel-major: one channel per scalar, in the order of `Widths.attributes`."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from pd4dgs_codec.attributes.quantise import dequantise, quantise
from pd4dgs_codec.scene import ATTRIBUTES, Widths


def attribute_rows(symbols: np.ndarray, widths: Widths) -> Iterator[tuple[str, np.ndarray]]:
    """(name, its rows [scalars, n]) of channel-major symbols [widths.channels, n]."""
    first = 0
    for name, shape in widths.attributes.items():
        last = first + math.prod(shape)
        yield name, symbols[first:last]
        first = last


def quantise_attributes(values: dict[str, np.ndarray], steps: dict[str, float]) -> np.ndarray:
    """int32 [channels, n] symbols, channel-major, of float32 [n, *shape] per attribute name."""
    flat = [(name, values[name].reshape(len(values[name]), math.prod(values[name].shape[1:]))) for name in ATTRIBUTES]
    return np.ascontiguousarray(np.concatenate([quantise(x, steps[name], name).T for name, x in flat]))


def dequantise_attributes(symbols: np.ndarray, widths: Widths, steps: dict[str, float]) -> dict[str, np.ndarray]:
    """The inverse of quantise_attributes: float32 [n, *shape] per attribute name, C-contiguous."""
    return {
        name: dequantise(np.ascontiguousarray(rows.T), steps[name]).reshape(-1, *widths.attributes[name])
        for name, rows in attribute_rows(symbols, widths)
    }
