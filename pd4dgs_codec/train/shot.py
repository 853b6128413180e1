"""A training view as the steps need it."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from pd4dgs_codec.data.view import View
from pd4dgs_codec.train.ssim import TargetStats


@dataclass(frozen=True, eq=False)
class Shot:
    """A view and its image on the device."""

    view: View
    target: TargetStats

    @staticmethod
    def of(view: View, device: torch.device) -> Shot:
        """The shot of a dataset's view."""
        image = torch.as_tensor(view.image, device=device).float() / 255
        mask = None if view.mask is None else torch.as_tensor(view.mask, device=device).float()
        return Shot(view, TargetStats(image, mask))
