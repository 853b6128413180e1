"""Feeds the decoder hostile input and counts what becomes of it.

    python tools/fuzz.py                                  # 20,000 inputs of run 0
    python tools/fuzz.py --inputs 1000000 --jobs 2 --json figures.json
    python tools/fuzz.py --input 4711                     # one input again, with its recipe
    python tools/fuzz.py --atheris 300                    # coverage-guided, 300 s; needs `pip install atheris`
    python tools/fuzz.py --coverage 20000                 # which branches those inputs alone reach; needs `coverage`
    python tools/fuzz.py --cost 3600                      # legal files, steered to what decoding costs most
    python tools/fuzz.py --damage 100000 a.pd4 b.pd4      # flips, bursts, swaps, splices and cuts of files of any size

Inputs are numbered: input i of run S over the same seed files is the same on every machine, whatever --jobs is. Each is
decoded in a child process by every entry point; a crash, a hang and anything but the package's own DecodeErrors is a
finding, saved as a file in --out. Exit 1 if there are findings.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import multiprocessing.connection
import random
import re
import resource
import subprocess
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tools"), str(ROOT / "tests")]

from fuzzing.check import Finding, check_memory, compare_reference, examine  # noqa: E402
from fuzzing.costly import search  # noqa: E402
from fuzzing.damage import damage  # noqa: E402
from fuzzing.files import Seed, built_seeds, given_seeds, known_prefixes  # noqa: E402
from fuzzing.mutate import Case, make_case  # noqa: E402

VECTORS = ROOT / "spec" / "vectors"
PACKAGES = ("bitstream", "entropy", "attributes", "codec")
BATCH = 5000  #: inputs per child process
SAMPLE = 25  #: every so many inputs the peak memory is traced, which takes twice the time
STUCK_SECONDS = 20.0  #: of wall time on one input, then its process is ended
SPARE_MEMORY = 4 << 30  #: address space a child may take beyond what it begins with
SEEN_MEMORY = 24 << 10  #: KiB: an input that grows the process by so much is traced as well
CHECKSUMS = ("header's checksum", "first chunk's", "second chunk's", "third chunk's")


@dataclass
class Figures:
    """What is counted. Sums of two runs' figures are the figures of both."""

    inputs: int = 0
    repaired: int = 0
    checksums: Counter[int] = field(default_factory=Counter)  #: inputs by number of checksums that hold
    outcomes: Counter[str] = field(default_factory=Counter)
    findings: list[dict[str, Any]] = field(default_factory=list)
    slowest: tuple[float, int] = (0.0, -1)  #: seconds of processor time of decode, input
    memory: tuple[float, int] = (0.0, -1)  #: share of the bound, input
    traced: int = 0
    compared: int = 0  #: with the reference decoder
    seconds: float = 0.0  #: of processor time, all checks included

    def add(self, other: Figures) -> None:
        """Count another part of the run as well."""
        self.inputs += other.inputs
        self.repaired += other.repaired
        self.checksums += other.checksums
        self.outcomes += other.outcomes
        self.findings += other.findings
        self.slowest, self.memory = max(self.slowest, other.slowest), max(self.memory, other.memory)
        self.traced += other.traced
        self.compared += other.compared
        self.seconds += other.seconds

    def shares(self) -> dict[str, float]:
        """Per checksum the share of the inputs in which it holds, and all before it."""
        past = [sum(n for depth, n in self.checksums.items() if depth >= k) for k in range(1, 1 + len(CHECKSUMS))]
        return {name: count / max(self.inputs, 1) for name, count in zip(CHECKSUMS, past, strict=True)}

    def markdown(self) -> str:
        """The figures as tables."""
        share = [f"| past the {name} | {share:.1%} |" for name, share in self.shares().items()]
        outcomes = [f"| ends in {name} | {count:,} |" for name, count in self.outcomes.most_common()]
        rows = [
            f"| inputs | {self.inputs:,} |",
            f"| repaired after the mutation | {self.repaired / max(self.inputs, 1):.1%} |",
            *share,
            *outcomes,
            f"| inputs per second and core | {self.inputs / max(self.seconds, 1e-9):,.0f} |",
            f"| slowest decode | {self.slowest[0]:.3f} s (input {self.slowest[1]}) |",
            f"| highest memory, of its bound | {self.memory[0]:.1%} (input {self.memory[1]}; {self.traced:,} traced) |",
            f"| compared with the reference decoder | {self.compared:,} |",
            f"| findings | {len(self.findings)} |",
        ]
        return "\n".join(["| figure | value |", "|---|---|", *rows])

    def json(self) -> dict[str, Any]:
        """The figures as plain values, with the shares worked out."""
        rate = self.inputs / max(self.seconds, 1e-9)
        return {**vars(self), "past": self.shares(), "inputs_per_second": rate}


