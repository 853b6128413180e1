"""First-frame times that the PD-4DGS paper publishes (Dycheck iPhone scenes). MB are 1e6 bytes."""

from __future__ import annotations

from typing import NamedTuple


class FirstFrame(NamedTuple):
    """Seconds until the first frame at 2, 10 and 50 Mbps."""

    method: str
    seconds: tuple[float, float, float]
    megabytes: float


FIRST_FRAME = (
    FirstFrame("SC-GS", (929.6, 185.9, 37.2), 232.4),
    FirstFrame("Deformable 3DGS", (437.6, 87.5, 17.5), 109.4),
    FirstFrame("4DGS", (314.0, 62.8, 12.6), 78.5),
    FirstFrame("MoDec-GS", (73.5, 14.7, 2.94), 18.37),
    FirstFrame("PD-4DGS, all layers", (27.5, 5.5, 1.10), 6.88),
    FirstFrame("PD-4DGS, layer 0", (1.74, 0.35, 0.07), 0.436),
)
