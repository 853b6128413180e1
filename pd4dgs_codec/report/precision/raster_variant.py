"""Draws saved Gaussians with kernels whose constants were changed before numba compiled them: one process per variant.

    python -m pd4dgs_codec.report.precision.raster_variant INPUT.npz OUTPUT.npz CONSTANTS REPEATS

CONSTANTS: a JSON object with any of tile_width, alpha_min, t_min. NUMBA_CACHE_DIR must be the variant's own, since
numba's cache does not know of constants.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np


def apply(constants: dict[str, float]) -> None:
    """Sets the constants; call it before anything imports the kernels."""
    from pd4dgs_codec.render import projection

    if "alpha_min" in constants:
        projection.ALPHA_MIN = constants["alpha_min"]
        projection.REACH_LOG2 = -math.log2(constants["alpha_min"])
    from pd4dgs_codec.render import kernels, simd

    kernels.T_MIN = constants.get("t_min", kernels.T_MIN)
    kernels.TILE_WIDTH = int(constants.get("tile_width", kernels.TILE_WIDTH))
    kernels._COLUMNS = kernels.TILE_WIDTH // simd.LANES
    kernels._BLOCKS = kernels._COLUMNS * kernels.TILE_HEIGHT


def draw_all(views: Sequence[dict[str, Any]], repeats: int, backend: str) -> tuple[list[np.ndarray], list[list[float]]]:
    """(pictures float32 [H, W, 3], seconds of each of `repeats` drawings) per view; the first drawing is not timed.

    views: the keyword arguments of oracle.picture as numpy arrays and numbers.
    """
    import torch

    from pd4dgs_codec.report.precision.timing import clock

    device = "cuda" if backend == "gsplat" else "cpu"
    pictures, seconds = [], []
    for view in views:
        arguments = _arguments(view, device)

        def draw(arguments=arguments) -> Any:
            from pd4dgs_codec.render.rasterization import rasterization

            with torch.no_grad():
                image = rasterization(*arguments[0], backend=backend, **arguments[1])[0][0]
            if device == "cuda":
                torch.cuda.synchronize()
            return image

        pictures.append(draw().cpu().numpy())
        seconds.append(clock(draw, repeats)[1])
    return pictures, seconds


def _arguments(view: dict[str, Any], device: str) -> tuple[list[Any], dict[str, Any]]:
    import torch

    names = ("means", "quats", "scales", "opacities", "colors")
    tensors = [torch.from_numpy(view[name]).to(device) for name in names]
    tensors += [torch.from_numpy(view[name])[None].to(device) for name in ("viewmat", "K")]
    background = torch.from_numpy(view["background"])[None].to(device)
    options = {"near_plane": float(view["near"]), "backgrounds": background}
    return [*tensors, int(view["width"]), int(view["height"])], options


def main(argv: Sequence[str]) -> int:
    source, target, constants, repeats = argv
    apply(json.loads(constants))
    with np.load(source) as stored:
        count = int(stored["count"])
        views = [{k.split(".", 1)[1]: stored[k] for k in stored.files if k.startswith(f"{i}.")} for i in range(count)]
    pictures, seconds = draw_all(views, int(repeats), "cpu")
    np.savez(target, seconds=np.array(seconds), **{f"picture{i}": p for i, p in enumerate(pictures)})
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