# -- one process -------------------------------------------------------------------------------------------------------


def peak_kib() -> int:
    """The highest resident size of this process since forget_peak, KiB; 0 where the system does not tell."""
    try:
        status = Path("/proc/self/status").read_bytes()
    except OSError:
        return 0
    found = re.search(rb"VmHWM:\s+(\d+)", status)
    return int(found[1]) if found else 0


def forget_peak() -> None:
    """Begin a new highest resident size."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        pass


def run_inputs(
    seeds: Sequence[Seed], run: int, first: int, end: int, place: Any = None, stop: Any = None, reference: int = 0
) -> Figures:
    """Examine the inputs first .. end - 1. place.value: the one at work; stop.value: end early.

    reference: every so many inputs are decoded by the specification's reference decoder as well, 0 for none.
    """
    figures, known = Figures(), known_prefixes(seeds)
    started = time.process_time()
    forget_peak()
    usual = peak_kib()
    for index in range(first, end):
        if place is not None:
            place.value = index
            if stop.value:
                break
        case = make_case(seeds, run, index)
        figures.inputs += 1
        figures.repaired += case.repaired
        try:
            outcome = examine(case, known, random.Random(~index))
            figures.outcomes[outcome.name] += 1
            figures.checksums[outcome.checksums] += 1
            figures.slowest = max(figures.slowest, (outcome.seconds, index))
            if reference and index % reference == 0:
                figures.compared += compare_reference(case.data)
            grown = peak_kib() > usual + SEEN_MEMORY
            if index % SAMPLE == 0 or grown:
                figures.traced += 1
                figures.memory = max(figures.memory, (check_memory(case.data), index))
            if grown:
                forget_peak()
                usual = peak_kib()
        except Finding as finding:
            figures.findings.append(_row(index, finding.kind, str(finding), case))
    figures.seconds = time.process_time() - started
    return figures


def _row(index: int, kind: str, message: str, case: Case) -> dict[str, Any]:
    return {"input": index, "kind": kind, "message": message, "recipe": case.recipe, "bytes": len(case.data)}


# -- many processes ----------------------------------------------------------------------------------------------------


@dataclass
class _Child:
    process: Any
    reader: Any
    place: Any
    first: int
    end: int
    seen: int = -1
    since: float = 0.0


def _child_main(writer: Any, *args: Any) -> None:
    taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (taken + SPARE_MEMORY,) * 2)
    writer.send(run_inputs(*args))


def run_many(seeds: Sequence[Seed], run: int, inputs: int, seconds: float, jobs: int, reference: int = 0) -> Figures:
    """The inputs 0 .. inputs - 1 in child processes, or as many as `seconds` of wall time allow."""
    context = multiprocessing.get_context("fork")  # the seeds are built once
    stop, figures = context.RawValue("b", 0), Figures()
    waiting = [(first, min(first + BATCH, inputs)) for first in range(0, inputs, BATCH)][::-1]
    children: list[_Child] = []
    deadline = time.monotonic() + seconds
    while waiting or children:
        if time.monotonic() > deadline:
            stop.value, waiting = 1, []
        while waiting and len(children) < jobs:
            first, end = waiting.pop()
            reader, writer = context.Pipe(duplex=False)
            place = context.RawValue("q", first)
            process = context.Process(target=_child_main, args=(writer, seeds, run, first, end, place, stop, reference))
            process.start()
            writer.close()
            children.append(_Child(process, reader, place, first, end))
        multiprocessing.connection.wait([child.reader for child in children], timeout=1.0)
        for child in children[:]:
            lost = _look_after(child, figures)
            if lost is None:
                continue
            children.remove(child)
            if lost:  # the inputs before and after the one that ended the process are examined again without it
                index = child.place.value
                case = make_case(seeds, run, index)
                figures.inputs += 1
                figures.repaired += case.repaired
                figures.findings.append(_row(index, lost, f"the process ended with {child.process.exitcode}", case))
                parts = [(child.first, index), (index + 1, child.end)]
                waiting += [(a, b) for a, b in parts if a < b and not stop.value]
    return figures


def _look_after(child: _Child, figures: Figures) -> str | None:
    """None while the child works, "" if it has delivered its figures, else "hang" or "crash"."""
    now = time.monotonic()
    if child.reader.poll():
        try:
            figures.add(child.reader.recv())
        except EOFError:
            child.process.join()
            return "crash"
        child.process.join()
        return ""
    if child.place.value != child.seen:
        child.seen, child.since = child.place.value, now
    elif now - child.since > STUCK_SECONDS:
        child.process.kill()
        child.process.join()
        return "hang"
    return None


def save_findings(seeds: Sequence[Seed], run: int, figures: Figures, folder: Path) -> None:
    """Write the input of each finding as run-input-kind.pd4."""
    for row in figures.findings:
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{run}-{row['input']}-{row['kind']}.pd4"
        path.write_bytes(make_case(seeds, run, row["input"]).data)
        row["file"] = str(path)


# -- coverage ----------------------------------------------------------------------------------------------------------


def reach(seeds: Sequence[Seed], run: int, inputs: int) -> dict[str, Any]:
    """What the inputs reach of the functions they enter: per package the lines and branches, in per cent, and per
    function the lines that no input reached. Functions never entered are the encoder's.
    """
    import coverage

    sources = [str(ROOT / "pd4dgs_codec" / name) for name in PACKAGES]
    measured = coverage.Coverage(branch=True, data_file=None, source=sources, messages=False)
    measured.start()
    run_inputs(seeds, run, 0, inputs)
    measured.stop()
    with tempfile.NamedTemporaryFile(suffix=".json") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # modules were imported before: only functions count here
        measured.json_report(outfile=file.name)
        files = json.loads(Path(file.name).read_text())["files"]
    shares, missed = {}, {}
    for package in PACKAGES:
        total = reached = 0
        for path, row in files.items():
            if f"pd4dgs_codec/{package}/" not in path:
                continue
            for name, function in row["functions"].items():
                counts = function["summary"]
                if name and counts["covered_lines"]:
                    total += counts["num_statements"] + counts["num_branches"]
                    reached += counts["covered_lines"] + counts["covered_branches"]
                    if counts["missing_lines"]:
                        missed[f"{package}/{Path(path).name} {name}"] = function["missing_lines"]
        shares[package] = 100 * reached / max(total, 1)
    return {"inputs": inputs, "reached": shares, "missed": missed}


# -- atheris -----------------------------------------------------------------------------------------------------------

_LAST = re.compile(r"#(\d+)\s+\w+\s+cov: (\d+) ft: (\d+) corp: (\d+)/")


def guided(seconds: int, run: int, folder: Path, paths: Sequence[Path]) -> dict[str, Any]:
    """A coverage-guided run of libFuzzer through atheris, in a process of its own; what it printed last."""
    corpus = folder / "corpus"
    corpus.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, str(Path(__file__).with_name("fuzz_atheris.py")), str(corpus)]
    command += [f"-max_total_time={seconds}", f"-seed={run + 1}", f"-artifact_prefix={folder}/atheris-"]
    command += ["-timeout=4", "-rss_limit_mb=4096", "-max_len=8192", "-print_final_stats=1"]
    for seed in all_seeds(paths):
        (corpus / f"{Path(seed.name).stem}.pd4").write_bytes(seed.data)
    done = subprocess.run(command, capture_output=True, text=True)
    lines = [match for match in map(_LAST.search, done.stderr.splitlines()) if match]
    if not lines:
        raise SystemExit(f"atheris did not run:\n{done.stderr[-2000:]}")
    inputs, edges, features, kept = (int(n) for n in lines[-1].groups())
    found = sorted(str(p) for p in folder.glob("atheris-*"))
    (folder / "atheris.log").write_text(done.stderr)
    return {"inputs": inputs, "edges": edges, "features": features, "corpus": kept, "findings": found}


# -- cost --------------------------------------------------------------------------------------------------------------


def dearest(seconds: float, run: int, folder: Path) -> dict[str, Any]:
    """The legal files that cost most processor time and most memory, found in half of `seconds` each and written to
    `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    result: dict[str, Any] = {}
    for what in ("seconds", "memory"):
        found = search(run, seconds / 2, what == "memory", report=lambda line: print(line, file=sys.stderr))
        for i, one in enumerate(found):
            (folder / f"dear-{what}-{i}.pd4").write_bytes(one.data)
        result[what] = [one.row() for one in found]
    return result


# -- the command -------------------------------------------------------------------------------------------------------


def all_seeds(paths: Sequence[Path]) -> list[Seed]:
    """The built seeds, and those of the given files and folders and of spec/vectors where it exists."""
    vectors = sorted(folder for folder in VECTORS.glob("*") if folder.is_dir() and folder.name != "dear")  # too slow
    return [*built_seeds(), *given_seeds([*paths, *vectors])]


def parser() -> argparse.ArgumentParser:
    """The options."""
    assert __doc__
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("files", nargs="*", type=Path, help="more seed files, .pd4 or folders of them")
    p.add_argument("--inputs", type=int, default=20_000, help="how many (default: 20000)")
    p.add_argument("--seed", type=int, default=0, help="number of the run (default: 0)")
    p.add_argument("--seconds", type=float, default=float("inf"), help="stop after this wall time")
    p.add_argument("--reference", type=int, default=50, metavar="K", help="compare every Kth input with spec/refdec.py")
    p.add_argument("--jobs", type=int, default=1, help="processes at once (default: 1)")
    p.add_argument("--out", type=Path, default=ROOT / "out" / "fuzz", help="folder for findings (default: out/fuzz)")
    p.add_argument("--json", type=Path, metavar="FILE", help="write the figures")
    p.add_argument("--input", type=int, metavar="I", help="examine input I alone, in this process")
    p.add_argument("--atheris", type=int, metavar="S", help="a coverage-guided run of S seconds instead")
    p.add_argument("--damage", type=int, metavar="N", help="N changes of the given files, checksums left as they are")
    p.add_argument("--cost", type=float, metavar="S", help="search S seconds for the legal files that cost most")
    p.add_argument("--coverage", type=int, metavar="N", help="measure what N inputs reach instead")
    return p


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = parser().parse_args(argv)
    if args.atheris is not None:
        result = guided(args.atheris, args.seed, args.out, args.files)
        found = result["findings"]
        text = "\n".join(["| figure | value |", "|---|---|", *(f"| {k} | {v} |" for k, v in result.items())])
    elif args.damage is not None:
        data = [seed.data for seed in given_seeds(args.files)]
        if not data:
            raise SystemExit("fuzz.py: --damage needs .pd4 files, found none")
        outcomes, found = damage(data, args.seed, args.damage)
        result = {"files": len(data), "outcomes": outcomes, "findings": found}
        rows = [f"| ends in {name} | {count:,} |" for name, count in outcomes.most_common()]
        text = "\n".join(["| figure | value |", "|---|---|", *rows, f"| findings | {len(found)} |", *found[:20]])
    elif args.cost is not None:
        result, found = dearest(args.cost, args.seed, args.out), []
        columns = ("share", "bytes", "seconds", "memory")
        rows = [f"| {what} | {' | '.join(str(row[c]) for c in columns)} |" for what in result for row in result[what]]
        text = "\n".join(
            ["| dearest in | share of the bound | bytes | seconds | memory |", "|---|---|---|---|---|", *rows]
        )
    elif args.coverage is not None:
        result, found = reach(all_seeds(args.files), args.seed, args.coverage), []
        rows = [f"| {k} | {v:.1f} % |" for k, v in result["reached"].items()]
        missed = [f"{function}: lines {lines}" for function, lines in result["missed"].items()]
        text = "\n".join(["| package | reached |", "|---|---|", *rows, "", *missed])
    else:
        seeds = all_seeds(args.files)
        if args.input is not None:
            print(make_case(seeds, args.seed, args.input).recipe)
            figures = run_inputs(seeds, args.seed, args.input, args.input + 1, reference=1)
        else:
            figures = run_many(seeds, args.seed, args.inputs, args.seconds, args.jobs, args.reference)
        save_findings(seeds, args.seed, figures, args.out)
        result, found, text = figures.json(), figures.findings, figures.markdown()
        text += "".join(f"\n{row['input']} {row['kind']}: {row['message']} ({row['recipe']})" for row in found[:20])
    print(text)
    if args.json:
        args.json.write_text(json.dumps(result, indent=1) + "\n")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
