"""What other coders make of the same data: a file's symbols, its positions, and its splats at one instant.

Every peer decodes what it wrote and is compared with what it was given. A peer that is not installed, or that cannot
hold the data, says so in a word instead of a figure.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from pages.draco import draco_encode
from pd4dgs_codec.bench.pictures import draw_all, view
from pd4dgs_codec.bench.report import markdown
from pd4dgs_codec.bench.timing import Timing, measure
from pd4dgs_codec.entropy.bits import gaussian_bits
from pd4dgs_codec.entropy.channels import decode_channels, encode_channels
from pd4dgs_codec.entropy.lzma_mode import decode_channels_lzma, encode_channels_lzma
from pd4dgs_codec.entropy.positions import decode_positions, encode_positions
from pd4dgs_codec.errors import Pd4Error
from pd4dgs_codec.format.attribute_section import read_attributes, write_attributes
from pd4dgs_codec.format.layer_meta import Section
from pd4dgs_codec.format.payload import GROUPS, channel_groups
from pd4dgs_codec.format.plane_choice import choose_predictor
from pd4dgs_codec.format.plane_section import read_planes, write_planes
from pd4dgs_codec.format.symbols import LayerSymbols
from pd4dgs_codec.interchange.formats import quiet
from pd4dgs_codec.quality.frames import Frame
from pd4dgs_codec.quality.levels import Level

#: What peers are made of.
PACKAGES = ("zstandard", "torchac", "DracoPy", "gaussforge", "fourdgs")
#: Bytes that a Gaussian peer needs per channel for what its decoder must know: mean, deviation, least, largest symbol.
GAUSS_PARAMETERS = 16
#: The least standard deviation, in steps, as in R(a).
LEAST_SIGMA = 2.0**-10
#: Entries of torchac's table of a cumulative distribution per symbol; longer channels go in pieces.
TORCHAC_ENTRIES = 1 << 24
#: Degree-0 spherical harmonic, by which PLY files of splats store colour.
_SH0 = 0.28209479177387814
#: What SPZ can hold, in its units: coordinates have 11 bits before the point and 12 behind, scales end at exp(5.9).
_SPZ_EXTENT, _SPZ_SCALE = 1024.0, 256.0


@dataclass(frozen=True)
class Row:
    """One coder on one kind of data. error: 0 where the data came back as they were, in pictures' RMSE for splats.
    missing: why there are no figures."""

    what: str
    coder: str
    bytes: int | None = None
    encode: Timing | None = None
    decode: Timing | None = None
    error: float | None = None
    missing: str | None = None


# -- symbols -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Symbols:
    """The coded integers of a file's layers: masks, attributes, residuals of planes, weights; positions aside."""

    layers: tuple[LayerSymbols, ...]
    planes: tuple[list[np.ndarray], ...]  #: per layer, residuals int32 [C, H, W] of each plane
    groups: tuple[dict[Section, list[np.ndarray]], ...]  #: per layer, the 1-D channels of each section

    @property
    def channels(self) -> list[np.ndarray]:
        """All channels, layer by layer in coding order, empty ones left out."""
        return [c for groups in self.groups for section in GROUPS for c in groups[section] if c.size]

    @property
    def rate_bits(self) -> float:
        """Sum of R(a) over all channels."""
        return sum(gaussian_bits(c) for c in self.channels)


def symbols_of(layers: Sequence[LayerSymbols]) -> Symbols:
    """The symbols of decoded layers."""
    planes = []
    for layer in layers:
        tensors = list(layer.tensors())[: 6 * len(layer.planes)]
        planes.append([choose_predictor(tensor)[1] for tensor in tensors])
    return Symbols(tuple(layers), tuple(planes), tuple(channel_groups(layer)[0] for layer in layers))


@dataclass(frozen=True)
class Coder:
    """encode: symbols -> payloads, which may carry what their decoder is told; decode: those -> all channels."""

    name: str
    encode: Callable[[Symbols], list[bytes]]
    decode: Callable[[list[bytes], Symbols], list[np.ndarray]]
    overhead: Callable[[Symbols], int] = lambda symbols: 0  #: bytes to count beside the payloads


