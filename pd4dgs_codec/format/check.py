"""Checks of a Scene before it is encoded: shapes, dtypes, finiteness, row counts."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from pd4dgs_codec.errors import EncodeError
from pd4dgs_codec.format.kinds import LAYER_KINDS, LayerKind
from pd4dgs_codec.format.quantise import all_finite, is_step, magnitude
from pd4dgs_codec.morton import MAX_VOXEL
from pd4dgs_codec.scene import (
    MASK_MIN_CODE,
    MAX_CLASS,
    MAX_FEATURE,
    MAX_SLOTS,
    PLANES,
    TRUNK,
    Deformation,
    Network,
    Scene,
    SceneInfo,
    Widths,
    plane_sides,
)


def _expect(ok: bool, message: str) -> None:
    if not ok:
        raise EncodeError(message)


def _expect_array(name: str, a: np.ndarray, dtype: type, shape: tuple[int | None, ...]) -> None:
    matches = len(a.shape) == len(shape) and all(e is None or e == f for e, f in zip(shape, a.shape, strict=True))
    _expect(a.dtype == dtype and matches, f"{name}: {a.dtype} {a.shape}, expected {np.dtype(dtype)} {shape}")
    if a.dtype.kind == "f":
        _expect(bool(np.isfinite(a).all()), f"{name}: a value is NaN or infinite")


def check_scene(scene: Scene) -> None:
    """Raise EncodeError unless `scene` has the shapes, dtypes and ranges that scene.Scene documents."""
    layers, rows = scene.layers, scene.rows
    _expect(layers[:1] == (0,) and set(layers) <= {0, 1, 2}, f"layers {layers}, expected 0 first and none but 0, 1, 2")
    _expect(all(a < b for a, b in pairwise(layers)), f"layers {layers}, expected ascending numbers")
    _expect(len(rows) == len(layers) == len(scene.mask), "rows, mask and layers differ in length")
    _expect(all(a <= b for a, b in pairwise((0, *rows))), f"rows {rows}, expected a non-decreasing sequence")
    n = rows[-1]
    _expect_array("anchor_q", scene.anchor_q, np.int32, (n, 3))
    reach = magnitude(scene.anchor_q)
    _expect(reach <= MAX_VOXEL, f"anchor_q: voxel index of magnitude {reach}, expected at most {MAX_VOXEL}")
    size = scene.info.voxel_size
    finite = not is_step(size) or all_finite(scene.anchor_q, size)
    _expect(finite, f"anchor_q: a position is infinite at voxel size {size:g}, expected finite ones")
    for name, axes in (("feature", 2), ("offset", 3)):
        found = scene.attributes[name].shape
        _expect(len(found) == axes, f"{name}: an array of {len(found)} axes, expected {axes}")
    widths = scene.widths
    for what, width, limit in (("feature width", widths.feature, MAX_FEATURE), ("slots", widths.slots, MAX_SLOTS)):
        _expect(1 <= width <= limit, f"{what}: {width}, expected 1..{limit}")
    for name, shape in widths.attributes.items():
        _expect_array(name, scene.attributes[name], np.float32, (n, *shape))
    if scene.grading is not None:
        _expect_array("step classes", scene.grading.classes, np.uint8, (n,))
        largest = int(scene.grading.classes.max(initial=0))
        _expect(largest <= MAX_CLASS, f"step classes: {largest}, expected at most {MAX_CLASS}")
        _expect_array("centre of the attributes", scene.grading.centre, np.float32, (widths.channels,))
    _check_masks(scene)
    _check_info(scene)
    for name, step in vars(scene.steps).items():
        _expect(is_step(step), f"step of {name}: {step!r}, expected a positive normal binary32 value")
    _check_networks(LAYER_KINDS[0].name, scene.networks, LAYER_KINDS[0], widths, widths.inputs)
    missing = set(widths.networks) - set(scene.networks)
    _expect(not missing, f"scaffold networks {sorted(missing)} are missing")
    for kind in LAYER_KINDS[1:]:
        deformation = scene.deformation(kind.layer)
        if deformation is not None:
            _expect(kind.layer in layers, f"{kind.name} is given, but layer {kind.layer} is not among {layers}")
            _check_deformation(deformation, kind, widths)


def _check_masks(scene: Scene) -> None:
    for layer, rows, codes in zip(scene.layers, scene.rows, scene.mask, strict=True):
        _expect_array(f"mask of layer {layer}", codes, np.uint8, (rows,))
        odd = (codes > 0) & (codes < MASK_MIN_CODE)
        _expect(not odd.any(), f"mask of layer {layer}: a code in 1..{MASK_MIN_CODE - 1}, expected 0 or more")
    for (low, high), layer in zip(pairwise(scene.mask), scene.layers[1:], strict=True):
        _expect(bool((high[: low.size] >= low).all()), f"mask of layer {layer} falls below that of the layer before")


def _check_info(scene: Scene) -> None:
    info = scene.info
    _expect(is_step(info.voxel_size), f"voxel_size {info.voxel_size!r}, expected a positive normal binary32 value")
    _expect_array("box", info.box, np.float32, (2, 3))
    _expect(bool((info.box[0] <= info.box[1]).all()), "box: a lower corner above the upper one")
    reals = [*info.time_range, *info.background, info.near, info.far, *info.up, info.unit]
    with np.errstate(over="ignore"):
        _expect(bool(np.isfinite(np.array(reals, np.float32)).all()), "info: a value is NaN, infinite or over binary32")
    if info.camera is not None:
        _expect_array("camera.viewmat", info.camera.viewmat, np.float32, (4, 4))
        _expect_array("camera.K", info.camera.K, np.float32, (3, 3))
        sizes = (info.camera.width, info.camera.height)
        _expect(all(1 <= s <= 65535 for s in sizes), f"camera of {sizes} pixels, expected 1..65535 each")
        _expect(bool((info.camera.viewmat[3] == (0, 0, 0, 1)).all()), "camera.viewmat: last row is not 0 0 0 1")
        form = info.camera.K * ((0, 1, 0), (1, 0, 0), (1, 1, 1))
        _expect(bool((form == ((0, 0, 0), (0, 0, 0), (0, 0, 1))).all()), "camera.K: expected fx 0 cx, 0 fy cy, 0 0 1")
    fault = info_fault(info)
    _expect(fault is None, str(fault))


def info_fault(info: SceneInfo) -> str | None:
    """The first rule that finite header values break, or None; for the encoder and the decoder."""
    start, end = info.time_range
    rules = [
        (start <= end, f"time range {start}..{end}, expected it to ascend"),
        (all(0 <= c <= 1 for c in info.background), f"background {info.background}, expected 0..1"),
        (0 <= info.near < info.far, f"near {info.near} and far {info.far}, expected 0 <= near < far"),
        (info.unit >= 0, f"unit {info.unit}, expected 0 or more"),
    ]
    if info.camera is not None:
        fx, fy = float(info.camera.K[0, 0]), float(info.camera.K[1, 1])
        rules.append((fx > 0 and fy > 0, f"camera with focal lengths {fx} and {fy}, expected both positive"))
    return next((fault for holds, fault in rules if not holds), None)


def _check_deformation(deformation: Deformation, kind: LayerKind, widths: Widths) -> None:
    name, width = kind.name, 0
    _expect(len(deformation.planes) > 0, f"{name}: no planes, expected at least one scale")
    for s, planes in enumerate(deformation.planes):
        _expect(set(planes) == {p for p, _, _ in PLANES}, f"{name} scale {s}: planes {sorted(planes)}, expected six")
        channels, side = planes["xy"].shape[0], plane_sides(planes)
        first = deformation.planes[0]["xy"].shape[0]
        _expect(channels == first, f"{name} scale {s}: {channels} channels, expected {first} as in scale 0")
        _expect(min(channels, *side) >= 1, f"{name} scale {s}: an empty plane")
        for p, a, b in PLANES:
            _expect_array(f"{name} scale {s} plane {p}", planes[p], np.float32, (channels, side[b], side[a]))
        width += channels
    _expect(TRUNK in deformation.networks, f"{name}: the network 'trunk' is missing")
    trunk_out = deformation.networks[TRUNK][-1][0].shape[0]
    for network, layers in deformation.networks.items():
        _check_networks(name, {network: layers}, kind, widths, width if network == TRUNK else trunk_out)


def _check_networks(owner: str, networks: dict[str, Network], kind: LayerKind, widths: Widths, width_in: int) -> None:
    for name, network in networks.items():
        _expect(name in kind.network_ids, f"{owner}: network {name!r}, expected one of {list(kind.network_ids)}")
        _expect(len(network) > 0, f"{owner} network {name}: no layers")
        width = width_in
        for i, (weight, bias) in enumerate(network):
            _expect_array(f"{owner} network {name} weight {i}", weight, np.float32, (None, width))
            width = weight.shape[0]
            _expect_array(f"{owner} network {name} bias {i}", bias, np.float32, (width,))
        out = kind.heads(widths).get(name, width)
        _expect(width == out, f"{owner} network {name}: {width} outputs, expected {out}")
