"""DASH and HLS manifests of a package.

DASH carries the layers: one AdaptationSet per slice, whose Representation names the slices that it depends on. HLS has
no dependent layers: its playlist shows the 2D video and refers to the JSON index, which tells where the layers are.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass

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


@dataclass(frozen=True)
class Part:
    """A slice. start, end: bytes of the `.pd4`; segment: bytes of the MP4 file; ends are exclusive."""

    layer: int
    slice: int
    start: int
    end: int
    segment: tuple[int, int]

    @property
    def id(self) -> str:
        """Of its Representation: L0 for layer 0, L0.1 for its second slice."""
        return f"L{self.layer}.{self.slice}" if self.slice else f"L{self.layer}"


def dash(
    init: int, parts: list[Part], seconds: float, segments: str, video: Video | None = None, video_name: str = ""
) -> bytes:
    """The MPD. init: bytes of the MP4 file `segments` before its first fragment. video, video_name: the 2D rendition
    and its file."""
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
        _video_set(period, video, video_name)
    ticks = max(1, round(seconds * mp4.TIMESCALE))
    for i, part in enumerate(parts):
        group = ElementTree.SubElement(
            period, "AdaptationSet", contentType="application", mimeType="application/mp4", codecs="mett"
        )
        ElementTree.SubElement(group, "SupplementalProperty", schemeIdUri=LAYER_SCHEME, value=str(part.layer))
        bandwidth = min(math.ceil(8 * part.segment[1] / MIN_BUFFER_SECONDS), (1 << 32) - 1)
        representation = ElementTree.SubElement(group, "Representation", id=part.id, bandwidth=str(bandwidth))
        if i:
            representation.set("dependencyId", " ".join(before.id for before in parts[:i]))
        _segment_list(representation, segments, init, mp4.TIMESCALE, ticks, [part.segment])
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


def hls(index: str, video: Video | None = None, playlist: str = "") -> bytes:
    """The multivariant playlist. index: the JSON index. video, playlist: the 2D rendition and its media playlist."""
    lines = ["#EXTM3U", "#EXT-X-VERSION:7", f'#EXT-X-SESSION-DATA:DATA-ID="{SESSION_DATA_ID}",URI="{index}"']
    if video is not None:
        init, _ = mp4.fragments(video.data)
        lines.append("#EXT-X-INDEPENDENT-SEGMENTS")
        lines.append(
            f'#EXT-X-STREAM-INF:BANDWIDTH={_peak_rate(video)},CODECS="{_codec(video.data[:init])}",'
            f"RESOLUTION={video.width}x{video.height},FRAME-RATE={video.fps:.3f}"
        )
        lines.append(playlist)
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


def _peak_rate(video: Video) -> int:
    """Bits per second of the fragment with the highest rate."""
    _, pieces = mp4.fragments(video.data)
    return math.ceil(max(8 * (piece.end - piece.start) * video.fps / piece.samples for piece in pieces))


def _codec(init: bytes) -> str:
    """`avc1.PPCCLL`: profile, constraints and level from the AVC configuration box."""
    at = init.find(b"avcC")
    if at < 0 or at + 8 > len(init):
        raise DeliveryError("the 2D video is not H.264, expected an avcC box")
    return f"avc1.{init[at + 5 : at + 8].hex()}"
