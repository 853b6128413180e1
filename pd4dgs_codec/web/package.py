"""A `.pd4` file as a folder for any web server: a page that plays it, DASH, HLS and a JSON index beside it.

DASH carries the layers themselves: `scene.mp4` holds each slice in a fragment of its own, and the manifest names the
fragments with their dependencies. Concatenated, the samples are the `.pd4` file again. HLS has no layers that depend on
each other: its playlist shows the 2D video and points to the index, which says where the layers lie in `scene.pd4`.
"""

from __future__ import annotations

import hashlib
import json
import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from pd4dgs_codec.errors import DeliveryError
from pd4dgs_codec.format.decoder import decode
from pd4dgs_codec.format.info import info
from pd4dgs_codec.scene import Scene
from pd4dgs_codec.web import mp4
from pd4dgs_codec.web.names import addressed, cache_control
from pd4dgs_codec.web.page import PAGE, page

SCENE, SEGMENTS, MPD, PLAYLIST, INDEX = "scene.pd4", "scene.mp4", "scene.mpd", "scene.m3u8", "index.json"
VIDEO, VIDEO_PLAYLIST, POSTER = "fallback.mp4", "fallback.m3u8", "poster.jpg"
#: Link rates, bits per second, for which the index tells when the first picture is there.
RATES = {"2M": 2e6, "10M": 1e7, "50M": 5e7}
LAYER_SCHEME = "urn:pd4dgs:layer:2026"
SESSION_DATA_ID = "org.pd4dgs.layers"
MIN_BUFFER_SECONDS = 1  #: the time that the manifest's bandwidths are for
STILL_SECONDS = 1.0  #: shown for a scene whose time stands still
MAX_SECONDS = ((1 << 32) - 1) // mp4.TIMESCALE  #: a sample's duration has 32 bits


@dataclass(frozen=True)
class Video:
    """A 2D rendition of the scene: fragmented MP4 of H.264. width, height: pixels. fps: frames per second. poster: a
    JPEG of a frame, if there is one."""

    data: bytes
    width: int
    height: int
    fps: float
    poster: bytes = b""


@dataclass(frozen=True)
class Part:
    """A slice's share of the file: start..end, bytes of the `.pd4`; segment: its bytes in scene.mp4, end exclusive."""

    layer: int
    slice: int
    start: int
    end: int
    segment: tuple[int, int]

    @property
    def id(self) -> str:
        """Of its representation: L0 for layer 0, L0.1 for its second slice."""
        return f"L{self.layer}.{self.slice}" if self.slice else f"L{self.layer}"


def package(
    data: bytes, render: Callable[[Scene], Video | None] | None = None, *, immutable: bool = False
) -> dict[str, bytes]:
    """Name -> content of every file of the folder.

    render: makes the 2D rendition of the decoded scene, if it can. immutable: files that others name carry the digest
    of their content in their names, so that caches may keep them forever. Raises DecodeError unless `data` is a whole,
    valid `.pd4` file, DeliveryError for one too long or large to wrap, both before anything is rendered.
    """
    scene = decode(data)
    low, high = info(data)["time_range"]
    seconds = high - low if high > low else STILL_SECONDS
    if seconds > MAX_SECONDS:
        raise DeliveryError(f"the scene lasts {seconds:g} s, DASH takes at most {MAX_SECONDS:,}")
    segments, init, parts = _segments(data, seconds)
    video = render(scene) if render is not None else None
    media = {SCENE: data, SEGMENTS: segments}
    if video is not None:
        media |= {VIDEO: video.data} | ({POSTER: video.poster} if video.poster else {})
    names = {name: addressed(name, content) if immutable else name for name, content in media.items()}
    files = {names[name]: content for name, content in media.items()}
    files[MPD] = _manifest(init, parts, seconds, video, names)
    if video is not None:
        files[VIDEO_PLAYLIST] = _video_playlist(video, names[VIDEO])
    files[PLAYLIST] = _playlist(video)
    files[PAGE] = (page(names[SCENE]) if immutable else page()).encode()
    cache = {name: cache_control(name) for name in (*files, INDEX)}
    files[INDEX] = _index(data, init, parts, seconds, video, names, cache)
    return files


