"""Channels split into classes of places (clauses 8.5 to 8.7), each with its own prior.

A place is an anchor or a cell of a plane. Anchors have step classes. The residuals of one cell tend to be large
together, so the channels of a plane are split by the *activity* of the channels before. All arithmetic is on integers.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

CLASSES = 8  #: of the cells of a plane by their activity
EXACT = 1 << 53  #: binary64 holds every integer up to here


@dataclass(frozen=True, eq=False)
class Places:
    """The places of a channel's symbols in coding order: by class, then ascending.

    order: int64 [n], or slice(None) for the order as it is. sizes: number of places in each class.
    """

    order: np.ndarray | slice
    sizes: tuple[int, ...]

    @staticmethod
    def whole(n: int) -> Places:
        """Returns all n places in one class."""
        return Places(slice(None), (n,))

    @staticmethod
    def by(classes: np.ndarray, count: int) -> Places:
        """Returns places by classes int [n] in 0..count-1, with count below 256; classes may be empty."""
        classes = classes.astype(np.uint8, copy=False)  # numpy sorts bytes by counting
        sizes = tuple(np.bincount(classes, minlength=count).tolist())
        return Places(np.argsort(classes, kind="stable"), sizes)

    def parts(self, channels: np.ndarray) -> Iterator[np.ndarray]:
        """Yields the coded parts of channels [m, n]: for each channel in turn, each class."""
        for channel in channels:
            ordered, end = channel[self.order], 0
            for size in self.sizes:
                yield ordered[end : end + size]
                end += size

    def put(self, coded: np.ndarray, channels: np.ndarray) -> None:
        """Writes the concatenated `parts` back into channels [m, n]."""
        rows = coded.reshape(len(channels), -1)
        if isinstance(self.order, slice):
            channels[:, self.order] = rows
            return
        rank = np.empty(channels.shape[1], np.int64)  # gathering by rank beats scattering by order
        rank[self.order] = np.arange(len(self.order))
        for symbols, channel in zip(rows, channels, strict=True):
            channel[:] = symbols.take(rank)


def relative_magnitude(residuals: np.ndarray) -> np.ndarray:
    """Returns, at each of n places, the sum over channels int [m, n] of the magnitudes relative to their channel's
    mean, in units of 1/256: integers below 2^8 m n in float64 [n]."""
    total, unit = np.zeros(residuals.shape[1]), residuals.shape[1] << 8
    for channel in residuals:
        shares = np.abs(channel.astype(np.float64))
        divisor = shares.sum() + 1  # below 2^53
        if int(shares.max(initial=0)) * unit < EXACT:
            # for integers below 2^53 the rounded quotient has the right floor, and floats divide faster
            shares *= unit
            shares /= divisor
            total += np.floor(shares, out=shares)
        else:
            total += shares.astype(np.int64) * unit // int(divisor)
    return total


def activity_classes(activity: np.ndarray) -> np.ndarray:
    """Returns classes uint8 [n], 0..CLASSES-1, of about equal size of places by their activity [n]."""
    at = np.arange(1, CLASSES) * len(activity) // CLASSES
    classes = np.zeros(len(activity), np.uint8)
    for bound in np.sort(activity)[at]:  # sort takes a tenth of the time of np.partition; a search of 7, several times
        classes += (activity >= bound).view(np.uint8)
    return classes
