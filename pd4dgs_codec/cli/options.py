"""Options of the commands: the shared parser, and types that turn text into values.

A type returns the value, or raises an error of one line with the text found and the expected form.
"""

from __future__ import annotations

import argparse
import contextlib
import math
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, NoReturn, TypeVar

from pd4dgs_codec.cli.common import UsageError, tell
from pd4dgs_codec.data.dataset import FOLDERS, color

T = TypeVar("T")
Add = Callable[..., None]  #: `Parser.add`, of the parser or of a group

EXIT_CODES = "exit codes: 0 success, 1 invalid data or I/O error, 2 usage error"
#: Defaults of the options of `add_reading`.
READING = {"downscale": 1, "holdout": 8}
#: The list of sources in the details of a command.
SOURCES = "\n  ".join(["SOURCE is one of", *FOLDERS])
SOURCES += """
  synthetic:static   nothing moves
  synthetic:global   large objects move slowly
  synthetic:local    large objects move slowly, and small parts of them on their own
  synthetic:fast     fast motion
  synthetic:dancer (a figure dances with a lantern), synthetic:flyby (a ball flies past a cube), synthetic:dart (a small
  ball flies fast), synthetic:rods (thin rods move): as in D-NeRF, on white, with a camera that jumps between frames and
  without initial points
  synthetic:random   3 to 8 bodies, a background and a camera path, all drawn from the seed
  synthetic:NAME?seed=S&size=WxH&frames=N&path=P varies a scene by random seed, image size and number of frames
  (default: 160x120 and 60; on white 100x100 and 150, the dancer 200x200, random 100) and by camera path: pass (once
  along an arc), sweeps (back and forth), orbit (a full turn), jump (a random pose in each frame) or still (6 cameras);
  seconds=T makes static, global, local and fast last so long
  teacher:PATH       renderings of explicit Gaussians: a file, folder or run that pd4dgs-import packs, or
                     module:function (a Python function from time to Gaussians)
  teacher:PATH?cameras=SOURCE takes cameras, times and held-out views from another source; otherwise
  ?views=N&size=WxH&fps=F&background=white&up=X,Y,Z sets them"""


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
        """Prints the help on stdout and exits: 0, or 1 if stdout cannot be written."""
        self.exit(tell(self.prog, self.format_help().rstrip("\n")))

    def add(self, form: str, about: str, kind: Any = None, *, to: Any = None, **more: Any) -> None:
        """Adds an option, or an argument, to the parser or to a group of it.

        form: its names and what stands for its value, as in the help: "-o, --output FILE". about: the help. kind: the
        type of the value. more: for `add_argument`. An option without value, choices or action is a flag.
        """
        words = form.split()
        names = [word.rstrip(",") for word in words if word[0] == "-"] or words[:1]
        more |= {"metavar": words[-1]} if len(words) > len(names) else {}
        if names[0][0] == "-" and not {"metavar", "choices", "action"} & more.keys():
            more["action"] = "store_true"
        (to or self).add_argument(*names, help=about, **more, **({"type": kind} if kind else {}))

    def group(self, title: str, about: str | None = None) -> Add:
        """Returns `add` for a new group of options."""
        return partial(self.add, to=self.add_argument_group(title, about))

    def exclusive(self) -> Add:
        """Returns `add` for options of which one can be given."""
        return partial(self.add, to=self.add_mutually_exclusive_group())

    def add_common(self, *, json_file: bool = False) -> Parser:
        """Adds the options of every command, and returns the parser. json_file: --json may name a file; args.json is
        then its name or "-"."""
        add = self.group("common options")
        add("-h, --help", "show this help and exit", action="help")
        add("--version", "show the version and exit", action=_Version, nargs=0)
        if json_file:
            what = "write the result as one JSON object to this file (default: to stdout, in place of the text)"
            add("--json FILE.json", what, ending(".json", "-"), nargs="?", const="-")
        else:
            add("--json", "print the result as one JSON object on stdout")
        add("-v, --verbose", "print more messages")
        add("-j, --threads N", "CPU threads (default: all cores)", positive_int)
        add("-f, --overwrite", "overwrite existing outputs")
        return self


