"""Packs explicit Gaussians and their motion into a scene of the kinds splats and tracks, without training.

The Gaussians at the key instant become splats, see `pack`. What changes over time is subtracted from them, head by
head, and its principal components, weighted by what pictures depend on, become bases over time, with one coefficient
per Gaussian and basis. A component stays while it lowers the error by more than its bits are worth. Instants at which
all bases are nearly straight are left out. Layer 2 takes the components that may be missing at twice the error.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pd4dgs_codec.interchange.pack import (
    YCOCG,
    Grid,
    Ordered,
    Packed,
    Pictures,
    conjugate,
    log_scales,
    logits,
    matched,
    sensitivity,
    turned,
)
from pd4dgs_codec.interchange.sampled import Sampled
from pd4dgs_codec.interchange.splats import picture
from pd4dgs_codec.kinds import splats
from pd4dgs_codec.kinds.splats import Splats, product
from pd4dgs_codec.kinds.tracks import Head, Tracks
from pd4dgs_codec.scene import Camera, SceneInfo

#: Consecutive views without times are this share of the duration apart, so that few views cover all of it.
GOLDEN = (5**0.5 - 1) / 2
BASIS_STEP = 2.0**-10  #: of all grids; bases are scaled to it
BITS = 6  #: about those of a basis at an instant
BIT = 2 * np.log(2)  #: what a bit is worth, in units of the error that a scalar may add
MOST_BASES = 80  #: of a head, components and a limit of the format on channels
STRAIGHT = 0.05  #: the share of the allowed error that left-out instants may add
CHECKED = 12  #: pictures that measure the error
#: Windows are precise to PRECISE of the width that all but the share SHORT of them have.
PRECISE, SHORT = 0.1, 0.01
STATIC = 1e-12  #: the least share of a picture's squared error for which anything changes


class Views(Sequence[Any]):
    """Views of samples at cameras, spread over time, whose Gaussians are made when they are asked for."""

    def __init__(self, source: Sampled, cameras: Sequence[Camera], chosen: Sequence[int]):
        self.source, self.cameras, self.chosen = source, cameras, list(chosen)

    @classmethod
    def over_time(cls, source: Sampled, cameras: Sequence[Camera]) -> Views:
        """Spreads the cameras over the instants."""
        last = len(source.times) - 1
        return cls(source, cameras, [round(i * GOLDEN % 1.0 * last) for i in range(len(cameras))])

    def __len__(self) -> int:
        return len(self.cameras)

    def __getitem__(self, i: Any) -> Any:
        if isinstance(i, slice):
            return Views(self.source, self.cameras[i], self.chosen[i])
        return self.cameras[i], self.source.frame(self.chosen[i], bare=False)

    def __iter__(self) -> Iterator[tuple[Camera, Splats]]:
        return (self[i] for i in range(len(self)))


@dataclass(frozen=True, eq=False)
class _Change:
    """How a head changes: values float32 [m, c T] of the moving rows, weights float64 [m], T instants, c components."""

    values: np.ndarray
    weights: np.ndarray
    components: int
    vectors: np.ndarray  #: float64 [c T, K], mean squares over time of 1
    energies: np.ndarray  #: float64 [K], squared errors of pictures without each


class Packer:
    """Packs samples for any quality; what does not depend on it is computed once."""

    def __init__(self, source: Sampled, cameras: Sequence[Camera], info: SceneInfo, step: Callable[[], None]):
        self.info, self.key = info, len(source.times) // 2
        self.source = source = _canonical(source, self.key)
        views = Views.over_time(source, cameras)
        pictures = Pictures(views, info.background, info.near)
        weights = sensitivity(pictures)
        step()
        some = Views(
            source, *zip(*[(views.cameras[i], views.chosen[i]) for i in _spread(len(views), CHECKED)], strict=True)
        )
        self.pictures, self.times = Pictures(some, info.background, info.near), source.times[some.chosen]
        self.ordered = Ordered.of(source.frame(self.key), weights)
        self.changes = self._changes() if len(source.times) > 1 else {}
        step()

    @property
    def left_out(self) -> int:
        """Number of the source's Gaussians that no view sees."""
        return len(self.source.means[0]) - len(self.ordered.rows)

    def scene(self, psnr: float) -> splats.SplatScene:
        """Returns the scene whose pictures have `psnr` dB against those of the source."""
        scalars = len(self.ordered.rows) * sum(self.ordered.channels.values())

        def build(theta: float) -> tuple[splats.SplatScene, float]:
            scene = self._scene(theta, 10 ** (-psnr / 10))
            return scene, self._error(scene)

        return matched(build, psnr, 10 ** (-psnr / 10) / scalars)

    def _error(self, scene: splats.SplatScene) -> float:
        """Returns the squared error of the pictures that stands for their mean PSNR."""
        errors, info = [], self.info
        for (camera, _), t, truth in zip(self.pictures.views, self.times, self.pictures.images, strict=True):
            image = picture(scene.splats(float(t))[0], camera, info.background, info.near)
            errors.append(np.square(image - truth, dtype=np.float64).mean())
        return float(np.exp(np.mean(np.log(np.maximum(errors, 1e-12)))))

    def _scene(self, theta: float, error: float) -> splats.SplatScene:
        grid = Grid.of(self.ordered.weights, self.ordered.channels, theta)
        packed = self.ordered.packed(grid)
        tensors, steps, centres = self._tensors(packed)
        found = splats.scene(
            replace(self.info, voxel_size=packed.voxel_size), packed.cells, tensors, steps,
            classes=packed.classes, centres=centres, tracks=self._tracks(grid, error),
        )  # fmt: skip
        return found

    def _tensors(self, packed: Packed) -> tuple[dict[str, np.ndarray], dict[str, float], dict[str, np.ndarray]]:
        """Returns tensors, steps and centres with the windows, exact multiples of the finest step of all classes."""
        tensors, steps, centres = dict(packed.tensors), dict(packed.steps), dict(packed.centres)
        if "harmonics" not in tensors and tensors["color"].shape[1] > 3:
            color, middle = tensors["color"], centres["color"]
            tensors["color"], tensors["harmonics"] = color[:, :3], color[:, 3:]
            centres["color"], centres["harmonics"], steps["harmonics"] = middle[:3], middle[3:], steps["color"]
        if self.source.windows is not None:
            windows = self.source.windows[packed.rows].astype(np.float64)
            shortest = np.quantile(windows[:, 1] + windows[:, 2], SHORT)
            windows[:, 2] = np.log(windows[:, 2])
            spacing = np.ldexp(1.0, packed.classes.astype(int))[:, None]
            step = float(np.float32(PRECISE * shortest / spacing.max()))
            middle = np.rint(np.median(windows, axis=0) / step)
            k = np.rint((windows / step - middle) / spacing)
            tensors["window"] = ((middle + k * spacing) * step).astype(np.float32)
            steps["window"], centres["window"] = step, middle.astype(np.int32)
        return tensors, steps, centres

    # -- what changes --------------------------------------------------------------------------------------------------

    def _changes(self) -> dict[str, _Change]:
        """Returns the principal components of what changes, by head, without heads in which nothing does."""
        s, rows, key = self.source, self.ordered.rows, self.key
        made: dict[str, Callable[[np.ndarray], np.ndarray]] = {
            "position": lambda r: s.means[:, r] - s.means[key, r],
            "rotation": lambda r: _turns(s.quats[:, r], s.quats[key, r]),
            "scale": lambda r: _logs(s.scales[:, r]) - _logs(s.scales[key, r])[None],
            "opacity": lambda r: (logits(s.opacities[:, r]) - logits(s.opacities[key, r]))[..., None],
            "color": lambda r: (s.colors[:, r] - s.colors[key, r]) @ YCOCG.T,
        }
        found = {}
        for name, make in made.items():
            values = np.ascontiguousarray(make(rows).transpose(1, 2, 0), np.float32)  # [n, c, T]
            n, components, instants = values.shape
            values = values.reshape(n, -1)
            weights = self.ordered.weights[name]
            root = np.sqrt(weights / instants)[:, None].astype(np.float32)
            gram = (values * root).T.astype(np.float64) @ (values * root)
            energies, vectors = np.linalg.eigh(gram)
            order = np.argsort(-energies)[:MOST_BASES]
            order = order[energies[order] > max(STATIC, 1e-9 * energies.max())]
            if len(order):
                vectors = vectors[:, order] * np.sqrt(instants)
                found[name] = _Change(values, weights, components, vectors, energies[order])
        return found

    def _tracks(self, grid: Grid, error: float) -> dict[int, Tracks]:
        """Returns the tracks of layers 1 and 2. error: the mean squared error of pictures that is aimed at."""
        kept = [
            (energy, name, k)
            for name, change in self.changes.items()
            for k, energy in enumerate(change.energies)
            if self._gain(change, k, grid.theta) > 0
        ]
        kept.sort(reverse=True)
        rest = np.cumsum([energy for energy, *_ in kept][::-1])[::-1]
        first = [row for row, behind in zip(kept, rest, strict=True) if behind > error]
        layers = {1: first or kept, 2: kept[len(first) :] if first else []}
        values = {name: change.values for name, change in self.changes.items()}
        return {layer: self._layer(own, grid, values) for layer, own in layers.items() if own}

    def _gain(self, change: _Change, k: int, theta: float) -> float:
        """Returns by how much a component lowers the error, less what its bits are worth."""
        change_of = change.weights * np.square(change.values @ (change.vectors[:, k] / len(self.source.times)))
        bits = 0.5 * np.log2(1 + change_of / theta).sum() + BITS * len(change.vectors)
        return float(np.maximum(change_of - theta, 0).sum() - BIT * theta * bits)

    def _layer(self, chosen: Sequence[tuple[float, str, int]], grid: Grid, values: dict[str, np.ndarray]) -> Tracks:
        """Quantises the bases of components, and fits coefficients to the values, which become what is left."""
        instants, names = len(self.source.times), sorted({name for _, name, _ in chosen})
        bases, steps = {}, {}
        for name in names:
            change, columns = self.changes[name], [k for _, other, k in chosen if other == name]
            step = np.sqrt(12 * grid.theta * instants / change.energies[columns].max())  # of bases
            bases[name] = change.vectors[:, columns].T.reshape(len(columns), change.components, instants)
            steps[name] = step
        knots = self._knots(bases, chosen, grid)
        times, heads = self.source.times, {}
        for name in names:
            scale = BASIS_STEP / min(steps[name], 0.05)
            coded = np.rint(bases[name][:, :, knots] * scale / BASIS_STEP) * BASIS_STEP
            whole = _between(times[knots], coded, times).reshape(len(coded), -1)
            coefficients = values[name] @ np.linalg.pinv(whole)
            step = float(np.float32(grid.steps[name] / scale))
            spacing = step * np.ldexp(1.0, grid.classes.astype(int))[:, None]
            exact = (np.rint(coefficients / spacing) * spacing).astype(np.float32)
            values[name] = values[name] - exact @ whole.astype(np.float32)
            heads[name] = Head(coded.astype(np.float32), exact, step)
        return Tracks.of(times[knots], BASIS_STEP, heads)

    def _knots(self, bases: dict[str, np.ndarray], chosen: Sequence[tuple[float, str, int]], grid: Grid) -> np.ndarray:
        """Returns the instants that are kept, int64: the ends and the key, then the one at which straight lines are
        farthest off, until what they add is small."""
        times, columns = self.source.times, []
        for name, values in bases.items():
            energies = [energy for energy, other, _ in chosen if other == name]
            columns.append((values * np.sqrt(energies)[:, None, None]).reshape(-1, len(times)))
        paths, knots = np.concatenate(columns), sorted({0, self.key, len(times) - 1})
        allowed = STRAIGHT * grid.theta * len(self.ordered.rows) * sum(self.ordered.channels.values())
        while len(knots) < len(times):
            off = np.square(_between(times[knots], paths[:, knots], times) - paths).sum(axis=0)
            if off.max() <= allowed:
                break
            ends = np.searchsorted(knots, np.arange(len(times)))
            knots = sorted({*knots, *(int(g[off[g].argmax()]) for g in _groups(ends) if off[g].max() > allowed)})
        return np.array(knots)


