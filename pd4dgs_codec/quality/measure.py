"""Measures scenes by their pictures for packing: errors, and the order of anchors in slices."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch

from pd4dgs_codec.data.view import View
from pd4dgs_codec.draw.player import drawer
from pd4dgs_codec.format.options import EncodeOptions
from pd4dgs_codec.format.plan import in_file_order, layer_symbols, passed, symbols_of, tensor_bytes
from pd4dgs_codec.kinds import AnyScene
from pd4dgs_codec.model.model import Model, from_scene
from pd4dgs_codec.model.networks import EXACT, Rounding
from pd4dgs_codec.model.picture import render_image
from pd4dgs_codec.model.sensitivity import omission_error, smaller, utility, without
from pd4dgs_codec.quality.image import mean_scores, mpsnr, to_uint8
from pd4dgs_codec.scene import Scene, Viewpoint
from pd4dgs_codec.tensors.tables import Fill

#: dB of a picture at most in means: one that equals its image would decide them alone.
MOST_DB = 100.0
#: A layer's bytes are divided into so many parts; the next layer may begin after any of them.
PARTS = 16
#: dB that a fill gains at least: for less it is not worth its bytes.
FILL_GAIN = 0.05
#: The same as a quotient of squared errors.
FILL_WORTH = 10 ** (-FILL_GAIN / 10)
#: The spreads that are tried, in units of 1/64 above 1: 1 to 3.
SPREADS = (0, 8, 16, 24, 32, 48, 64, 96, 128)


def pictures(
    model: Model, level: int, viewpoints: Sequence[Viewpoint], step: Callable[[], None] = lambda: None
) -> list[np.ndarray]:
    """Renders float32 [H, W, 3] in 0..1 at `level` from each viewpoint. step is called after each picture."""
    found = []
    for camera, time in viewpoints:
        found.append(render_image(model, level, time, camera))
        step()
    return found


def own_views(scene: Scene, viewpoints: Sequence[Viewpoint]) -> list[View]:
    """Returns views that show the highest level of the scene itself, at most SIDE pixels wide and high."""
    small = [(smaller(camera), time) for camera, time in viewpoints]
    shown = pictures(from_scene(scene), scene.level, small)
    return [
        View(camera.viewmat, camera.K, camera.width, camera.height, time, to_uint8(picture), None, "", 0)
        for (camera, time), picture in zip(small, shown, strict=True)
    ]


def level_psnr(
    model: Model, level: int, views: Sequence[View], step: Callable[[], None] = lambda: None, rounding: Rounding = EXACT
) -> float:
    """Returns the mean mPSNR of a level over `views`, dB, of each at most MOST_DB. step is called after each."""

    return _mean_psnr(lambda view: render_image(model, level, view.time, view.camera, rounding), views, step)


def _mean_psnr(draw: Callable[[View], np.ndarray], views: Sequence[View], step: Callable[[], None]) -> float:
    capped = {"mpsnr": lambda *pictures: min(mpsnr(*pictures), MOST_DB)}
    return mean_scores(draw, views, capped, step)["mpsnr"]


def true_psnr(
    scene: AnyScene, levels: Iterable[int], views: Sequence[View], step: Callable[[], None] = lambda: None
) -> dict[int, float]:
    """Returns `level_psnr` of a decoded scene at each of `levels`, which may lie above its highest layer."""
    if isinstance(scene, Scene):
        model = from_scene(scene)
        return {level: level_psnr(model, level, views, step) for level in levels}
    players = {level: drawer(scene.prefix(level)) for level in levels}
    return {
        level: _mean_psnr(lambda view: player.picture(view.camera, view.time), views, step)  # noqa: B023
        for level, player in players.items()
    }


# -- errors of a quantised scene ---------------------------------------------------------------------------------------


class RenderedLoss:
    """The error of decoded scenes in the pictures at `viewpoints`, relative to the unquantised `scene`, at its levels.

    step is called after each picture.
    """

    def __init__(self, scene: Scene, viewpoints: Sequence[Viewpoint], step: Callable[[], None] = lambda: None):
        self.scene, self.viewpoints, self.step = scene, viewpoints, step

    @cached_property
    def references(self) -> dict[int, list[np.ndarray]]:
        """The unquantised pictures by level."""
        model = from_scene(self.scene)
        return {level: pictures(model, level, self.viewpoints, self.step) for level in self.scene.layers}

    def mse(self, scene: AnyScene) -> dict[int, float]:
        """Returns per level the mean squared error over all pictures, colours in 0..1."""
        model, found = from_scene(scene), {}
        for level, references in self.references.items():
            pairs = zip(pictures(model, level, self.viewpoints, self.step), references, strict=True)
            found[level] = float(np.mean([np.square(a - b).mean() for a, b in pairs]))
        return found

    def mean_mse(self, scene: AnyScene) -> float:
        """Returns the mean of `mse` over the levels."""
        return float(np.mean(list(self.mse(scene).values())))

    def omission_error(self, scene: Scene, level: int) -> np.ndarray:
        """Estimates the squared error, summed over pictures and colours, of leaving out each anchor at `level`: float64
        [N], see `sensitivity.omission_error`; infinite, as unknown, for anchors that no picture shows."""
        model = from_scene(scene)
        total, met = np.zeros(len(scene.anchor_q)), np.zeros(len(scene.anchor_q), bool)
        generator = torch.Generator().manual_seed(0)
        for camera, time in self.viewpoints:
            error, near, _ = omission_error(model, level, time, camera, generator)
            total += error.numpy()
            met |= near.numpy()
            self.step()
        return np.where(met, total, np.inf)


# -- the order of anchors in a sliced file -----------------------------------------------------------------------------


def in_order(
    scene: Scene,
    viewpoints: Sequence[Viewpoint],
    whole: Sequence[np.ndarray],
    options: EncodeOptions,
    step: Callable[[], None] = lambda: None,
    *,
    passing: bool = True,
) -> tuple[Scene, np.ndarray]:
    """Orders the anchors of a planned scene. Returns the scene in file order, with some anchors passed to the next
    layer, and float64 [N], the utility of each anchor in its layer, see `utility`.

    A layer keeps its most useful anchors until the next layer's planes and networks improve the pictures at
    `viewpoints` more per byte than its own next anchors; with `passing` the other anchors pass. The highest level is
    unchanged. whole: its pictures at viewpoints. step is called after each round of `utility`.
    """
    found = list[np.ndarray]()
    for index, layer in enumerate(scene.layers):
        own = utility(scene.prefix(layer), viewpoints, step)
        if passing and layer < scene.level:
            order = np.argsort(-own, kind="stable")
            first = scene.rows[index] - len(own)
            kept, others = np.split(order, [_enough(scene, index, first + order, viewpoints, whole, options)])
            scene, rows = in_file_order(passed(scene, index, first + others), scene.layers)
            own = own[rows[first : first + len(kept)] - first]
        found.append(own)
    return scene, np.concatenate(found)


def _enough(
    scene: Scene,
    index: int,
    order: np.ndarray,
    viewpoints: Sequence[Viewpoint],
    whole: Sequence[np.ndarray],
    options: EncodeOptions,
) -> int:
    """Returns how many anchors of scene.layers[index] come before the next layer. order: int64 [n], its rows, the most
    useful one first. whole: the pictures of the highest level."""
    level, above = scene.layers[index : index + 2]

    def error(level: int, count: int) -> float:
        """Returns the pictures' squared error at `level` with `count` of the anchors and none of later layers."""
        prefix = scene.prefix(level)
        later = np.arange(scene.rows[index], prefix.rows[-1])
        model = from_scene(without(prefix, np.concatenate([order[count:], later])))
        shown = pictures(model, level, viewpoints)
        return float(sum(np.square(a - b).sum() for a, b in zip(shown, whole, strict=True)))

    motion = tensor_bytes(symbols_of(scene, above), options)
    size = np.cumsum(layer_symbols(scene, index).bits_per_row()[order - (scene.rows[index] - len(order))]) / 8
    parts = np.linspace(0.0, size[-1] if len(size) else 0.0, PARTS + 1)
    counts = np.searchsorted(size, parts, side="right")
    start = 1 if index == 0 else 0  # a picture needs anchors
    before = error(level, counts[start])
    for i in range(start, PARTS):
        after, moved = error(level, counts[i + 1]), error(above, counts[i])
        if (before - moved) * (parts[i + 1] - parts[i]) > (before - after) * motion:
            return int(counts[i])
        before = after
    return len(order)


