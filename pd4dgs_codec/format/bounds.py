"""Error bounds of a file: how far a decoded value may lie from the given one, and how far the farthest does.

By clause 11.5 and rounding half to even, |x - x_hat| <= Q/2 plus half a unit in the last place of x_hat, because the
product k Q is rounded to binary32. Voxel indices and mask codes are integers and come back exactly.

The header declares one bound per class of tensors (clause 5.4), the classes being the fields of Steps. An anchor of
step class c has 2^c times the steps and the bounds.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from pd4dgs_codec.errors import EncodeError
from pd4dgs_codec.format.deformation import arrays_of
from pd4dgs_codec.format.quantise import dequantise, magnitude
from pd4dgs_codec.format.symbols import SceneSymbols
from pd4dgs_codec.scene import Scene

#: |x| / Q <= 2^23 is computed in binary64, off by at most 2^-30, which may turn a tie: allow this share of Q more.
_TIES = 2.0**-29


@dataclass(frozen=True)
class ErrorBound:
    """Errors of all tensors that share a step, in the unit of the values. what: the field of Steps. step: Q. bound: the
    error that the header declares. largest: the largest error."""

    what: str
    step: float
    bound: float
    largest: float


def rounding_bounds(symbols: SceneSymbols) -> dict[str, float]:
    """By field of Steps that the symbols use: the largest error of rounding to the nearest symbol, rounded up to
    binary32. The symbol farthest from 0 has the largest bound."""
    farthest: dict[str, int] = {}
    for layer in symbols.layers:
        found = list(symbols.grid.farthest(layer.attributes, layer.classes).items())
        found += [(what, magnitude(k)) for what, k in arrays_of(layer.tensors, layer.kind)]
        for what, k in found:
            farthest[what] = max(farthest.get(what, 0), k)
    steps = vars(symbols.steps)
    return {
        what: _rounded_up(float(_bounds(dequantise(np.array([k]), steps[what]), steps[what])[0]))
        for what, k in farthest.items()
    }


def verify_errors(given: Scene, symbols: SceneSymbols, declared: Mapping[str, float]) -> list[ErrorBound]:
    """A row per entry of `declared`, the bounds in the header. given: the planned scene that was quantised.

    Raises EncodeError naming the field if a dequantised value lies farther from the given one than declared, or than
    rounding takes it.
    """
    steps, largest = vars(symbols.steps), dict.fromkeys(declared, 0.0)
    for what, x, restored, spacing in _pairs(given, symbols):
        errors = np.abs(x.astype(np.float64) - restored) / spacing
        bounds = np.minimum(_bounds(np.abs(restored), steps[what]), declared[what])
        if not (errors <= bounds).all():
            place = np.unravel_index(int((errors - bounds).argmax()), errors.shape)
            row = f"{what}: {x[place]} comes back as {restored[place]} at step {steps[what]:g}"
            raise EncodeError(f"verification: {row}, expected at most {bounds[place]:.9g} between them")
        largest[what] = max(largest[what], float(errors.max(initial=0.0)))
    return [ErrorBound(what, steps[what], bound, largest[what]) for what, bound in declared.items()]


def _pairs(given: Scene, symbols: SceneSymbols) -> Iterator[tuple[str, np.ndarray, np.ndarray, np.ndarray | float]]:
    """(field of Steps, values given, values dequantised, 2^step class of each)."""
    for rows, classes, values in symbols.blocks():
        for name, x in values.items():
            spacing = 2.0 ** classes.reshape(-1, *(1,) * (x.ndim - 1)) if classes.size else 1.0
            yield name, given.attributes[name][rows], x, spacing
    for layer in symbols.layers:
        both = (arrays_of(given.tensors(layer.kind.layer), layer.kind), arrays_of(layer.tensors, layer.kind))
        for (what, x), (_, k) in zip(*both, strict=True):
            yield what, x, dequantise(k, layer.steps[what]), 1.0


def _bounds(magnitudes: np.ndarray, step: float) -> np.ndarray:
    """float64 error bounds of dequantised values of these float32 magnitudes."""
    last_place: np.ndarray = np.spacing(magnitudes).astype(np.float64)
    return (0.5 + _TIES) * step + 0.5 * last_place


def _rounded_up(value: float) -> float:
    """The least binary32 value that is not below."""
    nearest = np.float32(value)
    return float(nearest if nearest >= value else np.nextafter(nearest, np.float32(np.inf)))
