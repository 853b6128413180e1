"""Which anchors and Gaussians are evaluated at all: the same for the torch model and for `playback`."""

from __future__ import annotations

import math

from pd4dgs_codec.draw.projection import ALPHA_MIN
from pd4dgs_codec.errors import RenderError
from pd4dgs_codec.scene import SceneInfo

#: A Gaussian fainter than the rasteriser's threshold never reaches a pixel, so its networks are not evaluated.
MIN_OPACITY = ALPHA_MIN
#: How far an anchor's Gaussians are taken to lie from it, in its largest extent: in trained scenes one anchor in 7,000
#: has one farther away.
OFFSET_REACH = 2.0
#: How far a Gaussian of opacity 1 reaches, in its largest standard deviation: to where alpha is ALPHA_MIN, at
#: sqrt(2 ln 255) = 3.3290.
SIGMA_REACH = 3.33
#: Anchors farther outside the image than this share of its size (plus what their Gaussians reach) are not evaluated.
FRUSTUM_MARGIN = 0.15
#: Nearer than this nothing is drawn, whatever a scene says, scene units: the rasteriser divides by depths.
LEAST_NEAR = 1e-6


def near_plane(info: SceneInfo) -> float:
    """That of a scene's pictures, scene units."""
    return max(float(info.near), LEAST_NEAR)


def check_time(t: float) -> None:
    """Raises RenderError unless a normalised time is a number; outside 0..1 a scene stands as at its ends."""
    if not math.isfinite(t):
        raise RenderError(f"time is {t}, expected a number from 0 to 1")
