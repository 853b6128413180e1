"""Packs the player for the web: one file per page and worker, without comments and indentation.

usage: python tools/pack_player.py FOLDER

The player runs as it is, module by module. Packed it is half the bytes and, more important, four requests instead of
forty. Modules keep their names and bodies: each becomes a function that returns what it exports, in the order in which
a browser would run them. That takes the few forms of import and export that the player uses, and refuses others.
"""

from __future__ import annotations

import gzip
import re
import sys
from pathlib import Path

PLAYER = Path(__file__).parents[1] / "player"
#: Entry -> name of its packed file. They lie side by side, so that workers are found beside what starts them.
ENTRIES = {
    "element.js": "element.js",
    "render/bench.js": "bench.js",
    "render/loader-worker.js": "loader-worker.js",
    "render/sort-worker.js": "sort-worker.js",
    "render/evaluate-worker.js": "evaluate-worker.js",
}
PAGE = "index.html"
#: What a first visit loads: not the measuring, and not the evaluator for machines without a GPU.
FIRST_VISIT = (PAGE, "element.js", "loader-worker.js", "sort-worker.js")

_NAMES = r"\{([^}]*)\}"
_IMPORT = re.compile(rf'^import {_NAMES} from "([^"]+)";\n', re.MULTILINE)
_REEXPORT = re.compile(rf'^export {_NAMES} from "([^"]+)";\n', re.MULTILINE)
_EXPORT = re.compile(r"^export (?=(?:async )?(?:const|function\*?|class) (\w+))", re.MULTILINE)
_LEFT = re.compile(r"^(?:import|export)\b.*", re.MULTILINE)
#: A slash after one of these begins a regular expression, not a division.
_BEFORE_REGEX = re.compile(r"(?:[(,=:\[!&|?{};+*%<>~^-]|\b(?:return|typeof|case|of|in))\s*$")


class PackError(Exception):
    """A module is written in a way that the packer does not know."""


def strip(source: str) -> str:
    """JavaScript without comments, indentation and empty lines. Strings, templates and patterns stay as they are."""
    out: list[str] = []
    depths: list[int] = []  # of braces, one per template that is open
    at = 0
    while at < len(source):
        two, one = source[at : at + 2], source[at]
        if two == "//":
            at = (source + "\n").index("\n", at)
            continue
        if two == "/*":
            end = source.find("*/", at)
            if end < 0:
                raise PackError(f"a comment without end: {source[at : at + 40]!r}")
            at = end + 2
            continue
        if one == "/" and _BEFORE_REGEX.search("".join(out[-40:])):
            end = _quoted(source, at)
        elif one in "'\"":
            end = _quoted(source, at)
        elif one == "`" or (one == "}" and depths and depths[-1] == 0):
            if one == "}":
                depths.pop()
            end, opened = _template(source, at + 1)
            if opened:
                depths.append(0)
        else:
            if depths:
                depths[-1] += {"{": 1, "}": -1}.get(one, 0)
            if one == "\n":
                while out and out[-1] in " \t":
                    out.pop()
                at += len(source) - at - len(source[at:].lstrip())
                if out and out[-1] != "\n":
                    out.append("\n")
                continue
            end = at + 1
            if one in " \t" and (not out or out[-1] == "\n"):
                at = end
                continue
        out.append(source[at:end])
        at = end
    if depths:
        raise PackError("a template without end")
    return "".join(out).rstrip() + "\n"


def _quoted(source: str, at: int) -> int:
    """Where the string or pattern that starts at `at` ends."""
    quote, i, in_class = source[at], at + 1, False
    while i < len(source) and source[i] != "\n":
        if source[i] == "\\":
            i += 1
        elif quote == "/" and source[i] in "[]":
            in_class = source[i] == "["
        elif source[i] == quote and not in_class:
            return i + 1
        i += 1
    raise PackError(f"a string or pattern without end: {source[at : at + 40]!r}")


def _template(source: str, at: int) -> tuple[int, bool]:
    """Where the text of a template that goes on at `at` ends, and whether an expression follows."""
    i = at
    while i < len(source):
        if source[i] == "\\":
            i += 1
        elif source[i] == "`":
            return i + 1, False
        elif source[i : i + 2] == "${":
            return i + 2, True
        i += 1
    raise PackError(f"a template without end: {source[at : at + 40]!r}")


def bundle(root: Path, entry: str) -> str:
    """The module `entry` of the folder `root` and all that it imports as one module with its exports."""
    modules: dict[Path, str] = {}  # path -> packed, imported ones first
    exports: dict[Path, list[str]] = {}
    packing: list[Path] = []

    def pack(path: Path) -> str:
        if path in packing:
            raise PackError(f"{path}: imports itself through {packing[-1]}")
        if path not in modules:
            packing.append(path)
            modules[path] = _wrapped(path, pack, exports)
            packing.pop()
        return f"m{list(modules).index(path)}"

    start = (root / entry).resolve()
    pack(start)
    parts = [f"const m{i}=(()=>{{\n{body}}})();\n" for i, body in enumerate(modules.values())]
    names = ",".join(exports[start])
    return "".join(parts) + (f"const {{{names}}}=m{len(parts) - 1};\nexport{{{names}}};\n" if names else "")


def _wrapped(path: Path, pack, exports: dict[Path, list[str]]) -> str:
    body = strip(path.read_text(encoding="utf-8"))
    names: list[str] = []
    packed: dict[str, str] = {}

    def target(relative: str) -> str:
        # not twice: a module that is being packed has no number yet
        if relative not in packed:
            packed[relative] = pack((path.parent / relative).resolve())
        return packed[relative]

    def imported(match: re.Match[str]) -> str:
        listed = ",".join(name.strip().replace(" as ", ":") for name in match[1].split(",") if name.strip())
        return f"const {{{listed}}}={target(match[2])};\n"

    def passed_on(match: re.Match[str]) -> str:
        given = [name.strip() for name in match[1].split(",") if name.strip()]
        names.extend(f"{name}:{target(match[2])}.{name}" for name in given)
        return ""

    body = _REEXPORT.sub(passed_on, _IMPORT.sub(imported, body))
    names += [match[1] for match in _EXPORT.finditer(body)]
    body = _EXPORT.sub("", body)
    left = _LEFT.search(body)
    if left:
        raise PackError(f"{path}: the packer does not know {left[0]!r}")
    exports[path] = [name.split(":")[0] for name in names]
    return f"{body}return{{{','.join(names)}}};\n"


def pack(root: Path = PLAYER) -> dict[str, bytes]:
    """Name -> content of every file of the packed player. root: the player's folder."""
    files = {name: bundle(root, entry).encode() for entry, name in ENTRIES.items()}
    page = (root / PAGE).read_text(encoding="utf-8").replace('"./render/bench.js"', '"./bench.js"')
    head = '<link rel="modulepreload" href="./element.js">\n'
    files[PAGE] = re.sub(r"<!--.*?-->\s*", head, page, count=1, flags=re.DOTALL).encode()
    return files


def main(folder: str) -> None:
    """Writes the packed player into `folder` and prints sizes."""
    files = pack()
    target = Path(folder)
    target.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        (target / name).write_bytes(content)
        print(f"{name:20} {len(content):>8,} bytes, {zipped(content):>7,} gzipped")
    print(f"first visit: {sum(zipped(files[name]) for name in FIRST_VISIT):,} bytes gzipped")


def zipped(content: bytes) -> int:
    """Bytes after gzip -9."""
    return len(gzip.compress(content, 9, mtime=0))


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(sys.argv[1])
