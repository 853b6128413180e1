"""Files to mutate: small ones that use every mode, layer set, prior and form; taking apart, putting together.

What is put together has right lengths, chunk list, scene ids and checksums, whatever its payloads say.
"""

from __future__ import annotations

import hashlib
import itertools
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from strategies import LAYER_SETS, RANGES, make_scene

from pd4dgs_codec import encode
from pd4dgs_codec.attributes.quantise import dequantise
from pd4dgs_codec.bitstream import canonical
from pd4dgs_codec.bitstream.container import read_chunk, read_preamble, scene_id_of, write_chunk, write_preamble
from pd4dgs_codec.codec import header as header_module
from pd4dgs_codec.codec import layer_meta
from pd4dgs_codec.codec.decoder import decode_layers
from pd4dgs_codec.codec.kinds import BY_CHUNK_TYPE
from pd4dgs_codec.errors import DecodeError
from pd4dgs_codec.scene import Scene


@dataclass
class Chunk:
    """One chunk. meta and sections are the parameters and sections of a layer's payload, None for other chunks."""

    type: int
    flags: int
    payload: bytes
    meta: dict[int, Any] | None = None
    sections: dict[int, bytes] | None = None

    def packed(self) -> bytes:
        """The payload, written anew if it was taken apart: section lengths follow the sections."""
        if self.meta is None or self.sections is None:
            return self.payload
        lengths = {number: len(data) for number, data in sorted(self.sections.items()) if data}
        meta = canonical.pack({**self.meta, layer_meta.SECTIONS: lengths})
        return b"".join([struct.pack("<I", len(meta)), meta, *(self.sections[number] for number in lengths)])


@dataclass
class Parts:
    """A file taken apart."""

    header: dict[int, Any]
    chunks: list[Chunk]


def take_apart(data: bytes) -> Parts:
    """The parts of a valid file, each a copy."""
    preamble = read_preamble(data)
    chunks, offset = [], preamble.size
    while offset < len(data):
        chunk = read_chunk(data, offset)
        part = Chunk(chunk.type, chunk.flags, chunk.payload)
        if chunk.type in BY_CHUNK_TYPE:
            (length,) = struct.unpack_from("<I", chunk.payload)
            part.meta, at = canonical.unpack(chunk.payload[4 : 4 + length]), 4 + length
            part.sections = {}
            for number, size in sorted(part.meta[layer_meta.SECTIONS].items()):
                part.sections[number], at = chunk.payload[at : at + size], at + size
        chunks.append(part)
        offset = chunk.end
    return Parts(canonical.unpack(preamble.header), chunks)


def put_together(parts: Parts, header: bytes | None = None) -> bytes:
    """The file of `parts`, or with other bytes for a header. EncodeError if a value has no canonical form."""
    payloads = [chunk.packed() for chunk in parts.chunks]
    if header is None:
        rows = [[chunk.type, len(payload)] for chunk, payload in zip(parts.chunks, payloads, strict=True)]
        header = canonical.pack({**parts.header, header_module.CHUNKS: rows})
    scene_id = scene_id_of(payloads[0]) if payloads else bytes(8)
    framed = [write_chunk(c.type, c.flags & 1, scene_id, p) for c, p in zip(parts.chunks, payloads, strict=True)]
    return b"".join([write_preamble(header), *framed])


@dataclass(frozen=True)
class Seed:
    """A valid file. digests: of the header and of each layer, all that is decoded. weight: how often to take it."""

    name: str
    data: bytes
    digests: tuple[bytes, ...]
    weight: float


def digests(data: bytes, **options: Any) -> tuple[bytes, ...]:
    """Of the header's fields and of each decoded layer's arrays. Raises DecodeError; options as in decode_layers."""
    header, layers, _ = decode_layers(data, **options)
    fields = {key: value for key, value in canonical.unpack(read_preamble(data).header).items()}
    assert header.chunks
    result = [hashlib.sha256(repr(sorted(fields.items())).encode()).digest()]
    for layer in layers:
        total = hashlib.sha256(repr((layer.kind.layer, sorted(layer.steps.items()))).encode())
        for array in layer.arrays():
            total.update(repr((array.dtype, array.shape)).encode() + array.tobytes())
        result.append(total.digest())
    return tuple(result)


def as_seed(name: str, data: bytes) -> Seed:
    """A seed of a valid file. Those that decode faster come more often: small ones, those without a tree of cells."""
    rows = sum(len(layer.anchor_q) for layer in decode_layers(data)[1])
    return Seed(name, data, digests(data), 1.0 / (len(data) + (3000 if rows > 1 else 0)))


