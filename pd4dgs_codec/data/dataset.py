"""What the trainer and the evaluation see of any dataset, and `load`, which picks the reader."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import DataError
from ..scene import Camera

SYNTHETIC_PREFIX = "synthetic:"


@dataclass(frozen=True, eq=False)
class View:
    """One posed image. The lens is an ideal pinhole: distortion was removed on reading.

    viewmat: float32 [4, 4], world to camera, OpenCV axes (x right, y down, z forward), scene units.
    K: float32 [3, 3], pixels of `image`, pixel centres at +0.5.
    time: 0..1 over the dataset's time range (train and test together).
    image: uint8 [height, width, 3], sRGB as stored.
    mask: bool [height, width], True = valid; None = all valid. Holds the undistortion border and, on test views,
        the covisibility mask.
    """

    viewmat: np.ndarray
    K: np.ndarray
    width: int
    height: int
    time: float
    image: np.ndarray
    mask: np.ndarray | None
    name: str
    camera_id: int

    @property
    def camera(self) -> Camera:
        """The camera alone."""
        return Camera(self.viewmat, self.K, self.width, self.height)


@dataclass(frozen=True, eq=False)
class Dataset:
    """A scene's images, split, with what is known of its geometry.

    points: float32 [M, 3], scene units, or None; point_colors: uint8 [M, 3] or None.
    box: float32 [2, 3], lower and upper corner of the content: normalisation box of the HexPlanes and the
        volume of random initial points.
    near, far: scene units along the optical axis. background: 0..1 per channel. time_range: seconds at normalised
        time 0 and 1, (0, 1) if unknown. up: unit vector, world. unit: metres per scene unit, 0 if unknown.
    masked: True where the test masks are covisibility masks.
    """

    name: str
    train: tuple[View, ...]
    test: tuple[View, ...]
    points: np.ndarray | None
    point_colors: np.ndarray | None
    box: np.ndarray
    near: float
    far: float
    background: tuple[float, float, float]
    time_range: tuple[float, float]
    up: tuple[float, float, float]
    unit: float
    masked: bool

    @property
    def camera(self) -> Camera:
        """The default camera: that of the first training view."""
        return self.train[0].camera


def load(source: str | Path, *, downscale: int = 1, holdout: int = 8) -> Dataset:
    """Read a dataset.

    source: `synthetic:NAME[?seed=n]`, a folder in the iPhone/Nerfies layout, or a folder with transforms*.json.
    downscale: images are averaged over downscale x downscale blocks (the remainder is cropped), intrinsics follow.
    holdout: without split files, frames with i % holdout == holdout // 2 are the test frames; 0 = none.
    Raises DataError, one line, for anything missing or broken.
    """
    from . import iphone, synthetic, transforms

    if isinstance(downscale, bool) or not isinstance(downscale, int) or downscale < 1:
        raise DataError(f"{source}: downscale is {downscale}, expected an integer >= 1")
    if isinstance(holdout, bool) or not isinstance(holdout, int) or holdout < 0 or holdout == 1:
        raise DataError(f"{source}: holdout {holdout} leaves no training frame, expected 0 (none) or an integer >= 2")
    if str(source).startswith(SYNTHETIC_PREFIX):
        return synthetic.load(str(source), downscale)
    folder = Path(source)
    if not folder.is_dir():
        found = "a file" if folder.exists() else "nothing"
        raise DataError(f"{folder}: found {found}, expected a dataset folder or {SYNTHETIC_PREFIX}NAME")
    if (folder / "camera").is_dir():
        return iphone.read(folder, downscale)
    if any(folder.glob("transforms*.json")):
        return transforms.read(folder, downscale, holdout)
    found = "other files" if any(folder.iterdir()) else "an empty folder"
    raise DataError(f"{folder}: found {found}, expected camera/ (iPhone, Nerfies) or transforms*.json (Blender)")
