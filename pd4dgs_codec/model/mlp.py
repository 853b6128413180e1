"""Multi-layer perceptrons whose weights can be rounded as the codec rounds them."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from pd4dgs_codec.model.rounding import round_straight_through
from pd4dgs_codec.scene import Network


class MLP(nn.Module):
    """Linear layers with ReLU between them. widths: input, hidden..., output."""

    def __init__(self, widths: tuple[int, ...], *, zero_last: bool = False):
        super().__init__()
        #: The linear layers, input side first.
        self.layers = [nn.Linear(a, b) for a, b in zip(widths[:-1], widths[1:], strict=True)]
        self.linears = nn.ModuleList(self.layers)  # what names the parameters; slow to read
        if zero_last:
            nn.init.zeros_(self.layers[-1].weight)
            nn.init.zeros_(self.layers[-1].bias)

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