def _encode_own(priors: str, effort: int) -> Callable[[Symbols], list[bytes]]:
    def encode(symbols: Symbols) -> list[bytes]:
        payloads = []
        for layer, planes, groups in zip(symbols.layers, symbols.planes, symbols.groups, strict=True):
            for section in GROUPS:
                if not any(c.size for c in groups[section]):
                    payloads.append(b"")
                elif section == Section.ATTRIBUTES:
                    payloads.append(_write_attributes(layer, priors, effort))
                elif section == Section.PLANES:
                    payloads.append(write_planes(planes, priors, effort)[0])
                else:
                    payloads.append(encode_channels(groups[section], priors=priors, effort=effort).payload)
        return payloads

    return encode


def _write_attributes(layer: LayerSymbols, priors: str, effort: int) -> bytes:
    return write_attributes(layer.attributes, layer.classes, layer.widths, priors, effort)[0]


def _decode_own(payloads: list[bytes], symbols: Symbols) -> list[np.ndarray]:
    rest, channels = iter(payloads), []
    for layer, planes, groups in zip(symbols.layers, symbols.planes, symbols.groups, strict=True):
        for section in GROUPS:
            data = next(rest)
            if not data:
                continue
            if section == Section.ATTRIBUTES:
                classes, attributes = read_attributes(data, layer.widths, layer.attributes.shape[1])
                channels += [*([classes] if classes.size else []), *attributes]
            elif section == Section.PLANES:
                shapes = [plane.shape for plane in planes]
                channels += [c.ravel() for plane in read_planes(data, shapes) for c in plane]
            else:
                channels += [c for c in decode_channels(data, [c.size for c in groups[section]]) if c.size]
    return channels


def _lzma_peer() -> Coder:
    return Coder(
        "LZMA, its best layout",
        lambda symbols: [encode_channels_lzma(symbols.channels, effort=5).payload],
        lambda payloads, symbols: decode_channels_lzma(payloads[0], [c.size for c in symbols.channels]),
    )


def _zstd_peer() -> Coder:
    import zstandard

    def width(channel: np.ndarray) -> np.dtype:
        top = max(int(channel.max()), -int(channel.min()) - 1)
        return np.dtype("<i1") if top < 1 << 7 else np.dtype("<i2") if top < 1 << 15 else np.dtype("<i4")

    def decode(payloads: list[bytes], symbols: Symbols) -> list[np.ndarray]:
        data, at, channels = zstandard.ZstdDecompressor().decompress(payloads[0]), 0, []
        for channel in symbols.channels:
            kind = width(channel)
            channels.append(np.frombuffer(data, kind, channel.size, at).astype(np.int32))
            at += channel.size * kind.itemsize
        return channels

    return Coder(
        "zstd -19, narrowest integers",
        lambda symbols: [
            zstandard.ZstdCompressor(level=19).compress(
                b"".join(c.astype(width(c)).tobytes() for c in symbols.channels)
            )
        ],
        decode,
        lambda symbols: len(symbols.channels),
    )


def _moments(channel: np.ndarray) -> tuple[int, int, float, float]:
    """(least, largest, mean, standard deviation) as a decoder gets them, in binary32."""
    mu, sigma = np.float32(channel.mean()), np.float32(max(channel.std(), LEAST_SIGMA))
    return int(channel.min()), int(channel.max()), float(mu), float(sigma)


def _quantized_gaussian_peer() -> Coder:
    import constriction

    def model(channel: np.ndarray) -> Any:
        return constriction.stream.model.QuantizedGaussian(*_moments(channel))

    def encode(symbols: Symbols) -> list[bytes]:
        coder = constriction.stream.stack.AnsCoder()
        for channel in reversed(symbols.channels):
            if channel.min() < channel.max():
                coder.encode_reverse(np.ascontiguousarray(channel, np.int32), model(channel))
        return [coder.get_compressed().tobytes()]

    def decode(payloads: list[bytes], symbols: Symbols) -> list[np.ndarray]:
        coder = constriction.stream.stack.AnsCoder(np.frombuffer(payloads[0], np.uint32))
        return [
            coder.decode(model(c), c.size) if c.min() < c.max() else np.full(c.size, c.min(), np.int32)
            for c in symbols.channels
        ]

    return Coder("constriction QuantizedGaussian", encode, decode, _gauss_parameters)


