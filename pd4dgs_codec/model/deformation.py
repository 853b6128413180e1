"""The torch module of a deformation: residuals with gradients, start values, conversion to arrays.

A deformation has planes, a shared trunk and one network per residual head. The trunk of layer 2 reads the planes of
both layers, so one class handles all kinds of planes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from pd4dgs_codec import scene
from pd4dgs_codec.draw.layers import Layers
from pd4dgs_codec.model.config import DeformationConfig
from pd4dgs_codec.model.hexplane import HexPlane
from pd4dgs_codec.model.networks import MLP, rounded

#: Heads that change what Gaussians look like; the others move them.
APPEARANCE = ("feature", "scaling")


class DeformationField(nn.Module):
    """Computes residuals at points and a time. The heads start at zero, so a fresh field changes nothing.

    key: as in `scene.Deformation`.
    """

    def __init__(self, planes: HexPlane, trunk: MLP, heads: Mapping[str, MLP], key: int | None = None):
        super().__init__()
        self.planes, self.trunk, self.heads, self.key = planes, trunk, nn.ModuleDict(heads), key
        self.unit = float(scene.deformation_unit(planes.box.numpy()))  #: unit of LENGTH_HEADS, scene units

    # -- start values and arrays ---------------------------------------------------------------------------------------

    @staticmethod
    def fresh(
        config: DeformationConfig, box: np.ndarray, head_widths: dict[str, int], key: int | None = None, below: int = 0
    ) -> DeformationField:
        """Returns an untrained field with the heads of `config`. head_widths: their output widths. below: the number of
        features from the planes of the layer below, which the trunk reads too."""
        planes = HexPlane.fresh(config, box)  # first: the order of random draws decides the start values
        trunk = MLP((below + config.features, config.width, config.width))
        heads = {name: MLP((config.width, head_widths[name]), zero_last=True) for name in config.heads}
        return DeformationField(planes, trunk, heads, key)

    @staticmethod
    def from_arrays(deformation: scene.Deformation, box: np.ndarray) -> DeformationField:
        """Returns the field of a decoded scene's deformation."""
        networks = {name: MLP.from_arrays(net) for name, net in deformation.networks.items()}
        trunk = networks.pop(scene.TRUNK)
        return DeformationField(HexPlane.from_arrays(box, deformation.planes), trunk, networks, deformation.key)

    def arrays(self) -> scene.Deformation:
        """The inverse of `from_arrays`."""
        networks = {scene.TRUNK: self.trunk.arrays()} | {name: head.arrays() for name, head in self._named_heads()}
        return scene.Deformation(self.planes.arrays(), networks, self.key)

    def shape(self) -> dict[str, Any]:
        """Returns the values that `arrays_of_state` needs besides the state dictionary."""
        return {**self.planes.shape(), "key": self.key}

    @staticmethod
    def arrays_of_state(shape: dict[str, Any], state: Mapping[str, np.ndarray]) -> scene.Deformation:
        """Returns arrays of a field's shapes, planes all 0, from its `shape` and state dictionary. Raises ValueError if
        the two do not match."""
        planes = HexPlane.arrays_of_state(shape, state["planes.grid"])
        # the registry's order, not the dictionary's: optimiser states are matched to parameters by order
        present = {key.split(".")[1] for key in state if key.startswith("heads.")}
        heads = [head for head in scene.HEADS if head in present]
        names = {scene.TRUNK: scene.TRUNK} | {head: f"heads.{head}" for head in heads}
        networks = {name: MLP.arrays_of_state(state, key) for name, key in names.items()}
        return scene.Deformation(planes, networks, shape["key"])

    # -- parameters ----------------------------------------------------------------------------------------------------

    @property
    def weights(self) -> list[nn.Parameter]:
        """The parameters but the planes, quantised in the step of weights."""
        return [*self.trunk.parameters(), *self.heads.parameters()]

    def motion_parameters(self) -> list[nn.Parameter]:
        """The parameters but those of the heads that change what Gaussians look like."""
        heads = [head for name, head in self._named_heads() if name not in APPEARANCE]
        return [p for module in (self.planes, self.trunk, *heads) for p in module.parameters()]

    def head_layer(self, head: str) -> nn.Linear | None:
        """Returns the linear layer whose output is the residual `head`, or None if the field lacks it."""
        return cast(MLP, self.heads[head]).layers[-1] if head in self.heads else None

    # -- residuals -----------------------------------------------------------------------------------------------------

    @property
    def fusible(self) -> bool:
        """Whether the kernels can evaluate the field."""
        return self.planes.fusible and all(len(head.layers) == 1 for _, head in self._named_heads())

    def moved(
        self,
        rows: Tensor,
        features: Callable[[float], Tensor],
        columns: Mapping[str, slice],
        t: float,
        weight_step: float | None = None,
        kernels: bool = False,
    ) -> Tensor:
        """Returns rows [n, columns] plus the residuals at time t in 0..1, lengths in scene units.

        features: time -> inputs of the trunk [n, inputs]. columns: see `Widths.head_columns`; those of absent heads
        stay. weight_step: the step of the weights, if they are rounded, straight through.
        kernels: whether the kernels evaluate the field, which must be `fusible`; else plain torch does.
        """
        if not self.heads:
            return rows
        add = self._added if kernels else self._added_reference
        times = [(t, 1.0)] if self.key is None else [(t, 1.0), (scene.instant(self.key), -1.0)]
        for time, sign in times:
            rows = add(rows, features(time), columns, sign, weight_step)
        return rows

    def _added_reference(
        self, rows: Tensor, features: Tensor, columns: Mapping[str, slice], sign: float, step: float | None
    ) -> Tensor:
        hidden = F.relu(self.trunk(features, step))
        residuals = torch.zeros_like(rows)
        for name, head in self._named_heads():
            residuals[:, columns[name]] += head(hidden, step) * (sign * self._unit_of(name))
        return rows + residuals

    def _added(
        self, rows: Tensor, features: Tensor, columns: Mapping[str, slice], sign: float, step: float | None
    ) -> Tensor:
        """`_added_reference` by the kernels."""
        heads = self._named_heads()
        own = [(columns[name], sign * self._unit_of(name)) for name, _ in heads]
        networks = [self.trunk, *(head for _, head in heads)]
        parameters = [p for network in networks for layer in network.layers for p in (layer.weight, layer.bias)]
        settings = own, 2 * len(self.trunk.layers), step
        found: Tensor = _AddNetworks.apply(rows, features, settings, *parameters)  # type: ignore[no-untyped-call]
        return found

    def _named_heads(self) -> list[tuple[str, MLP]]:
        """Returns the heads present, in the registry's order."""
        return [(name, cast(MLP, head)) for name, head in self.heads.items()]

    def _unit_of(self, head: str) -> float:
        return self.unit if head in scene.LENGTH_HEADS else 1.0


