"""Global and local deformation: a HexPlane, a shared trunk and one linear head per residual."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from pd4dgs_codec import scene
from pd4dgs_codec.model.config import DeformationConfig
from pd4dgs_codec.model.hexplane import HexPlane
from pd4dgs_codec.model.layers import MLP, round_straight_through


class DeformationField(nn.Module):
    """Residuals at points and a time. The heads start at zero, so a fresh field changes nothing."""

    def __init__(self, planes: HexPlane, trunk: MLP, heads: dict[str, MLP]):
        super().__init__()
        self.planes = planes
        self.trunk = trunk
        self.heads = nn.ModuleDict(heads)

    @staticmethod
    def fresh(
        config: DeformationConfig, box: np.ndarray, head_widths: dict[str, int], plane_step: float
    ) -> DeformationField:
        """A new field with the heads that `config` names, `head_widths` giving each one's output width."""
        resolution = (config.resolution,) * 3 + (config.time_resolution,)
        planes = HexPlane(box, resolution, config.channels, config.multires, step=plane_step)
        trunk = MLP((config.channels * len(config.multires), config.width, config.width))
        return DeformationField(
            planes, trunk, {name: MLP((config.width, head_widths[name]), zero_last=True) for name in config.heads}
        )

    @staticmethod
    def from_arrays(deformation: scene.Deformation, box: np.ndarray) -> DeformationField:
        """The field that a decoded scene holds."""
        networks = {name: MLP.from_arrays(net) for name, net in deformation.networks.items()}
        trunk = networks.pop("trunk")
        return DeformationField(HexPlane.from_plane_arrays(box, deformation.planes), trunk, networks)

    def arrays(self) -> scene.Deformation:
        """Planes and weights as numpy arrays."""
        networks = {"trunk": self.trunk.arrays()} | {name: head.arrays() for name, head in self.heads.items()}
        return scene.Deformation(self.planes.plane_arrays(), networks)

    def forward(
        self, points: Tensor, t: float, plane_step: float | None = None, weight_step: float | None = None
    ) -> dict[str, Tensor]:
        """points [n, 3] world, t in 0..1 -> residual [n, width] per head present."""
        if not self.heads:
            return {}
        hidden = F.relu(self.trunk(self.planes(points, t, step=plane_step), weight_step))
        heads = list(self.heads.items())
        if all(len(head.linears) == 1 for _, head in heads):  # one product for all heads
            weight = torch.cat([head.linears[0].weight for _, head in heads])
            bias = torch.cat([head.linears[0].bias for _, head in heads])
            out = F.linear(
                hidden, round_straight_through(weight, weight_step), round_straight_through(bias, weight_step)
            )
            parts = out.split([head.linears[0].out_features for _, head in heads], dim=1)
            return {name: part for (name, _), part in zip(heads, parts, strict=True)}
        return {name: head(hidden, weight_step) for name, head in heads}
