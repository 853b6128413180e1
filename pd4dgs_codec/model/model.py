"""The layered model: one graph for training and inference, and its conversion from and to a `Scene` of numpy arrays.

Render_0    = R(MLP(A))
Render_1(t) = R(MLP(A + F_global(A, t)))
Render_2(t) = R(MLP(A + F_local(A, t)))

A: anchors on a voxel grid (feature, log-scaling, offsets), from which the scaffold's networks make Gaussians. F_global
reads the planes of layer 1, coarse in space and time. F_local replaces it and also reads the finer planes of layer 2.
The gate m^(level) multiplies each Gaussian's opacity and scale.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn

from pd4dgs_codec.draw.gaussians import OFFSET_REACH, SIGMA_REACH, in_view
from pd4dgs_codec.errors import DataError
from pd4dgs_codec.model import fused, reference
from pd4dgs_codec.model.deformation import DeformationField
from pd4dgs_codec.model.networks import EXACT, MLP, Quantisation, Rounding, level_mask, mask_logits
from pd4dgs_codec.scene import (
    ATTRIBUTES,
    MASK_STEP,
    MASK_THRESHOLD,
    SCAFFOLD_NETWORKS,
    Camera,
    Grading,
    LayeredScene,
    Scene,
    SceneInfo,
    Steps,
    Widths,
)
from pd4dgs_codec.tensors.quantise import mask_codes

#: Log2 of the step of frozen anchors, in steps of class 0: so fine that neither noise nor rounding changes them.
FROZEN_STEP = -12.0
#: Range over which the opacity biases of an anchor's Gaussians, which start at one place, are spread at the start: some
#: but not all of them are visible everywhere.
START_OPACITY = (-0.1, 0.2)


@dataclass
class Gaussians:
    """The input of the rasteriser: K Gaussians, activated and gated."""

    means: Tensor  #: [K, 3] world
    quats: Tensor  #: [K, 4] wxyz, unit
    scales: Tensor  #: [K, 3] scene units
    opacities: Tensor  #: [K] 0..1
    colors: Tensor  #: [K, 3] 0..1
    slots: Tensor  #: int64 [K], anchor * G + offset, of G slots
    anchors: Tensor  #: int64 [n], the anchors that were evaluated
    raw_opacity: Tensor  #: [n, G] before the gate


class Model(nn.Module):
    """Anchors, networks, deformations and masks. All tensors are float32 except anchor_q (int32 [N, 3]) and step_class
    (uint8 [N]). step_class and centre [channels]: see `scene.Grading`. frozen: number of the first anchors, those of a
    base, which training does not change, nor the networks (0: none)."""

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
        self.frozen = 0
        self.backgrounds = dict[int, tuple[float, float, float]]()  #: of levels of incomplete files
        self.spreads = dict[int, float]()  #: of levels of incomplete files, see `LayeredScene.spread`
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

    def shown(self, level: int) -> SceneInfo:
        """Returns `info` with the background of a level."""
        return replace(self.info, background=self.backgrounds.get(level, self.info.background))

    @property
    def anchor(self) -> Tensor:
        """[N, 3] anchor positions, world."""
        return (self.anchor_q.double() * float(self.info.voxel_size)).float()

    @property
    def widths(self) -> Widths:
        """The widths of anchors and networks, read off the tensors."""
        features = self.feature.shape[1]
        viewing = tuple(n for n in SCAFFOLD_NETWORKS if self.network(n).layers[0].in_features > features)
        return Widths(features, self.offset.shape[1], viewing=viewing)

    @property
    def spacing(self) -> Tensor:
        """[N], 2^c: the factor on the steps of each anchor's attributes."""
        classes = self.step_class.float()
        classes[: self.frozen] = FROZEN_STEP
        return torch.exp2(classes)

    def freeze(self, count: int) -> None:
        """Freezes the first `count` anchors, and the networks if there are any."""
        self.frozen = count
        self.networks.requires_grad_(not count)

    @property
    def centres(self) -> dict[str, Tensor]:
        """The centre of the attributes by name, in the shape of one anchor's value."""
        shapes = self.widths.attributes
        parts = torch.split(self.centre, [math.prod(shape) for shape in shapes.values()])
        return {name: part.view(shape) for (name, shape), part in zip(shapes.items(), parts, strict=True)}

    @property
    def deformations(self) -> dict[int, DeformationField]:
        """The deformations present, by layer, 1 and 2."""
        fields = {1: self.global_deformation, 2: self.local_deformation}
        return {layer: field for layer, field in fields.items() if field is not None}

    @property
    def level(self) -> int:
        """The highest level that differs from the one below in more than its masks."""
        return max(self.deformations, default=0)

    def network(self, name: str) -> MLP:
        """Returns the scaffold's decoder `name`."""
        return cast(MLP, self.networks[name])

    def masks(self, level: int) -> Tensor:
        """Returns the masks m^(level) [N]."""
        return level_mask(self.mask_logits, level)

    @torch.no_grad()
    def _visible(self, masks: Tensor, spread: float, camera: Camera, only: Tensor | None) -> Tensor:
        offsets, sizes = (part.amax(1).exp() for part in torch.split(self.scaling_log, 3, dim=1))
        radius, position = OFFSET_REACH * offsets + SIGMA_REACH * spread * sizes, self.anchor
        seen = in_view(camera, self._viewmat(camera), position, radius, self.info.near) & (masks > MASK_THRESHOLD)
        visible: Tensor = (seen if only is None else seen & only).nonzero()[:, 0]
        return visible

    def gaussians(
        self, level: int, t: float, camera: Camera, rounding: Rounding = EXACT, only: Tensor | None = None
    ) -> Gaussians:
        """Returns the Gaussians of `level` that the camera may see at normalised time t in 0..1, of the anchors `only`
        (bool [N]) if given. The kernels evaluate them if they support the model, else plain torch does."""
        kernels, masks, slots = self._fusible(), self.masks(level), self.widths.slots
        spread = self.spreads.get(level, 1.0)
        stages: Any = fused if kernels else reference
        rows, viewmat = self._visible(masks, spread, camera, only), self._viewmat(camera)
        anchors = self._moved(level, stages.pick(*self._picked(rows, rounding)), t, rounding, kernels)
        step = self.steps.weights_scaffold if rounding.weights else None
        networks = [self.network(name) for name in SCAFFOLD_NETWORKS]
        eye = -viewmat[:3, :3].T @ viewmat[:3, 3]
        found, gates, raw_opacity, keep = stages.grow(anchors, masks.index_select(0, rows), eye, networks, step)
        owner = rows.index_select(0, torch.div(keep, slots, rounding_mode="floor"))
        means, scales, quats, opacities, colors = torch.split(found, [3, 3, 4, 1, 3], dim=1)
        gated = scales * (spread * gates)[:, None], opacities[:, 0] * gates
        kept = owner * slots + keep % slots
        return Gaussians(means, quats, *gated, colors, kept, rows, raw_opacity)

    def _picked(self, rows: Tensor, rounding: Rounding) -> tuple[Any, ...]:
        """Returns the arguments of `pick` for the anchors `rows`: attributes, positions, rows and quantisation."""
        steps, centres, noise = [*self.steps.attributes.values()], [*self.centres.values()], None
        if rounding.noise is not None and not rounding.attributes:
            noise = [rounding.noise.draw(len(rows), centre.numel()) for centre in centres]
        quantisation = Quantisation(steps, centres, self.spacing, noise, rounding.attributes)
        return [getattr(self, name) for name in ATTRIBUTES], self.anchor, rows, quantisation

    def _moved(self, level: int, rows: Tensor, t: float, rounding: Rounding, kernels: bool) -> Tensor:
        """Returns the rows of anchors plus the residuals of the deformation of `level`."""
        layers = [layer for layer in self.deformations if layer <= level]
        if not layers:
            return rows
        fields, points = [self.deformations[layer] for layer in layers], rows[:, :3].detach()
        steps = [self.steps.planes(layer) if rounding.weights else None for layer in layers]

        def features(time: float) -> Tensor:
            parts = [field.planes(points, time, step) for field, step in zip(fields, steps, strict=True)]
            return torch.cat(parts, dim=1)

        step = self.steps.weights(layers[-1]) if rounding.weights else None
        return fields[-1].moved(rows, features, self.widths.head_columns, t, step, kernels)

    def moved_points(self, points: Tensor, level: int, t: float, rounding: Rounding = EXACT) -> Tensor:
        """Returns points [n, 3], world, as the deformation of `level` moves them to normalised time t."""
        return self.moved_rows(points, level, t, rounding)[:, :3]

    def moved_rows(self, points: Tensor, level: int, t: float, rounding: Rounding = EXACT) -> Tensor:
        """Returns [n, 3 + channels]: `moved_points`, and what is added to the attributes of anchors there."""
        rows = torch.cat([points, points.new_zeros(len(points), self.widths.channels)], dim=1)
        return self._moved(level, rows, t, rounding, self._fusible())

    def _viewmat(self, camera: Camera) -> Tensor:
        """[4, 4] world to camera."""
        return torch.as_tensor(np.array(camera.viewmat, np.float32), device=self.feature.device)

    @torch.no_grad()
    def round_to_steps(self) -> None:
        """Rounds all parameters but the masks in place to multiples of their steps, as `Rounding` simulates."""
        steps = self.steps
        for name, centre in self.centres.items():
            values = getattr(self, name)
            step = getattr(steps, name) * self.spacing.view(-1, *(1,) * centre.dim())
            rounded = centre + torch.round((values - centre) / step) * step
            values[self.frozen :] = rounded[self.frozen :]
        parts = [([] if self.frozen else [*self.networks.parameters()], steps.weights_scaffold)]
        for layer, field in self.deformations.items():
            parts += [([field.planes.grid], steps.planes(layer)), (field.weights, steps.weights(layer))]
        for parameters, step in parts:
            for parameter in parameters:
                parameter.copy_(torch.round(parameter / step) * step)

    def _fusible(self) -> bool:
        """Whether `fused` can evaluate the whole model."""
        fields = all(field.fusible for field in self.deformations.values())
        networks = [self.network(name) for name in SCAFFOLD_NETWORKS]
        return fields and fused.fusible(networks) and self.feature.device.type == "cpu"