def _gauss_parameters(symbols: Symbols) -> int:
    return GAUSS_PARAMETERS * len(symbols.channels)


def _torchac_peer() -> Coder:
    import torch

    with quiet():  # it builds its C++ part at its first import, and tells
        import torchac

    def pieces(channel: np.ndarray) -> tuple[Any, int, int]:
        """(cumulative distribution int16 [1, symbols + 1], least symbol, rows per piece)."""
        low, high, mu, sigma = _moments(channel)
        count = high - low + 1
        if count >= 1 << 15:
            raise ValueError(f"a channel spans {count} values, its limit is 32,767")
        edges = (np.arange(1, count) + low - 0.5 - mu) / sigma
        cdf = np.concatenate([[0.0], [0.5 * math.erfc(-e / math.sqrt(2)) for e in edges], [1.0]])
        table = np.rint(cdf * ((1 << 16) - count)).astype(np.int64) + np.arange(count + 1)
        wrapped = (table & 0xFFFF).astype(np.uint16).view(np.int16)
        return torch.from_numpy(wrapped)[None], low, max(1, TORCHAC_ENTRIES // (count + 1))

    def encode(symbols: Symbols) -> list[bytes]:
        payloads = []
        for channel in symbols.channels:
            if channel.min() == channel.max():
                continue
            table, low, rows = pieces(channel)
            values = torch.from_numpy((channel - low).astype(np.int16))
            for part in values.split(rows):  # type: ignore[no-untyped-call]
                payloads.append(torchac.encode_int16_normalized_cdf(table.repeat(len(part), 1), part))
        return payloads

    def decode(payloads: list[bytes], symbols: Symbols) -> list[np.ndarray]:
        rest, channels = iter(payloads), []
        for channel in symbols.channels:
            if channel.min() == channel.max():
                channels.append(np.full(channel.size, channel.min(), np.int32))
                continue
            table, low, rows = pieces(channel)
            sizes = [min(rows, channel.size - first) for first in range(0, channel.size, rows)]
            parts = [torchac.decode_int16_normalized_cdf(table.repeat(n, 1), next(rest)) for n in sizes]
            channels.append(torch.cat(parts).numpy().astype(np.int32) + low)
        return channels

    return Coder("torchac, Gaussian", encode, decode, _gauss_parameters)


def coder_rows(symbols: Symbols, repeats: int, effort: int = 5) -> list[Row]:
    """This package's coder first, then the peers, all on the same channels."""
    own = (
        Coder("this codec", _encode_own("best", effort), _decode_own),
        Coder("this codec, Gaussian priors", _encode_own("gauss", effort), _decode_own),
    )
    peers = {
        "constriction QuantizedGaussian": _quantized_gaussian_peer,
        "torchac": _torchac_peer,
        "LZMA": _lzma_peer,
        "zstd": _zstd_peer,
    }
    rows = [_coder_row(coder, symbols, repeats) for coder in own]
    for name, make in peers.items():
        rows.append(_peer_row("symbols", name, lambda make=make: _coder_row(make(), symbols, repeats)))  # type: ignore
    return rows


def _coder_row(coder: Coder, symbols: Symbols, repeats: int) -> Row:
    payloads, encode = measure(lambda: coder.encode(symbols), repeats)
    channels, decode = measure(lambda: coder.decode(payloads, symbols), repeats)
    if not all(np.array_equal(a, b) for a, b in zip(channels, symbols.channels, strict=True)):
        raise Pd4Error("its symbols came back as others")
    return Row("symbols", coder.name, sum(map(len, payloads)) + coder.overhead(symbols), encode, decode, 0.0)


# -- positions ---------------------------------------------------------------------------------------------------------


def position_rows(layers: Sequence[LayerSymbols], repeats: int) -> list[Row]:
    """The anchors of each layer by themselves, as in a file."""
    cells = [layer.anchor_q for layer in layers if len(layer.anchor_q)]

    def own() -> Row:
        payloads, encode = measure(lambda: [encode_positions(c) for c in cells], repeats)
        back, decode = measure(
            lambda: [decode_positions(p, len(c)) for p, c in zip(payloads, cells, strict=True)], repeats
        )
        if not all(np.array_equal(a, b) for a, b in zip(back, cells, strict=True)):
            raise Pd4Error("its cells came back as others")
        return Row("positions", "this codec", sum(map(len, payloads)), encode, decode, 0.0)

    def draco() -> Row:
        import DracoPy

        payloads, encode = measure(lambda: [draco_encode(c) for c in cells], repeats)
        back, decode = measure(lambda: [DracoPy.decode(p).points for p in payloads], repeats)
        for points, c in zip(back, cells, strict=True):
            found = np.rint(np.asarray(points)).astype(np.int64) + c.min(axis=0)
            if not np.array_equal(np.unique(found, axis=0), np.unique(c, axis=0)):
                raise Pd4Error("its cells came back as others")
        return Row("positions", "Draco, kd-tree, level 10", sum(map(len, payloads)), encode, decode, 0.0)

    return [own(), _peer_row("positions", "Draco", draco)]


# -- splats ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Splats:
    """Gaussians as static formats know them, float32: means [N, 3], scales [N, 3] (standard deviations), quats [N, 4]
    wxyz, opacities [N] and colors [N, 3] in 0..1."""

    means: np.ndarray
    scales: np.ndarray
    quats: np.ndarray
    opacities: np.ndarray
    colors: np.ndarray


def splat_rows(level: Level, frame: Frame, file_bytes: int, repeats: int) -> list[Row]:
    """The whole file first, which holds every instant and every view, then static formats on one instant of it."""
    seen = view(level, frame)
    splats = Splats(*(seen[name] for name in ("means", "scales", "quats", "opacities", "colors")))
    picture = draw_all([seen], 1)[0][0]
    count = f"{len(splats.means):,} splats at t = {frame.time:.2f}"

    def peer(name: str, encode: Callable[[Splats], bytes], decode: Callable[[bytes], Splats]) -> Callable[[], Row]:
        def row() -> Row:
            with quiet():
                data, encoding = measure(lambda: encode(splats), repeats)
                back, decoding = measure(lambda: decode(data), repeats)
            drawn = draw_all([seen | vars(back)], 1)[0][0].astype(np.float64)
            error = math.sqrt(float(np.square(drawn - picture).mean()))
            return Row(count, name, len(data), encoding, decoding, error)

        return row

    ply = peer("PLY, float32", to_ply, from_ply)
    return [
        Row("all times and views", "this file", file_bytes),
        ply(),
        _peer_row(count, "SPZ", lambda: peer("SPZ 4, by gaussforge", *_spz_peer(splats))()),
        _peer_row(count, "fourdgs", lambda: peer("fourdgs, default profile", *_fourdgs_peer())()),
    ]


_PLY = ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1",
        "rot_2", "rot_3")  # fmt: skip


