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
from vectors import blocks, refining, slices

from pd4dgs_codec import encode
from pd4dgs_codec.entropy.varint import ByteReader, put_varint
from pd4dgs_codec.errors import DecodeError
from pd4dgs_codec.format import attribute_section, canonical, layer_meta, stages
from pd4dgs_codec.format import header as header_module
from pd4dgs_codec.format.container import read_chunk, read_preamble, write_chunk, write_preamble
from pd4dgs_codec.format.decoder import LayerReader, decode_layers
from pd4dgs_codec.format.kinds import BY_CHUNK_TYPE
from pd4dgs_codec.format.layer_meta import Section
from pd4dgs_codec.format.metadata import Metadata
from pd4dgs_codec.format.quantise import dequantise
from pd4dgs_codec.scene import DEFAULT_WIDTHS, Scene, Widths


@dataclass
class Chunk:
    """One chunk. meta and sections are the parameters and sections of a layer's payload, None for other chunks.

    The section map in meta holds only what stands for no bytes."""

    type: int
    flags: int
    payload: bytes
    meta: dict[int, Any] | None = None
    sections: dict[int, bytes] | None = None
    widths: Widths = DEFAULT_WIDTHS

    def packed(self) -> bytes:
        """The payload, written anew if it was taken apart: section lengths follow the sections."""
        if self.meta is None or self.sections is None:
            return self.payload
        lengths = {number: len(data) for number, data in sorted(self.sections.items()) if data}
        others = self.meta.get(layer_meta.SECTIONS)
        both = {**(others if isinstance(others, dict) else {}), **lengths}
        meta = canonical.pack({**self.meta, layer_meta.SECTIONS: both})
        return b"".join([struct.pack("<I", len(meta)), meta, *(self.sections[number] for number in lengths)])


@dataclass
class Parts:
    """A file taken apart."""

    header: dict[int, Any]
    chunks: list[Chunk]


def take_apart(data: bytes) -> Parts:
    """The parts of a valid file, each a copy."""
    preamble = read_preamble(data)
    header = canonical.unpack(preamble.header)
    chunks, offset = [], preamble.size
    while offset < len(data):
        chunk = read_chunk(data, offset)
        widths = Widths(*header[header_module.WIDTHS], graded=header_module.CENTRE in header)
        part = Chunk(chunk.type, chunk.flags, chunk.payload, widths=widths)
        if chunk.type in BY_CHUNK_TYPE:
            (length,) = struct.unpack_from("<I", chunk.payload)
            part.meta, at = canonical.unpack(chunk.payload[4 : 4 + length]), 4 + length
            part.sections = {}
            lengths = part.meta[layer_meta.SECTIONS]
            for number in sorted(int(section) for section in Section if section in lengths):
                size = lengths.pop(number)
                part.sections[number], at = chunk.payload[at : at + size], at + size
        chunks.append(part)
        offset = chunk.end
    return Parts(header, chunks)


def put_together(parts: Parts, header: bytes | None = None) -> bytes:
    """The file of `parts`, or with other bytes for a header, which may be none. EncodeError if a value has no canonical
    form."""
    payloads = [chunk.packed() for chunk in parts.chunks]
    if header is None:
        rows = [[chunk.type, len(payload)] for chunk, payload in zip(parts.chunks, payloads, strict=True)]
        header = canonical.pack({**parts.header, header_module.CHUNKS: rows})
    try:
        scene_id = header_module.scene_id_of(header)
    except (DecodeError, LookupError, TypeError):  # no header, or no chunk
        scene_id = bytes(8)
    framed = [write_chunk(c.type, c.flags, scene_id, p) for c, p in zip(parts.chunks, payloads, strict=True)]
    return b"".join([write_preamble(header), *framed])


@dataclass
class Staged:
    """A section of form 1 taken apart. block: all before the lengths, the form included."""

    block: bytes
    stages: list[bytes]

    def packed(self) -> bytes:
        """The section, with the lengths of these stages."""
        lengths = bytearray()
        for stage in self.stages[:-1]:
            put_varint(lengths, len(stage))
        return b"".join([self.block, lengths, *self.stages])


def take_stages(chunk: Chunk, number: int) -> Staged | None:
    """The stages of a section; None if it has none or is not valid."""
    data = (chunk.sections or {}).get(number, b"")
    try:
        reader = ByteReader(data)
        form = reader.byte("the form")
        if number == Section.ATTRIBUTES and form in (stages.STAGED, attribute_section.CONTINUED):
            count = _pass_attributes(reader, chunk.widths, form)
        elif number == Section.PLANES and form == stages.STAGED:
            count = _pass_planes(reader, chunk)
        else:
            return None
        block = data[: reader.offset]
        lengths = [reader.varint(len(data), "the length of a stage") for _ in range(count - 1)]
    except (DecodeError, LookupError, TypeError):  # the section, or the parameters, were changed before
        return None
    bounds = [*itertools.accumulate(lengths, initial=reader.offset), len(data)]
    return Staged(block, [data[start:end] for start, end in itertools.pairwise(bounds)])