def fresh_networks(widths: Widths, hidden: int) -> dict[str, MLP]:
    """Returns untrained decoders of the scaffold."""
    networks = {name: MLP((widths.inputs[name], hidden, outputs)) for name, outputs in widths.networks.items()}
    with torch.no_grad():  # random biases could hide anchors for good
        networks["opacity"].layers[-1].bias.copy_(torch.linspace(*START_OPACITY, widths.slots))
    return networks


# -- from and to the arrays that the codec packs -----------------------------------------------------------------------


def check_finite(state: Mapping[str, torch.Tensor]) -> None:
    """Raises DataError naming a tensor that holds a NaN or an infinity."""
    for name, tensor in state.items():
        if not torch.isfinite(tensor).all():
            raise DataError(f"tensor {name} holds a NaN or an infinity; expected finite numbers")


def to_scene(model: Model) -> Scene:
    """Returns an unplanned scene of every anchor of the model: rows (N, ...), masks of inactive anchors 0.

    Raises DataError as `check_finite` does.
    """
    check_finite(model.state_dict())
    deformations = {layer: field.arrays() for layer, field in model.deformations.items()}
    layers = (0, *deformations)
    n = len(model.anchor_q)
    with torch.no_grad():
        masks = tuple(mask_codes(model.masks(layer).cpu().numpy()) for layer in layers)
    return Scene(
        info=model.info,
        steps=model.steps,
        layers=layers,
        rows=(n,) * len(layers),
        anchor_q=_numpy(model.anchor_q),
        feature=_numpy(model.feature),
        scaling_log=_numpy(model.scaling_log),
        offset=_numpy(model.offset),
        mask=masks,
        networks={name: model.network(name).arrays() for name in SCAFFOLD_NETWORKS},
        global_deformation=deformations.get(1),
        local_deformation=deformations.get(2),
        grading=Grading(_numpy(model.step_class), _numpy(model.centre)) if model.step_class.any() else None,
    )


