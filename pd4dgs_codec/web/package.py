"""Packages a `.pd4` file as a folder for any web server: the player's page, DASH and HLS manifests, a JSON index.

`scene.mp4` holds each slice in an MP4 fragment of its own; concatenated, its samples are the `.pd4` file. A library is
the index of a folder of packages.
"""

import hashlib
import html
import json
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any
from urllib.parse import quote

from pd4dgs_codec.errors import DeliveryError, printable
from pd4dgs_codec.format.decoder import decode, every_prefix
from pd4dgs_codec.format.info import info
from pd4dgs_codec.format.reader import read_base
from pd4dgs_codec.kinds import AnyScene
from pd4dgs_codec.segments import INDEX as SEGMENTS_INDEX
from pd4dgs_codec.segments import File, Index, Segment, read_file, read_index
from pd4dgs_codec.web import PAGE, manifests
from pd4dgs_codec.web.headers import cache_control
from pd4dgs_codec.web.page import CHARSET, Still, page, with_policy

SCENE, SEGMENTS, MPD, PLAYLIST, INDEX = "scene.pd4", "scene.mp4", "scene.mpd", "scene.m3u8", "index.json"
VIDEO, VIDEO_PLAYLIST, POSTER = "fallback.mp4", "fallback.m3u8", "poster.jpg"
#: Link rates, bits per second, for which the index gives the time of the first picture.
RATES = {"2M": 2e6, "10M": 1e7, "50M": 5e7}
STILL_SECONDS = 1.0  #: presentation time of a static scene
#: What renders a share of a scene's time, from its start on.
Render = Callable[[AnyScene, float], manifests.Video | None]
#: What draws a page's still: of the scene, and of (bytes, scene) of what a client has of it before and at the end.
Draw = Callable[[AnyScene, Iterator[tuple[int, AnyScene]]], Still | None]


def presentation_seconds(low: float, high: float) -> float:
    """How long manifests and video show a scene of this time range, seconds."""
    return high - low if high > low else STILL_SECONDS


def package(
    data: bytes,
    render: Render = lambda scene, share: None,
    draw: Draw = lambda scene, prefixes: None,
    *,
    immutable: bool = False,
) -> dict[str, bytes]:
    """Returns name -> content of every file of the folder.

    render, draw: make the 2D rendition and the page's still of the decoded scene, or return None. immutable: names of
    scene and media files contain a digest of their content, so that caches may keep them forever. Raises DecodeError
    unless `data` is a complete, valid `.pd4` file, and DeliveryError if it is too long or too large for MP4, both
    before rendering.
    """
    scene = decode(data)
    about = info(data)
    seconds = presentation_seconds(*about["time_range"])
    if seconds > manifests.MAX_SECONDS:
        raise DeliveryError(f"found a scene of {seconds:g} s, expected at most {manifests.MAX_SECONDS:,} s for DASH")
    segments, slices = _segments(data, about, seconds)
    video = render(scene, 1.0)
    media = {SCENE: data, SEGMENTS: segments}
    if video is not None:
        media |= {VIDEO: video.data} | ({POSTER: video.poster} if video.poster else {})
    names = {name: addressed(name, content) if immutable else name for name, content in media.items()}
    files = {names[name]: content for name, content in media.items()}
    for row in slices:
        row["dash"]["file"] = names[SEGMENTS]
    track = None if video is None else manifests.Track.of(names[VIDEO], video)
    files |= _manifests([manifests.Period(slices, seconds, track)])
    ends = (row["range"][1] for row in slices)
    files[PAGE] = page(names[SCENE], data, draw(scene, zip(ends, every_prefix(data), strict=True))).encode()
    index = _index(names[SCENE], data, about, len(data), seconds, slices, names.get(POSTER))
    index["video"] = video and {"file": names[VIDEO], "width": video.width, "height": video.height, "fps": video.fps}
    index["cache_control"] = {name: cache_control(name) for name in (*files, INDEX)}
    return files | {INDEX: _json(index)}


