"""The bodies of the synthetic scenes, four in a room and others alone on white, and an analytic ray caster for them.

Every body is a unit shape (sphere |m| <= 1, box |m_i| <= 1, cylinder m_x² + m_y² <= 1, |m_z| <= 1) in its own material
coordinates m, placed by an affine map that depends on time: x = A(t) m + c(t). The material coordinates of a surface
point stay constant in any motion, including stretching.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

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
    """A body at one instant: x = A m + c, m = inverse (x - c). radius: of a ball around the inscribed ellipsoid."""

    body: Body
    A: np.ndarray
    c: np.ndarray
    inverse: np.ndarray
    radius: float


def place(bodies: Sequence[Body], t: float) -> list[Placed]:
    """Places all bodies at time t."""
    poses = [b.pose(t) for b in bodies]
    return [
        Placed(b, A, c, np.linalg.inv(A), float(np.linalg.norm(A, 2))) for b, (A, c) in zip(bodies, poses, strict=True)
    ]


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
    middle = (world.min(axis=1) + world.max(axis=1)) / 2
    radius = float(np.linalg.norm(world.max(axis=1) - middle))
    for i, body in enumerate(placed):
        if i == own or not body.body.casts:
            continue
        gap = middle - body.c
        if gap @ gap - (gap @ LIGHT) ** 2 > (radius + high * body.radius) ** 2:
            continue  # seen along the light, they are apart
        towards = body.inverse @ LIGHT
        towards = (towards / np.linalg.norm(towards)).astype(world.dtype)
        m = material(body, world)
        along = towards @ m
        square = (m * m).sum(axis=0) - along * along
        near = np.flatnonzero(square < high * high)
        miss, along = np.sqrt(np.maximum(square[near], 0)), along[near]
        s = np.clip((miss - low) / (high - low), 0, 1)
        # Points past the body's centre towards the light (along > 0) are lit; the fade avoids a visible edge.
        result[near] *= np.maximum(s * s * (3 - 2 * s), np.clip(along + 1, 0, 1))
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


# -- scenes in a room --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Motion:
    """The motion of a scene over t = 0..1. Amplitudes in radians or shares, rates in turns (cycles) over that time."""

    sway: float = 0.0  #: rotation of the platform and the bodies on it
    heave: float = 0.0  #: rise of the platform, scene units
    swing: float = 0.0  #: the arm on the column
    swing_rate: float = 2.0
    pulse: float = 0.0  #: stretching of the ball
    tint: float = 0.0  #: colour change of the plank
    spin: float = 0.0  #: turns of the crate
    hops: float = 0.0  #: bounces of the two balls
    orbit: float = 0.0  #: turns of the runner around the platform


Size = Sequence[float]  #: of three axes
#: Rotation [3, 3], shift [3] and stretch per axis [3] of a body at an instant, relative to its place.
Local = tuple[np.ndarray, np.ndarray, np.ndarray]

MOTIONS = {
    "static": Motion(),
    "global": Motion(sway=0.7, heave=0.08),
    "local": Motion(sway=0.3, swing=0.6, pulse=0.16, tint=0.55),
    "fast": Motion(swing=1.0, swing_rate=6.0, spin=2.5, hops=6.0, orbit=1.5),
}


def rotation(axis: int, angle: float) -> np.ndarray:
    """Rotation about a coordinate axis."""
    c, s = np.cos(angle), np.sin(angle)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    r = np.eye(3)
    r[i, i], r[i, j], r[j, i], r[j, j] = c, -s, s, c
    return r


class Painter:
    """Makes paints from a seed."""

    def __init__(self, seed: int):
        self.rng = np.random.default_rng(seed)
        self.hue = self.rng.uniform()

    def paint(
        self, size: Size, hue: float, wave: float, axes: tuple[int, int] = (0, 2), strength: float = 0.45
    ) -> Paint:
        """Two shades of a hue in checks along two axes, `wave` radians per unit."""
        rng = self.rng
        angle = 2 * np.pi * (hue + self.hue + np.array([0, 1 / 3, 2 / 3]))
        base = 0.56 + 0.34 * np.cos(angle)
        waves, (a, b) = np.zeros((2, 4)), axes
        waves[:, a], waves[0, b], waves[1, b], waves[:, 3] = wave, wave, -wave, rng.uniform(0, 6, 2)
        direction = rng.normal(size=(4, 3))
        direction *= rng.uniform(9, 26, (4, 1)) / np.linalg.norm(direction, axis=1, keepdims=True)
        detail = np.concatenate([direction, rng.uniform(0, 6, (4, 1))], axis=1)
        high = np.clip(base + 0.25, 0, 1)
        return Paint(base * (1 - strength), high, waves, detail, np.asarray(size, float))


class RoomBuilder(Painter):
    """Builds the bodies of a scene in the room."""

    def __init__(self, name: str, seed: int):
        super().__init__(seed)
        self.motion = MOTIONS[name]

    def group(self, t: float) -> Pose:
        """Rotation and position of the platform."""
        m = self.motion
        angle = m.sway * np.sin(2 * np.pi * 0.75 * t)
        return rotation(2, angle), np.array([0, 0, m.heave * np.sin(np.pi * t) ** 2])

    def fixed(self, shape: str, size: Size, at: Size, *look: Any, casts: bool = False, **more: Any) -> Body:
        """A body that never moves. look, more: arguments of `paint`. casts: False for floor and wall."""
        pose = np.diag(np.asarray(size, float)), np.asarray(at, float)
        return Body(shape, lambda t: pose, self.paint(size, *look, **more), casts)

    def riding(
        self, shape: str, size: Size, at: Size, *look: Any, local: Callable[[float], Local] | None = None, **more: Any
    ) -> Body:
        """A body on the platform; `local` is its motion there."""
        half = np.asarray(size, float)
        yaw = rotation(2, self.rng.uniform(-0.4, 0.4))
        place = np.asarray(at, float) + np.array([*self.rng.uniform(-0.05, 0.05, 2), 0])

        def pose(t: float) -> Pose:
            R, p = self.group(t)
            turn, shift, stretch = local(t) if local else (np.eye(3), np.zeros(3), np.ones(3))
            return R @ turn @ yaw @ np.diag(half * stretch), R @ (place + shift) + p

        return Body(shape, pose, self.paint(size, *look, **more))

    def arm(self) -> list[Body]:
        """A rod that swings about the top of the column, with a bob at its end."""
        m, pivot, reach = self.motion, np.array([0.15, 0.35, 1.17]), 0.36
        rest = self.rng.uniform(0.4, 0.9)

        def part(size: Size, along: float) -> Callable[[float], Pose]:
            def pose(t: float) -> Pose:
                R, p = self.group(t)
                turn = R @ rotation(1, rest + m.swing * np.sin(2 * np.pi * m.swing_rate * t))
                return turn @ np.diag(size), R @ pivot + p + turn @ np.array([along, -0.2, 0])

            return pose

        rod, bob = (reach, 0.05, 0.05), (0.15, 0.15, 0.15)
        return [
            Body("box", part(rod, 0.6 * reach), self.paint(rod, 0.1, 9.0)),
            Body("sphere", part(bob, 1.7 * reach), self.paint(bob, 0.75, 14.0)),
        ]

    def bodies(self) -> list[Body]:
        """All bodies, the fixed ones first."""
        m = self.motion
        one, still = np.ones(3), np.eye(3)

        def hop(t: float, phase: float, height: float) -> np.ndarray:
            bounce = height * abs(np.sin(np.pi * (m.hops * t + phase))) if m.hops else 0.0
            return np.array([0, 0, bounce])

        def ball(t: float) -> Local:
            s = m.pulse * np.sin(2 * np.pi * 3 * t)
            return still, hop(t, 0.0, 0.55) + [0, 0, 0.3 * s], np.array([1 - 0.5 * s, 1 - 0.5 * s, 1 + s])

        def small(t: float) -> Local:
            return still, hop(t, 0.4, 0.8), one

        def crate(t: float) -> Local:
            return rotation(2, 2 * np.pi * m.spin * t), np.zeros(3), one

        def runner(t: float) -> Local:
            angle = 2 * np.pi * m.orbit * t
            return still, 1.5 * np.array([np.cos(angle) - 1, np.sin(angle), 0]), one

        def tint(t: float) -> np.ndarray:
            s = m.tint * np.sin(np.pi * 2 * t) ** 2
            return np.array([1 - s, 1 - 0.4 * s, 1 + 0.6 * s])

        plank = self.riding("box", (0.1, 0.38, 0.24), (-0.62, 0.42, 0.34), 0.55, 11.0, axes=(1, 2))
        return [
            self.fixed("box", (2.6, 2.4, 0.05), (0, -0.1, -0.05), 0.08, 5.5, axes=(0, 1), strength=0.3),
            self.fixed("box", (2.6, 0.05, 1.2), (0, 2.3, 1.2), 0.6, 3.5, strength=0.18),
            self.fixed("box", (0.22, 0.22, 0.75), (1.9, 1.5, 0.75), 0.3, 8.0, casts=True),
            self.fixed("sphere", (0.42, 0.42, 0.42), (-1.8, 1.2, 0.42), 0.9, 7.0, casts=True),
            self.riding("cylinder", (1.15, 1.15, 0.05), (0, 0, 0.05), 0.15, 6.0, axes=(0, 1)),
            self.riding("cylinder", (0.12, 0.12, 0.55), (0.15, 0.42, 0.65), 0.45, 10.0),
            replace(plank, paint=replace(plank.paint, tint=tint if m.tint else None)),
            self.riding("box", (0.26, 0.26, 0.26), (-0.42, -0.3, 0.36), 0.0, 9.0, local=crate),
            self.riding("sphere", (0.3, 0.3, 0.3), (0.5, -0.3, 0.4), 0.33, 9.0, local=ball),
            self.riding("sphere", (0.16, 0.16, 0.16), (-0.42, -0.3, 0.78), 0.7, 12.0, local=small),
            self.riding("sphere", (0.14, 0.14, 0.14), (1.5, 0, 0.14), 0.2, 14.0, local=runner),
            *self.arm(),
        ]


# -- scenes on white ---------------------------------------------------------------------------------------------------

Point = tuple[float, float, float]
pi = np.pi


@dataclass(frozen=True)
class Thing:
    """A body of a scene on white: half sizes, centre and rotation, as functions of t = 0..1 if they change."""

    shape: str
    size: Point
    at: Point | Callable[[float], Point | np.ndarray]
    turn: Callable[[float], np.ndarray] = lambda t: np.eye(3)

    def pose(self, t: float) -> Pose:
        at = self.at(t) if callable(self.at) else self.at
        return self.turn(t) @ np.diag(self.size), np.asarray(at, float)


#: The bodies of the scenes on white, within 1.2 of the origin.
THINGS: dict[str, tuple[Thing, ...]] = {
    "flyby": (  # a ball flies past a cube
        Thing("box", (0.4, 0.4, 0.4), (0.0, 0.1, -0.2)),
        Thing("sphere", (0.18, 0.18, 0.18), lambda t: (2 * t - 1, -0.65, 0.55 - 2.4 * (t - 0.5) ** 2)),
    ),
    "dart": (  # a small ball flies fast
        Thing(
            "sphere",
            (0.1, 0.1, 0.1),
            lambda t: (0.9 * np.sin(6 * pi * t), 0.9 * np.cos(4 * pi * t), 0.5 * np.sin(10 * pi * t)),
        ),
    ),
    "rods": (  # thin rods turn, swing and slide
        Thing("cylinder", (0.025, 0.025, 0.9), (0.0, -0.5, 0.1), lambda t: rotation(0, 0.5) @ rotation(1, 4 * pi * t)),
        Thing("cylinder", (0.025, 0.025, 0.7), (0.0, 0.5, 0.0), lambda t: rotation(1, np.sin(6 * pi * t))),
        Thing("box", (0.02, 0.8, 0.02), lambda t: (0.9 * np.cos(2 * pi * t), 0.0, 0.7)),
        Thing("cylinder", (0.03, 0.03, 0.6), (0.6, 0.0, -0.2)),
    ),
}


def bodies(name: str, seed: int) -> list[Body]:
    """All bodies of a scene of MOTIONS or THINGS, the fixed ones of a room first. On white the seed changes the paints
    and rotates the scene."""
    if name in MOTIONS:
        return RoomBuilder(name, seed).bodies()
    painter = Painter(seed)
    facing = rotation(2, painter.rng.uniform(0, 2 * pi))

    def pose(thing: Thing, t: float) -> Pose:
        shape, at = thing.pose(t)
        return facing @ shape, facing @ at

    hues = {"box": 0.0, "sphere": 0.37, "cylinder": 0.74}
    return [
        Body(thing.shape, partial(pose, thing), painter.paint(thing.size, hues[thing.shape], 9.0))
        for thing in THINGS[name]
    ]
