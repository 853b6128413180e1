"""What a file does without, and about what it would have cost."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pd4dgs_codec.format.kinds import LayerKind
from pd4dgs_codec.format.options import EncodeOptions
from pd4dgs_codec.format.payload import write_layer
from pd4dgs_codec.format.symbols import LayerSymbols, layer_steps, quantise_tensors
from pd4dgs_codec.scene import Deformation, Steps, Widths


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Something that was not written. What it would have cost: `tensors` is coded to see; else that of `anchors`
    average anchors; else `bits`, the order-0 entropy that went. lossless: no picture changes."""

    what: str
    why: str
    kind: LayerKind | None = None
    tensors: Deformation | None = None
    anchors: int = 0
    bits: float = 0.0
    lossless: bool = False

    def row(self, steps: Steps, options: EncodeOptions, kept: int, kept_bits: int) -> dict[str, Any]:
        """{what, why, lossless, bytes} for the report of a file whose `kept` anchors took kept_bits, 0 if none."""
        if self.anchors:
            cost = self.anchors * kept_bits / 8 / kept if kept else 0
        elif self.tensors is not None and self.kind is not None:
            cost = tensor_bytes(self.tensors, self.kind, steps, options)
        else:
            cost = self.bits / 8
        return {"what": self.what, "why": self.why, "lossless": self.lossless, "bytes": round(cost)}


def tensor_bytes(tensors: Deformation, kind: LayerKind, steps: Steps, options: EncodeOptions) -> int:
    """What planes and networks alone would take as the layer of `kind`."""
    tensors = quantise_tensors(tensors, kind, steps)
    empty = np.zeros(0, np.int32)
    alone = LayerSymbols(
        kind=kind,
        widths=Widths(),  # of no anchors
        anchor_q=np.zeros((0, 3), np.int32),
        mask_increase=empty,
        mask_own=empty,
        classes=empty,
        attributes=np.zeros((0, 0), np.int32),
        planes=tensors.planes,
        networks=tensors.networks,
        steps=layer_steps(steps, kind),
    )
    return len(write_layer(alone, options)[0])
