"""The one function that every engine runs: one scene from its source to its finished output."""

from __future__ import annotations

import json
import os
import resource
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pd4dgs_codec import __version__
from pd4dgs_codec.batch import store
from pd4dgs_codec.batch.manifest import OPS, Line, arguments
from pd4dgs_codec.data.dataset import SYNTHETIC
from pd4dgs_codec.errors import DataError, Pd4Error, one_line
from pd4dgs_codec.io import remove_temporaries, temporary_folder
from pd4dgs_codec.signals import ignore_more, interruptible

LOG_BYTES = 1 << 16  #: kept of a command's log
DONE, ALREADY, FAILED = "done", "already", "failed"
#: Runs a command: (verb, argv) -> (exit code, its stdout, its stderr).
Command = Callable[[str, list[str]], tuple[int, str, str]]


@dataclass(frozen=True)
class Job:
    """A line with the settings of the batch. version: of the package that began the batch."""

    line: Line
    verb: str
    root: str
    threads: int
    overwrite: bool = False
    version: str = __version__


@dataclass(frozen=True)
class Outcome:
    """The result of a job.

    state: "done" now, "already" before, or "failed". final: another try would end the same. log: the command's stderr.
    cpu: CPU seconds in all, work: of the command alone. peak: memory of the worker so far, bytes.
    """

    state: str
    message: str = ""
    final: bool = False
    log: str = ""
    bytes: int = 0
    cpu: float = 0.0
    work: float = 0.0
    peak: int = 0


class CommandFailed(Exception):
    """The command failed. outcome: of the job."""

    def __init__(self, message: str, **fields: Any):
        super().__init__(message)
        self.outcome = Outcome(FAILED, message, **fields)


def run_job(job: Job, command: Command) -> Outcome:
    """Does a job unless its output is finished. Every failure is an outcome, and so is a signal, but in the process
    that runs the batch, which a signal ends."""
    cpu = time.process_time()
    with interruptible() as outermost:
        try:
            outcome = _outcome(job, command)
        except KeyboardInterrupt:
            if not outermost:
                raise
            ignore_more()
            remove_temporaries()
            outcome = Outcome(FAILED, "was interrupted")
    peak = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return replace(outcome, message=one_line(outcome.message), cpu=time.process_time() - cpu, peak=peak)


def _outcome(job: Job, command: Command) -> Outcome:
    try:
        return _done_once(job, command)
    except CommandFailed as error:
        return error.outcome
    except Pd4Error as error:
        return Outcome(FAILED, str(error), final=True)
    except OSError as error:
        message = f"{error.filename}: {error.strerror}" if error.filename else str(error)
        return Outcome(FAILED, message, final=isinstance(error, store.FINAL))
    except Exception as error:  # a fault in the package or a library must not end the batch
        return Outcome(FAILED, f"{type(error).__name__}: {error}")


def _done_once(job: Job, command: Command) -> Outcome:
    if job.version != __version__:
        raise DataError(f"the worker has pd4dgs-codec {__version__}, the batch began with {job.version}")
    line, root = job.line, store.Root(job.root)
    record = root.record(line.output, job.overwrite)
    inputs = {"": line.source} | {name: line.options[name] for name in OPS[job.verb].inputs if name in line.options}
    options = {name: value for name, value in line.options.items() if name not in inputs}
    stamps = {name: place if place.startswith(SYNTHETIC) else store.stamp(place) for name, place in inputs.items()}
    made_of = {"op": job.verb, "options": options, "inputs": stamps, "version": __version__}
    same = record is not None and made_of.items() <= record.items()
    if record and same and root.holds(line.output, record):
        return Outcome(ALREADY)
    if record and not same and not job.overwrite:
        found = "holds what other input or options gave"
        if record.get("version") != __version__:
            found = f"was made by pd4dgs-codec {record.get('version')}, this is {__version__}"
        raise DataError(f"{found}; --overwrite makes it anew")
    with _temporary_folder() as folder:
        files, report, work = _run(job, command, {name: _fetched(p, folder) for name, p in inputs.items()}, folder)
        whole = made_of | {"source": line.source, "report": report}
        return Outcome(DONE, bytes=root.publish(line.output, files, whole, job.overwrite or same), work=work)


def _fetched(place: str, folder: Path) -> str:
    """The argument for the command. The path of a copy is relative to the folder, so that no temporary name gets into
    outputs."""
    if place.startswith(SYNTHETIC):
        return place
    path = store.fetch(place, folder)
    return str(path.relative_to(folder) if path.is_relative_to(folder) else path)


def _run(
    job: Job, command: Command, sources: dict[str, str], folder: Path
) -> tuple[dict[str, Path], dict[str, Any], float]:
    """Runs the command: (its output's files by name, the numbers that it reported, CPU seconds)."""
    op, output = OPS[job.verb], Path("output") / ("result" + OPS[job.verb].suffix)
    output.parent.mkdir()
    options = job.line.options | {name: text for name, text in sources.items() if name}
    argv = [*arguments(job.verb, sources[""], str(output), options), "--json", f"--threads={job.threads}"]
    cpu = time.process_time()
    code, printed, log = command(job.verb, argv)
    work, log = time.process_time() - cpu, log[-LOG_BYTES:]
    if code != 0:
        message = ([line for line in log.splitlines() if line.strip()] or [f"pd4dgs-{job.verb} ended with {code}"])[-1]
        raise CommandFailed(message, final=code == 2, log=log, work=work)
    report = json.loads(printed)
    if report.get("interrupted"):
        raise CommandFailed("was interrupted before its end", log=log, work=work)
    if op.stdout:
        output.write_text(json.dumps(report, indent=1) + "\n")
    if output.is_dir():
        files = [path for path in sorted(output.rglob("*")) if path.is_file()]
        return {path.relative_to(output).as_posix(): folder / path for path in files}, {}, work
    numbers = {name: value for name, value in report.items() if isinstance(value, (bool, int, float))}
    return {"": folder / output}, {} if op.stdout else numbers, work


@contextmanager
def _temporary_folder() -> Iterator[Path]:
    """A new folder, the working folder meanwhile."""
    before = os.getcwd()
    with temporary_folder() as folder:
        os.chdir(folder)
        try:
            yield folder
        finally:
            os.chdir(before)
