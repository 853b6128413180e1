"""A dataset as training and evaluation use it: posed images, their split, and the geometry of the scene."""

from dataclasses import dataclass

import numpy as np

from pd4dgs_codec.scene import Camera

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
    """A scene's images, split into training and test views, with its geometry.

    points: float32 [M, 3], scene units, or None.
    box: float32 [2, 3], lower and upper corner of the content: normalisation box of the HexPlanes and the
        volume of random initial points.
    near, far: scene units along the optical axis. background: 0..1 per channel. time_range: seconds at normalised
        time 0 and 1, (0, 1) if unknown. up: unit vector, world.
    masked: True if the test masks are covisibility masks. left_out: names of views in neither split, as their masks
        hold no valid pixel.
    """

    name: str
    train: tuple[View, ...]
    test: tuple[View, ...]
    points: np.ndarray | None
    box: np.ndarray
    near: float
    far: float
    background: tuple[float, float, float]
    time_range: tuple[float, float]
    up: tuple[float, float, float]
    masked: bool
    left_out: tuple[str, ...] = ()

    @property
    def camera(self) -> Camera:
        """The default camera: that of the first training view."""
        return self.train[0].camera

    def remarks(self) -> list[str]:
        """Limits of this data for training and evaluation, a line each."""
        remarks = []
        if self.left_out:
            names = ", ".join(self.left_out[:REMARKED]) + (", ..." if len(self.left_out) > REMARKED else "")
            count = f"{len(self.left_out)} of {len(self.train) + len(self.test) + len(self.left_out)} views"
            remarks.append(f"{count} left out, no valid pixel in the mask: {names}")
        if len({view.time for view in self.train}) == 1:
            remarks.append("all training views show one instant: levels 1 and 2 cannot learn motion")
        first = self.train[0].viewmat
        if all(np.array_equal(view.viewmat, first) for view in self.train):
            remarks.append("all training views are from one viewpoint: depth is unknown, other viewpoints look wrong")
        return remarks
