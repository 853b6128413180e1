"""An analytic ray caster for moving convex bodies, in numpy.

Every body is a unit shape (sphere |m| <= 1, box |m_i| <= 1, cylinder m_x² + m_y² <= 1, |m_z| <= 1) in its own material
coordinates m, placed by an affine map that depends on time: x = A(t) m + c(t). The material coordinates of a surface
point stay constant in any motion, including stretching.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

Pose = tuple[np.ndarray, np.ndarray]  #: A [3, 3] and c [3], float64

LIGHT = np.array([0.42, -0.58, 0.70]) / np.linalg.norm([0.42, -0.58, 0.70])  #: direction to the light
AMBIENT, DIFFUSE = 0.42, 0.68
NO_BODY = -1
CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)]).T
#: Shadows fade between these distances of the light ray from a body's centre, in radii of its inscribed ellipsoid.
PENUMBRA = (0.8, 1.25)


@dataclass(frozen=True, eq=False)
class Paint:
    """A procedural albedo: two colours mixed by a wave pattern, with fine detail on top.

    low, high: RGB 0..1. waves: [2, 4] rows (wave vector, phase); the sum of their sines mixes the colours, and two
    crossed waves make a checkerboard. detail: [n, 4] such rows. Wave vectors are in radians per scene unit of `size`
    (half sizes [3]) times m. tint: colour factor over time, or None.
    """

    low: np.ndarray
    high: np.ndarray
    waves: np.ndarray
    detail: np.ndarray
    size: np.ndarray
    tint: Callable[[float], np.ndarray] | None = None

    def albedo(self, m: np.ndarray, t: float) -> np.ndarray:
        """RGB [3, n] at material points [3, n] at time t."""

        def sines(rows: np.ndarray) -> np.ndarray:
            vectors = (rows[:, :3] * self.size).astype(m.dtype)
            return np.asarray(np.sin(vectors @ m + rows[:, 3:].astype(m.dtype)).sum(axis=0))

        mix = 0.5 + 0.5 * np.tanh(2.5 * sines(self.waves))
        color = self.low[:, None] + (self.high - self.low)[:, None] * mix
        color = color * (1.0 + 0.07 * sines(self.detail))
        return np.asarray(color * self.tint(t)[:, None] if self.tint else color)


@dataclass(frozen=True, eq=False)
class Body:
    """shape: "sphere", "box" or "cylinder"; pose: A(t), c(t); casts: whether it casts a shadow."""

    shape: str
    pose: Callable[[float], Pose]
    paint: Paint
    casts: bool = True


@dataclass(frozen=True, eq=False)
class Placed:
    """A body at one instant: x = A m + c, m = inverse (x - c)."""

    body: Body
    A: np.ndarray
    c: np.ndarray
    inverse: np.ndarray


def place(bodies: Sequence[Body], t: float) -> list[Placed]:
    """All bodies at time t."""
    poses = [b.pose(t) for b in bodies]
    return [Placed(b, A, c, np.linalg.inv(A)) for b, (A, c) in zip(bodies, poses, strict=True)]


def _slab(o: float, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Entry and exit of |o + s d| <= 1."""
    inverse = 1.0 / np.where(np.abs(d) < 1e-9, d.dtype.type(1e-9), d)
    a, b = (-1.0 - o) * inverse, (1.0 - o) * inverse
    return np.minimum(a, b), np.maximum(a, b)


