"""Pictures that the reports take of a scene: from where, of which Gaussians, drawn by the kernels or by an oracle."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from pd4dgs_codec.bench.timing import clock
from pd4dgs_codec.draw.player import Player
from pd4dgs_codec.draw.projection import ALPHA_MIN
from pd4dgs_codec.draw.visibility import near_plane
from pd4dgs_codec.model.rasterization import rasterization
from pd4dgs_codec.model.reference import composite, project
from pd4dgs_codec.quality.frames import Frame, dataset_frames, own_frames
from pd4dgs_codec.quality.levels import Level
from pd4dgs_codec.scene import Camera, SceneInfo

T = TypeVar("T")

#: The Gaussians of a view, float32: means [N, 3], quats [N, 4] wxyz, scales [N, 3] (standard deviations), opacities
#: [N] and colors [N, 3] in 0..1.
SPLATS = ("means", "quats", "scales", "opacities", "colors")
#: SPLATS and how they are seen: viewmat [4, 4], K [3, 3], background [3], width, height, near. Arrays and numbers.
View = dict[str, Any]
#: Pixels of a block's side in the oracle: small blocks meet few Gaussians, large ones cost fewer calls.
BLOCK = 16


def spread(items: Sequence[T], count: int) -> list[T]:
    """Up to `count` of the items, evenly spaced, each from the middle of its share."""
    count = min(count, len(items))
    return [items[(2 * i + 1) * len(items) // (2 * count)] for i in range(count)]


def frames(info: SceneInfo, source: str | None, count: int, downscale: int = 1, holdout: int = 8) -> list[Frame]:
    """Up to `count` frames: of the held-out views of `source` (training views if none are), or, without a source, of
    the file's own camera over time. Raises DataError, RenderError."""
    if source is None:
        return own_frames(info, count, downscale=downscale)
    from pd4dgs_codec.interchange.teacher import load_source

    dataset = load_source(source, downscale=downscale, holdout=holdout)
    return dataset_frames(spread(dataset.test or dataset.train, count))


def view(level: Level, frame: Frame) -> View:
    """The Gaussians that the frame's camera meets at its time, with the colours that it sees."""
    info, camera = level.model.info, frame.camera
    viewmat, K = np.array(camera.viewmat, np.float32), np.array(camera.K, np.float32)
    if isinstance(level.model, Player):
        splats = {name: getattr(level.model.gaussians(camera, frame.time), name) for name in SPLATS}
    else:
        with torch.no_grad():
            g = level.model.gaussians(level.level, frame.time, camera)
        splats = {name: getattr(g, name).numpy() for name in SPLATS}
    return {
        **splats,
        "viewmat": viewmat,
        "K": K,
        "width": camera.width,
        "height": camera.height,
        "near": near_plane(info),
        "background": np.array(info.background, np.float32),
    }


def draw_all(views: Sequence[View], repeats: int, backend: str = "cpu") -> tuple[list[np.ndarray], list[float]]:
    """(picture of each view, float32 [H, W, 3]; seconds of each of `repeats` drawings of each). A first drawing is not
    timed."""
    pictures, seconds = [], []
    for one in views:
        inputs = _inputs(one, "cuda" if backend == "gsplat" else "cpu")
        _draw(inputs, backend)
        image, own = clock(lambda inputs=inputs: _draw(inputs, backend), repeats)  # type: ignore[misc]
        pictures.append(image.cpu().numpy())
        seconds += own
    return pictures, seconds


def _inputs(one: View, device: str) -> dict[str, Any]:
    tensors = {name: torch.from_numpy(np.ascontiguousarray(one[name], np.float32)).to(device) for name in SPLATS}
    camera = Camera(one["viewmat"], one["K"], int(one["width"]), int(one["height"]))
    return {**tensors, "camera": camera, "background": one["background"], "near_plane": float(one["near"])}


def _draw(inputs: dict[str, Any], backend: str) -> Tensor:
    with torch.no_grad():
        image = rasterization(**inputs, backend=backend)[0]
    if image.device.type == "cuda":
        torch.cuda.synchronize()
    return image


@torch.no_grad()
def oracle(one: View, dtype: torch.dtype = torch.float64) -> np.ndarray:
    """[H, W, 3] in `dtype`: what `rasterization(backend="reference")` draws, for any number of Gaussians.

    The same formulas, a block of pixels at a time: a Gaussian contributes nothing where its alpha is below 1/255, so
    that each block needs only those whose box meets it.
    """
    tensors = [torch.from_numpy(np.asarray(one[k])).to(dtype) for k in (*SPLATS, "viewmat", "K", "background")]
    viewmat, K, background = tensors[5:]
    width, height = int(one["width"]), int(one["height"])
    z = tensors[0] @ viewmat[2, :3] + viewmat[2, 3]
    index = torch.nonzero((z > float(one["near"])) & (tensors[3] > ALPHA_MIN))[:, 0]
    index = index[torch.sort(z[index].to(torch.float32), stable=True).indices]
    means, quats, scales, opacities, colors = (a[index] for a in tensors[:5])
    means2d, covariance, det, _ = project(means, quats, scales, viewmat, K, width, height)
    p, q, r = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    conics = torch.stack([r, -q, p], -1) / det[:, None]
    extent = torch.sqrt(2 * torch.log(opacities / ALPHA_MIN))
    half = torch.ceil(extent[:, None] * torch.sqrt(torch.stack([p, r], -1)))
    image = background.expand(height, width, 3).clone()
    for top in range(0, height, BLOCK):
        rows = (det > 0) & (means2d[:, 1] + half[:, 1] > top) & (means2d[:, 1] - half[:, 1] < top + BLOCK)
        row = torch.nonzero(rows)[:, 0]
        for left in range(0, width, BLOCK):
            hit = (means2d[row, 0] + half[row, 0] > left) & (means2d[row, 0] - half[row, 0] < left + BLOCK)
            own = row[hit]
            if len(own):
                size = min(BLOCK, width - left), min(BLOCK, height - top)
                shifted = means2d[own] - means2d.new_tensor([left, top])
                block, alpha = composite(shifted, conics[own], opacities[own], colors[own], *size)
                image[top : top + size[1], left : left + size[0]] = block + (1 - alpha) * background
    return image.numpy()
