"""Reads manifests, and takes one line from its source to its finished output, the function that all engines run.

A manifest has a JSON object per line, `{"source": ..., "output": ..., "options": {...}}`. One operation, a command of
the package, runs on each source. Invalid lines are reported, and the others run.
"""

import json
import os
import posixpath
import re
import resource
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import chain, count
from pathlib import Path, PurePosixPath
from typing import Any

from pd4dgs_codec import __version__
from pd4dgs_codec.batch import store
from pd4dgs_codec.data.dataset import SYNTHETIC, dataset_folders
from pd4dgs_codec.errors import DataError, Pd4Error, one_line
from pd4dgs_codec.io import URI, remove_temporaries, temporary_folder
from pd4dgs_codec.signals import ignore_more, interruptible

LOG_BYTES = 1 << 16  #: limit of a command's log, whose end is kept
DONE, ALREADY, FAILED = "done", "already", "failed"
#: Runs a command: (verb, argv) -> (exit code, its stdout, its stderr).
Command = Callable[[str, list[str]], tuple[int, str, str]]
Check = Callable[[str, dict[str, Any]], None]  #: of a source with its options

# -- manifests ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Op:
    """A command for one source.

    suffix: of the output; "" for a folder. finds: suffixes of its sources, none for dataset folders. stdout: the output
    is the JSON object that the command prints. inputs: options that name further sources.
    """

    suffix: str
    finds: tuple[str, ...] = ()
    stdout: bool = False
    inputs: tuple[str, ...] = ()


OPS = {
    "prepare": Op("", (".mp4", ".mov", ".mkv", ".webm", ".avi")),
    "train": Op(".pt", inputs=("whole",)),
    "encode": Op(".pd4", (".pt",), inputs=("data",)),
    "eval": Op(".json", (".pd4",), stdout=True, inputs=("data",)),
    "package": Op("", (".pd4",)),
}
#: Options that the batch sets for every command, or that make no sense for one scene of many.
RESERVED = {"output", "overwrite", "threads", "json", "help", "version", "verbose", "resume", "log"}
KEYS = ("source", "output", "options", "needs")


@dataclass(frozen=True)
class Line:
    """A valid line. number: from 1 on. output: a path below the root of the batch. needs: options that name the output
    of another line, which needs nothing and is made first."""

    number: int
    source: str
    output: str
    options: dict[str, Any] = field(default_factory=dict)
    needs: dict[str, str] = field(default_factory=dict)

    def at(self, root: str) -> "Line":
        """The line of a batch below `root`, with what it needs among its options."""
        return replace(self, options=self.options | {name: posixpath.join(root, o) for name, o in self.needs.items()})


def read_manifest(place: str, op: Op, check: Check) -> tuple[list[Line], list[tuple[int, str]]]:
    """Returns the valid lines of a manifest, and the faults of the others as (number, message). Raises OSError or
    DataError if it cannot be read or is empty. check: raises DataError for a source and options that the command does
    not take."""
    lines, faults, first = list[Line](), list[tuple[int, str]](), dict[str, int]()
    with store.opened(place) as stream:
        for number, raw in enumerate(stream, 1):
            if not raw.strip():
                continue
            try:
                line = _line(number, raw, op, check)
                if first.setdefault(line.output, number) != number:
                    raise DataError(f"found output {line.output!r} of line {first[line.output]}, expected another")
                lines.append(line)
            except DataError as error:
                faults.append((number, str(error)))
            except Exception as error:  # an error that no check foresaw fails this line only
                faults.append((number, one_line(f"{type(error).__name__}: {error}")))
    if not (lines or faults):
        raise DataError(f"{place}: is empty, expected one JSON object per scene")
    made = {line.output for line in lines if not line.needs}
    for line in lines:
        if lost := [output for output in line.needs.values() if output not in made]:
            fault = f"found needs of {lost[0]!r}, expected the output of a valid line that needs nothing"
            faults.append((line.number, fault))
    return [line for line in lines if made.issuperset(line.needs.values())], sorted(faults)


