"""Writes DASH and HLS manifests of a package and the MP4 boxes that hold its slices.

DASH carries the layers: one AdaptationSet per slice, which names the slice before it; a slice needs all those before
it. That is a property of our own: players take a dependencyId for a part of the same set, and naming all slices each
time takes quadratic space. HLS has no dependent layers: its playlist plays the 2D video and links the JSON index, which
lists the layers.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from pd4dgs_codec.errors import DeliveryError
from pd4dgs_codec.web.headers import MEDIA_TYPES

TIMESCALE = 1000  #: ticks per second of every track
MAX_BOX = (1 << 32) - 1

_IDENTITY = struct.pack(">9I", 1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30)
_SYNC = 0x02000000  # the sample depends on no other of its track
_DEFAULT_BASE_IS_MOOF = 0x020000
_CONTAINERS = {b"moov", b"trak", b"mdia", b"minf", b"stbl", b"mvex", b"moof", b"traf"}

#: Of the properties of a set: its layer; the id of the Representation that holds the slice before.
LAYER_SCHEME, AFTER_SCHEME = "urn:pd4dgs:layer:2026", "urn:pd4dgs:after:2026"
SESSION_DATA_ID = "org.pd4dgs.layers"
MIN_BUFFER_SECONDS = 1  #: time in which each bandwidth delivers the file up to the slice's end
MAX_SECONDS = ((1 << 32) - 1) // TIMESCALE  #: the duration of a sample has 32 bits


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
class Track:
    """A `Video` as manifests list it. init: bytes before the first fragment. rate: bits per second of the fragment with
    the most."""

    name: str
    width: int
    height: int
    fps: float
    init: int
    pieces: list[Fragment]
    codec: str
    rate: int

    @staticmethod
    def of(name: str, video: Video) -> Track:
        """Lists the video in the file `name`. Raises DeliveryError unless it is fragmented H.264."""
        init, pieces = fragments(video.data)
        rate = math.ceil(max(8 * (piece.end - piece.start) * video.fps / piece.samples for piece in pieces))
        codec = _codec(video.data[:init])
        return Track(name, video.width, video.height, video.fps, init, pieces, codec, rate)


@dataclass(frozen=True)
class Period:
    """A part of a presentation. slices: `layers` of its file in the package's index; base: of the file whose layer 0 it
    continues. video: its 2D rendition."""

    slices: list[dict[str, Any]]
    seconds: float
    video: Track | None = None
    base: Sequence[dict[str, Any]] = ()


def dash(periods: Sequence[Period]) -> bytes:
    """Returns the DASH MPD. Periods with the same base have the same AdaptationSets for it, by their ids."""
    root = Element("MPD", xmlns="urn:mpeg:dash:schema:mpd:2011", profiles="urn:mpeg:dash:profile:full:2011")
    total = sum(period.seconds for period in periods)
    root.attrib |= {"type": "static", "mediaPresentationDuration": _duration(total)}
    root.set("minBufferTime", _duration(MIN_BUFFER_SECONDS))
    start, shared = 0.0, dict[str, int]()
    for i, part in enumerate(periods):
        period = SubElement(root, "Period", id=str(i), start=_duration(start))
        start += part.seconds
        if part.video is not None:
            _video_set(period, part.video)
        before = ""
        for row in part.base:
            number = shared.setdefault(f"{row['dash']['file']} {row['slice']}", len(shared) + 1)
            before = _slice_set(period, row, part.seconds, before, "B", {"id": str(number)})
        for row in part.slices:
            before = _slice_set(period, row, part.seconds, before, "L", {})
    indent(root)
    text: bytes = tostring(root, encoding="utf-8", xml_declaration=True)
    return text + b"\n"


def _slice_set(
    period: Element, row: dict[str, Any], seconds: float, before: str, letter: str, more: dict[str, str]
) -> str:
    """Adds the set of a slice, which needs the Representation `before`; returns the id of its own."""
    where = row["dash"]
    kind = more | {"contentType": "application", "mimeType": "application/mp4", "codecs": "mett"}
    group = SubElement(period, "AdaptationSet", kind)
    SubElement(group, "SupplementalProperty", schemeIdUri=LAYER_SCHEME, value=str(row["layer"]))
    if before:
        SubElement(group, "SupplementalProperty", schemeIdUri=AFTER_SCHEME, value=before)
    bandwidth = min(math.ceil(8 * where["range"][1] / MIN_BUFFER_SECONDS), (1 << 32) - 1)
    name = f"{letter}{row['layer']}.{row['slice']}" if row["slice"] else f"{letter}{row['layer']}"
    representation = SubElement(group, "Representation", id=name, bandwidth=str(bandwidth))
    _segment_list(representation, where["file"], where["init"][1], seconds, [where["range"]])
    return name


def _video_set(period: Element, video: Track) -> None:
    kind = {"contentType": "video", "mimeType": "video/mp4", "segmentAlignment": "true", "startWithSAP": "1"}
    representation = SubElement(
        SubElement(period, "AdaptationSet", kind),
        "Representation",
        id="video",
        bandwidth=str(video.rate),
        codecs=video.codec,
        width=str(video.width),
        height=str(video.height),
        frameRate=f"{round(video.fps * 1000)}/1000",
    )
    seconds = max(piece.samples for piece in video.pieces) / video.fps
    ranges = [(piece.start, piece.end) for piece in video.pieces]
    _segment_list(representation, video.name, video.init, seconds, ranges)


def _segment_list(parent: Element, url: str, init: int, seconds: float, ranges: Iterable[tuple[int, int]]) -> None:
    """Adds a SegmentList. ranges: bytes of segments that last `seconds` each, ends exclusive."""
    SubElement(parent, "BaseURL").text = url
    segments = SubElement(parent, "SegmentList", timescale=str(TIMESCALE), duration=str(ticks(seconds)))
    SubElement(segments, "Initialization", range=f"0-{init - 1}")
    for start, end in ranges:
        SubElement(segments, "SegmentURL", mediaRange=f"{start}-{end - 1}")


def _duration(seconds: float) -> str:
    return f"PT{seconds:.3f}".rstrip("0").rstrip(".") + "S"


def hls(index: str, video: Track | None, playlist: str) -> bytes:
    """Returns the multivariant HLS playlist. index: name of the JSON index. playlist: media playlist of `video`."""
    lines = ["#EXTM3U", "#EXT-X-VERSION:7", f'#EXT-X-SESSION-DATA:DATA-ID="{SESSION_DATA_ID}",URI="{index}"']
    if video is not None:
        stream = f'BANDWIDTH={video.rate},CODECS="{video.codec}",'
        stream += f"RESOLUTION={video.width}x{video.height},FRAME-RATE={video.fps:.3f}"
        lines += ["#EXT-X-INDEPENDENT-SEGMENTS", f"#EXT-X-STREAM-INF:{stream}", playlist]
    return ("\n".join(lines) + "\n").encode()


def hls_video(videos: Sequence[Track]) -> bytes:
    """Returns the HLS media playlist of the 2D rendition, with a discontinuity between two of its files."""
    lines, longest = list[str](), 1.0
    for video in videos:
        lines += ["#EXT-X-DISCONTINUITY"] if lines else []
        lines.append(f'#EXT-X-MAP:URI="{video.name}",BYTERANGE="{video.init}@0"')
        for piece in video.pieces:
            length = piece.samples / video.fps
            longest = max(longest, length)
            where = f"#EXT-X-BYTERANGE:{piece.end - piece.start}@{piece.start}"
            lines += [f"#EXTINF:{length:.6f},", where, video.name]
    head = ["#EXTM3U", "#EXT-X-VERSION:7", "#EXT-X-PLAYLIST-TYPE:VOD", "#EXT-X-INDEPENDENT-SEGMENTS"]
    head.append(f"#EXT-X-TARGETDURATION:{math.ceil(longest)}")
    return ("\n".join([*head, *lines, "#EXT-X-ENDLIST"]) + "\n").encode()


def _codec(init: bytes) -> str:
    """`avc1.PPCCLL`: profile, constraints and level from the AVC configuration box."""
    at = init.find(b"avcC")
    if at < 0 or at + 8 > len(init):
        raise DeliveryError("the 2D video is not H.264, expected an avcC box")
    return f"avc1.{init[at + 5 : at + 8].hex()}"


# -- MP4 (ISO/IEC 14496-12): writes a track of one fragment per slice, and finds the fragments of other files ----------


def ticks(seconds: float) -> int:
    """A duration in units of TIMESCALE, at least 1."""
    return max(1, round(seconds * TIMESCALE))


def box(kind: bytes, *parts: bytes) -> bytes:
    """Returns one box. Raises DeliveryError if its size exceeds 32 bits."""
    size = 8 + sum(map(len, parts))
    if size > MAX_BOX:
        raise DeliveryError(f"found a layer of {size:,} bytes, expected at most {MAX_BOX:,} in an MP4 box")
    return struct.pack(">I4s", size, kind) + b"".join(parts)


def _full(kind: bytes, version: int, flags: int, *parts: bytes) -> bytes:
    return box(kind, struct.pack(">I", version << 24 | flags), *parts)


def initialisation(tracks: int, ticks: int) -> bytes:
    """Returns `ftyp` and `moov` of `tracks` metadata tracks with ids from 1 that last `ticks` (32 bits) each."""
    times = struct.pack(">QQIQ", 0, 0, TIMESCALE, ticks)
    rate_volume = struct.pack(">IH10x", 1 << 16, 1 << 8)
    header = _full(b"mvhd", 1, 0, times, rate_volume, _IDENTITY, bytes(24), struct.pack(">I", tracks + 1))
    traks = [_track(number, ticks) for number in range(1, tracks + 1)]
    extends = [_full(b"trex", 0, 0, struct.pack(">5I", n, 1, ticks, 0, _SYNC)) for n in range(1, tracks + 1)]
    brands = struct.pack(">4sI4s4s", b"iso6", 0, b"iso6", b"dash")
    return box(b"ftyp", brands) + box(b"moov", header, *traks, box(b"mvex", *extends))


def _track(number: int, ticks: int) -> bytes:
    enabled_in_movie = 3
    place = struct.pack(">QQIIQ8xHHHH", 0, 0, number, 0, ticks, 0, 0, 0, 0)
    head = _full(b"tkhd", 1, enabled_in_movie, place, _IDENTITY, bytes(8))
    undetermined = sum((ord(c) - 0x60) << shift for c, shift in zip("und", (10, 5, 0), strict=True))
    media = _full(b"mdhd", 1, 0, struct.pack(">QQIQHH", 0, 0, TIMESCALE, ticks, undetermined, 0))
    handler = _full(b"hdlr", 0, 0, struct.pack(">I4s12x", 0, b"meta"), f"layer {number - 1}\0".encode())
    here = _full(b"url ", 0, 1)
    data = box(b"dinf", _full(b"dref", 0, 0, struct.pack(">I", 1), here))
    entry = box(b"mett", struct.pack(">6xH", 1), b"\0", MEDIA_TYPES[".pd4"].encode() + b"\0")
    none = struct.pack(">I", 0)
    table = box(
        b"stbl",
        _full(b"stsd", 0, 0, struct.pack(">I", 1), entry),
        *(_full(kind, 0, 0, none) for kind in (b"stts", b"stsc")),
        _full(b"stsz", 0, 0, none, none),
        _full(b"stco", 0, 0, none),
    )
    return box(b"trak", head, box(b"mdia", media, handler, box(b"minf", _full(b"nmhd", 0, 0), data, table)))


def fragment(number: int, track: int, payload: bytes, ticks: int) -> bytes:
    """Returns `moof` and `mdat` of one sample that lasts from 0 to `ticks`. number: of the fragment in the file."""

    def moof(data_offset: int) -> bytes:
        run_flags = 0x000301  # data offset, and each sample's duration and size
        return box(
            b"moof",
            _full(b"mfhd", 0, 0, struct.pack(">I", number)),
            box(
                b"traf",
                _full(b"tfhd", 0, _DEFAULT_BASE_IS_MOOF, struct.pack(">I", track)),
                _full(b"tfdt", 1, 0, struct.pack(">Q", 0)),
                _full(b"trun", 0, run_flags, struct.pack(">IiII", 1, data_offset, ticks, len(payload))),
            ),
        )

    return moof(len(moof(0)) + 8) + box(b"mdat", payload)


class Box(NamedTuple):
    """An MP4 box: its kind and the offsets of its first byte, its content and its end (exclusive)."""

    kind: bytes
    start: int
    content: int
    end: int


def boxes(data: bytes, start: int = 0, end: int | None = None) -> Iterator[Box]:
    """Yields the boxes in data[start:end] in order. Raises DeliveryError if they do not fill it."""
    end = len(data) if end is None else end
    while start < end:
        size, kind = struct.unpack_from(">I4s", data, start) if end - start >= 8 else (0, b"")
        content = start + 8
        if size == 1 and end - start >= 16:
            (size,), content = struct.unpack_from(">Q", data, content), content + 8
        if size < content - start or start + size > end:
            raise DeliveryError(f"found an MP4 box of {size} bytes at byte {start}, expected at most {end - start}")
        yield Box(kind, start, content, start + size)
        start += size


def find(data: bytes, kind: bytes, inside: Sequence[Box]) -> Iterator[Box]:
    """Yields all boxes of a kind inside the boxes `inside`, at any depth."""
    for parent in inside:
        for child in boxes(data, parent.content, parent.end):
            if child.kind == kind:
                yield child
            elif child.kind in _CONTAINERS:
                yield from find(data, kind, [child])


class Fragment(NamedTuple):
    """Offsets of a `moof` and the `mdat` after it, and their number of samples."""

    start: int
    end: int
    samples: int


def fragments(data: bytes) -> tuple[int, list[Fragment]]:
    """Returns (bytes before the first fragment, fragments) of an MP4 file. Raises DeliveryError if it has none."""
    top = list(boxes(data))
    result = []
    for moof, mdat in zip(top, top[1:], strict=False):
        if (moof.kind, mdat.kind) == (b"moof", b"mdat"):
            runs = find(data, b"trun", [moof])
            samples = sum(struct.unpack_from(">I", data, run.content + 4)[0] for run in runs)
            result.append(Fragment(moof.start, mdat.end, samples))
    if not result:
        raise DeliveryError("found no fragments in an MP4 file, expected some")
    return result[0].start, result
