"""Adam over the model's named parameter groups, and its surgery when anchors come and go."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from pd4dgs_codec.model.model import Model
from pd4dgs_codec.train.config import LearningRates, learning_rate

#: Parameters with one row per anchor.
PER_ANCHOR = ("feature", "scaling_log", "offset", "mask_logits")


class Optimiser:
    """One Adam with a group per learning-rate schedule; groups are named after the fields of LearningRates."""

    def __init__(self, model: Model, rates: LearningRates, cooldown: float = 0.0):
        self.model, self.rates, self.cooldown = model, rates, cooldown
        groups: dict[str, list[nn.Parameter]] = {name: [getattr(model, name)] for name in PER_ANCHOR}
        groups |= {name: list(net.parameters()) for name, net in model.networks.items()}
        fields = [f for f in (model.global_deformation, model.local_deformation) if f is not None]
        groups["planes"] = [p for f in fields for p in f.planes.parameters()]
        groups["deformation"] = [p for f in fields for part in (f.trunk, f.heads) for p in part.parameters()]
        self.adam = torch.optim.Adam(
            [{"params": params, "name": name} for name, params in groups.items() if params],
            lr=0.0,
            betas=(0.9, 0.99),
            eps=1e-15,
            fused=True,
        )

    def step(self, progress: float) -> None:
        """One update at progress 0..1 of the schedule."""
        for group in self.adam.param_groups:
            group["lr"] = learning_rate(getattr(self.rates, group["name"]), progress, self.cooldown)
        self.adam.step()

    def gradient_norm(self) -> float:
        """Norm over all gradients; NaN or infinite if any is."""
        gradients = [p.grad for group in self.adam.param_groups for p in group["params"] if p.grad is not None]
        return float(torch.stack(torch._foreach_norm(gradients)).norm()) if gradients else 0.0

    def scale_gradients(self, factor: float) -> None:
        """All gradients times `factor`."""
        for group in self.adam.param_groups:
            for p in group["params"]:
                if p.grad is not None:
                    p.grad.mul_(factor)

    def zero_grad(self) -> None:
        """Forgets all gradients."""
        self.adam.zero_grad(set_to_none=True)

    def replace_anchors(self, keep: Tensor, added: dict[str, Tensor]) -> None:
        """Keeps the anchors `keep` (int64) and appends the rows of `added`; the moments of new rows start at zero."""
        for group in self.adam.param_groups:
            name = group["name"]
            if name not in PER_ANCHOR:
                continue
            old = group["params"][0]
            new = nn.Parameter(torch.cat([old.detach()[keep], added[name]]))
            state = self.adam.state.pop(old, None)
            if state:
                for moment in ("exp_avg", "exp_avg_sq"):
                    state[moment] = torch.cat([state[moment][keep], torch.zeros_like(added[name])])
                self.adam.state[new] = state
            group["params"][0] = new
            setattr(self.model, name, new)
        self.model.anchor_q = torch.cat([self.model.anchor_q[keep], added["anchor_q"]])
        graded = self.model.step_class
        self.model.step_class = torch.cat([graded[keep], graded.new_zeros(len(added["anchor_q"]))])

    def keep_anchors(self, keep: Tensor) -> None:
        """Keeps the anchors `keep` (int64) alone."""
        names = (*PER_ANCHOR, "anchor_q")
        self.replace_anchors(keep, {name: getattr(self.model, name).detach()[:0] for name in names})

    @torch.no_grad()
    def transform(self, parameter: Tensor, columns: slice, right: Tensor, *, transposed: bool = False) -> None:
        """The parameter's `columns` X become X M, M = `right` [d, d]; of a transposed one its rows, as columns.

        Its gradients then come as G M^-T, and so do their means. Their mean squares follow as if the gradients of the
        columns were independent.
        """
        moment = torch.linalg.inv(right).T
        state = self.adam.state.get(parameter, {})
        changes = [(parameter, right)]
        changes += [(state[name], by) for name, by in (("exp_avg", moment), ("exp_avg_sq", moment**2)) if name in state]
        for tensor, by in changes:
            part = (tensor.T if transposed else tensor)[..., columns]
            part.copy_((part.double() @ by).to(part))

    def forget(self, module: nn.Module) -> None:
        """Takes the parameters of `module` out, and groups that hold no others."""
        gone = {id(p) for p in module.parameters()}
        for group in self.adam.param_groups:
            for p in group["params"]:
                if id(p) in gone:
                    self.adam.state.pop(p, None)
            group["params"] = [p for p in group["params"] if id(p) not in gone]
        self.adam.param_groups = [group for group in self.adam.param_groups if group["params"]]

    def state(self) -> dict[str, Any]:
        """What resuming needs."""
        return self.adam.state_dict()

    def load_state(self, state: dict[str, Any]) -> None:
        """Back to what `state` returned."""
        self.adam.load_state_dict(state)
