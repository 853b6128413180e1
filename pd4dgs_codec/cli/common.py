"""Runs commands: inputs, outputs, messages on stdout and stderr, progress, one-line errors and exit codes.

At import only the standard library is loaded, so that `--help` and usage errors answer at once, and so that the number
of threads is set before torch and numba are loaded.
"""

from __future__ import annotations

import argparse
import atexit
import contextlib
import errno
import gc
import io
import os
import sys
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, TextIO

from pd4dgs_codec.errors import (
    DamageWarning,
    DataError,
    DecodeError,
    DeliveryError,
    EncodeError,
    Pd4Error,
    one_line,
    printable,
)
from pd4dgs_codec.signals import ignore_more, interruptible
from pd4dgs_codec.threads import configure

if TYPE_CHECKING:
    from pd4dgs_codec.data.view import Dataset, View
    from pd4dgs_codec.scene import LayeredScene, Scene, SceneInfo, Viewpoint
    from pd4dgs_codec.train.loop import Trainer

#: A last garbage collection at exit took a quarter of the time of a cold start's first picture.
atexit.register(gc.freeze)

OK, FAILED, USAGE, PARTIAL = 0, 1, 2, 3
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)  #: errors of a full disk
STDIO = "-"
#: Times of a scene and a dataset that differ by less than this share of the duration are the same.
SAME_TIME = 1e-3
#: Least time between two lines if stderr is not a terminal.
LINE_SECONDS = 10.0
EXTRAS = {"ray": "cluster", "submitit": "cluster"}  #: extra of each module that the extra `train` does not install


class UsageError(Exception):
    """The command line itself is wrong: exit 2."""


# -- messages ----------------------------------------------------------------------------------------------------------


class Console:
    """Prints data to stdout and details to stderr; with --json, stdout gets one JSON object and nothing else."""

    def __init__(self, args: argparse.Namespace):
        self.json, self.verbose = args.json, args.verbose

    def detail(self, text: str) -> None:
        """Prints a line with -v only."""
        if self.verbose:
            say(text)

    def result(self, data: dict[str, Any], text: str, *, on_stdout: bool = False) -> None:
        """Prints `data` as JSON on stdout with --json, otherwise `text` on stderr, or on stdout with `on_stdout`."""
        if self.json:
            import json

            from pd4dgs_codec.io import finite

            show(json.dumps(finite(data)))
        elif on_stdout:
            show(text)
        else:
            say(text)


def show(text: str) -> None:
    """Prints `text` on stdout. Raises an OSError that names stdout."""
    with _naming_stdout():
        print(printable(text), flush=True)


@contextlib.contextmanager
def _naming_stdout() -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), "stdout") from None


def say(text: str) -> None:
    """Prints a line on stderr. If stderr is full or closed, the line is lost and the work goes on."""
    try:
        print(printable(text), file=sys.stderr, flush=True)
    except OSError:
        _point_at_nothing(sys.stderr)


def tell(prog: str, text: str) -> int:
    """Prints `text` on stdout as a program's whole output; returns the exit code."""
    try:
        show(text)
    except OSError as error:
        if not isinstance(error, BrokenPipeError):
            say(f"{prog}: error: stdout: {error.strerror}")
        _point_at_nothing(sys.stdout)
        return FAILED
    return OK