def _segments(data: bytes, seconds: float) -> tuple[bytes, int, list[Part]]:
    """(scene.mp4, bytes of its initialisation, parts). What stands between slices travels with the slice after it."""
    rows = [
        (layer["layer"], number, part["end"])
        for layer in info(data)["layers"]
        for number, part in enumerate(layer["slices"])
    ]
    ticks = max(1, round(seconds * mp4.TIMESCALE))
    content = mp4.initialisation(len(rows), ticks)
    init, start, parts = len(content), 0, []
    for number, (layer, place, end) in enumerate(rows, 1):
        end = len(data) if number == len(rows) else end
        piece = mp4.fragment(number, number, data[start:end], ticks)
        parts.append(Part(layer, place, start, end, (len(content), len(content) + len(piece))))
        content += piece
        start = end
    return content, init, parts


# -- DASH --------------------------------------------------------------------------------------------------------------


def _manifest(init: int, parts: list[Part], seconds: float, video: Video | None, names: dict[str, str]) -> bytes:
    root = ElementTree.Element(
        "MPD",
        {
            "xmlns": "urn:mpeg:dash:schema:mpd:2011",
            "profiles": "urn:mpeg:dash:profile:full:2011",
            "type": "static",
            "mediaPresentationDuration": _duration(seconds),
            "minBufferTime": _duration(MIN_BUFFER_SECONDS),
        },
    )
    period = ElementTree.SubElement(root, "Period", id="0", start="PT0S")
    if video is not None:
        _video_set(period, video, names[VIDEO])
    for i, part in enumerate(parts):
        group = ElementTree.SubElement(
            period, "AdaptationSet", contentType="application", mimeType="application/mp4", codecs="mett"
        )
        ElementTree.SubElement(group, "SupplementalProperty", schemeIdUri=LAYER_SCHEME, value=str(part.layer))
        bandwidth = math.ceil(8 * part.segment[1] / MIN_BUFFER_SECONDS)
        representation = ElementTree.SubElement(
            group, "Representation", id=part.id, bandwidth=str(min(bandwidth, (1 << 32) - 1))
        )
        if i:
            representation.set("dependencyId", " ".join(before.id for before in parts[:i]))
        whole = max(1, round(seconds * mp4.TIMESCALE))
        _segment_list(representation, names[SEGMENTS], init, mp4.TIMESCALE, whole, [part.segment])
    ElementTree.indent(root)
    text: bytes = ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)
    return text + b"\n"


def _video_set(period: ElementTree.Element, video: Video, name: str) -> None:
    init, pieces = mp4.fragments(video.data)
    group = ElementTree.SubElement(
        period, "AdaptationSet", contentType="video", mimeType="video/mp4", segmentAlignment="true", startWithSAP="1"
    )
    representation = ElementTree.SubElement(
        group,
        "Representation",
        id="video",
        bandwidth=str(_peak_rate(video)),
        codecs=_codec(video.data[:init]),
        width=str(video.width),
        height=str(video.height),
        frameRate=f"{round(video.fps * 1000)}/1000",
    )
    ticks = round(1000 * max(piece.samples for piece in pieces) / video.fps)
    _segment_list(representation, name, init, 1000, ticks, [(piece.start, piece.end) for piece in pieces])


def _segment_list(
    parent: ElementTree.Element, url: str, init: int, timescale: int, ticks: int, ranges: list[tuple[int, int]]
) -> None:
    ElementTree.SubElement(parent, "BaseURL").text = url
    segments = ElementTree.SubElement(parent, "SegmentList", timescale=str(timescale), duration=str(ticks))
    ElementTree.SubElement(segments, "Initialization", range=f"0-{init - 1}")
    for start, end in ranges:
        ElementTree.SubElement(segments, "SegmentURL", mediaRange=f"{start}-{end - 1}")