def built_seeds() -> list[Seed]:
    """Small files of every layer set, mode, deformation and range of symbols, every prior, and odd plane sizes."""
    files: dict[str, bytes] = {}
    tiny = {"channels": 1, "width": 1, "hidden": (), "heads": ({"position": 3}, {"opacity": 1})}
    combinations = itertools.product(LAYER_SETS, (("ans", "coded"), ("lzma", "coded"), ("ans", "float32")))
    for i, (layers, (mode, deformation)) in enumerate(combinations):
        scene = make_scene(i, layers=layers, anchors=i % 3, extent=1, kind=RANGES[i % 4], sides=(1, 2, 1, 2), **tiny)
        options = {"mode": mode, "deformation": deformation, "priors": ("gauss", "best")[i % 2]}
        files[f"tiny-{i}-{mode}-{deformation}"] = encode(scene, layers=2, effort=3, **options)
    files["no-anchor"] = encode(make_scene(1, anchors=0, with_camera=False), layers=2, effort=1)
    files["all-heads"] = encode(make_scene(2, anchors=6, scales=2), layers=2, effort=5)
    files["predicted"] = encode(_correlated(60), layers=0, effort=2)
    for mode in ("ans", "lzma"):
        files[f"priors-{mode}"] = encode(_all_priors(), layers=0, effort=5, mode=mode)
    flat = make_scene(3, layers=(0, 1), anchors=0, kind="constant", **{**tiny, "sides": (90, 3, 40, 2), "scales": 2})
    files["wide-planes"] = encode(flat, layers=2, effort=1)
    ancillary = take_apart(files["no-anchor"])
    ancillary.chunks[1:1] = [Chunk(99, 1, b"an ancillary chunk"), Chunk(40000, 1, b"")]
    files["ancillary"] = put_together(ancillary)
    return [as_seed(name, data) for name, data in files.items()]


def _correlated(anchors: int) -> Scene:
    """Attributes that predict one another, so that the encoder takes form 1 of the attributes."""
    rng = np.random.default_rng(0)
    scene = make_scene(4, layers=(0,), anchors=anchors, extent=3, hidden=())
    n, steps = len(scene.anchor_q), scene.steps
    feature = np.rint(rng.normal(0, 900, (n, 1))) * rng.choice([1, 2], 32) + rng.integers(-1, 2, (n, 32))
    still = rng.random((n, 10, 1)) < 0.6
    offset = np.where(still, 0, np.rint(rng.normal(0, 40, (n, 10, 3))))
    codes = np.full(n, 255, np.uint8)
    return replace(
        scene,
        mask=(codes,),
        feature=dequantise(feature.astype(np.int32), steps.feature),
        offset=dequantise(offset.astype(np.int32), steps.offset),
    )


def _all_priors() -> Scene:
    """No anchors, and weights that are spiky, heavy-tailed, or wide with outliers: a kind of prior for each."""
    rng = np.random.default_rng(0)
    scene = make_scene(5, layers=(0,), anchors=0, hidden=())

    def with_weight(name: str, symbols: np.ndarray) -> Any:
        ((weight, bias),) = scene.networks[name]
        return ((dequantise(symbols.reshape(weight.shape).astype(np.int32), scene.steps.weights_scaffold), bias),)

    spiky = np.array([0, 3, 4, 9, 20])[rng.integers(0, 5, 350)]
    tails = np.where(rng.random(2450) < 0.8, rng.normal(0, 0.6, 2450), rng.normal(0, 30, 2450))
    wide = rng.normal(0, 40_000, 1050)
    wide[[3, 77]] = (5_000_000, -8_000_000)
    symbols = {"opacity": spiky, "covariance": np.rint(tails), "color": np.rint(wide)}
    return replace(scene, networks={name: with_weight(name, k) for name, k in symbols.items()})


def given_seeds(paths: Iterable[Path]) -> list[Seed]:
    """Seeds of `.pd4` files and of those in folders; files that do not decode are left out (vectors may be faulty)."""
    seeds = []
    for path in paths:
        for file in sorted(path.rglob("*.pd4")) if path.is_dir() else [path]:
            try:
                seeds.append(as_seed(str(file), file.read_bytes()))
            except DecodeError:
                continue
    return seeds


def known_prefixes(seeds: Sequence[Seed]) -> frozenset[tuple[bytes, ...]]:
    """The digests of every prefix of layers of every seed: what an unrepaired input may decode to, and nothing else."""
    return frozenset(seed.digests[:k] for seed in seeds for k in range(2, len(seed.digests) + 1))
