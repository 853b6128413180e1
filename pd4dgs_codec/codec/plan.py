"""What a file of this scene needs: which anchors, in which layer and order, which deformations and which heads.

Layer l carries the anchors that become active at level l. Anchors inactive at the highest level kept are dropped. When
a layer goes because its deformation is left out, its anchors and masks pass to the highest layer kept, so that the
highest level's picture stays what it was, within the bounds below.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pd4dgs_codec.codec.kinds import LAYER_KINDS, LayerKind
from pd4dgs_codec.codec.omissions import LeftOut, leave_out
from pd4dgs_codec.codec.symbols import dequantise_deformation, first_duplicate, quantise_deformation
from pd4dgs_codec.entropy.morton import morton_order
from pd4dgs_codec.errors import EncodeError
from pd4dgs_codec.evaluate.residuals import residuals
from pd4dgs_codec.scene import TRUNK, Deformation, Scene

#: A deformation is left out if it moves no position (or local scale) by more than this many voxels ...
NEGLIGIBLE_VOXELS = 1e-3
#: ... no anchor attribute by half its quantisation step or more, no colour or opacity by half an 8-bit step ...
NEGLIGIBLE_STEPS = 0.5
NEGLIGIBLE_COLOR = 0.5 / 255
#: ... and no quaternion component (before normalisation) by more than this.
NEGLIGIBLE_QUAT = 1e-3

#: What `plan` leaves out: all it may, what changes no picture, or no more than it must.
OMIT = ("bounded", "lossless", "nothing")

#: A quick look that usually finds a head at work, and the most samples (points x times) before one is left out.
QUICK_SAMPLES = 1 << 12
FULL_SAMPLES = 1 << 18
MIN_TIMES = 17


def plan(
    scene: Scene, layers: str | int = "auto", raw_deformation: bool = False, omit: str = "bounded"
) -> tuple[Scene, list[LeftOut]]:
    """(the scene that the file will hold, what it leaves out). Rows come out sorted by (layer, Morton order).

    layers "auto" leaves out every head that is zero after quantisation or below the bounds, then every layer without
    one; 0, 1 or 2 keeps the layers up to that number and only drops heads that are exactly zero.
    omit, one of OMIT: "bounded" leaves out what the bounds allow and what changes no picture, "lossless" only the
    latter, "nothing" only heads that are exactly zero and anchors below the mask threshold.
    """
    left_out: list[LeftOut] = []
    scene = replace(scene, steps=scene.steps.scaled(1.0))  # binary32, as the file will hold them
    if layers != "auto":
        scene, left_out = _cut(scene, int(layers))
    kept = [0]
    for layer in scene.layers[1:]:
        kind = LAYER_KINDS[layer]
        scene, dropped = _drop_heads(scene, kind, layers == "auto" and omit == "bounded", raw_deformation)
        left_out += dropped
        if layers != "auto" or getattr(scene, kind.deformation or "") is not None:
            kept.append(layer)
    arranged, inactive = _arrange(scene, tuple(kept))
    if inactive:
        why = f"mask at or below the threshold at level {scene.level}"
        left_out.append(LeftOut(f"{inactive} anchors", why, anchors=inactive))
    if omit != "nothing":
        arranged, lossless = leave_out(arranged, raw_deformation)
        left_out += lossless
    return arranged, left_out


def _cut(scene: Scene, highest: int) -> tuple[Scene, list[LeftOut]]:
    """The layers <= highest as they are, and a note for each one above."""
    left_out = []
    for layer in scene.layers:
        kind = LAYER_KINDS[layer]
        if layer > highest:
            tensors = getattr(scene, kind.deformation or "")
            left_out.append(LeftOut(f"layer {layer}", f"layers up to {highest} were asked for", kind, tensors))
    codes = full_masks(scene)
    kept = sum(layer <= highest for layer in scene.layers)
    n = scene.rows[-1]
    cut = replace(scene.prefix(highest), anchor_q=scene.anchor_q, feature=scene.feature)
    cut = replace(cut, scaling_log=scene.scaling_log, offset=scene.offset, rows=(n,) * kept, mask=tuple(codes[:kept]))
    return cut, left_out


def _drop_heads(scene: Scene, kind: LayerKind, judge: bool, raw: bool) -> tuple[Scene, list[LeftOut]]:
    """`scene` without the heads of kind's deformation that do nothing, or without the deformation if none is left."""
    assert kind.deformation is not None
    given: Deformation | None = getattr(scene, kind.deformation)
    if given is None:
        return scene, []
    decoded = given
    if not raw:
        decoded = dequantise_deformation(quantise_deformation(given, kind, scene.steps), kind, scene.steps)
    heads = {name: network for name, network in decoded.networks.items() if name != TRUNK}
    why = {name: "zero after quantisation" for name, network in heads.items() if not any(a.any() for a in network[-1])}
    if judge:
        alive = Deformation(decoded.planes, {k: v for k, v in decoded.networks.items() if k not in why})
        why |= _negligible(scene, kind, alive)
    if not why and heads:
        return scene, []
    if len(why) == len(heads):
        reason = "; ".join(f"{name}: {text}" for name, text in why.items()) or "it has no heads"
        return _with_deformation(scene, kind, None), [LeftOut(f"{kind.deformation}", reason, kind, given)]
    rest = Deformation(given.planes, {k: v for k, v in given.networks.items() if k not in why})
    gone = [
        LeftOut(f"{kind.deformation} head {name}", text, kind, Deformation((), {name: given.networks[name]}))
        for name, text in why.items()
    ]
    return _with_deformation(scene, kind, rest), gone