def _duration(seconds: float) -> str:
    return f"PT{seconds:.3f}".rstrip("0").rstrip(".") + "S"


# -- HLS ---------------------------------------------------------------------------------------------------------------


def _playlist(video: Video | None) -> bytes:
    lines = ["#EXTM3U", "#EXT-X-VERSION:7"]
    lines.append(f'#EXT-X-SESSION-DATA:DATA-ID="{SESSION_DATA_ID}",URI="{INDEX}"')
    if video is not None:
        init, _ = mp4.fragments(video.data)
        lines.append("#EXT-X-INDEPENDENT-SEGMENTS")
        lines.append(
            f'#EXT-X-STREAM-INF:BANDWIDTH={_peak_rate(video)},CODECS="{_codec(video.data[:init])}",'
            f"RESOLUTION={video.width}x{video.height},FRAME-RATE={video.fps:.3f}"
        )
        lines.append(VIDEO_PLAYLIST)
    return ("\n".join(lines) + "\n").encode()


def _video_playlist(video: Video, name: str) -> bytes:
    init, pieces = mp4.fragments(video.data)
    seconds = [piece.samples / video.fps for piece in pieces]
    lines = ["#EXTM3U", "#EXT-X-VERSION:7", "#EXT-X-PLAYLIST-TYPE:VOD", "#EXT-X-INDEPENDENT-SEGMENTS"]
    lines.append(f"#EXT-X-TARGETDURATION:{max(1, math.ceil(max(seconds)))}")
    lines.append(f'#EXT-X-MAP:URI="{name}",BYTERANGE="{init}@0"')
    for piece, length in zip(pieces, seconds, strict=True):
        lines += [f"#EXTINF:{length:.6f},", f"#EXT-X-BYTERANGE:{piece.end - piece.start}@{piece.start}", name]
    return ("\n".join([*lines, "#EXT-X-ENDLIST"]) + "\n").encode()


def _peak_rate(video: Video) -> int:
    """Bits per second of the video's dearest fragment."""
    _, pieces = mp4.fragments(video.data)
    return math.ceil(max(8 * (piece.end - piece.start) * video.fps / piece.samples for piece in pieces))


def _codec(init: bytes) -> str:
    """`avc1.PPCCLL`: profile, constraints and level as the AVC configuration box has them."""
    at = init.find(b"avcC")
    if at < 0 or at + 8 > len(init):
        raise DeliveryError("the 2D video is not H.264, expected an avcC box")
    return f"avc1.{init[at + 5 : at + 8].hex()}"


# -- the index ---------------------------------------------------------------------------------------------------------


def _index(
    data: bytes,
    init: int,
    parts: list[Part],
    seconds: float,
    video: Video | None,
    names: dict[str, str],
    cache: dict[str, str],
) -> bytes:
    """Where everything is. Byte ranges are [first, one past the last]; sha256 are of the `.pd4` file's bytes."""
    about = info(data)
    layers = [
        {
            "layer": part.layer,
            "slice": part.slice,
            "range": [part.start, part.end],
            "sha256": hashlib.sha256(data[part.start : part.end]).hexdigest(),
            "depends_on": sorted({before.layer for before in parts[:i]}),
            "dash": {"file": names[SEGMENTS], "init": [0, init], "range": list(part.segment)},
        }
        for i, part in enumerate(parts)
    ]
    content: dict[str, Any] = {
        "file": names[SCENE],
        "format_version": about["format_version"],
        "bytes": len(data),
        "sha256": hashlib.sha256(data).hexdigest(),
        "time_range": about["time_range"],
        "seconds": seconds,
        "layers": layers,
        "dash": MPD,
        "hls": PLAYLIST,
        "video": None,
        "poster": names.get(POSTER),
        "first_frame_seconds": {name: 8 * parts[0].end / rate for name, rate in RATES.items()},
        "cache_control": cache,
    }
    if video is not None:
        content["video"] = {"file": names[VIDEO], "width": video.width, "height": video.height, "fps": video.fps}
    return (json.dumps(content, indent=1) + "\n").encode()
