"""`pd4dgs-batch`: one command over a library of scenes."""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from pd4dgs_codec.batch.job import OPS, Job, Line, Outcome, arguments, read_manifest, scan
from pd4dgs_codec.cli import common, options
from pd4dgs_codec.cli.common import FAILED, OK, STDIO, Console, UsageError, progress_bar, say
from pd4dgs_codec.errors import DataError, printable
from pd4dgs_codec.threads import available

ENGINES = ("local", "ray", "slurm")
PARAMETER = options.checked(lambda text: text.split("=", 1), lambda pair: len(pair) == 2 and pair[0] != "", "KEY=VALUE")

DETAILS = """\
MANIFEST has one JSON object per line:
  {"source": "s3://films/kitchen.pt", "output": "kitchen.pd4", "options": {"effort": 3}}
source is the input, a path or a URI (s3, gs, https, ...). output is a path relative to -o (default: named after the
source). options are the command's options without dashes: true for a flag, a list for several values. For eval, the
option data names the dataset. "needs": {"base": "base-0000.pd4"} gives as an option the output of another line, which
needs nothing and is made first. `pd4dgs-batch scan FOLDER` writes a manifest of the sources in a folder, and
`pd4dgs-train --segments --manifest` one of the parts of a long capture.

OUTPUT.done.json beside each output records its inputs, options, version and checksums. Scenes with a matching record
are skipped, so the same command resumes an interrupted batch. A scene that still fails after its retries is reported
with its log, and the batch continues. The exit code is 1 if any scene failed.

--on local runs processes that share -j threads, --on ray uses the cluster at --address (or RAY_ADDRESS), and --on slurm
submits array jobs. Ray and Slurm need the extra [cluster]. See docs/batch.md.

examples:
  pd4dgs-batch scan models -o scenes.jsonl
  pd4dgs-batch scenes.jsonl --op encode -o out
  pd4dgs-batch scenes.jsonl --op encode --on ray --address 10.0.0.1:6379 -o s3://films/pd4"""

SCAN_DETAILS = """\
Writes one line per source below FOLDER: videos for prepare, datasets for train, checkpoints for encode, .pd4 files for
package and eval. Outputs keep the relative paths of their sources.

examples:
  pd4dgs-batch scan models -o scenes.jsonl
  pd4dgs-batch scan s3://films/pd4 --op eval -o eval.jsonl"""


def parser() -> options.Parser:
    p = options.Parser("batch", "MANIFEST --op OP -o URI", "Run a command on many scenes.", DETAILS)
    p.add("input MANIFEST", "file of JSON lines, see below")
    p.add("-o, --output URI", "output folder or URI", options.named, required=True)
    p.add("--op", "command to run on each scene (pd4dgs-OP)", required=True, choices=OPS)
    p.add("--on", "where to run the command (default: local)", choices=ENGINES, default="local")
    what = "scenes at a time (default: one per core; ray: as many as fit; 0: one after another in this process)"
    p.add("--workers N", what, options.count)
    p.add("--cpus N", "threads per scene (default: 1; local: an equal share of -j)", options.positive_int)
    p.add("--gpus N", "GPUs per scene (default: 0)", options.non_negative_float)
    p.add("--retries N", "retries of a failed scene (default: %(default)s)", options.count, default=2)
    p.add("--timeout T", "time limit of each try, such as 90s (default: none)", options.duration)
    p.add("--logs DIR", "folder for the logs of failed scenes (default: %(default)s)", default="batch-logs")
    p.add("--address A", "address of the Ray cluster (default: RAY_ADDRESS, else a new local cluster)")
    what = "parameter of submitit, such as slurm_partition=gpu; cluster=local runs on this machine"
    p.add("--slurm KEY=VALUE", what, PARAMETER, action="append")
    return p.add_common()


def scan_parser() -> options.Parser:
    p = options.Parser("batch scan", "FOLDER", "Write a manifest of the sources in a folder.", SCAN_DETAILS)
    p.add("input FOLDER", "folder or URI of the sources")
    p.add("--op", "command of the manifest (default: chosen by the sources found)", choices=OPS)
    p.add("-o, --output FILE", "manifest to write (default: stdout)", default=STDIO)
    return p.add_common()


def main(argv: Sequence[str] | None = None) -> int:
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments[:1] == ["scan"]:
        return common.run(scan_parser(), _scan, arguments[1:])
    return common.run(parser(), _batch, arguments)


