"""Encoder: residual heads without visible effect."""

from __future__ import annotations

import numpy as np

from pd4dgs_codec.format.deformation import dequantise_tensors, quantise_tensors
from pd4dgs_codec.format.kinds import LayerKind
from pd4dgs_codec.format.left_out import LeftOut
from pd4dgs_codec.format.residuals import residuals
from pd4dgs_codec.scene import HEADS, TRUNK, Deformation, Scene

#: A head is left out if it moves no position (or local scale) by more than this many voxels ...
NEGLIGIBLE_VOXELS = 1e-3
#: ... no anchor attribute by half its quantisation step or more, no colour or opacity by half an 8-bit step ...
NEGLIGIBLE_STEPS = 0.5
NEGLIGIBLE_COLOR = 0.5 / 255
#: ... and no quaternion component (before normalisation) by more than this.
NEGLIGIBLE_QUAT = 1e-3

#: Samples (points x times) of a first look, which usually finds a head at work, and of the look before one is left out.
QUICK_SAMPLES = 1 << 12
FULL_SAMPLES = 1 << 18
MIN_TIMES = 17


def drop_heads(scene: Scene, kind: LayerKind, bounded: bool) -> tuple[Scene, list[LeftOut]]:
    """(`scene` without the heads of a layer that have no effect, or without its deformation if none is left; the heads
    left out). bounded: also leave out heads within head_bounds, not only those that are exactly zero."""
    given = scene.deformation(kind.layer)
    if given is None:
        return scene, []
    decoded = dequantise_tensors(quantise_tensors(given, kind, scene.steps), kind, scene.steps)
    heads = {name: network for name, network in decoded.networks.items() if name != TRUNK}
    why = {name: "zero after quantisation" for name, network in heads.items() if not any(a.any() for a in network[-1])}
    if bounded:
        alive = Deformation(decoded.planes, {k: v for k, v in decoded.networks.items() if k not in why})
        why |= _negligible(scene, kind, alive)
    if not why and heads:
        return scene, []
    if len(why) == len(heads):
        reason = "; ".join(f"{name}: {text}" for name, text in why.items()) or "it has no heads"
        return scene.with_tensors(kind.layer, None), [LeftOut(kind.name, reason, kind, given)]
    rest = Deformation(given.planes, {k: v for k, v in given.networks.items() if k not in why})
    gone = [
        LeftOut(f"{kind.name} head {name}", text, kind, Deformation((), {name: given.networks[name]}))
        for name, text in why.items()
    ]
    return scene.with_tensors(kind.layer, rest), gone


def head_bounds(scene: Scene, kind: LayerKind) -> dict[str, float]:
    """By head of a layer, the largest negligible residual, in the head's unit; lengths in scene units."""
    of_unit = {
        "length": NEGLIGIBLE_VOXELS * scene.info.voxel_size,
        **{name: NEGLIGIBLE_STEPS * step for name, step in scene.steps.attributes.items()},
        "quaternion": NEGLIGIBLE_QUAT,
        "color": NEGLIGIBLE_COLOR,
    }
    return {name: of_unit[head.unit] for name, head in HEADS[kind.layer].items()}


def _negligible(scene: Scene, kind: LayerKind, deformation: Deformation) -> dict[str, str]:
    """The heads whose residuals stay within head_bounds at all samples, each with the reason."""
    times = max([MIN_TIMES, *(s["zt"].shape[1] for s in deformation.planes)])
    bounds = head_bounds(scene, kind)
    largest: dict[str, float] = {}
    for n_times, samples in ((MIN_TIMES, QUICK_SAMPLES), (times, FULL_SAMPLES)):
        candidates = {k: v for k, v in deformation.networks.items() if k == TRUNK or largest.get(k, 0.0) <= bounds[k]}
        deformation = Deformation(deformation.planes, candidates)
        if len(candidates) == 1:
            return {}
        largest = _largest_residuals(scene, kind, deformation, n_times, samples)
    return {
        name: f"largest residual {value:.3g}, negligible up to {bounds[name]:.3g}"
        for name, value in largest.items()
        if value <= bounds[name]
    }


def _largest_residuals(
    scene: Scene, kind: LayerKind, deformation: Deformation, n_times: int, samples: int
) -> dict[str, float]:
    """By head, the largest |residual| (NaN counts as infinite) over times and evenly chosen anchors or Gaussians."""
    per_time = max(1, samples // n_times)
    rows = np.flatnonzero(scene.full_masks()[-1] > 0)
    rows = rows[:: max(1, -(-rows.size // per_time))]
    largest = {name: 0.0 for name in deformation.networks if name != TRUNK}
    for t in np.linspace(0.0, 1.0, n_times):
        points = _deformed_means(scene, rows, t, per_time) if kind.layer == 2 else scene.anchor_at(rows)
        with np.errstate(all="ignore"):
            found = residuals(deformation, scene.info.box, points, float(t)) if len(points) else {}
        for name, value in found.items():
            top = float(np.abs(value).max())
            largest[name] = max(largest[name], top if top == top else np.inf)
    return largest


def _deformed_means(scene: Scene, rows: np.ndarray, t: float, most: int) -> np.ndarray:
    """float32 [n, 3], n <= `most`: means of Gaussians after the global deformation at t, where the local deformation is
    sampled."""
    rows = rows[:: max(1, -(-rows.size * scene.offset.shape[1] // max(most, 1)))]
    anchor, offset, scaling = scene.anchor_at(rows), scene.offset[rows], scene.scaling_log[rows]
    if scene.global_deformation is not None and len(rows):
        moved = residuals(scene.global_deformation, scene.info.box, anchor, float(t))
        anchor = anchor + moved.get("position", 0)
        scaling = scaling + moved.get("scaling", 0)
        offset = offset + (moved["offset"].reshape(offset.shape) if "offset" in moved else 0)
    with np.errstate(over="ignore"):
        means = anchor[:, None] + offset * np.exp(scaling[:, None, :3])
    finite: np.ndarray = np.nan_to_num(means.reshape(-1, 3), posinf=0.0, neginf=0.0)
    return finite
