"""The layered model: one graph for training and inference.

Render_0    = R(MLP(A))
Render_1(t) = R(MLP(A + F_global(A, t)))
Render_2(t) = R(MLP(A + F_global(A, t)) + F_local(G, t))

A: anchors (feature, log-scaling, offsets on a voxel grid); G: the Gaussians that the scaffold's networks make of them.
The gate m^(level) multiplies each Gaussian's final opacity and scale, after the local residuals.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from pd4dgs_codec.model.deformation import DeformationField
from pd4dgs_codec.model.layers import MLP, level_mask, round_straight_through
from pd4dgs_codec.model.slots import assemble, slot_linear
from pd4dgs_codec.scene import FEATURE_DIM, MASK_THRESHOLD, N_OFFSETS, SCAFFOLD_NETWORKS, SceneInfo, Steps

#: A Gaussian fainter than this never reaches a pixel (the rasteriser's threshold), so its networks are not evaluated.
MIN_OPACITY = 1.0 / 255.0
#: Opacities of an anchor's ten Gaussians start spread between these: some are seen everywhere, and not all are, since
#: they start at one place.
START_OPACITY = (-0.1, 0.2)
#: Anchors farther outside the image than this share of its size (plus their own extent) are not evaluated.
FRUSTUM_MARGIN = 0.15


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


@dataclass
class Gaussians:
    """What the rasteriser takes; K Gaussians. Scales, opacities and colours are activated and gated."""

    means: Tensor  #: [K, 3] world
    quats: Tensor  #: [K, 4] wxyz, unit
    scales: Tensor  #: [K, 3] scene units
    opacities: Tensor  #: [K] 0..1
    colors: Tensor  #: [K, 3] 0..1
    slots: Tensor  #: int64 [K], anchor * 10 + offset
    anchors: Tensor  #: int64 [n], the anchors that were evaluated
    raw_opacity: Tensor  #: [n, 10] before the gate


class Model(nn.Module):
    """Anchors, networks, deformations and masks. All tensors float32 but anchor_q (int32 [N, 3])."""

    anchor_q: Tensor

    def __init__(
        self,
        info: SceneInfo,
        steps: Steps,
        anchor_q: Tensor,
        feature: Tensor,
        scaling_log: Tensor,
        offset: Tensor,
        mask_logits: Tensor,
        networks: dict[str, MLP],
        global_deformation: DeformationField | None,
        local_deformation: DeformationField | None,
    ):
        super().__init__()
        self.info, self.steps = info, steps
        self.register_buffer("anchor_q", anchor_q)
        self.feature = nn.Parameter(feature)
        self.scaling_log = nn.Parameter(scaling_log)
        self.offset = nn.Parameter(offset)
        self.mask_logits = nn.Parameter(mask_logits)
        self.networks = nn.ModuleDict(networks)
        self.global_deformation = global_deformation
        self.local_deformation = local_deformation

    @property
    def anchor(self) -> Tensor:
        """[N, 3] anchor positions, world."""
        return (self.anchor_q.double() * float(self.info.voxel_size)).float()

    @property
    def level(self) -> int:
        """The highest level that differs from the one below in more than its masks."""
        return 2 if self.local_deformation is not None else 1 if self.global_deformation is not None else 0

    def network(self, name: str) -> MLP:
        """One of the scaffold's decoders."""
        return cast(MLP, self.networks[name])

    def masks(self, level: int) -> Tensor:
        """m^(level) [N]."""
        return level_mask(self.mask_logits, level)

    @torch.no_grad()
    def visible(self, level: int, viewmat: Tensor, K: Tensor, width: int, height: int) -> Tensor:
        """int64 [n]: anchors active at `level` that may reach the image, in ascending order."""
        position = self.anchor @ viewmat[:3, :3].T + viewmat[:3, 3]
        extent = self.scaling_log.exp()
        radius = 2.0 * extent[:, :3].amax(1) + 3.33 * extent[:, 3:].amax(1)
        depth = position[:, 2]
        z = depth.clamp(min=float(self.info.near))
        x = K[0, 0] * position[:, 0] / z + K[0, 2]
        y = K[1, 1] * position[:, 1] / z + K[1, 2]
        margin = torch.maximum(K[0, 0], K[1, 1]) * radius / z + FRUSTUM_MARGIN * max(width, height)
        inside = (x > -margin) & (x < width + margin) & (y > -margin) & (y < height + margin)
        return (inside & (depth + radius > 0) & (self.masks(level) > MASK_THRESHOLD)).nonzero()[:, 0]

    def gaussians(
        self,
        level: int,
        t: float,
        viewmat: Tensor,
        K: Tensor,
        width: int,
        height: int,
        rounding: Rounding = EXACT,
    ) -> Gaussians:
        """The Gaussians of `level` at normalised time t in 0..1 as the camera (viewmat [4, 4], K [3, 3]) meets them."""
        rows = self.visible(level, viewmat, K, width, height)
        mask = self.masks(level).index_select(0, rows)
        position = self.anchor.index_select(0, rows)
        feature = self._attribute(self.feature, rows, self.steps.feature, rounding)
        scaling_log = self._attribute(self.scaling_log, rows, self.steps.scaling_log, rounding)
        offset = self._attribute(self.offset, rows, self.steps.offset, rounding)
        if level >= 1 and self.global_deformation is not None:
            residual = self.global_deformation(
                position,
                t,
                plane_step=self.steps.planes_global if rounding.weights else None,
                weight_step=self.steps.weights_global if rounding.weights else None,
            )
            position = position + residual["position"] if "position" in residual else position
            feature = feature + residual["feature"] if "feature" in residual else feature
            offset = offset + residual["offset"].view_as(offset) if "offset" in residual else offset
            scaling_log = scaling_log + residual["scaling"] if "scaling" in residual else scaling_log

        camera_centre = -viewmat[:3, :3].T @ viewmat[:3, 3]
        direction = F.normalize(position - camera_centre, dim=1)
        opacity, covariance, color = self._last_layers(torch.cat([feature, direction], dim=1), rounding)
        raw_opacity = torch.tanh(F.linear(*opacity))
        keep = (raw_opacity.detach() * mask.detach()[:, None] >= MIN_OPACITY).flatten().nonzero()[:, 0]
        shape = slot_linear(*covariance, keep)
        colors = torch.sigmoid(slot_linear(*color, keep))
        means, scales, quats, opacities, gate = assemble(
            position, scaling_log.exp(), offset, raw_opacity, mask, shape, keep
        )
        if level >= 2 and self.local_deformation is not None:
            residual = self.local_deformation(
                means,
                t,
                plane_step=self.steps.planes_local if rounding.weights else None,
                weight_step=self.steps.weights_local if rounding.weights else None,
            )
            means = means + residual["mean"] if "mean" in residual else means
            scales = F.relu(scales + residual["scale"]) if "scale" in residual else scales
            quats = F.normalize(quats + residual["quat"], dim=1) if "quat" in residual else quats
            opacities = (opacities + residual["opacity"][:, 0]).clamp(0, 1) if "opacity" in residual else opacities
            colors = (colors + residual["color"]).clamp(0, 1) if "color" in residual else colors
        return Gaussians(
            means=means,
            quats=quats,
            scales=scales * gate[:, None],
            opacities=opacities * gate,
            colors=colors,
            slots=rows.index_select(0, torch.div(keep, N_OFFSETS, rounding_mode="floor")) * N_OFFSETS
            + keep % N_OFFSETS,
            anchors=rows,
            raw_opacity=raw_opacity,
        )

    @torch.no_grad()
    def round_to_steps(self) -> None:
        """Attributes, planes and weights in place to multiples of their steps: what `Rounding` imitates."""
        steps = self.steps
        for name in ("feature", "scaling_log", "offset"):
            values, step = getattr(self, name), getattr(steps, name)
            values.copy_(torch.round(values / step) * step)
        parts: list[tuple[nn.Module, float]] = [(self.networks, steps.weights_scaffold)]
        for field, planes, weights in (
            (self.global_deformation, steps.planes_global, steps.weights_global),
            (self.local_deformation, steps.planes_local, steps.weights_local),
        ):
            if field is not None:
                parts += [(field.planes, planes), (field.trunk, weights), (field.heads, weights)]
        for module, step in parts:
            for parameter in module.parameters():
                parameter.copy_(torch.round(parameter / step) * step)

    def _last_layers(self, inputs: Tensor, rounding: Rounding) -> list[tuple[Tensor, Tensor, Tensor]]:
        """Per decoder what its last layer takes, its weight and its bias; first layers of two in one product."""
        step = self.steps.weights_scaffold if rounding.weights else None
        networks = [self.network(name).rounded(step) for name in SCAFFOLD_NETWORKS]
        if any(len(layers) != 2 for layers in networks):
            return [(_before_last(layers, inputs), *layers[-1]) for layers in networks]
        first = [layers[0] for layers in networks]
        hidden = F.relu(F.linear(inputs, torch.cat([w for w, _ in first]), torch.cat([b for _, b in first])))
        parts = hidden.split([len(b) for _, b in first], dim=1)
        return [(part, *layers[1]) for part, layers in zip(parts, networks, strict=True)]

    def _attribute(self, values: Tensor, rows: Tensor, step: float, rounding: Rounding) -> Tensor:
        picked = values.index_select(0, rows)
        if rounding.attributes:
            return round_straight_through(picked, step)
        return picked if rounding.noise is None else picked + rounding.noise.draw(picked.shape) * step


def _before_last(layers: list[tuple[Tensor, Tensor]], x: Tensor) -> Tensor:
    """What the last of the layers takes: the hidden layers applied to x [n, in]."""
    for weight, bias in layers[:-1]:
        x = F.relu(F.linear(x, weight, bias))
    return x


def fresh_networks(hidden: int) -> dict[str, MLP]:
    """The scaffold's decoders, untrained: input [feature 32, view direction 3]."""
    width = FEATURE_DIM + 3
    networks = {name: MLP((width, hidden, outputs)) for name, outputs in SCAFFOLD_NETWORKS.items()}
    with torch.no_grad():  # else chance decides what is ever seen
        networks["opacity"].layers[-1].bias.copy_(torch.linspace(*START_OPACITY, N_OFFSETS))
    return networks
