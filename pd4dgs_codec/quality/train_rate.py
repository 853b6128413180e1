"""The trainer's own rate of a checkpoint, layer by layer, to hold against what the coder really spent."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from pd4dgs_codec.entropy.bits import entropy_bits
from pd4dgs_codec.format.layer_meta import Section
from pd4dgs_codec.format.options import DEFAULTS, EncodeOptions
from pd4dgs_codec.format.payload import channel_groups
from pd4dgs_codec.format.plan import plan
from pd4dgs_codec.format.symbols import layer_symbols
from pd4dgs_codec.format.table import classes_of
from pd4dgs_codec.model.plane_rate import gaussian_bits
from pd4dgs_codec.model.rate import channel_moments, rate_bits
from pd4dgs_codec.scene import Scene


def train_rate_bits(scene: Scene, options: EncodeOptions = DEFAULTS) -> list[dict[str, float]]:
    """Per layer of the file that `scene` becomes: bits of R(a) as the trainer computes them, in float64.

    attributes: R of the unrounded values over the layer's anchors, by step class, priors their moments, and the entropy
    of the classes. planes, weights: R of the rounded residuals and weights, which is what the last third of training
    sees.
    """
    planned, _ = plan(scene, options)
    rows = (0, *planned.rows)
    result = []
    for i, layer in enumerate(planned.layers):
        own = slice(rows[i], rows[i + 1])
        classes = np.zeros(rows[-1], np.int32) if planned.grading is None else classes_of(planned)
        attributes = 0.0 if planned.grading is None else entropy_bits(classes[own])
        for c in np.unique(classes[own]).tolist():
            for name, rows_of in planned.attributes.items():
                values = torch.from_numpy(rows_of[own][classes[own] == c]).double().flatten(1)
                attributes += _bits(values, planned.steps.attributes[name] * 2.0**c)
        groups, _ = channel_groups(layer_symbols(planned, i))
        row = {"layer": float(layer), "attributes": attributes}
        for section in (Section.PLANES, Section.WEIGHTS):
            row[section.name.lower()] = gaussian_bits(groups[section])
        result.append(row)
    return result


def _bits(values: Tensor, step: float) -> float:
    mu, sigma = channel_moments(values)
    return float(rate_bits(values, mu, sigma, step).sum())
