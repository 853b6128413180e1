"""What the trainer and the evaluation see of any dataset, and `load`, which picks the reader."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..errors import DataError
from ..scene import Camera

SYNTHETIC_PREFIX = "synthetic:"
#: Names of left-out views that a remark lists.
REMARKED = 4


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
    masked: True where the test masks are covisibility masks. left_out: names of views that are in neither split because
        their masks hold no valid pixel.
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
    left_out: tuple[str, ...] = ()

    @property
    def camera(self) -> Camera:
        """The default camera: that of the first training view."""
        return self.train[0].camera

    def remarks(self) -> list[str]:
        """What this data cannot teach or score, a line each, for whoever starts a training on it."""
        remarks = []
        if self.left_out:
            names = ", ".join(self.left_out[:REMARKED]) + (", ..." if len(self.left_out) > REMARKED else "")
            count = f"{len(self.left_out)} of {len(self.train) + len(self.test) + len(self.left_out)} views"
            remarks.append(f"{count} left out, no valid pixel in the mask: {names}")
        if len({view.time for view in self.train}) == 1:
            remarks.append("all training views are of one instant: levels 1 and 2 can learn no motion")
        first = self.train[0].viewmat
        if all(np.array_equal(view.viewmat, first) for view in self.train):
            remarks.append("all training views are from one place: depth stays a guess, other viewpoints look wrong")
        return remarks


def load(source: str | Path, *, downscale: int = 1, holdout: int = 8) -> Dataset:
    """Read a dataset.

    source: `synthetic:NAME[?seed=n]`, a folder in the iPhone/Nerfies layout, or a folder with transforms*.json.
    downscale: images are averaged over downscale x downscale blocks (the remainder is cropped), intrinsics follow.
    holdout: without split files, frames with i % holdout == holdout // 2 are the test frames; 0 = none.
    Views whose masks hold no valid pixel are left out, see `Dataset.left_out`.
    Raises DataError, one line, for anything missing or broken.
    """
    return _without_blind_views(_read(source, downscale, holdout), source)


def _without_blind_views(dataset: Dataset, source: str | Path) -> Dataset:
    """Nothing can be learnt from a view without a valid pixel, and any picture would match it without error."""

    def sees(view: View) -> bool:
        return view.mask is None or bool(view.mask.any())

    train, test = (tuple(filter(sees, views)) for views in (dataset.train, dataset.test))
    left_out = tuple(view.name for view in (*dataset.train, *dataset.test) if not sees(view))
    if not train:
        count = len(dataset.train)
        raise DataError(f"{source}: the masks of all {count} training views hold no valid pixel, expected one at least")
    return replace(dataset, train=train, test=test, left_out=left_out) if left_out else dataset


def _read(source: str | Path, downscale: int, holdout: int) -> Dataset:
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
