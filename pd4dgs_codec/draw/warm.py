"""Everything that the first picture of a process waits for and that no scene is needed for."""

from __future__ import annotations

import numpy as np

from pd4dgs_codec.scene import (
    PLANES,
    Camera,
    Deformation,
    Network,
    Scene,
    SceneInfo,
    Steps,
    Widths,
)

WIDTHS = Widths()
SIDE = 16  #: pixels of the picture drawn and thrown away
CHANNELS = 8  #: of its planes, as many as take the kernel's path


def warm_up() -> None:
    """Imports numba and loads the kernels (where none are cached: compiles them) by drawing one anchor with both
    deformations. A viewer calls it in a thread while the first layer is on its way."""
    from pd4dgs_codec.draw.player import Player

    scene = _one_anchor()
    camera = scene.info.camera
    assert camera is not None
    Player(scene).picture(camera, 0.5)


def _one_anchor() -> Scene:
    """The Gaussians of one anchor in front of a camera."""
    box = np.array([[-1, -1, 1], [1, 1, 3]], np.float32)
    K = np.array([[SIDE, 0, SIDE / 2], [0, SIDE, SIDE / 2], [0, 0, 1]], np.float32)
    camera = Camera(np.eye(4, dtype=np.float32), K, SIDE, SIDE)
    return Scene(
        info=SceneInfo(1.0, box, (0.0, 1.0), (0.0, 0.0, 0.0), 0.1, 100.0, (0.0, -1.0, 0.0), 0.0, camera),
        steps=Steps(),
        layers=(0, 1, 2),
        rows=(1, 1, 1),
        anchor_q=np.array([[0, 0, 2]], np.int32),
        feature=np.zeros((1, WIDTHS.feature), np.float32),
        scaling_log=np.full((1, *WIDTHS.attributes["scaling_log"]), -2, np.float32),
        offset=np.zeros((1, WIDTHS.slots, 3), np.float32),
        mask=(np.full(1, 255, np.uint8),) * 3,
        networks={name: _constant(WIDTHS.inputs, n, 0.5) for name, n in WIDTHS.networks.items()},
        global_deformation=_deformation("position"),
        local_deformation=_deformation("mean"),
    )


def _deformation(head: str) -> Deformation:
    planes = {name: np.ones((CHANNELS, 2, 2), np.float32) for name, _, _ in PLANES}
    return Deformation((planes,), {"trunk": _constant(CHANNELS, CHANNELS), head: _constant(CHANNELS, 3)})


def _constant(inputs: int, outputs: int, value: float = 0.0) -> Network:
    return ((np.zeros((outputs, inputs), np.float32), np.full(outputs, value, np.float32)),)
