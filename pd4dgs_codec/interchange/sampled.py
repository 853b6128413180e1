"""Samples a model of another program at instants, so that each Gaussian keeps its row over time.

Runs, functions and polynomials know all times: they are sampled where a straight line between two samples would be
wrong. A folder of frames has a stable order if a row's next Gaussian is, more often than not, the one that most
resembles it. Without such an order, Gaussians of neighbouring frames are matched where each is the other's nearest in
space and colour. A row is then a chain of matches, and is shown only in its own frames: it has a window.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from pd4dgs_codec.draw.simd import kernel
from pd4dgs_codec.errors import DamageWarning, DataError
from pd4dgs_codec.format.registry import MAX_SIDE
from pd4dgs_codec.interchange.splats import evenly
from pd4dgs_codec.interchange.teacher import GOLDEN, Teacher, spread
from pd4dgs_codec.kinds.splats import MAX_DEGREE, Splats, unit, visible
from pd4dgs_codec.threads import together

MOST_NUMBERS = 1 << 29  #: numbers of all samples, which take 2 GiB
NUMBERS = 14  #: of a Gaussian that may change over time: all but harmonics
#: Samples of a model that knows all times: at first, and at most.
FIRST, MOST = 9, 257
#: A straight line is wrong if Gaussians lie beside it by this share of their size, or change by it, on average.
STRAIGHT = 0.02
SEEN = 0.05  #: the least opacity of Gaussians that count for this
#: Gaussians whose order is checked, triples of frames, and the rank up to which a Gaussian resembles its row.
ROWS, TRIPLES, RANK = 200, 6, 2
#: Matches are nearer than so many median distances between neighbours, and than so much in colour and in logarithms of
#: sizes.
REACH, HUE, GROWTH = 3.0, 0.2, 1.0
SHARP = 1e-3  #: the share of a frame in which a window of matched Gaussians ends
MOVES = 0.02  #: Gaussians are static if they move by less than this share of their size, and change by less than it

#: Pictures that show a Gaussian before it counts as one that no view needs, and how many are added for that, at most.
LOOKS, MOST_LOOKS = 4, 1024
LATE = 0.9  #: half widths after its centre at which a window is looked at: it is still open

Step = Callable[[], None]


@dataclass(frozen=True, eq=False)
class Sampled:
    """n Gaussians at T instants.

    times: float64 [T], from 0 to 1, or [0] if nothing moves. means, quats, scales: float32 [T, n, ..]; opacities [T, n]
    without windows; colors [T, n, 3], the constants of the harmonics. rest: float32 [n, J - 1, 3], the other harmonics.
    windows: float32 [n, 3], centre, half width and softness in normalised time, or None. order: how rows were found, in
    words. matched: the share of the Gaussians of all frames that are rows of the frame before, 1 if the order is known.
    """

    times: np.ndarray
    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    colors: np.ndarray
    rest: np.ndarray
    windows: np.ndarray | None
    order: str
    matched: float = 1.0

    def frame(self, i: int, *, bare: bool = True) -> Splats:
        """Returns the Gaussians at instant i; bare: without their windows."""
        return self.near(self.times[i], bare=bare)

    def near(self, t: float, *, bare: bool = False) -> Splats:
        """Returns the Gaussians at the instant nearest to time t, through their windows at t."""
        i = int(np.abs(self.times - t).argmin())
        shown = np.float32(1) if bare or self.windows is None else visible(self.windows, t)
        sh = np.concatenate([self.colors[i][:, None], self.rest], axis=1)
        return Splats(self.means[i], self.quats[i], self.scales[i], self.opacities[i] * shown, sh)

    def looks(self, count: int) -> tuple[list[float], np.ndarray]:
        """Returns (times of pictures that see each Gaussian while it is shown: of `count`, spread over the instants,
        and then further ones; the Gaussians, bool [n], that LOOKS of the `count` show, if there are so many)."""
        last, windows = len(self.times) - 1, self.windows
        found = [float(self.times[round(t * last)]) for t in spread(count)]
        peak = self.opacities.max(axis=0)
        bright = self.opacities >= np.maximum(peak / 2, SEEN)
        end, other = self.times[last - bright[::-1].argmax(axis=0)], peak < SEEN
        if windows is not None:
            center, half, softness = windows.T
            other |= (center - half - softness > 1) | (center + half + softness < 0)
            end = np.clip(center + LATE * half, 0, 1)

        def shows(t: float) -> np.ndarray:
            i = np.abs(self.times - t).argmin()
            return np.asarray(bright[i] if windows is None else visible(windows, t) > 0.5)

        most = min(LOOKS, count)
        seen = np.where(other, most, np.sum([shows(t) for t in found], axis=0))
        often = seen >= most
        while len(found) < count + MOST_LOOKS and (lacking := seen < most).any():
            found.append(float(end[lacking].min()))
            seen += shows(found[-1]) | (end == found[-1])
        return found, often

    @property
    def static(self) -> np.ndarray:
        """bool [n]: the Gaussians that neither move nor change, and are always shown."""
        size = self.scales[0].max(axis=1)
        found: np.ndarray = np.ptp(self.means, axis=0).max(axis=1) < MOVES * size
        if self.windows is not None:
            found &= self.windows[:, 1] >= 0.5
        rows = np.flatnonzero(found)
        scales, quats = self.scales[:, rows], self.quats[:, rows]
        for values in (np.log(np.maximum(scales, 1e-12)), self.opacities[:, rows], self.colors[:, rows]):
            found[rows] &= np.ptp(values, axis=0).max(axis=tuple(range(1, values.ndim - 1))) < MOVES
        found[rows] &= np.abs(np.einsum("tnd,nd->tn", quats, quats[0])).min(axis=0) > 1 - MOVES**2
        return found


def sampled(model: Teacher, where: str, fps: float = 30.0, step: Step = lambda: None) -> Sampled:
    """Samples a model. where: its name for messages. fps: of models that give other Gaussians at other times. step:
    called after each sample. Raises DataError."""
    read, times, kept = model.bare or model.splats, model.times, _Kept()
    if times is None and model.varies:
        times = tuple(np.linspace(0, 1, max(round(model.seconds * fps), 1) + 1))
    if times is None:
        exact, frames = _by_error(lambda t: kept.without_rest(read(t)), where, step)
        same = True
    else:
        if len(times) > MAX_SIDE:
            raise DataError(f"{where}: holds {len(times):,} frames, expected at most {MAX_SIDE:,}")
        exact, frames = np.asarray(times), list[Splats]()
        for frame in _ahead(read, times):
            _check_size(where, len(times), len(frame.means))
            frames.append(kept.without_rest(frame))
            step()
        same = len({len(frame.means) for frame in frames}) == 1 and in_order(frames)
    kept.say(where)
    if same:
        order = "one instant" if len(frames) == 1 else "rows in a stable order"
        return stacked(exact, frames, model.windows, order, kept.total / np.float32(len(frames)))
    frames = [read(float(t)) for t in exact]
    frames = [replace(frame, sh=frame.sh[:, : 1 + kept.harmonics]) for frame in frames]
    return matched_frames(where, exact, frames)


def _ahead(read: Callable[[float], Splats], times: Sequence[float]) -> Iterator[Splats]:
    """Yields the frame of each time. Two are read at once."""
    for i in range(0, len(times), 2):
        yield from together([partial(read, float(t)) for t in times[i : i + 2]])


class _Kept:
    """What is kept of the harmonics above the constants of many frames. total: float32 [n, harmonics, 3], their sum if
    all frames have as many rows. harmonics, most: the least and the largest number of any frame."""

    def __init__(self) -> None:
        self.total, self.harmonics, self.most = np.zeros((0, 0, 3), np.float32), MAX_DEGREE * (MAX_DEGREE + 2), 0

    def without_rest(self, frame: Splats) -> Splats:
        """Returns a frame with the constants alone."""
        rest = frame.sh[:, 1:]
        self.harmonics, self.most = min(self.harmonics, rest.shape[1]), max(self.most, rest.shape[1])
        if len(self.total) in (0, len(rest)):
            before = self.total[:, : self.harmonics] if len(self.total) else np.float32(0)
            self.total = before + rest[:, : self.harmonics]
        return replace(frame, sh=frame.sh[:, :1].copy())

    def say(self, where: str) -> None:
        """Warns if harmonics of some frames are left out."""
        if self.most > self.harmonics:
            degree, most = (math.isqrt(1 + count) - 1 for count in (self.harmonics, self.most))
            left = f"harmonics above degree {degree} are left out, expected degree {most} at all instants"
            warnings.warn(DamageWarning(f"{where}: {left}"), stacklevel=3)


def _check_size(where: str, frames: int, count: int) -> None:
    if frames * count * NUMBERS > MOST_NUMBERS:
        found = f"{count:,} Gaussians at {frames:,} instants"
        raise DataError(f"{where}: {found}, expected at most {MOST_NUMBERS // NUMBERS:,} in all")


def stacked(
    times: np.ndarray,
    frames: Sequence[Splats],
    windows: np.ndarray | None,
    order: str,
    rest: np.ndarray | None = None,
) -> Sampled:
    """Stacks frames with the same rows. rest: harmonics but the constants; by default means over the frames."""
    names = ("means", "quats", "scales", "opacities")
    parts = [[getattr(frame, name) for frame in frames] for name in names] + [[frame.sh[:, 0] for frame in frames]]
    means, quats, scales, opacities, colors = together([partial(np.stack, part) for part in parts])
    if rest is None:
        rest = np.asarray(sum(frame.sh[:, 1:] for frame in frames) / len(frames), np.float32)
    return Sampled(times, means, quats, scales, opacities, colors, rest, windows, order)


# -- models that know all times ----------------------------------------------------------------------------------------


def _by_error(read: Callable[[float], Splats], where: str, step: Step) -> tuple[np.ndarray, list[Splats]]:
    """Returns (times, frames with the same rows): more where a straight line between samples is wrong."""
    found = dict[float, Splats]()

    def at(t: float) -> Splats:
        if t not in found:
            found[t] = read(t)
            first = next(iter(found.values()))
            if len(found[t].means) != len(first.means):
                have = f"{len(found[t].means):,} usable Gaussians at {t:g} and {len(first.means):,} at 0"
                raise DataError(f"{where}: gives {have}, expected the same at all times")
            _check_size(where, len(found), len(first.means))
            step()
        return found[t]

    order = np.arange(1, FIRST - 1)
    inner = order + (order * GOLDEN % 1 - 0.5) / 2  # a motion that repeats with even samples would stand still
    grid = [0.0, *(inner / (FIRST - 1)).tolist(), 1.0]
    open_ = [(a, b) for a, b in zip(grid[:-1], grid[1:], strict=True)]
    for t in grid:
        at(t)
    while open_ and len(found) < MOST:
        a, b = open_.pop(0)
        middle = (a + b) / 2
        if _bend(at(a), at(middle), at(b)) > STRAIGHT:
            open_ += [(a, middle), (middle, b)]
    times = sorted(found)
    return np.array(times), [found[t] for t in times]


def _bend(a: Splats, middle: Splats, b: Splats) -> float:
    """Returns how far the Gaussians `middle` are from the mean of a and b, in shares of their size."""
    seen = middle.opacities > SEEN
    if not seen.any():
        return 0.0
    size = middle.scales.max(axis=1)[seen]
    aside = np.abs((a.means + b.means)[seen] / 2 - middle.means[seen]).max(axis=1) / np.maximum(size, 1e-9)
    turned = 1 - np.abs(np.einsum("nd,nd->n", _halfway(a.quats, b.quats), middle.quats))[seen]
    grown = np.abs((a.scales + b.scales)[seen] / 2 / np.maximum(middle.scales[seen], 1e-9) - 1).max(axis=1)
    faded = np.abs((a.opacities + b.opacities) / 2 - middle.opacities)[seen]
    tinted = np.abs((a.sh[:, 0] + b.sh[:, 0]) / 2 - middle.sh[:, 0])[seen].max(axis=1)
    parts = (aside, np.sqrt(turned.clip(0)), grown, faded, tinted)
    return max(float(np.minimum(part, 1).mean()) for part in parts)


def _halfway(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Returns the unit quaternions [n, 4] between a and b."""
    return unit(a + b * np.where(np.einsum("nd,nd->n", a, b) < 0, np.float32(-1), np.float32(1))[:, None])


