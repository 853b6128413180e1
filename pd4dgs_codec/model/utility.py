"""What the pictures gain by each anchor, so that the slices of a layer bring the anchors that matter most first.

Anchors leave one after another, the least of them first, as in a backward elimination: what an anchor is worth depends
on which others are there, for what stands behind it shows when it is gone. Leaving out anchor i changes the squared
error of a picture I against that of the whole level by about -2 <I - J, dI/dg_i> + ||dI/dg_i||^2, g_i a gate on its
opacities and scales that goes from 1 to 0: the first term tells anchors that make up for what has gone already from
those that have become wrong.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch

from pd4dgs_codec.format.slicing import bits_per_row
from pd4dgs_codec.format.symbols import layer_symbols
from pd4dgs_codec.model.convert import from_scene
from pd4dgs_codec.model.harm import anchor_slopes
from pd4dgs_codec.model.picture import render_image
from pd4dgs_codec.scene import Camera, Scene

Place = tuple[Camera, float]

#: Pixels along the longer side of the pictures that utility is measured on, about: holes are larger than that.
SIDE = 128
#: The share of a layer's anchors that stay after each round, and how many are left when no further round pays.
STAY, FEW = 0.8, 64


def utility(scene: Scene, places: Sequence[Place], step: Callable[[], None] = lambda: None) -> np.ndarray:
    """float64 [N]: the order in which the anchors of each layer should come, the highest first; see above.

    places: cameras and times, 0..1, whose pictures decide. Of a layer's own anchors only, at its level, all earlier
    layers being there: what they gain per byte. Anchors that no picture comes near have 0, the least. step is called
    after each round.
    """
    places = [(_smaller(camera), time) for camera, time in places]
    rank, first = np.zeros(len(scene.anchor_q)), 0
    for index, (layer, end) in enumerate(zip(scene.layers, scene.rows, strict=True)):
        bits = bits_per_row(layer_symbols(scene, index))
        rank[first:end] = _layer_utility(scene.prefix(layer), layer, first, bits, places, step)
        first = end
    return rank


def _layer_utility(
    scene: Scene, level: int, first: int, bits: np.ndarray, places: Sequence[Place], step: Callable[[], None]
) -> np.ndarray:
    """float64 [rows of the highest layer]: in which round each leaves, and within it what it was worth."""
    own = scene.rows[-1] - first
    rank, alive = np.zeros(own), np.ones(own, bool)
    whole = from_scene(scene)
    references = [torch.from_numpy(render_image(whole, level, time, camera)) for camera, time in places]
    generator, rounds = torch.Generator().manual_seed(0), 0
    while alive.any():
        rows = np.flatnonzero(alive)
        model = from_scene(without(scene, first + np.flatnonzero(~alive)))
        gain, met = np.zeros(len(rows)), np.zeros(len(rows), bool)
        for (camera, time), reference in zip(places, references, strict=True):
            linear, square, near = anchor_slopes(model, level, time, camera, generator, reference)
            gain += (square - 2 * linear).numpy()[first:]
            met |= near.numpy()[first:]
        step()
        rounds += 1
        order = np.argsort(np.where(met, gain / bits[rows], -np.inf), kind="stable")
        leaving = len(rows) if len(rows) <= FEW else math.ceil((1 - STAY) * len(rows))
        out = rows[order[:leaving]]
        rank[out] = np.where(met[order[:leaving]], rounds + np.arange(leaving) / leaving, 0.0)
        alive[out] = False
    return rank


def without(scene: Scene, rows: np.ndarray) -> Scene:
    """The scene without some anchors, int64 [M]."""
    kept = np.ones(len(scene.anchor_q), bool)
    kept[rows] = False
    return replace(
        scene,
        rows=tuple(int(kept[:n].sum()) for n in scene.rows),
        mask=tuple(codes[kept[: len(codes)]] for codes in scene.mask),
        **scene.of_anchors(kept),
    )


def _smaller(camera: Camera) -> Camera:
    """The same picture in as few pixels as SIDE says."""
    factor = min(1.0, SIDE / max(camera.width, camera.height))
    width, height = (max(1, round(side * factor)) for side in (camera.width, camera.height))
    scale = np.array([[width / camera.width], [height / camera.height], [1.0]], np.float32)
    return Camera(camera.viewmat, (camera.K * scale).astype(np.float32), width, height)
