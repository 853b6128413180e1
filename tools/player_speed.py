"""Decode times of the player's decoder, in Node, beside the package's, in one run and in turn.

    python tools/player_speed.py a.pd4 b.pd4               # median of 9 decodes each, after 8 that do not count
    python tools/player_speed.py a.pd4 --runs 25 --json times.json
    python tools/player_speed.py a.pd4 --grow 100000 big.pd4  # writes copies of a.pd4's anchors side by side
    python tools/player_speed.py --before FOLDER model.pt     # also beside the package of another commit, in FOLDER

With --before each checkpoint is packed by either commit, as it is and grown to 100,000 anchors; the player decodes the
file of this one.

All decode whole files from memory, warm, in processes of their own that stay. What counts is processor time, so that
a busy machine changes less; wall time stands beside it. They slow down alike when other work shares the cores, and as
they take turns, the ratio is of decodes that met the same conditions.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from decoder_loop import grown

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from pd4dgs_codec import decode, encode  # noqa: E402

LOOP = ROOT / "player" / "testing" / "decoder_loop.mjs"
PYTHON_LOOP = ROOT / "tools" / "decoder_loop.py"
WARM_UP = 8
#: Anchors of the large file.
MANY = 100_000


@dataclass(frozen=True)
class Times:
    """Seconds of each decode."""

    cpu: list[float]
    wall: list[float]


class Loop:
    """A process that answers lines of JSON; close it, or use it in a `with` block."""

    def __init__(self, command: Sequence[str], environment: Mapping[str, str] | None = None):
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, env=environment)

    def __enter__(self) -> Any:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Ends the process."""
        self._process.communicate(timeout=60)

    def ask(self, question: Mapping[str, object]) -> dict[str, object]:
        """The answer to one line."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(json.dumps(question) + "\n")
        self._process.stdin.flush()
        line = self._process.stdout.readline()
        if not line:
            raise SystemExit(f"player_speed.py: {self._process.args} ended with {self._process.wait()}")
        answer: dict[str, object] = json.loads(line)
        return answer

    def seconds(self, path: Path) -> tuple[float, float]:
        """(processor, wall) time of decoding a file once."""
        answer = self.ask({"time": str(path.resolve())})
        if "cpu" not in answer:
            raise SystemExit(f"player_speed.py: {path}: {answer.get('message') or answer}")
        return float(str(answer["cpu"])), float(str(answer["wall"]))


class NodeDecoder(Loop):
    """The player's decoder."""

    def __init__(self, node: str = "node"):
        super().__init__([node, str(LOOP)])


class PythonDecoder(Loop):
    """The package in the folder of a checkout."""

    def __init__(self, checkout: Path):
        super().__init__([sys.executable, str(PYTHON_LOOP)], os.environ | {"PYTHONPATH": str(checkout)})

    def pack(self, checkpoint: Path, file: Path, anchors: int) -> None:
        """Writes `file`, grown to so many anchors if any are asked for."""
        self.ask({"pack": str(checkpoint.resolve()), "to": str(file), "anchors": anchors})


def python_seconds(data: bytes) -> tuple[float, float]:
    """(processor, wall) time of decoding a file once with the package."""
    cpu, wall = time.process_time(), time.perf_counter()
    decode(data)
    return time.process_time() - cpu, time.perf_counter() - wall


def compare(
    path: Path, runs: int, node: Loop, before: tuple[Loop, Path] | None = None
) -> tuple[int, Times, Times, Times | None]:
    """(anchors, times in Node, times in Python, times before) of `runs` decodes in turn. before: a loop of another
    commit, and its own file of the same scene."""
    data = path.read_bytes()
    anchors = decode(data).rows[-1]
    turns = []
    for _ in range(WARM_UP + runs):
        turn = [node.seconds(path), python_seconds(data)]
        turns.append(turn + [before[0].seconds(before[1])] if before else turn)
    found = [Times(*map(list, zip(*times, strict=True))) for times in zip(*turns[WARM_UP:], strict=True)]
    return anchors, found[0], found[1], found[2] if before else None


def row(path: Path, anchors: int, ours: Times, theirs: Times, before: Times | None) -> dict[str, object]:
    """Medians, and the median of the ratios turn by turn."""
    known: dict[str, object] = (
        {
            "before_cpu_s": median(before.cpu),
            "before_ratio": median(a / b for a, b in zip(ours.cpu, before.cpu, strict=True)),
        }
        if before
        else {}
    )
    return known | {
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


def beside(checkpoint: Path, checkout: Path, runs: int, node: Loop) -> list[dict[str, object]]:
    """Rows of a checkpoint's file and of one with MANY anchors, beside the package in `checkout`."""
    rows = []
    with tempfile.TemporaryDirectory() as folder, PythonDecoder(ROOT) as now, PythonDecoder(checkout) as then:
        for anchors in (0, MANY):
            name = f"{checkpoint.parent.name}{f'-{anchors}' if anchors else ''}.pd4"
            ours, theirs = Path(folder) / name, Path(folder) / f"before-{name}"
            now.pack(checkpoint, ours, anchors)
            then.pack(checkpoint, theirs, anchors)
            rows.append(row(ours, *compare(ours, runs, node, (then, theirs))))
    return rows


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    assert __doc__
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("files", nargs="+", type=Path)
    p.add_argument("--runs", type=int, default=9, help="decodes that count (default: 9)")
    p.add_argument(
        "--grow", nargs=2, metavar=("N", "FILE"), help="write a file of N anchors instead, from the first file"
    )
    p.add_argument("--before", type=Path, metavar="FOLDER", help="a checkout of another commit; FILES are checkpoints")
    p.add_argument("--json", type=Path, metavar="FILE", help="write the figures")
    args = p.parse_args(argv)
    if args.grow:
        count, path = args.grow
        Path(path).write_bytes(
            encode(grown(decode(args.files[0].read_bytes()), int(count)), effort=1, omit="nothing", verify=False)
        )
        return 0
    with NodeDecoder() as node:
        if args.before:
            rows = [row for path in args.files for row in beside(path, args.before, args.runs, node)]
        else:
            rows = [row(path, *compare(path, args.runs, node)) for path in args.files]
    heads = ["file", "anchors", "Node CPU s", "Python CPU s", "Node/Python CPU", "Node wall s", "Python wall s", "wall"]
    heads += ["before CPU s", "Node/before CPU"] if args.before else []
    print(f"| {' | '.join(heads)} |")
    print("|---" * len(heads) + "|")
    for r in rows:
        cells = [str(r["file"]), f"{r['anchors']:,}", f"{r['node_cpu_s']:.4f}", f"{r['python_cpu_s']:.4f}"]
        cells += [f"{r['cpu_ratio']:.2f}", f"{r['node_wall_s']:.4f}", f"{r['python_wall_s']:.4f}"]
        cells += [f"{r['wall_ratio']:.2f}"]
        cells += [f"{r['before_cpu_s']:.4f}", f"{r['before_ratio']:.2f}"] if args.before else []
        print(f"| {' | '.join(cells)} |")
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
