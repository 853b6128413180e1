"""What the commands share: options, exit codes, one-line errors, and what goes to stdout or stderr.

Of libraries only the standard one is imported here, so that `--help` and usage errors answer at once, and so that the
number of threads is settled before torch and numba are loaded.
"""

from __future__ import annotations

import argparse
import atexit
import contextlib
import gc
import os
import sys
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NoReturn, TextIO

from pd4dgs_codec.cli.values import count, positive_int
from pd4dgs_codec.errors import DecodeError, EncodeError, Pd4Error
from pd4dgs_codec.threads import configure

#: To look for garbage once more at the end of the process took a quarter of a cold picture's time.
atexit.register(gc.freeze)

OK, FAILED, USAGE, PARTIAL = 0, 1, 2, 3

EXIT_CODES = (
    "exit codes: 0 done, 1 bad data or I/O, 2 wrong usage, 3 cut input decoded as far as possible (--allow-partial)"
)
SOURCES = """\
SOURCE is one of
  a folder in the iPhone/Nerfies layout (camera/, rgb/, splits/; its split files decide what is held out)
  a folder with transforms*.json (Blender, D-NeRF, nerfstudio)
  a folder with poses_bounds.npy and a video per camera, cam*.mp4 (Neu3D; the first camera is held out)
  a folder with a model of COLMAP in sparse/0 and its pictures in images/; times.txt may say when they were taken
  a folder with such a model and a synchronised video per picture in videos/ (the first camera is held out)
  a folder of Panoptic Studio (train_meta.json, ims/) or an unpacked recording of Record3D (metadata, rgbd/)
  synthetic:static   nothing moves
  synthetic:global   large objects move slowly
  synthetic:local    the same, and small parts move on their own
  synthetic:fast     quick motion
  (synthetic:NAME?seed=n gives another scene of that kind; &size=WxH and &frames=N,
  default 160x120 and 60, larger pictures and more of them)
  teacher:PATH       pictures of explicit Gaussians: a folder of .ply or .spz files, one per frame, one such file, a
                     .4dgs file, a checkpoint of gsplat, or module:function (time -> Gaussians)
  (teacher:PATH?cameras=SOURCE takes the cameras, times and held-out pictures of another source;
  else ?views=N&size=WxH&fps=F&background=white&up=X,Y,Z)"""


class UsageError(Exception):
    """The command line itself is wrong: exit 2."""


class Parser(argparse.ArgumentParser):
    """argparse with one-line usage errors, no abbreviated options, and the common options."""

    def __init__(self, verb: str, usage: str, summary: str, details: str):
        super().__init__(
            prog=f"pd4dgs-{verb}",
            usage=" ".join(part for part in (f"pd4dgs-{verb}", usage, "[options]") if part),
            description=summary,
            epilog=f"{details}\n\n{EXIT_CODES}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
            add_help=False,
        )

    def error(self, message: str) -> NoReturn:
        raise UsageError(message)

    def print_help(self, file: object = None) -> NoReturn:
        """Prints the help on stdout and ends the program: with 0, or with 1 if stdout does not take it."""
        self.exit(tell(self.prog, self.format_help().rstrip("\n")))

    def add_common(self, *, json_file: bool = False) -> None:
        """The options that every command has. json_file: --json may name a file; args.json is then its name, or "-"."""
        group = self.add_argument_group("common options")
        group.add_argument("-h", "--help", action="help", help="show this help and exit")
        group.add_argument("--version", action=_Version, nargs=0, help="show the version and exit")
        if json_file:
            what = "write one JSON object to FILE; without FILE, to stdout and nothing else there"
            group.add_argument("--json", nargs="?", const="-", metavar="FILE", help=what)
        else:
            what = "print one JSON object on stdout and nothing else there"
            group.add_argument("--json", action="store_true", help=what)
        group.add_argument("-v", "--verbose", action="store_true", help="say more on stderr")
        group.add_argument("-j", "--threads", type=positive_int, metavar="N", help="CPU threads (default: all cores)")
        group.add_argument("-f", "--overwrite", action="store_true", help="replace an output that exists")


def add_reading(options: argparse._ActionsContainer, *, defaults: bool = True) -> None:
    """How a dataset is read: --downscale and --holdout. defaults: False for None where an option is not given."""
    add, (downscale, holdout) = options.add_argument, (1, 8) if defaults else (None, None)
    what = "use images 1/K as wide and high (default: 1)"
    add("--downscale", type=positive_int, default=downscale, metavar="K", help=what)
    what = "without split files, hold out frames with i %% K == K/2 (default: 8; 0: none)"
    add("--holdout", type=count, default=holdout, metavar="K", help=what)


class _Version(argparse.Action):
    """Prints the release and the format version; a plain "version" action would import the codec for every --help."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> NoReturn:
        parser.exit(tell(parser.prog, version_line(parser.prog)))


def version_line(prog: str) -> str:
    """The program's release and the version of the format it writes."""
    from pd4dgs_codec import FORMAT_VERSION, __version__

    return f"{prog} {__version__}, format {FORMAT_VERSION}"