def _with_deformation(scene: Scene, kind: LayerKind, deformation: Deformation | None) -> Scene:
    if kind.layer == 1:
        return replace(scene, global_deformation=deformation)
    return replace(scene, local_deformation=deformation)


def head_bounds(scene: Scene, kind: LayerKind) -> dict[str, float]:
    """Per head of kind's deformation, the largest residual that counts as nothing, in that head's unit."""
    voxel, steps = NEGLIGIBLE_VOXELS * scene.info.voxel_size, scene.steps
    if kind.layer == 1:
        attribute = {"feature": steps.feature, "offset": steps.offset, "scaling": steps.scaling_log}
        return {"position": voxel, **{name: NEGLIGIBLE_STEPS * step for name, step in attribute.items()}}
    return {
        "mean": voxel,
        "scale": voxel,
        "quat": NEGLIGIBLE_QUAT,
        "opacity": NEGLIGIBLE_COLOR,
        "color": NEGLIGIBLE_COLOR,
    }


def _negligible(scene: Scene, kind: LayerKind, deformation: Deformation) -> dict[str, str]:
    """Heads whose residuals stay within head_bounds wherever sampled, each with the reason in words."""
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
    """Per head the largest |residual| (NaN counts as infinite) over times and evenly chosen anchors or Gaussians."""
    per_time = max(1, samples // n_times)
    rows = np.flatnonzero(full_masks(scene)[-1] > 0)
    rows = rows[:: max(1, -(-rows.size // per_time))]
    largest = {name: 0.0 for name in deformation.networks if name != TRUNK}
    for t in np.linspace(0.0, 1.0, n_times):
        points = _deformed_means(scene, rows, t, per_time) if kind.layer == 2 else scene.anchor[rows]
        with np.errstate(all="ignore"):
            found = residuals(deformation, scene.info.box, points, float(t)) if len(points) else {}
        for name, value in found.items():
            top = float(np.abs(value).max())
            largest[name] = max(largest[name], top if top == top else np.inf)
    return largest


def _deformed_means(scene: Scene, rows: np.ndarray, t: float, most: int) -> np.ndarray:
    """float32 [n, 3] Gaussian means after the global deformation at t: where the local one is sampled. n <= `most`."""
    rows = rows[:: max(1, -(-rows.size * scene.offset.shape[1] // max(most, 1)))]
    anchor, offset, scaling = scene.anchor[rows], scene.offset[rows], scene.scaling_log[rows]
    if scene.global_deformation is not None and len(rows):
        moved = residuals(scene.global_deformation, scene.info.box, anchor, float(t))
        anchor = anchor + moved.get("position", 0)
        scaling = scaling + moved.get("scaling", 0)
        offset = offset + (moved["offset"].reshape(offset.shape) if "offset" in moved else 0)
    with np.errstate(over="ignore"):
        means = anchor[:, None] + offset * np.exp(scaling[:, None, :3])
    return np.nan_to_num(means.reshape(-1, 3), posinf=0.0, neginf=0.0)


def full_masks(scene: Scene) -> list[np.ndarray]:
    """uint8 [N] codes per layer present: an anchor that a layer's prefix does not hold is inactive there."""
    return [np.concatenate([codes, np.zeros(scene.rows[-1] - codes.size, np.uint8)]) for codes in scene.mask]


def _arrange(scene: Scene, kept: tuple[int, ...]) -> tuple[Scene, int]:
    """(scene with rows sorted by (layer, Morton) and the layers `kept`, number of anchors dropped)."""
    codes = full_masks(scene)
    by_layer = dict(zip(scene.layers, codes, strict=True))
    masks = np.stack([*(by_layer[layer] for layer in kept[:-1]), codes[-1]])
    first = np.where(masks[-1] > 0, (masks > 0).argmax(axis=0), len(kept))
    groups = [np.flatnonzero(first == i) for i in range(len(kept))]
    order = np.concatenate([group[morton_order(scene.anchor_q[group])] if group.size else group for group in groups])
    rows = tuple(int(n) for n in np.cumsum([group.size for group in groups]))
    _refuse_duplicates(scene.anchor_q[order])
    arranged = replace(
        scene,
        layers=kept,
        rows=rows,
        anchor_q=np.ascontiguousarray(scene.anchor_q[order]),
        feature=scene.feature[order],
        scaling_log=scene.scaling_log[order],
        offset=scene.offset[order],
        mask=tuple(m[order][:n] for m, n in zip(masks, rows, strict=True)),
    )
    return arranged, scene.rows[-1] - order.size


def _refuse_duplicates(anchor_q: np.ndarray) -> None:
    row = first_duplicate(anchor_q)
    if row is not None:
        raise EncodeError(f"anchor_q: voxel {row.tolist()} holds more than one anchor, expected one")
