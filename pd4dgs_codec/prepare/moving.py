"""Features that lie on moving things, told by epipolar residuals: a camera's poses explain where what stands still may
be seen again, and what moves is seen elsewhere, time after time.

Motion along the epipolar line is not seen this way. Nothing is learnt from elsewhere: there are no weights.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

#: A match is off if its Sampson distance is above this, pixels of a picture 1000 wide. One with a wide margin.
OFF = 4.0
#: A verdict takes so many matches, most of them off. One wrong match says nothing.
LEAST_MATCHES, MOVING_SHARE = 3, 0.6
#: Neighbours within this share of the picture's width have a say too.
REACH = 0.03


@dataclass
class Verdicts:
    """Counts over pairs for the features of one picture. places: float64 [n, 2], pixels; matched and off: int64 [n]."""

    places: np.ndarray
    matched: np.ndarray = field(init=False)
    off: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        self.matched = np.zeros(len(self.places), np.int64)
        self.off = np.zeros(len(self.places), np.int64)

    @property
    def known(self) -> np.ndarray:
        """bool [n]: the feature has matches enough for a verdict of its own."""
        return np.asarray(self.matched >= LEAST_MATCHES)

    def moving(self, width: int) -> np.ndarray:
        """bool [n]: most of what is known of the feature and of those around it says that it moves."""
        known = self.known
        votes = np.where(self.off >= MOVING_SHARE * self.matched, 1, -1)[known]
        result = np.zeros(len(self.places), bool)
        if not (votes > 0).any():
            return result
        told = self.places[known]
        for start in range(0, len(self.places), 512):
            part = slice(start, start + 512)
            gaps = ((self.places[part, None] - told) ** 2).sum(axis=2)
            result[part] = ((gaps <= (REACH * width) ** 2) @ votes) > 0
        return result


def sampson(a: np.ndarray, b: np.ndarray, relative: np.ndarray) -> np.ndarray:
    """Sampson distance float64 [n] of matches a, b [n, 2] in normalised coordinates (Hartley and Zisserman, 11.4.3).

    relative: float64 [3, 4], from the first camera to the second. The unit is that of the coordinates.
    """
    t = relative[:, 3]
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    essential = cross @ relative[:, :3]
    ha, hb = (np.concatenate([p, np.ones((len(p), 1))], axis=1) for p in (a, b))
    line_b, line_a = ha @ essential.T, hb @ essential
    error = np.abs((hb * line_b).sum(axis=1))
    slope = np.sqrt((line_b[:, :2] ** 2).sum(axis=1) + (line_a[:, :2] ** 2).sum(axis=1))
    return np.asarray(np.where(slope > 1e-12, error / np.where(slope > 1e-12, slope, 1), 0.0))


def count_off(
    verdicts: dict[int, Verdicts],
    normalised: dict[int, np.ndarray],
    poses: dict[int, np.ndarray],
    focal: float,
    width: int,
    matches: Iterable[tuple[int, int, np.ndarray]],
) -> None:
    """Counts for each feature how many of its matches are off.

    normalised: float64 [n, 2] per picture, undistorted; poses: float64 [3, 4] per picture, world to camera; focal and
    width: pixels; matches: (picture, picture, int [m, 2] indices of features).
    """
    for first, second, index in matches:
        if first not in poses or second not in poses or not len(index):
            continue
        rotation = poses[second][:, :3] @ poses[first][:, :3].T
        shift = poses[second][:, 3] - rotation @ poses[first][:, 3]
        a, b = normalised[first][index[:, 0]], normalised[second][index[:, 1]]
        off = sampson(a, b, np.column_stack([rotation, shift])) * focal > OFF * width / 1000
        for picture, column in ((first, 0), (second, 1)):
            np.add.at(verdicts[picture].matched, index[:, column], 1)
            np.add.at(verdicts[picture].off, index[:, column], off)
