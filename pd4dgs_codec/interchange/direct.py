"""Packs explicit Gaussians and their motion into a scene of the kinds splats and tracks, without training.

The Gaussians at the key instant become splats, see `pack`. What changes over time is subtracted from them, head by
head, and its principal components, weighted by what pictures depend on, become bases over time, with one coefficient
per Gaussian and basis. A component stays while it lowers the error by more than its bits are worth. Instants at which
all bases are nearly straight are left out. What moves comes in layer 1, and with it the Gaussians that a file of far
lower quality would leave out: layer 0 is a good picture of the key instant in a third of the bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from pd4dgs_codec.data.view import held_out
from pd4dgs_codec.draw.player import SplatPlayer
from pd4dgs_codec.errors import DataError
from pd4dgs_codec.interchange.pack import (
    Grid,
    Ordered,
    Packed,
    Pictures,
    absence,
    conjugate,
    log_scales,
    logits,
    matched,
    sensitivity,
    turned,
)
from pd4dgs_codec.interchange.sampled import Sampled
from pd4dgs_codec.interchange.splats import evenly, picture
from pd4dgs_codec.interchange.teacher import Teacher, spread
from pd4dgs_codec.interchange.tracks import BIT, STRAIGHT, Change, Grouping, tracks_of
from pd4dgs_codec.kinds import splats
from pd4dgs_codec.kinds.splats import HEADS, YCOCG, Splats, product
from pd4dgs_codec.kinds.tracks import Tracks, place
from pd4dgs_codec.quality.image import mpsnr
from pd4dgs_codec.scene import Camera, SceneInfo
from pd4dgs_codec.threads import together

#: One of so many cameras measures the error and does not decide about steps: those that do look better than others. Of
#: fewer than FEW all decide, and CHECKED of them measure.
HOLDOUT, FEW, CHECKED = 5, 30, 12
FITTED = 0.25  #: dB by which all of them, on average of eleven sources, surpass cameras that neither decide nor measure
#: Bits of a scalar, about. Gaussians leave in rounds, each at twice the theta of the one before or that at which the
#: share LEAVE leaves: several that hide each other's absence cannot all leave. Views decide about it in turn, one of
#: EACH in a round, with what the rounds before found: other views lose 1 dB by Gaussians that leave because always the
#: same views decide. Of what the error allows each scalar, the first guess of theta is the share GUESS if coefficients
#: of motion add to it.
SCALAR_BITS, LEAVE, EACH, GUESS = 2.8, 1 / 32, 3, 0.3
EARLY = 8.0  #: in layer 0 are the Gaussians that the key instant's pictures keep at so many times theta
BEST = 100.0  #: dB that stand for equal pictures
BLOCK = 1024  #: Gaussians whose changes are computed at once, which the cache holds
#: Principal components, groups and decisions about leaving serve for thetas that differ, or are lower, by this factor.
NEAR = 8.0
#: Windows are precise to PRECISE of the width that all but the share SHORT of them have.
PRECISE, SHORT = 0.1, 0.01


class Views(Sequence[Any]):
    """Cameras, again and again, with the Gaussians at times, or instants, that are made when they are asked for."""

    def __init__(self, at: Callable[[Any], Splats], cameras: Sequence[Camera], times: Sequence[Any]):
        self.at, self.cameras, self.times = at, cameras, times

    def __len__(self) -> int:
        return len(self.times)

    def __getitem__(self, i: Any) -> Any:
        return self.cameras[i % len(self.cameras)], self.at(self.times[i])


@dataclass(frozen=True, eq=False)
class Seen(Pictures):
    """Pictures of known cameras and times."""

    views: Views


@dataclass(eq=False)
class Leaving:
    """Finds at which theta each of n Gaussians leaves: thetas, float64 [n], inf for those that stay at `reached`.

    parts: pictures by EACH parts of the views. worth: of a Gaussian's bits at a theta of 1. free: bool [n], those that
    may leave. added: float64 [n], the error by the absence of each."""

    parts: Sequence[Pictures]
    worth: float
    free: np.ndarray
    added: np.ndarray
    thetas: np.ndarray
    reached: float = 0.0
    turn: int = 0

    def until(self, theta: float) -> None:
        """Lets those leave whose absence adds less than their bits are worth at theta."""
        while self.reached < theta:
            kept = self.thetas > self.reached
            found = absence(self.parts[self.turn % EACH], kept, self.turn)
            self.added, self.turn = self.added + (found - self.added) / EACH, self.turn + 1
            at, free = self.added / self.worth, kept & self.free
            soon = np.quantile(np.append(at[free], np.inf), LEAVE, method="lower")
            next_ = max(2 * self.reached or LEAVE * theta, float(soon))
            leaving = free & (at < next_)
            self.thetas[leaving] = np.maximum(at[leaving], self.reached)
            self.reached = next_


class Packer:
    """Packs samples for any quality; what does not depend on it is computed once."""

    early: np.ndarray | None = None  #: bool [n]: the ordered Gaussians that come in layer 0, None for all

    def __init__(
        self, model: Teacher, source: Sampled, cameras: Sequence[Camera], info: SceneInfo, step: Callable[[], None]
    ):
        self.info, self.key = info, len(source.times) // 2
        self.source = source = canonical(source, self.key)
        deciding, others = held_out(cameras, HOLDOUT if len(cameras) >= FEW else 0)
        times, often = source.looks(len(deciding))

        def pictures(cameras: Sequence[Camera], times: Sequence[float]) -> Seen:
            return Seen(Views(source.near, cameras, times), info.background, info.near)

        weights, alone = sensitivity(pictures(deciding, times))
        known, still = times[: len(deciding)], [source.times[self.key]] * len(deciding)
        self.deciding, self._at_key = (
            [pictures(deciding[i::EACH], t[i::EACH]) for i in range(EACH)] for t in (known, still)
        )
        step()
        self.few, others = not others, others or list(evenly(deciding, CHECKED))
        instants = [model.nearest(t) for t in spread(len(others))]  # also between samples
        self.checked = Seen(Views(model.splats, others, instants), info.background, info.near)
        if not any(own.any() for own in weights.values()):
            raise DataError(f"found none of {len(source.means[0]):,} Gaussians in any picture, expected one")
        self.ordered = Ordered.of(source.frame(self.key), weights)
        self.grouping: Grouping | None = None
        self.changes: dict[str, Change] = {}
        seen = np.bincount(self.ordered.rows, minlength=len(source.means[0])) > 0
        worth = BIT * SCALAR_BITS * sum(self.ordered.channels.values())
        self._fresh = Leaving(self.deciding, worth, often, alone, np.where(seen, np.inf, 0.0))
        self._leaving, self._begun = self._fresh, np.inf  # the theta at which its rounds began
        self._first: Leaving | None = None  # who leaves the first layer
        self._moving: tuple[float, Packer] | None = None  # a theta, and with what moves of those that have not left
        step()

    @property
    def scalars(self) -> int:
        """Numbers of all Gaussians at the key instant."""
        return len(self.ordered.rows) * sum(self.ordered.channels.values())

    def guess(self, psnr: float) -> float:
        """Returns about the theta of `psnr` dB."""
        share = GUESS if len(self.source.times) > 1 else 1.0
        return float(share * 10 ** (-psnr / 10) / self.scalars)

    def scene(self, theta: float) -> splats.SplatScene:
        """Returns the scene at a theta."""
        return self._thinned(theta)._scene(theta)

    def matched(self, psnr: float) -> splats.SplatScene:
        """Returns the scene whose pictures have `psnr` dB against those of the source."""

        above = list[float]()  # dB of other pictures above those of the few that are drawn each time

        def build(theta: float) -> tuple[splats.SplatScene, float]:
            scene = self.scene(theta)
            few = self._psnr(scene, self.checked)
            if not above:
                above.append(0.0 if self.few else self._psnr(scene, self.checked, *self.deciding) - FITTED - few)
            return scene, few + above[0] - psnr

        return matched(build, self.guess(psnr))

    def _thinned(self, theta: float) -> Packer:
        """Returns the packer of the Gaussians whose absence would add more to the error than their bits are worth: of
        all that a view sees if there are few, which would not tell what other views miss."""
        if theta * NEAR < self._begun:
            self._leaving, self._begun = replace(self._fresh, thetas=self._fresh.thetas.copy()), theta
            self._first = self._moving = None
        moving, leaving = len(self.source.times) > 1, self._leaving
        if not self.few:
            leaving.until(theta)
        if moving and not self.few:
            if self._first is None:
                kept = leaving.thetas > theta
                added = absence(self._at_key[0], kept)
                self._first = Leaving(self._at_key, leaving.worth, kept, added, leaving.thetas.copy(), theta, turn=1)
            self._first.until(EARLY * theta)
        if self._moving is None or not 1 / NEAR <= theta / self._moving[0] <= NEAR:
            own = self._taken(leaving.thetas[self.ordered.rows] > theta / NEAR)
            own.changes = own._changes() if moving else {}
            if own.changes:
                own.grouping = Grouping.of(own.changes, place(own.ordered.values["position"], self.info.box), theta)
            self._moving = theta, own
        own = self._moving[1]
        own = own._taken(leaving.thetas[own.ordered.rows] > theta)
        early = (self._first or leaving).thetas[own.ordered.rows] > EARLY * theta
        own.early = early if moving and early.any() else None
        return own

    def _taken(self, kept: np.ndarray) -> Packer:
        """Returns the packer of those of the ordered Gaussians that are kept, bool [n]: of all if none is."""
        own, kept = copy(self), kept if kept.any() else ~kept
        own.ordered = self.ordered.taken(kept)
        own.changes = {name: change.taken(kept) for name, change in self.changes.items()}
        own.grouping = self.grouping and self.grouping.taken(kept)
        return own

    def _psnr(self, scene: splats.SplatScene, *seen: Seen) -> float:
        """Returns the mean PSNR of the pictures in dB, which are not rounded."""
        errors, player = [], SplatPlayer(scene)
        for part in seen:
            for camera, t, truth in zip(part.views.cameras, part.views.times, part.images, strict=True):
                image = picture(player.splats(t)[0], camera, part.background, part.near)
                errors.append(np.square(image - truth, dtype=np.float64).mean())
        return float(np.mean(-10 * np.log10(np.maximum(errors, 1e-12))))

    def _scene(self, theta: float) -> splats.SplatScene:
        grid = self.ordered.grid(theta)
        packed = self.ordered.packed(grid)
        tensors, steps, centres = self._tensors(packed)
        found = splats.scene(
            replace(self.info, voxel_size=packed.voxel_size), packed.cells, tensors, steps,
            classes=packed.classes, centres=centres, tracks=self._tracks(grid, packed),
            layer=None if self.early is None else ~self.early,
        )  # fmt: skip
        return found

    def _tensors(self, packed: Packed) -> tuple[dict[str, np.ndarray], dict[str, float], dict[str, np.ndarray]]:
        """Returns tensors, steps and centres with the windows, exact multiples of the finest step of all classes."""
        tensors, steps, centres = dict(packed.tensors), dict(packed.steps), dict(packed.centres)
        if tensors["color"].shape[1] > 3:
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
        made: dict[str, tuple[np.ndarray, Callable[[np.ndarray, np.ndarray], np.ndarray]]] = {
            "position": (s.means, lambda x, at: x - at),
            "rotation": (s.quats, _turns),
            "scale": (s.scales, lambda x, at: _logs(x) - _logs(at)),
            "opacity": (s.opacities, lambda x, at: (logits(x) - logits(at))[..., None]),
            "color": (s.colors, lambda x, at: (x - at) @ YCOCG.T),
        }

        def change(name: str) -> Change | None:
            given, differences = made[name]
            if (given == given[key]).all():
                return None
            blocks = np.split(rows, range(BLOCK, len(rows), BLOCK))  # of [T, n, c], to be [n, c, T] in memory
            values = np.empty((len(rows), HEADS[name], len(given)), np.float32)
            for own, part in zip(blocks, np.split(values, range(BLOCK, len(rows), BLOCK)), strict=True):
                part[:] = differences(given[:, own], given[key, own]).transpose(1, 2, 0)
            return Change.of(values, self.ordered.weights[name])

        found = zip(made, together([partial(change, name) for name in made]), strict=True)
        return {name: own for name, own in found if own}

    def _tracks(self, grid: Grid, packed: Packed) -> dict[int, Tracks]:
        """Returns the tracks, of layer 1, none if nothing moves."""
        chosen = {name: np.flatnonzero(change.gains(grid.theta) > 0) for name, change in self.changes.items()}
        chosen = {name: own for name, own in chosen.items() if len(own)}
        if not chosen:
            return {}
        at = (packed.cells + packed.tensors["offset"].astype(np.float64)) * packed.voxel_size
        grouping = self.grouping and replace(self.grouping, places=place(at, self.info.box))
        allowed = STRAIGHT * grid.theta * self.scalars
        return {1: tracks_of(self.changes, chosen, grid, self.source.times, self.key, allowed, grouping)}


def mean_psnr(scene: splats.SplatScene, views: Iterable[tuple[Camera, float, np.ndarray]]) -> float:
    """Returns the mean PSNR of a scene's pictures in dB. views: cameras, normalised times, and the pictures float32
    [H, W, 3] that they are compared with."""
    player, found = SplatPlayer(scene), []
    for camera, t, truth in views:
        found.append(mpsnr(picture(player.splats(t)[0], camera, player.background, scene.info.near), truth))
    return float(np.minimum(found, BEST).mean())


def _logs(scales: np.ndarray) -> np.ndarray:
    """The logarithms of scales [.., n, 3], bounded as those of splats."""
    return log_scales(scales.reshape(-1, 3)).reshape(scales.shape)


def _turns(quats: np.ndarray, key: np.ndarray) -> np.ndarray:
    """Returns float [T, n, 4]: the rotations from the key instant's quaternions [n, 4], less the identity."""
    turns = product(quats, np.broadcast_to(conjugate(key), quats.shape))
    turns[..., 0] -= 1
    return turns


def canonical(source: Sampled, key: int) -> Sampled:
    """Describes each ellipsoid so that its rotation is smallest at the key instant, and continuous over time."""
    quats, scales = np.empty_like(source.quats), np.empty_like(source.scales)
    given = source.quats[key]
    upright, axes = turned(given, np.tile(np.arange(3), (len(given), 1)), np.array([1, 0, 0, 0], np.float32))
    turn = product(conjugate(given), upright)
    for way in (range(key, len(quats)), range(key - 1, -1, -1)):
        last = upright
        for i in way:
            sizes = np.take_along_axis(source.scales[i], axes, 1)
            quats[i], scales[i] = turned(product(source.quats[i], turn), sizes, last)
            last = quats[i]
    return replace(source, quats=quats, scales=scales)
