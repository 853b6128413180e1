"""Figures that the PD-4DGS paper publishes (Dycheck iPhone scenes; ours are other scenes). MB are 1e6 bytes."""

from __future__ import annotations

from typing import NamedTuple

from pd4dgs_codec.bench.latency import PUBLISHED_MEGABYTES


class Comparison(NamedTuple):
    """Averages over seven scenes."""

    method: str
    mpsnr: float
    mssim: float
    mlpips: float
    megabytes: float


class Sampling(NamedTuple):
    """Averages over block, spin and paper-windmill."""

    method: str
    mpsnr: float
    megabytes: float


class Component(NamedTuple):
    """Averages over seven scenes, six without TMC."""

    method: str
    mpsnr: float
    mssim: float
    mlpips: float
    megabytes: float
    tlpips: float


class Level(NamedTuple):
    """Cumulative megabytes."""

    level: int
    mpsnr: float
    mssim: float
    tlpips: float
    megabytes: float


class FirstFrame(NamedTuple):
    """Seconds until the first frame at 2, 10 and 50 Mbps."""

    method: str
    seconds: tuple[float, float, float]

    @property
    def megabytes(self) -> float:
        """What must arrive before it."""
        return PUBLISHED_MEGABYTES[self.method]


FIRST_FRAME = (
    FirstFrame("SC-GS", (929.6, 185.9, 37.2)),
    FirstFrame("Deformable 3DGS", (437.6, 87.5, 17.5)),
    FirstFrame("4DGS", (314.0, 62.8, 12.6)),
    FirstFrame("MoDec-GS", (73.5, 14.7, 2.94)),
    FirstFrame("PD-4DGS, all layers", (27.5, 5.5, 1.10)),
    FirstFrame("PD-4DGS, layer 0", (1.74, 0.35, 0.07)),
)
COMPARISON = (
    Comparison("SC-GS", 13.90, 0.464, 0.479, 232.4),
    Comparison("Deformable 3DGS", 13.72, 0.461, 0.430, 109.4),
    Comparison("4DGS", 13.72, 0.460, 0.509, 78.54),
    Comparison("MoDec-GS", 14.60, 0.480, 0.443, 18.37),
    Comparison("PD-4DGS", 14.54, 0.480, 0.481, 6.88),
)
SAMPLING = (
    Sampling("uniform", 15.01, 7.03),
    Sampling("fixed", 14.94, 7.18),
    Sampling("adaptive", 14.99, 6.98),
)
COMPONENTS = (
    Component("without rate", 14.48, 0.480, 0.475, 7.49, 0.0149),
    Component("without binary", 14.48, 0.480, 0.480, 6.88, 0.0144),
    Component("without smooth", 14.58, 0.481, 0.482, 6.89, 0.0139),
    Component("without tmc", 14.52, 0.488, 0.500, 6.81, 0.0137),
    Component("full", 14.54, 0.480, 0.478, 6.90, 0.0143),
)
LEVELS = (
    Level(0, 14.122, 0.354, 0.0008, 0.436),
    Level(1, 14.175, 0.352, 0.0019, 1.623),
    Level(2, 14.370, 0.339, 0.0143, 6.898),
)
