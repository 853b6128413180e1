"""DASH and HLS manifests of a package.

DASH carries the layers: one AdaptationSet per slice, whose Representation names the slices that it depends on. HLS has
no dependent layers: its playlist shows the 2D video and refers to the JSON index, which tells where the layers are.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from pd4dgs_codec.errors import DeliveryError
from pd4dgs_codec.web import mp4

LAYER_SCHEME = "urn:pd4dgs:layer:2026"
SESSION_DATA_ID = "org.pd4dgs.layers"
MIN_BUFFER_SECONDS = 1  #: the time in which each bandwidth delivers its layers
MAX_SECONDS = ((1 << 32) - 1) // mp4.TIMESCALE  #: the duration of a sample has 32 bits


@dataclass(frozen=True)
class Video:
    """A 2D rendition of the scene: fragmented MP4 of H.264. width, height: pixels. fps: frames per second. poster: a
    JPEG of a frame, or empty."""

    data: bytes
    width: int
    height: int
    fps: float
    poster: bytes = b""


def dash(slices: list[dict[str, Any]], seconds: float, video: Video | None = None, video_name: str = "") -> bytes:
    """The MPD. slices: as the index of the package lists them. video, video_name: the 2D rendition and its file."""
    root = Element("MPD", xmlns="urn:mpeg:dash:schema:mpd:2011", profiles="urn:mpeg:dash:profile:full:2011")
    root.attrib |= {"type": "static", "mediaPresentationDuration": _duration(seconds)}
    root.set("minBufferTime", _duration(MIN_BUFFER_SECONDS))
    period = SubElement(root, "Period", id="0", start="PT0S")
    if video is not None:
        _video_set(period, video, video_name)
    ids: list[str] = []
    for row in slices:
        where = row["dash"]
        group = SubElement(
            period, "AdaptationSet", contentType="application", mimeType="application/mp4", codecs="mett"
        )
        SubElement(group, "SupplementalProperty", schemeIdUri=LAYER_SCHEME, value=str(row["layer"]))
        bandwidth = min(math.ceil(8 * where["range"][1] / MIN_BUFFER_SECONDS), (1 << 32) - 1)
        name = f"L{row['layer']}.{row['slice']}" if row["slice"] else f"L{row['layer']}"
        representation = SubElement(group, "Representation", id=name, bandwidth=str(bandwidth))
        if ids:
            representation.set("dependencyId", " ".join(ids))
        _segment_list(representation, where["file"], where["init"][1], seconds, [where["range"]])
        ids.append(name)
    indent(root)
    text: bytes = tostring(root, encoding="utf-8", xml_declaration=True)
    return text + b"\n"


def _video_set(period: Element, video: Video, name: str) -> None:
    init, pieces = mp4.fragments(video.data)
    kind = {"contentType": "video", "mimeType": "video/mp4", "segmentAlignment": "true", "startWithSAP": "1"}
    representation = SubElement(
        SubElement(period, "AdaptationSet", kind),
        "Representation",
        id="video",
        bandwidth=str(_peak_rate(video, pieces)),
        codecs=_codec(video.data[:init]),
        width=str(video.width),
        height=str(video.height),
        frameRate=f"{round(video.fps * 1000)}/1000",
    )
    seconds = max(piece.samples for piece in pieces) / video.fps
    _segment_list(representation, name, init, seconds, [(piece.start, piece.end) for piece in pieces])


def _segment_list(parent: Element, url: str, init: int, seconds: float, ranges: Iterable[tuple[int, int]]) -> None:
    """ranges: bytes of segments that last `seconds` each, ends exclusive."""
    SubElement(parent, "BaseURL").text = url
    segments = SubElement(parent, "SegmentList", timescale=str(mp4.TIMESCALE), duration=str(mp4.ticks(seconds)))
    SubElement(segments, "Initialization", range=f"0-{init - 1}")
    for start, end in ranges:
        SubElement(segments, "SegmentURL", mediaRange=f"{start}-{end - 1}")


def _duration(seconds: float) -> str:
    return f"PT{seconds:.3f}".rstrip("0").rstrip(".") + "S"


def hls(index: str, video: Video | None = None, playlist: str = "") -> bytes:
    """The multivariant playlist. index: the JSON index. video, playlist: the 2D rendition and its media playlist."""
    lines = ["#EXTM3U", "#EXT-X-VERSION:7", f'#EXT-X-SESSION-DATA:DATA-ID="{SESSION_DATA_ID}",URI="{index}"']
    if video is not None:
        init, pieces = mp4.fragments(video.data)
        stream = f'BANDWIDTH={_peak_rate(video, pieces)},CODECS="{_codec(video.data[:init])}",'
        stream += f"RESOLUTION={video.width}x{video.height},FRAME-RATE={video.fps:.3f}"
        lines += ["#EXT-X-INDEPENDENT-SEGMENTS", f"#EXT-X-STREAM-INF:{stream}", playlist]
    return ("\n".join(lines) + "\n").encode()


def hls_video(video: Video, name: str) -> bytes:
    """The media playlist of the 2D rendition, whose file is `name`."""
    init, pieces = mp4.fragments(video.data)
    seconds = [piece.samples / video.fps for piece in pieces]
    lines = ["#EXTM3U", "#EXT-X-VERSION:7", "#EXT-X-PLAYLIST-TYPE:VOD", "#EXT-X-INDEPENDENT-SEGMENTS"]
    lines.append(f"#EXT-X-TARGETDURATION:{max(1, math.ceil(max(seconds)))}")
    lines.append(f'#EXT-X-MAP:URI="{name}",BYTERANGE="{init}@0"')
    for piece, length in zip(pieces, seconds, strict=True):
        lines += [f"#EXTINF:{length:.6f},", f"#EXT-X-BYTERANGE:{piece.end - piece.start}@{piece.start}", name]
    return ("\n".join([*lines, "#EXT-X-ENDLIST"]) + "\n").encode()


def _peak_rate(video: Video, pieces: list[mp4.Fragment]) -> int:
    """Bits per second of the fragment with the highest rate."""
    return math.ceil(max(8 * (piece.end - piece.start) * video.fps / piece.samples for piece in pieces))


def _codec(init: bytes) -> str:
    """`avc1.PPCCLL`: profile, constraints and level from the AVC configuration box."""
    at = init.find(b"avcC")
    if at < 0 or at + 8 > len(init):
        raise DeliveryError("the 2D video is not H.264, expected an avcC box")
    return f"avc1.{init[at + 5 : at + 8].hex()}"
