"""Exports a level of a scene as explicit Gaussians, and measures the loss of quality.

The decoders take the view direction, so opacity, size, rotation and colour of a Gaussian depend on it. Baking evaluates
them from a set of eyes, each with a weight per anchor. Opacity is the weighted mean over the eyes; an eye that does not
see the Gaussian counts as 0. The weights of covariance and colour are multiplied by opacity. Covariance is a mean;
colours are harmonics fitted by least squares, with a ridge that keeps unseen directions near the mean colour.

No eye sees this average, so refinement then fits the Gaussians to pictures of the scene by gradient descent.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pd4dgs_codec.data.view import View, rotation_matrix
from pd4dgs_codec.draw.gaussians import LEAST_NEAR, near_plane
from pd4dgs_codec.draw.player import Player
from pd4dgs_codec.draw.rasteriser import Geometry, backward, composite, project
from pd4dgs_codec.interchange.splats import (
    Splats,
    harmonics,
    looking,
    picture,
    principal_axes,
    quaternions,
    sphere,
    spread,
    unit,
)
from pd4dgs_codec.quality.frames import shrunk
from pd4dgs_codec.quality.image import mpsnr
from pd4dgs_codec.scene import MIN_OPACITY, Camera

Step = Callable[[], None]
UNTURNED = np.eye(3)
#: Eyes of a bake; more of them change held-out PSNR by less than 0.01 dB.
EYES = 48
#: Anchors baked at a time, which bounds memory to EYES times their Gaussians.
CHUNK = 1024
#: Factor of an eye's weight for anchors outside its picture and margin.
OUTSIDE = 1e-3
#: The ridge on coefficients of degree l is RIDGE times l (l + 1), where the eyes' weights sum to 1.
RIDGE = 1e-4
PIXELS = 400  #: width and height of the pictures of a file without a camera
#: `eyes_of_scene` weighs an eye at the angle a from the file's camera by exp(CONCENTRATION (cos a - 1)).
CONCENTRATION = 2.0
#: Refinement shrinks the eyes' pictures by a whole factor to at most this many pixels.
TARGET_PIXELS = 1 << 17
#: Later times start from the refinement of the previous time and take this share of the steps.
LATER = 0.25
#: Initial learning rates, which decay to LAST of that. The rate of means is relative to a Gaussian's largest scale.
RATES = {"means": 0.02, "quats": 0.01, "log_scales": 0.02, "logits": 0.05, "sh": 0.01}
LAST = 0.1
REST = 0.2  #: factor of the rate for harmonics of degree 1 and above, which 3D Gaussian splatting lowers as well
BETAS, EPSILON = (0.9, 0.99), 1e-15
SMALLEST = np.float32(1e-9)  #: scene units
FAINTEST, STRONGEST = 1e-3, 1 - 1e-4  #: bounds of opacities before their logits are taken


# -- eyes and baking ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Eyes:
    """E cameras that see the scene, and their weights, float64 [E] > 0."""

    cameras: tuple[Camera, ...]
    weights: np.ndarray

    @property
    def places(self) -> np.ndarray:
        """float32 [E, 3], world."""
        return np.stack([camera.eye for camera in self.cameras])


def eyes_of_cameras(cameras: Sequence[Camera]) -> Eyes:
    """Picks EYES cameras, evenly spaced in their order, or all if there are fewer. Their weights are equal."""
    chosen = spread(cameras, EYES)
    return Eyes(chosen, np.ones(len(chosen)))


def eyes_of_scene(player: Player, count: int = EYES) -> Eyes:
    """Places `count` cameras on a sphere around the median of the anchors that the file's camera sees.

    They look at the centre with the distance and intrinsics of that camera; the nearer to it, the higher their weight.
    If the file has no camera, the radius is twice the distance of the farthest active anchor, and weights are equal.
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
        away = camera.eye - middle
        distance = max(float(np.linalg.norm(away)), LEAST_NEAR)
        like, weights = camera, np.exp(CONCENTRATION * (places @ (away / distance) - 1))
    up = np.asarray(info.up, np.float64)
    return Eyes(tuple(looking(middle + distance * d, -d, up, like) for d in places), weights)


