"""Mixing the channels of the features so that rounding costs least: equal steps then do equal harm in any direction.

What the networks read of a feature is a few directions of it, and these are not its channels; a step spoils pictures by
the directions that count and spends bits on all others. Nothing but linear layers touches a feature, so any invertible
mix of its channels is undone by them, and is the scene's to choose. With H the mean Gauss-Newton matrix of the pictures
by an anchor's feature and C the features' covariance, the bits at a given error are least where H becomes the identity
and C diagonal (Goyal, Theoretical foundations of transform coding, 2001).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from pd4dgs_codec.model.harm import attribute_slopes
from pd4dgs_codec.model.model import Model
from pd4dgs_codec.model.rounding import Rounding
from pd4dgs_codec.scene import MASK_THRESHOLD, SCAFFOLD_NETWORKS
from pd4dgs_codec.train import workers
from pd4dgs_codec.train.optimiser import Optimiser
from pd4dgs_codec.train.shot import Shot

#: Share of the mean harm that every direction has at least: what no picture shows must not be blown up without bound.
LEAST_HARM = 0.01


def whiten(
    model: Model, optimiser: Optimiser, shots: Sequence[Shot], levels: Sequence[int], rounding: Rounding
) -> None:
    """Mixes the feature's channels, in the anchors and in all that reads or moves them: pictures stay, to rounding.
    A step's harm, summed over the channels, stays the same too."""
    mix = workers.alike(lambda: _measured(model, shots, levels, rounding))
    if mix is not None:
        _mix(model, optimiser, mix)


def _measured(model: Model, shots: Sequence[Shot], levels: Sequence[int], rounding: Rounding) -> Tensor | None:
    """float64 [D, D]: the mix that fits the model; None where no picture shows a feature."""
    harm = torch.stack([_feature_harm(model, level, shots, rounding) for level in levels]).sum(0)
    active = model.masks(2).detach() > MASK_THRESHOLD
    if not harm.trace() > 0 or int(active.sum()) < 2:
        return None
    scaled = model.feature.detach()[active].double() / model.spacing[active, None]
    return mixing(harm, torch.cov(scaled.T))


def mixing(harm: Tensor, covariance: Tensor) -> Tensor:
    """float64 [D, D]: A of features f' = A f for which A^-T harm A^-1, the harm in the new channels, is about the
    identity times a number, its trace that of `harm`, and A covariance A^T is diagonal, its entries falling. Both
    [D, D], symmetric, not negative."""
    floor = LEAST_HARM * harm.trace() / len(harm) * torch.eye(len(harm), dtype=harm.dtype, device=harm.device)
    root = torch.linalg.cholesky(harm + floor)
    back = torch.linalg.inv(root)
    root = root * ((back @ harm @ back.T).trace() / harm.trace()).sqrt()
    _, axes = torch.linalg.eigh(root.T @ covariance @ root)
    mix: Tensor = axes.flip(1).T @ root.T
    return mix


def _feature_harm(model: Model, level: int, shots: Sequence[Shot], rounding: Rounding) -> Tensor:
    """float64 [D, D]: the Gauss-Newton matrices by the features, in units of their anchors' spacings, over all anchors
    and shots, over the squared error that there is."""
    width = model.widths.feature
    total, error = torch.zeros(width, width, dtype=torch.float64, device=model.feature.device), 0.0
    generator = torch.Generator().manual_seed(0)
    for shot in shots:
        weights, place = shot.target.weights, (level, shot.view.time, shot.view.camera)
        slopes, _, image = attribute_slopes(model, *place, generator, weights=weights, rounding=rounding)
        slope = (slopes["feature"] * model.spacing[:, None]).double()
        total += slope.T @ slope
        error += shot.squared_error(image)
    return total / max(error, 1e-12)


@torch.no_grad()
def _mix(model: Model, optimiser: Optimiser, mix: Tensor) -> None:
    """Replaces features f by A f, A = `mix` [D, D], with the layers before and behind them and the moments of all."""
    back, width = torch.linalg.inv(mix), model.widths.feature
    optimiser.transform(model.feature, slice(None), mix.T)
    for name in SCAFFOLD_NETWORKS:
        optimiser.transform(model.network(name).layers[0].weight, slice(width), back)
    field = model.global_deformation
    if field is not None and "feature" in field.heads:
        last = dict(field.named_heads())["feature"].layers[-1]
        optimiser.transform(last.weight, slice(None), mix.T, transposed=True)
        optimiser.transform(last.bias, slice(None), mix.T)
