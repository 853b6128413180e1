"""Decode times of the player's decoder, in Node, beside the package's.

    python tools/player_speed.py a.pd4 b.pd4                  # median of 9 decodes each, after 8 of warm-up
    python tools/player_speed.py a.pd4 --runs 25 --json times.json

Both decode whole files from memory, warm, and take turns, so that they meet the same load; processor time changes less
with that load than wall time.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from pd4dgs_codec import decode  # noqa: E402

LOOP = ROOT / "player" / "testing" / "decoder_loop.mjs"
WARM_UP = 8


def node_seconds(node: subprocess.Popen[str], path: Path) -> tuple[float, float]:
    """(processor, wall) time of decoding a file once with the player's decoder, a process that answers lines."""
    assert node.stdin is not None and node.stdout is not None
    node.stdin.write(json.dumps({"time": str(path.resolve())}) + "\n")
    node.stdin.flush()
    answer: dict[str, Any] = json.loads(node.stdout.readline() or '{"message": "node ended"}')
    if "cpu" not in answer:
        raise SystemExit(f"player_speed.py: {path}: {answer.get('message') or answer}")
    return answer["cpu"], answer["wall"]


def python_seconds(data: bytes) -> tuple[float, float]:
    """(processor, wall) time of decoding a file once with the package."""
    cpu, wall = time.process_time(), time.perf_counter()
    decode(data)
    return time.process_time() - cpu, time.perf_counter() - wall


def compare(path: Path, runs: int, node: subprocess.Popen[str]) -> dict[str, Any]:
    """Medians of `runs` decodes in turn, and the medians of the ratios."""
    data = path.read_bytes()
    turns = [(node_seconds(node, path), python_seconds(data)) for _ in range(WARM_UP + runs)][WARM_UP:]
    result: dict[str, Any] = {"file": path.name, "bytes": len(data), "anchors": decode(data).rows[-1], "runs": runs}
    for i, kind in enumerate(("cpu", "wall")):
        for side, name in enumerate(("node", "python")):
            result[f"{name}_{kind}_s"] = median(turn[side][i] for turn in turns)
        result[f"{kind}_ratio"] = median(ours[i] / theirs[i] for ours, theirs in turns)
    return result


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    assert __doc__
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("files", nargs="+", type=Path)
    p.add_argument("--runs", type=int, default=9, help="decodes after the warm-up (default: 9)")
    p.add_argument("--json", type=Path, metavar="FILE", help="write the figures")
    args = p.parse_args(argv)
    pipe = subprocess.PIPE
    with subprocess.Popen(["node", str(LOOP)], stdin=pipe, stdout=pipe, text=True) as node:
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
