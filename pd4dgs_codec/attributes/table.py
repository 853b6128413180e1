"""The table of per-anchor attributes. Adding an attribute is adding a row here (and a row in the specification)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pd4dgs_codec.attributes.quantise import dequantise, quantise
from pd4dgs_codec.scene import FEATURE_DIM, N_OFFSETS, SCALING_DIM


@dataclass(frozen=True)
class Attribute:
    """One attribute: `name` is the field of Scene and of Steps, `shape` the shape of one anchor's value."""

    name: str
    shape: tuple[int, ...]

    @property
    def width(self) -> int:
        """Number of channels: scalars per anchor."""
        return math.prod(self.shape)


#: In coding order; the channels of an anchor are these attributes' scalars, last axis fastest.
ATTRIBUTES: tuple[Attribute, ...] = (
    Attribute("feature", (FEATURE_DIM,)),
    Attribute("scaling_log", (SCALING_DIM,)),
    Attribute("offset", (N_OFFSETS, 3)),
)

N_CHANNELS = sum(a.width for a in ATTRIBUTES)


def attribute_rows(symbols: np.ndarray) -> Iterator[tuple[Attribute, np.ndarray]]:
    """(attribute, its rows [width, n]) of channel-major symbols [N_CHANNELS, n]."""
    first = 0
    for a in ATTRIBUTES:
        yield a, symbols[first : first + a.width]
        first += a.width


def quantise_attributes(values: dict[str, np.ndarray], steps: dict[str, float]) -> np.ndarray:
    """int32 [N_CHANNELS, n] symbols, channel-major, of float32 [n, *shape] per attribute name."""
    columns = [quantise(values[a.name].reshape(-1, a.width), steps[a.name], a.name).T for a in ATTRIBUTES]
    return np.ascontiguousarray(np.concatenate(columns))


def dequantise_attributes(symbols: np.ndarray, steps: dict[str, float]) -> dict[str, np.ndarray]:
    """The inverse of quantise_attributes: float32 [n, *shape] per attribute name, C-contiguous."""
    return {
        a.name: dequantise(np.ascontiguousarray(rows.T), steps[a.name]).reshape(-1, *a.shape)
        for a, rows in attribute_rows(symbols)
    }
