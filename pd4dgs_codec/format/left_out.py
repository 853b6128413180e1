"""Parts of a scene that a file leaves out, and about the bytes that they would have taken."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pd4dgs_codec.format.deformation import layer_steps, quantise_tensors
from pd4dgs_codec.format.kinds import LayerKind
from pd4dgs_codec.format.options import EncodeOptions
from pd4dgs_codec.format.payload import write_layer
from pd4dgs_codec.format.symbols import LayerSymbols
from pd4dgs_codec.scene import Deformation, Steps, Widths


@dataclass(frozen=True, eq=False)
class LeftOut:
    """A part that was not written. Its cost is found by coding `tensors`, else is that of `anchors` average anchors,
    else `bits`, the order-0 entropy that was saved. lossless: no picture changes."""

    what: str
    why: str
    kind: LayerKind | None = None
    tensors: Deformation | None = None
    anchors: int = 0
    bits: float = 0.0
    lossless: bool = False

    def row(self, steps: Steps, options: EncodeOptions, kept: int, kept_bits: int) -> dict[str, Any]:
        """{what, why, lossless, bytes} for the report of a file whose `kept` anchors took kept_bits bits."""
        if self.anchors:
            cost = self.anchors * kept_bits / 8 / kept if kept else 0
        elif self.tensors is not None and self.kind is not None:
            cost = tensor_bytes(self.tensors, self.kind, steps, options)
        else:
            cost = self.bits / 8
        return {"what": self.what, "why": self.why, "lossless": self.lossless, "bytes": round(cost)}


def tensor_bytes(tensors: Deformation, kind: LayerKind, steps: Steps, options: EncodeOptions) -> int:
    """Bytes of planes and networks as a layer without anchors."""
    empty = np.zeros(0, np.int32)
    alone = LayerSymbols(
        kind=kind,
        widths=Widths(),
        anchor_q=np.zeros((0, 3), np.int32),
        mask_increase=empty,
        mask_own=empty,
        classes=empty,
        attributes=np.zeros((0, 0), np.int32),
        tensors=quantise_tensors(tensors, kind, steps),
        steps=layer_steps(steps, kind, tensors),
    )
    return len(write_layer(alone, options)[0])
