"""Fits the motion of many Gaussians: bases over time, and a coefficient of each Gaussian and basis.

The principal components of what changes, weighted by what pictures depend on, become bases over time. A component stays
while it lowers the error by more than its bits are worth.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pd4dgs_codec.format.registry import MAX_CHANNELS
from pd4dgs_codec.interchange.pack import Grid
from pd4dgs_codec.kinds.tracks import Head, Tracks

BASIS_STEP = 2.0**-10  #: of all grids; bases are scaled to it
COARSEST = 0.05  #: the largest step of bases, whose mean square over time is 1
BITS = 6  #: about those of a basis at an instant
BIT = 2 * np.log(2)  #: what a bit is worth, in units of the error that a scalar may add
MOST_BASES = 80  #: of a head, if the format allows so many channels
STRAIGHT = 0.05  #: the share of the allowed error that left-out instants may add
STATIC = 1e-12  #: the least share of a picture's squared error for which anything changes


@dataclass(frozen=True, eq=False)
class Change:
    """How a head changes. values: float32 [n, c T], n Gaussians at T instants, c components. weights: float64 [n],
    `pack.sensitivity`. vectors: float64 [c T, K], its principal components, with mean squares over time of 1.
    energies: float64 [K], squared errors of pictures without each, falling."""

    values: np.ndarray
    weights: np.ndarray
    components: int
    vectors: np.ndarray
    energies: np.ndarray

    @staticmethod
    def of(values: np.ndarray, weights: np.ndarray) -> Change | None:
        """Analyses values float32 [n, c, T], which are 0 at the key instant; returns None if nothing changes."""
        _, components, instants = values.shape
        values = values.reshape(len(values), -1)
        scaled = values * np.sqrt(weights / instants)[:, None].astype(np.float32)
        energies, vectors = np.linalg.eigh((scaled.T @ scaled).astype(np.float64))
        order = np.argsort(-energies)[: min(MOST_BASES, MAX_CHANNELS // components)]
        order = order[energies[order] > max(STATIC, 1e-7 * energies.max())]
        found = vectors[:, order] * np.sqrt(instants)
        return Change(values, weights, components, found, energies[order]) if len(order) else None

    @property
    def instants(self) -> int:
        return len(self.vectors) // self.components

    def gains(self, theta: float) -> np.ndarray:
        """Returns by how much each component lowers the error, less what its bits are worth, float64 [K]."""
        added = self.weights[:, None] * np.square(self.values @ (self.vectors / self.instants))
        bits = bits_of(added, theta).sum(axis=0) + BITS * len(self.vectors)
        return np.asarray(np.maximum(added - theta, 0).sum(axis=0) - BIT * theta * bits)


def bits_of(added: np.ndarray, theta: float) -> np.ndarray:
    """Returns about the bits of scalars that would add so much to the error if they were 0."""
    return np.asarray(0.5 * np.log2(1 + added / theta))


def knots(paths: np.ndarray, times: np.ndarray, key: int, allowed: float) -> np.ndarray:
    """Returns the instants that are kept, int64: the ends, the key, and those at which straight lines between the
    others are farthest off, until the squares of what is left, summed over paths [any, T], are at most `allowed`."""
    found = sorted({0, key, len(times) - 1})
    while len(found) < len(times):
        off = np.square(between(times[found], paths[:, found], times) - paths).sum(axis=0)
        if off.max() <= allowed:
            break
        spans = np.split(np.arange(len(times)), found[1:-1])
        found = sorted({*found, *(int(span[off[span].argmax()]) for span in spans if off[span].max() > allowed)})
    return np.array(found)


def between(known: np.ndarray, values: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Interpolates values [.., known] linearly at times [T]: [.., T]."""
    j = np.clip(np.searchsorted(known, times, side="right") - 1, 0, len(known) - 2)
    f = (times - known[j]) / (known[j + 1] - known[j])
    return np.asarray(values[..., j] * (1 - f) + values[..., j + 1] * f)


def layer(
    changes: Mapping[str, Change],
    chosen: Mapping[str, np.ndarray],
    grid: Grid,
    times: np.ndarray,
    key: int,
    allowed: float,
) -> tuple[Tracks, dict[str, np.ndarray]]:
    """Returns (the tracks of a layer, what they add, float32 [n, c T] at all instants by head).

    chosen: components by head. times: float64 [T], normalised; key: the key instant. allowed: the squared error that
    leaving out instants may add.
    """
    paths = [changes[name].vectors[:, own] * np.sqrt(changes[name].energies[own]) for name, own in chosen.items()]
    kept = knots(np.concatenate([path.T.reshape(-1, len(times)) for path in paths]), times, key, allowed)
    heads, added = {}, {}
    for name, own in chosen.items():
        change = changes[name]
        fine = min(np.sqrt(12 * grid.theta * len(times) / change.energies[own].max()), COARSEST)  # step of bases
        scale = BASIS_STEP / fine
        exact = change.vectors[:, own].T.reshape(len(own), change.components, -1)[:, :, kept]
        bases = (np.rint(exact / fine) * BASIS_STEP).astype(np.float32)
        whole = between(times[kept], bases.astype(np.float64), times).reshape(len(own), -1)
        step = float(np.float32(grid.steps[name] / scale))
        coefficients = grid.rounded(change.values @ np.linalg.pinv(whole), step, change.weights * scale**2)
        heads[name] = Head(bases, coefficients, step)
        added[name] = (coefficients @ whole).astype(np.float32)
    return Tracks.of(times[kept], BASIS_STEP, heads), added
