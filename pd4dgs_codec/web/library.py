"""The index of a library: a folder of packages as one JSON file and one page of posters."""

from __future__ import annotations

import html
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

from pd4dgs_codec.errors import DeliveryError
from pd4dgs_codec.web.package import INDEX
from pd4dgs_codec.web.page import PAGE

LIBRARY = "library.json"
#: What the library says of a scene, as the index of its package does.
FIELDS = ("bytes", "sha256", "format_version", "seconds", "first_frame_seconds")
STYLE = (
    "body{font:16px system-ui;margin:2rem;background:#111;color:#eee}"
    "main{display:grid;grid-template-columns:repeat(auto-fill,minmax(220px,1fr));gap:1rem}"
    "a{color:inherit;text-decoration:none}img,.none{width:100%;aspect-ratio:4/3;object-fit:cover;background:#333}"
    "small{color:#aaa}"
)


def library(folder: Path) -> dict[str, bytes]:
    """Name -> content of the two files that list all packages below `folder`, wherever it will be served.

    Raises DeliveryError if there are none, or one whose index is not that of a package.
    """
    scenes = list(_scenes(folder))
    if not scenes:
        raise DeliveryError(f"{folder}: holds no packages, expected NAME/{INDEX} as pd4dgs-package writes it")
    content = {"scenes": scenes, "bytes": sum(scene["bytes"] for scene in scenes)}
    return {LIBRARY: (json.dumps(content, indent=1) + "\n").encode(), PAGE: _page(scenes).encode()}


def _scenes(folder: Path) -> Iterator[dict[str, Any]]:
    for path in sorted(folder.rglob(INDEX)):
        if path.parent == folder:
            continue
        name = path.parent.relative_to(folder).as_posix()
        try:
            about = json.loads(path.read_bytes())
            scene: dict[str, Any] = {
                "name": name,
                "page": f"{quote(name)}/{PAGE}",
                "file": f"{quote(name)}/{about['file']}",
            }
            scene["poster"] = f"{quote(name)}/{about['poster']}" if about["poster"] else None
            scene |= {field: about[field] for field in FIELDS}
            scene["layers"] = [{"layer": part["layer"], "end": part["range"][1]} for part in about["layers"]]
        except (ValueError, KeyError, TypeError) as error:
            raise DeliveryError(f"{path}: is not the index of a package ({type(error).__name__}: {error})") from None
        yield scene


def _page(scenes: list[dict[str, Any]]) -> str:
    cards = []
    for scene in scenes:
        poster = f'<img loading="lazy" alt="" src="{html.escape(scene["poster"])}">' if scene["poster"] else None
        first = ", ".join(f"{seconds:.1f} s at {rate}bps" for rate, seconds in scene["first_frame_seconds"].items())
        about = f"{scene['bytes'] / 1e6:.2f} MB; first picture after {first}"
        link = f'<a href="{html.escape(scene["page"])}">{poster or "<div class=none></div>"}'
        cards.append(f"{link}<br>{html.escape(scene['name'])}<br><small>{about}</small></a>")
    head = f'<!doctype html><meta charset="utf-8"><title>{len(scenes)} scenes</title><style>{STYLE}</style>'
    return f"{head}\n<main>\n" + "\n".join(cards) + "\n</main>\n"
