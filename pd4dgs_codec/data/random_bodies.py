"""`synthetic:random`: 3 to 8 bodies of random shape, size, speed and path, some of them still, in a room or before a
plain background. All of them stay in view and clear of each other."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pd4dgs_codec.data.bodies import Body, Painter, Point, RoomBuilder, Thing, rotation

RANDOM = "random"  #: the scene's name
SHAPES = ("sphere", "box", "cylinder")
#: Camera paths, see `synthetic.PATHS`.
PATHS = ("jump", "orbit", "pass", "still")
REACH = 1.25  #: of every body from the middle, scene units
ROOM_MIDDLE = np.array([0.0, 0.1, 0.85])
CHECKED = np.linspace(0, 1, 65)  #: instants at which bodies are in view and apart
CORNER = 1.2  #: a body's radius in its longest half sizes: its corners may touch others


@dataclass(frozen=True, eq=False)
class Chance:
    """What the seed decides: bodies (floor and wall of a room first), RGB of the background and the camera's path."""

    bodies: list[Body]
    background: tuple[float, float, float]
    path: str
    room: bool


def _within(rng: np.random.Generator, least: float, most: float) -> float:
    """A number whose logarithm is evenly distributed."""
    return float(np.exp(rng.uniform(np.log(least), np.log(most))))


def _way(rng: np.random.Generator, middle: np.ndarray) -> Callable[[float], np.ndarray]:
    """A place over t = 0..1: on an orbit around the middle, along a line or wandering."""
    reach, turns, phase = _within(rng, 0.3, 1.1), _within(rng, 0.25, 3), rng.uniform(size=3)
    kind = rng.choice(["orbit", "line", "wander"])
    if kind == "orbit":
        start, ranges, rates = middle, np.array([reach, reach, 0]), np.array([turns, turns, 0])
        phase[1] = phase[0] + rng.choice([-0.25, 0.25])
        tilt = rotation(0, rng.uniform(-0.5, 0.5))
    else:
        start = middle + rng.uniform(-0.7, 0.7, 3)
        line = kind == "line"
        ranges = reach * (np.array([1, 0, 0]) if line else rng.uniform(0.2, 0.8, 3))
        rates = turns * (np.ones(3) if line else rng.uniform(0.4, 1.2, 3))
        tilt = rotation(2, rng.uniform(0, 2 * np.pi)) @ rotation(1, rng.uniform(-0.8, 0.8))
    return lambda t: start + tilt @ (ranges * np.sin(2 * np.pi * (rates * t + phase)))


def _thing(rng: np.random.Generator, scale: float, *, still: bool, first: bool, room: bool) -> Thing:
    """A body; the first one stands in the middle, still ones of a room on its floor."""
    size = scale * _within(rng, 0.09, 0.4) * np.exp(rng.uniform(-0.4, 0.4, 3))
    half: Point = (float(size[0]), float(size[1]), float(size[2]))
    middle = ROOM_MIDDLE if room else np.zeros(3)
    yaw, tilt, shape = rng.uniform(0, 2 * np.pi), rng.uniform(-1, 1), str(rng.choice(SHAPES))
    if still:
        place = middle + rng.uniform(-1, 1, 3) * (0.15 if first else REACH)
        turn = rotation(2, yaw) @ rotation(0, 0.0 if room else tilt)
        at: Point = (float(place[0]), float(place[1]), half[2] if room else float(place[2]))
        return Thing(shape, half, at, lambda t: turn)
    spin = rng.choice([0.0, rng.uniform(-1, 1)])
    return Thing(shape, half, _way(rng, middle), lambda t: rotation(2, yaw + 2 * np.pi * spin * t) @ rotation(0, tilt))


def _things(rng: np.random.Generator, *, room: bool) -> list[Thing]:
    """The bodies without floor and wall, the still ones first. What does not fit is drawn anew and a little smaller."""
    count = int(rng.integers(3, 9))
    still = int(rng.integers(1, count))
    middle = ROOM_MIDDLE if room else np.zeros(3)
    things: list[Thing] = []
    ways: list[tuple[np.ndarray, float]] = []  # places [instants, 3] and radius
    while len(things) < count:
        scale, k = 1.0, len(things)
        while len(things) == k:
            thing = _thing(rng, scale, still=k < still, first=k == 0, room=room)
            way, radius = np.stack([thing.pose(t)[1] for t in CHECKED]), CORNER * max(thing.size)
            seen = np.linalg.norm(way - middle, axis=1).max() + radius < REACH
            above = not room or k < still or way[:, 2].min() > radius
            if seen and above and all(np.linalg.norm(way - w, axis=1).min() > radius + r for w, r in ways):
                things.append(thing)
                ways.append((way, radius))
            scale *= 0.99
    return things


def random_scene(seed: int) -> Chance:
    """The scene of a seed."""
    rng = np.random.default_rng([seed, 3])
    room, path = bool(rng.uniform() < 0.4), str(rng.choice(PATHS))
    color = np.ones(3) if rng.uniform() < 0.5 else rng.uniform(size=3)
    painter = Painter(seed)
    bodies = RoomBuilder("static", seed).bodies()[:2] if room else []
    for thing in _things(rng, room=room):
        hue, wave = rng.uniform(), rng.uniform(5, 14)
        bodies.append(Body(thing.shape, thing.pose, painter.paint(thing.size, hue, wave)))
    return Chance(bodies, (float(color[0]), float(color[1]), float(color[2])), path, room)