# -- what incomplete files leave open ----------------------------------------------------------------------------------


def best_fill(
    prefix: AnyScene, viewpoints: Sequence[Viewpoint], whole: Sequence[np.ndarray], before: Fill | None = None
) -> Fill | None:
    """Returns the colour, RGB 0..255, behind the Gaussians of `prefix` and their spread that bring its pictures at
    `viewpoints` nearest to `whole`, float32 [H, W, 3] each. None if that gains less than FILL_GAIN over the background
    of the header without a spread. before: that of the slice before, from which the search for a spread goes downhill;
    without it all of SPREADS are tried.
    """
    tried = dict[int, Filled]()

    def at(i: int) -> Filled:
        if i not in tried:
            tried[i] = filled(prefix, SPREADS[i], viewpoints, whole)
        return tried[i]

    def error(i: int) -> float:
        return at(i).error

    if before:
        best = SPREADS.index(before[3]) if len(before) > 3 else 0
    else:
        best = min(range(len(SPREADS)), key=error)
    for way in (-1, 1):
        while 0 <= best + way < len(SPREADS) and error(best + way) < error(best):
            best += way
    if tried[best].error >= at(0).plain * FILL_WORTH:
        return None
    spread = [SPREADS[best]] if SPREADS[best] else []
    return (*tried[best].color, *spread)


