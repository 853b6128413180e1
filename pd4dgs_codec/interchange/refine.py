"""Explicit Gaussians fitted to pictures by gradient descent, with our rasteriser and numpy alone.

A baked scene's opacities are means over the eyes, so that no eye sees what the scene itself would show it. Some steps
of Adam (Kingma and Ba 2015) on the squared error of pictures get most of that back.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pd4dgs_codec.draw.rasteriser import Geometry, backward, composite, project
from pd4dgs_codec.interchange.splats import Splats, camera_eye, harmonics, unit
from pd4dgs_codec.scene import Camera

#: Steps of Adam per parameter, at the start; they end at LAST of that. Positions: in shares of a Gaussian's size.
RATES = {"means": 0.02, "quats": 0.01, "log_scales": 0.02, "logits": 0.05, "sh": 0.01}
LAST = 0.1
#: Harmonics but the constant learn slower, as in 3D Gaussian splatting.
REST = 0.2
BETAS, EPSILON = (0.9, 0.99), 1e-15
SMALLEST = np.float32(1e-9)  #: scene units
FAINTEST, STRONGEST = 1e-3, 1 - 1e-4  #: opacities whose logits are taken


@dataclass(frozen=True, eq=False)
class Target:
    """A picture to match: float32 [H, W, 3]."""

    camera: Camera
    image: np.ndarray


def refine(
    splats: Splats,
    targets: Mapping[int, Target],
    order: Sequence[int],
    background: tuple[float, float, float],
    near: float,
    step: Callable[[], None] = lambda: None,
) -> Splats:
    """The Gaussians after one step on each of the targets that `order` names, in that order."""
    size = np.maximum(splats.scales.max(axis=1, keepdims=True), SMALLEST)
    values = {
        "means": splats.means / size,
        "quats": splats.quats.copy(),
        "log_scales": np.log(np.maximum(splats.scales, SMALLEST)),
        "logits": logits(splats.opacities),
        "sh": splats.sh.copy(),
    }
    moments = {name: (np.zeros_like(value), np.zeros_like(value)) for name, value in values.items()}
    behind = np.array(background, np.float32)
    for i, which in enumerate(order):
        target = targets[which]
        gradients = _gradients(values, size, target, behind, near)
        rate = LAST ** (i / max(len(order) - 1, 1))
        for name, gradient in gradients.items():
            first, second = moments[name]
            first += (1 - BETAS[0]) * (gradient - first)
            second += (1 - BETAS[1]) * (gradient * gradient - second)
            corrected = np.sqrt(second / np.float32(1 - BETAS[1] ** (i + 1))) + np.float32(EPSILON)
            change = np.float32(rate * RATES[name] / (1 - BETAS[0] ** (i + 1))) * first / corrected
            if name == "sh":
                change[:, 1:] *= np.float32(REST)
            values[name] -= change
        step()
    return _splats(values, size)


def logits(opacities: np.ndarray) -> np.ndarray:
    """float32 [N] of opacities [N], no nearer to 0 and 1 than can be learnt away from."""
    p = np.clip(opacities, FAINTEST, STRONGEST).astype(np.float32)
    result: np.ndarray = np.log(p / (1 - p))
    return result


def _splats(values: dict[str, np.ndarray], size: np.ndarray) -> Splats:
    return Splats(
        np.ascontiguousarray(values["means"] * size),
        unit(values["quats"]),
        np.exp(values["log_scales"]),
        1 / (1 + np.exp(-values["logits"])),
        values["sh"],
    )


def _gradients(
    values: dict[str, np.ndarray], size: np.ndarray, target: Target, behind: np.ndarray, near: float
) -> dict[str, np.ndarray]:
    """Of the mean squared error of one picture, by each of the values."""
    splats = _splats(values, size)
    basis = harmonics(unit(splats.means - camera_eye(target.camera).astype(np.float32)), splats.degree)
    raw = np.einsum("nj,njc->nc", basis, splats.sh) + np.float32(0.5)
    colors = np.maximum(raw, 0)
    geometry = Geometry(splats.means, splats.quats, splats.scales, splats.opacities)
    projected = project(geometry, target.camera, near)
    picture, transmittance = composite(projected, colors, behind)
    slope = (2 / picture.size) * (picture - target.image)
    g = backward(projected, geometry, colors, picture, transmittance, slope, np.zeros_like(transmittance))
    g_colors = g.colors * (raw > 0)
    g_quats = g.geometry.quats
    return {
        "means": g.geometry.means * size,
        "quats": g_quats - splats.quats * np.einsum("nd,nd->n", g_quats, splats.quats)[:, None],
        "log_scales": g.geometry.scales * splats.scales,
        "logits": g.geometry.opacities * splats.opacities * (1 - splats.opacities),
        "sh": basis[:, :, None] * g_colors[:, None, :],
    }
