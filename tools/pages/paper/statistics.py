"""Results of several seeds and scenes as one row, and what a difference between two rows is worth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

Result = dict[str, Any]


@dataclass(frozen=True)
class Figure:
    """A figure of a row: its mean over seeds, and how far the seeds lie apart (largest minus smallest).

    Each seed's value is the mean over scenes. spread is None for a single seed.
    """

    mean: float
    spread: float | None
    seeds: tuple[float, ...]

    def text(self, digits: int) -> str:
        """ "mean" or "mean ± half the spread"."""
        if self.spread is None:
            return f"{self.mean:,.{digits}f}"
        return f"{self.mean:,.{digits}f} ± {self.spread / 2:,.{digits}f}"


def figure(results: Sequence[Result], value: Any) -> Figure:
    """value(result) over results: first the mean over the scenes of each seed, then mean and spread over the seeds."""
    by_seed: dict[int, list[float]] = {}
    for result in results:
        by_seed.setdefault(result["seed"], []).append(float(value(result)))
    seeds = tuple(sum(values) / len(values) for _, values in sorted(by_seed.items()))
    spread = max(seeds) - min(seeds) if len(seeds) > 1 else None
    return Figure(sum(seeds) / len(seeds), spread, seeds)


def gain(ours: Figure, other: Figure) -> float | None:
    """Mean over the seeds of ours - other at the same seed, or None where that is smaller than what these differences
    spread (largest minus smallest), so that it says nothing."""
    differences = [a - b for a, b in zip(ours.seeds, other.seeds, strict=True)]
    mean = sum(differences) / len(differences)
    return None if abs(mean) < max(differences) - min(differences) else mean


def top(key: str) -> Any:
    """The figure `key` of a result's highest level."""
    return lambda result: result["levels"][-1][key]


def at_level(level: int, key: str) -> Any:
    """The figure `key` at `level`, or at the highest level below it that the file holds."""
    return lambda result: next(row for row in reversed(result["levels"]) if row["level"] <= level)[key]


def monotone(result: Result) -> bool:
    """Whether the levels gain mPSNR strictly and lose no mSSIM, one after another."""
    levels = result["levels"]
    return all(
        a["mpsnr"] < b["mpsnr"] and a["mssim"] <= b["mssim"] for a, b in zip(levels[:-1], levels[1:], strict=True)
    )