def add_reading(add: Add, *, unset: Iterable[str] = ()) -> None:
    """Adds --downscale and --holdout for reading a dataset. unset: names that are None unless given."""
    default = READING | dict.fromkeys(unset)
    what = f"downscale images by K (default: {READING['downscale']})"
    add("--downscale K", what, positive_int, default=default["downscale"])
    what = f"without split files, hold out frames with i %% K == K/2 (default: {READING['holdout']}; 0: none)"
    add("--holdout K", what, count, default=default["holdout"])


def conditional(args: argparse.Namespace, condition: object, otherwise: str, **defaults: Any) -> None:
    """Sets the defaults (by name) of options that are used under a condition only and were not given. Raises UsageError
    with the text `otherwise` for one that was given although the condition is false."""
    for name, default in defaults.items():
        value = getattr(args, name)
        if value is None or value is False:
            setattr(args, name, default)
        elif not condition:
            raise UsageError(f"--{name.replace('_', '-')} {otherwise}")


def given(args: argparse.Namespace, *names: str) -> dict[str, Any]:
    """Returns the options among `names` that were given."""
    return {name: value for name in names if (value := getattr(args, name)) is not None}


def add_metadata(p: Parser, about: str) -> None:
    """Adds --title, --source and --licence. about: what becomes of them."""
    add = p.group("metadata", about)
    add("--title TEXT", "title of the scene", line)
    add("--source TEXT", "origin of the scene", line)
    add("--licence TEXT", "terms of use", line)


def add_background(add: Add, default: str) -> None:
    """Adds --background. default: the default in words."""
    what = f"colour behind the scene and images with alpha: black, white or R,G,B in 0..1 (default: {default})"
    add("--background COLOR", what, background)


def add_file(add: Add, metavar: str, what: str) -> None:
    """Adds the input, and --sample in its place; see `choose_file`."""
    add(f"input {metavar}", what, nargs="?")
    add("--sample", f"the scene that comes with the package, in place of {metavar}")


def choose_file(args: argparse.Namespace, metavar: str) -> None:
    """Makes the sample the input with --sample. Raises UsageError unless one of them is given."""
    if args.input is None and not args.sample:
        raise UsageError(f"found no {metavar}, expected one, or --sample")
    if args.sample:
        if args.input is not None:
            raise UsageError(f"found {metavar} and --sample, expected one of them")
        from pd4dgs_codec import sample

        args.input = str(sample())


def add_level(add: Add, verb: str) -> None:
    """Adds --level, also known as --max-layer."""
    add("--level", f"highest level to {verb} (default: the highest of the file)", int, choices=(0, 1, 2))
    add("--max-layer", argparse.SUPPRESS, int, dest="level", choices=(0, 1, 2))


def add_prefix(add: Add, verb: str) -> None:
    """Adds --level and --max-bytes, which limit what the command decodes, renders, ...: the `verb`."""
    add_level(add, verb)
    add("--max-bytes SIZE", f"{verb} only the slices within the first SIZE bytes, such as 50k", size)


class _Version(argparse.Action):
    """Prints the release and the format version. A plain "version" action would import the codec for every --help."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> NoReturn:
        parser.exit(tell(parser.prog, version_line(parser.prog)))


def version_line(prog: str) -> str:
    """Returns the program's release and the version of the format that it writes."""
    from pd4dgs_codec import FORMAT_VERSION, __version__

    return f"{prog} {__version__}, format {FORMAT_VERSION}"


# -- types -------------------------------------------------------------------------------------------------------------


def checked(kind: Callable[[str], T], accept: Callable[[T], bool], expected: str) -> Callable[[str], T]:
    """Makes a type: `kind` converts the text, `accept` checks the value, and `expected` is the form in errors."""

    def read(text: str) -> T:
        with contextlib.suppress(ValueError, OverflowError):
            value = kind(text)
            if accept(value) and not (isinstance(value, int) and abs(value) >> 63):  # of hundreds of digits
                return value
        raise argparse.ArgumentTypeError(f"found {text!r}, expected {expected}")

    return read