def package_segments(
    folder: Path,
    render: Render = lambda scene, share: None,
    draw: Draw = lambda scene, prefixes: None,
    *,
    immutable: bool = False,
) -> Iterator[tuple[str, bytes]]:
    """Yields (name, content) of every file of the package of a folder of segments; those that name others come last.

    render, draw: as for `package`; `render` is called with each segment and the share of its time before the next one
    begins, `draw` with the first. `index.json` has the slices of each file; `segments.json`, which players fetch first,
    has not. Raises DataError or DecodeError for a file that is missing or damaged.
    """
    place, index = read_index(folder)
    rows: dict[str, list[dict[str, Any]]] = {"bases": [], "segments": []}
    periods, tracks, begun, poster = list[manifests.Period](), list[manifests.Track](), None, b""
    base_of = lru_cache(1)(lambda k: read_base(read_file(place, index.bases[k])))

    def media(file: File, data: bytes, seconds: float) -> Iterator[tuple[str, bytes]]:
        """Yields a file and its MP4, and appends its row of the index."""
        stem, _, _ = file.file.rpartition(".")
        boxes, slices = _segments(data, info(data), seconds)
        found = {file.file: data, f"{stem}.mp4": boxes}
        names = [addressed(name, content) if immutable else name for name, content in found.items()]
        for row in slices:
            row["dash"]["file"] = names[1]
        kind = "segments" if isinstance(file, Segment) else "bases"
        rows[kind].append({**vars(file), "file": names[0], "layers": slices})
        yield from zip(names, found.values(), strict=True)

    for base in index.bases:
        yield from media(base, read_file(place, base), STILL_SECONDS)
    for number, segment in enumerate(index.segments):
        data, (start, end) = read_file(place, segment), segment.time_range
        scene = decode(data, base=None if segment.base is None else base_of(segment.base))
        yield from media(segment, data, end - start)
        until = index.segments[number + 1].time_range[0] if number + 1 < len(index.segments) else end
        if (video := render(scene, (until - start) / (end - start))) is not None:
            name = f"fallback-{number:05d}.mp4"
            name = addressed(name, video.data) if immutable else name
            yield name, video.data
            tracks.append(manifests.Track.of(name, video))
            poster = poster or video.poster
        begun = scene if number == 0 else begun
        shared = [] if segment.base is None else rows["bases"][segment.base]["layers"]
        shared = [row for row in shared if row["layer"] == 0]
        layers = rows["segments"][-1]["layers"]
        periods.append(manifests.Period(layers, until - start, tracks[-1] if video else None, shared))
    files = _manifests(periods) | ({POSTER: poster} if poster else {})
    bases = [replace(file, file=row["file"]) for file, row in zip(index.bases, rows["bases"], strict=True)]
    parts = [replace(file, file=row["file"]) for file, row in zip(index.segments, rows["segments"], strict=True)]
    content = Index(tuple(bases), tuple(parts)).packed()
    shown = index.segments[0] if index.segments[0].base is None else index.bases[index.segments[0].base]
    first = read_file(place, shown)
    prefixes = [(len(content) + shown.bytes, decode(first))] if index.segments[0].base is not None else []
    files[PAGE] = page(SEGMENTS_INDEX, first, draw(begun, iter(prefixes)) if begun else None).encode()
    (low, high), size = index.time_range, sum(file.bytes for file in index.files)
    header = info(first) | {"time_range": [low, high]}
    layers = periods[0].base or periods[0].slices
    about = _index(SEGMENTS_INDEX, content, header, size, high - low, layers, POSTER if poster else None)
    yield from (files | {SEGMENTS_INDEX: content, INDEX: _json(about | rows)}).items()


def _manifests(periods: Sequence[manifests.Period]) -> dict[str, bytes]:
    """Returns the manifests of DASH and HLS by name."""
    videos = [period.video for period in periods if period.video]
    files = {MPD: manifests.dash(periods), PLAYLIST: manifests.hls(INDEX, next(iter(videos), None), VIDEO_PLAYLIST)}
    return files | ({VIDEO_PLAYLIST: manifests.hls_video(videos)} if videos else {})


