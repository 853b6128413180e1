"""Adam over named groups of the model's parameters; its moments follow the addition and removal of anchors.

The update calls torch's fused kernel, because `torch.optim.Adam` imports torch's compiler at its first use, which takes
a second.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Set
from typing import Any

import torch
from torch import Tensor, nn

from pd4dgs_codec.model.model import Model
from pd4dgs_codec.train.config import LearningRates

#: Parameters with one row per anchor.
PER_ANCHOR = ("feature", "scaling_log", "offset", "mask_logits")
#: Names of a parameter's moments: its steps so far, and the running means of gradients and of their squares.
STEP, MEAN, SQUARE = "step", "exp_avg", "exp_avg_sq"
#: Decay of both running means, and the number added to the root of the second.
BETA1, BETA2, EPS = 0.9, 0.99, 1e-15


class Optimiser:
    """Adam with a parameter group per learning-rate schedule.

    groups: parameters by field of LearningRates. moments: for each parameter that has had a gradient, tensors by STEP,
    MEAN and SQUARE. exposures: see `TrainingViews`.
    """

    def __init__(self, model: Model, rates: LearningRates, cooldown: float, exposures: Iterable[nn.Parameter] = ()):
        self.model, self.rates, self.cooldown = model, rates, cooldown
        groups: dict[str, list[nn.Parameter]] = {name: [getattr(model, name)] for name in PER_ANCHOR}
        if not model.frozen:
            groups |= {name: list(net.parameters()) for name, net in model.networks.items()}
        fields = model.deformations.values()
        groups["planes"] = [f.planes.grid for f in fields]
        groups["deformation"] = [p for f in fields for p in f.weights]
        groups["exposure"] = list(exposures)
        self.groups = {name: params for name, params in groups.items() if params}
        self.moments: dict[Tensor, dict[str, Tensor]] = {}

    @property
    def parameters(self) -> list[nn.Parameter]:
        """The parameters of all groups, in order."""
        return [p for params in self.groups.values() for p in params]

    @torch.no_grad()
    def step(self, progress: float, iterations: int | None) -> None:
        """Updates the parameters at progress 0..1 of a schedule of `iterations` steps, None while unknown."""
        rates = self.rates.of_run(iterations)
        for name, params in self.groups.items():
            rate = learning_rate(getattr(rates, name), progress, self.cooldown)
            moved: list[Tensor] = [p for p in params if p.grad is not None]
            for p in moved:
                if p not in self.moments:
                    zero = torch.zeros((), device=p.device)
                    self.moments[p] = {STEP: zero, MEAN: torch.zeros_like(p), SQUARE: torch.zeros_like(p)}
            means, squares, steps = ([self.moments[p][name] for p in moved] for name in (MEAN, SQUARE, STEP))
            gradients = [p.grad for p in moved if p.grad is not None]
            if moved:
                torch._foreach_add_(steps, 1)
                torch._fused_adam_(
                    moved, gradients, means, squares, [], steps, amsgrad=False, maximize=False, beta1=BETA1,
                    beta2=BETA2, lr=rate, weight_decay=0.0, eps=EPS,
                )  # fmt: skip

    def clip_gradients(self, most: float) -> float:
        """Scales the gradients to a norm of at most `most`. Returns their norm before, NaN or inf if one is. Those of
        frozen anchors become 0, so that neither they nor their moments change."""
        for p in (self.groups[name][0] for name in PER_ANCHOR if self.model.frozen):
            if p.grad is not None:
                p.grad[: self.model.frozen] = 0
        gradients = [p.grad for p in self.parameters if p.grad is not None]
        norm = float(torch.stack(torch._foreach_norm(gradients)).norm()) if gradients else 0.0
        if most < norm < math.inf:
            torch._foreach_mul_(gradients, most / norm)
        return norm

    def take_gradients(self) -> list[Tensor | None]:
        """Removes and returns the gradients of all parameters."""
        taken = [p.grad for p in self.parameters]
        self.zero_grad()
        return taken

    def add_gradients(self, given: list[Tensor | None]) -> None:
        """Adds gradients from `take_gradients`."""
        for p, g in zip(self.parameters, given, strict=True):
            if g is not None:
                p.grad = g if p.grad is None else p.grad.add_(g)

    def keep_gradients(self, kept: Set[nn.Parameter]) -> None:
        """Removes the gradients of all parameters but those."""
        for p in self.parameters:
            if p not in kept:
                p.grad = None

    def zero_grad(self) -> None:
        for p in self.parameters:
            p.grad = None

    def replace_anchors(self, keep: Tensor, added: dict[str, Tensor]) -> None:
        """Keeps the anchors `keep` (int64) and appends the rows of `added`; the moments of new rows start at zero."""
        for name in PER_ANCHOR:
            (old,) = self.groups[name]
            new = nn.Parameter(torch.cat([old.detach()[keep], added[name]]))
            moments = self.moments.pop(old, None)
            if moments:
                for moment in (MEAN, SQUARE):
                    moments[moment] = torch.cat([moments[moment][keep], torch.zeros_like(added[name])])
                self.moments[new] = moments
            self.groups[name] = [new]
            setattr(self.model, name, new)
        self.model.anchor_q = torch.cat([self.model.anchor_q[keep], added["anchor_q"]])
        graded = self.model.step_class
        self.model.step_class = torch.cat([graded[keep], graded.new_zeros(len(added["anchor_q"]))])

    @torch.no_grad()
    def transform(self, parameter: Tensor, columns: slice, right: Tensor, *, transposed: bool = False) -> None:
        """Replaces the parameter's `columns` X by X M with M = `right` [d, d]; if transposed, its rows.

        Gradients G by X become G M^-T by X M, and their running means change likewise. The mean squares change as if
        the gradients of the columns were independent.
        """
        moment = torch.linalg.inv(right).T
        moments = self.moments.get(parameter, {})
        changes: list[tuple[Tensor, Tensor]] = [(parameter, right)]
        changes += [(moments[name], by) for name, by in ((MEAN, moment), (SQUARE, moment**2)) if name in moments]
        for tensor, by in changes:
            part = (tensor.T if transposed else tensor)[..., columns]
            part.copy_((part.double() @ by).to(part))

    def forget(self, module: nn.Module) -> None:
        """Removes the parameters of `module`, and groups that become empty."""
        gone: set[Tensor] = set(module.parameters())
        for name, params in list(self.groups.items()):
            self.groups[name] = [p for p in params if p not in gone]
            if not self.groups[name]:
                del self.groups[name]
        for p in gone:
            self.moments.pop(p, None)

    def state(self) -> dict[str, Any]:
        """The state for a checkpoint: under "state", the moments of each parameter by its index."""
        return {"state": {i: dict(self.moments[p]) for i, p in enumerate(self.parameters) if p in self.moments}}

    def load_state(self, state: dict[str, Any]) -> None:
        """Restores a `state`. Raises an exception of any type if it is broken."""
        by_index = dict(enumerate(self.parameters))
        self.moments = {}
        for index, stored in state["state"].items():
            p = by_index[int(index)]
            moments = {name: stored[name].detach().clone() for name in (STEP, MEAN, SQUARE)}
            shapes = [tuple(value.shape) for value in moments.values()]
            if shapes != [(), tuple(p.shape), tuple(p.shape)]:
                raise ValueError(f"step and moments have shapes {shapes}, the parameter {tuple(p.shape)}")
            self.moments[p] = {name: value.to(p.device, torch.float32) for name, value in moments.items()}


def learning_rate(bounds: tuple[float, float], progress: float, cooldown: float = 0.0) -> float:
    """The rate at progress 0..1: log-linear between the bounds, times a factor that falls from 1 to 0 over the last
    `cooldown` of the run."""
    start, end = bounds
    left = min((1 - progress) / cooldown, 1.0) if cooldown else 1.0
    return start * math.pow(end / start, progress) * left
