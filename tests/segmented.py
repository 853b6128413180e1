"""A folder of four small segments, made once for all tests that read one."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import numpy as np

from pd4dgs_codec.interchange import imported
from pd4dgs_codec.interchange.segmented import import_segments
from pd4dgs_codec.interchange.splats import ply_bytes, sphere
from pd4dgs_codec.kinds.splats import Splats

SECONDS, COUNT, FPS = 4, 4, 4


def scene(seconds: float) -> Splats:
    """A grey floor, and a red ball of 60 Gaussians that swings above it."""
    rng = np.random.default_rng(0)
    floor = np.stack([*rng.uniform(-2, 2, (2, 200)), np.full(200, -1.0)], axis=1)
    ball = 0.3 * sphere(60) + [1.5 * np.sin(2 * seconds), 0, 0]
    means = np.concatenate([floor, ball]).astype(np.float32)
    n = len(means)
    tint = np.where(np.arange(n)[:, None] < 200, 0.5, [0.9, 0.1, 0.1]) + rng.normal(0, 0.02, (n, 3))
    quats = np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1))
    sizes = np.where(np.arange(n) < 200, 0.2, 0.08).astype(np.float32)
    sh = ((tint - 0.5) / 0.28209479)[:, None].astype(np.float32)
    return Splats(means, quats, np.tile(sizes[:, None], 3), np.full(n, 0.95, np.float32), sh)


@contextmanager
def _silent(what: str, total: int | None) -> Iterator[object]:
    yield lambda: None


@cache
def folder() -> Path:
    """The folder, which no test may change."""
    root = Path(mkdtemp())
    (root / "frames").mkdir()
    for i in range(SECONDS * FPS + 1):
        (root / "frames" / f"{i:03d}.ply").write_bytes(ply_bytes(scene(i / FPS)))
    usual = imported.CAMERAS, imported.SIZE
    imported.CAMERAS, imported.SIZE = 18, 64
    try:
        import_segments(
            str(root / "frames"), str(root / "scene"), length=SECONDS / COUNT, psnr=40, fps=FPS, up=(0, 0, 1),
            tell=lambda text: None, progress=_silent,
        )  # fmt: skip
    finally:
        imported.CAMERAS, imported.SIZE = usual
    return root / "scene"
