"""Error bounds of a file: how far a decoded value may lie from the one that was given, and how far the farthest does.

By clause 11.5 and half-to-even rounding |x - x_hat| <= Q/2, plus half a unit in the last place of x_hat: the product
k Q is rounded to binary32 once. Voxel indices and mask codes are integers and come back as they are.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pd4dgs_codec.attributes.table import ATTRIBUTES
from pd4dgs_codec.codec.kinds import LAYER_KINDS
from pd4dgs_codec.errors import EncodeError
from pd4dgs_codec.scene import PLANES, Scene

#: |x| / Q <= 2^23 is computed in binary64, which is off by 2^-30 at most and may turn a tie: so much of Q more.
_TIES = 2.0**-29


@dataclass(frozen=True)
class ErrorBound:
    """Of all tensors that share a step. what: that field of Steps. step: Q, 0 where values are stored as they are.
    bound: the largest error allowed to the largest of the values; largest: the largest error there is. In the unit of
    the values."""

    what: str
    step: float
    bound: float
    largest: float


def error_bounds(given: Scene, decoded: Scene, raw_deformation: bool) -> list[ErrorBound]:
    """One per field of Steps that the scenes' tensors use, in the order of Steps.

    given: the planned scene, its steps those of the file; decoded: what the file holds, of the same rows and shapes.
    Raises EncodeError naming the field if any value lies farther off than its own bound.
    """
    found: dict[str, ErrorBound] = {}
    for (what, raw, x), (_, _, restored) in zip(_tensors(given), _tensors(decoded), strict=True):
        step = 0.0 if raw and raw_deformation else getattr(given.steps, what)
        errors = np.abs(x.astype(np.float64) - restored)
        units = np.spacing(np.abs(restored)).astype(np.float64) if step else np.zeros(1)
        bounds = (0.5 + _TIES) * step + 0.5 * units
        if not (errors <= bounds).all():
            place = np.unravel_index(int((errors - bounds).argmax()), errors.shape)
            row = f"{what}: {x[place]!r} comes back as {restored[place]!r} at step {step:g}"
            raise EncodeError(f"verification: {row}, expected at most half a step between them")
        before = found.get(what, ErrorBound(what, step, 0.0, 0.0))
        bound, largest = float(bounds.max(initial=before.bound)), float(errors.max(initial=before.largest))
        found[what] = ErrorBound(what, step, bound, largest)
    return [found[what] for what in vars(given.steps) if what in found]


def _tensors(scene: Scene) -> Iterator[tuple[str, bool, np.ndarray]]:
    """(field of Steps, whether it belongs to a deformation, float32 values)."""
    for attribute in ATTRIBUTES:
        yield attribute.name, False, getattr(scene, attribute.name)
    for kind in LAYER_KINDS:
        deformation = getattr(scene, kind.deformation) if kind.deformation else None
        networks = scene.networks if kind.deformation is None else deformation.networks if deformation else {}
        if deformation and kind.planes_step:
            for scale in deformation.planes:
                yield from ((kind.planes_step, True, scale[name]) for name, _, _ in PLANES)
        for name in kind.network_ids:
            for pair in networks.get(name, ()):
                yield from ((kind.weights_step, kind.deformation is not None, array) for array in pair)