class Filled(NamedTuple):
    """Squared errors of a prefix's pictures over the background and over the fill of this color, RGB 0..255."""

    plain: float
    error: float
    color: tuple[int, int, int]


def filled(prefix: AnyScene, spread: int, viewpoints: Sequence[Viewpoint], whole: Sequence[np.ndarray]) -> Filled:
    """The best colour behind the pictures of `prefix` with this spread: the background unless another gains FILL_GAIN,
    since a colour beside it would show where the Gaussians end.

    A picture over the colour b is C + T b, T the transmittance that is left. Its squared error against I is least for
    b = <T, I - C> / <T, T> in each channel.
    """
    player = drawer(replace(prefix, fills=((0, 0, 0, spread),) * len(prefix.layers)))
    parts = []
    for (camera, time), target in zip(viewpoints, whole, strict=True):
        picture, alpha = player.drawn(camera, time)
        parts.append(((target - picture).astype(np.float64), 1.0 - alpha.astype(np.float64)))

    def error(color: np.ndarray) -> float:
        return sum(float(np.square(missing - left[..., None] * color / 255).sum()) for missing, left in parts)

    slope = np.sum([np.einsum("hw,hwc->c", left, missing) for missing, left in parts], axis=0)
    curve = sum(float(np.square(left).sum()) for _, left in parts)
    best = np.rint(255 * np.clip(slope / max(curve, np.finfo(float).tiny), 0, 1))
    background = 255 * np.array(prefix.info.background)
    plain, least = error(background), error(best)
    color, least = (best, least) if least < plain * FILL_WORTH else (background, plain)
    red, green, blue = np.rint(color).astype(int).tolist()
    return Filled(plain, least, (red, green, blue))