def _line(number: int, raw: bytes, op: Op, check: Check) -> Line:
    try:
        content = json.loads(raw.decode("utf-8-sig").rstrip())
    except json.JSONDecodeError as error:
        raise DataError(f"invalid JSON: {error.msg} at character {error.pos + 1}") from None
    except (ValueError, RecursionError) as error:
        raise DataError(f"invalid JSON: {error}") from None
    if not isinstance(content, dict) or not set(content) <= set(KEYS):
        found = ", ".join(map(str, content)) if isinstance(content, dict) else type(content).__name__
        raise DataError(f"found {found}, expected an object with {', '.join(KEYS)}")
    source, options, needs = content.get("source"), content.get("options", {}), content.get("needs", {})
    if not isinstance(source, str) or not source:
        raise DataError(f"found source {source!r}, expected a path or a URI")
    if not isinstance(options, dict):
        raise DataError(f"found options {options!r}, expected an object")
    if not isinstance(needs, dict) or not all(name in op.inputs and isinstance(needs[name], str) for name in needs):
        raise DataError(
            f"found needs {needs!r}, expected outputs of other lines for {' and '.join(op.inputs) or 'none'}"
        )
    output = content.get("output", default_output(source, op))
    plain = isinstance(output, str) and output.isprintable() and "\\" not in output
    if not plain or {"", ".", ".."} & set(output.split("/")) or output.endswith(store.RECORD):
        raise DataError(f"found output {output!r}, expected a path relative to -o without the suffix {store.RECORD}")
    source = _absolute(source)
    check(source, options | needs)
    inputs = {name: _absolute(options[name]) for name in op.inputs if name in options}
    return Line(number, source, output, options | inputs, needs)


def _absolute(place: Any) -> str:
    if not isinstance(place, str) or not place:
        raise DataError(f"found {place!r}, expected a path or a URI")
    return place if place.startswith(SYNTHETIC) else store.absolute(place)


def default_output(source: str, op: Op) -> str:
    """The last part of the source with the operation's suffix: kitchen.pt -> kitchen.pd4, synthetic:fast?seed=1 ->
    fast.pt."""
    name = source.removeprefix(SYNTHETIC)
    if name != source or URI.match(source):
        name = name.partition("?")[0]
    name = posixpath.basename(name.rstrip("/"))
    return (posixpath.splitext(name)[0] or name) + op.suffix


def arguments(verb: str, source: str, output: str, options: dict[str, Any]) -> list[str]:
    """The command line of an operation on a source. Raises DataError for options that no command line can express."""
    options = dict(options)
    if verb == "eval":
        if not isinstance(options.get("data"), str):
            raise DataError("found no option data, expected the dataset for eval")
        argv = [source, options.pop("data")]
    else:
        argv = [source, "--output", output]
    for name, value in options.items():
        if name in RESERVED or not name.replace("-", "").isalnum() or name.startswith("-"):
            raise DataError(f"found option {name!r}, expected one that a manifest can set")
        for item in value if isinstance(value, list) else [value]:
            if not isinstance(item, (str, int, float)):
                raise DataError(
                    f"found {item!r} for option {name}, expected a string, a number, true or a list of these"
                )
            if item is not False:
                argv.append(f"--{name}" if item is True else f"--{name}={item}")
    return argv


def scan(folder: str, verb: str | None) -> Iterator[dict[str, str]]:
    """Yields the lines of a manifest for the sources in a folder, a path or a URI.

    verb: one of OPS, None to choose it by the sources found. Raises DataError for a folder without sources, or with
    sources of several kinds.
    """
    names = store.names(folder)

    def sources(op: Op) -> list[str]:
        if not op.finds:
            return dataset_folders(names)
        return sorted(name for name in names if PurePosixPath(name).suffix.lower() in op.finds)

    found = {name: sources(op) for name, op in OPS.items()}
    kinds = [verb] if verb else [name for name in ("prepare", "train", "encode", "package") if found[name]]
    if len(kinds) > 1:
        raise DataError(f"{folder}: found sources for {' and '.join(kinds)}, expected --op with one of them")
    if not kinds or not found[kinds[0]]:
        wanted = OPS[verb].finds if verb else [suffix for op in OPS.values() for suffix in op.finds]
        raise DataError(f"{folder}: found no sources, expected {', '.join(dict.fromkeys(wanted)) or 'dataset folders'}")
    op, taken = OPS[kinds[0]], set[str]()
    for name in found[kinds[0]]:
        usual = default_output(name, op)
        whole = posixpath.basename(name) + op.suffix  # kitchen.mov beside kitchen.mp4
        for short in chain((usual, whole), (f"{n}-{usual}" for n in count(2))):
            output = re.sub(r"\\|\.done(?=\.json$)", "_", posixpath.join(posixpath.dirname(name), short))
            output = "".join(c if c.isprintable() else "_" for c in output)
            if output not in taken:
                break
        taken.add(output)
        yield {"source": posixpath.join(folder, name), "output": output}


# -- jobs --------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Job:
    """A line with the settings of the batch. version: of the package that started the batch."""

    line: Line
    verb: str
    root: str
    threads: int
    overwrite: bool = False
    version: str = __version__


