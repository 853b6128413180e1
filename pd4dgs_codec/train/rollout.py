"""Which level a step trains: pi(rho), rho the moving average of how much the masks differ between levels 0 and 2."""

from __future__ import annotations

import torch

RHO_DECAY = 0.95


def updated_rho(rho: float, mask_0: torch.Tensor, mask_2: torch.Tensor) -> float:
    """0.95 rho + 0.05 mean(m^(2) - m^(0)), within [0, 1]."""
    sample = float((mask_2 - mask_0).mean()) if len(mask_0) else 0.0
    return min(max(RHO_DECAY * rho + (1 - RHO_DECAY) * sample, 0.0), 1.0)


def sample_level(probabilities: tuple[float, float, float], highest: int, generator: torch.Generator) -> int:
    """A level drawn from `probabilities`, never above `highest`."""
    draw = float(torch.rand((), generator=generator))
    level = 0 if draw < probabilities[0] else 1 if draw < probabilities[0] + probabilities[1] else 2
    return min(level, highest)
