"""Makes legal files and mutates them, and holds the decoders to their promises.

    python tools/fuzz.py                                        # 20,000 inputs of run 0
    python tools/fuzz.py --inputs 1000000 --decoders python     # the package alone
    python tools/fuzz.py --inputs 5000 --seed 7 scene.pd4       # files beside the built-in ones
    python tools/fuzz.py --seed 7 --input 4711                  # one input again, with its recipe

One of five inputs is a legal file of random choices near the limits, which every decoder must accept with the hashes
that its writer says. Of the others, three of five have their fields, sections, tokens or bytes changed and then right
lengths, CRC-32 and scene id, and two keep the CRCs of before. Input i of a run over the same files is the same on every
machine. A crash, an exception that is no DecodeError, too much time or memory, damage that decodes, and a decoder that
accepts what another refuses or yields other hashes are findings; they are saved in --out, and the exit code is 1.
Ctrl-C ends the run with what was found.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import multiprocessing
import random
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tools")]

from fuzzing.check import (  # noqa: E402
    Decoder,
    Finding,
    JavaScript,
    Reference,
    check_memory,
    check_package,
    compare,
    python_decoder,
)
from fuzzing.legal import Seed, seeds  # noqa: E402
from fuzzing.mutate import make_case  # noqa: E402

DECODERS = ("python", "refdec", "javascript")
COMPARED = {"refdec": 10, "javascript": 2}  #: every so many inputs, and every legal one
MEASURED = 25  #: every so many inputs the peak memory is traced, which takes twice the time
STUCK_SECONDS = 300.0  #: of wall time on one input, on a busy machine; then the process is ended
BATCH = 500  #: inputs of a process


@dataclass
class Figures:
    """Counts. findings: {input, kind, message, recipe}. differences: faults that two decoders name differently."""

    inputs: int = 0
    legal: int = 0
    sealed: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    compared: Counter[str] = field(default_factory=Counter)
    differences: Counter[str] = field(default_factory=Counter)
    memory: float = 0.0  #: the largest share of the bound
    findings: list[dict[str, Any]] = field(default_factory=list)

    def add(self, other: Figures) -> None:
        """Count another part of the run as well."""
        self.inputs += other.inputs
        self.legal += other.legal
        self.sealed += other.sealed
        self.outcomes += other.outcomes
        self.compared += other.compared
        self.differences += other.differences
        self.memory = max(self.memory, other.memory)
        self.findings += other.findings

    def text(self) -> str:
        """A table."""
        rows: list[tuple[str, Any]] = [("inputs", self.inputs), ("legal files", self.legal)]
        rows += [("right CRCs after the mutation", self.sealed)]
        rows += [(f"ends in {name}", count) for name, count in self.outcomes.most_common()]
        rows += [(f"compared with {name}", count) for name, count in self.compared.items()]
        rows += [("another name for a fault", self.differences.total()), ("memory, of its bound", f"{self.memory:.0%}")]
        lines = [
            "| figure | value |",
            "|---|---|",
            *(f"| {n} | {v} |" for n, v in [*rows, ("findings", len(self.findings))]),
        ]
        lines += [f"{count} × {name}" for name, count in self.differences.most_common(10)]
        return "\n".join(
            [*lines, *(f"{r['input']} {r['kind']}: {r['message']} ({r['recipe']})" for r in self.findings[:20])]
        )


def run_inputs(
    files: Sequence[Seed], run: int, inputs: Sequence[int], decoders: dict[str, Decoder], place: Any = None
) -> Figures:
    """Examine these inputs in this process. place.value: the one at work."""
    figures = Figures()
    for index in inputs:
        if place is not None:
            place.value = index
        case = make_case(files, run, index)
        legal = case.meaning is not None
        figures.inputs += 1
        figures.legal += legal
        figures.sealed += case.sealed and not legal
        every = legal or len(inputs) == 1
        asked = {n: d for n, d in decoders.items() if every or index % COMPARED.get(n, 1) == 0}
        try:
            figures.outcomes[check_package(case, random.Random(~index))] += 1
            figures.compared.update(set(asked) - {"python"})
            if difference := compare(case.data, asked, case.meaning):
                figures.differences[difference] += 1
            if index % MEASURED == 0:
                figures.memory = max(figures.memory, check_memory(case.data))
        except Finding as finding:
            row = {"input": index, "kind": finding.kind, "message": str(finding), "recipe": case.recipe}
            figures.findings.append(row)
    return figures


def make_decoders(names: Sequence[str]) -> dict[str, Decoder]:
    """The decoders of these names, the package's first."""
    kinds: dict[str, Any] = {"python": lambda: python_decoder, "refdec": Reference, "javascript": JavaScript}
    return {name: kinds[name]() for name in DECODERS if name in names}