positive_int = checked(int, lambda value: value >= 1, "an integer >= 1")
count = checked(int, lambda value: value >= 0, "an integer >= 0")
port = checked(int, lambda value: 0 <= value < 65536, "an integer from 0 to 65535")
#: Seeds that torch's generators take; the trainer also uses the next one.
seed = checked(int, lambda value: 0 <= value <= 2**63 - 2, "an integer from 0 to 2^63 - 2")
positive_float = checked(float, lambda value: 0 < value < math.inf, "a number > 0")
non_negative_float = checked(float, lambda value: 0 <= value < math.inf, "a number >= 0")
share = checked(float, lambda value: 0 <= value <= 1, "a number from 0 to 1")
#: Frames per second that ffmpeg can represent.
fps = checked(float, lambda value: 0.01 <= value <= 1000, "a number from 0.01 to 1000")
named = checked(str, lambda text: text not in ("", "-"), "the name of a file or folder")
line = checked(str, str.isprintable, "one line of printable text")
host = checked(str, bool, "a host name or an IP address")
finite_float = checked(float, math.isfinite, "a number")
background = checked(color, lambda _: True, "black, white or R,G,B in 0..1")


def ending(suffix: str, *others: str) -> Callable[[str], str]:
    """Makes the type of outputs that end in `suffix`, so that none is an input by mistake. others: further names."""
    return checked(str, lambda text: text in others or text.lower().endswith(suffix), f"a name that ends in {suffix}")


def listed(kind: Callable[[str], T]) -> Callable[[str], tuple[T, ...]]:
    """Makes the type of comma-separated values of a kind, without repetitions, in the order given."""
    return lambda text: tuple(dict.fromkeys(kind(part) for part in text.split(",")))


def rate(text: str) -> float:
    """Reads a link rate in bits per second with k, M or G for 1e3, 1e6, 1e9: "2M" -> 2e6. 1k is the lowest."""
    expected = "a rate in bits per second such as 2M or 500k, at least 1k"
    return _scaled(text, {"k": 1e3, "M": 1e6, "G": 1e9}, expected, low=1e3)


def rates(text: str) -> dict[str, float]:
    """Reads comma-separated link rates: "2M,10M" -> {"2M": 2e6, "10M": 1e7}."""
    return {name: rate(name) for name in text.split(",")}


def duration(text: str) -> float:
    """Reads seconds: "50ms", "1.5s" or "1.5"."""
    return _scaled(text, {"ms": 1e-3, "s": 1.0}, "a time such as 50ms or 1.5s", low=0.0)


def size(text: str, expected: str = "a size in bytes such as 50k or 1.5MB") -> int:
    """Reads bytes with k or K, M, G for 1e3, 1e6, 1e9, and B or not: "50k", "50KB" -> 50000."""
    units = {"k": 1e3, "K": 1e3, "M": 1e6, "G": 1e9}
    with contextlib.suppress(argparse.ArgumentTypeError):
        return int(_scaled(text.removesuffix("B"), units, expected, low=1.0, high=2.0**63))
    raise argparse.ArgumentTypeError(f"found {text!r}, expected {expected}")


def layer_sizes(text: str) -> dict[int | None, int]:
    """Reads the bytes of a file or by layer: "300k" -> {None: 300000}, "L0=425k,L1=80000" -> {0: 425000, 1: 80000}."""
    layers, expected = {"L0": 0, "L1": 1, "L2": 2}, "a size such as 300k, or sizes of layers such as L0=425k,L1=120000"
    sizes: dict[int | None, int] = {}
    if "=" not in text:
        return {None: size(text, expected)}
    for part in text.split(","):
        name, _, number = part.partition("=")
        if name not in layers or layers[name] in sizes:
            raise argparse.ArgumentTypeError(f"found {text!r}, expected {expected}, each layer once")
        sizes[layers[name]] = size(number, expected)
    return sizes


def _scaled(
    text: str, units: dict[str, float], expected: str, low: float = math.ulp(0.0), high: float = math.inf
) -> float:
    """Reads a number with one of the units; the product must be at least `low` and below `high`."""
    unit = next((unit for unit in units if text.endswith(unit)), "")
    with contextlib.suppress(ValueError):
        value = float(text.removesuffix(unit)) * units.get(unit, 1.0)
        if low <= value < high:
            return value
    raise argparse.ArgumentTypeError(f"found {text!r}, expected {expected}")