def table(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Formats rows as right-aligned columns under their heads; the first column is left-aligned."""
    cells = [list(head), *([str(cell) for cell in row] for row in rows)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(head))]
    lines = []
    for first, *others in cells:
        columns = [first.ljust(widths[0]), *(cell.rjust(w) for cell, w in zip(others, widths[1:], strict=True))]
        lines.append("  ".join(columns).rstrip())
    return "\n".join(lines)


def number(value: float | None, digits: int = 2) -> str:
    """Formats a number for a table, with thousands separators; "-" for None."""
    return "-" if value is None else f"{value:,.{digits}f}"


def color(fill: Sequence[int] | None) -> str:
    """Formats a fill as #rrggbb, and behind it the spread if it has one; "-" for None."""
    from pd4dgs_codec.scene import SPREAD_UNITS

    spread = f" x{1 + fill[3] / SPREAD_UNITS:.3g}" if fill and len(fill) > 3 else ""
    return "-" if fill is None else f"#{bytes(fill[:3]).hex()}{spread}"


def shown_name(path: str, stream: str = "stdin") -> str:
    """Returns the name of a file for messages; `stream` for `-`."""
    return stream if path == STDIO else path


# -- progress ----------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def progress_bar(total: int | None, unit: str, label: str) -> Iterator[Callable[[], None]]:
    """Yields a function to call after each item. Shows a bar on a terminal, otherwise a line every LINE_SECONDS."""
    if sys.stderr.isatty():
        from tqdm import tqdm

        with tqdm(total=total, unit=unit, desc=label, leave=False, file=sys.stderr) as bar:
            yield bar.update  # by 1
        return
    done, told = 0, time.monotonic()

    def count_one() -> None:
        nonlocal done, told
        done += 1
        if time.monotonic() - told > LINE_SECONDS:
            told = time.monotonic()
            say(f"{label}: {done} of {total} {unit}" if total else f"{label}: {unit.removesuffix('s')} {done}")

    yield count_one


class TrainingProgress:
    """Shows a bar on a terminal, otherwise a line after each evaluation."""

    def __init__(self) -> None:
        self.stream = sys.stderr
        self.bar: Any = None

    def update(self, trainer: Trainer, record: dict[str, Any]) -> None:
        psnr = "/".join(f"{value:.2f}" for value in trainer.curve[-1]["psnr"]) if trainer.curve else ""
        if self.stream.isatty():
            if self.bar is None:
                from tqdm import tqdm

                total, unit = (trainer.config.max_seconds, "s") if trainer.timed else (trainer.total, "step")
                initial = int(trainer.seconds) if trainer.timed else trainer.iteration - 1
                self.bar = tqdm(total=total, initial=initial, unit=unit, file=self.stream, leave=False)
            self.bar.set_postfix_str(f"{record['anchors']} anchors {psnr} dB" if psnr else "", refresh=False)
            self.bar.update((int(trainer.seconds) if trainer.timed else trainer.iteration) - self.bar.n)
        elif "held_out_psnr" in record:
            steps = f"step {trainer.iteration}" if trainer.timed else f"step {trainer.iteration}/{trainer.total}"
            limit = f" of {trainer.config.max_seconds:g}" if trainer.timed else ""
            say(f"{steps}, {trainer.seconds:.0f}{limit} s: {psnr} dB, {record['anchors']} anchors")

    def on_trial(self, done: int, steps: int) -> None:
        if self.bar is not None:
            self.bar.set_postfix_str(f"trial of motion or levels: step {done + 1}/{steps}")

    def close(self) -> None:
        if self.bar is not None:
            self.bar.close()


# -- inputs and outputs ------------------------------------------------------------------------------------------------


def read_bytes(path: str) -> bytes:
    """Reads a file, or stdin for `-`. Raises DataError that names the path, UsageError if stdin is a terminal."""
    if path != STDIO:
        from pd4dgs_codec.io import read_source

        return read_source(path)
    if sys.stdin is None or sys.stdin.isatty():
        raise UsageError("stdin is a terminal, expected a file name or piped input")
    return sys.stdin.buffer.read()


def read_prefix(
    path: str, console: Console, max_layer: int | None = None, max_bytes: int | None = None, allow_partial: bool = False
) -> tuple[bytes, int]:
    """Reads (bytes, length of the file). From a URL it fetches only the header and the slices of layers up to max_layer
    within max_bytes; with allow_partial, as many of these bytes as arrive."""
    from pd4dgs_codec.web import is_url

    if not is_url(path):
        data = read_bytes(path)
        return data, len(data)
    from pd4dgs_codec.web.client import Transfer, fetch

    with contextlib.closing(Transfer(path)) as transfer:
        try:
            data = fetch(transfer, max_layer, max_bytes)
        except DeliveryError as error:
            if not (allow_partial and transfer.data):
                raise
            say(f"pd4dgs-decode: {error}")
            data = bytes(transfer.data)
    size = f"fetched {len(transfer.data):,} bytes"
    console.detail(f"{size} in {transfer.requests} requests, {transfer.cuts} interruptions")
    return data, len(data) if transfer.total is None else transfer.total


def same_file(path: str, other: str) -> bool:
    """Whether both name one file, through links too; `-` names none. A missing file is the same under every path."""
    return STDIO not in (path, other) and os.path.realpath(path) == os.path.realpath(other)


def check_other_file(path: str, output: str) -> None:
    """Raises UsageError if the output of -o is the input `path`, which would be lost."""
    if same_file(path, output):
        raise UsageError(f"-o names the input {path}, expected another file")


def named_input(path: str) -> str | bytes:
    """Returns the path, or all bytes of stdin for `-`, for readers that take either."""
    return read_bytes(path) if path == STDIO else path


def is_pd4(data: bytes) -> bool:
    """Whether the first four bytes are those of a `.pd4` file; the rest may be damaged."""
    from pd4dgs_codec.format.container import SIGNATURE

    return data.startswith(SIGNATURE[:4])


def checkpoint_scene(path: str, data: bytes) -> tuple[Scene, list[Viewpoint], str]:
    """The scene of a checkpoint of bytes `data`, read from `path`; its training cameras and times; and where its 0 lies
    in the coordinates of its data, "" if it is their 0. Needs torch."""
    from pd4dgs_codec.model import checkpoint
    from pd4dgs_codec.model.model import to_scene

    model, training = checkpoint.loads(data, shown_name(path))
    return to_scene(model), training.get("viewpoints", []), str(training.get("place", ""))


def write_checkpoint(path: str, scene: LayeredScene, overwrite: bool) -> None:
    """Writes a scene as a checkpoint, whole or not at all."""
    from pd4dgs_codec.model import checkpoint
    from pd4dgs_codec.model.model import from_scene

    model = from_scene(scene)
    check_output(path, overwrite)  # it may have appeared meanwhile
    checkpoint.save(path, model)


def read_dataset(source: str, args: argparse.Namespace, info: SceneInfo) -> Dataset:
    """Reads the dataset `source` with the options of `add_reading`, over the background of the scene to compare, and of
    segments its part of their time; says what was assumed or left out. Raises DataError."""
    from dataclasses import replace
    from pathlib import Path

    from pd4dgs_codec.interchange.teacher import load_source
    from pd4dgs_codec.segments import is_folder, read_index

    place = next((p for p in (Path(args.input), Path(args.input).parent) if is_folder(p)), None)
    reading = place and read_index(place)[1].made.get("reading")  # of its training
    fps: Any = reading.get("fps") if isinstance(reading, dict) else None
    fps = fps if type(fps) in (int, float) and 0.01 <= fps <= 1000 else None  # as --fps of the training
    dataset = load_source(source, downscale=args.downscale, holdout=args.holdout, background=info.background, fps=fps)
    for remark in dataset.origin.notes:
        say(f"note: {remark}")
    (low, high), (start, stop) = dataset.time_range, info.time_range
    whole, part = high - low, stop - start
    if not place or start < low - SAME_TIME * whole or stop > high + SAME_TIME * whole:
        if abs(whole - part) > SAME_TIME * whole:
            say(f"note: {source} lasts {whole:.4g} s, {args.input} {part:.4g} s: compared at the same shares of both")
        return dataset
    if part > (1 - SAME_TIME) * whole:
        return dataset

    def within(views: Iterable[View]) -> tuple[View, ...]:
        times = ((view, (low + view.time * whole - start) / part) for view in views)
        return tuple(replace(v, time=min(max(t, 0.0), 1.0)) for v, t in times if -SAME_TIME <= t <= 1 + SAME_TIME)

    train, test = within(dataset.train), within(dataset.test)
    if not train:
        raise DataError(f"{source}: has no views from {start:.4g} to {stop:.4g} s, the time of {args.input}")
    say(f"note: {args.input} shows {start:.4g} to {stop:.4g} of {low:.4g} to {high:.4g} s: compared with these views")
    return replace(dataset, train=train, test=test, time_range=info.time_range)


def check_output(path: str, overwrite: bool) -> None:
    """Calls `io.check_output`, before any work, for outputs other than `-`."""
    if path != STDIO:
        from pd4dgs_codec.io import check_output  # loaded only if something is written

        check_output(path, overwrite)


def write_bytes(path: str, data: bytes, overwrite: bool) -> None:
    """Writes all of `data`, to stdout for `-`, otherwise to a file, whole or not at all."""
    if path != STDIO:
        from pd4dgs_codec.io import write_bytes

        write_bytes(path, data, overwrite)
        return
    with _naming_stdout():
        sys.stdout.buffer.write(data)
        sys.stdout.buffer.flush()


# -- running -----------------------------------------------------------------------------------------------------------

Action = Callable[[argparse.Namespace, Console], int]


def run(parser: argparse.ArgumentParser, action: Action, argv: Sequence[str] | None) -> int:
    """Parses the arguments and runs `action`; every failure becomes one line on stderr and an exit code.

    A signal in ENDING ends the command as a failure; if the command runs another one, it ends both.
    """
    open_streams()
    arguments = list(sys.argv[1:] if argv is None else argv)
    with interruptible() as outermost, _told_warnings(parser.prog):
        try:
            return _run(parser, action, arguments)
        except KeyboardInterrupt as error:
            if not outermost:
                raise
            ignore_more()
            if writing := sys.modules.get("pd4dgs_codec.io"):
                writing.remove_temporaries()
            return _fail(parser.prog, error, "interrupted; unfinished outputs were removed", "--json" in arguments)


@contextlib.contextmanager
def _told_warnings(prog: str) -> Iterator[None]:
    """Prints a DamageWarning as a message, and escapes the text of all other warnings."""
    before = warnings.showwarning

    def tell_of(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
        if issubclass(category, DamageWarning):
            say(f"{prog}: warning: {one_line(str(message))}")
        else:
            before(one_line(str(message)), category, *where, **more)

    warnings.showwarning = tell_of
    try:
        yield
    finally:
        warnings.showwarning = before


def _run(parser: argparse.ArgumentParser, action: Action, arguments: list[str]) -> int:
    as_json, verbose = "--json" in arguments, not {"-v", "--verbose"}.isdisjoint(arguments)
    name = ""
    try:
        args = parser.parse_args(arguments)
        name = getattr(args, "input", "")
        if empty := [what for what in ("input", "source", "output") if getattr(args, what, None) == ""]:
            raise UsageError(f"found an empty name of the {empty[0]}, expected a file or folder")
        configure(getattr(args, "threads", None))  # before numpy, torch and numba are imported
        code = action(args, Console(args))
        with _naming_stdout():
            sys.stdout.flush()
        return code
    except UsageError as error:
        return _fail(parser.prog, error, f"{error}; see {parser.prog} --help", as_json, USAGE)
    except BrokenPipeError:  # the reader closed the pipe, as `| head` does
        _point_at_nothing(sys.stdout)
        return FAILED
    except Exception as error:
        message = _explain(error, shown_name(name))
        if message is None:
            if verbose:
                import traceback

                say(traceback.format_exc().rstrip())
            message = f"internal error, please report it: {type(error).__name__}: {error} (-v prints the traceback)"
        return _fail(parser.prog, error, message, as_json)


def command(parser: Callable[[], argparse.ArgumentParser], action: Action) -> Callable[..., int]:
    """Makes the entry point of a program: takes arguments (None: of the process) and returns the exit code."""

    def main(argv: Sequence[str] | None = None) -> int:
        return run(parser(), action, argv)

    return main


def _explain(error: BaseException, name: str) -> str | None:
    """Returns one line for an error that the user can act on, None for a fault of this program."""
    if isinstance(error, (DecodeError, EncodeError)):  # the codec sees bytes and arrays, not the name of their file
        return f"{name}: {error}"
    if isinstance(error, Pd4Error):
        return str(error)
    if isinstance(error, OSError):
        # a library's cache or temporary file has no name
        where = error.filename or ("a cache or a temporary file" if error.errno in FULL else "")
        return f"{where}: {error.strerror or error}".lstrip(": ")
    if isinstance(error, ModuleNotFoundError) and error.name and not error.name.startswith("pd4dgs_codec"):
        extra = EXTRAS.get(error.name.partition(".")[0], "train")
        return f"the module {error.name} is not installed: pip install 'pd4dgs-codec[{extra}]'"
    if isinstance(error, MemoryError):
        return "out of memory"
    return None


def _fail(prog: str, error: BaseException, message: str, as_json: bool, code: int = FAILED) -> int:
    line = one_line(message)
    say(f"{prog}: error: {line}")
    if as_json:
        import json

        content: dict[str, Any] = {"type": type(error).__name__, "message": line}
        if isinstance(error, DecodeError) and error.offset is not None:
            content["offset"] = error.offset
        with contextlib.suppress(OSError):
            print(json.dumps({"error": content}), flush=True)
    try:
        sys.stdout.flush()
    except OSError:
        _point_at_nothing(sys.stdout)
    return code


def open_streams() -> None:
    """Opens the descriptors 0 to 2 that the caller closed, so that no file of ours gets their numbers.

    A closed stdin reads as empty, writing to a closed stdout is an error like writing to a full one, and output to a
    closed stderr is lost.
    """
    for descriptor, flags in ((0, os.O_RDONLY), (1, os.O_RDONLY), (2, os.O_WRONLY)):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, flags)  # takes the lowest free number, which is this one
    if sys.stdout is None:
        sys.stdout = open(1, "w", encoding="utf-8", closefd=False)  # noqa: SIM115 - it lives as long as the process
    if sys.stderr is None:
        sys.stderr = open(2, "w", encoding="utf-8", closefd=False)  # noqa: SIM115 - likewise
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal may lack the letters of a title
            stream.reconfigure(errors="backslashreplace")


def _point_at_nothing(stream: TextIO) -> None:
    """Redirects a stream to /dev/null, so that the interpreter's flush at exit cannot fail again."""
    with contextlib.suppress(OSError, ValueError):
        nothing = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nothing, stream.fileno())
        os.close(nothing)