# -- talking to the caller ---------------------------------------------------------------------------------------------


class Console:
    """Data to stdout, messages to stderr; with --json stdout holds one JSON object and nothing else."""

    def __init__(self, args: argparse.Namespace):
        self.json, self.verbose = args.json, args.verbose

    def message(self, text: str) -> None:
        """A line for the person at the terminal."""
        say(text)

    def detail(self, text: str) -> None:
        """A line shown with -v only."""
        if self.verbose:
            self.message(text)

    def result(self, data: dict[str, Any], text: str, *, on_stdout: bool) -> None:
        """The outcome: `data` with --json, else `text`, on stdout where it is what was asked for, else on stderr."""
        if self.json:
            import json

            from pd4dgs_codec.io import finite

            print(json.dumps(finite(data)), flush=True)
        elif on_stdout:
            print(text, flush=True)
        else:
            self.message(text)


def say(text: str) -> None:
    """A line on stderr. One that is full or gone takes nothing more, and the work goes on without its words."""
    try:
        print(text, file=sys.stderr, flush=True)
    except OSError:
        _point_at_nothing(sys.stderr)


def tell(prog: str, text: str) -> int:
    """Prints all there is to say on stdout; returns the exit code."""
    try:
        print(text, flush=True)
    except OSError as error:
        if not isinstance(error, BrokenPipeError):
            say(f"{prog}: error: stdout: {error.strerror}")
        _point_at_nothing(sys.stdout)
        return FAILED
    return OK


def table(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Rows as right-aligned columns under their heads; the first column is left-aligned."""
    cells = [list(head), *([str(cell) for cell in row] for row in rows)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(head))]
    return "\n".join(
        "  ".join(
            cell.rjust(w) if i else cell.ljust(w) for i, (cell, w) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in cells
    )


def number(value: float | None, digits: int = 2) -> str:
    """A number for a table, thousands separated; "-" for none."""
    return "-" if value is None else f"{value:,.{digits}f}"


# -- running -----------------------------------------------------------------------------------------------------------

Action = Callable[[argparse.Namespace, Console], int]


def run(parser: Parser, action: Action, argv: Sequence[str] | None) -> int:
    """Parses, acts, and turns every failure into one line on stderr and an exit code."""
    open_streams()
    arguments = list(sys.argv[1:] if argv is None else argv)
    as_json, verbose = "--json" in arguments, not {"-v", "--verbose"}.isdisjoint(arguments)
    name = ""
    try:
        args = parser.parse_args(arguments)
        name = getattr(args, "input", "")
        configure(getattr(args, "threads", None))  # before numpy, torch and numba are imported
        code = action(args, Console(args))
        sys.stdout.flush()
        return code
    except UsageError as error:
        return _fail(parser, error, f"{error}; see {parser.prog} --help", as_json, USAGE)
    except BrokenPipeError:  # the reader went away, as `| head` does
        _point_at_nothing(sys.stdout)
        return FAILED
    except (Exception, KeyboardInterrupt) as error:
        message = _explain(error, "stdin" if name == "-" else name)
        if message is None:
            if verbose:
                raise
            message = f"internal error, please report it: {type(error).__name__}: {error} (-v shows where)"
        return _fail(parser, error, message, as_json)


def command(parser: Callable[[], Parser], action: Action) -> Callable[..., int]:
    """The entry point of a program: takes its arguments, or those of the process, and returns the exit code."""

    def main(argv: Sequence[str] | None = None) -> int:
        return run(parser(), action, argv)

    return main


def _explain(error: BaseException, name: str) -> str | None:
    """One line for an error that the caller can do something about; None for a fault of this program."""
    if isinstance(error, (DecodeError, EncodeError)):  # the codec sees bytes and arrays, not the name of their file
        return f"{name}: {error}"
    if isinstance(error, Pd4Error):
        return str(error)
    if isinstance(error, OSError):
        where = error.filename or ("stdout" if error.errno else "")  # only writes to a stream carry no name
        return f"{where}: {error.strerror or error}".lstrip(": ")
    if isinstance(error, ModuleNotFoundError) and error.name and not error.name.startswith("pd4dgs_codec"):
        return f"needs the module {error.name}, which is not installed: pip install 'pd4dgs-codec[train]'"
    if isinstance(error, MemoryError):
        return "out of memory"
    if isinstance(error, KeyboardInterrupt):
        return "interrupted; nothing was written"
    return None


def _fail(parser: Parser, error: BaseException, message: str, as_json: bool, code: int = FAILED) -> int:
    line = " ".join(message.split())
    say(f"{parser.prog}: error: {line}")
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
    """Opens what the caller closed of descriptors 0 to 2, so that no file of ours takes their numbers.

    A closed stdin is empty, writing to a closed stdout is an error as it is of a full one, and a closed stderr takes
    every word and keeps none.
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


def _point_at_nothing(stream: TextIO) -> None:
    """So that the interpreter's own flush at exit cannot fail a second time."""
    with contextlib.suppress(OSError, ValueError):
        nothing = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nothing, stream.fileno())
        os.close(nothing)