def to_ply(splats: Splats) -> bytes:
    """A binary PLY as 3D Gaussian splatting writes it: logits, logarithms, degree-0 harmonics."""
    p = np.clip(splats.opacities.astype(np.float64), 1e-6, 1 - 1e-6)
    columns = (
        splats.means,
        (splats.colors - 0.5) / _SH0,
        np.log(p / (1 - p))[:, None],
        np.log(np.maximum(splats.scales, 1e-12)),
        splats.quats,
    )
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(p)}"]
    head += [*(f"property float {name}" for name in _PLY), "end_header", ""]
    return "\n".join(head).encode() + np.concatenate(columns, axis=1).astype("<f4").tobytes()


def from_ply(data: bytes) -> Splats:
    """The splats of a binary PLY whose vertex properties are all floats, to_ply's among them."""
    head, body = data.split(b"end_header\n", 1)
    lines = head.decode("ascii").splitlines()
    names = [line.split()[2] for line in lines if line.startswith("property float ")]
    count = next(int(line.split()[2]) for line in lines if line.startswith("element vertex "))
    rows = dict(zip(names, np.frombuffer(body, "<f4", count * len(names)).reshape(count, -1).T, strict=True))

    def columns(*wanted: str) -> np.ndarray:
        return np.stack([rows[name] for name in wanted], axis=1)

    return Splats(
        means=columns(*_PLY[:3]),
        scales=np.exp(columns(*_PLY[7:10])),
        quats=columns(*_PLY[10:]),
        opacities=1 / (1 + np.exp(-rows["opacity"])),
        colors=columns(*_PLY[3:6]) * np.float32(_SH0) + np.float32(0.5),
    )


