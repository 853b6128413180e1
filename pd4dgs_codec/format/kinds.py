"""One row per layer: its chunk type, the networks it may carry and the names of its steps.

All numbers here are those of the bitstream.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from pd4dgs_codec.scene import LOCAL_HEADS, TRUNK, Widths


@dataclass(frozen=True)
class LayerKind:
    """A layer of the format.

    name: of its planes and networks, for messages and reports. heads: the outputs per network in a scene of those
    widths (the trunk's are free). network_ids: registry numbers in the layer's chunk, ascending in this order.
    planes_step, weights_step: names of the classes of tensors that share a step; None if the layer has no planes.
    """

    layer: int
    chunk_type: int
    name: str
    heads: Callable[[Widths], dict[str, int]]
    network_ids: dict[str, int]
    weights_step: str
    planes_step: str | None = None

    @property
    def step_names(self) -> tuple[str, ...]:
        """Of the steps in the layer's chunk, in their order there."""
        return (self.weights_step,) if self.planes_step is None else (self.planes_step, self.weights_step)


LAYER_KINDS: tuple[LayerKind, ...] = (
    LayerKind(
        layer=0,
        chunk_type=0,
        name="scaffold",
        heads=lambda widths: widths.networks,
        network_ids={"opacity": 0, "covariance": 1, "color": 2},
        weights_step="weights_scaffold",
    ),
    LayerKind(
        layer=1,
        chunk_type=1,
        name="global_deformation",
        heads=lambda widths: widths.global_heads,
        network_ids={TRUNK: 0, "position": 1, "feature": 2, "offset": 3, "scaling": 4},
        weights_step="weights_global",
        planes_step="planes_global",
    ),
    LayerKind(
        layer=2,
        chunk_type=2,
        name="local_deformation",
        heads=lambda widths: LOCAL_HEADS,
        network_ids={TRUNK: 0, "mean": 1, "scale": 2, "quat": 3, "opacity": 4, "color": 5},
        weights_step="weights_local",
        planes_step="planes_local",
    ),
)

BY_CHUNK_TYPE: dict[int, LayerKind] = {kind.chunk_type: kind for kind in LAYER_KINDS}
