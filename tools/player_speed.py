"""Decode times of the player's decoder, in Node, beside the package's, in one run and in turn.

    python tools/player_speed.py a.pd4 b.pd4               # median of 9 decodes each, after 8 that do not count
    python tools/player_speed.py a.pd4 --runs 25 --json times.json
    python tools/player_speed.py a.pd4 --grow 100000 big.pd4  # writes copies of a.pd4's anchors side by side

Both decode whole files from memory, warm, in processes of their own that stay. What counts is processor time, so that
a busy machine changes less; wall time stands beside it. Both slow down alike when other work shares the cores, and as
they take turns, the ratio is of decodes that met the same conditions.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from pd4dgs_codec import decode, encode  # noqa: E402
from pd4dgs_codec.morton import morton_order  # noqa: E402
from pd4dgs_codec.scene import Scene  # noqa: E402

LOOP = ROOT / "player" / "testing" / "decoder_loop.mjs"
WARM_UP = 8


@dataclass(frozen=True)
class Times:
    """Seconds of each decode."""

    cpu: list[float]
    wall: list[float]


class NodeDecoder:
    """The player's decoder in a Node process; close it, or use it in a `with` block."""

    def __init__(self, node: str = "node"):
        self._process = subprocess.Popen([node, str(LOOP)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def __enter__(self) -> NodeDecoder:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Ends the process."""
        self._process.communicate(timeout=60)

    def ask(self, question: dict[str, str]) -> dict[str, object]:
        """The answer to one line of decoder_loop.mjs."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(json.dumps(question) + "\n")
        self._process.stdin.flush()
        line = self._process.stdout.readline()
        if not line:
            raise SystemExit(f"player_speed.py: node ended with {self._process.wait()}")
        answer: dict[str, object] = json.loads(line)
        return answer

    def seconds(self, path: Path) -> tuple[float, float]:
        """(processor, wall) time of decoding a file once."""
        answer = self.ask({"time": str(path.resolve())})
        if "cpu" not in answer:
            raise SystemExit(f"player_speed.py: {path}: {answer.get('message') or answer}")
        return float(str(answer["cpu"])), float(str(answer["wall"]))


def grown(scene: Scene, anchors: int) -> Scene:
    """At least so many anchors: copies of the scene's side by side along x, networks and planes as they are."""
    copies = -(-anchors // scene.rows[-1])
    shift = int(np.ptp(scene.anchor_q[:, 0])) + 1
    rows, voxels, first = list[np.ndarray](), list[np.ndarray](), 0
    for last in scene.rows:
        own = np.tile(np.arange(first, last), copies)
        moved = scene.anchor_q[own]
        moved[:, 0] += np.repeat(np.arange(copies), last - first).astype(np.int32) * shift
        order = morton_order(moved)
        rows.append(own[order])
        voxels.append(moved[order])
        first = last
    index = np.concatenate(rows)
    return replace(
        scene,
        rows=tuple(copies * n for n in scene.rows),
        anchor_q=np.concatenate(voxels),
        feature=scene.feature[index],
        scaling_log=scene.scaling_log[index],
        offset=scene.offset[index],
        grading=None if scene.grading is None else scene.grading.take(index),
        mask=tuple(codes[index[: copies * len(codes)]] for codes in scene.mask),
    )


def python_seconds(data: bytes) -> tuple[float, float]:
    """(processor, wall) time of decoding a file once with the package."""
    cpu, wall = time.process_time(), time.perf_counter()
    decode(data)
    return time.process_time() - cpu, time.perf_counter() - wall


def compare(path: Path, runs: int, node: NodeDecoder) -> tuple[int, Times, Times]:
    """(anchors, times in Node, times in Python) of `runs` decodes in turn."""
    data = path.read_bytes()
    anchors = decode(data).rows[-1]
    pairs = [(node.seconds(path), python_seconds(data)) for _ in range(WARM_UP + runs)][WARM_UP:]
    ours, theirs = zip(*pairs, strict=True)
    return anchors, *(Times([cpu for cpu, _ in times], [wall for _, wall in times]) for times in (ours, theirs))


def row(path: Path, anchors: int, ours: Times, theirs: Times) -> dict[str, object]:
    """Medians, and the median of the ratios turn by turn."""
    return {
        "file": path.name,
        "bytes": path.stat().st_size,
        "anchors": anchors,
        "runs": len(ours.cpu),
        "node_cpu_s": median(ours.cpu),
        "python_cpu_s": median(theirs.cpu),
        "node_wall_s": median(ours.wall),
        "python_wall_s": median(theirs.wall),
        "cpu_ratio": median(a / b for a, b in zip(ours.cpu, theirs.cpu, strict=True)),
        "wall_ratio": median(a / b for a, b in zip(ours.wall, theirs.wall, strict=True)),
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    assert __doc__
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("files", nargs="+", type=Path)
    p.add_argument("--runs", type=int, default=9, help="decodes that count (default: 9)")
    p.add_argument(
        "--grow", nargs=2, metavar=("N", "FILE"), help="write a file of N anchors instead, from the first file"
    )
    p.add_argument("--json", type=Path, metavar="FILE", help="write the figures")
    args = p.parse_args(argv)
    if args.grow:
        count, path = args.grow
        Path(path).write_bytes(
            encode(grown(decode(args.files[0].read_bytes()), int(count)), effort=1, omit="nothing", verify=False)
        )
        return 0
    with NodeDecoder() as node:
        rows = [row(path, *compare(path, args.runs, node)) for path in args.files]
    print("| file | anchors | Node CPU s | Python CPU s | Node/Python CPU | Node wall s | Python wall s | wall |")
    print("|---|---|---|---|---|---|---|---|")
    for r in rows:
        print(
            f"| {r['file']} | {r['anchors']:,} | {r['node_cpu_s']:.4f} | {r['python_cpu_s']:.4f} "
            f"| {r['cpu_ratio']:.2f} | {r['node_wall_s']:.4f} | {r['python_wall_s']:.4f} | {r['wall_ratio']:.2f} |"
        )
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
