"""Feeds the player's decoder the inputs of tools/fuzz.py and holds what becomes of them against the package's verdict.

    python tools/player_fuzz.py                        # 10,000 inputs of run 0, some minutes
    python tools/player_fuzz.py --inputs 300 --seed 7 --json figures.json
    python tools/player_fuzz.py --input 4711           # one input again, with its recipe

About three of five inputs were changed inside and sealed again, so that lengths, scene ids and checksums are right. An
exception that is no DecodeError, an end of the Node process, a file accepted that the package refuses, or the reverse,
and other hashes are findings, and the exit code is 1. Another name of clause 15 is listed, and no finding: a file with
several faults is refused for any one of them. What the header says to be of mode lzma or to hold float32 values counts
as refused with UnsupportedFeature, as this decoder is an ans-only one (clause 16).
"""

from __future__ import annotations

import argparse
import base64
import json
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tools"), str(ROOT / "tests")]

from fuzz import all_seeds  # noqa: E402
from fuzzing.files import Seed  # noqa: E402
from fuzzing.mutate import make_case  # noqa: E402
from player_speed import NodeDecoder  # noqa: E402

from pd4dgs_codec.errors import DecodeError  # noqa: E402
from pd4dgs_codec.format.container import read_preamble  # noqa: E402
from pd4dgs_codec.format.header import unpack_header  # noqa: E402
from pd4dgs_codec.format.info import hashes  # noqa: E402

DECODED = "decoded"
UNSUPPORTED = "UnsupportedFeature"


@dataclass
class Figures:
    """What is counted; findings and differences are one line each."""

    inputs: int = 0
    sealed: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    differences: Counter[str] = field(default_factory=Counter)
    findings: list[str] = field(default_factory=list)
    examples: dict[str, str] = field(default_factory=dict)

    def text(self) -> str:
        """The figures as a table, with the findings and one example of each difference."""
        rows = [("inputs", self.inputs), ("sealed again after the change", self.sealed)]
        rows += [(f"ends in {name}", count) for name, count in self.outcomes.most_common()]
        rows += [("other names", sum(self.differences.values())), ("findings", len(self.findings))]
        lines = ["| figure | value |", "|---|---|", *(f"| {name} | {count:,} |" for name, count in rows)]
        lines += [f"{count} × {name}: {self.examples[name]}" for name, count in self.differences.most_common()]
        return "\n".join([*lines, *self.findings])


def ans_only(data: bytes) -> bool:
    """Whether the header is read and asks for what an ans-only decoder does without."""
    try:
        header = unpack_header(read_preamble(data).header)
    except DecodeError:
        return False
    return header.mode != "ans"


def expected(data: bytes) -> tuple[str, Any]:
    """(DECODED or the name of the error, the hashes or its message) that an ans-only decoder owes."""
    if ans_only(data):
        return UNSUPPORTED, "mode lzma"
    try:
        return DECODED, hashes(data)
    except DecodeError as error:
        return type(error).__name__, str(error)


def answer(node: NodeDecoder, data: bytes) -> tuple[str, Any]:
    """The same of the player's decoder; "crash" is an exception that is no DecodeError."""
    found: dict[str, Any] = node.ask({"hashes": base64.b64encode(data).decode()})
    if "crash" in found:
        return "crash", found["crash"]
    return (found["error"], found["message"]) if "error" in found else (DECODED, found["hashes"])


def compare(node: NodeDecoder, data: bytes, what: str, figures: Figures) -> None:
    """Adds one input to the figures. what: names it."""
    (name, result), (found, given) = expected(data), answer(node, data)
    figures.inputs += 1
    figures.outcomes[found] += 1
    if found == name == DECODED and result != given:
        figures.findings.append(f"other hashes: {what}")
    elif found == "crash" or (DECODED in (found, name) and found != name):
        figures.findings.append(f"{found}, the package ends in {name}: {given} | {result}: {what}")
    elif found != name:
        difference = f"{found}, the package says {name}"
        figures.differences[difference] += 1
        figures.examples.setdefault(difference, f"{given} | {result}: {what}")


def run_inputs(node: NodeDecoder, seeds: Sequence[Seed], run: int, indices: Sequence[int]) -> Figures:
    """The figures of these inputs of a run."""
    figures = Figures()
    for index in indices:
        case = make_case(seeds, run, index)
        figures.sealed += case.repaired
        compare(node, case.data, f"input {index} of run {run}, {case.recipe}", figures)
    return figures


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    assert __doc__
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("files", nargs="*", type=Path, help="more seed files, .pd4 or folders of them")
    p.add_argument("--inputs", type=int, default=10_000, help="how many (default: 10000)")
    p.add_argument("--seed", type=int, default=0, help="number of the run (default: 0)")
    p.add_argument("--input", type=int, metavar="I", help="input I alone")
    p.add_argument("--json", type=Path, metavar="FILE", help="write the figures")
    args = p.parse_args(argv)
    seeds = all_seeds(args.files)
    indices = range(args.inputs) if args.input is None else [args.input]
    if args.input is not None:
        print(make_case(seeds, args.seed, args.input).recipe)
    with NodeDecoder() as node:
        figures = run_inputs(node, seeds, args.seed, indices)
    print(figures.text())
    if args.json:
        args.json.write_text(json.dumps(vars(figures), indent=1) + "\n")
    return 1 if figures.findings else 0


if __name__ == "__main__":
    sys.exit(main())