def _index(
    file: str, content: bytes, about: dict[str, Any], size: int, seconds: float, layers: Any, poster: str | None
) -> dict[str, Any]:
    """Returns what the indices of files and of segments share. content: of the file that players fetch first. about:
    its `info`. size: bytes of all. layers: slices of the first file."""
    return {
        "file": file,
        "format_version": about["format_version"],
        "bytes": size,
        "sha256": hashlib.sha256(content).hexdigest(),
        "time_range": about["time_range"],
        "seconds": seconds,
        "layers": layers,
        "dash": MPD,
        "hls": PLAYLIST,
        "poster": poster,
        "first_frame_seconds": {name: 8 * layers[0]["range"][1] / rate for name, rate in RATES.items()},
    }


def addressed(name: str, content: bytes) -> str:
    """The name with the first 64 bits of the content's SHA-256: scene.pd4 -> scene-0123456789abcdef.pd4."""
    stem, dot, suffix = name.rpartition(".")
    return f"{stem}-{hashlib.sha256(content).hexdigest()[:16]}{dot}{suffix}"


def _segments(data: bytes, about: dict[str, Any], seconds: float) -> tuple[bytes, list[dict[str, Any]]]:
    """Returns (scene.mp4, slices as the index lists them). Chunks between slices belong to the slice after them.

    Byte ranges are [first, one past the last]; sha256: of the `.pd4` bytes.
    """
    rows = [(row["layer"], i, part["end"]) for row in about["layers"] for i, part in enumerate(row["slices"])]
    content = bytearray(manifests.initialisation(len(rows), manifests.ticks(seconds)))
    init, start, slices = len(content), 0, list[dict[str, Any]]()
    for number, (layer, place, end) in enumerate(rows, 1):
        part = data[start : len(data) if number == len(rows) else end]
        piece = manifests.fragment(number, number, part, manifests.ticks(seconds))
        row = {"layer": layer, "slice": place, "range": [start, start + len(part)]}
        row["sha256"] = hashlib.sha256(part).hexdigest()
        row["depends_on"] = sorted({before for before, *_ in rows[: number - 1]})
        row["dash"] = {"file": SEGMENTS, "init": [0, init], "range": [len(content), len(content) + len(piece)]}
        slices.append(row)
        content += piece
        start += len(part)
    return bytes(content), slices


def _json(content: dict[str, Any]) -> bytes:
    return (json.dumps(content, indent=1) + "\n").encode()


# -- the library -------------------------------------------------------------------------------------------------------

LIBRARY = "library.json"
LARGEST, LONGEST = 2**53, 200  #: largest number and longest text that a library copies from a package's index
STYLE = (
    "body{font:16px system-ui;margin:2rem;background:#111;color:#eee}"
    "main{display:grid;grid-template-columns:repeat(auto-fill,minmax(220px,1fr));gap:1rem}"
    "a{color:inherit;text-decoration:none}img,.none{width:100%;aspect-ratio:4/3;object-fit:cover;background:#333}"
    "small{color:#aaa}"
)


def library(folder: Path) -> dict[str, bytes]:
    """Returns name -> content of two files that list all packages below `folder`: a JSON index and a page of posters.

    Raises DeliveryError if there are no packages, or one has an invalid index.
    """
    scenes = list(_scenes(folder))
    if not scenes:
        raise DeliveryError(f"{folder}: found no packages, expected NAME/{INDEX} by pd4dgs-package")
    content = {"scenes": scenes, "bytes": sum(scene["bytes"] for scene in scenes)}
    return {LIBRARY: _json(content), PAGE: _library_page(scenes).encode()}


def _scenes(folder: Path) -> Iterator[dict[str, Any]]:
    for path in sorted(folder.rglob(INDEX)):
        if path.parent == folder or not path.is_file():
            continue
        try:
            yield _listed(path.parent.relative_to(folder).as_posix(), json.loads(path.read_bytes()))
        except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
            raise DeliveryError(f"{path}: invalid package index ({type(error).__name__}: {error})") from None


