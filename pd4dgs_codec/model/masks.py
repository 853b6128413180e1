"""The levels' masks: one logit per level, made so that a mask never falls from a level to the next."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F


def level_mask(logits: Tensor, level: int) -> Tensor:
    """m^(level) [N] of logits [N, 3]: sigmoid(a0 + sum_{1<=j<=level} softplus(a_j)), so never falling with level.

    The gradient reaches a_level alone. If it reached the logits below as well, layer 0 would hold the anchors of higher
    levels too, and the levels' masks would stay together.
    """
    columns = logits.T.contiguous()  # torch vectorises contiguous tensors only
    total = columns[0]
    for j in range(1, level + 1):
        total = total.detach() + F.softplus(columns[j])
    return torch.sigmoid(total)


def mask_logits(masks: np.ndarray) -> np.ndarray:
    """Logits float32 [N, 3] whose level masks are `masks` [N, 3], non-decreasing along axis 1, to within 1e-6."""
    m = np.clip(masks.astype(np.float64), 1e-7, 1 - 1e-7)
    total = np.log(m) - np.log1p(-m)
    rise = np.maximum(np.diff(total, axis=1), 1e-13)
    steps = np.where(rise > 30, rise, np.log(np.expm1(np.minimum(rise, 30.0))))
    return np.concatenate([total[:, :1], steps], axis=1).astype(np.float32)
