"""Sizes of a model, and the three presets."""

from dataclasses import dataclass

from pd4dgs_codec.scene import HEADS, Steps


@dataclass(frozen=True)
class DeformationConfig:
    """Planes and networks of a layer. scales: of the planes, each with its cells along x, y and z, and along time.
    width: of the trunk. heads: names in HEADS."""

    scales: tuple[tuple[int, int], ...]
    channels: int
    width: int
    heads: tuple[str, ...] = tuple(HEADS)

    @property
    def features(self) -> int:
        """Numbers that the planes give at a point."""
        return self.channels * len(self.scales)


#: Quantisation steps of the presets, before the quality dial scales them. The rate of the planes makes them so flat
#: that coarse steps lose nothing.
STEPS = Steps(planes_global=0.2, planes_local=1 / 3)


@dataclass(frozen=True)
class ModelConfig:
    """Both deformations (None: absent), of equal channels and width, and the counts of anchors that training starts
    from and stays below.

    Layer 1 is coarse in time. Layer 2 adds a scale that is finer in it: fast motion needs an instant for four pictures
    or so, but training does not find it with such planes alone.
    """

    global_deformation: DeformationConfig | None
    local_deformation: DeformationConfig | None
    hidden: int = 32
    initial_anchors: int = 20_000
    max_anchors: int = 40_000
    steps: Steps = STEPS

    @property
    def level(self) -> int:
        """The highest level that a model of this kind renders."""
        return 2 if self.local_deformation is not None else 1 if self.global_deformation is not None else 0


PRESETS: dict[str, ModelConfig] = {
    "tiny": ModelConfig(
        DeformationConfig(((16, 16), (32, 16)), 8, 32),
        DeformationConfig(((32, 48),), 8, 32),
        initial_anchors=5_000,
        max_anchors=12_000,
    ),
    "small": ModelConfig(DeformationConfig(((32, 24), (64, 24)), 16, 64), DeformationConfig(((64, 72),), 16, 64)),
    # the grids of the paper: 291,840 and 1,904,640 values; its networks are 128 wide, these 64
    "paper": ModelConfig(
        DeformationConfig(((32, 10), (64, 10)), 16, 64),
        DeformationConfig(((64, 100), (128, 100)), 16, 64),
        initial_anchors=26_000,
        max_anchors=50_000,
    ),
}