def _spz_peer(splats: Splats) -> tuple[Callable[[Splats], bytes], Callable[[bytes], Splats]]:
    import gaussforge

    converter = gaussforge.GaussForge()
    room = min(
        limit / max(float(np.abs(values).max(initial=0.0)), 1e-9)
        for limit, values in ((_SPZ_EXTENT, splats.means), (_SPZ_SCALE, splats.scales))
    )
    factor = np.float32(2.0 ** math.floor(math.log2(room)))

    def scaled(s: Splats, by: np.float32) -> Splats:
        return Splats(s.means * by, s.scales * by, s.quats, s.opacities, s.colors)

    def convert(data: bytes, source: str, target: str) -> bytes:
        result = converter.convert(data, source, target, spz_version=4)
        if "error" in result:
            raise ValueError(f"gaussforge: {result['error']}")
        return bytes(result["data"])

    return (
        lambda s: convert(to_ply(scaled(s, factor)), "ply", "spz"),
        lambda data: scaled(from_ply(convert(data, "spz", "ply")), 1 / factor),
    )


def _fourdgs_peer() -> tuple[Callable[[Splats], bytes], Callable[[bytes], Splats]]:
    import fourdgs

    def encode(s: Splats) -> bytes:
        n = len(s.means)
        gaussians = fourdgs.GaussianSet(
            positions=s.means,
            scales=s.scales,
            rotations=s.quats[:, [1, 2, 3, 0]],
            colors=np.concatenate([s.colors, s.opacities[:, None]], axis=1),
            motions=np.zeros((n, 3), np.float32),
            mu_t=np.full(n, 0.5, np.float32),
            sigma_t=np.full(n, np.inf, np.float32),
            win_lo=np.zeros(n),
            win_hi=np.ones(n),
        )
        stream = io.BytesIO()
        fourdgs.write(stream, gaussians, 1.0, options=fourdgs.WriteOptions(verify=False))
        return stream.getvalue()

    def decode(data: bytes) -> Splats:
        g = fourdgs.read(data).gaussians
        return Splats(g.positions, g.scales, g.rotations[:, [3, 0, 1, 2]], g.colors[:, 3], g.colors[:, :3])

    return encode, decode


# -- rows --------------------------------------------------------------------------------------------------------------


def _peer_row(what: str, coder: str, make: Callable[[], Row]) -> Row:
    """The row, or one that says why there is none: a peer's failure is no failure of the report."""
    try:
        return make()
    except Exception as error:
        reason = "not installed" if isinstance(error, ModuleNotFoundError) else f"{type(error).__name__}: {error}"
        return Row(what, coder, missing=" ".join(reason.split())[:160])


def table(rows: Sequence[Row], rate_bits: float | None = None) -> str:
    """Bytes and times, each over those of the first row of its kind. rate_bits: sum of R(a) of the symbols."""
    head = ("what", "coder", "bytes", "bytes / ours", "bytes / ΣR", "encode / ours", "decode / ours", "picture RMSE")
    first: Row | None = None
    cells = []
    for row in rows:
        if first is None or row.coder.startswith("this") and row.what != first.what:
            first = row
        if row.missing:
            cells.append((row.what, row.coder, f"none: {row.missing}", *["-"] * 5))
            continue
        over_rate = 8 * row.bytes / rate_bits if row.what == "symbols" and rate_bits and row.bytes else None
        cells.append(
            (
                row.what, row.coder, f"{row.bytes:,}", _ratio(row.bytes, first.bytes),
                "-" if over_rate is None else f"{over_rate:.4f}",
                _time_ratio(row.encode, first.encode), _time_ratio(row.decode, first.decode),
                "-" if row.error is None or row.error == 0 else f"{row.error:.2g}",
            )
        )  # fmt: skip
    return markdown(head, cells)


def as_json(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """The rows as plain dicts."""
    return [asdict(row) for row in rows]


def _ratio(a: float | None, b: float | None) -> str:
    return "-" if a is None or not b else f"{a / b:.3f}"


def _time_ratio(a: Timing | None, b: Timing | None) -> str:
    return "-" if a is None or b is None else f"{a.median / b.median:.3g}"
