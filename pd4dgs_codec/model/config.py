"""Sizes of a model, and the three presets."""

from dataclasses import dataclass

from pd4dgs_codec.scene import HEADS, Steps


@dataclass(frozen=True)
class DeformationConfig:
    """Sizes of a deformation. scales: per scale of the planes, cells along each of x, y, z, and along time. channels:
    of each plane. width: of the trunk. heads: names in HEADS."""

    scales: tuple[tuple[int, int], ...]
    channels: int
    width: int
    heads: tuple[str, ...] = tuple(HEADS)

    @property
    def features(self) -> int:
        """Width of the planes' features at a point."""
        return self.channels * len(self.scales)


#: Quantisation steps of the presets, before they are scaled for a quality. Training with a rate makes the planes so
#: flat that coarse steps lose nothing.
STEPS = Steps(planes_global=0.2, planes_local=1 / 3)


@dataclass(frozen=True)
class ModelConfig:
    """Sizes of a model. The deformations (None: absent) have equal channels and width. Training starts with
    initial_anchors and keeps at most max_anchors. iterations: of a run that is given neither a number nor a time limit.

    Layer 1 is coarse in time, layer 2 adds a finer scale: fast motion needs an instant for about every four pictures,
    but training does not find the motion with fine planes alone.
    """

    global_deformation: DeformationConfig | None
    local_deformation: DeformationConfig | None
    hidden: int = 32
    initial_anchors: int = 20_000
    max_anchors: int = 40_000
    iterations: int = 10_000
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
        iterations=3_000,
    ),
    "small": ModelConfig(DeformationConfig(((32, 24), (64, 24)), 16, 64), DeformationConfig(((64, 72),), 16, 64)),
    # the grids of the paper: 291,840 and 1,904,640 values; its networks are 128 wide, these 64
    "paper": ModelConfig(
        DeformationConfig(((32, 10), (64, 10)), 16, 64),
        DeformationConfig(((64, 100), (128, 100)), 16, 64),
        initial_anchors=26_000,
        max_anchors=50_000,
        iterations=15_000,
    ),
}
