"""The player as one HTML file: beside a scene on any web server, with the scene inside, or in a notebook.

One file takes one request instead of one for each module, and browsers open it without a server. Workers of a page that
is opened as a file cannot import modules, so each entry point is bundled into one script. In it, each module is a
function that returns the module's exports, in the order in which a browser would run the modules.
"""

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
from pd4dgs_codec.format.info import info
from pd4dgs_codec.scene import Scene
from pd4dgs_codec.web import PAGE, is_url

#: The page's script, and the one that requests the scene while the rest of the page arrives.
SCRIPT, EARLY = "page.js", "early.js"
WORKERS = ("loader-worker.js", "sort-worker.js", "evaluate-worker.js")
#: Encoder effort for a scene that is shown immediately.
EFFORT = 1

_WORKER_URL = re.compile(r'new URL\("\./([\w-]+-worker\.js)", import\.meta\.url\)')
_COMMENTS = re.compile(r"/\*\*.*?\*/[ \t]*|^[ \t]*//[^\n]*|[ \t]+//[^\n\"`]*$", re.DOTALL | re.MULTILINE)
_SPACE = re.compile(r"\s*\n\s*")
_IMPORT = re.compile(r'^import \{([^}]*)\} from "([^"]+)";$', re.MULTILINE)
_REEXPORT = re.compile(r'^export \{([^}]*)\} from "([^"]+)";$', re.MULTILINE)
_EXPORT = re.compile(r"^export (?=(?:async )?(?:const|function\*?|class) (\w+))", re.MULTILINE)


def bundle(root: Path, entry: str) -> str:
    """Bundles the module `entry` of the folder `root` and its imports into one script without indentation.

    Only the player's forms of import and export are supported; any other raises DeliveryError.
    """
    modules: dict[Path, str] = {}  # imported ones first

    def add(path: Path) -> str:
        """Adds a module after its imports and returns its variable."""
        if path not in modules:
            modules[path] = _module(path, lambda name: add((path.parent / name).resolve()))
        return "m_" + re.sub(r"\W", "_", path.relative_to(root.resolve()).as_posix())

    add((root / entry).resolve())
    return "".join(f"const {add(path)}=(()=>{{\n{body}}})();\n" for path, body in modules.items())


def _module(path: Path, imported: Callable[[str], str]) -> str:
    body = packed(path)
    exports: list[str] = []

    def take(match: re.Match[str]) -> str:
        return f"const {{{match[1].replace(' as ', ':')}}}={imported(match[2])};"

    def pass_on(match: re.Match[str]) -> str:
        exports.extend(f"{name.strip()}:{imported(match[2])}.{name.strip()}" for name in match[1].split(","))
        return ""

    body = _REEXPORT.sub(pass_on, _IMPORT.sub(take, body))
    exports += [match[1] for match in _EXPORT.finditer(body)]
    body = _EXPORT.sub("", body)
    unknown = re.search(r"^(?:import|export)\b.*", body, re.MULTILINE)
    if unknown:
        raise DeliveryError(f"{path}: cannot bundle {unknown[0]!r}")
    return f"{body}return{{{','.join(exports)}}};\n"


def packed(path: Path) -> str:
    """Returns a script without indentation and comments, except comments after code that contain a quote."""
    return _SPACE.sub("\n", _COMMENTS.sub("", path.read_text(encoding="utf-8"))).strip() + "\n"


def player_folder() -> Path:
    """Finds the player's folder in the installed package or beside it in a checkout. Raises DataError."""
    package = Path(__file__).parents[1]
    for folder in (package / "player", package.parent / "player"):
        if (folder / PAGE).is_file():
            return folder
    raise DataError(f"{package}: found no player, expected an installed package or a checkout")


def page(source: bytes | str | None = None, about: bytes | None = None) -> str:
    """Returns the player as one HTML file.

    source: the bytes of a `.pd4` to embed, or its URL; None: `scene.pd4` beside the page, or the page's
    `?src=address`. about: bytes of a `.pd4` whose metadata name the page; default: those that are embedded.
    """
    root = player_folder()
    workers = {name: bundle(root, f"render/{name}") for name in WORKERS}
    code = _WORKER_URL.sub(r"new URL(workers['\1'])", bundle(root, SCRIPT))
    # the first script is not a module, so that the loader begins while the browser still reads the player
    script = f"""<script>
const workers={_literal(workers)};
for(const name in workers)workers[name]=URL.createObjectURL(new Blob([workers[name]],{{type:"text/javascript"}}));
globalThis.early?.begin(workers["{WORKERS[0]}"]);
</script>
<script type="module">
{code}</script>
"""
    text = re.sub(r"<!--.*?-->\s*", "", (root / PAGE).read_text(encoding="utf-8"), flags=re.DOTALL)
    about = source if isinstance(source, bytes) else about
    title: str = ((about and info(about)["metadata"]) or {}).get("title") or ""
    for usual, tag in ((".pd4 player", "title"), ("Dynamic scene", "h1")) if title else ():
        text = text.replace(f"{usual}</{tag}>", f"{html.escape(title)}</{tag}>")
    head, body, _ = re.split(r'(?=<p id="note")|<script type="module".*', text, maxsplit=2)
    early = "" if isinstance(source, bytes) else f"<script>\n{packed(root / EARLY)}</script>"
    head = head.replace(f'<script src="./{EARLY}"></script>', early)
    if isinstance(source, str):
        head, body = head.replace("<html ", f'<html data-src="{html.escape(source)}" ', 1), ""
    elif source is not None:
        body = f'<script type="text/plain" id="scene">{base64.b64encode(source).decode()}</script>\n'
    return f"{head}{body}{script}</html>\n"


def _literal(value: object) -> str:
    """Returns a JavaScript literal without `</script` and `<!--`, which would end the page's script."""
    return json.dumps(value).replace("<", "\\u003c")


@dataclass(frozen=True)
class Shown:
    """The result of a notebook cell. page: the whole HTML file. width: CSS. height: pixels."""

    page: str
    width: str
    height: int

    def _repr_html_(self) -> str:
        frame = f'style="width:{html.escape(self.width)};height:{self.height:d}px;border:0" allow="fullscreen"'
        return f'<iframe title="Dynamic scene" {frame} srcdoc="{html.escape(self.page)}"></iframe>'

    def __repr__(self) -> str:
        return f"<a page of {len(self.page):,} characters; a notebook shows it>"


def show(scene: Scene | bytes | str | os.PathLike[str], *, width: str = "100%", height: int = 480) -> Shown:
    """Shows a scene in a notebook, as the last line of a cell or by `display(show(scene))`.

    scene: a decoded scene, the bytes of a `.pd4`, its path or its URL. The page embeds the scene, except for a URL,
    whose server must allow pages of other sites to read it, as pd4dgs-serve does. width: CSS. height: pixels. Raises
    DecodeError for bytes that are not a complete, valid `.pd4` file.
    """
    if isinstance(scene, str) and is_url(scene):
        return Shown(page(scene), width, height)
    if isinstance(scene, Scene):
        from pd4dgs_codec.format.encoder import encode

        data = encode(scene, effort=EFFORT)
    else:
        data = scene if isinstance(scene, bytes) else Path(scene).read_bytes()
        decode(data)  # an error here is clearer than one in the page
    return Shown(page(data), width, height)
