"""Makes legal files and mutates them, and holds the decoders to their promises.

    python tools/fuzz.py                                        # 20,000 inputs of run 0
    python tools/fuzz.py --inputs 1000000 --decoders python     # the package alone
    python tools/fuzz.py --inputs 5000 --seed 7 scene.pd4       # files beside the built-in ones
    python tools/fuzz.py --seed 7 --input 4711                  # one input again, with its recipe

One of five inputs is a legal file of random choices near the limits, which every decoder must accept with the hashes
that its writer says. Of the others, three of five have their fields, tables, codes or bytes changed and then right
lengths, CRC-32 and scene id, and two keep the CRCs of before. Input i of a run over the same files is the same on every
machine. A crash, an exception that is no DecodeError, too much time or memory, damage that decodes, and a decoder that
accepts what another refuses, yields other hashes or makes a scene where another makes none are findings; they are saved
in --out, and the exit code is 1. Ctrl-C ends the run with what was found.
"""

from __future__ import annotations

import argparse
import contextlib
import multiprocessing
import random
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fuzzing.check import DECODED, Answer, Decoder, Finding, JavaScript, check_memory, check_package, compare, reference
from fuzzing.legal import Case, seeds
from fuzzing.mutate import make_case
from vectors import ROOT

#: Those beside the package's. They are made in the process that asks them.
DECODERS: dict[str, Callable[[], Decoder]] = {"refdec": lambda: reference, "javascript": JavaScript}
NAMES = ("python", *DECODERS)
COMPARED = {"refdec": 10, "javascript": 2}  #: every so many inputs, and every legal one
MEASURED = 25  #: every so many inputs the peak memory is traced, which takes twice the time
STUCK_SECONDS = 300.0  #: of wall time on one input, on a busy machine; then the process is ended


@dataclass
class Figures:
    """counts: of inputs, by name. differences: faults that two decoders name differently. findings: {input, kind,
    message, recipe}."""

    counts: Counter[str] = field(default_factory=Counter)
    differences: Counter[str] = field(default_factory=Counter)
    memory: float = 0.0  #: the largest share of the bound
    findings: list[dict[str, Any]] = field(default_factory=list)

    def add(self, other: Figures) -> None:
        """Count another part of the run as well."""
        self.counts += other.counts
        self.differences += other.differences
        self.memory = max(self.memory, other.memory)
        self.findings += other.findings

    def text(self) -> str:
        """A table."""
        rows = [*sorted(self.counts.items()), ("faults under two names", self.differences.total())]
        rows += [("largest memory / bound", f"{self.memory:.0%}"), ("findings", len(self.findings))]
        lines = ["| figure | value |\n|---|---|", *(f"| {name} | {value} |" for name, value in rows)]
        lines += [f"{count} × {name}" for name, count in self.differences.most_common(10)]
        lines += [f"{r['input']} {r['kind']}: {r['message']} ({r['recipe']})" for r in self.findings[:20]]
        return "\n".join(lines)


def row_of(index: int, finding: Finding, case: Case) -> dict[str, Any]:
    """A finding in input number `index`."""
    return {"input": index, "kind": finding.kind, "message": str(finding), "recipe": case.recipe}


def examine(files: Sequence[Case], run: int, index: int, decoders: dict[str, Decoder], every: bool = False) -> Figures:
    """Examines one input. every: by all of `decoders`, also where it is not their turn."""
    case = make_case(files, run, index)
    legal = case.meaning is not None
    sort = "legal files" if legal else "CRCs recomputed after the mutation" if case.sealed else "CRCs of before"
    figures = Figures(Counter(["inputs", sort]))
    asked = {n: d for n, d in decoders.items() if every or legal or index % COMPARED.get(n, 1) == 0}
    try:
        own = check_package(case, random.Random(~index))
        scene = "" if own.scene in ("", DECODED) else f", the scene {own.scene}"
        figures.counts[f"ends in {own.name}{scene}"] += 1
        answers = {"the writer": Answer(DECODED, case.meaning)} if legal else {}
        answers |= {"python": own} | {n: found for n, d in asked.items() if (found := d(case.data, case.base))}
        figures.counts.update(f"compared with {name}" for name in asked if name in answers)
        if difference := compare(answers):
            figures.differences[difference] += 1
        if index % MEASURED == 0:
            figures.memory = check_memory(case.data, case.base)
    except Finding as finding:
        figures.findings.append(row_of(index, finding, case))
    return figures


def make_decoders(names: Sequence[str]) -> dict[str, Decoder]:
    """The decoders of these names."""
    return {name: make() for name, make in DECODERS.items() if name in names}


def _child(writer: Any, files: Sequence[Case], run: int, inputs: range, names: Sequence[str]) -> None:
    decoders = make_decoders(names)
    for index in inputs:
        writer.send(examine(files, run, index, decoders))


def run_safely(files: Sequence[Case], run: int, inputs: range, names: Sequence[str]) -> Iterator[Figures]:
    """Examines inputs in a child process, and behind one at which it crashes or gets stuck, which is a finding, in
    another."""
    context = multiprocessing.get_context("fork")
    while inputs:
        reader, writer = context.Pipe(duplex=False)
        child = context.Process(target=_child, args=(writer, files, run, inputs, names), daemon=True)
        child.start()
        writer.close()
        for index in inputs:
            if not reader.poll(STUCK_SECONDS):
                child.kill()
            try:
                yield reader.recv()
            except EOFError:
                child.join()
                crash = Finding("crash", f"the process ended with exit code {child.exitcode}")
                yield Figures(Counter(["inputs"]), findings=[row_of(index, crash, make_case(files, run, index))])
                break
        child.join()
        inputs = range(index + 1, inputs.stop)


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    assert __doc__
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("files", nargs="*", type=Path, help="more files to mutate, .pd4 or folders of them")
    p.add_argument("--inputs", type=int, default=20_000, help="number of inputs (default: 20000)")
    p.add_argument("--seed", type=int, default=0, help="seed of the run (default: 0)")
    p.add_argument("--decoders", default=",".join(NAMES), help="of python,refdec,javascript (default: all)")
    p.add_argument("--input", type=int, metavar="I", help="examine input I alone, in this process")
    p.add_argument("--out", type=Path, default=ROOT / "out" / "fuzz", help="folder for findings (default: out/fuzz)")
    args = p.parse_args(argv)
    names = args.decoders.split(",")
    if unknown := set(names) - set(NAMES):
        p.error(f"--decoders: expected some of {', '.join(NAMES)}, found {', '.join(sorted(unknown))}")
    files, figures = seeds(args.files), Figures()
    if args.input is None:
        parts = run_safely(files, args.seed, range(args.inputs), names)
    else:
        print(make_case(files, args.seed, args.input).recipe)
        parts = iter([examine(files, args.seed, args.input, make_decoders(names), every=True)])
    with contextlib.suppress(KeyboardInterrupt):
        for part in parts:
            figures.add(part)
            for row in part.findings:  # at once, since a long run may be killed
                args.out.mkdir(parents=True, exist_ok=True)
                case = make_case(files, args.seed, row["input"])
                for data, name in ((case.data, ""), (case.base, "-base")):
                    if data is not None:
                        (args.out / f"{args.seed}-{row['input']}-{row['kind']}{name}.pd4").write_bytes(data)
    print(figures.text())
    return 1 if figures.findings else 0


if __name__ == "__main__":
    sys.exit(main())