def _groups(labels: np.ndarray) -> list[np.ndarray]:
    """Splits the indices of sorted labels by label."""
    return np.split(np.arange(len(labels)), np.flatnonzero(np.diff(labels)) + 1)


def _between(knots: np.ndarray, values: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Interpolates values [.., knots] linearly at times [T]: [.., T]."""
    j = np.clip(np.searchsorted(knots, times, side="right") - 1, 0, len(knots) - 2)
    f = (times - knots[j]) / (knots[j + 1] - knots[j])
    return np.asarray(values[..., j] * (1 - f) + values[..., j + 1] * f)


def _spread(count: int, most: int) -> list[int]:
    return sorted({round(x) for x in np.linspace(0, count - 1, min(most, count))})


def _logs(scales: np.ndarray) -> np.ndarray:
    """The logarithms of scales [.., n, 3], bounded as those of splats."""
    return log_scales(scales.reshape(-1, 3)).reshape(scales.shape)


def _turns(quats: np.ndarray, key: np.ndarray) -> np.ndarray:
    """Returns float [T, n, 4]: the rotations from the key instant's quaternions [n, 4], less the identity."""
    turns = product(quats, np.broadcast_to(conjugate(key), quats.shape))
    turns[..., 0] -= 1
    return turns


def _canonical(source: Sampled, key: int) -> Sampled:
    """Describes each ellipsoid so that its rotation is smallest at the key instant, and continuous over time."""
    quats, scales = source.quats.astype(np.float64), source.scales.copy()
    instants = len(quats)
    quats[key], scales[key] = turned(quats[key], scales[key], np.array([1.0, 0, 0, 0]))
    for way in (range(key + 1, instants), range(key - 1, -1, -1)):
        last = key
        for i in way:
            quats[i], scales[i] = turned(quats[i], scales[i], quats[last])
            last = i
    return replace(source, quats=quats.astype(np.float32), scales=scales)
