"""The player as one HTML file: beside a scene on any web server, with the scene inside, or in a notebook.

The player's modules run as they are. Packed, the page and its workers are one file without comments and indentation:
half the bytes and, more important, one request instead of forty. Modules keep their names and bodies: each becomes a
function that returns what it exports, in the order in which a browser would run them. That takes the few forms of
import and export that the player uses, and refuses others.
"""

from __future__ import annotations

import base64
import html
import json
import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pd4dgs_codec.errors import DataError, DeliveryError
from pd4dgs_codec.format.decoder import decode
from pd4dgs_codec.scene import Scene
from pd4dgs_codec.web.urls import is_url

PAGE = "index.html"
MODULE = "page.js"
#: Asks for the scene before the rest of the page is there.
EARLY = "early.js"
WORKERS = ("loader-worker.js", "sort-worker.js", "evaluate-worker.js")
#: Of packing a scene that is shown at once.
EFFORT = 1

#: How the player names what it starts a worker from.
_WORKER_URL = re.compile(r'new URL\("\./([\w-]+-worker\.js)", import\.meta\.url\)')
_NAMES = r"\{([^}]*)\}"
_IMPORT = re.compile(rf'^import {_NAMES} from "([^"]+)";\n', re.MULTILINE)
_REEXPORT = re.compile(rf'^export {_NAMES} from "([^"]+)";\n', re.MULTILINE)
_EXPORT = re.compile(r"^export (?=(?:async )?(?:const|function\*?|class) (\w+))", re.MULTILINE)
_LEFT = re.compile(r"^(?:import|export)\b.*", re.MULTILINE)
#: A slash after one of these begins a regular expression, not a division.
_BEFORE_REGEX = re.compile(r"(?:[(,=:\[!&|?{};+*%<>~^-]|\b(?:return|typeof|case|of|in))\s*$")


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
                raise DeliveryError(f"a comment without end: {source[at : at + 40]!r}")
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
        raise DeliveryError("a template without end")
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
    raise DeliveryError(f"a string or pattern without end: {source[at : at + 40]!r}")


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
    raise DeliveryError(f"a template without end: {source[at : at + 40]!r}")


def bundle(root: Path, entry: str) -> str:
    """The module `entry` of the folder `root` and all that it imports as one module with its exports."""
    modules: dict[Path, str] = {}  # path -> packed, imported ones first
    exports: dict[Path, list[str]] = {}
    packing: list[Path] = []

    def pack(path: Path) -> str:
        if path in packing:
            raise DeliveryError(f"{path}: imports itself through {packing[-1]}")
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


def _wrapped(path: Path, pack: Callable[[Path], str], exports: dict[Path, list[str]]) -> str:
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
        raise DeliveryError(f"{path}: the packer does not know {left[0]!r}")
    exports[path] = [name.split(":")[0] for name in names]
    return f"{body}return{{{','.join(names)}}};\n"


def player_folder() -> Path:
    """Where the player lies: in the installed package, or beside it in a checkout. DataError if it is nowhere."""
    package = Path(__file__).parents[1]
    for folder in (package / "player", package.parent / "player"):
        if (folder / PAGE).is_file():
            return folder
    raise DataError(f"{package}: holds no player; expected the package as pip installs it, or a checkout")


def page(source: bytes | str | None = None) -> str:
    """The player as one HTML file. It needs no server for a scene that it holds, and no network.

    source: the bytes of a `.pd4`, or its URL; None: `scene.pd4` beside the page, or the page's `?src=address`.
    """
    root = player_folder()
    workers = {name: bundle(root, f"render/{name}") for name in WORKERS}
    code = _WORKER_URL.sub(r"new URL(workers['\1'])", bundle(root, MODULE))
    # no module, so that the loader begins while the browser still reads the player
    script = f"""<script>
const workers={_literal(workers)};
for(const name in workers)workers[name]=URL.createObjectURL(new Blob([workers[name]],{{type:"text/javascript"}}));
globalThis.early?.begin(workers["{WORKERS[0]}"]);
</script>
<script type="module">
{code}</script>
"""
    text = re.sub(r"<!--.*?-->\s*", "", (root / PAGE).read_text(encoding="utf-8"), flags=re.DOTALL)
    head, body, _ = re.split(r'(?=<p id="note")|<script type="module".*', text, maxsplit=2)
    first = strip((root / EARLY).read_text(encoding="utf-8"))
    early = "" if isinstance(source, bytes) else f"<script>\n{first}</script>"
    head = head.replace(f'<script src="./{EARLY}"></script>', early)
    if isinstance(source, str):
        head, body = head.replace("<html ", f'<html data-src="{html.escape(source)}" ', 1), "<body>\n"
    elif source is not None:
        body = f'<body>\n<script type="text/plain" id="scene">{base64.b64encode(source).decode()}</script>\n'
    return f"{head}{body}{script}</html>\n"


def _literal(value: object) -> str:
    """As JavaScript inside a page, where `</script` and `<!--` would be the page's."""
    return json.dumps(value).replace("<", "\\u003c")


@dataclass(frozen=True)
class Shown:
    """What a notebook shows as the result of a cell. page: the whole HTML file. width: CSS. height: pixels."""

    page: str
    width: str
    height: int

    def _repr_html_(self) -> str:
        frame = f'style="width:{html.escape(self.width)};height:{self.height:d}px;border:0" allow="fullscreen"'
        return f'<iframe title="Dynamic scene" {frame} srcdoc="{html.escape(self.page)}"></iframe>'

    def __repr__(self) -> str:
        return f"<a page of {len(self.page):,} characters; a notebook shows it>"


def show(scene: Scene | bytes | str | os.PathLike[str], *, width: str = "100%", height: int = 480) -> Shown:
    """The player with a scene, for a notebook: the last line of a cell, or `display(show(scene))`.

    scene: a decoded scene, the bytes of a `.pd4`, its path or its URL. The page holds all but the last; the server of
    a URL must allow pages of other sites to read it, as pd4dgs-serve does. width: CSS. height: pixels. Raises
    DecodeError for bytes that are no whole, valid `.pd4` file.
    """
    if isinstance(scene, str) and is_url(scene):
        return Shown(page(scene), width, height)
    if isinstance(scene, Scene):
        from pd4dgs_codec.format.encoder import encode

        data = encode(scene, effort=EFFORT)
    else:
        data = scene if isinstance(scene, bytes) else Path(scene).read_bytes()
        decode(data)  # a fault is better said here than in a page
    return Shown(page(data), width, height)
