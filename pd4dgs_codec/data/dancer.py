"""The dancer: an articulated figure with patterned clothes, which carries a swinging lantern over a light ground.

Hands and feet follow smooth closed paths, and limbs of two bones reach them, so the feet stand on the ground. In the
figure's own axes x points to its left, y backwards and z up. Lengths are in scene units.
"""

from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np

from pd4dgs_codec.data.bodies import Body, Paint, Pose, rotation

DANCER = "dancer"  #: the scene's name
GROUND = -0.92  #: its height
SKINS = ((0.97, 0.80, 0.70), (0.90, 0.69, 0.55), (0.70, 0.50, 0.39))
HAIRS = ((0.50, 0.32, 0.22), (0.88, 0.52, 0.24), (0.36, 0.35, 0.44))


def _rgb(hue: float, light: float, depth: float) -> np.ndarray:
    """RGB of a hue in turns: `light` on average, up to `depth` above or below it."""
    return np.clip(light + depth * np.cos(2 * np.pi * (hue - np.array([0, 1 / 3, 2 / 3]))), 0, 1)


@dataclass(frozen=True, eq=False)
class Part:
    """A body on a bone: half sizes and centre along the bone's axes."""

    bone: str
    shape: str
    size: tuple[float, float, float]
    at: tuple[float, float, float]
    paint: Paint


def reach(root: np.ndarray, target: np.ndarray, lengths: tuple[float, float], bend: np.ndarray) -> np.ndarray:
    """The joint [3] of two bones from `root` to `target`, on the side of the direction `bend`. Bones that are too short
    are stretched alike."""
    line = target - root
    far = float(np.linalg.norm(line))
    first = lengths[0] * max(1.0, far / (0.999 * sum(lengths)))
    second = first * lengths[1] / lengths[0]
    along = (first**2 - second**2 + far**2) / (2 * far)
    aside = bend - line * (bend @ line) / far**2
    away = np.sqrt(max(first**2 - along**2, 0.0)) / np.linalg.norm(aside)
    return np.asarray(root + line * (along / far) + aside * away)


def bone(start: np.ndarray, end: np.ndarray, side: np.ndarray) -> Pose:
    """Axes [3, 3] and centre [3] of a bone: z from start to end with half its length as scale, x near `side`."""
    z = (end - start) / 2
    y = np.cross(z, side)
    y /= np.linalg.norm(y)
    x = np.cross(y, z)
    return np.stack([x / np.linalg.norm(x), y, z], axis=1), (start + end) / 2


