"""Error bounds of a file: how far a decoded value may lie from the one that was given, and how far the farthest does.

By clause 11.5 and half-to-even rounding |x - x_hat| <= Q/2, plus half a unit in the last place of x_hat: the product
k Q is rounded to binary32 once. Voxel indices and mask codes are integers and come back as they are.

The header declares one bound per class of tensors (clause "error bounds"), the classes being the fields of Steps. An
anchor of step class c has 2^c times the steps, and 2^c times the bounds.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from pd4dgs_codec.errors import EncodeError
from pd4dgs_codec.format.kinds import LAYER_KINDS
from pd4dgs_codec.format.table import classes_of, row_blocks
from pd4dgs_codec.scene import PLANES, Scene

#: |x| / Q <= 2^23 is computed in binary64, which is off by 2^-30 at most and may turn a tie: so much of Q more.
_TIES = 2.0**-29


@dataclass(frozen=True)
class ErrorBound:
    """Of all tensors that share a step. what: that field of Steps. step: Q. bound: the error that the header declares;
    largest: the largest error there is. In the unit of the values."""

    what: str
    step: float
    bound: float
    largest: float


#: Attributes float32 [rows, ...] by name, some rows of a scene at a time, together all of them.
Blocks = Iterable[tuple[slice, Mapping[str, np.ndarray]]]


def blocks_of(scene: Scene) -> Blocks:
    """Those of a scene that is there."""
    for rows in row_blocks(scene.rows[-1]):
        yield rows, {name: values[rows] for name, values in scene.attributes.items()}


def rounding_bounds(decoded: Scene, blocks: Blocks) -> dict[str, float]:
    """By field of Steps that the scene's tensors use: what bounds the error of them all if each value was rounded to
    the nearest symbol, rounded up to binary32. The attributes are those of `blocks`."""
    bounds: dict[str, float] = {}
    for what, step, restored in _tensors(decoded, blocks):
        largest = np.abs(restored).max(initial=np.float32(0))
        bounds[what] = max(bounds.get(what, 0.0), float(_bounds(largest, step)))
    return {what: _rounded_up(bound) for what, bound in bounds.items()}


def verify_errors(given: Scene, decoded: Scene, blocks: Blocks, declared: Mapping[str, float]) -> list[ErrorBound]:
    """One row per entry of `declared`, the bounds in the header of the file.

    given: the planned scene, its steps those of the file; decoded: what the file holds, of the same rows and shapes,
    its attributes those of `blocks`. Raises EncodeError naming the field if any value lies farther off than declared,
    or than rounding takes it.
    """
    steps, largest = dict.fromkeys(declared, 0.0), dict.fromkeys(declared, 0.0)
    spacing = 2.0 ** classes_of(decoded)
    for rows, what, step, x, restored in _pairs(given, decoded, blocks):
        errors = np.abs(x.astype(np.float64) - restored)
        if rows is not None and spacing.size:
            errors /= spacing[rows].reshape(-1, *(1,) * (x.ndim - 1))
        bounds = np.minimum(_bounds(np.abs(restored), step), declared[what])
        if not (errors <= bounds).all():
            place = np.unravel_index(int((errors - bounds).argmax()), errors.shape)
            row = f"{what}: {x[place]} comes back as {restored[place]} at step {step:g}"
            raise EncodeError(f"verification: {row}, expected at most {bounds[place]:.9g} between them")
        steps[what], largest[what] = step, max(largest[what], float(errors.max(initial=0.0)))
    return [ErrorBound(what, steps[what], bound, largest[what]) for what, bound in declared.items()]


def _bounds(magnitude: np.ndarray, step: float) -> np.ndarray:
    """float64 error bounds of decoded values of that float32 magnitude."""
    last_place: np.ndarray = np.spacing(magnitude).astype(np.float64)
    return (0.5 + _TIES) * step + 0.5 * last_place


def _rounded_up(value: float) -> float:
    """The least binary32 value that is not below."""
    nearest = np.float32(value)
    return float(nearest if nearest >= value else np.nextafter(nearest, np.float32(np.inf)))


def _pairs(
    given: Scene, decoded: Scene, blocks: Blocks
) -> Iterator[tuple[slice | None, str, float, np.ndarray, np.ndarray]]:
    """(rows of an attribute, field of Steps, step, values given, values decoded)."""
    for rows, values in blocks:
        for name, x in values.items():
            yield rows, name, given.steps.attributes[name], given.attributes[name][rows], x
    both = zip(_tensors(given, ()), _tensors(decoded, ()), strict=True)
    yield from ((None, what, step, x, restored) for (what, step, x), (_, _, restored) in both)


def _tensors(scene: Scene, blocks: Blocks) -> Iterator[tuple[str, float, np.ndarray]]:
    """(field of Steps, step, float32 values); attributes of `blocks`."""
    for _, values in blocks:
        yield from ((name, scene.steps.attributes[name], x) for name, x in values.items())
    for kind in LAYER_KINDS:
        tensors = scene.tensors(kind.layer)
        for scale in tensors.planes:
            step = scene.steps.planes(kind.layer)
            yield from ((str(kind.planes_step), step, scale[name]) for name, _, _ in PLANES)
        step = scene.steps.weights(kind.layer)
        for name in kind.network_ids:
            for pair in tensors.networks.get(name, ()):
                yield from ((kind.weights_step, step, array) for array in pair)
