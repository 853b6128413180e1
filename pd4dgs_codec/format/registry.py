"""Registries of the bitstream's layers and sections, and its limits."""

from dataclasses import dataclass
from enum import IntEnum

from pd4dgs_codec.scene import HEADS, SCAFFOLD_NETWORKS, TRUNK, Widths


@dataclass(frozen=True)
class LayerKind:
    """A layer of the format. layer: its number, which is also its chunk type.

    name: of its planes and networks, in messages and reports. weights_step, planes_step: the fields of Steps that it
    uses; planes_step is None if the layer has no planes.
    """

    layer: int
    name: str
    weights_step: str
    planes_step: str | None = None

    @property
    def network_ids(self) -> dict[str, int]:
        """Numbers of the layer's networks in the bitstream, ascending: the order of the tables in `scene`."""
        names = (TRUNK, *HEADS) if self.layer else SCAFFOLD_NETWORKS
        return {name: number for number, name in enumerate(names)}

    def heads(self, widths: Widths) -> dict[str, int]:
        """Output width of each network but the trunk, whose width is free."""
        return widths.heads if self.layer else widths.networks

    @property
    def step_names(self) -> tuple[str, ...]:
        """The steps in the layer's chunk, in their order there."""
        return (self.weights_step,) if self.planes_step is None else (self.planes_step, self.weights_step)


LAYER_KINDS: tuple[LayerKind, ...] = (
    LayerKind(0, "scaffold", "weights_scaffold"),
    LayerKind(1, "global_deformation", "weights_global", "planes_global"),
    LayerKind(2, "local_deformation", "weights_local", "planes_local"),
)

BY_CHUNK_TYPE: dict[int, LayerKind] = {kind.layer: kind for kind in LAYER_KINDS}


class Section(IntEnum):
    """Parts of a payload, in order (clause 6.4). A section without symbols is absent. In mode lzma, SYMBOLS replaces
    the four sections before it."""

    POSITIONS = 0
    MASKS = 1
    ATTRIBUTES = 2
    PLANES = 3
    WEIGHTS = 4
    SYMBOLS = 5


# Limits (clause 14). A reader checks every declared count against them before it allocates.

MAX_HEADER = 1 << 14  #: bytes; the longest chunk list takes two thirds of it
MAX_PARAMETERS = 4096  #: bytes of a layer's parameters; msgpack takes up to 130 times its bytes in memory
MAX_CHUNKS = 1024  #: slices of layers and ancillary chunks; a slice's number takes ten bits
MAX_PAYLOAD = (1 << 31) - 1  #: bytes in one chunk; fits a signed 32-bit size on every platform
MAX_DEPTH = 4  #: nested maps and lists in canonical msgpack
MAX_ANCHORS = 1 << 24  #: rows over all layers; 68 int32 columns of them are 4.6 GB
