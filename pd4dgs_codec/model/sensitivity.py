"""How pictures depend on single anchors: the errors of omitting one or rounding its attributes, and a ranking.

These measures decide which anchors leave a layer or a model, their step classes, the channels of their features, and
their order in slices.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from pd4dgs_codec.format.plan import layer_symbols
from pd4dgs_codec.model.model import Gaussians, Model, from_scene
from pd4dgs_codec.model.networks import EXACT, Rounding
from pd4dgs_codec.model.picture import draw, render_image
from pd4dgs_codec.scene import ATTRIBUTES, Camera, Scene, Viewpoint

#: Share of the mean error that every direction has at least, so that invisible directions are scaled within bounds.
LEAST_ERROR = 0.01

#: Random pictures of signs per view for each estimate: other views say more than a second one.
PROBES = 1


def omission_error(
    model: Model,
    level: int,
    t: float,
    camera: Camera,
    generator: torch.Generator,
    *,
    weights: Tensor | None = None,
    rounding: Rounding = EXACT,
) -> tuple[Tensor, Tensor, Tensor]:
    """Estimates the squared error, summed over pixels and colours, of omitting each anchor at `level`.

    Arguments as for `render`; weights [H, W] multiply the pixels' squared errors. Returns the errors, float64 [N];
    bool [N], whether each anchor may reach the picture; and the picture [H, W, 3]. The error is ||dI/dg||^2, g a gate
    on the anchor's opacities and scales that goes from 1 to 0: the diagonal of the Gauss-Newton matrix, from products
    with random signs (Bekas, Kokiopoulou and Saad, An estimator for the diagonal of a matrix, 2007).
    """
    image, gate, met = _gated(model, level, t, camera, rounding)
    return _squared(image, gate, generator, weights), met, image.detach()


def anchor_slopes(
    model: Model, level: int, t: float, camera: Camera, generator: torch.Generator, reference: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Returns, for each anchor, <I - J, dI/dg>, float64 [N], with I the picture and J the reference [H, W, 3];
    ||dI/dg||^2, float64 [N], as in `omission_error`; and bool [N], whether it may reach the picture."""
    image, gate, met = _gated(model, level, t, camera, EXACT)
    (slope,) = torch.autograd.grad((image * (image.detach() - reference)).sum(), gate, retain_graph=True)
    return slope.double(), _squared(image, gate, generator), met


def _gated(model: Model, level: int, t: float, camera: Camera, rounding: Rounding) -> tuple[Tensor, Tensor, Tensor]:
    """Returns the picture [H, W, 3], the anchors' gates [N], all 1, and bool [N], whether each anchor may reach it."""
    with torch.no_grad():
        g = model.gaussians(level, t, camera, rounding)
    gate = torch.ones(len(model.anchor_q), device=g.means.device, requires_grad=True)
    shown = gate[torch.div(g.slots, model.widths.slots, rounding_mode="floor")]
    gated = replace(g, scales=g.scales * shown[:, None], opacities=g.opacities * shown)
    return draw(model.shown(level), gated, camera).image, gate, _met(model, g)


def _met(model: Model, gaussians: Gaussians) -> Tensor:
    """Returns bool [N]: whether each anchor was evaluated for these Gaussians, so that it may reach their picture."""
    met = torch.zeros(len(model.anchor_q), dtype=torch.bool, device=gaussians.means.device)
    met[gaussians.anchors] = True
    return met


def _squared(image: Tensor, gate: Tensor, generator: torch.Generator, weights: Tensor | None = None) -> Tensor:
    """Estimates the squared norm of the picture's derivative by each gate, float64 [N]."""
    total = torch.zeros(len(gate), dtype=torch.float64, device=gate.device)
    for _ in range(PROBES):
        signs = _signs(image, generator, weights)
        (slope,) = torch.autograd.grad((image * signs).sum(), gate, retain_graph=True)
        total += slope.double().square() / PROBES
    return total


def attribute_slopes(
    model: Model,
    level: int,
    t: float,
    camera: Camera,
    generator: torch.Generator,
    *,
    weights: Tensor | None = None,
    rounding: Rounding = EXACT,
) -> tuple[dict[str, Tensor], Tensor, Tensor]:
    """Returns the derivatives of the picture's product with random signs by each attribute, in its shape; bool [N],
    whether each anchor may reach the picture; and the picture [H, W, 3]. Arguments as for `omission_error`.

    Averaged over the signs, the products of derivatives by two scalars of an anchor are its Gauss-Newton matrix.
    """
    values = [getattr(model, name) for name in ATTRIBUTES]
    with torch.enable_grad():
        g = model.gaussians(level, t, camera, rounding)
        image = draw(model.shown(level), g, camera).image
        slopes = [torch.zeros_like(value) for value in values]
        if len(g.scales):
            slopes = list(torch.autograd.grad((image * _signs(image, generator, weights)).sum(), values))
    return dict(zip(ATTRIBUTES, slopes, strict=True)), _met(model, g), image.detach()


