"""How much a picture would change without an anchor: the measure by which anchors leave a layer or a model."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from pd4dgs_codec.model.model import Model
from pd4dgs_codec.model.picture import draw
from pd4dgs_codec.model.rounding import EXACT, Rounding
from pd4dgs_codec.scene import Camera

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
    with torch.no_grad():
        g = model.gaussians(level, t, camera, rounding)
    n, device = len(model.anchor_q), g.means.device
    total = torch.zeros(n, dtype=torch.float64, device=device)
    met = torch.zeros(n, dtype=torch.bool, device=device)
    met[g.anchors] = True
    gate = torch.ones(n, device=device, requires_grad=True)
    shown = gate[torch.div(g.slots, model.widths.slots, rounding_mode="floor")]
    gated = replace(g, scales=g.scales * shown[:, None], opacities=g.opacities * shown)
    image = draw(model.info, gated, camera).image
    for _ in range(PROBES):
        signs = (torch.randint(0, 2, image.shape, generator=generator).float() * 2 - 1).to(device)
        if weights is not None:
            signs = signs * weights.sqrt()[:, :, None]
        (slope,) = torch.autograd.grad((image * signs).sum(), gate, retain_graph=True)
        total += slope.double().square() / PROBES
    return total, met, image.detach()
