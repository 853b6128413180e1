"""Draws saved views with kernels whose constants were changed before numba compiled them: one process per variant.

    python -m pd4dgs_codec.bench.variant INPUT.npz OUTPUT.npz CONSTANTS REPEATS

CONSTANTS: a JSON object with any of tile_width, alpha_min, t_min. NUMBA_CACHE_DIR must be the variant's own, since
numba's cache does not know of constants.
"""

from __future__ import annotations

import json
import math
import sys
from typing import Any

import numpy as np


def apply(constants: dict[str, float]) -> None:
    """Sets the constants; call it before anything imports the kernels."""
    from pd4dgs_codec import threads

    threads.configure()
    from pd4dgs_codec.draw import projection

    if "alpha_min" in constants:
        projection.ALPHA_MIN = constants["alpha_min"]
        projection.REACH_LOG2 = -math.log2(constants["alpha_min"])
    projection.TILE_WIDTH = int(constants.get("tile_width", projection.TILE_WIDTH))
    from pd4dgs_codec.draw import compositing

    compositing.T_MIN = constants.get("t_min", compositing.T_MIN)


def main(source: str, target: str, constants: str, repeats: str) -> None:
    """Writes picture0, picture1, ... and seconds, those of `draw_all`."""
    apply(json.loads(constants))
    with np.load(source) as stored:
        count = int(stored["count"])
        views = [{k.split(".", 1)[1]: stored[k] for k in stored.files if k.startswith(f"{i}.")} for i in range(count)]
    from pd4dgs_codec.bench.pictures import draw_all

    pictures, seconds = draw_all(views, int(repeats))
    arrays: dict[str, Any] = {f"picture{i}": picture for i, picture in enumerate(pictures)}
    np.savez(target, seconds=np.array(seconds), **arrays)


if __name__ == "__main__":
    main(*sys.argv[1:])
