"""One row per layer: its chunk type, the networks it may carry and where its tensors live in Scene and Steps.

All numbers here are those of the bitstream.
"""

from __future__ import annotations

from dataclasses import dataclass

from pd4dgs_codec.scene import FEATURE_DIM, GLOBAL_HEADS, LOCAL_HEADS, SCAFFOLD_NETWORKS, TRUNK

#: Input of the scaffold's networks: feature and view direction.
SCAFFOLD_INPUT = FEATURE_DIM + 3


@dataclass(frozen=True)
class LayerKind:
    """A layer of the format.

    deformation: field of Scene with this layer's Deformation, None for the scaffold. heads: output width per network
    (the trunk's is free). network_ids: registry numbers in the layer's chunk, ascending in this order.
    weights_step, planes_step: fields of Steps.
    """

    layer: int
    chunk_type: int
    deformation: str | None
    heads: dict[str, int]
    network_ids: dict[str, int]
    weights_step: str
    planes_step: str | None


LAYER_KINDS: tuple[LayerKind, ...] = (
    LayerKind(
        layer=0,
        chunk_type=0,
        deformation=None,
        heads=SCAFFOLD_NETWORKS,
        network_ids={"opacity": 0, "covariance": 1, "color": 2},
        weights_step="weights_scaffold",
        planes_step=None,
    ),
    LayerKind(
        layer=1,
        chunk_type=1,
        deformation="global_deformation",
        heads=GLOBAL_HEADS,
        network_ids={TRUNK: 0, "position": 1, "feature": 2, "offset": 3, "scaling": 4},
        weights_step="weights_global",
        planes_step="planes_global",
    ),
    LayerKind(
        layer=2,
        chunk_type=2,
        deformation="local_deformation",
        heads=LOCAL_HEADS,
        network_ids={TRUNK: 0, "mean": 1, "scale": 2, "quat": 3, "opacity": 4, "color": 5},
        weights_step="weights_local",
        planes_step="planes_local",
    ),
)

BY_CHUNK_TYPE: dict[int, LayerKind] = {kind.chunk_type: kind for kind in LAYER_KINDS}
