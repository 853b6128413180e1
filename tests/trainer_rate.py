"""The rate of a scene as the trainer computes it, which that of its file must equal."""

import math

import numpy as np
import torch

from pd4dgs_codec.entropy.fitting import entropy_bits
from pd4dgs_codec.format.payload import Residuals
from pd4dgs_codec.format.plan import plan
from pd4dgs_codec.model.rate import MAX_BITS, MIN_SIGMA_RATIO, MIN_VARIANCE


def moments(x):
    """Mean and standard deviation of each column of x [n, c]."""
    mu = x.mean(0)
    return mu, ((x - mu).square().mean(0) + MIN_VARIANCE).sqrt()


def plain_bits(a, mu, sigma, step):
    """R(a) in the shape of a: the plain form of what `rate.row_bits` sums, precise in float64. The clip passes
    gradients."""
    sigma, d = sigma.clamp(min=step * MIN_SIGMA_RATIO), (a - mu).abs()
    near, far = (torch.special.log_ndtr((side - d) / sigma) for side in (step / 2, -step / 2))
    bits = -(near + torch.log1p(-torch.exp(far - near))) / math.log(2)
    return bits + (bits.detach().clamp(max=MAX_BITS) - bits.detach())


def train_rate_bits(scene):
    """Per layer of the file that `scene` becomes: bits of R(a) as the trainer computes them, in float64.

    attributes: R of the unrounded values over the layer's anchors, by step class, priors their moments, and the entropy
    of the classes. planes, weights: R of the rounded residuals and weights, as in the last third of training.
    """
    found = plan(scene)
    planned = found.scene
    rows = (0, *planned.rows)
    result = []
    for i, symbols in enumerate(found.symbols.layers):
        own = slice(rows[i], rows[i + 1])
        classes = np.zeros(rows[-1], np.int32) if planned.grading is None else planned.grading.classes
        attributes = 0.0 if planned.grading is None else entropy_bits(classes[own])
        for c in np.unique(classes[own]).tolist():
            for name, rows_of in planned.attributes.items():
                values = torch.from_numpy(rows_of[own][classes[own] == c]).double().flatten(1)
                step = planned.steps.attributes[name] * 2.0**c
                attributes += float(plain_bits(values, *moments(values), step).sum())
        planes = [channel.ravel() for plane in Residuals.of(symbols.tensors).planes for channel in plane]
        row = {"layer": float(symbols.layer), "attributes": attributes, "planes": gaussian_bits(planes)}
        row["weights"] = gaussian_bits([array.ravel() for array in symbols.tensors.weights])
        result.append(row)
    return result


def gaussian_bits(channels):
    """The sum of R(a) over integer channels, as the trainer computes it in float64: priors are a channel's moments."""
    total = 0.0
    for channel in channels:
        if channel.size:
            mu, sigma = moments(torch.from_numpy(channel.astype(np.float64)))
            symbols, counts = (torch.from_numpy(x) for x in np.unique(channel, return_counts=True))
            total += float((plain_bits(symbols.double(), mu, sigma, 1.0) * counts).sum())
    return total