def bake(player: Player, t: float, eyes: Eyes, degree: int, turn: np.ndarray = UNTURNED) -> tuple[Splats, np.ndarray]:
    """Returns (Gaussians at normalised time t in 0..1, their slots int64 [N]), without Gaussians too faint to be drawn.

    degree: of the harmonics, 0 to 3. turn: rotation of the world, [3, 3].
    """
    rows, parts, slots = player.active, [], []
    for start in range(0, len(rows), CHUNK):
        chunk = rows[start : start + CHUNK]
        splats, found = _bake(player, chunk, t, eyes, degree, turn)
        keep = np.flatnonzero(splats.opacities >= MIN_OPACITY)
        parts.append(splats.taken(keep))
        slots.append(found[keep])
    if not parts:
        empty = (np.zeros((0, *shape), np.float32) for shape in ((3,), (4,), (3,), (), ((degree + 1) ** 2, 3)))
        return Splats(*empty), np.zeros(0, np.int64)
    joined = (np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0]))
    return Splats(*joined), np.concatenate(slots)


def _inside(camera: Camera, positions: np.ndarray) -> np.ndarray:
    """Returns bool [n]: whether positions [n, 3] project into the picture or a margin of half its size."""
    viewmat, K = camera.viewmat.astype(np.float64), camera.K.astype(np.float64)
    x, y, depth = viewmat[:3, :3] @ positions.T.astype(np.float64) + viewmat[:3, 3:]
    z = np.maximum(depth, LEAST_NEAR)
    u, v = (K[0, 0] * x / z + K[0, 2]) / camera.width, (K[1, 1] * y / z + K[1, 2]) / camera.height
    return np.asarray((depth > 0) & (np.abs(u - 0.5) < 1) & (np.abs(v - 0.5) < 1))


