"""Checks a scene before it is written, and the quantisation errors of its symbols."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from pd4dgs_codec import kinds
from pd4dgs_codec.errors import DecodeError, EncodeError
from pd4dgs_codec.format.header import MAX_CAMERA_SIDE, info_fault
from pd4dgs_codec.format.plan import SceneSymbols
from pd4dgs_codec.kinds import AnyScene
from pd4dgs_codec.kinds.scaffold import step_names
from pd4dgs_codec.morton import MAX_VOXEL
from pd4dgs_codec.scene import (
    MASK_MIN_CODE,
    MAX_CLASS,
    Scene,
    SceneInfo,
)
from pd4dgs_codec.tensors.quantise import all_finite, dequantise, expect, expect_array, is_step, magnitude, row_blocks
from pd4dgs_codec.tensors.tables import Tensors


def check_scene(scene: AnyScene) -> None:
    """Raises EncodeError unless `scene` has the shapes, dtypes and ranges that its class documents."""
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
    width = 0
    for name, values in scene.attributes.items():
        expect_array(name, values, np.float32, (n, *values.shape[1:]))
        width += math.prod(values.shape[1:])
    if scene.grading is not None:
        expect_array("step classes", scene.grading.classes, np.uint8, (n,))
        largest = int(scene.grading.classes.max(initial=0))
        expect(largest <= MAX_CLASS, f"step classes: {largest}, expected at most {MAX_CLASS}")
        expect_array("centre of the attributes", scene.grading.centre, np.float32, (width,))
    _check_masks(scene)
    check_info(scene.info)
    for name, step in scene.all_steps.items():
        expect(is_step(step), f"step of {name}: {step!r}, expected a positive normal binary32 value")
    for fill in scene.fills:
        valid = fill is None or (len(fill) in (3, 4) and all(type(c) is int and 0 <= c <= 255 for c in fill))
        expect(valid, f"fill {fill}, expected None or 3 to 4 integers 0..255")
    expect(len(scene.fills) in (0, len(layers)), f"{len(scene.fills)} fills, expected none or one per layer {layers}")
    _check_tensors(scene)


def _check_tensors(scene: AnyScene) -> None:
    """Checks the grids, chains and layer rows of all layers, and then the rules of the kinds."""
    found = dict[int, Tensors]()
    for layer in range(3):
        given, own = scene.deformation(layer), kinds.layer_name(scene, layer)
        if layer and given is None:
            continue
        expect(layer in scene.layers, f"{own} is given, but layer {layer} is not among {scene.layers}")
        kinds.check_arrays(scene, layer)
        tensors = kinds.tensors_of(scene, layer)
        names = [f"{own} {name}" for name in kinds.array_names(scene, layer, tensors.tables)]
        shapes = tensors.tables.planes + tensors.tables.weights
        for name, array, shape in zip(names, tensors.arrays, shapes, strict=True):
            expect_array(name, array, np.float32, shape)
        valued = not isinstance(scene, Scene)  # no values of a scaffold have rules of their own
        found[layer] = tensors.quantised(names.__getitem__) if valued else Tensors(tensors.tables)
        try:
            kinds.check(kinds.kind_of(scene), kinds.row_table(scene), found)
        except DecodeError as error:
            raise EncodeError(f"{own}: {error}") from None


def _check_masks(scene: AnyScene) -> None:
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

#: Extra share of Q: |x| / Q <= 2^23 in binary64 is off by at most 2^-30, which may round a tie the other way.
_TIES = 2.0**-29


@dataclass(frozen=True)
class Errors:
    """Errors of all values that share a step, in the unit of the values, divided by 2^c in step class c. what: the
    field of Steps, or the tensor of splats or of their tracks. step: Q. bound: of rounding, for the largest value.
    largest: the largest error."""

    what: str
    step: float
    bound: float
    largest: float


def verify_errors(given: AnyScene, symbols: SceneSymbols) -> list[Errors]:
    """Returns the errors by step. given: the planned scene that was quantised. Raises EncodeError naming the step if a
    value is farther from its dequantised one than rounding explains: half a step, and half a unit in the last place
    because the product v Q is rounded to binary32."""
    found = dict[str, Errors]()
    for what, step, x, restored, spacing in _pairs(given, symbols):
        bounds = (0.5 + _TIES) * step + 0.5 * np.spacing(np.abs(restored)).astype(np.float64) / spacing
        errors = np.abs(x.astype(np.float64) - restored) / spacing
        if not (errors <= bounds).all():
            place = np.unravel_index(int((errors - bounds).argmax()), errors.shape)
            row = f"{what}: {x[place]} is decoded as {restored[place]} at step {step:g}"
            raise EncodeError(f"verification: {row}, expected an error of at most {bounds[place]:.9g}")
        before = found.get(what, Errors(what, step, 0.0, 0.0))
        worst = [max(a, float(b.max(initial=0.0))) for a, b in ((before.bound, bounds), (before.largest, errors))]
        found[what] = Errors(what, step, *worst)
    return list(found.values())


def _pairs(
    given: AnyScene, symbols: SceneSymbols
) -> Iterator[tuple[str, float, np.ndarray, np.ndarray, np.ndarray | float]]:
    """Yields (what has the step, the step, values given, values dequantised, 2^(step class) of each)."""
    first = symbols.base_rows
    for part in symbols.layers:
        for at in row_blocks(len(part.codes)):
            own, classes = slice(first + at.start, first + at.stop), part.classes[at]
            spacing = 2.0 ** classes[:, None] if classes.size else 1.0
            restored = zip(part.table.tensors, part.table.dequantise(part.rows[:, at]), strict=True)
            for (name, x), (tensor, y) in zip(given.attributes.items(), restored, strict=True):
                yield name, tensor.step, x[own].reshape(y.shape), y, spacing
        first += len(part.codes)
        layer, tensors = part.layer, kinds.tensors_of(given, part.layer)
        if symbols.base and not layer:
            continue  # its tensors are those of the base
        names = step_names(layer) if isinstance(given, Scene) else (kinds.layer_name(given, layer),)
        fields = [names[0]] * len(tensors.planes) + [names[-1]] * len(tensors.weights)
        for what, step, x, k in zip(fields, tensors.tables.steps, tensors.arrays, part.tensors.arrays, strict=True):
            yield what, step, x, dequantise(k, step), 1.0
