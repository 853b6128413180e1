"""Global and local deformation: a HexPlane, a shared trunk and one linear head per residual."""

from __future__ import annotations

from typing import cast

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from pd4dgs_codec import scene
from pd4dgs_codec.model.config import DeformationConfig
from pd4dgs_codec.model.hexplane import HexPlane
from pd4dgs_codec.model.mlp import MLP


class DeformationField(nn.Module):
    """Residuals at points and a time. The heads start at zero, so a fresh field changes nothing."""

    def __init__(self, planes: HexPlane, trunk: MLP, heads: dict[str, MLP]):
        super().__init__()
        self.planes = planes
        self.unit = float(scene.deformation_unit(planes.box.numpy()))
        self.trunk = trunk
        self.heads = nn.ModuleDict(heads)

    @staticmethod
    def fresh(
        config: DeformationConfig, box: np.ndarray, head_widths: dict[str, int], spacing: int | None, plane_step: float
    ) -> DeformationField:
        """A new field with the heads that `config` names, `head_widths` giving each one's output width. spacing: of the
        planes' start values, see HexPlane."""
        resolution = (config.resolution,) * 3 + (config.time_resolution,)
        planes = HexPlane(box, resolution, config.channels, config.multires, spacing=spacing, step=plane_step)
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
        networks = {"trunk": self.trunk.arrays()} | {name: head.arrays() for name, head in self.named_heads()}
        return scene.Deformation(self.planes.plane_arrays(), networks)

    def forward(
        self, points: Tensor, t: float, plane_step: float | None = None, weight_step: float | None = None
    ) -> dict[str, Tensor]:
        """points [n, 3] world, t in 0..1 -> residual [n, width] per head present, lengths in scene units."""
        if not self.heads:
            return {}
        outputs = self._outputs(points, t, plane_step, weight_step)
        return {name: out * self.unit if name in scene.LENGTH_HEADS else out for name, out in outputs.items()}

    def _outputs(
        self, points: Tensor, t: float, plane_step: float | None, weight_step: float | None
    ) -> dict[str, Tensor]:
        hidden = F.relu(self.trunk(self.planes(points, t, step=plane_step), weight_step))
        layers = {name: head.rounded(weight_step) for name, head in self.named_heads()}
        if any(len(head) > 1 for head in layers.values()):
            return {name: head(hidden, weight_step) for name, head in self.named_heads()}
        firsts = [head[0] for head in layers.values()]  # one product for all heads
        out = F.linear(hidden, torch.cat([w for w, _ in firsts]), torch.cat([b for _, b in firsts]))
        return dict(zip(layers, torch.split(out, [len(b) for _, b in firsts], dim=1), strict=True))

    def named_heads(self) -> list[tuple[str, MLP]]:
        """The heads present, in the registry's order."""
        return [(name, cast(MLP, head)) for name, head in self.heads.items()]
