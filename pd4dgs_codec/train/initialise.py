"""A fresh model for a dataset: positions and sizes of the first anchors."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from pd4dgs_codec.data.view import Dataset, View, border_pixels, spans_volume
from pd4dgs_codec.draw.gaussians import LEAST_NEAR
from pd4dgs_codec.draw.projection import FAR
from pd4dgs_codec.draw.simd import Tasks, parallel
from pd4dgs_codec.errors import DataError
from pd4dgs_codec.model.config import ModelConfig
from pd4dgs_codec.model.deformation import DeformationField
from pd4dgs_codec.model.model import Model, fresh_networks
from pd4dgs_codec.morton import MAX_VOXEL
from pd4dgs_codec.scene import INSTANTS, SceneInfo, Steps, Widths
from pd4dgs_codec.train import workers
from pd4dgs_codec.train.following import Track, moving_bodies
from pd4dgs_codec.train.stereo import with_points

#: Voxels along the longest side of the scene's box.
GRID = 1024
#: The shortest and the longest such side, scene units: nothing is drawn nearer than LEAST_NEAR or farther than FAR.
SIDES = 10 * LEAST_NEAR, 0.1 * FAR
MASK_START = 2.0
#: a_j of absent levels: its softplus is 4e-18, so their masks equal those of the highest level present.
TIED = -40.0
#: A view shows a model if its anchors are at so many of its pixels or more.
LEAST_PIXELS = 10
NEAREST = 3  #: neighbours whose distance sets the size of an anchor
#: For a dataset without points: random candidates per initial point, and training views that score them.
CARVE_CANDIDATES = 20
CARVE_VIEWS = 40
#: A pixel shows an object if a channel differs from the background by more than this, of 255.
CARVE_CONTRAST = 8


def fresh_model(
    config: ModelConfig,
    dataset: Dataset,
    widths: Widths,
    steps: Steps,
    seed: int,
    max_layer: int = 2,
    key: float | None = None,
    moving: Tensor | None = None,
) -> Model:
    """Returns an untrained model without the deformations of the layers above max_layer.

    Anchors start at the dataset's points, with jittered copies if there are few; without points in its box where
    pictures differ from a plain background. More start at points `moving` [m, 3], see `start_points`. A layer's start
    values do not depend on max_layer. key: the key instant, normalised time; None: no key instant.
    """
    generator = torch.Generator().manual_seed(seed)
    torch.manual_seed(seed)  # nn.Linear and HexPlane draw their start values from the global generator
    info = scene_info(dataset)
    if moving is not None:
        moving = moving[torch.randperm(len(moving), generator=generator)[: config.initial_anchors]]
    anchor_q = initial_cells(dataset, config.initial_anchors, info.voxel_size, generator, moving)
    n = len(anchor_q)
    spacing = nearest_distances((anchor_q.double() * info.voxel_size).float()).clamp(min=info.voxel_size)
    key_code = None if key is None else round(INSTANTS * key)  # see `scene.instant`
    fields: list[DeformationField | None] = []
    below = 0
    for field in (config.global_deformation, config.local_deformation):
        fresh = None if field is None else DeformationField.fresh(field, info.box, widths.heads, key_code, below)
        fields.append(fresh)
        below += field.features if field else 0
    return Model(
        info,
        steps,
        anchor_q,
        torch.zeros(n, widths.feature),
        spacing.log()[:, None].repeat(1, 6),
        torch.zeros(n, widths.slots, 3),
        fresh_mask_logits(n, min(config.level, max_layer)),
        fresh_networks(widths, config.hidden),
        fields[0] if max_layer > 0 else None,
        fields[1] if max_layer > 1 else None,
    )


def start_points(dataset: Dataset, key: float | None, moves: bool) -> tuple[Dataset, Tensor, list[Track]]:
    """The dataset, with points found by stereo if it has neither points nor a plain background; float32 [n, 3] points
    of what moves at the key instant, and tracks of bodies, if there is one and motion is to be learnt."""
    if dataset.points is None and not on_plain_background(dataset):
        dataset = with_points(dataset, key)
    if key is None or not moves:
        return dataset, torch.zeros(0, 3), []
    return dataset, *workers.alike(lambda: moving_bodies(dataset, key))


def fresh_mask_logits(n: int, level: int) -> Tensor:
    """float32 [n, 3]: a_0 = MASK_START, a_1 = 0 if `level` is at least 1, and TIED for the rest, since layer 2 starts
    without anchors of its own."""
    logits = torch.full((n, 3), TIED)
    logits[:, 0] = MASK_START
    logits[:, 1 : min(level, 1) + 1] = 0
    return logits


def scene_info(dataset: Dataset) -> SceneInfo:
    """The `SceneInfo` of a dataset; a voxel is 1/GRID of the box's longest side. Raises DataError for a box that is too
    small or too large to be drawn, or so far from 0 that the format cannot number its voxels."""
    box = np.array(dataset.box, np.float32)
    side, farthest = float((box[1] - box[0]).max()), float(np.abs(box).max())
    if not SIDES[0] <= side <= SIDES[1] or farthest + side > MAX_VOXEL / GRID * side:
        expected = f"a longest side of {SIDES[0]:g} to {SIDES[1]:g} and at most {MAX_VOXEL // GRID} sides from 0"
        raise DataError(f"{dataset.name}: the scene's box is {box.tolist()}, expected {expected}")
    return SceneInfo(
        voxel_size=_binary32(side / GRID),
        box=box,
        time_range=tuple(_binary32(v) for v in dataset.time_range),  # type: ignore[arg-type]
        background=tuple(_binary32(v) for v in dataset.background),  # type: ignore[arg-type]
        near=_binary32(dataset.near),
        far=_binary32(dataset.far),
        up=tuple(_binary32(v) for v in dataset.up),  # type: ignore[arg-type]
        unit=0.0,  # unknown to all dataset readers
        camera=dataset.camera,
    )


def initial_cells(
    dataset: Dataset, count: int, voxel_size: float, generator: torch.Generator, moving: Tensor | None = None
) -> Tensor:
    """int32 [n, 3] unique voxel cells, about `count` of them and those of the points `moving` [m, 3]."""
    points = torch.from_numpy(np.array(() if dataset.points is None else dataset.points, np.float32).reshape(-1, 3))
    box = torch.from_numpy(np.array(dataset.box, np.float32))
    points = points[near_box(points, box)]
    if not spans_volume(points.numpy()):
        points = carved_points(dataset, count, generator)
    elif len(points) > count:
        points = points[torch.randperm(len(points), generator=generator)[:count]]
    elif len(points) < count:
        spacing = nearest_distances(points)
        pick = torch.randint(len(points), (count - len(points),), generator=generator)
        jitter = torch.randn(len(pick), 3, generator=generator) * spacing[pick, None]
        points = torch.cat([points, points[pick] + jitter])
        points = points[near_box(points, box)]
    points = points if moving is None else torch.cat([points, moving])
    cells: Tensor = torch.unique(torch.round(points / voxel_size).to(torch.int32), dim=0)
    return cells


def check_visible(model: Model, dataset: Dataset) -> None:
    """Raises DataError if hardly an anchor of a fresh model is in any picture, so that nothing could be learnt."""
    x, y, z = model.anchor.cpu().numpy().T.copy()
    most = 0
    for view in _carving_views(dataset):
        line, column, inside = view.project(x, y, z)
        most = max(most, len(np.unique((line * view.width + column)[inside])))
        if most >= min(LEAST_PIXELS, view.width * view.height, len(x)):
            return
    found = f"the {len(x):,} start points are at {most} different pixels of a training picture at most"
    expected = "poses, focal lengths and units that belong together"
    raise DataError(f"{dataset.name}: the pictures show nothing of the scene: {found}, expected {expected}")


def near_box(points: Tensor, box: Tensor) -> Tensor:
    """bool [n]: whether points [n, 3] lie in the box [2, 3] or within half its longest side of it. Anchors farther away
    would stretch the grid."""
    low, high = box
    reach = 0.5 * (high - low).max()
    near: Tensor = ((points > low - reach) & (points < high + reach)).all(1)
    return near


def on_plain_background(dataset: Dataset) -> bool:
    """Whether half of the pixels at the borders of training views show the background."""
    return bool(_shown(border_pixels(_carving_views(dataset)), dataset).mean() <= 0.5)


def _carving_views(dataset: Dataset) -> Sequence[View]:
    return dataset.train[:: max(1, len(dataset.train) // CARVE_VIEWS)]


def _shown(pixels: np.ndarray, dataset: Dataset) -> np.ndarray:
    """bool [...]: which `pixels` (uint8 [..., 3]) differ from the background."""
    background = np.array(dataset.background, np.float32) * 255
    shown: np.ndarray = np.abs(pixels - background).max(-1) > CARVE_CONTRAST
    return shown


def carved_points(dataset: Dataset, count: int, generator: torch.Generator) -> Tensor:
    """float32 [count, 3] random points of the box, more likely where more training views show an object.

    A view shows an object where its pixel differs from the constant background. Points outside every view are rarely
    chosen.
    """
    low, high = torch.from_numpy(np.array(dataset.box, np.float32))
    points = low + (high - low) * torch.rand(CARVE_CANDIDATES * count, 3, generator=generator)
    px, py, pz = points.numpy().T.copy()
    seen, hits = np.zeros(len(points), np.float32), np.zeros(len(points), np.float32)
    for view in _carving_views(dataset):
        shown = _shown(view.image, dataset)
        line, column, inside = view.project(px, py, pz)
        seen[inside] += 1
        hits[inside] += shown[line[inside], column[inside]]
    share = torch.from_numpy((hits + np.float32(1e-3)) / (seen + 1))  # + 1 discounts points that few views see
    chosen: Tensor = points[torch.multinomial(share.square(), count, generator=generator)]
    return chosen


def nearest_distances(points: Tensor) -> Tensor:
    """[n]: root mean squared distance of points [n, 3] to their NEAREST nearest neighbours, exact; 0 for one point."""
    n = len(points)
    if n < 2:
        return torch.zeros(n)
    squares, order = np.empty(n, np.float32), points[:, 0].argsort()
    _nearest_squares(squares, points[order].numpy(), min(NEAREST, n - 1))
    out = torch.empty(n)
    out[order] = torch.from_numpy(squares).sqrt()
    return out


@parallel(lambda out, *_: len(out))
def _nearest_squares(tasks: Tasks, out: np.ndarray, points: np.ndarray, k: int) -> None:
    """out [n] = mean squared distance of points [n, 3], sorted along the first axis, to their k < n nearest neighbours.
    The search stops where the distance along that axis alone is too large."""
    nearest = np.empty(k)
    for i in range(tasks[0], tasks[1]):
        for n in range(k):  # numba's own full and mean take longer to compile than all the rest
            nearest[n] = np.inf
        for way in (-1, 1):
            j = i + way
            while 0 <= j < len(points) and (points[j, 0] - points[i, 0]) ** 2 < nearest[k - 1]:
                square, at = 0.0, k - 1
                for axis in range(3):
                    square += (points[j, axis] - points[i, axis]) ** 2
                if square < nearest[at]:
                    while at > 0 and nearest[at - 1] > square:
                        nearest[at] = nearest[at - 1]
                        at -= 1
                    nearest[at] = square
                j += way
        total = 0.0
        for n in range(k):
            total += nearest[n]
        out[i] = total / k


def _binary32(value: float) -> float:
    value = float(np.float32(value))
    return value if math.isfinite(value) else 0.0