# -- frames ------------------------------------------------------------------------------------------------------------


def features(splats: Splats, means: np.ndarray, reach: float) -> np.ndarray:
    """Returns float32 [n, 7] whose distances say how little Gaussians, moved to `means`, resemble each other."""
    size = np.log(np.maximum(splats.scales, 1e-12)).mean(axis=1, keepdims=True)
    return np.concatenate(
        [means / np.float32(reach), splats.base_colors / np.float32(HUE), size / np.float32(GROWTH)], 1
    )


def reach_of(splats: Splats) -> float:
    """Returns the distance of matches: REACH median distances between neighbours."""
    some = np.random.default_rng(0).permutation(len(splats.means))[:ROWS]
    if len(some) < 2:
        return 1.0
    _, nearest = _others(splats.means[some], splats.means, some)
    return max(REACH * float(np.sqrt(np.median(nearest))), 1e-9)


def in_order(frames: Sequence[Splats]) -> bool:
    """Whether frames of as many rows keep their rows: of most Gaussians, the one in the same row of the next frame is
    among the RANK that most resemble it where its last movement takes it."""
    n, rng = len(frames[0].means), np.random.default_rng(0)
    for i in evenly(range(min(1, len(frames) - 2), len(frames) - 1), TRIPLES):  # before the first there is no movement
        before, now, later = frames[max(i - 1, 0)], frames[i], frames[i + 1]
        rows, reach = rng.permutation(n)[:ROWS], reach_of(now)
        there = features(later, later.means, reach)
        here = [features(now, guess, reach)[rows] for guess in (now.means, 2 * now.means - before.means)]
        ranks = together([partial(_others, guess, there, rows) for guess in here])
        if np.median(np.minimum(*(found for found, _ in ranks))) > RANK:
            return False
    return True