def _pass_attributes(reader: ByteReader, widths: Widths, form: int) -> int:
    """Reads on to the lengths of the stages and returns how many stages there are."""
    if widths.graded:
        reader.take(reader.varint(reader.remaining, "the length of the step classes"))
    if form == stages.STAGED:
        attribute_section._read_block(reader, widths)
    return attribute_section.N_STAGES


def _pass_planes(reader: ByteReader, chunk: Chunk) -> int:
    assert chunk.meta is not None
    count: int = max(1, (chunk.meta[layer_meta.SCALES][0][0] - 1).bit_length())
    for stage in range(1, count):
        stages.read_class_count(reader, stage)
    return count


@dataclass(frozen=True)
class Seed:
    """A valid file. prefixes: what each prefix of slices decodes to, as digests of the header and of each layer.
    weight: how often to take it."""

    name: str
    data: bytes
    prefixes: frozenset[tuple[bytes, ...]]
    weight: float


def digests(data: bytes, **options: Any) -> tuple[bytes, ...]:
    """Of the header's fields and of each decoded layer's arrays. Raises DecodeError; options as in decode_layers."""
    return _digests(data, *decode_layers(data, **options)[:2])


def _digests(data: bytes, header: Any, layers: Sequence[Any]) -> tuple[bytes, ...]:
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
    prefixes, reader = set(), LayerReader()
    while reader.next_slice(data):
        prefixes.add(_digests(data, reader.header, reader.layers))
    rows = sum(len(layer.anchor_q) for layer in reader.layers)
    return Seed(name, data, frozenset(prefixes), 1.0 / (len(data) + (3000 if rows > 1 else 0)))


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
    files |= _staged() | _of_other_widths() | _in_slices() | _with_low_bits()
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
    scene: Scene = make_scene(4, layers=(0,), anchors=anchors, extent=3, hidden=())
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


def _staged() -> dict[str, bytes]:
    """Attributes and planes in stages with classes, terms and splits, whether an encoder would choose them or not."""
    k = blocks.pattern(68, 12) * (np.arange(12, dtype=np.int32) % 4)
    terms = {c: [(c // 2, 300 - 20 * c)] for c in range(1, 38, 3)}
    splits = {i: (i % 4, i - 4, 5 - i) for i in range(10)}
    layer = blocks.make_layer(0, [[i, 0, 0] for i in range(12)], attributes=k)
    section = blocks.predicted_attributes(k, terms, splits, (3, 1, 8, 2, 5))
    attributes = blocks.make_file(layer.with_sections({Section.ATTRIBUTES: section}))
    layer = blocks.make_layer(1, (), before=1, scales=[blocks.Scale(5), blocks.Scale(5, (2, 1, 3, 4))])
    planes = [plane for scale in layer.meant.planes for plane in scale.values()]
    layer = layer.with_sections({Section.PLANES: blocks.staged_planes(planes, (3, 8))})
    return {
        "staged-attributes": attributes.data(),
        "staged-planes": blocks.make_file(blocks.make_layer(), layer).data(),
    }


def _of_other_widths() -> dict[str, bytes]:
    """Other feature widths and slots, step classes, and a file that tells of itself."""
    tiny = {"channels": 1, "width": 1, "hidden": (), "extent": 2}
    narrow = make_scene(6, anchors=5, widths=Widths(1, 1), **tiny)
    wide = make_scene(7, layers=(0,), anchors=3, widths=Widths(64, 16, graded=True), **tiny)
    packed = make_scene(8, layers=(0, 1), anchors=4, widths=Widths(3, 2, graded=True), **tiny)
    about = Metadata("title", quality={0: 20.5}, still=b"\xff\xd8\xff" + bytes(9), slices=(19.5,))
    return {
        "narrow": encode(narrow, layers=2, effort=1, metadata=about),
        "wide-classes": encode(wide, layers=2, effort=1),
        "narrow-classes-lzma": encode(packed, layers=2, effort=1, mode="lzma"),
    }


def _in_slices() -> dict[str, bytes]:
    """Slices in every form, with and without step classes, by hand and as an encoder makes them."""
    by_hand = itertools.takewhile(lambda v: v.name.startswith("valid/"), slices.cases())
    scene = make_scene(9, layers=(0, 1), anchors=90, extent=3, hidden=(), widths=Widths(2, 2))
    return {vector.name: vector.data for vector in by_hand} | {"sliced": encode(scene, layers=2, effort=2, slices=1000)}


def _with_low_bits() -> dict[str, bytes]:
    """Slices that refine others, by hand and as an encoder makes them."""
    by_hand = (v for v in refining.cases() if v.error is None)
    scene = make_scene(9, layers=(0, 1), anchors=70, extent=3, kind="gaussian", hidden=(), widths=Widths(2, 2, True))
    low = encode(scene, layers=2, effort=2, slices=1000, low_bits=3)
    return {vector.name: vector.data for vector in by_hand} | {"low-bits": low}


def _all_priors() -> Scene:
    """No anchors, and weights that are spiky, heavy-tailed, or wide with outliers: a kind of prior for each."""
    rng = np.random.default_rng(0)
    scene: Scene = make_scene(5, layers=(0,), anchors=0, hidden=())

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
    """The digests of every prefix of slices of every seed: what an unrepaired input may decode to, and nothing else."""
    return frozenset[tuple[bytes, ...]]().union(*(seed.prefixes for seed in seeds))