def _round(o: np.ndarray, d: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Entry and exit of |o + s d| <= 1 over the given axes; (inf, -inf) on a miss."""
    a = sum(x * x for x in d)
    a = np.maximum(a, a.dtype.type(1e-12))
    b = sum(p * x for p, x in zip(o.tolist(), d, strict=True))
    disc = b * b - a * (float(o @ o) - 1.0)
    root, miss = np.sqrt(np.maximum(disc, 0.0)), disc <= 0
    return np.where(miss, np.inf, (-b - root) / a), np.where(miss, -np.inf, (-b + root) / a)


def enter(shape: str, o: np.ndarray, d: list[np.ndarray]) -> np.ndarray:
    """Smallest s > 0 at which the ray o + s d enters the unit shape from outside; inf on a miss.

    o: [3] material origin (one for all rays); d: three arrays of material directions.
    """
    if shape == "sphere":
        near, far = _round(o, d)
    elif shape == "cylinder":
        near, far = _round(o[:2], d[:2])
        low, high = _slab(float(o[2]), d[2])
        near, far = np.maximum(near, low), np.minimum(far, high)
    else:
        spans = [_slab(float(p), x) for p, x in zip(o, d, strict=True)]
        near = np.maximum(np.maximum(spans[0][0], spans[1][0]), spans[2][0])
        far = np.minimum(np.minimum(spans[0][1], spans[1][1]), spans[2][1])
    return np.where((near < far) & (near > 0), near, np.inf)


def normal(shape: str, m: np.ndarray) -> np.ndarray:
    """Outward material normal [3, n], not normalised, at surface points m [3, n]."""
    if shape == "sphere":
        return m
    if shape == "cylinder":
        cap = np.abs(m[2]) >= np.sqrt(m[0] * m[0] + m[1] * m[1])
        return np.where(cap, np.stack([0 * m[0], 0 * m[1], m[2]]), np.stack([m[0], m[1], 0 * m[2]]))
    return np.where(np.abs(m) == np.abs(m).max(axis=0), np.sign(m), 0)


class Eye:
    """A pinhole camera and placed bodies. Rays are x, y at depth 1 (camera axes), so distance along them is depth."""

    def __init__(self, placed: Sequence[Placed], viewmat: np.ndarray):
        self.placed, self.viewmat = placed, viewmat
        self.center = -viewmat[:3, :3].T @ viewmat[:3, 3]

    def bounds(self, body: Placed) -> tuple[float, float, float, float]:
        """x and y range of the body's bounding parallelepiped at depth 1; infinite if it reaches behind the camera."""
        x, y, z = self.viewmat[:3, :3] @ (body.A @ CORNERS + body.c[:, None]) + self.viewmat[:3, 3:]
        if z.min() < 0.05:
            return -np.inf, np.inf, -np.inf, np.inf
        return (x / z).min(), (x / z).max(), (y / z).min(), (y / z).max()

    def enter(self, body: Placed, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Depth at which the rays (x, y), broadcast together, enter the body; inf on a miss."""
        turn = body.inverse @ self.viewmat[:3, :3].T
        d = [x * float(r[0]) + (y * float(r[1]) + x.dtype.type(r[2])) for r in turn]
        return enter(body.body.shape, body.inverse @ (self.center - body.c), d)

    def first_hits(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Depth (inf = none) and body index (NO_BODY = none), both [len(y), len(x)], for a grid of rays."""
        depth = np.full((len(y), len(x)), np.inf, x.dtype)
        index = np.full(depth.shape, NO_BODY, np.int16)
        for i, body in enumerate(self.placed):
            x0, x1, y0, y1 = self.bounds(body)
            cols, rows = (slice(*np.searchsorted(a, [lo, hi])) for a, lo, hi in ((x, x0, x1), (y, y0, y1)))
            found = self.enter(body, x[None, cols], y[rows, None])
            closer = found < depth[rows, cols]
            depth[rows, cols] = np.where(closer, found, depth[rows, cols])
            index[rows, cols] = np.where(closer, i, index[rows, cols])
        return depth, index

    def hidden(self, x: np.ndarray, y: np.ndarray, depth: np.ndarray, own: np.ndarray) -> np.ndarray:
        """bool [n]: a body other than `own` [n] is closer than `depth` [n] on the ray (x, y).

        The shapes are convex, so a body never hides its own front; the caller excludes backs.
        """
        result = np.zeros(len(x), bool)
        for i, body in enumerate(self.placed):
            x0, x1, y0, y1 = self.bounds(body)
            some = np.flatnonzero((x >= x0) & (x <= x1) & (y >= y0) & (y <= y1) & (own != i) & ~result)
            result[some] = self.enter(body, x[some], y[some]) < depth[some] * (1 - 1e-9)
        return result

    def world(self, x: np.ndarray, y: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """World points [3, n] on the rays (x, y) at the given depths."""
        rotation = self.viewmat[:3, :3].T.astype(x.dtype)
        along = rotation @ np.stack([x * depth, y * depth, depth])
        return np.asarray(along + self.center.astype(x.dtype)[:, None])


def material(body: Placed, world: np.ndarray) -> np.ndarray:
    """Material coordinates [3, n] of world points [3, n]."""
    return np.asarray(body.inverse.astype(world.dtype) @ (world - body.c.astype(world.dtype)[:, None]))


def light_reaching(placed: Sequence[Placed], own: int, world: np.ndarray) -> np.ndarray:
    """Share of the light, 0..1 [n], that reaches `world` [3, n] past the ellipsoids inscribed in the other bodies."""
    low, high = PENUMBRA
    result = np.ones(world.shape[1], world.dtype)
    for i, body in enumerate(placed):
        if i == own or not body.body.casts:
            continue
        towards = body.inverse @ LIGHT
        towards = (towards / np.linalg.norm(towards)).astype(world.dtype)
        m = material(body, world)
        along = towards @ m
        miss = np.sqrt(np.maximum((m * m).sum(axis=0) - along * along, 0))
        s = np.clip((miss - low) / (high - low), 0, 1)
        # Points past the body's centre towards the light (along > 0) are lit; the fade avoids a visible edge.
        s = np.maximum(s * s * (3 - 2 * s), np.clip(along + 1, 0, 1))
        result *= s
    return result


def shade(placed: Sequence[Placed], own: int, world: np.ndarray, t: float) -> np.ndarray:
    """RGB 0..1 [3, n] of surface points of body `own`: Lambert and ambient light with soft shadows."""
    body = placed[own]
    m = material(body, world)
    n = body.inverse.T.astype(world.dtype) @ normal(body.body.shape, m)
    n = n / np.maximum(np.linalg.norm(n, axis=0), 1e-12)
    lambert = np.maximum(LIGHT.astype(world.dtype) @ n, 0) * light_reaching(placed, own, world)
    strength = AMBIENT * (0.85 + 0.15 * n[2]) + DIFFUSE * lambert
    return np.asarray(np.clip(body.body.paint.albedo(m, t) * strength, 0, 1))
