"""A decoded scene's Gaussians at an instant, made independent of the eye but for colours in spherical harmonics.

The scaffold's networks take the direction from the eye, so opacity, size, rotation and colour of a Gaussian differ from
eye to eye. What is kept is found from a set of eyes, each with a weight per anchor. The opacity is its weighted mean
over the eyes, 0 where an eye does not see the Gaussian. The covariance is its mean weighted by the eyes' weights times
the opacities that they see. The colours are harmonics by least squares over the eyes' directions with those same
weights, with a ridge that keeps what no eye has seen near the mean.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pd4dgs_codec.data.cameras import rotation_matrix
from pd4dgs_codec.draw.gaussians import LEAST_NEAR, MIN_OPACITY
from pd4dgs_codec.draw.player import Player
from pd4dgs_codec.interchange.splats import Splats, camera_eye, harmonics, looking, quaternions, sphere, spread, unit
from pd4dgs_codec.scene import Camera

#: Eyes that a bake asks: more change held-out PSNR by less than 0.01 dB.
EYES = 48
#: Anchors at a time; what is in memory at once is EYES times their Gaussians.
CHUNK = 1024
#: Weight of an eye whose picture an anchor is outside of.
OUTSIDE = 1e-3
#: Of the ridge on the coefficients of degree l: RIDGE times l (l + 1), in shares of the eyes' weight.
RIDGE = 1e-4
PIXELS = 400  #: sides of the pictures of a file without a camera
#: Without a dataset's cameras, an eye turned away by the angle a counts exp(CONCENTRATION (cos a - 1)).
CONCENTRATION = 2.0


@dataclass(frozen=True, eq=False)
class Eyes:
    """From where a scene is seen: E cameras and how much each counts, float64 [E] > 0."""

    cameras: tuple[Camera, ...]
    weights: np.ndarray

    @property
    def places(self) -> np.ndarray:
        """float32 [E, 3], world."""
        return np.stack([camera_eye(camera) for camera in self.cameras]).astype(np.float32)

    def weigh(self, positions: np.ndarray) -> np.ndarray:
        """float64 [E, n]: each eye's weight for the anchors at positions [n, 3], times OUTSIDE out of its picture."""
        inside = np.stack([_inside(camera, positions) for camera in self.cameras])
        weights: np.ndarray = self.weights[:, None] * np.where(inside, 1.0, OUTSIDE)
        return weights


def eyes_of_cameras(cameras: Sequence[Camera], count: int = EYES) -> Eyes:
    """`count` of the cameras, evenly spaced in their order; all of them if there are fewer."""
    chosen = spread(cameras, count)
    return Eyes(chosen, np.ones(len(chosen)))


def eyes_of_scene(player: Player, count: int = EYES) -> Eyes:
    """Cameras on a sphere around what the file's camera looks at (the median of the anchors in its picture), at its
    distance and with its lens, looking at the middle; near the file's camera they count more.

    Without a camera in the file: around all active anchors, as far away as they reach, and all the same.
    """
    info, camera = player.info, player.info.camera
    positions = player.positions[player.active].astype(np.float64)
    if camera is not None and len(positions) and (seen := _inside(camera, positions)).any():
        positions = positions[seen]
    middle = np.median(positions, axis=0) if len(positions) else np.zeros(3)
    places = sphere(count)
    if camera is None:
        distance = 2 * float(np.linalg.norm(positions - middle, axis=1).max(initial=LEAST_NEAR))
        K = np.array([[PIXELS, 0, PIXELS / 2], [0, PIXELS, PIXELS / 2], [0, 0, 1]], np.float32)
        like, weights = Camera(np.eye(4, dtype=np.float32), K, PIXELS, PIXELS), np.ones(count)
    else:
        away = camera_eye(camera) - middle
        distance = max(float(np.linalg.norm(away)), LEAST_NEAR)
        like, weights = camera, np.exp(CONCENTRATION * (places @ (away / distance) - 1))
    up = np.asarray(info.up, np.float64)
    return Eyes(tuple(looking(middle + distance * d, -d, up, like) for d in places), weights)


