"""The player as one HTML file: beside a scene on any web server, with the scene inside, or in a notebook.

One file takes one request instead of one for each module, and browsers open it without a server. Workers of a page that
is opened as a file cannot import modules, so one script holds all modules, each as a function that returns its exports.
Page and workers run that script, each from a module of its own. The page holds it compressed, behind what the first
paint needs: a small picture of the scene, then the loader that requests the scene.
"""

import base64
import gzip
import hashlib
import html
import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pd4dgs_codec.errors import DataError, DeliveryError
from pd4dgs_codec.format.decoder import decode
from pd4dgs_codec.format.info import info
from pd4dgs_codec.kinds import AnyScene
from pd4dgs_codec.scene import LayeredScene
from pd4dgs_codec.web import PAGE, is_url

#: The page's script, and the one that requests the scene while the rest of the page arrives.
SCRIPT, EARLY = "page.js", "early.js"
WORKERS = ("loader-worker.js", "sort-worker.js", "evaluate-worker.js")
#: Which module a script of all entry points starts: a worker's address names it, except that of EARLY's worker.
ENTRY = f'self.document?"{SCRIPT}":"render/"+(location.hash.slice(1)||"{WORKERS[0]}")'
CHARSET = '<meta charset="utf-8">'  #: the first element of our pages
#: Encoder effort for a scene that is shown immediately.
EFFORT = 1

_WORKER_URL = re.compile(r'new URL\("\./([\w-]+-worker\.js)", import\.meta\.url\)')
_COMMENTS = re.compile(r"/\*\*.*?\*/[ \t]*|^[ \t]*//[^\n]*|[ \t]+//[^\n\"`]*$", re.DOTALL | re.MULTILINE)
_SPACE = re.compile(r"\s*\n\s*")
_IMPORT = re.compile(r'^import (?:\{([^}]*)\} from )?"([^"]+)";$', re.MULTILINE)
_REEXPORT = re.compile(r'^export \{([^}]*)\} from "([^"]+)";$', re.MULTILINE)
_EXPORT = re.compile(r"^export (?=(?:async )?(?:const|function\*?|class) (\w+))", re.MULTILINE)


def bundle(root: Path, *entries: str, start: str = "") -> str:
    """Bundles modules of the folder `root` and their imports into one script without indentation.

    start: JavaScript expression for the entry that the script runs; default: the first. Only the player's forms of
    import and export are supported; any other raises DeliveryError.
    """
    modules: dict[str, str] = {}

    def add(path: Path) -> str:
        """Adds a module and its imports, and returns the expression for its exports."""
        name = path.relative_to(root.resolve()).as_posix()
        if name not in modules:
            modules[name] = ""
            modules[name] = _module(path, lambda other: add((path.parent / other).resolve()))
        return f'$take("{name}")'  # no name of a module's own

    first = [add((root / entry).resolve()) for entry in entries][0]
    bodies = "".join(f'"{name}"(){{\n{body}}},\n' for name, body in modules.items())
    head = f'"use strict";\nconst $modules={{\n{bodies}}};\n'
    head += "const $made={},$take=(name)=>$made[name]??=$modules[name]();\n"
    return f"{head}{f'$take({start})' if start else first};\n"


def _module(path: Path, imported: Callable[[str], str]) -> str:
    body = packed(path)
    exports: list[str] = []

    def take(match: re.Match[str]) -> str:
        names = f"const {{{match[1].replace(' as ', ':')}}}=" if match[1] else ""
        return f"{names}{imported(match[2])};"

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


@dataclass(frozen=True)
class Still:
    """The picture that a page shows until the player has drawn one. data: a WebP file that shows `reach` times the
    width and height of the scene's camera around its picture, so that windows of other shapes are filled. aspect: width
    of the camera's picture per height. background: CSS colour. worth: so many bytes of the scene show less than it
    does."""

    data: bytes
    reach: float
    aspect: float
    background: str
    worth: int = 0


#: Bytes of the code before the loader, a multiple of 3 for base64. A first slice of some 50 kB and the rest of the code
#: share the link. The code is then complete first, and starts the player while the slice arrives: on a slow link the
#: first picture takes as many bytes in any order, and what a processor does meanwhile is no extra time.
AHEAD = 39_000
#: Makes the player of the compressed code in the elements "code".
UNPACK = """<script>
{const held=[...document.querySelectorAll(".code")].map((part)=>part.textContent).join("");
const code=Uint8Array.from(atob(held),(c)=>c.charCodeAt(0));
const text=new Blob([code]).stream().pipeThrough(new DecompressionStream("gzip"));
new Response(text,{headers:{"Content-Type":"text/javascript"}}).blob().then((blob)=>{
globalThis.packed=URL.createObjectURL(blob);
globalThis.early?.begin(packed);
document.head.append(Object.assign(document.createElement("script"),{src:packed}));
});}
</script>
"""


