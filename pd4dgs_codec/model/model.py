"""The layered model: one graph for training and inference.

Render_0    = R(MLP(A))
Render_1(t) = R(MLP(A + F_global(A, t)))
Render_2(t) = R(MLP(A + F_global(A, t)) + F_local(G, t))

A: anchors (feature, log-scaling, offsets on a voxel grid); G: the Gaussians that the scaffold's networks make of them.
The gate m^(level) multiplies each Gaussian's final opacity and scale, after the local residuals.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import cast

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from pd4dgs_codec.draw.visibility import FRUSTUM_MARGIN, MIN_OPACITY, OFFSET_REACH, SIGMA_REACH
from pd4dgs_codec.model import fused
from pd4dgs_codec.model.deformation import DeformationField
from pd4dgs_codec.model.masks import level_mask
from pd4dgs_codec.model.mlp import MLP
from pd4dgs_codec.model.rounding import EXACT, Rounding, round_straight_through
from pd4dgs_codec.model.slots import assemble, slot_linear
from pd4dgs_codec.scene import (
    ATTRIBUTES,
    LOCAL_HEADS,
    MASK_THRESHOLD,
    SCAFFOLD_NETWORKS,
    Camera,
    SceneInfo,
    Steps,
    Widths,
)

#: Opacities of an anchor's Gaussians start spread between these: some are seen everywhere, and not all are, since
#: they start at one place.
START_OPACITY = (-0.1, 0.2)


@dataclass
class Gaussians:
    """What the rasteriser takes; K Gaussians. Scales, opacities and colours are activated and gated."""

    means: Tensor  #: [K, 3] world
    quats: Tensor  #: [K, 4] wxyz, unit
    scales: Tensor  #: [K, 3] scene units
    opacities: Tensor  #: [K] 0..1
    colors: Tensor  #: [K, 3] 0..1
    slots: Tensor  #: int64 [K], anchor * G + offset, of G slots
    anchors: Tensor  #: int64 [n], the anchors that were evaluated
    raw_opacity: Tensor  #: [n, G] before the gate


def camera_tensors(camera: Camera, device: torch.device) -> tuple[Tensor, Tensor]:
    """(viewmat [4, 4] world to camera, K [3, 3] pixels) as float32 tensors."""
    viewmat, K = (torch.as_tensor(np.array(m, np.float32), device=device) for m in (camera.viewmat, camera.K))
    return viewmat, K


def camera_centre(camera: Camera, device: torch.device) -> Tensor:
    """[3], world."""
    viewmat, _ = camera_tensors(camera, device)
    return -viewmat[:3, :3].T @ viewmat[:3, 3]


class Model(nn.Module):
    """Anchors, networks, deformations and masks. All tensors float32 but anchor_q (int32 [N, 3]) and step_class (uint8
    [N]). step_class and centre [channels] are those of `scene.Grading`."""

    anchor_q: Tensor
    step_class: Tensor
    centre: Tensor

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
        step_class: Tensor | None = None,
        centre: Tensor | None = None,
    ):
        super().__init__()
        self.info, self.steps = info, steps
        self.register_buffer("anchor_q", anchor_q)
        widths = Widths(feature.shape[1], offset.shape[1])
        no_class, no_centre = torch.zeros(len(anchor_q), dtype=torch.uint8), torch.zeros(widths.channels)
        self.register_buffer("step_class", no_class if step_class is None else step_class)
        self.register_buffer("centre", no_centre if centre is None else centre)
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
    def widths(self) -> Widths:
        """Feature width and slots, as its tensors have them."""
        return Widths(self.feature.shape[1], self.offset.shape[1])

    @property
    def spacing(self) -> Tensor:
        """[N], 2^c: what the steps of each anchor's attributes are multiplied with."""
        return torch.exp2(self.step_class.float())

    @property
    def centres(self) -> dict[str, Tensor]:
        """The centre of the attributes by name, in the shape of one anchor's value."""
        shapes = self.widths.attributes
        parts = torch.split(self.centre, [math.prod(shape) for shape in shapes.values()])
        return {name: part.view(shape) for (name, shape), part in zip(shapes.items(), parts, strict=True)}

    @property
    def deformations(self) -> dict[int, DeformationField]:
        """By layer, 1 and 2, those that there are."""
        fields = {1: self.global_deformation, 2: self.local_deformation}
        return {layer: field for layer, field in fields.items() if field is not None}

    @property
    def level(self) -> int:
        """The highest level that differs from the one below in more than its masks."""
        return max(self.deformations, default=0)

    def network(self, name: str) -> MLP:
        """One of the scaffold's decoders."""
        return cast(MLP, self.networks[name])

    def masks(self, level: int) -> Tensor:
        """m^(level) [N]."""
        return level_mask(self.mask_logits, level)

    def visible(self, level: int, camera: Camera) -> Tensor:
        """int64 [n]: anchors active at `level` that may reach the image, in ascending order."""
        return self._visible(self.masks(level), self.anchor, camera)

    @torch.no_grad()
    def _visible(self, masks: Tensor, position: Tensor, camera: Camera, only: Tensor | None = None) -> Tensor:
        viewmat, _ = camera_tensors(camera, self.feature.device)
        fx, fy, cx, cy = (float(camera.K[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
        across, down, depth = torch.unbind(viewmat[:3, :3] @ position.T + viewmat[:3, 3:])
        offsets, sizes = (part.amax(1).exp() for part in torch.split(self.scaling_log, 3, dim=1))
        radius = OFFSET_REACH * offsets + SIGMA_REACH * sizes
        z = depth.clamp(min=float(self.info.near))
        x = fx * across / z + cx
        y = fy * down / z + cy
        width, height = camera.width, camera.height
        margin = max(fx, fy) * radius / z + FRUSTUM_MARGIN * max(width, height)
        inside = (x > -margin) & (x < width + margin) & (y > -margin) & (y < height + margin)
        seen = inside & (depth + radius > 0) & (masks > MASK_THRESHOLD)
        return (seen if only is None else seen & only).nonzero()[:, 0]

    def gaussians(
        self, level: int, t: float, camera: Camera, rounding: Rounding = EXACT, only: Tensor | None = None
    ) -> Gaussians:
        """The Gaussians of `level` at normalised time t in 0..1 as the camera meets them; of the anchors `only` (bool
        [N]) where it is given."""
        if not self._fusible():
            return self.gaussians_reference(level, t, camera, rounding, only)
        steps, masks, position, widths = self.steps, self.masks(level), self.anchor, self.widths
        centres = self.centres
        rows = self._visible(masks, position, camera, only)
        noise = None
        if rounding.noise is not None and not rounding.attributes:
            draws = [rounding.noise.draw(torch.Size((len(rows), x[0].numel()))) for x in self._attributes()]
            noise = draws[0], draws[2], draws[1]
        anchors = fused.pick(
            (self.feature, self.offset, self.scaling_log),
            position,
            rows,
            (steps.feature, steps.offset, steps.scaling_log),
            noise,
            rounding.attributes,
            self.spacing,
            (centres["feature"], centres["offset"], centres["scaling_log"]),
        )
        if level >= 1 and (field := self.global_deformation) is not None and field.heads:
            anchors = fused.moved(anchors, field, widths.global_heads, t, *self._field_steps(1, rounding), False)
        step = steps.weights_scaffold if rounding.weights else None
        networks = [self.network(name) for name in SCAFFOLD_NETWORKS]
        mask = masks.index_select(0, rows)
        found, gates, raw_opacity, keep = fused.grown(
            anchors, mask, camera_centre(camera, self.feature.device), networks, step, MIN_OPACITY
        )
        loose = level >= 2 and self.local_deformation is not None
        if (field := self.local_deformation) is not None and loose and field.heads:
            found = fused.moved(found, field, LOCAL_HEADS, t, *self._field_steps(2, rounding), True)
        means, quats, scales, opacities, colors = fused.finish(found, gates, loose)
        owner = rows.index_select(0, torch.div(keep, widths.slots, rounding_mode="floor"))
        slots = owner * widths.slots + keep % widths.slots
        return Gaussians(means, quats, scales, opacities, colors, slots, rows, raw_opacity)

    def gaussians_reference(
        self, level: int, t: float, camera: Camera, rounding: Rounding = EXACT, only: Tensor | None = None
    ) -> Gaussians:
        """The plain torch form of `gaussians`, for any device and any networks."""
        slots = self.widths.slots
        rows = self._visible(self.masks(level), self.anchor, camera, only)
        mask = self.masks(level).index_select(0, rows)
        position = self.anchor.index_select(0, rows)
        feature, scaling_log, offset = (self._attribute(name, rows, rounding) for name in ATTRIBUTES)
        if level >= 1 and self.global_deformation is not None:
            residuals = self.global_deformation(position, t, *self._field_steps(1, rounding))
            position = _moved(position, residuals, "position")
            feature = _moved(feature, residuals, "feature")
            offset = _moved(offset, residuals, "offset")
            scaling_log = _moved(scaling_log, residuals, "scaling")

        direction = F.normalize(position - camera_centre(camera, self.feature.device), dim=1)
        opacity, covariance, color = self._last_layers(torch.cat([feature, direction], dim=1), rounding)
        raw_opacity = torch.tanh(F.linear(*opacity))
        keep = (raw_opacity.detach() * mask.detach()[:, None] >= MIN_OPACITY).flatten().nonzero()[:, 0]
        shape = slot_linear(*covariance, keep, slots)
        colors = torch.sigmoid(slot_linear(*color, keep, slots))
        means, scales, quats, opacities, gate = assemble(
            position, scaling_log.exp(), offset, raw_opacity, mask, shape, keep
        )
        if level >= 2 and self.local_deformation is not None:
            residuals = self.local_deformation(means, t, *self._field_steps(2, rounding))
            means = _moved(means, residuals, "mean")
            scales = F.relu(_moved(scales, residuals, "scale")) if "scale" in residuals else scales
            quats = F.normalize(_moved(quats, residuals, "quat"), dim=1) if "quat" in residuals else quats
            opacities = _moved(opacities, residuals, "opacity").clamp(0, 1) if "opacity" in residuals else opacities
            colors = _moved(colors, residuals, "color").clamp(0, 1) if "color" in residuals else colors
        anchors = rows.index_select(0, torch.div(keep, slots, rounding_mode="floor"))
        return Gaussians(
            means=means,
            quats=quats,
            scales=scales * gate[:, None],
            opacities=opacities * gate,
            colors=colors,
            slots=anchors * slots + keep % slots,
            anchors=rows,
            raw_opacity=raw_opacity,
        )

    @torch.no_grad()
    def round_to_steps(self) -> None:
        """Attributes, planes and weights in place to multiples of their steps: what `Rounding` imitates."""
        steps = self.steps
        for name, centre in self.centres.items():
            values = getattr(self, name)
            step = getattr(steps, name) * self.spacing.view(-1, *(1,) * centre.dim())
            values.copy_(centre + torch.round((values - centre) / step) * step)
        parts: list[tuple[nn.Module, float]] = [(self.networks, steps.weights_scaffold)]
        for layer, field in self.deformations.items():
            weights = steps.weights(layer)
            parts += [(field.planes, steps.planes(layer)), (field.trunk, weights), (field.heads, weights)]
        for module, step in parts:
            for parameter in module.parameters():
                parameter.copy_(torch.round(parameter / step) * step)

    def _attributes(self) -> tuple[nn.Parameter, nn.Parameter, nn.Parameter]:
        """In the order in which they take noise."""
        return self.feature, self.scaling_log, self.offset

    def _fusible(self) -> bool:
        """Whether `fused` can evaluate all of the model."""
        fields = self.deformations.values()
        networks = [(self.network(name), 2) for name in SCAFFOLD_NETWORKS]
        networks += [(field.trunk, len(field.trunk.layers)) for field in fields]
        fits = all(fused.supports(*pair) for pair in networks) and all(map(fused.supports_field, fields))
        return fits and self.feature.device.type == "cpu"

    def _last_layers(self, inputs: Tensor, rounding: Rounding) -> list[tuple[Tensor, Tensor, Tensor]]:
        """Per decoder what its last layer takes, its weight and its bias; first layers of two in one product."""
        step = self.steps.weights_scaffold if rounding.weights else None
        networks = [self.network(name).rounded(step) for name in SCAFFOLD_NETWORKS]
        if any(len(layers) != 2 for layers in networks):
            return [(_before_last(layers, inputs), *layers[-1]) for layers in networks]
        first = [layers[0] for layers in networks]
        hidden = F.relu(F.linear(inputs, torch.cat([w for w, _ in first]), torch.cat([b for _, b in first])))
        parts = torch.split(hidden, [len(b) for _, b in first], dim=1)
        return [(part, *layers[1]) for part, layers in zip(parts, networks, strict=True)]

    def _field_steps(self, layer: int, rounding: Rounding) -> tuple[float | None, float | None]:
        """Of planes and weights of a layer's deformation, if they are rounded."""
        return (self.steps.planes(layer), self.steps.weights(layer)) if rounding.weights else (None, None)

    def _attribute(self, name: str, rows: Tensor, rounding: Rounding) -> Tensor:
        picked: Tensor = getattr(self, name).index_select(0, rows)
        centre = self.centres[name]
        step = getattr(self.steps, name) * self.spacing.index_select(0, rows).view(-1, *(1,) * centre.dim())
        if rounding.attributes:
            return centre + round_straight_through(picked - centre, step)
        return picked if rounding.noise is None else picked + rounding.noise.draw(picked.shape) * step


def _moved(values: Tensor, residuals: dict[str, Tensor], head: str) -> Tensor:
    """values plus what the head answers, if there is such a head."""
    return values + residuals[head].view_as(values) if head in residuals else values


def _before_last(layers: list[tuple[Tensor, Tensor]], x: Tensor) -> Tensor:
    """What the last of the layers takes: the hidden layers applied to x [n, in]."""
    for weight, bias in layers[:-1]:
        x = F.relu(F.linear(x, weight, bias))
    return x


def fresh_networks(widths: Widths, hidden: int) -> dict[str, MLP]:
    """The scaffold's decoders, untrained: input [feature, view direction 3]."""
    networks = {name: MLP((widths.inputs, hidden, outputs)) for name, outputs in widths.networks.items()}
    with torch.no_grad():  # else chance decides what is ever seen
        networks["opacity"].layers[-1].bias.copy_(torch.linspace(*START_OPACITY, widths.slots))
    return networks