def _child(writer: Any, files: Sequence[Seed], run: int, inputs: range, names: Sequence[str], place: Any) -> None:
    writer.send(run_inputs(files, run, inputs, make_decoders(names), place))


def run_safely(files: Sequence[Seed], run: int, inputs: range, names: Sequence[str]) -> Figures:
    """Examine inputs in child processes: one that crashes or gets stuck is a finding, and the run goes on behind it."""
    context, figures = multiprocessing.get_context("fork"), Figures()
    while inputs:
        reader, writer = context.Pipe(duplex=False)
        place, seen, since = context.RawValue("q", inputs[0]), -1, time.monotonic()
        child = context.Process(target=_child, args=(writer, files, run, inputs, names, place))
        child.start()
        writer.close()
        while not reader.poll(1.0):
            if place.value != seen:
                seen, since = place.value, time.monotonic()
            elif time.monotonic() - since > STUCK_SECONDS:
                child.kill()
        try:
            figures.add(reader.recv())
            inputs = range(0)
        except EOFError:
            child.join()
            lost = place.value  # the inputs before it, which were counted in the child, are examined again
            figures.add(run_safely(files, run, range(inputs[0], lost), names))
            message = f"the process ended with {child.exitcode}"
            row = {"input": lost, "kind": "crash", "message": message, "recipe": make_case(files, run, lost).recipe}
            figures.findings.append(row)
            figures.inputs += 1
            inputs = range(lost + 1, inputs[-1] + 1)
        child.join()
    return figures


def _keep(figures: Figures, files: Sequence[Seed], args: argparse.Namespace) -> None:
    """Saves what was found so far."""
    for row in figures.findings:
        args.out.mkdir(parents=True, exist_ok=True)
        path = args.out / f"{args.seed}-{row['input']}-{row['kind']}.pd4"
        path.write_bytes(make_case(files, args.seed, row["input"]).data)
    if args.json:
        args.json.write_text(json.dumps(vars(figures), indent=1) + "\n")


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    assert __doc__
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("files", nargs="*", type=Path, help="more files to mutate, .pd4 or folders of them")
    p.add_argument("--inputs", type=int, default=20_000, help="how many (default: 20000)")
    p.add_argument("--seed", type=int, default=0, help="number of the run (default: 0)")
    p.add_argument("--decoders", default=",".join(DECODERS), help="of python,refdec,javascript (default: all)")
    p.add_argument("--input", type=int, metavar="I", help="examine input I alone, in this process")
    p.add_argument("--out", type=Path, default=ROOT / "out" / "fuzz", help="folder for findings (default: out/fuzz)")
    p.add_argument("--json", type=Path, metavar="FILE", help="write the figures, also of the batches so far")
    args = p.parse_args(argv)
    names = args.decoders.split(",")
    if unknown := set(names) - set(DECODERS):
        p.error(f"--decoders: expected some of {', '.join(DECODERS)}, found {', '.join(sorted(unknown))}")
    files = seeds(args.files)
    if args.input is not None:
        print(make_case(files, args.seed, args.input).recipe)
        figures = run_inputs(files, args.seed, [args.input], make_decoders(names))
    else:
        figures = Figures()
        with contextlib.suppress(KeyboardInterrupt):
            for first in range(0, args.inputs, BATCH):
                batch = range(first, min(first + BATCH, args.inputs))
                figures.add(run_safely(files, args.seed, batch, names))
                _keep(figures, files, args)
    _keep(figures, files, args)
    print(figures.text())
    return 1 if figures.findings else 0


if __name__ == "__main__":
    sys.exit(main())
