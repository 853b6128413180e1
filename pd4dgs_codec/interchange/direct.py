"""Packs explicit Gaussians and their motion into a scene of the kinds splats and tracks, without training.

The Gaussians at the key instant become splats, see `pack`. What changes over time is subtracted from them, head by
head, and its principal components, weighted by what pictures depend on, become bases over time, with one coefficient
per Gaussian and basis. A component stays while it lowers the error by more than its bits are worth. Instants at which
all bases are nearly straight are left out. Layer 2 takes the components that may be missing at twice the error.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
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
from pd4dgs_codec.interchange.tracks import STRAIGHT, Change, layer
from pd4dgs_codec.kinds import splats
from pd4dgs_codec.kinds.splats import Splats, product
from pd4dgs_codec.kinds.tracks import Tracks
from pd4dgs_codec.scene import Camera, SceneInfo

#: Consecutive views without times are this share of the duration apart, so that few views cover all of it.
GOLDEN = (5**0.5 - 1) / 2
CHECKED = 12  #: pictures that measure the error
#: Windows are precise to PRECISE of the width that all but the share SHORT of them have.
PRECISE, SHORT = 0.1, 0.01


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

    @property
    def scalars(self) -> int:
        """Numbers of all Gaussians at the key instant."""
        return len(self.ordered.rows) * sum(self.ordered.channels.values())

    def scene(self, psnr: float) -> splats.SplatScene:
        """Returns the scene whose pictures have `psnr` dB against those of the source."""
        scalars = self.scalars

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
        grid = self.ordered.grid(theta)
        packed = self.ordered.packed(grid)
        tensors, steps, centres = self._tensors(packed)
        found = splats.scene(
            replace(self.info, voxel_size=packed.voxel_size), packed.cells, tensors, steps,
            classes=packed.classes, centres=centres,
            tracks=self._tracks(grid, error),
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
            spacing = np.ldexp(1.0, packed.classes.astype(int))[:, None]
            step = self._window_step(windows, float(spacing.max()))
            windows[:, 2] = np.log(windows[:, 2])
            middle = self.ordered.centre("window", windows, step)
            k = np.rint((windows / step - middle) / spacing)
            tensors["window"] = ((middle + k * spacing) * step).astype(np.float32)
            steps["window"], centres["window"] = step, middle
        return tensors, steps, centres

    def _window_step(self, windows: np.ndarray, coarsest: float) -> float:
        """Returns the step, exact binary32, of windows float64 [n, 3]. coarsest: the largest 2^class."""
        shortest = np.quantile(windows[:, 1] + windows[:, 2], SHORT)
        return float(np.float32(PRECISE * shortest / coarsest))

    # -- what changes --------------------------------------------------------------------------------------------------

    def _changes(self) -> dict[str, Change]:
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
            if change := Change.of(values, self.ordered.weights[name]):
                found[name] = change
        return found

    def _tracks(self, grid: Grid, error: float) -> dict[int, Tracks]:
        """Returns the tracks of layers 1 and 2. error: the mean squared error of pictures that is aimed at."""
        kept = [
            (change.energies[k], name, int(k))
            for name, change in self.changes.items()
            for k in np.flatnonzero(change.gains(grid.theta) > 0)
        ]
        kept.sort(reverse=True)
        rest = np.cumsum([energy for energy, *_ in kept][::-1])[::-1]
        first = [row for row, behind in zip(kept, rest, strict=True) if behind > error]
        allowed = STRAIGHT * grid.theta * self.scalars
        changes, layers = self.changes, {1: first or kept, 2: kept[len(first) :] if first else []}
        found = dict[int, Tracks]()
        for number, own in layers.items():
            if not own:
                continue
            chosen = {name: np.array([k for _, other, k in own if other == name]) for name in changes}
            chosen = {name: ks for name, ks in chosen.items() if len(ks)}
            found[number], done = layer(changes, chosen, grid, self.source.times, self.key, allowed)
            for name, values in done.items():
                changes = changes | {name: replace(changes[name], values=changes[name].values - values)}
        return found


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