@kernel()
def _others(here: np.ndarray, there: np.ndarray, own: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns (int64 [m]: how many rows of `there` [n, d] are nearer to each row of `here` [m, d] than there[own],
    float32 [m]: the least squared distance to a row but that one)."""
    ranks, nearest = np.zeros(len(here), np.int64), np.full(len(here), np.inf, np.float32)
    for i in range(len(here)):
        most = np.float32(0)
        for k in range(here.shape[1]):
            most += (here[i, k] - there[own[i], k]) ** 2
        for j in range(len(there)):
            apart, limit = np.float32(0), max(most, nearest[i])
            for k in range(here.shape[1]):
                apart += (here[i, k] - there[j, k]) ** 2
                if apart >= limit:
                    break
            if j != own[i]:
                ranks[i] += apart < most
                nearest[i] = min(nearest[i], apart)
    return ranks, nearest


@kernel()
def _nearest(here: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Returns int64 [n]: for each row of `here` [n, d] the row of `there` [m, d], sorted by its first column, nearest
    to it within a distance of 1, else -1."""
    found = np.full(len(here), -1, np.int64)
    for i in range(len(here)):
        least = np.float32(1)
        j = np.searchsorted(there[:, 0], here[i, 0] - np.float32(1))
        while j < len(there) and there[j, 0] <= here[i, 0] + 1:
            apart = np.float32(0)
            for k in range(here.shape[1]):
                apart += (here[i, k] - there[j, k]) ** 2
            if apart < least:
                least, found[i] = apart, j
            j += 1
    return found


def mutual(here: np.ndarray, there: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the rows of features `here` and `there`, [n, d] and [m, d], that are each other's nearest."""
    order, back = (np.argsort(x[:, 0], kind="stable") for x in (there, here))
    to, fro = _nearest(here, there[order]), _nearest(there, here[back])
    to, fro = np.where(to < 0, -1, order[to]), np.where(fro < 0, -1, back[fro])
    rows = np.flatnonzero(to >= 0)
    rows = rows[fro[to[rows]] == rows]
    return rows, to[rows]


def matched_frames(where: str, times: np.ndarray, frames: Sequence[Splats], reach: float | None = None) -> Sampled:
    """Chains the Gaussians of neighbouring frames that match. A chain stays as it is before and after its frames."""
    reach = reach or float(np.median([reach_of(frame) for frame in evenly(frames, TRIPLES)]))
    chain, links = np.arange(len(frames[0].means)), [np.arange(len(frames[0].means))]
    count, kept, speed = len(chain), 0, np.zeros_like(frames[0].means)
    for now, later in zip(frames[:-1], frames[1:], strict=True):
        rows, others = mutual(features(now, now.means + speed, reach), features(later, later.means, reach))
        chain, speed = np.full(len(later.means), -1), np.zeros_like(later.means)
        chain[others], speed[others] = links[-1][rows], later.means[others] - now.means[rows]
        new = np.flatnonzero(chain < 0)
        chain[new] = count + np.arange(len(new))
        count, kept = count + len(new), kept + len(rows)
        _check_size(where, len(frames), count)
        links.append(chain)
    owner = np.concatenate(links)
    frame = np.repeat(np.arange(len(frames)), [len(link) for link in links])
    order = np.lexsort((frame, owner))
    first = np.searchsorted(owner[order], np.arange(count))
    length = np.bincount(owner, minlength=count)
    start = frame[order][first]
    columns = {name: np.concatenate([getattr(f, name) for f in frames])[order] for name in vars(frames[0])}

    def at(i: int) -> Splats:
        entries = first + np.clip(i - start, 0, length - 1)
        return Splats(**{name: values[entries] for name, values in columns.items()})

    half = 0.5 / max(len(frames) - 1, 1)
    low, high = times[start] - half, times[start + length - 1] + half
    low, high = np.where(start == 0, -half, low), np.where(start + length == len(frames), 1 + half, high)
    windows = np.stack([(low + high) / 2, (high - low) / 2, np.full(count, half * SHARP)], axis=1).astype(np.float32)
    share = kept / max(len(owner) - len(frames[0].means), 1)
    words = f"no stable order: {share:.0%} of the Gaussians match one of the frame before, the others have windows"
    found = stacked(times, [at(i) for i in range(len(frames))], windows, words)
    return replace(found, matched=share)
