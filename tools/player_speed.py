"""Decode times of the player's decoder, in Node, beside the package's.

    python tools/player_speed.py a.pd4 b.pd4                  # median of 9 decodes each, after 8 of warm-up
    python tools/player_speed.py a.pd4 --runs 25 --json times.json
    python tools/player_speed.py a.pd4 --grow 100000 big.pd4  # writes copies of a.pd4's anchors side by side

Both decode whole files from memory, warm, and take turns, so that they meet the same load; processor time changes less
with that load than wall time.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from pd4dgs_codec import decode, encode  # noqa: E402
from pd4dgs_codec.morton import morton_order  # noqa: E402
from pd4dgs_codec.scene import Scene  # noqa: E402

LOOP = ROOT / "player" / "testing" / "decoder_loop.mjs"
WARM_UP = 8


class NodeDecoder:
    """The player's decoder in a process that answers lines of JSON; close it, or use it in a `with` block."""

    def __init__(self, node: str = "node"):
        pipe = subprocess.PIPE
        self._process = subprocess.Popen([node, str(LOOP)], stdin=pipe, stdout=pipe, text=True)

    def __enter__(self) -> NodeDecoder:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Ends the process."""
        self._process.communicate(timeout=60)

    def ask(self, question: Mapping[str, object]) -> dict[str, Any]:
        """The answer to one line."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(json.dumps(question) + "\n")
        self._process.stdin.flush()
        line = self._process.stdout.readline()
        if not line:
            raise SystemExit(f"player_speed.py: node ended with {self._process.wait()}")
        answer: dict[str, Any] = json.loads(line)
        return answer

    def seconds(self, path: Path) -> tuple[float, float]:
        """(processor, wall) time of decoding a file once."""
        answer = self.ask({"time": str(path.resolve())})
        if "cpu" not in answer:
            raise SystemExit(f"player_speed.py: {path}: {answer.get('message') or answer}")
        return answer["cpu"], answer["wall"]


def python_seconds(data: bytes) -> tuple[float, float]:
    """(processor, wall) time of decoding a file once with the package."""
    cpu, wall = time.process_time(), time.perf_counter()
    decode(data)
    return time.process_time() - cpu, time.perf_counter() - wall


def compare(path: Path, runs: int, node: NodeDecoder) -> dict[str, Any]:
    """Medians of `runs` decodes in turn, and the medians of the ratios."""
    data = path.read_bytes()
    turns = [(node.seconds(path), python_seconds(data)) for _ in range(WARM_UP + runs)][WARM_UP:]
    result: dict[str, Any] = {"file": path.name, "bytes": len(data), "anchors": decode(data).rows[-1], "runs": runs}
    for i, kind in enumerate(("cpu", "wall")):
        for side, name in enumerate(("node", "python")):
            result[f"{name}_{kind}_s"] = median(turn[side][i] for turn in turns)
        result[f"{kind}_ratio"] = median(ours[i] / theirs[i] for ours, theirs in turns)
    return result


def grown(scene: Scene, anchors: int) -> Scene:
    """At least so many anchors: copies of the scene's side by side along x, with the same networks and planes."""
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
    changed: dict[str, Any] = {
        "rows": tuple(copies * n for n in scene.rows),
        "anchor_q": np.concatenate(voxels),
        "mask": tuple(codes[index[: copies * len(codes)]] for codes in scene.mask),
    }
    changed |= {name: getattr(scene, name)[index] for name in ("feature", "scaling_log", "offset")}
    if scene.grading is not None:
        changed["grading"] = scene.grading.take(index)
    return replace(scene, **changed)


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    assert __doc__
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("files", nargs="+", type=Path)
    p.add_argument("--runs", type=int, default=9, help="decodes after the warm-up (default: 9)")
    p.add_argument("--grow", nargs=2, metavar=("N", "FILE"), help="only write the first file grown to N anchors")
    p.add_argument("--json", type=Path, metavar="FILE", help="write the figures")
    args = p.parse_args(argv)
    if args.grow:
        scene = grown(decode(args.files[0].read_bytes()), int(args.grow[0]))
        Path(args.grow[1]).write_bytes(encode(scene, effort=1, omit="nothing", verify=False))
        return 0
    with NodeDecoder() as node:
        rows = [compare(path, args.runs, node) for path in args.files]
    heads = ["file", "anchors", "node_cpu_s", "python_cpu_s", "cpu_ratio", "node_wall_s", "python_wall_s", "wall_ratio"]
    print(f"| {' | '.join(heads)} |\n{'|---' * len(heads)}|")
    for row in rows:
        cells = (f"{row[head]:.4f}" if isinstance(row[head], float) else f"{row[head]}" for head in heads)
        print(f"| {' | '.join(cells)} |")
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