@dataclass(frozen=True)
class Outcome:
    """The result of a job.

    state: "done" now, "already" before, or "failed". final: a retry would fail too. log: the command's stderr. cpu: CPU
    seconds in all, work: of the command alone. peak: largest memory of the worker so far, bytes.
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
    """Runs a job unless its output is finished. Failures and signals become outcomes, except that a signal to the
    process that runs the batch ends it."""
    cpu = time.process_time()
    with interruptible() as outermost:
        try:
            outcome = _done_once(job, command)
        except KeyboardInterrupt:
            if not outermost:
                raise
            ignore_more()
            remove_temporaries()
            outcome = Outcome(FAILED, "interrupted")
        except CommandFailed as error:
            outcome = error.outcome
        except Pd4Error as error:
            outcome = Outcome(FAILED, str(error), final=True)
        except OSError as error:
            message = f"{error.filename}: {error.strerror}" if error.filename else str(error)
            outcome = Outcome(FAILED, message, final=isinstance(error, store.FINAL))
        except Exception as error:  # a fault in the package or a library must not end the batch
            outcome = Outcome(FAILED, f"{type(error).__name__}: {error}")
    peak = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return replace(outcome, message=one_line(outcome.message), cpu=time.process_time() - cpu, peak=peak)


def _done_once(job: Job, command: Command) -> Outcome:
    if job.version != __version__:
        raise DataError(f"found pd4dgs-codec {__version__} on the worker, expected {job.version}")
    line, root = job.line, store.Root(job.root)
    record = root.record(line.output, job.overwrite)
    inputs = {"": line.source} | {name: line.options[name] for name in OPS[job.verb].inputs if name in line.options}
    options = {name: value for name, value in line.options.items() if name not in inputs}
    stamps = dict(inputs)
    for name, place in inputs.items():
        if not place.startswith(SYNTHETIC):
            stamps[name] = store.stamp(place, dataset=bool(name) or not OPS[job.verb].finds)
    made_of = {"op": job.verb, "options": options, "inputs": stamps, "version": __version__}
    same = record is not None and made_of.items() <= record.items()
    if record and same and root.holds(line.output, record):
        return Outcome(ALREADY)
    if record and not same and not job.overwrite:
        found = "was made with other inputs or options"
        if record.get("version") != __version__:
            found = f"was made by pd4dgs-codec {record.get('version')}, expected {__version__}"
        raise DataError(f"{found}; --overwrite replaces it")
    with _temporary_folder() as folder:
        files, report, work = _run(job, command, {name: _fetched(p, folder) for name, p in inputs.items()}, folder)
        whole = made_of | {"source": line.source, "report": report}
        return Outcome(DONE, bytes=root.publish(line.output, files, whole, job.overwrite or same), work=work)


def _fetched(place: str, folder: Path) -> str:
    """Fetches a source and returns the command's argument. The path of a copy is relative to the folder, so that no
    temporary name gets into outputs; one that begins with a dash would be an option, or stdin."""
    if place.startswith(SYNTHETIC):
        return place
    path = store.fetch(place, folder)
    if not path.is_relative_to(folder):
        return str(path)
    return ("./" if path.name.startswith("-") else "") + path.name


def _run(
    job: Job, command: Command, sources: dict[str, str], folder: Path
) -> tuple[dict[str, Path], dict[str, Any], float]:
    """Runs the command and returns (output files by name, numbers that it reported, CPU seconds)."""
    op, output = OPS[job.verb], Path("output") / ("result" + OPS[job.verb].suffix)
    if job.verb == "train" and job.line.output.endswith(".pd4"):  # a part of a folder of segments
        output = output.with_suffix(".pd4")
    output.parent.mkdir()
    options = job.line.options | {name: text for name, text in sources.items() if name}
    argv = [*arguments(job.verb, sources[""], str(output), options), "--json", f"--threads={job.threads}"]
    cpu = time.process_time()
    code, printed, log = command(job.verb, argv)
    work, log = time.process_time() - cpu, log[-LOG_BYTES:]
    if code != 0:
        told = (line for line in reversed(log.splitlines()) if line.strip())
        message = next(told, f"pd4dgs-{job.verb} exited with code {code}")
        raise CommandFailed(message, final=code == 2, log=log, work=work)
    report = json.loads(printed)
    if report.get("interrupted"):
        raise CommandFailed("interrupted before it finished", log=log, work=work)
    if op.stdout:
        output.write_text(json.dumps(report, indent=1) + "\n")
    if output.is_dir():
        files = [path for path in sorted(output.rglob("*")) if path.is_file()]
        return {path.relative_to(output).as_posix(): folder / path for path in files}, {}, work
    numbers = {name: value for name, value in report.items() if isinstance(value, (bool, int, float))}
    return {"": folder / output}, {} if op.stdout else numbers, work


@contextmanager
def _temporary_folder() -> Iterator[Path]:
    """Makes a temporary folder the working folder within the block."""
    before = os.getcwd()
    with temporary_folder() as folder:
        os.chdir(folder)
        try:
            yield folder
        finally:
            os.chdir(before)
