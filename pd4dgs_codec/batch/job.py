"""The one function that every engine runs: a scene of a batch from its source to its finished output."""

from __future__ import annotations

import hashlib
import json
import os
import resource
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pd4dgs_codec import __version__
from pd4dgs_codec.batch import store
from pd4dgs_codec.batch.manifest import SPECIFICATIONS, Line
from pd4dgs_codec.batch.ops import OPS, Command, arguments
from pd4dgs_codec.errors import DataError, Pd4Error, one_line

LOG_BYTES = 1 << 16  #: kept of a command's log
DONE, ALREADY, FAILED = "done", "already", "failed"


@dataclass(frozen=True)
class Job:
    """A line with what holds for the whole batch. version: of the package that began the batch."""

    line: Line
    verb: str
    root: str
    threads: int
    overwrite: bool = False
    version: str = __version__


@dataclass(frozen=True)
class Outcome:
    """What became of a job.

    state: "done" now, "already" before, or "failed". final: trying again would end the same. log: the command's stderr.
    result: what it reported. cpu: seconds of CPU time in all, work: those of the command alone. peak: of the worker's
    memory so far, bytes.
    """

    state: str
    message: str = ""
    final: bool = False
    log: str = ""
    bytes: int = 0
    seconds: float = 0.0
    cpu: float = 0.0
    work: float = 0.0
    peak: int = 0


class CommandFailed(Exception):
    """The command's exit code was not 0."""

    def __init__(self, code: int, message: str, log: str, work: float):
        super().__init__(message)
        self.code, self.log, self.work = code, log, work


def run_job(job: Job, command: Command) -> Outcome:
    """Does a job unless its output is finished. It raises nothing: whatever goes wrong is the outcome."""
    begun, cpu = time.monotonic(), time.process_time()

    def outcome(state: str, message: str = "", **more: Any) -> Outcome:
        peak = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        spent = time.process_time() - cpu
        return Outcome(state, one_line(message), seconds=time.monotonic() - begun, cpu=spent, peak=peak, **more)

    try:
        state, size, work = _done_once(job, command)
        return outcome(state, bytes=size, work=work)
    except CommandFailed as error:
        usage = error.code == 2
        return outcome(FAILED, str(error), final=usage, log=error.log, work=error.work)
    except Pd4Error as error:
        return outcome(FAILED, str(error), final=True)
    except OSError as error:
        message = f"{error.filename}: {error.strerror}" if error.filename else str(error)
        return outcome(FAILED, message, final=isinstance(error, store.FINAL))
    except Exception as error:  # a fault of ours or of a library must not end the batch
        return outcome(FAILED, f"{type(error).__name__}: {error}")


def _done_once(job: Job, command: Command) -> tuple[str, int, float]:
    """(state, bytes of the output, CPU seconds of the command)."""
    if job.version != __version__:
        raise DataError(f"the worker has pd4dgs-codec {__version__}, the batch began with {job.version}")
    line, root = job.line, store.Root(job.root)
    record = root.record(line.output, job.overwrite)
    stamps = _stamps(job)
    if record and _is_of(record, job, stamps) and root.holds(line.output, record["files"]):
        return ALREADY, 0, 0.0
    if record and record.get("version") != __version__ and not job.overwrite:
        found = f"was made by pd4dgs-codec {record.get('version')}, this is {__version__}"
        raise DataError(f"{found}; --overwrite makes it anew")
    with tempfile.TemporaryDirectory(prefix="pd4dgs-batch-") as name, _inside(Path(name)) as folder:
        sources = {key: _fetched(place, folder) for key, place in _places(job).items()}
        digests = {key: found for key, (_, found) in sources.items()}
        plain = {name: value for name, value in line.options.items() if name not in OPS[job.verb].inputs}
        key = key_of(job.verb, digests, plain, __version__)
        if record and record.get("key") == key and root.holds(line.output, record["files"]):
            return ALREADY, 0, 0.0
        if record and record.get("key") != key and not job.overwrite:
            raise DataError("holds what other input or options gave; --overwrite makes it anew")
        files, report, work = _run(job, command, {key: text for key, (text, _) in sources.items()}, folder)
        about = {"key": key, "op": job.verb, "source": line.source, "options": line.options, "inputs": digests}
        about |= {"stamps": stamps, "version": __version__, "report": report}
        replace = job.overwrite or (record is not None and record.get("key") == key)
        whole = root.publish(line.output, files, about, replace)
    return DONE, sum(entry["bytes"] for entry in whole["files"].values()), work


def key_of(verb: str, digests: dict[str, str], options: dict[str, Any], version: str) -> str:
    """The address of an output: SHA-256 over what it depends on. digests: of the source ("") and of options that name
    sources. options: the others."""
    text = json.dumps([verb, digests, options, version], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def _places(job: Job) -> dict[str, str]:
    """Where the inputs are: "" for the source, else by the option that names it."""
    named = {name: job.line.options[name] for name in OPS[job.verb].inputs if name in job.line.options}
    return {"": job.line.source, **named}


def _stamps(job: Job) -> dict[str, str | None]:
    return {
        key: place if place.startswith(SPECIFICATIONS) else store.stamp(place) for key, place in _places(job).items()
    }


def _is_of(record: dict[str, Any], job: Job, stamps: dict[str, str | None]) -> bool:
    """Whether a record is of this very job, as far as can be told without reading the sources."""
    same = record.get("op") == job.verb and record.get("version") == __version__
    same = same and record.get("source") == job.line.source and record.get("options") == job.line.options
    return same and None not in stamps.values() and record.get("stamps") == stamps


def _fetched(place: str, folder: Path) -> tuple[str, str]:
    """(what to tell the command, digest) of a source. A copy is named relative to the folder, which leaves no trace."""
    if place.startswith(SPECIFICATIONS):
        return place, hashlib.sha256(place.encode()).hexdigest()
    path = store.fetch(place, folder)
    return str(path.relative_to(folder) if path.is_relative_to(folder) else path), store.digest(path)


def _run(
    job: Job, command: Command, sources: dict[str, str], folder: Path
) -> tuple[dict[str, Path], dict[str, Any], float]:
    """Runs the command: (its output's files by name, what it reported, CPU seconds)."""
    op = OPS[job.verb]
    output = Path("output") / ("result" + op.suffix)
    output.parent.mkdir()
    options = job.line.options | {name: text for name, text in sources.items() if name}
    argv = [*arguments(job.verb, sources[""], str(output), options), "--json", f"--threads={job.threads}"]
    cpu = time.process_time()
    code, printed, log = command(job.verb, argv)
    work, log = time.process_time() - cpu, log[-LOG_BYTES:]
    if code != 0:
        said = [line for line in log.splitlines() if line.strip()]
        raise CommandFailed(code, said[-1] if said else f"pd4dgs-{job.verb} ended with {code}", log, work)
    report = json.loads(printed)
    if report.get("interrupted"):
        raise CommandFailed(1, "was interrupted before its end", log, work)
    if op.stdout:
        output.write_text(json.dumps(report, indent=1) + "\n")
    if output.is_dir():
        files = [path for path in sorted(output.rglob("*")) if path.is_file()]
        return {path.relative_to(output).as_posix(): folder / path for path in files}, {}, work
    scalars = {name: value for name, value in report.items() if isinstance(value, (bool, int, float))}
    return {"": folder / output}, {} if op.stdout else scalars, work


@contextmanager
def _inside(folder: Path) -> Iterator[Path]:
    before = os.getcwd()
    os.chdir(folder)
    try:
        yield folder
    finally:
        os.chdir(before)
