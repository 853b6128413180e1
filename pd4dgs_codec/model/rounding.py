"""How training imitates quantisation: noise of a step's width, or rounding that lets the gradient straight through."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor


class Noise:
    """Uniform noise in -0.5..0.5, cut at random places from one long pool: drawing it afresh would cost 5 ms a step."""

    def __init__(self, seed: int, device: torch.device | str = "cpu", size: int = 1 << 23):
        generator = torch.Generator().manual_seed(seed)
        self.pool = (torch.rand(size, generator=generator) - 0.5).to(device)
        self.generator = generator

    def draw(self, shape: torch.Size) -> Tensor:
        """A tensor of `shape`."""
        n = shape.numel()
        if n > len(self.pool):
            return torch.rand(shape, generator=self.generator).to(self.pool.device) - 0.5
        start = int(torch.randint(len(self.pool) - n + 1, (), generator=self.generator))
        return self.pool[start : start + n].view(shape)


@dataclass(frozen=True)
class Rounding:
    """How a training step imitates quantisation: noise on the anchors' attributes, or rounding of them; rounding of
    planes and weights. Rounding is straight-through."""

    noise: Noise | None = None
    attributes: bool = False
    weights: bool = False


EXACT = Rounding()


class _Round(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, step: float | Tensor) -> Tensor:
        return torch.div(x, step).round_().mul_(step)

    @staticmethod
    def backward(ctx: Any, g: Tensor) -> tuple[Tensor, None]:
        return g, None


def round_straight_through(x: Tensor, step: float | Tensor | None) -> Tensor:
    """round(x / step) * step with the identity's gradient; x itself if step is None."""
    if step is None:
        return x
    rounded: Tensor = _Round.apply(x, step)  # type: ignore[no-untyped-call]
    return rounded