def _listed(name: str, about: Any) -> dict[str, Any]:
    """Returns a package's entry in the library. about: the package's index, which is not trusted."""
    base = quote(os.fsencode(name))
    layers = [{"layer": _number(part["layer"]), "end": _number(part["range"][1])} for part in about["layers"]]
    return {
        "name": printable(name, ""),
        "page": f"{base}/{PAGE}",
        "file": f"{base}/{quote(_text(about['file']), safe='')}",
        "poster": f"{base}/{quote(_text(about['poster']), safe='')}" if about["poster"] else None,
        "bytes": int(_number(about["bytes"])),
        **{field: _text(about[field]) for field in ("sha256", "format_version")},
        "seconds": _number(about["seconds"]),
        "first_frame_seconds": {_text(rate): _number(s) for rate, s in about["first_frame_seconds"].items()},
        "layers": layers,
    }


def _number(value: Any) -> Any:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 <= value <= LARGEST:
        raise TypeError(f"found {str(value)[:60]}, expected a number from 0")
    return value


def _text(value: Any) -> str:
    if not isinstance(value, str) or not value.isprintable() or not 0 < len(value) <= LONGEST:
        raise TypeError(f"found {str(value)[:60]!r}, expected a text of at most {LONGEST} characters")
    return value


def _library_page(scenes: list[dict[str, Any]]) -> str:
    cards = []
    for scene in scenes:
        poster = f'<img loading="lazy" alt="" src="{html.escape(scene["poster"])}">' if scene["poster"] else None
        first = ", ".join(f"{seconds:.1f} s at {rate}bps" for rate, seconds in scene["first_frame_seconds"].items())
        about = html.escape(f"{scene['bytes'] / 1e6:.2f} MB; first image after {first}")
        link = f'<a href="{html.escape(scene["page"])}">{poster or "<div class=none></div>"}'
        cards.append(f"{link}<br>{html.escape(scene['name'])}<br><small>{about}</small></a>")
    title, head = f"{len(scenes)} scenes", f'<!doctype html><html lang="en">{CHARSET}'
    head += f"<title>{title}</title><style>{STYLE}</style>\n<h1>{title}</h1>"
    return with_policy(f"{head}\n<main>\n" + "\n".join(cards) + "\n</main>\n", img="'self'")


# -- scenes to choose from ---------------------------------------------------------------------------------------------

CHOICE = "scenes.html"
_CHOICE_STYLE = (
    "body{margin:0;display:flex;height:100vh;font:16px system-ui;background:#111}iframe{flex:1;border:0}"
    "nav{overflow:auto}a{display:block;padding:.6rem 1rem;color:#eee;text-decoration:none}small{color:#aaa}"
    "a[aria-current]{background:#345}@media(max-width:40rem){body{flex-direction:column}nav{display:flex}}"
)
_CHOICE_SCRIPT = (
    'document.querySelector("nav").onclick=({target})=>{const chosen=target.closest("a");if(!chosen)return;'
    'for(const a of document.links)a.removeAttribute("aria-current");chosen.setAttribute("aria-current","true");}'
)


def player_of(address: str) -> str:
    """The player's page beside this one, with the scene at `address`."""
    return f"{PAGE}?src={quote(os.fsencode(address), safe='')}"


def choice_page(sizes: dict[str, int]) -> bytes:
    """A page that lists scenes beside it, name -> bytes, and shows the one chosen, at first the first."""
    links = [
        f'<a target="scene" href="{player_of(name)}"{" aria-current=true" if i == 0 else ""}>'
        f"{html.escape(printable(name, ''))}<br><small>{size / 1e3:,.0f} kB</small></a>"
        for i, (name, size) in enumerate(sizes.items())
    ]
    head = f'<!doctype html><html lang="en">{CHARSET}<title>{len(sizes)} scenes</title>'
    head += f'<meta name="viewport" content="width=device-width"><style>{_CHOICE_STYLE}</style>\n<nav>\n'
    frame = f'<iframe name="scene" title="The scene" allow="fullscreen" src="{player_of(next(iter(sizes)))}"></iframe>'
    text = head + "\n".join(links) + f"\n</nav>\n{frame}\n<script>{_CHOICE_SCRIPT}</script>\n"
    return with_policy(text, frame="'self'").encode()