def command(verb: str, argv: list[str]) -> tuple[int, str, str]:
    """Runs `pd4dgs-VERB` in this process: (exit code, stdout, stderr)."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = import_module(f"pd4dgs_codec.cli.{verb}").main(argv)
    return code, out.getvalue(), err.getvalue()


def _scan(args: argparse.Namespace, console: Console) -> int:
    if args.json and args.output == STDIO:
        raise UsageError("the manifest and --json both write to stdout, expected -o FILE")
    common.check_output(args.output, args.overwrite)
    lines = [json.dumps(line) + "\n" for line in scan(args.input, args.op)]
    common.write_bytes(args.output, "".join(lines).encode(), args.overwrite)
    console.result({"output": args.output, "scenes": len(lines)}, f"{len(lines)} scene{'s' * (len(lines) != 1)}")
    return OK


def _batch(args: argparse.Namespace, console: Console) -> int:
    options.conditional(args, args.on != "local", "needs --on ray or slurm", gpus=0)
    options.conditional(args, args.on != "local" or args.workers != 0, "has no effect with --workers 0", timeout=None)
    options.conditional(args, args.on == "ray", "needs --on ray", address=None)
    options.conditional(args, args.on == "slurm", "needs --on slurm", slurm=[])
    cores = args.threads or available()
    workers = args.workers if args.workers is not None else cores if args.on == "local" else 0
    threads = args.cpus or (max(1, cores // max(1, workers)) if args.on == "local" else 1)
    from pd4dgs_codec.batch import store
    from pd4dgs_codec.batch.run import Settings, run

    module = import_module(f"pd4dgs_codec.cli.{args.op}")
    takes, check_usage = module.parser(), getattr(module, "check_usage", lambda args: None)

    def check(source: str, options: dict[str, Any]) -> None:
        try:
            check_usage(takes.parse_args(arguments(args.op, source, "output", options)))
        except UsageError as error:
            raise DataError(str(error)) from None

    lines, faults = read_manifest(args.input, OPS[args.op], check)
    output = store.absolute(args.output)
    if lines:  # the check makes the output folder
        store.Root(output).check()
    failures = [_failed(args.input, number, None, message) for number, message in faults]
    settings = Settings(
        workers, threads, args.gpus, args.timeout or None, args.address, Path(args.logs), dict(args.slurm)
    )
    with progress_bar(len(lines), "scenes", args.op) as step:

        def told(job: Job, outcome: Outcome, tries: int) -> None:
            if outcome.state == "failed":
                log, again = _written_log(args.logs, job, outcome), f", tried {tries} times" if tries > 1 else ""
                failures.append(_failed(args.input, job.line.number, job.line.output, outcome.message + again, log))
            step()

        summary = dict[str, Any]()
        for needy in (False, True):
            stage, failed = list[Line](), {row["output"] for row in failures}
            for line in (line for line in lines if bool(line.needs) == needy):
                if lost := failed.intersection(line.needs.values()):  # an earlier batch may have left such an output
                    failures.append(_failed(args.input, line.number, line.output, f"needs {min(lost)}, which failed"))
                    step()
                else:
                    stage.append(line.at(output))
            jobs = (Job(line, args.op, output, threads, args.overwrite) for line in stage)
            if stage or not needy:
                for name, n in run(jobs, command, args.on, settings, args.retries, told).items():
                    had = summary.get(name, 0)
                    summary[name] = max(had, n) if name == "peak_memory" else round(had + n, 3)
    found = {"failed": len(failures), "failures": failures}
    result = {"output": args.output, "op": args.op, "on": args.on, **summary, **found}
    console.result(result, _text(result))
    return FAILED if failures else OK


def _failed(place: str, number: int, output: str | None, message: str, log: str | None = None) -> dict[str, Any]:
    """Reports a line that failed. Returns its row of the result."""
    named = f" {output}:" if output else ""
    say(f"pd4dgs-batch: {place}, line {number}:{named} {message}" + (f" (log: {log})" if log else ""))
    return {"line": number, "output": output, "message": message, "log": log}


def _written_log(folder: str, job: Job, outcome: Outcome) -> str | None:
    """Writes the log of a failed job and returns its path; None if it has none, or it cannot be written."""
    if not outcome.log:
        return None
    path = Path(folder) / f"{job.line.output}.log"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(printable(outcome.log), encoding="utf-8")
    except (OSError, ValueError):  # which must not end the batch
        return None
    return str(path)


def _text(result: dict[str, Any]) -> str:
    parts = [f"{result['done']} done", f"{result['already']} already done", f"{result['failed']} failed"]
    return f"{result['output']}: {', '.join(parts)}; {result['bytes']:,} bytes in {result['seconds']:.0f} s"