class Dancer:
    """The figure of a seed, which varies its build, its clothes and its motion."""

    def __init__(self, seed: int):
        self.rng = rng = np.random.default_rng([seed, 5])
        self.facing = rotation(2, rng.uniform(-0.6, 0.6))
        self.tall, self.broad = rng.uniform(0.95, 1.05), rng.uniform(0.9, 1.1)
        self.swing = rng.uniform(0.8, 1.1)  # of the arms
        self.phase = rng.uniform(0, 2 * np.pi)
        self.mirror = rng.choice([-1.0, 1.0])
        self.hue = rng.uniform()
        self.bones = lru_cache(maxsize=2)(self._bones)  # all bodies ask for the same instant

    def cloth(self, low: np.ndarray, high: np.ndarray, size: tuple[float, ...], *waves: tuple[float, ...]) -> Paint:
        """Two colours in stripes (one wave vector, radians per unit) or checks (two), with a fine grain."""
        rows = np.zeros((2, 4))
        for row, wave in zip(rows, (waves * 2)[:2], strict=True):
            row[:3] = wave
        detail = np.concatenate([self.rng.normal(size=(3, 3)) * 8, self.rng.uniform(0, 6, (3, 1))], axis=1)
        return Paint(np.asarray(low), np.asarray(high), rows, 0.4 * detail, np.asarray(size))

    def _bones(self, t: float) -> dict[str, Pose]:
        """Axes and position of every bone at t = 0..1, before the figure is turned and set on the ground."""
        a = 2 * np.pi * t + self.phase
        s, c, s2, c2 = np.sin(a), np.cos(a), np.sin(2 * a), np.cos(2 * a)
        m, tall, broad = self.mirror, self.tall, self.broad
        hips = np.array([0.05 * s, 0.015 * c2, 0.96 * tall - 0.018 * c2])
        pelvis = rotation(2, 0.12 * s) @ rotation(1, 0.05 * c)
        spine = rotation(2, -0.22 * s * m) @ rotation(1, 0.07 * s) @ rotation(0, 0.05 * c2)
        chest = hips + spine @ [0, 0, 0.40 * tall]
        head = rotation(2, 0.25 * np.sin(a - 0.6) * m) @ rotation(1, 0.06 * s2)
        crown = chest + spine @ [0, 0, 0.30 * tall]
        result = {"pelvis": (pelvis, hips), "chest": (spine, chest), "head": (head, crown + head @ [0, 0, 0.17])}
        back, ahead = np.array([0.0, 1.0, 0.0]), np.array([0.0, -1.0, 0.0])
        for name, side, beat in (("left", 1.0, s), ("right", -1.0, -s)):
            hip = hips + pelvis @ [side * 0.12 * broad, 0, -0.06]
            lift = max(0.0, beat) ** 2
            ankle = np.array([side * (0.17 + 0.04 * lift), -0.08 * lift, 0.08 + 0.08 * lift])
            knee = reach(hip, ankle, (0.44 * tall, 0.42 * tall), ahead + 0.35 * side * np.array([1.0, 0, 0]))
            shoulder = chest + spine @ [side * 0.24 * broad, 0, 0.16 * tall]
            if side == m:  # this hand carries the lantern
                hand = shoulder + [side * (0.42 + 0.03 * c2), -0.16 + 0.07 * s, 0.02 + 0.08 * self.swing * s]
                string = rotation(1, 0.20 * np.sin(a - 1.1)) @ rotation(0, 0.12 * np.cos(a - 0.9))
                result["lantern"] = string, hand
            else:
                hand = shoulder + [side * (0.22 + 0.05 * c), -0.20 - 0.04 * s, self.swing * (0.13 * c + 0.12)]
            elbow = reach(shoulder, hand, (0.29 * tall, 0.27 * tall), 0.6 * back + [0.5 * side, 0, -0.7])
            for limb, points in (("arm", (shoulder, elbow, hand)), ("leg", (hip, knee, ankle))):
                for k in range(2):
                    result[f"{name} {limb} {k}"] = bone(points[k], points[k + 1], np.array([1.0, 0.2, 0]))
            result[f"{name} elbow"] = spine, elbow
            result[f"{name} knee"] = pelvis, knee
            result[f"{name} hand"] = spine, hand
            result[f"{name} foot"] = rotation(2, side * 0.35) @ rotation(0, 0.5 * lift), ankle
        return result

    def pose(self, part: Part, t: float) -> Pose:
        """A and c of a part at t."""
        axes, at = self.bones(t)[part.bone]
        axes, at = self.facing @ axes, self.facing @ (at + axes @ part.at) + [0, 0, GROUND]
        return axes @ np.diag(part.size), at

    def bodies(self) -> list[Body]:
        """All bodies, the ground first."""
        rng, hue, tall, broad = self.rng, self.hue, self.tall, self.broad
        skin, hair = np.array(SKINS[rng.integers(3)]), np.array(HAIRS[rng.integers(3)])
        cream, dark = np.array([0.97, 0.95, 0.90]), np.array([0.26, 0.26, 0.32])
        shirt, trousers, shoe = _rgb(hue, 0.70, 0.24), _rgb(hue + 0.55, 0.62, 0.20), _rgb(hue + 0.17, 0.66, 0.28)
        pale = 0.4 * shirt + 0.6 * cream
        parts: list[Part] = []

        def add(
            on: str, shape: str, size: tuple[float, float, float], at: tuple[float, float, float],
            low: np.ndarray, high: np.ndarray | None = None, *waves: tuple[float, ...],
        ) -> None:  # fmt: skip
            high = low if high is None else high
            parts.append(Part(on, shape, size, at, self.cloth(low, high, size, *(waves or ((0.0, 0.0, 0.0),)))))

        stripes, checks = ((0.0, 0.0, 36.0),), ((24.0, 0.0, 24.0), (24.0, 0.0, -24.0))
        add("pelvis", "sphere", (0.21 * broad, 0.15, 0.17), (0, 0, -0.02), trousers, 1.2 * trousers, *checks)
        add("chest", "sphere", (0.23 * broad, 0.155, 0.34 * tall), (0, 0, -0.12 * tall), shirt, pale, *stripes)
        add("chest", "sphere", (0.27 * broad, 0.13, 0.11), (0, 0, 0.14 * tall), shirt, pale, *stripes)
        add("chest", "cylinder", (0.055, 0.055, 0.08), (0, 0, 0.27 * tall), skin)
        add("head", "sphere", (0.155, 0.17, 0.19), (0, 0, 0), skin)
        add("head", "sphere", (0.168, 0.165, 0.165), (0, 0.035, 0.055), hair, 1.35 * hair, (40.0, 0.0, 12.0))
        add("head", "sphere", (0.075, 0.075, 0.075), (0, 0.15, 0.17), hair, 1.35 * hair, (40.0, 0.0, 12.0))
        add("head", "sphere", (0.028, 0.045, 0.03), (0, -0.165, -0.035), 0.9 * skin)
        add("head", "sphere", (0.055, 0.03, 0.018), (0, -0.142, -0.095), np.array([0.75, 0.16, 0.18]))
        for x in (-0.06, 0.06):
            add("head", "sphere", (0.036, 0.022, 0.036), (x, -0.145, 0.015), cream)
            add("head", "sphere", (0.02, 0.02, 0.022), (x, -0.158, 0.015), dark)
        for side in ("left", "right"):
            add(f"{side} arm 0", "sphere", (0.078, 0.078, 1.25), (0, 0, 0), shirt, pale, (0.0, 0.0, 5.5))
            add(f"{side} elbow", "sphere", (0.062, 0.062, 0.062), (0, 0, 0), skin)
            add(f"{side} arm 1", "sphere", (0.06, 0.06, 1.2), (0, 0, 0), skin)
            add(f"{side} hand", "sphere", (0.065, 0.05, 0.07), (0, 0, 0), skin)
            for k, wide in enumerate((0.125, 0.088)):
                woven = (24.0, 0.0, 4.5), (24.0, 0.0, -4.5)
                add(f"{side} leg {k}", "sphere", (wide, wide, 1.2), (0, 0, 0), trousers, 1.2 * trousers, *woven)
            add(f"{side} knee", "sphere", (0.088, 0.088, 0.088), (0, 0, 0), trousers)
            add(f"{side} foot", "sphere", (0.075, 0.15, 0.07), (0, -0.07, -0.01), shoe, cream, (0.0, 30.0, 0.0))
        glow = _rgb(hue + 0.4, 0.66, 0.30)
        add("lantern", "cylinder", (0.009, 0.009, 0.13), (0, 0, -0.13), dark)
        add(
            "lantern", "cylinder", (0.10, 0.10, 0.12), (0, 0, -0.38), glow, cream, (30.0, 0.0, 26.0), (30.0, 0.0, -26.0)
        )
        add("lantern", "cylinder", (0.07, 0.07, 0.02), (0, 0, -0.245), dark)
        add("lantern", "cylinder", (0.07, 0.07, 0.02), (0, 0, -0.515), dark)
        flat = (0.9, 0.9, 0.02)
        ground = self.cloth(np.array([0.86, 0.87, 0.88]), cream, flat, (7.0, 7.0, 0.0), (7.0, -7.0, 0.0))
        stands = np.diag(flat), np.array([0, 0, GROUND - 0.02])
        figure = [Body(p.shape, partial(self.pose, p), p.paint) for p in parts]
        return [Body("cylinder", lambda t: stands, ground, casts=False), *figure]