def _signs(image: Tensor, generator: torch.Generator, weights: Tensor | None) -> Tensor:
    """Random signs [H, W, 3] times the roots of the pixels' weights [H, W]."""
    signs = (torch.randint(0, 2, image.shape, generator=generator).float() * 2 - 1).to(image.device)
    return signs if weights is None else signs * weights.sqrt()[:, :, None]


# -- the order of anchors ----------------------------------------------------------------------------------------------

#: Longer side, pixels, of the pictures that `utility` compares: holes are larger than such a pixel.
SIDE = 128
#: The share of a layer's anchors that stay after each round, and the count at which all leave in one round.
STAY, FEW = 0.8, 64


def utility(
    scene: Scene, viewpoints: Sequence[Viewpoint], step: Callable[[], None] = lambda: None, fewest: int = 0
) -> np.ndarray:
    """Ranks the n anchors of the highest layer by the gain per byte of the pictures at `viewpoints` (times 0..1), with
    all earlier layers present. Returns float64 [n], higher for anchors that should come earlier, 0 for anchors that
    reach no picture. step is called after each round.

    Backward elimination: the anchors of least gain leave round by round, since the gain of an anchor depends on the
    others (it may hide them). The last `fewest` are equal. Omitting anchor i changes the squared error of a picture I
    against the whole level's picture J by about -2 <I - J, dI/dg_i> + ||dI/dg_i||^2, g_i a gate on its opacities and
    scales that goes from 1 to 0. The first term separates anchors that make up for absent ones from anchors that have
    become wrong.
    """
    viewpoints = [(smaller(camera), time) for camera, time in viewpoints]
    level, first = scene.level, scene.rows[-2] if len(scene.rows) > 1 else 0
    bits = layer_symbols(scene, len(scene.layers) - 1).bits_per_row()
    rank, alive = np.zeros(len(bits)), np.ones(len(bits), bool)
    whole = from_scene(scene)
    references = [torch.from_numpy(render_image(whole, level, time, camera)) for camera, time in viewpoints]
    generator, rounds = torch.Generator().manual_seed(0), 0
    while alive.sum() > fewest:
        rows = np.flatnonzero(alive)
        model = from_scene(without(scene, first + np.flatnonzero(~alive)))
        gain, met = np.zeros(len(rows)), np.zeros(len(rows), bool)
        for (camera, time), reference in zip(viewpoints, references, strict=True):
            linear, square, near = anchor_slopes(model, level, time, camera, generator, reference)
            gain += (square - 2 * linear).numpy()[first:]
            met |= near.numpy()[first:]
        step()
        rounds += 1
        order = np.argsort(np.where(met, gain / bits[rows], -np.inf), kind="stable")
        leaving = len(rows) if len(rows) <= FEW else math.ceil((1 - STAY) * len(rows))
        out = rows[order[:leaving]]
        rank[out] = np.where(met[order[:leaving]], rounds + np.arange(leaving) / leaving, 0.0)
        alive[out] = False
    rank[alive] = rounds + 1
    return rank


def without(scene: Scene, rows: np.ndarray) -> Scene:
    """Returns the scene without the anchors `rows`, int64 [M]."""
    kept = np.ones(len(scene.anchor_q), bool)
    kept[rows] = False
    return replace(
        scene,
        rows=tuple(int(kept[:n].sum()) for n in scene.rows),
        mask=tuple(codes[kept[: len(codes)]] for codes in scene.mask),
        **scene.of_anchors(kept),
    )


def smaller(camera: Camera) -> Camera:
    """Returns the same view scaled down to at most SIDE pixels along the longer side."""
    factor = min(1.0, SIDE / max(camera.width, camera.height))
    width, height = (max(1, round(side * factor)) for side in (camera.width, camera.height))
    scale = np.array([[width / camera.width], [height / camera.height], [1.0]], np.float32)
    return Camera(camera.viewmat, (camera.K * scale).astype(np.float32), width, height)


def whitening_transform(errors: Tensor, covariance: Tensor) -> Tensor:
    """float64 [D, D]: A of features f' = A f, for which a quantisation step costs the same in every channel.

    The networks read few directions of a feature, which are not its channels: rounding causes errors in these
    directions but costs bits in all. Only linear layers read or change a feature, so they can undo A. With H the
    errors by direction and C the features' covariance, the bits at a given error are least where H becomes the identity
    and C diagonal (Goyal, Theoretical foundations of transform coding, 2001). Here A^-T H A^-1 is about a multiple of
    the identity with the trace of H, and A C A^T is diagonal with falling entries. errors: H, covariance: C, both
    [D, D], symmetric and positive semidefinite.
    """
    floor = LEAST_ERROR * errors.trace() / len(errors) * torch.eye(len(errors)).to(errors)
    root = torch.linalg.cholesky(errors + floor)
    back = torch.linalg.inv(root)
    root = root * ((back @ errors @ back.T).trace() / errors.trace()).sqrt()
    _, axes = torch.linalg.eigh(root.T @ covariance @ root)
    found: Tensor = axes.flip(1).T @ root.T
    return found
