"""The objects of the synthetic scenes and the four ways they move."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pd4dgs_codec.data.raycast import Body, Paint, Pose


@dataclass(frozen=True)
class Motion:
    """How a scene moves over t = 0..1. Amplitudes in radians or shares, rates in turns (cycles) over the whole time."""

    sway: float = 0.0  #: turning of the platform with all that stands on it
    heave: float = 0.0  #: its rise, scene units
    swing: float = 0.0  #: the arm on the column
    swing_rate: float = 2.0
    pulse: float = 0.0  #: stretching of the ball
    tint: float = 0.0  #: colour change of the plank
    spin: float = 0.0  #: turns of the crate
    hops: float = 0.0  #: bounces of the two balls
    orbit: float = 0.0  #: turns of the runner around the platform


#: At an instant, on top of a body's place: rotation [3, 3], shift [3] and stretch per axis [3].
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


class SceneBuilder:
    """Builds the bodies of one scene."""

    def __init__(self, name: str, seed: int):
        self.motion, self.rng = MOTIONS[name], np.random.default_rng(seed)
        self.hue = self.rng.uniform()

    def paint(
        self, hue: float, size: Sequence[float], wave: float, axes: tuple[int, int] = (0, 2), strength: float = 0.45
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

    def group(self, t: float) -> tuple[np.ndarray, np.ndarray]:
        """Rotation and position of the platform."""
        m = self.motion
        angle = m.sway * np.sin(2 * np.pi * 0.75 * t)
        return _turn(2, angle), np.array([0, 0, m.heave * np.sin(np.pi * t) ** 2])

    def fixed(
        self,
        shape: str,
        size: Sequence[float],
        at: Sequence[float],
        hue: float,
        wave: float,
        *,
        axes: tuple[int, int] = (0, 2),
        strength: float = 0.45,
        casts: bool = False,
    ) -> Body:
        """A body that never moves and throws no shadow (floor, wall) or stands beside the platform."""
        A, c = np.diag(np.asarray(size, float)), np.asarray(at, float)
        return Body(shape, lambda t: (A, c), self.paint(hue, size, wave, axes, strength), casts)

    def riding(
        self,
        shape: str,
        size: Sequence[float],
        at: Sequence[float],
        hue: float,
        wave: float,
        local: Callable[[float], Local] | None = None,
        *,
        axes: tuple[int, int] = (0, 2),
    ) -> Body:
        """A body on the platform, which moves there as `local` says."""
        half = np.asarray(size, float)
        yaw = _turn(2, self.rng.uniform(-0.4, 0.4))
        place = np.asarray(at, float) + np.array([*self.rng.uniform(-0.05, 0.05, 2), 0])

        def pose(t: float) -> Pose:
            R, p = self.group(t)
            turn, shift, stretch = local(t) if local else (np.eye(3), np.zeros(3), np.ones(3))
            return R @ turn @ yaw @ np.diag(half * stretch), R @ (place + shift) + p

        return Body(shape, pose, self.paint(hue, size, wave, axes))

    def hop(self, phase: float, height: float) -> Callable[[float], np.ndarray]:
        """Bouncing on the spot."""
        rate = self.motion.hops
        return lambda t: np.array([0, 0, height * abs(np.sin(np.pi * (rate * t + phase)))]) if rate else np.zeros(3)

    def arm(self) -> list[Body]:
        """A rod that swings about the top of the column, with a bob at its end."""
        m, pivot, reach = self.motion, np.array([0.15, 0.35, 1.17]), 0.36
        rest = self.rng.uniform(0.4, 0.9)

        def part(size: Sequence[float], along: float) -> Callable[[float], Pose]:
            def pose(t: float) -> Pose:
                R, p = self.group(t)
                turn = R @ _turn(1, rest + m.swing * np.sin(2 * np.pi * m.swing_rate * t))
                return turn @ np.diag(size), R @ pivot + p + turn @ np.array([along, -0.2, 0])

            return pose

        rod, bob = (reach, 0.05, 0.05), (0.15, 0.15, 0.15)
        return [
            Body("box", part(rod, 0.6 * reach), self.paint(0.1, rod, 9.0)),
            Body("sphere", part(bob, 1.7 * reach), self.paint(0.75, bob, 14.0)),
        ]

    def bodies(self) -> list[Body]:
        """All bodies, the still ones first."""
        m = self.motion
        one, still = np.ones(3), np.eye(3)
        ball_hop, small_hop = self.hop(0.0, 0.55), self.hop(0.4, 0.8)

        def ball(t: float) -> Local:
            s = m.pulse * np.sin(2 * np.pi * 3 * t)
            return still, ball_hop(t) + [0, 0, 0.3 * s], np.array([1 - 0.5 * s, 1 - 0.5 * s, 1 + s])

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
            self.riding(
                "box", (0.26, 0.26, 0.26), (-0.42, -0.3, 0.36), 0.0, 9.0,
                lambda t: (_turn(2, 2 * np.pi * m.spin * t), np.zeros(3), one),
            ),
            self.riding("sphere", (0.3, 0.3, 0.3), (0.5, -0.3, 0.4), 0.33, 9.0, ball),
            self.riding(
                "sphere", (0.16, 0.16, 0.16), (-0.42, -0.3, 0.78), 0.7, 12.0, lambda t: (still, small_hop(t), one)
            ),
            self.riding("sphere", (0.14, 0.14, 0.14), (1.5, 0, 0.14), 0.2, 14.0, runner),
            *self.arm(),
        ]  # fmt: skip
