"""Small building blocks: straight-through rounding, multi-layer perceptrons, level masks."""

from __future__ import annotations

from typing import cast

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from pd4dgs_codec.scene import Network


class _Round(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x: Tensor, step: float) -> Tensor:
        return torch.div(x, step).round_().mul_(step)

    @staticmethod
    def backward(ctx, g: Tensor):
        return g, None


def round_straight_through(x: Tensor, step: float | None) -> Tensor:
    """round(x / step) * step with the identity's gradient; x itself if step is None."""
    return x if step is None else _Round.apply(x, step)


class MLP(nn.Module):
    """Linear layers with ReLU between them. widths: input, hidden..., output."""

    def __init__(self, widths: tuple[int, ...], *, zero_last: bool = False):
        super().__init__()
        self.linears = nn.ModuleList(nn.Linear(a, b) for a, b in zip(widths[:-1], widths[1:], strict=True))
        if zero_last:
            nn.init.zeros_(self.layers[-1].weight)
            nn.init.zeros_(self.layers[-1].bias)

    @property
    def layers(self) -> list[nn.Linear]:
        """The linear layers, input side first."""
        return [cast(nn.Linear, linear) for linear in self.linears]

    def rounded(self, step: float | None) -> list[tuple[Tensor, Tensor]]:
        """(weight, bias) per layer; with `step`, rounded straight-through."""
        return [
            (round_straight_through(lin.weight, step), round_straight_through(lin.bias, step)) for lin in self.layers
        ]

    def forward(self, x: Tensor, step: float | None = None) -> Tensor:
        """x [n, in] -> [n, out]; with `step`, weights and biases are rounded straight-through first."""
        for i, (weight, bias) in enumerate(self.rounded(step)):
            x = F.linear(F.relu(x) if i else x, weight, bias)
        return x

    def arrays(self) -> Network:
        """The weights as numpy arrays, input side first."""
        return tuple(
            (lin.weight.detach().cpu().numpy().copy(), lin.bias.detach().cpu().numpy().copy()) for lin in self.layers
        )

    @staticmethod
    def from_arrays(network: Network) -> MLP:
        """The module that `arrays` came from."""
        mlp = MLP((network[0][0].shape[1], *(w.shape[0] for w, _ in network)))
        with torch.no_grad():
            for linear, (w, b) in zip(mlp.layers, network, strict=True):
                linear.weight.copy_(torch.from_numpy(np.array(w)))
                linear.bias.copy_(torch.from_numpy(np.array(b)))
        return mlp


def level_mask(logits: Tensor, level: int) -> Tensor:
    """m^(level) [N] of logits [N, 3]: sigmoid(a0 + sum_{1<=j<=level} softplus(a_j)), so never falling with level.

    The gradient reaches a_level alone. Were it to reach the logits below as well, whatever a higher level needs would
    be held in layer 0 too, and the levels' masks would stay together.
    """
    total = logits[:, 0]
    for j in range(1, level + 1):
        total = total.detach() + F.softplus(logits[:, j])
    return torch.sigmoid(total)


def mask_logits(masks: np.ndarray) -> np.ndarray:
    """Logits float32 [N, 3] whose level masks are `masks` [N, 3], non-decreasing along axis 1, to within 1e-6."""
    m = np.clip(masks.astype(np.float64), 1e-7, 1 - 1e-7)
    total = np.log(m) - np.log1p(-m)
    rise = np.maximum(np.diff(total, axis=1), 1e-13)
    steps = np.where(rise > 30, rise, np.log(np.expm1(np.minimum(rise, 30.0))))
    return np.concatenate([total[:, :1], steps], axis=1).astype(np.float32)
