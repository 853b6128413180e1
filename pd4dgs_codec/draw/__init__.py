"""Draws scenes on the CPU by numba kernels, without torch: numpy arrays in, Gaussians and pictures out.

`render` draws a decoded scene, `player.drawer` with fewer checks, `rasteriser.draw` any Gaussians.
`pd4dgs_codec.threads.configure` sets the number of threads.
"""

from dataclasses import replace
from threading import Lock
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from pd4dgs_codec.errors import required
from pd4dgs_codec.kinds import AnyScene
from pd4dgs_codec.scene import Camera, LayeredScene

_players = WeakKeyDictionary[LayeredScene, dict[int, Any]]()  # by level; they keep what does not depend on the camera
_one = Lock()  # players are not thread-safe


def render(scene: AnyScene, camera: Camera, t: float, level: int | None = None) -> np.ndarray:
    """Draws a picture, float32 [H, W, 3], RGB as displayed in 0..1, at normalised time t in 0..1.

    level: 0, 1 or 2, by default the highest; a level that the scene lacks equals the one below. The first call for a
    scene prepares it, and the first in a process loads or compiles the kernels; the scene's arrays must not change
    afterwards. Raises RenderError for another time, level or camera, DataError if numba is not installed.
    """
    part = scene.at(t, level)
    required("numba", "draw", "pictures")
    from pd4dgs_codec.draw.player import drawer

    with _one:
        players = _players.setdefault(scene, {})
        if part.level not in players:
            players[part.level] = drawer(replace(part))  # a copy: a value that held its key would keep it forever
        picture: np.ndarray = players[part.level].picture(camera, t)
    return picture
