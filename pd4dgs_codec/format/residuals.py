"""HexPlane and residual networks evaluated in numpy, in float32: how far a deformation moves a scene.

The encoder decides by it which heads to leave out. It is the function of the trained model; it is not normative.
"""

from __future__ import annotations

import numpy as np

from pd4dgs_codec.scene import (
    LENGTH_HEADS,
    PLANES,
    TRUNK,
    Deformation,
    Network,
    Planes,
    deformation_unit,
    plane_sides,
)


def sample_planes(planes: Planes, box: np.ndarray, points: np.ndarray, t: float) -> np.ndarray:
    """float32 [n, sum of C]: bilinear samples, multiplied over a scale's six planes, concatenated over scales.

    points: float32 [n, 3], scene units; box float32 [2, 3] maps to the planes' corners (align corners), clamped at the
    border; t in 0..1 to the first and last time row.
    """
    extent = np.maximum(box[1] - box[0], np.finfo(np.float32).tiny)
    unit = np.empty((len(points), 4), dtype=np.float32)
    unit[:, :3] = np.clip((points - box[0]) / extent, 0.0, 1.0)
    unit[:, 3] = np.clip(t, 0.0, 1.0)
    features = []
    for scale in planes:
        position = unit * (np.array(plane_sides(scale), dtype=np.float32) - 1)
        product: np.ndarray | float = 1.0
        for name, a, b in PLANES:
            product = product * bilinear(scale[name], position[:, a], position[:, b])
        features.append(product)
    return np.concatenate(features, axis=1) if features else np.zeros((len(points), 0), np.float32)


def bilinear(plane: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """[n, C] samples of plane [C, H, W] at column u in 0..W-1 and row v in 0..H-1."""
    _, h, w = plane.shape
    rows_last = np.ascontiguousarray(plane.transpose(1, 2, 0))
    j, i = np.minimum(u.astype(np.intp), max(w - 2, 0)), np.minimum(v.astype(np.intp), max(h - 2, 0))
    j1, i1 = np.minimum(j + 1, w - 1), np.minimum(i + 1, h - 1)
    fu, fv = (u - j)[:, None], (v - i)[:, None]
    top = rows_last[i, j] * (1 - fu) + rows_last[i, j1] * fu
    bottom = rows_last[i1, j] * (1 - fu) + rows_last[i1, j1] * fu
    samples: np.ndarray = top * (1 - fv) + bottom * fv
    return samples


def run_network(network: Network, x: np.ndarray) -> np.ndarray:
    """float32 [n, out] of x [n, in]: linear layers with ReLU between them."""
    for i, (weight, bias) in enumerate(network):
        x = (np.maximum(x, 0) if i else x) @ weight.T + bias
    return x


def residuals(deformation: Deformation, box: np.ndarray, points: np.ndarray, t: float) -> dict[str, np.ndarray]:
    """head -> float32 [n, width] residuals at `points` [n, 3] (scene units) and normalised time t; lengths in scene
    units."""
    features = sample_planes(deformation.planes, box, points, t)
    hidden = np.maximum(run_network(deformation.networks[TRUNK], features), 0)
    outputs = {name: run_network(network, hidden) for name, network in deformation.networks.items() if name != TRUNK}
    unit = deformation_unit(box)
    return {name: out * unit if name in LENGTH_HEADS else out for name, out in outputs.items()}