class _AddNetworks(torch.autograd.Function):
    """(rows, features) -> rows plus the outputs of the trunk and all heads, each in its columns and times its unit."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, features: Tensor, settings: tuple[Any, ...], *parameters: Tensor) -> Tensor:
        columns, trunk, step = settings
        used = [rounded(p, step) for p in parameters]
        weight, bias = rows.new_zeros(rows.shape[1], used[trunk].shape[1]), rows.new_zeros(rows.shape[1])
        for (own, unit), w, b in zip(columns, used[trunk::2], used[trunk + 1 :: 2], strict=True):
            weight[own] += w * unit
            bias[own] += b * unit
        pairs = [*zip(used[:trunk:2], used[1:trunk:2], strict=True), (weight, bias)]
        ctx.layers, ctx.columns = Layers([(w.numpy(), b.numpy()) for w, b in pairs]), columns
        out = rows.clone()
        ctx.hidden = ctx.layers.add(out.numpy(), features.numpy(), keep=True)
        ctx.save_for_backward(features)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g: Tensor) -> tuple[Tensor | None, ...]:
        (features,) = ctx.saved_tensors
        g = g.contiguous()
        g_features, grads = ctx.layers.backward(g.numpy(), features.numpy(), ctx.hidden)
        weight, bias = map(torch.from_numpy, grads.pop())
        found = [torch.from_numpy(part) for layer in grads for part in layer]
        for own, unit in ctx.columns:
            found += [weight[own] * unit, bias[own] * unit]
        return g, torch.from_numpy(g_features), None, *found
