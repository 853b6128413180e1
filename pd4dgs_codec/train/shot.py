"""A training view as the steps need it."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import overload

import torch
from torch import Tensor

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

    def squared_error(self, image: Tensor) -> float:
        """Of a picture [H, W, 3] of this view, summed over colours and weighted pixels."""
        return float(((image - self.target.image).square().sum(-1) * self.target.weights).sum())


#: Bytes of images on the device, weights included, beyond which those not used for longest leave.
KEPT_BYTES = 1 << 30


class Shots(Sequence[Shot]):
    """The shots of a data set's views, made when they are asked for and kept as long as KEPT_BYTES hold them."""

    def __init__(self, views: Sequence[View], device: torch.device):
        self.views, self.device = views, device
        self._kept: OrderedDict[int, Shot] = OrderedDict()
        self._bytes = 0

    def __len__(self) -> int:
        return len(self.views)

    @overload
    def __getitem__(self, index: int) -> Shot: ...

    @overload
    def __getitem__(self, index: slice) -> list[Shot]: ...

    def __getitem__(self, index: int | slice) -> Shot | list[Shot]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        shot = self._kept.pop(index, None)
        if shot is None:
            shot = Shot.of(self.views[index], self.device)
            self._bytes += _bytes(shot)
        self._kept[index] = shot
        while self._bytes > KEPT_BYTES and len(self._kept) > 1:
            self._bytes -= _bytes(self._kept.popitem(last=False)[1])
        return shot


def _bytes(shot: Shot) -> int:
    return shot.target.image.nbytes + shot.target.weights.nbytes
