"""Clouds of anchors on surfaces, lines and in volumes."""

from __future__ import annotations

import numpy as np

from pd4dgs_codec.morton import morton_order


def surface(name: str, count: int, side: int = 1024) -> np.ndarray:
    """`count` distinct cells int32 [count, 3] of a sphere, torus, plane or gyroid in a cube of `side` cells."""
    rng = np.random.default_rng(0)
    cells = np.zeros((0, 3), dtype=np.int32)
    while len(cells) < count:
        points = _SAMPLERS[name](rng, 2 * count)
        cells = np.unique(np.vstack([cells, np.floor((points + 0.5) * side).astype(np.int32)]), axis=0)
    return rng.permutation(cells)[:count]


def _sphere(rng: np.random.Generator, n: int) -> np.ndarray:
    p = rng.normal(size=(n, 3))
    return 0.48 * p / np.linalg.norm(p, axis=1, keepdims=True)


def _torus(rng: np.random.Generator, n: int) -> np.ndarray:
    u, v = 2 * np.pi * rng.random((2, n))
    around = 0.34 + 0.14 * np.cos(v)
    return np.stack([around * np.cos(u), around * np.sin(u), 0.14 * np.sin(v)], 1)


def _plane(rng: np.random.Generator, n: int) -> np.ndarray:
    return (rng.random((n, 2)) - 0.5) @ np.array([[0.8, 0.1, 0.25], [-0.15, 0.7, 0.3]])


def _gyroid(rng: np.random.Generator, n: int) -> np.ndarray:
    p, w = rng.random((n, 3)) - 0.5, 4 * np.pi
    for _ in range(8):  # Newton steps along the gradient
        s, c = np.sin(w * p), np.cos(w * p)
        value = (s * np.roll(c, -1, axis=1)).sum(axis=1, keepdims=True)
        slope = w * (c * np.roll(c, -1, axis=1) - s * np.roll(s, 1, axis=1))
        p = p - value * slope / np.maximum((slope**2).sum(axis=1, keepdims=True), 1e-9)
    return p[(np.abs(p) < 0.48).all(axis=1) & (np.abs(value[:, 0]) < 1e-3)]


_SAMPLERS = {"sphere": _sphere, "torus": _torus, "plane": _plane, "gyroid": _gyroid}


def cases(count: int) -> dict[str, np.ndarray]:
    """Name -> distinct cells int32 [N, 3] in Morton order."""
    rng = np.random.default_rng(3)
    out = {name: surface(name, count) for name in _SAMPLERS}
    out["torus, dense"] = surface("torus", int(count * 0.7), 160)
    out["uniform"] = rng.integers(0, 1024, (count, 3))
    out["line"] = rng.random((count, 1)) * [900, 300, 50]
    out["blob"] = rng.normal(size=(count, 3)) * 30
    distinct = {name: np.unique(np.asarray(c).astype(np.int32), axis=0) for name, c in out.items()}
    return {name: c[morton_order(c)] for name, c in distinct.items()}
