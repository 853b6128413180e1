"""Sphinx: the repository's own Markdown as a site, with the API from the docstrings. Run by tools/docs.sh.

The source folder is the repository itself, so that a link works here as it works in the repository. Two things are made
on the way: one page per room of the package under docs/api/, and the table of contents, which stands here and not as a
directive in README.md.
"""

from __future__ import annotations

import re
import shutil
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "pd4dgs_codec"
API = ROOT / "docs" / "api"
sys.path.insert(0, str(ROOT))

project = "pd4dgs-codec"
author = copyright = "the pd4dgs-codec authors"
extensions = ["myst_parser", "sphinx.ext.autodoc"]
root_doc = "README"
include_patterns = ["*.md", "docs/**", "spec/*.md", "spec/vectors/README.md"]
exclude_patterns = [".*", "out", "build", "dist", "tests", "tools", "benchmarks", "pd4dgs_codec", "*.egg-info"]

# Markdown: headings are link targets as they are on a forge; a link that leads nowhere is a warning, hence an error.
myst_heading_anchors = 4
myst_enable_extensions = ["strikethrough"]

# The site needs neither torch nor numba: what is not installed is a stand-in while docstrings are read.
autodoc_mock_imports = "torch numba PIL imageio_ffmpeg matplotlib tqdm gsplat llvmlite fsspec pycolmap".split()
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True, "ignore-module-all": True}
autodoc_preserve_defaults = True
autodoc_typehints = "signature"
default_role = "code"
add_module_names = False
toc_object_entries = False

html_theme = "furo"
html_title = "pd4dgs-codec"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sourcelink = False
html_extra_path = ["index.html"]
pygments_style = "friendly"

#: The table of contents: caption and pages.
CONTENTS = {
    "Use": [
        "docs/README",
        "docs/tutorial",
        "docs/python",
        "docs/training",
        "docs/constants",
        "docs/encoding",
        "docs/player-and-delivery",
        "docs/interchange",
        "docs/batch",
        "docs/evaluation",
        "docs/api/index",
    ],
    "Format": ["spec/format", "spec/audit", "spec/vectors/README", "docs/robustness"],
    "Project": ["docs/results", "docs/design", "CONTRIBUTING", "SECURITY", "CHANGELOG"],
    "Log": ["docs/log/README", *sorted(f"docs/log/{page.stem}" for page in ROOT.glob("docs/log/[a-z]*.md"))],
}

STYLE = "border: 0; width: 480px; max-width: 100%; aspect-ratio: 1"  # no wider than a phone
PLAYER = f'<iframe src="sample.html" title="The dancer, playing" style="{STYLE}"></iframe>'

#: Rooms that are used as commands, not as a library.
LEFT_OUT = {"cli", "bench"}


def toctree(pages: list[str], caption: str) -> str:
    """A hidden table of contents in MyST's syntax."""
    return "\n".join(["", "", "```{toctree}", ":hidden:", f":caption: {caption}", "", *pages, "```", ""])


def add_contents(app: Any, docname: str, source: list[str]) -> None:
    """Event source-read: the start page gets the table of contents, and what tools/docs.sh lays beside the pages: the
    player with the sample in place of its animation, and the notebook."""
    if docname == root_doc:
        source[0], count = re.subn(r"!\[[^]]*\]\(docs/img/refining\.gif\)", PLAYER, source[0])
        assert count == 1, "README.md shows docs/img/refining.gif once"
        source[0] += '\n<a href="tutorial.ipynb">The tutorial as a notebook</a>\n'
        source[0] += "".join(toctree([f"/{page}" for page in pages], caption) for caption, pages in CONTENTS.items())


def heading(text: str, line: str) -> list[str]:
    """A title underlined with `line`."""
    return [text, line * len(text), ""]


def automodule(path: Path) -> list[str]:
    """The section of one module, headed by its name inside the package."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
    options = ["   :show-inheritance:"] if name == "errors" else []
    return [*heading(name, "-"), f".. automodule:: pd4dgs_codec.{name}", *options, ""]


def write_api(app: Any) -> None:
    """Event builder-inited: docs/api/ROOM.rst per room and docs/api/index.rst."""
    rooms: dict[str, list[Path]] = {}
    for path in sorted(PACKAGE.iterdir()):
        if path.name.startswith("_") or path.name in LEFT_OUT:
            continue
        if path.suffix == ".py":
            rooms[path.stem] = [path]
        elif modules := sorted(path.rglob("*.py")):
            rooms[path.name] = modules
    pages = {
        name: [*heading(f"pd4dgs_codec.{name}", "="), *(line for path in paths for line in automodule(path))]
        for name, paths in rooms.items()
    }
    index = [*heading("API", "="), INDEX, "", ".. toctree::", "   :maxdepth: 1", ""]
    pages["index"] = [*index, *(f"   {name} <{name}>" for name in rooms), ""]
    shutil.rmtree(API, ignore_errors=True)
    API.mkdir()
    for name, lines in pages.items():
        (API / f"{name}.rst").write_text("\n".join(lines))


INDEX = """\
What most programs need can be imported from the package itself. A decoded file is a
:class:`~pd4dgs_codec.scene.Scene`, a refused one a :exc:`~pd4dgs_codec.errors.DecodeError`. Scenes from a web server
come from a :class:`~pd4dgs_codec.web.client.SceneClient`.

.. autofunction:: pd4dgs_codec.decode
.. autofunction:: pd4dgs_codec.render
.. autofunction:: pd4dgs_codec.sample
.. autofunction:: pd4dgs_codec.open_stream
.. autofunction:: pd4dgs_codec.encode

The rooms of the package:
"""

#: What stays markup in a docstring: `a literal`, and *a word* or a few.
MARKUP = re.compile(r"(`[^`\n]+`|(?<![\w*])\*[A-Za-z][\w ]*\*(?![\w*]))")
#: A line that begins with names and a colon, as docstrings list arguments and fields.
NAMED = re.compile(r"\w+(, \w+)*: ")


def escaped(text: str) -> str:
    """One line of plain text as reStructuredText."""
    parts = MARKUP.split(text)
    for i, part in enumerate(parts):
        if i % 2 == 0:
            parts[i] = re.sub(r"([\\*|_`<>])", r"\\\1", part)
        elif part[0] == "`":
            parts[i] = f"``{part[1:-1]}``"
    return "".join(parts)


def from_plain_text(app: Any, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Event autodoc-process-docstring: docstrings here are plain text.

    Paragraphs and lists stay, indented paragraphs are shown as they are, and `name: ...` begins a line of its own.
    """
    out: list[str] = []
    for block in re.split(r"\n\s*\n", "\n".join(lines).strip("\n")):
        rows = block.split("\n")
        if all(row.startswith("    ") for row in rows):
            out += ["::", "", *rows]
        elif any(NAMED.match(row) for row in rows[1:]):
            starts = [i == 0 or NAMED.match(row) for i, row in enumerate(rows)]
            out += [("| " if start else "  ") + escaped(row.strip()) for start, row in zip(starts, rows, strict=True)]
        else:
            out += [row[: len(row) - len(row.lstrip())] + escaped(row.strip()) for row in rows]
        out.append("")
    lines[:] = out


def setup(app: Any) -> None:
    """Called by Sphinx."""
    app.connect("builder-inited", write_api)
    app.connect("source-read", add_contents)
    app.connect("autodoc-process-docstring", from_plain_text)
