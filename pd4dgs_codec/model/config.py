"""Sizes of a model, and the three presets."""

from __future__ import annotations

from dataclasses import dataclass

from pd4dgs_codec.scene import HEADS, Steps


@dataclass(frozen=True)
class DeformationConfig:
    """Planes and networks of a layer. multires: a factor per scale on `resolution`, that of x, y and z. heads: names in
    HEADS."""

    resolution: int
    time_resolution: int
    channels: int
    width: int
    multires: tuple[int, ...] = (1,)
    heads: tuple[str, ...] = tuple(HEADS)


#: Quantisation steps of the presets, before the quality dial scales them. The rate of the planes makes them so flat
#: that coarse steps lose nothing.
STEPS = Steps(planes_global=0.2, planes_local=1 / 3)


@dataclass(frozen=True)
class ModelConfig:
    """Both deformations (None: absent), of equally many channels, and the counts of anchors that training starts from
    and stays below. That of layer 1 is coarse, that of layer 2 fine in space and above all in time: what moves fast
    needs an instant for each four pictures, and finds its motion sooner where the coarse planes are there as well."""

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
        DeformationConfig(16, 16, 8, 32),
        DeformationConfig(32, 48, 8, 32),
        initial_anchors=5_000,
        max_anchors=12_000,
    ),
    "small": ModelConfig(DeformationConfig(32, 24, 16, 64), DeformationConfig(64, 72, 16, 64)),
    # the grids of the paper: 291,840 and 1,904,640 values; its networks are 128 wide, these 64
    "paper": ModelConfig(
        DeformationConfig(32, 10, 16, 64, (1, 2)),
        DeformationConfig(64, 100, 16, 64, (1, 2)),
        initial_anchors=26_000,
        max_anchors=50_000,
    ),
}
