"""Bits per point and time of the position coder against Draco's kd-tree and a plain octree.

    python tools/bench_positions.py [--count 26000]
    python tools/bench_positions.py FILE.pd4 ...      # of the layers of files

Draco gets its highest compression level, no order to keep, and exactly the quantisation that leaves the integers as
they are (checked). The plain octree is the entropy of its child masks under one table for all levels, not counted.
Captured points are taken from PD4DGS_SHARED (default ../shared/data beside the repository), if there.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from pages.draco import draco_encode
from pages.scenes import SHARED

from pd4dgs_codec.entropy.positions import decode_positions, encode_positions
from pd4dgs_codec.format.decoder import decode
from pd4dgs_codec.morton import morton_codes, morton_order

SURFACES = ("sphere", "torus", "plane", "cylinder", "gyroid")


def surface(name: str, count: int, side: int = 1024, seed: int = 0) -> np.ndarray:
    """`count` distinct cells int32 [count, 3] of a uniformly sampled surface in a cube of `side` cells."""
    rng = np.random.default_rng(seed)
    cells = np.zeros((0, 3), dtype=np.int32)
    while len(cells) < count:
        points = _SAMPLERS[name](rng, 2 * count)
        cells = np.unique(np.vstack([cells, np.floor((points + 0.5) * side).astype(np.int32)]), axis=0)
    return rng.permutation(cells)[:count]


def _sphere(rng: np.random.Generator, n: int) -> np.ndarray:
    p = rng.normal(size=(n, 3))
    return np.asarray(0.48 * p / np.linalg.norm(p, axis=1, keepdims=True))


def _torus(rng: np.random.Generator, n: int) -> np.ndarray:
    ring, tube = 0.34, 0.14
    u, v, keep = rng.random((3, n)) * [[2 * np.pi], [2 * np.pi], [1]]
    around = ring + tube * np.cos(v)
    points = np.stack([around * np.cos(u), around * np.sin(u), tube * np.sin(v)], 1)
    return np.asarray(points[keep < around / (ring + tube)])


def _plane(rng: np.random.Generator, n: int) -> np.ndarray:
    return np.asarray((rng.random((n, 2)) - 0.5) @ np.array([[0.8, 0.1, 0.25], [-0.15, 0.7, 0.3]]))


def _cylinder(rng: np.random.Generator, n: int) -> np.ndarray:
    u, v = 2 * np.pi * rng.random(n), 0.8 * (rng.random(n) - 0.5)
    x, y = 0.25 * np.cos(u), 0.25 * np.sin(u)
    return np.stack([x, np.cos(0.5) * y - np.sin(0.5) * v, np.sin(0.5) * y + np.cos(0.5) * v], 1)


def _gyroid(rng: np.random.Generator, n: int) -> np.ndarray:
    p, w = rng.random((n, 3)) - 0.5, 4 * np.pi
    for _ in range(8):  # Newton steps along the gradient
        s, c = np.sin(w * p), np.cos(w * p)
        value = (s * np.roll(c, -1, axis=1)).sum(axis=1, keepdims=True)
        slope = w * (c * np.roll(c, -1, axis=1) - s * np.roll(s, 1, axis=1))
        p = p - value * slope / np.maximum((slope**2).sum(axis=1, keepdims=True), 1e-9)
    return np.asarray(p[(np.abs(p) < 0.48).all(axis=1) & (np.abs(value[:, 0]) < 1e-3)])


_SAMPLERS = {"sphere": _sphere, "torus": _torus, "plane": _plane, "cylinder": _cylinder, "gyroid": _gyroid}


def captured_points() -> np.ndarray | None:
    """Triangulated points float64 [N, 3] of a phone video, or None if the data are not there."""
    path = SHARED / "shelf-hand" / "points_triangulated.ply"
    if not path.exists():
        return None
    head, body = path.read_bytes().split(b"end_header\n", 1)
    rows = int(head.split(b"element vertex ")[1].split()[0])
    row = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)])
    return np.frombuffer(body, row, rows)["xyz"].astype(np.float64)


def cases(count: int = 26000) -> dict[str, np.ndarray]:
    """Name -> distinct cells int32 [N, 3] in Morton order."""
    rng = np.random.default_rng(3)
    out = {name: surface(name, count) for name in SURFACES}
    out["sphere, fewer"] = surface("sphere", max(count // 5, 1))
    out["torus, dense"] = surface("torus", int(count * 0.7), 160)
    out["uniform"] = rng.integers(0, 1024, (count, 3))
    out["line"] = rng.random((count, 1)) * [900, 300, 50]
    out["blob"] = rng.normal(size=(count, 3)) * 30
    points = captured_points()
    if points is not None:
        extent = np.ptp(np.percentile(points, [1, 99], axis=0), axis=0).max()
        out |= {f"captured, 1/{n}": np.round(points * n / extent) for n in (100, 300, 1000, 3000)}
    distinct = {name: np.unique(np.asarray(c).astype(np.int32), axis=0) for name, c in out.items()}
    return {name: c[morton_order(c)] for name, c in distinct.items()}


def layers(path: Path) -> dict[str, np.ndarray]:
    """Name -> cells int32 [N, 3] in Morton order, of every layer of a `.pd4` file that has anchors of its own."""
    scene, first, out = decode(path.read_bytes()), 0, {}
    for layer, end in zip(scene.layers, scene.rows, strict=True):
        if end > first:
            out[f"{path.stem}, {layer}"] = scene.anchor_q[first:end]
        first = end
    return out


def draco_bytes(cells: np.ndarray) -> int:
    """Size of Draco's kd-tree encoding at level 10, checked to be lossless."""
    import DracoPy

    blob, offsets = draco_encode(cells), cells - cells.min(axis=0)
    back = np.round(np.asarray(DracoPy.decode(blob).points)).astype(np.int64)
    if not np.array_equal(np.unique(back, axis=0), np.unique(offsets, axis=0)):
        raise SystemExit("Draco did not keep the integers")
    return len(blob)


