"""Parts of the model: simulated quantisation, multi-layer perceptrons, and the masks of the levels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from pd4dgs_codec.scene import Network

POOL = 1 << 23  #: size of the pool of `Noise`


class Noise:
    """Uniform noise in -0.5..0.5, cut at random places from one long pool: drawing it anew would cost 5 ms a step."""

    def __init__(self, seed: int, device: torch.device | str = "cpu"):
        self.generator = torch.Generator().manual_seed(seed)
        self.pool = (torch.rand(POOL, generator=self.generator) - 0.5).to(device)

    def draw(self, rows: int, columns: int) -> Tensor:
        """Returns noise [rows, columns]."""
        n = rows * columns
        if n > len(self.pool):
            return torch.rand(rows, columns, generator=self.generator).to(self.pool.device) - 0.5
        start = int(torch.randint(len(self.pool) - n + 1, (), generator=self.generator))
        return self.pool[start : start + n].view(rows, columns)


@dataclass(frozen=True)
class Rounding:
    """How a training step simulates quantisation. noise: added to the anchors' attributes. attributes: they are rounded
    instead. weights: the other parameters are rounded. Rounding is straight-through."""

    noise: Noise | None = None
    attributes: bool = False
    weights: bool = False


EXACT = Rounding()


class Quantisation(NamedTuple):
    """How the attributes of n of N anchors are quantised: to centre plus multiples of step * spacing. steps, centres:
    per attribute. spacing: [N], per anchor. noise: per attribute [n, width], in steps, or None. rounding: round instead
    of adding noise."""

    steps: Sequence[float]
    centres: Sequence[Tensor]
    spacing: Tensor
    noise: Sequence[Tensor] | None
    rounding: bool


def rounded(x: Tensor, step: float | Tensor | None) -> Tensor:
    """Returns round(x / step) * step, or x itself if step is None. For custom forward passes, outside the graph."""
    return x if step is None else torch.div(x, step).round_().mul_(step)


class _Round(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, step: float | Tensor) -> Tensor:
        return rounded(x, step)

    @staticmethod
    def backward(ctx: Any, g: Tensor) -> tuple[Tensor, None]:
        return g, None


def round_straight_through(x: Tensor, step: float | Tensor | None) -> Tensor:
    """`rounded`, with the gradient of the identity."""
    if step is None:
        return x
    found: Tensor = _Round.apply(x, step)  # type: ignore[no-untyped-call]
    return found


class MLP(nn.Module):
    """Linear layers with ReLU between them. widths: input, hidden..., output."""

    def __init__(self, widths: tuple[int, ...], *, zero_last: bool = False):
        super().__init__()
        #: The linear layers, input side first.
        self.layers = [nn.Linear(a, b) for a, b in zip(widths[:-1], widths[1:], strict=True)]
        self.linears = nn.ModuleList(self.layers)  # registers the parameters; slow to read
        if zero_last:
            nn.init.zeros_(self.layers[-1].weight)
            nn.init.zeros_(self.layers[-1].bias)

    def forward(self, x: Tensor, step: float | None = None) -> Tensor:
        """x [n, in] -> [n, out]; with `step`, weights and biases are rounded straight-through first."""
        for i, layer in enumerate(self.layers):
            weight, bias = (round_straight_through(p, step) for p in (layer.weight, layer.bias))
            x = F.linear(F.relu(x) if i else x, weight, bias)
        return x

    def arrays(self) -> Network:
        """Returns the layers as numpy arrays, input side first."""
        return tuple(
            (lin.weight.detach().cpu().numpy().copy(), lin.bias.detach().cpu().numpy().copy()) for lin in self.layers
        )

    @staticmethod
    def from_arrays(network: Network) -> MLP:
        """The inverse of `arrays`."""
        mlp = MLP((network[0][0].shape[1], *(w.shape[0] for w, _ in network)))
        with torch.no_grad():
            for linear, (w, b) in zip(mlp.layers, network, strict=True):
                linear.weight.copy_(torch.from_numpy(np.array(w)))
                linear.bias.copy_(torch.from_numpy(np.array(b)))
        return mlp

    @staticmethod
    def arrays_of_state(state: Mapping[str, np.ndarray], prefix: str) -> Network:
        """Returns the network whose parameters have names with `prefix` in a state dictionary of arrays."""
        count = sum(key.startswith(f"{prefix}.linears.") and key.endswith(".weight") for key in state)
        names = [f"{prefix}.linears.{i}" for i in range(count)]
        return tuple((state[f"{name}.weight"], state[f"{name}.bias"]) for name in names)


# -- masks of the levels -----------------------------------------------------------------------------------------------


def level_mask(logits: Tensor, level: int) -> Tensor:
    """Returns m^(level) [N] = sigmoid(a_0 + sum_{1<=j<=level} softplus(a_j)) of logits [N, 3]; it rises with the level.

    Above level 0 the gradient does not reach a_0. Otherwise layer 0 would hold the anchors of higher levels too, and
    the levels' masks would stay together.
    """
    columns = logits.T.contiguous()  # torch vectorises contiguous tensors only
    total = columns[0].detach() if level else columns[0]
    for j in range(1, level + 1):
        total = total + F.softplus(columns[j])
    return torch.sigmoid(total)


def mask_logits(masks: np.ndarray) -> np.ndarray:
    """Returns logits float32 [N, 3] of the level masks `masks` [N, 3], non-decreasing along axis 1, to within 1e-6."""
    m = np.clip(masks.astype(np.float64), 1e-7, 1 - 1e-7)
    total = np.log(m) - np.log1p(-m)
    rise = np.maximum(np.diff(total, axis=1), 1e-13)
    steps = np.where(rise > 30, rise, np.log(np.expm1(np.minimum(rise, 30.0))))
    return np.concatenate([total[:, :1], steps], axis=1).astype(np.float32)
