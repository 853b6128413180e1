"""The bodies of the synthetic scenes: four in a room, which share their objects and differ in motion, and those that
stand alone on white."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from pd4dgs_codec.data.raycast import Body, Paint, Pose


@dataclass(frozen=True)
class Motion:
    """The motion of a scene over t = 0..1. Amplitudes in radians or shares, rates in turns (cycles) over that time."""

    sway: float = 0.0  #: turning of the platform with all that stands on it
    heave: float = 0.0  #: its rise, scene units
    swing: float = 0.0  #: the arm on the column
    swing_rate: float = 2.0
    pulse: float = 0.0  #: stretching of the ball
    tint: float = 0.0  #: colour change of the plank
    spin: float = 0.0  #: turns of the crate
    hops: float = 0.0  #: bounces of the two balls
    orbit: float = 0.0  #: turns of the runner around the platform


Size = Sequence[float]  #: of three axes
#: Rotation [3, 3], shift [3] and stretch per axis [3] of a body at an instant, on top of its place.
Local = tuple[np.ndarray, np.ndarray, np.ndarray]

MOTIONS = {
    "static": Motion(),
    "global": Motion(sway=0.7, heave=0.08),
    "local": Motion(sway=0.3, swing=0.6, pulse=0.16, tint=0.55),
    "fast": Motion(swing=1.0, swing_rate=6.0, spin=2.5, hops=6.0, orbit=1.5),
}


def _turn(axis: int, angle: float) -> np.ndarray:
    """Rotation about a coordinate axis."""
    c, s = np.cos(angle), np.sin(angle)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    r = np.eye(3)
    r[i, i], r[i, j], r[j, i], r[j, j] = c, -s, s, c
    return r


class Painter:
    """Paints that depend on a seed."""

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
        return _turn(2, angle), np.array([0, 0, m.heave * np.sin(np.pi * t) ** 2])

    def fixed(self, shape: str, size: Size, at: Size, *look: Any, casts: bool = False, **more: Any) -> Body:
        """A body that never moves. look, more: of its paint. casts: False for floor and wall."""
        pose = np.diag(np.asarray(size, float)), np.asarray(at, float)
        return Body(shape, lambda t: pose, self.paint(size, *look, **more), casts)

    def riding(
        self, shape: str, size: Size, at: Size, *look: Any, local: Callable[[float], Local] | None = None, **more: Any
    ) -> Body:
        """A body on the platform; `local` is its motion there."""
        half = np.asarray(size, float)
        yaw = _turn(2, self.rng.uniform(-0.4, 0.4))
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
                turn = R @ _turn(1, rest + m.swing * np.sin(2 * np.pi * m.swing_rate * t))
                return turn @ np.diag(size), R @ pivot + p + turn @ np.array([along, -0.2, 0])

            return pose

        rod, bob = (reach, 0.05, 0.05), (0.15, 0.15, 0.15)
        return [
            Body("box", part(rod, 0.6 * reach), self.paint(rod, 0.1, 9.0)),
            Body("sphere", part(bob, 1.7 * reach), self.paint(bob, 0.75, 14.0)),
        ]

    def bodies(self) -> list[Body]:
        """All bodies, the still ones first."""
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
            return _turn(2, 2 * np.pi * m.spin * t), np.zeros(3), one

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
GONE = 1e-4  #: the stretch of a body that is not there
pi = np.pi


@dataclass(frozen=True)
class Thing:
    """A body of a scene on white: half sizes, centre, turning and stretching, over t = 0..1 where they change."""

    shape: str
    size: Point
    at: Point | Callable[[float], Point]
    turn: Callable[[float], np.ndarray] = lambda t: np.eye(3)
    stretch: Callable[[float], float | Point] = lambda t: 1.0

    def pose(self, t: float) -> Pose:
        """Its place at an instant."""
        at = self.at(t) if callable(self.at) else self.at
        return self.turn(t) @ np.diag(np.multiply(self.size, self.stretch(t))), np.asarray(at, float)


def _slice(k: int) -> Thing:
    """The k-th of 10 slices of a column that bends, twists and breathes."""

    def at(t: float) -> Point:
        angle = 0.11 * k * np.sin(4 * pi * t)
        return 0.075 * k * np.sin(angle), 0.0, 0.125 * k * np.cos(angle / 2) - 0.6

    def turn(t: float) -> np.ndarray:
        return np.asarray(_turn(1, 0.14 * k * np.sin(4 * pi * t)) @ _turn(2, 0.11 * k * np.sin(2 * pi * t)))

    return Thing("box", (0.28, 0.28, 0.085), at, turn, lambda t: (w := 1 + 0.25 * np.sin(6 * pi * t - 0.4 * k), w, 1.0))


#: What stands alone on white, within 1.2 of the origin.
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
        Thing("cylinder", (0.025, 0.025, 0.9), (0.0, -0.5, 0.1), lambda t: _turn(0, 0.5) @ _turn(1, 4 * pi * t)),
        Thing("cylinder", (0.025, 0.025, 0.7), (0.0, 0.5, 0.0), lambda t: _turn(1, np.sin(6 * pi * t))),
        Thing("box", (0.02, 0.8, 0.02), lambda t: (0.9 * np.cos(2 * pi * t), 0.0, 0.7)),
        Thing("cylinder", (0.03, 0.03, 0.6), (0.6, 0.0, -0.2)),
    ),
    "tunnel": (  # a ball goes to and fro through a tunnel
        Thing("box", (0.6, 0.05, 0.4), (0.0, -0.35, 0.0)),
        Thing("box", (0.6, 0.05, 0.4), (0.0, 0.35, 0.0)),
        Thing("box", (0.6, 0.4, 0.05), (0.0, 0.0, 0.4)),
        Thing("sphere", (0.2, 0.2, 0.2), lambda t: (-1.1 * np.cos(4 * pi * t), 0.0, -0.1)),
    ),
    "bend": tuple(map(_slice, range(10))),  # a column bends, twists and breathes
    "blink": (  # beside a cube a ball appears and vanishes, and a cylinder grows after it
        Thing("box", (0.35, 0.35, 0.35), (-0.4, 0.2, -0.2)),
        Thing("sphere", (0.25, 0.25, 0.25), (0.5, -0.4, 0.2), stretch=lambda t: 1.0 if 0.3 < t < 0.6 else GONE),
        Thing(
            "cylinder",
            (0.2, 0.2, 0.5),
            (0.3, 0.6, 0.0),
            stretch=lambda t: (1.0, 1.0, max(GONE, min(1.0, 5 * t - 3))) if t > 0.6 else GONE,
        ),
    ),
}


def bodies(name: str, seed: int) -> list[Body]:
    """All bodies of a scene of MOTIONS or THINGS, the still ones of a room first. On white the seed changes paints and
    the direction that the scene faces."""
    if name in MOTIONS:
        return RoomBuilder(name, seed).bodies()
    painter = Painter(seed)
    facing = _turn(2, painter.rng.uniform(0, 2 * pi))

    def pose(thing: Thing, t: float) -> Pose:
        shape, at = thing.pose(t)
        return facing @ shape, facing @ at

    hues = {"box": 0.0, "sphere": 0.37, "cylinder": 0.74}
    return [
        Body(thing.shape, partial(pose, thing), painter.paint(thing.size, hues[thing.shape], 9.0))
        for thing in THINGS[name]
    ]
