"""Encoder: checks a scene before it is written, and the quantisation errors of its symbols.

By clause 11.5 and rounding half to even, |x - x_hat| <= Q/2 plus half a unit in the last place of x_hat, because the
product k Q is rounded to binary32. Voxel indices and mask codes are integers and decode exactly. The header declares
one bound per field of Steps (clause 5.4). An anchor of step class c has 2^c times the steps and the bounds.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from pd4dgs_codec.errors import EncodeError
from pd4dgs_codec.format.deformation import arrays_of, check_tensors
from pd4dgs_codec.format.header import MAX_CAMERA_SIDE, info_fault
from pd4dgs_codec.format.quantise import all_finite, dequantise, expect, expect_array, is_step, magnitude, row_blocks
from pd4dgs_codec.format.registry import LAYER_KINDS
from pd4dgs_codec.format.symbols import SceneSymbols
from pd4dgs_codec.morton import MAX_VOXEL
from pd4dgs_codec.scene import MASK_MIN_CODE, MAX_CLASS, MAX_FEATURE, MAX_SLOTS, Scene, SceneInfo

#: Extra share of Q: |x| / Q <= 2^23 in binary64 is off by at most 2^-30, which may round a tie the other way.
_TIES = 2.0**-29


def check_scene(scene: Scene) -> None:
    """Raises EncodeError unless `scene` has the shapes, dtypes and ranges that scene.Scene documents."""
    layers, rows = scene.layers, scene.rows
    expect(layers[:1] == (0,) and set(layers) <= {0, 1, 2}, f"layers {layers}, expected 0 first and only 0, 1, 2")
    expect(all(a < b for a, b in pairwise(layers)), f"layers {layers}, expected ascending numbers")
    expect(len(rows) == len(layers) == len(scene.mask), "rows, mask and layers differ in length")
    expect(all(a <= b for a, b in pairwise((0, *rows))), f"rows {rows}, expected a non-decreasing sequence")
    n = rows[-1]
    expect_array("anchor_q", scene.anchor_q, np.int32, (n, 3))
    reach = magnitude(scene.anchor_q)
    expect(reach <= MAX_VOXEL, f"anchor_q: voxel index of magnitude {reach}, expected at most {MAX_VOXEL}")
    size = scene.info.voxel_size
    finite = not is_step(size) or all_finite(scene.anchor_q, size)
    expect(finite, f"anchor_q: a position is infinite at voxel size {size:g}, expected finite positions")
    for name, axes in (("feature", 2), ("offset", 3)):
        found = scene.attributes[name].shape
        expect(len(found) == axes, f"{name}: an array of {len(found)} axes, expected {axes}")
    widths = scene.widths
    for what, width, limit in (("feature width", widths.feature, MAX_FEATURE), ("slots", widths.slots, MAX_SLOTS)):
        expect(1 <= width <= limit, f"{what}: {width}, expected 1..{limit}")
    for name, shape in widths.attributes.items():
        expect_array(name, scene.attributes[name], np.float32, (n, *shape))
    if scene.grading is not None:
        expect_array("step classes", scene.grading.classes, np.uint8, (n,))
        largest = int(scene.grading.classes.max(initial=0))
        expect(largest <= MAX_CLASS, f"step classes: {largest}, expected at most {MAX_CLASS}")
        expect_array("centre of the attributes", scene.grading.centre, np.float32, (widths.channels,))
    _check_masks(scene)
    check_info(scene.info)
    for name, step in vars(scene.steps).items():
        expect(is_step(step), f"step of {name}: {step!r}, expected a positive normal binary32 value")
    for kind in LAYER_KINDS:
        if kind.layer == 0 or scene.deformation(kind.layer) is not None:
            expect(kind.layer in layers, f"{kind.name} is given, but layer {kind.layer} is not among {layers}")
            below = scene.global_deformation if kind.layer == 2 else None
            check_tensors(scene.tensors(kind.layer), kind, widths, below)


def _check_masks(scene: Scene) -> None:
    for layer, rows, codes in zip(scene.layers, scene.rows, scene.mask, strict=True):
        expect_array(f"mask of layer {layer}", codes, np.uint8, (rows,))
        odd = (codes > 0) & (codes < MASK_MIN_CODE)
        expect(
            not odd.any(), f"mask of layer {layer}: a code below {MASK_MIN_CODE}, expected 0 or {MASK_MIN_CODE}..255"
        )
    for (low, high), layer in zip(pairwise(scene.mask), scene.layers[1:], strict=True):
        expect(bool((high[: low.size] >= low).all()), f"mask of layer {layer} is below the mask of the layer before")


def check_info(info: SceneInfo) -> None:
    """Raises EncodeError unless `info` has the shapes, dtypes and ranges that SceneInfo documents."""
    expect(is_step(info.voxel_size), f"voxel_size {info.voxel_size!r}, expected a positive normal binary32 value")
    expect_array("box", info.box, np.float32, (2, 3))
    expect(bool((info.box[0] <= info.box[1]).all()), "box: a lower corner above the upper one")
    reals = [*info.time_range, *info.background, info.near, info.far, *info.up, info.unit]
    with np.errstate(over="ignore"):
        expect(bool(np.isfinite(np.array(reals, np.float32)).all()), "info: a value is not a finite binary32")
    if info.camera is not None:
        expect_array("camera.viewmat", info.camera.viewmat, np.float32, (4, 4))
        expect_array("camera.K", info.camera.K, np.float32, (3, 3))
        sizes = (info.camera.width, info.camera.height)
        limit = MAX_CAMERA_SIDE
        expect(all(1 <= s <= limit for s in sizes), f"camera of {sizes} pixels, expected 1..{limit} each")
        expect(bool((info.camera.viewmat[3] == (0, 0, 0, 1)).all()), "camera.viewmat: last row is not 0 0 0 1")
        form = info.camera.K * ((0, 1, 0), (1, 0, 0), (1, 1, 1))
        expect(bool((form == ((0, 0, 0), (0, 0, 0), (0, 0, 1))).all()), "camera.K: expected fx 0 cx, 0 fy cy, 0 0 1")
    fault = info_fault(info)
    expect(fault is None, str(fault))


# -- errors ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ErrorBound:
    """Errors of all tensors that share a step, in the unit of the values, divided by 2^c in step class c. what: the
    field of Steps. step: Q. bound: the error that the header declares. largest: the largest error."""

    what: str
    step: float
    bound: float
    largest: float


def rounding_bounds(symbols: SceneSymbols) -> dict[str, float]:
    """Returns the largest error of rounding to the nearest symbol, rounded up to binary32, by field of Steps that the
    symbols use. The symbol farthest from 0 has the largest bound."""
    # They hold in every step class c: an error is at most 2^c Q/2 plus half a unit in the last place, and 2^c times the
    # bound is no less.
    farthest: dict[str, int] = {}
    for layer in symbols.layers:
        found = list(symbols.grid.farthest(layer.attributes, layer.classes).items())
        found += [(what, magnitude(k)) for what, _, k in arrays_of(layer.tensors, layer.kind)]
        for what, k in found:
            farthest[what] = max(farthest.get(what, 0), k)
    steps = vars(symbols.steps)
    return {
        what: _rounded_up(float(_bounds(dequantise(np.array([k]), steps[what]), steps[what])[0]))
        for what, k in farthest.items()
    }


def verify_errors(given: Scene, symbols: SceneSymbols, declared: Mapping[str, float]) -> list[ErrorBound]:
    """Returns the errors for each entry of `declared`, the bounds in the header.

    given: the planned scene that was quantised. Raises EncodeError naming the field if the error of a dequantised value
    exceeds the declared bound or the bound of rounding.
    """
    steps, largest = vars(symbols.steps), dict.fromkeys(declared, 0.0)
    for what, x, restored, spacing in _pairs(given, symbols):
        errors = np.abs(x.astype(np.float64) - restored) / spacing
        bounds = np.minimum(_bounds(np.abs(restored), steps[what]), declared[what])
        if not (errors <= bounds).all():
            place = np.unravel_index(int((errors - bounds).argmax()), errors.shape)
            row = f"{what}: {x[place]} is decoded as {restored[place]} at step {steps[what]:g}"
            raise EncodeError(f"verification: {row}, expected an error of at most {bounds[place]:.9g}")
        largest[what] = max(largest[what], float(errors.max(initial=0.0)))
    return [ErrorBound(what, steps[what], bound, largest[what]) for what, bound in declared.items()]


def _pairs(given: Scene, symbols: SceneSymbols) -> Iterator[tuple[str, np.ndarray, np.ndarray, np.ndarray | float]]:
    """Yields (field of Steps, values given, values dequantised, 2^(step class) of each)."""
    first = 0
    for layer in symbols.layers:
        for rows in row_blocks(len(layer.anchor_q)):
            own, classes = slice(first + rows.start, first + rows.stop), layer.classes[rows]
            for name, x in symbols.grid.dequantise(layer.attributes[:, rows], classes).items():
                spacing = 2.0 ** classes.reshape(-1, *(1,) * (x.ndim - 1)) if classes.size else 1.0
                yield name, given.attributes[name][own], x, spacing
        first += len(layer.anchor_q)
        both = (arrays_of(given.tensors(layer.kind.layer), layer.kind), arrays_of(layer.tensors, layer.kind))
        for (what, _, x), (*_, k) in zip(*both, strict=True):
            yield what, x, dequantise(k, layer.steps[what]), 1.0


def _bounds(magnitudes: np.ndarray, step: float) -> np.ndarray:
    """Returns the error bounds float64 of dequantised values of these float32 magnitudes."""
    last_place: np.ndarray = np.spacing(magnitudes).astype(np.float64)
    return (0.5 + _TIES) * step + 0.5 * last_place


def _rounded_up(value: float) -> float:
    """Returns the least binary32 value that is not below `value`."""
    nearest = np.float32(value)
    return float(nearest if nearest >= value else np.nextafter(nearest, np.float32(np.inf)))
