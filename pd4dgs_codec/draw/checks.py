"""What a rasteriser refuses, whatever holds its numbers; each in one line that says what was found and expected."""

from __future__ import annotations

import math
from collections.abc import Sequence

from pd4dgs_codec.errors import NotFinite, RenderError

MAX_SIDE = 65535  #: pixels
#: Least volume of a viewmat's 3 x 3 part; that of a rotation is 1.
LEAST_VOLUME = 1e-9

Rows = Sequence[Sequence[float]]  #: a matrix


def check_shape(name: str, found: Sequence[int], *shapes: tuple[int | None, ...]) -> None:
    """Raises RenderError unless the shape `found` is one of `shapes`; None in a shape is any size."""
    for shape in shapes:
        if len(found) == len(shape) and all(b is None or a == b for a, b in zip(found, shape, strict=True)):
            return
    expected = " or ".join("[" + ", ".join("*" if b is None else str(b) for b in shape) + "]" for shape in shapes)
    raise RenderError(f"{name} has shape {list(found)}, expected {expected}")


def check_camera(viewmat: Rows, K: Rows, width: int, height: int) -> None:
    """Raises RenderError unless it is a pinhole without skew, of a picture from 1x1 to MAX_SIDE on a side."""
    for name, value in (("width", width), ("height", height)):
        if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= MAX_SIDE:
            raise RenderError(f"{name} is {value!r}, expected an integer from 1 to {MAX_SIDE}")
    if not all(math.isfinite(v) for row in [*viewmat, *K] for v in row):
        raise RenderError("viewmats or Ks has a value that is not finite")
    if [*viewmat[3]] != [0.0, 0.0, 0.0, 1.0]:
        raise RenderError(f"the last row of a viewmat is {viewmat[3]}, expected [0, 0, 0, 1]")
    (a, b, c), (d, e, f), (g, h, i) = (row[:3] for row in viewmat[:3])
    if not abs(a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)) >= LEAST_VOLUME:
        raise RenderError(
            f"a viewmat of {[list(row[:3]) for row in viewmat[:3]]} flattens the scene, expected a rotation"
        )
    if [K[0][1], K[1][0], *K[2]] != [0.0, 0.0, 0.0, 0.0, 1.0]:
        raise RenderError(f"a matrix in Ks is {K}, expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] (no skew)")
    if not (K[0][0] > 0 and K[1][1] > 0):
        raise RenderError(f"focal lengths {K[0][0]} and {K[1][1]} in Ks, expected both positive")


def check_time(t: float) -> None:
    """Raises RenderError unless a normalised time is a number; beyond 0..1 a scene stands as at its ends."""
    if not math.isfinite(t):
        raise RenderError(f"time is {t}, expected a number from 0 to 1")


def check_limits(near_plane: float, far_plane: float, eps2d: float, radius_clip: float) -> None:
    """Raises RenderError unless they are numbers that a rasteriser can work with."""
    if not 0 <= near_plane < far_plane:
        raise RenderError(f"near_plane {near_plane} and far_plane {far_plane}: expected 0 <= near < far")
    if not (0 <= eps2d < math.inf and 0 <= radius_clip < math.inf):
        raise RenderError(f"eps2d {eps2d} and radius_clip {radius_clip}: expected finite and not negative")


def check_colours(name: str, total: float) -> None:
    """Raises NotFinite if the sum of the colours `name` is not finite."""
    if not math.isfinite(total):
        raise NotFinite(f"{name} has a value that is not finite, or their sum overflows")
