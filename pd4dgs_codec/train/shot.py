"""A training view as the steps need it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pd4dgs_codec.data.view import View
from pd4dgs_codec.train.ssim import TargetStats


@dataclass(frozen=True, eq=False)
class Shot:
    """A view with its camera and its image on the device. viewmat: float32 [4, 4]; K: float32 [3, 3]."""

    view: View
    viewmat: Tensor
    K: Tensor
    target: TargetStats

    @staticmethod
    def of(view: View, device: torch.device) -> Shot:
        """The shot of a dataset's view."""
        viewmat, K = (torch.as_tensor(np.array(m, np.float32), device=device) for m in (view.viewmat, view.K))
        image = torch.as_tensor(view.image, device=device).float() / 255
        mask = None if view.mask is None else torch.as_tensor(view.mask, device=device).float()
        return Shot(view, viewmat, K, TargetStats(image, mask))
