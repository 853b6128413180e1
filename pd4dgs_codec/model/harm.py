"""How much a picture would change without an anchor, or by a step of its attributes.

The measures by which anchors leave a layer or a model, and by which they get their step classes.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from pd4dgs_codec.model.model import Model
from pd4dgs_codec.model.networks import EXACT, Rounding
from pd4dgs_codec.model.picture import draw
from pd4dgs_codec.scene import ATTRIBUTES, Camera

#: Random pictures of signs per view from which an anchor's weight is estimated.
PROBES = 2


def anchor_harm(
    model: Model,
    level: int,
    t: float,
    camera: Camera,
    generator: torch.Generator,
    *,
    weights: Tensor | None = None,
    rounding: Rounding = EXACT,
) -> tuple[Tensor, Tensor, Tensor]:
    """(float64 [N] the squared error, summed over pixels and colours, of leaving out an anchor at `level`, about; bool
    [N] whether the picture comes near it; the picture [H, W, 3]). Arguments as those of `render`; weights [H, W]: of
    the pixels' squares.

    The squared norm of the picture's derivative by a gate g on the anchor's opacities and scales, times its change from
    1 to 0: ||dI/dg||^2, the diagonal of the Gauss-Newton matrix, from products with random signs (Bekas, Kokiopoulou
    and Saad, An estimator for the diagonal of a matrix, 2007).
    """
    image, gate, met = _gated(model, level, t, camera, rounding)
    return _squared(image, gate, generator, weights), met, image.detach()


def anchor_slopes(
    model: Model, level: int, t: float, camera: Camera, generator: torch.Generator, reference: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """(float64 [N] <I - J, dI/dg> of each anchor, I the picture, J the reference [H, W, 3]; float64 [N] ||dI/dg||^2 as
    in anchor_harm; bool [N] whether the picture comes near it)."""
    image, gate, met = _gated(model, level, t, camera, EXACT)
    (slope,) = torch.autograd.grad((image * (image.detach() - reference)).sum(), gate, retain_graph=True)
    return slope.double(), _squared(image, gate, generator), met


def _gated(model: Model, level: int, t: float, camera: Camera, rounding: Rounding) -> tuple[Tensor, Tensor, Tensor]:
    """(picture [H, W, 3], gates of the anchors [N], all 1, from which it was drawn, bool [N] which it comes near)."""
    with torch.no_grad():
        g = model.gaussians(level, t, camera, rounding)
    n, device = len(model.anchor_q), g.means.device
    met = torch.zeros(n, dtype=torch.bool, device=device)
    met[g.anchors] = True
    gate = torch.ones(n, device=device, requires_grad=True)
    shown = gate[torch.div(g.slots, model.widths.slots, rounding_mode="floor")]
    gated = replace(g, scales=g.scales * shown[:, None], opacities=g.opacities * shown)
    return draw(model.info, gated, camera).image, gate, met


def _squared(image: Tensor, gate: Tensor, generator: torch.Generator, weights: Tensor | None = None) -> Tensor:
    """float64 [N]: the squared norm of the picture's derivative by each gate, estimated."""
    total = torch.zeros(len(gate), dtype=torch.float64, device=gate.device)
    for _ in range(PROBES):
        signs = _signs(image, generator, weights)
        (slope,) = torch.autograd.grad((image * signs).sum(), gate, retain_graph=True)
        total += slope.double().square() / PROBES
    return total


def step_harm(
    model: Model,
    level: int,
    t: float,
    camera: Camera,
    generator: torch.Generator,
    *,
    weights: Tensor | None = None,
    rounding: Rounding = EXACT,
) -> tuple[Tensor, Tensor, Tensor]:
    """(float64 [N] the squared error, summed over pixels and colours, that rounding an anchor's attributes to the
    model's steps adds, about; bool [N] whether the picture comes near it; the picture [H, W, 3]). Arguments as those of
    `anchor_harm`, by whose method the derivative by each scalar is squared; the error of a step Q is Q^2 / 12 on
    average.
    """
    slopes, met, image = attribute_slopes(model, level, t, camera, generator, weights=weights, rounding=rounding)
    total = torch.zeros(len(met), dtype=torch.float64, device=image.device)
    for name, slope in slopes.items():
        total += slope.double().square().flatten(1).sum(1) * (getattr(model.steps, name) ** 2 / 12)
    return total, met, image


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
    """(by attribute, in its shape, the derivative by it of the picture's product with random signs; bool [N] whether
    the picture comes near an anchor; the picture [H, W, 3]). Arguments as those of `anchor_harm`.

    On average over the signs, products of two derivatives by scalars of one anchor are the entries of its Gauss-Newton
    matrix.
    """
    values = [getattr(model, name) for name in ATTRIBUTES]
    with torch.enable_grad():
        g = model.gaussians(level, t, camera, rounding)
        image = draw(model.info, g, camera).image
        met = torch.zeros(len(model.anchor_q), dtype=torch.bool, device=image.device)
        met[g.anchors] = True
        slopes = [torch.zeros_like(value) for value in values]
        if len(g.scales):
            slopes = list(torch.autograd.grad((image * _signs(image, generator, weights)).sum(), values))
    return dict(zip(ATTRIBUTES, slopes, strict=True)), met, image.detach()


def _signs(image: Tensor, generator: torch.Generator, weights: Tensor | None) -> Tensor:
    """Random signs [H, W, 3] times the roots of the pixels' weights [H, W]."""
    signs = (torch.randint(0, 2, image.shape, generator=generator).float() * 2 - 1).to(image.device)
    return signs if weights is None else signs * weights.sqrt()[:, :, None]