def from_scene(scene: LayeredScene) -> Model:
    """Returns the model that renders `scene`, with anchors in the scene's order.

    A level whose layer is absent equals the level below it; masks are reproduced to within 1e-6. Raises DataError for a
    scene without networks.
    """
    if not isinstance(scene, Scene):
        raise DataError("found a scene of splats, which has no networks; models and checkpoints hold scaffolds only")
    n = len(scene.anchor_q)
    masks = np.zeros((n, 3), np.float64)
    for level in range(3):
        present = [i for i, layer in enumerate(scene.layers) if layer <= level]
        codes = scene.mask[present[-1]]
        masks[: len(codes), level] = codes * np.float64(MASK_STEP)
    box = scene.info.box
    fields = (scene.global_deformation, scene.local_deformation)
    global_field, local_field = (None if f is None else DeformationField.from_arrays(f, box) for f in fields)
    model = Model(
        scene.info,
        scene.steps,
        torch.from_numpy(scene.anchor_q.astype(np.int32)),
        torch.from_numpy(np.array(scene.feature, np.float32)),
        torch.from_numpy(np.array(scene.scaling_log, np.float32)),
        torch.from_numpy(np.array(scene.offset, np.float32)),
        torch.from_numpy(mask_logits(masks)),
        {name: MLP.from_arrays(net) for name, net in scene.networks.items()},
        global_field,
        local_field,
        *(() if scene.grading is None else map(torch.tensor, (scene.grading.classes, scene.grading.centre))),
    )
    found = {level: scene.background(level) for level in range(3)}
    model.backgrounds = {level: color for level, color in found.items() if color != scene.info.background}
    model.spreads = {level: scene.spread(level) for level in range(3)}
    return model


def _numpy(tensor: torch.Tensor) -> np.ndarray:
    array: np.ndarray = tensor.detach().cpu().numpy().copy()
    return array
