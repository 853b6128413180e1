"""A scene of any number of anchors, made of one that was trained: for times that depend on size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pd4dgs_codec.codec.decoder import decode
from pd4dgs_codec.codec.encoder import encode
from pd4dgs_codec.errors import DataError
from pd4dgs_codec.scene import Scene

REACH = 3  #: voxels; copies lie this far from their original at most, along each axis
EFFORT = 3  #: of the encoder; more gains little here
MOST = 20  #: times as many anchors; more would hardly find free voxels


def with_anchors(data: bytes, count: int, seed: int = 5) -> bytes:
    """The file of a scene whose layer 0 shows `count` anchors: those of `data`, and copies of random ones among them,
    each moved to a free voxel nearby. Raises DataError if the scene has more already, or far too few."""
    scene = decode(data)
    return encode(_enlarged(scene, count, np.random.default_rng(seed)), effort=EFFORT)


def _enlarged(scene: Scene, count: int, rng: np.random.Generator) -> Scene:
    masks = [np.pad(codes, (0, len(scene.anchor_q) - len(codes))) for codes in scene.mask]
    shown = np.flatnonzero(masks[0])
    if not len(shown) <= count <= MOST * len(shown):
        raise DataError(
            f"layer 0 shows {len(shown):,} anchors, expected {count // MOST:,} to {count:,} to make {count:,}"
        )
    taken = {tuple(cell) for cell in scene.anchor_q.tolist()}
    copies: list[int] = []
    cells: list[tuple[int, ...]] = []
    while len(copies) < count - len(shown):
        row = int(rng.choice(shown))
        cell = tuple((scene.anchor_q[row] + rng.integers(-REACH, REACH + 1, 3)).tolist())
        if cell not in taken:
            taken.add(cell)
            copies.append(row)
            cells.append(cell)
    rows = np.concatenate([np.arange(len(scene.anchor_q)), np.array(copies, np.int64)])
    return replace(
        scene,
        rows=(len(rows),) * len(scene.layers),
        anchor_q=np.concatenate([scene.anchor_q, np.array(cells, np.int32).reshape(-1, 3)]),
        feature=scene.feature[rows],
        scaling_log=scene.scaling_log[rows],
        offset=scene.offset[rows],
        mask=tuple(codes[rows] for codes in masks),
    )