def bake(
    player: Player, t: float, eyes: Eyes, degree: int, turn: np.ndarray | None = None
) -> tuple[Splats, np.ndarray]:
    """(Gaussians at normalised time t in 0..1, their slots int64 [N]), those fainter than any pixel shows left out.

    degree: of the harmonics, 0 to 3. turn: a rotation [3, 3] of the world; the Gaussians are then those of the turned
    world.
    """
    turned = np.eye(3) if turn is None else np.asarray(turn, np.float64)
    rows, parts, slots = player.active, [], []
    for start in range(0, len(rows), CHUNK):
        chunk = rows[start : start + CHUNK]
        splats, found = _bake(player, chunk, t, eyes, degree, turned)
        keep = np.flatnonzero(splats.opacities >= MIN_OPACITY)
        parts.append(splats.taken(keep))
        slots.append(found[keep])
    if not parts:
        empty = (np.zeros((0, *shape), np.float32) for shape in ((3,), (4,), (3,), (), ((degree + 1) ** 2, 3)))
        return Splats(*empty), np.zeros(0, np.int64)
    joined = (np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0]))
    return Splats(*joined), np.concatenate(slots)


def _inside(camera: Camera, positions: np.ndarray) -> np.ndarray:
    """bool [n]: whether positions [n, 3] lie in the camera's picture or half its size around it."""
    viewmat, K = camera.viewmat.astype(np.float64), camera.K.astype(np.float64)
    x, y, depth = viewmat[:3, :3] @ positions.T.astype(np.float64) + viewmat[:3, 3:]
    z = np.maximum(depth, LEAST_NEAR)
    u, v = (K[0, 0] * x / z + K[0, 2]) / camera.width, (K[1, 1] * y / z + K[1, 2]) / camera.height
    inside: np.ndarray = (depth > 0) & (np.abs(u - 0.5) < 1) & (np.abs(v - 0.5) < 1)
    return inside


def _bake(
    player: Player, rows: np.ndarray, t: float, eyes: Eyes, degree: int, turn: np.ndarray
) -> tuple[Splats, np.ndarray]:
    g = player.gaussians_of_eyes(rows, t, eyes.places)
    count = len(eyes.places)
    means, slots = g.means.reshape(count, -1, 3)[0], g.slots.reshape(count, -1)[0]
    opacities = g.opacities.reshape(count, -1).astype(np.float64)
    finite = np.isfinite(g.colors).all(axis=1).reshape(count, -1)  # as in pictures: what overflowed is not seen
    opacities = np.where(finite, opacities, 0)
    colors = np.nan_to_num(g.colors).reshape(count, -1, 3)
    prior = eyes.weigh(player.positions[rows])
    prior = prior[:, np.searchsorted(rows, slots // player.slots)]
    prior /= prior.sum(axis=0)
    weights = prior * opacities
    opacity = weights.sum(axis=0)
    weights /= np.maximum(opacity, np.finfo(np.float64).tiny)
    covariance = np.einsum("ek,ekij->kij", weights, _covariances(g.quats, g.scales).reshape(count, -1, 3, 3))
    scales, axes = _principal_axes(turn @ covariance @ turn.T)
    places = eyes.places.astype(np.float64)
    directions = unit(means[None].astype(np.float64) - places[:, None]) @ turn.T
    splats = Splats(
        means=(means @ turn.T).astype(np.float32),
        quats=quaternions(axes).astype(np.float32),
        scales=scales.astype(np.float32),
        opacities=np.minimum(opacity, 1).astype(np.float32),
        sh=_fitted(harmonics(directions, degree), colors, weights).astype(np.float32),
    )
    finite = np.isfinite(splats.means).all(axis=1) & np.isfinite(splats.scales).all(axis=1) & (opacity > 0)
    return splats.taken(finite), slots[finite]


def _covariances(quats: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """float64 [n, 3, 3]."""
    factor = rotation_matrix(quats) * scales[:, None, :]
    product: np.ndarray = factor @ factor.transpose(0, 2, 1)
    return product


def _principal_axes(covariances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(standard deviations [n, 3], rotations [n, 3, 3] whose columns are their axes); NaN where there are none."""
    finite = np.isfinite(covariances).all(axis=(1, 2))
    values, axes = np.linalg.eigh(np.where(finite[:, None, None], covariances, np.eye(3)))
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    return np.where(finite[:, None], np.sqrt(np.maximum(values, 0)), np.nan), axes


def _fitted(basis: np.ndarray, colors: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """float64 [K, J, 3]: coefficients of basis [E, K, J] for colors [E, K, 3] - 0.5 by least squares with weights
    [E, K], whose sum over the eyes is 1."""
    degrees = np.floor(np.sqrt(np.arange(basis.shape[2])))
    weighted = (basis * weights[..., None]).transpose(1, 2, 0)
    normal = weighted @ basis.transpose(1, 0, 2) + np.diag(RIDGE * degrees * (degrees + 1))
    seen = weights.sum(axis=0) > 0
    normal[~seen] = np.eye(basis.shape[2])
    fitted: np.ndarray = np.linalg.solve(normal, weighted @ (colors.transpose(1, 0, 2) - 0.5))
    return fitted
