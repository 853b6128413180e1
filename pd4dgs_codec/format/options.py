"""How a scene becomes a file: every choice with its default and its check. The commands read theirs from here.

Of libraries only the standard one is imported here, so that `--help` answers at once.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from pd4dgs_codec.entropy import EFFORTS, PRIORS
from pd4dgs_codec.errors import EncodeError

if TYPE_CHECKING:
    from pd4dgs_codec.scene import Scene

#: How symbols are coded, with the numbers of the header.
MODES = {"ans": 0, "lzma": 1}

#: What may be chosen, by field of EncodeOptions.
CHOICES: Mapping[str, Sequence[str | int]] = {
    "mode": tuple(MODES),
    "priors": PRIORS,
    "layers": ("auto", 0, 1, 2),
    "effort": EFFORTS,
    "omit": ("bounded", "lossless", "nothing"),
}


#: A slice's frame and parameters take some 50 bytes, and its channels name a prior each.
LEAST_SLICE = 1000


@dataclass(frozen=True)
class EncodeOptions:
    """Options of the encoder. Raises EncodeError for a value that is none.

    mode: "ans", or "lzma" for the same symbols under LZMA2. priors: "best", or "gauss", the model of R(a). layers:
    "auto" leaves out every head that is zero after quantisation or below the bounds of `heads`, then every layer
    without one; 0, 1 or 2 keeps the layers up to that number and only drops heads that are exactly zero. effort:
    1 (fast) .. 9 (small). omit:
    "bounded" leaves out what those bounds allow and what changes no picture, "lossless" only the latter, "nothing" only
    heads that are exactly zero and anchors below the mask threshold. step_scale multiplies every quantisation step.
    slices: bytes that a slice of a layer takes at most where its planes and networks allow it, the header counted with
    the first; 0 for one slice per layer.
    verify: decode the result, compare every symbol and every float, and hold every float against the error bound in the
    header.
    """

    mode: str = "ans"
    priors: str = "best"
    layers: str | int = "auto"
    effort: int = 5
    omit: str = "bounded"
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
            raise EncodeError(f"slices of {self.slices} bytes, expected 0 or {LEAST_SLICE} and more")
        if self.slices and self.mode != "ans":
            raise EncodeError(f"slices in mode {self.mode}, expected mode ans or one slice per layer")

    def apply_scale(self, scene: Scene) -> tuple[Scene, EncodeOptions]:
        """(`scene` at the steps of its file, binary32, and options that scale them no more)."""
        return replace(scene, steps=scene.steps.scaled(self.step_scale)), replace(self, step_scale=1.0)


DEFAULTS = EncodeOptions()