def octree_bits(cells: np.ndarray) -> float:
    """Entropy of the child masks of a plain octree, one table for all levels, in bits."""
    nodes, masks = morton_codes(cells), []
    while nodes[-1] > 0:
        parents, row = np.unique(nodes >> 3, return_inverse=True)
        masks.append(np.bincount(row, weights=1 << (nodes & 7)).astype(np.int64))
        nodes = parents
    counts = np.bincount(np.concatenate(masks))
    counts = counts[counts > 0]
    return float(-(counts * np.log2(counts / counts.sum())).sum())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=26000, help="points per surface (default: 26000)")
    parser.add_argument("files", nargs="*", type=Path, metavar="FILE", help=".pd4 files, in place of made points")
    arguments = parser.parse_args()
    found = (
        cases(arguments.count) if not arguments.files else {k: v for p in arguments.files for k, v in layers(p).items()}
    )
    print(
        f"{'case':20} {'points':>7} {'bytes':>7} {'bits':>7} {'Draco':>7} {'octree':>7} {'/Draco':>7}   encode  decode"
    )
    ours, draco = [], []
    for name, cells in found.items():
        t0 = time.process_time()
        payload = encode_positions(cells)
        t1 = time.process_time()
        same = np.array_equal(decode_positions(payload, len(cells)), cells)
        t2 = time.process_time()
        for _ in range(4):
            decode_positions(payload, len(cells))
        decoding = (time.process_time() - t2) / 4
        if not same:
            raise SystemExit(f"{name}: decoded cells differ")
        ours.append(8 * len(payload) / len(cells))
        draco.append(8 * draco_bytes(cells) / len(cells))
        plain = octree_bits(cells) / len(cells)
        row = f"{ours[-1]:7.3f} {draco[-1]:7.3f} {plain:7.3f} {ours[-1] / draco[-1]:7.3f}"
        print(f"{name:20} {len(cells):7} {len(payload):7} {row} {t1 - t0:6.2f}s {1000 * decoding:5.1f}ms")
    if not arguments.files:
        print(f"mean of the five surfaces: ours {np.mean(ours[:5]):.3f}, Draco {np.mean(draco[:5]):.3f} bits per point")


if __name__ == "__main__":
    main()