def page(source: bytes | str | None = None, about: bytes | None = None, still: Still | None = None) -> str:
    """Returns the player as one HTML file.

    source: the bytes of a `.pd4` to embed, or its URL, whatever `?src=` says; None: `scene.pd4` beside the page, or the
    page's `?src=address`. about: bytes of a `.pd4` whose metadata name the page; default: those that are embedded.
    still: shown before any script has arrived.
    """
    root = player_folder()
    code = bundle(root, SCRIPT, *(f"render/{name}" for name in WORKERS), start=ENTRY)
    code = _WORKER_URL.sub(r"new URL(packed+'#\1')", code)
    text = re.sub(r"<!--.*?-->\s*", "", (root / PAGE).read_text(encoding="utf-8"), flags=re.DOTALL)
    about = source if isinstance(source, bytes) else about
    title: str = ((about and info(about)["metadata"]) or {}).get("title") or ""
    for usual, tag in ((".pd4 player", "title"), ("Dynamic scene", "h1")) if title else ():
        text = text.replace(f"{usual}</{tag}>", f"{html.escape(title)}</{tag}>")
    head, _, _ = re.split(r'<script src="\./early\.js"></script>\s*|<p id="note".*', text, flags=re.DOTALL)
    early = "" if isinstance(source, bytes) else f"<script>\n{packed(root / EARLY)}</script>\n"
    if isinstance(source, str):
        head = head.replace("<html ", f'<html data-src="{html.escape(source)}" ', 1)
    if still is not None:
        held = f' poster-bytes="{still.worth}"' if still.worth else ""
        head = head.replace("<pd4-player></pd4-player>", f"<pd4-player{held}>{_img(still)}</pd4-player>", 1)
    zipped = gzip.compress(code.encode(), 9, mtime=0)
    parts = [_held('id="scene"', source)] if isinstance(source, bytes) else []
    parts += [_held('class="code"', zipped[:AHEAD]), early, _held('class="code"', zipped[AHEAD:]), UNPACK]
    asked = "'none'" if isinstance(source, bytes) else "'self'" if source and not is_url(source) else "http: https:"
    more = {"script": "blob: 'wasm-unsafe-eval'", "worker": "blob:", "img": "'self' data: blob:", "connect": asked}
    return with_policy(f"{head}{''.join(parts)}</html>\n", **more)


def with_policy(text: str, **sources: str) -> str:
    """Returns a page with a Content-Security-Policy that allows its own inline scripts and styles by their digests, and
    nothing else but `sources`: by kind, such as img, what the directive allows."""
    inline: dict[str, list[str]] = {}
    for kind, content in re.findall(r"<(script|style)>(.*?)</\1>", text, re.DOTALL):
        digest = base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()
        inline.setdefault(kind, []).append(f"'sha256-{digest}'")
    allowed = {kind: " ".join([*inline.get(kind, ()), sources.get(kind, "")]).strip() for kind in {**inline, **sources}}
    rules = ["default-src 'none'", "base-uri 'none'", "form-action 'none'"]
    rules += [f"{kind}-src {what}" for kind, what in allowed.items()]
    policy = f'<meta http-equiv="Content-Security-Policy" content="{"; ".join(rules)}">'
    return text.replace(CHARSET, CHARSET + policy, 1)


def _held(name: str, data: bytes) -> str:
    """An element whose text is the data in base64."""
    return f'<script type="text/plain" {name}>{base64.b64encode(data).decode()}</script>\n'


def _img(still: Still) -> str:
    """The picture as large as the player draws the scene, for both values of `fit`."""
    style = f"<style>pd4-player{{background:{still.background}}}"
    for fit, side in (("", "min"), ("[fit=cover]", "max")):
        style += f"pd4-player{fit}>img{{width:calc({still.reach}*{side}(100cqw,100cqh*{still.aspect:.4f}))}}"
    style += "</style>"
    return f'{style}<img alt="" src="data:image/webp;base64,{base64.b64encode(still.data).decode()}">'


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


def show(scene: AnyScene | bytes | str | os.PathLike[str], *, width: str = "100%", height: int = 480) -> Shown:
    """Shows a scene in a notebook, as the last line of a cell or by `display(show(scene))`.

    scene: a decoded scene, the bytes of a `.pd4`, its path or its URL. The page embeds the scene, except for a URL,
    whose server must allow pages of other sites to read it, as pd4dgs-serve does. width: CSS. height: pixels. Raises
    DecodeError for bytes that are not a complete, valid `.pd4` file.
    """
    if isinstance(scene, str) and is_url(scene):
        return Shown(page(scene), width, height)
    if isinstance(scene, LayeredScene):
        from pd4dgs_codec.format.encoder import encode

        data = encode(scene, effort=EFFORT)
    else:
        data = scene if isinstance(scene, bytes) else Path(scene).read_bytes()
        decode(data)  # an error here is clearer than one in the page
    return Shown(page(data), width, height)