def _bake(
    player: Player, rows: np.ndarray, t: float, eyes: Eyes, degree: int, turn: np.ndarray
) -> tuple[Splats, np.ndarray]:
    g = player.gaussians_of_eyes(rows, t, eyes.places)
    count = len(eyes.places)
    means, slots = g.means.reshape(count, -1, 3)[0], g.slots.reshape(count, -1)[0]
    opacities = g.opacities.reshape(count, -1).astype(np.float64)
    finite = np.isfinite(g.colors).all(axis=1).reshape(count, -1)  # as in Player.picture
    opacities = np.where(finite, opacities, 0)
    colors = np.nan_to_num(g.colors).reshape(count, -1, 3)
    inside = np.stack([_inside(camera, player.positions[rows]) for camera in eyes.cameras])
    prior = eyes.weights[:, None] * np.where(inside, 1.0, OUTSIDE)
    prior = prior[:, np.searchsorted(rows, slots // player.slots)]
    prior /= prior.sum(axis=0)
    weights = prior * opacities
    opacity = weights.sum(axis=0)
    weights /= np.maximum(opacity, np.finfo(np.float64).tiny)
    factor = rotation_matrix(g.quats) * g.scales[:, None, :]
    covariances = (factor @ factor.transpose(0, 2, 1)).reshape(count, -1, 3, 3)
    covariance = np.einsum("ek,ekij->kij", weights, covariances)
    scales, axes = principal_axes(turn @ covariance @ turn.T)
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


def _fitted(basis: np.ndarray, colors: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Fits coefficients float64 [K, J, 3] of basis [E, K, J] to colors [E, K, 3] - 0.5 by least squares with weights
    [E, K], whose sum over the eyes is 1."""
    degrees = np.floor(np.sqrt(np.arange(basis.shape[2])))
    weighted = (basis * weights[..., None]).transpose(1, 2, 0)
    normal = weighted @ basis.transpose(1, 0, 2) + np.diag(RIDGE * degrees * (degrees + 1))
    seen = weights.sum(axis=0) > 0
    normal[~seen] = np.eye(basis.shape[2])
    return np.asarray(np.linalg.solve(normal, weighted @ (colors.transpose(1, 0, 2) - 0.5)))


# -- refinement --------------------------------------------------------------------------------------------------------


#: A camera, and the picture to match, float32 [H, W, 3].
Target = tuple[Camera, np.ndarray]


def refine(
    splats: Splats,
    targets: Mapping[int, Target],
    order: Sequence[int],
    background: tuple[float, float, float],
    near: float,
    step: Step = lambda: None,
) -> Splats:
    """Refines Gaussians by Adam (Kingma and Ba 2015) on the squared error. order: key of each step's target."""
    size = np.maximum(splats.scales.max(axis=1, keepdims=True), SMALLEST)
    values = {
        "means": splats.means / size,
        "quats": splats.quats.copy(),
        "log_scales": np.log(np.maximum(splats.scales, SMALLEST)),
        "logits": logits(splats.opacities),
        "sh": splats.sh.copy(),
    }
    moments = {name: (np.zeros_like(value), np.zeros_like(value)) for name, value in values.items()}
    behind = np.array(background, np.float32)
    for i, which in enumerate(order):
        gradients = _gradients(values, size, *targets[which], behind, near)
        rate = LAST ** (i / max(len(order) - 1, 1))
        for name, gradient in gradients.items():
            first, second = moments[name]
            first += (1 - BETAS[0]) * (gradient - first)
            second += (1 - BETAS[1]) * (gradient * gradient - second)
            corrected = np.sqrt(second / np.float32(1 - BETAS[1] ** (i + 1))) + np.float32(EPSILON)
            change = np.float32(rate * RATES[name] / (1 - BETAS[0] ** (i + 1))) * first / corrected
            if name == "sh":
                change[:, 1:] *= np.float32(REST)
            values[name] -= change
        step()
    return _splats(values, size)


def logits(opacities: np.ndarray) -> np.ndarray:
    """Returns the logits float32 [N] of opacities [N], bounded so that gradients do not vanish."""
    p = np.clip(opacities, FAINTEST, STRONGEST).astype(np.float32)
    return np.asarray(np.log(p / (1 - p)))


def _splats(values: dict[str, np.ndarray], size: np.ndarray) -> Splats:
    return Splats(
        np.ascontiguousarray(values["means"] * size),
        unit(values["quats"]),
        np.exp(values["log_scales"]),
        1 / (1 + np.exp(-values["logits"])),
        values["sh"],
    )


def _gradients(
    values: dict[str, np.ndarray], size: np.ndarray, camera: Camera, image: np.ndarray, behind: np.ndarray, near: float
) -> dict[str, np.ndarray]:
    """Returns the gradients of one picture's mean squared error by the names of `values`."""
    splats = _splats(values, size)
    basis = harmonics(unit(splats.means - camera.eye), splats.degree)
    raw = np.einsum("nj,njc->nc", basis, splats.sh) + np.float32(0.5)
    colors = np.maximum(raw, 0)
    geometry = Geometry(splats.means, splats.quats, splats.scales, splats.opacities)
    projected = project(geometry, camera, near)
    picture, transmittance = composite(projected, colors, behind)
    slope = (2 / picture.size) * (picture - image)
    g = backward(projected, geometry, colors, picture, transmittance, slope, np.zeros_like(transmittance))
    g_quats = g.geometry.quats
    return {
        "means": g.geometry.means * size,
        "quats": g_quats - splats.quats * np.einsum("nd,nd->n", g_quats, splats.quats)[:, None],
        "log_scales": g.geometry.scales * splats.scales,
        "logits": g.geometry.opacities * splats.opacities * (1 - splats.opacities),
        "sh": basis[:, :, None] * (g.colors * (raw > 0))[:, None, :],
    }


# -- export ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Export:
    """Turns a scene into explicit Gaussians. degree: of the harmonics, 0 to 3; steps: of refinement, 0 for none."""

    player: Player
    eyes: Eyes
    degree: int
    steps: int

    def splats(
        self, t: float, turn: np.ndarray = UNTURNED, before: Learnt | None = None, step: Step = lambda: None
    ) -> tuple[Splats, Learnt]:
        """Returns (Gaussians at normalised time t, their changes by refinement). turn: rotation of the world, [3, 3].
        before: changes of another time to start from. step: called after each step of refinement."""
        baked, slots = bake(self.player, t, self.eyes, self.degree, turn)
        started = baked if before is None else before.applied(baked, slots)
        steps = self.steps if before is None else int(np.ceil(LATER * self.steps))
        if not (steps and len(slots)):
            return started, Learnt(slots, baked, started)
        weights, info = self.eyes.weights / self.eyes.weights.sum(), self.player.info
        order = np.random.default_rng(0).choice(len(weights), steps, p=weights).tolist()
        targets = {}
        for i in set(order):
            camera = self.eyes.cameras[i]
            camera = shrunk(camera, int(np.ceil(np.sqrt(camera.width * camera.height / TARGET_PIXELS))))
            targets[i] = turned_camera(camera, turn), self.player.picture(camera, t)
        refined = refine(started, targets, order, self.player.background, near_plane(info), step)
        return refined, Learnt(slots, baked, refined)


@dataclass(frozen=True, eq=False)
class Learnt:
    """The changes by refinement at one time: slots int64 [N] and their Gaussians before and after it."""

    slots: np.ndarray
    baked: Splats
    refined: Splats

    def applied(self, splats: Splats, slots: np.ndarray) -> Splats:
        """Applies the changes to the Gaussians of another time by slot. Sizes and rotations stay, since the order of
        their axes differs from time to time."""
        _, here, there = np.intersect1d(slots, self.slots, assume_unique=True, return_indices=True)
        old, new = self.baked.taken(there), self.refined.taken(there)
        parts = {name: values.copy() for name, values in vars(splats).items()}
        parts["means"][here] += new.means - old.means
        gained = logits(new.opacities) - logits(old.opacities)
        parts["opacities"][here] = 1 / (1 + np.exp(-logits(parts["opacities"][here]) - gained))
        parts["sh"][here] += new.sh - old.sh
        return Splats(**parts)


def upright(up: Sequence[float]) -> np.ndarray:
    """Returns float64 [3, 3]: the smallest rotation that carries the direction `up` to +y."""
    a, b = unit(np.asarray(up, np.float64)), np.array([0.0, 1.0, 0.0])
    if a @ b < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    # reflections along a and a + b: the first turns a round, the second carries -a to b
    return np.asarray(np.eye(3) + 2 * np.outer(b, a) - np.outer(a + b, a + b) / (1 + a @ b))


def turned_camera(camera: Camera, turn: np.ndarray) -> Camera:
    """Rotates a camera together with the world by `turn` [3, 3], so that its picture stays the same."""
    viewmat = camera.viewmat.astype(np.float64)
    viewmat[:3, :3] = viewmat[:3, :3] @ turn.T
    return replace(camera, viewmat=viewmat.astype(np.float32))


def cost(export: Export, views: Sequence[View], step: Step = lambda: None) -> dict[str, float]:
    """Measures the loss by export: each view's time is exported by itself and drawn from the view's camera.

    Returns the number of views and means over them in dB: direct_mpsnr (direct picture against the truth),
    exported_mpsnr (exported against the truth) and exported_to_direct_psnr (exported against direct).
    """
    rows, info = [], export.player.info
    for view in views:
        direct = export.player.picture(view.camera, view.time)
        splats, _ = export.splats(view.time)
        image = picture(splats, view.camera, export.player.background, near_plane(info))
        error = float(np.square(image.astype(np.float64) - direct).mean())
        to_direct = -10 * np.log10(max(error, np.finfo(float).tiny))
        rows.append((mpsnr(direct, view.image, view.mask), mpsnr(image, view.image, view.mask), to_direct))
        step()
    names = ("direct_mpsnr", "exported_mpsnr", "exported_to_direct_psnr")
    return {"views": len(views), **dict(zip(names, np.mean(rows, axis=0).tolist(), strict=True))}
