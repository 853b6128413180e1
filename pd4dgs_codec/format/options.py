"""Options of the encoder with their defaults and checks, also for the commands.

Imports neither numpy nor torch, so that `--help` answers at once.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from pd4dgs_codec.entropy import EFFORTS, PRIORS
from pd4dgs_codec.errors import EncodeError

if TYPE_CHECKING:
    from pd4dgs_codec.scene import S

#: How symbols are coded, with the numbers of the header.
MODES = {"ans": 0, "lzma": 1}

#: Allowed values by field of EncodeOptions.
CHOICES: Mapping[str, Sequence[str | int]] = {
    "mode": tuple(MODES),
    "priors": PRIORS,
    "layers": ("auto", 0, 1, 2),
    "effort": EFFORTS,
    "omit": ("lossless", "nothing"),
}

#: Least bytes of a slice: its frame and parameters take some 50 bytes, and each channel names a prior.
LEAST_SLICE = 1000


@dataclass(frozen=True)
class EncodeOptions:
    """Options of the encoder. Raises EncodeError for an invalid value.

    mode: "ans", or "lzma" for the same symbols under LZMA2. priors: "best", or "gauss", the model of R(a). layers:
    "auto" leaves out every layer without a head; 0, 1 or 2 keeps the layers up to that number. Heads that are zero
    after quantisation and anchors below the mask threshold are always left out. effort: 1 (fast) .. 9 (small). omit:
    "lossless" gives plane cells that no anchor reads values of little cost, "nothing" does not.
    step_scale: factor on every quantisation step. slices: most bytes of a slice, where planes and networks allow it,
    the header counted with the first slice; 0 for one slice per layer. verify: check the error of every value, decode
    the result and compare every symbol.
    """

    mode: str = "ans"
    priors: str = "best"
    layers: str | int = "auto"
    effort: int = 5
    omit: str = "lossless"
    step_scale: float = 1.0
    slices: int = 0
    verify: bool = True

    def __post_init__(self) -> None:
        for name, allowed in CHOICES.items():
            value = vars(self)[name]
            if value not in allowed:
                raise EncodeError(f"{name} {value!r}, expected one of {list(allowed)}")
        if not 0 < self.step_scale < math.inf:
            raise EncodeError(f"step_scale {self.step_scale!r}, expected a positive number")
        if self.slices and self.slices < LEAST_SLICE:
            raise EncodeError(f"slices of {self.slices} bytes, expected 0 or at least {LEAST_SLICE}")
        if self.slices and self.mode != "ans":
            raise EncodeError(f"slices in mode {self.mode}, expected mode ans or one slice per layer")

    def apply_scale(self, scene: S) -> tuple[S, EncodeOptions]:
        """Returns (`scene` with its steps scaled and rounded to binary32, these options with step_scale 1)."""
        return scene.scaled(self.step_scale), replace(self, step_scale=1.0)


DEFAULTS = EncodeOptions()
