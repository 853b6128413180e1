"""Sizes of a model, and the three presets."""

from __future__ import annotations

from dataclasses import dataclass

from pd4dgs_codec.scene import GLOBAL_HEADS, LOCAL_HEADS, Steps


@dataclass(frozen=True)
class DeformationConfig:
    """A HexPlane and its networks. multires: a factor per scale on `resolution`, that of x, y and z."""

    resolution: int
    time_resolution: int
    channels: int
    multires: tuple[int, ...]
    width: int
    heads: tuple[str, ...]


#: Quantisation steps of the presets, before the quality dial scales them. The rate of the planes makes them so flat
#: that coarse steps lose nothing.
STEPS = Steps(planes_global=0.2, planes_local=1 / 3)


@dataclass(frozen=True)
class ModelConfig:
    """Both deformations (None: absent), and the counts of anchors that training starts from and stays below."""

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


_GLOBAL, _LOCAL = GLOBAL_HEADS, tuple(LOCAL_HEADS)

PRESETS: dict[str, ModelConfig] = {
    "tiny": ModelConfig(
        DeformationConfig(16, 16, 8, (1, 2), 32, _GLOBAL),
        DeformationConfig(24, 24, 8, (1, 2), 32, _LOCAL),
        initial_anchors=5_000,
        max_anchors=12_000,
    ),
    "small": ModelConfig(
        DeformationConfig(32, 24, 16, (1, 2), 64, _GLOBAL),
        DeformationConfig(48, 50, 16, (1, 2), 32, _LOCAL),
    ),
    # the grids of the paper: 291,840 and 1,904,640 values; its networks are 128 wide, these 64
    "paper": ModelConfig(
        DeformationConfig(32, 10, 16, (1, 2), 64, _GLOBAL),
        DeformationConfig(64, 100, 16, (1, 2), 64, _LOCAL),
        initial_anchors=26_000,
        max_anchors=50_000,
    ),
}
