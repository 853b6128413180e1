"""The reference decoder agrees with the package, and quotes the specification that it claims to follow."""

import ast
import importlib.util
import json
import random
import re
import struct
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import LAYER_SETS, make_scene, scenes

from pd4dgs_codec.entropy.channels import encode_channels
from pd4dgs_codec.entropy.lzma_mode import encode_channels_lzma
from pd4dgs_codec.entropy.positions import encode_positions, position_channels
from pd4dgs_codec.entropy.priors import CONST, GAUSS, GMM2, HIST, K_MAX
from pd4dgs_codec.entropy.tables import NORMAL, OCTAVE
from pd4dgs_codec.entropy.varint import put_varint, put_zigzag
from pd4dgs_codec.errors import DecodeError
from pd4dgs_codec.format import canonical
from pd4dgs_codec.format.attributes import read_attributes
from pd4dgs_codec.format.container import read_chunk, read_preamble, write_chunk, write_preamble
from pd4dgs_codec.format.decoder import decode
from pd4dgs_codec.format.encoder import encode
from pd4dgs_codec.format.header import scene_id_of
from pd4dgs_codec.format.info import hashes
from pd4dgs_codec.format.planes import read_planes
from pd4dgs_codec.format.quantise import MAX_SYMBOL, dequantise
from pd4dgs_codec.format.registry import Section
from pd4dgs_codec.format.stages import PLAIN, STAGED
from pd4dgs_codec.morton import morton_order
from pd4dgs_codec.scene import Widths

SPEC = Path(__file__).parents[2] / "spec"
TEXT = (SPEC / "format.md").read_text(encoding="utf-8")
SOURCE = (SPEC / "refdec.py").read_text(encoding="utf-8")

_module = importlib.util.spec_from_file_location("refdec", SPEC / "refdec.py")
refdec = importlib.util.module_from_spec(_module)
_module.loader.exec_module(refdec)

CODINGS = {
    "ans best": {},
    "ans gauss": {"priors": "gauss"},
    "lzma": {"mode": "lzma"},
    "slices": {"slices": 1500},
}
SCENES = {
    "empty": {"anchors": 0},
    "one anchor": {"anchors": 1, "layers": (0,), "hidden": ()},
    "whole range": {"anchors": 1, "layers": (0,), "kind": "huge", "hidden": ()},
    "a hundred anchors": {"anchors": 100, "kind": "gaussian", "extent": 30},
    "two scales": {"scales": 2, "sides": (1, 3, 2, 4), "channels": 1},
    **{f"layers {layers}": {"layers": layers, "anchors": 9} for layers in LAYER_SETS},
}


@pytest.mark.parametrize("coding", CODINGS)
@pytest.mark.parametrize("scene", SCENES)
def test_hashes_are_those_of_the_package(scene, coding):
    data = encode(make_scene(3, **SCENES[scene]), layers=2, effort=3, **CODINGS[coding])
    assert refdec.hashes(data) == hashes(data)


@given(scenes(), st.sampled_from(sorted(CODINGS)))
@settings(max_examples=15)
def test_hashes_of_any_scene_are_those_of_the_package(scene, coding):
    data = encode(scene, layers=2, effort=1, verify=False, **CODINGS[coding])
    assert refdec.hashes(data) == hashes(data)


def test_tensors_by_name_and_prefixes():
    data = encode(make_scene(7, anchors=20), layers=2, effort=1)
    scene, layers = decode(data), refdec.decode(data)
    assert [layer.number for layer in layers] == [0, 1, 2]
    own = slice(scene.rows[0], scene.rows[1])
    for name in ("anchor", "feature", "scaling_log", "offset"):
        assert layers[1].tensors[name] == getattr(scene, name)[own].ravel().tolist(), name
    assert layers[1].tensors["planes.0.yt"] == scene.global_deformation.planes[0]["yt"].ravel().tolist()
    assert layers[2].tensors["network.3.bias.0"] == scene.local_deformation.networks["offset"][0][1].tolist()
    assert layers[0].symbols["anchor"] == scene.anchor_q[: scene.rows[0]].ravel().tolist()
    prefix = refdec.decode(data, max_layer=1)
    assert [p.tensors for p in prefix] == [p.tensors for p in layers[:2]] and len(prefix) == 2


def test_every_prior_family():
    rng = np.random.default_rng(0)
    two = np.concatenate([rng.normal(-40, 3, 4000), rng.normal(60, 9, 4000)])
    channels = [
        np.full(5, 7),
        rng.normal(3, 2.5, 3000),
        two,
        rng.choice([-30, 0, 1, 30], 5000, p=[0.2, 0.5, 0.2, 0.1]),
        rng.normal(0, 1e6, 400),
        np.append(rng.normal(0, 1, 500), [90000, -K_MAX, K_MAX]),
        np.zeros(0),
    ]
    channels = [np.clip(np.rint(c), -K_MAX, K_MAX).astype(np.int32) for c in channels]
    counts = [len(c) for c in channels]
    coded = encode_channels(channels, effort=9)
    assert {fitted.prior.id for fitted in coded.defined} == {CONST, GAUSS, GMM2, HIST}
    assert refdec.decode_channels(coded.payload, counts) == [c.tolist() for c in channels]
    wide = encode_channels(channels[4:5], priors="gauss").payload
    assert wide[0] >> 1 == 4 and refdec.decode_channels(wide, [400]) == [channels[4].tolist()]
    assert refdec.decode_lzma_symbols(encode_channels_lzma(channels), counts) == [c.tolist() for c in channels]


@pytest.mark.parametrize("depth", [7, 13, 21])
def test_positions_on_a_surface(depth):
    rng = np.random.default_rng(depth)
    direction = rng.normal(size=(1200, 3)) * (1, 0.8, 0.3)
    sphere = direction / np.linalg.norm(direction, axis=1)[:, None]
    cells = np.unique(np.rint(sphere * (2 ** (depth - 1) - 1)).astype(np.int32), axis=0)
    cells = cells[morton_order(cells)]
    assert refdec.decode_positions(encode_positions(cells), len(cells)) == [tuple(c) for c in cells.tolist()]


def correlated_scene(anchors):
    """Features and log-scalings mixed from five sources and noise, louder for some anchors; per Gaussian, half of the
    anchors have offset 0, 0, 0; samples of planes are large in some blocks, in all channels."""
    scene = make_scene(5, layers=(0, 1), anchors=anchors, extent=12, channels=5, sides=(20, 25, 22, 4))
    rng, n = np.random.default_rng(6), len(scene.anchor_q)
    alone = rng.normal(size=(n, 38)) * np.exp(rng.normal(size=(n, 1)) * 1.5)
    mixed = np.rint(rng.normal(size=(n, 5)) @ rng.normal(size=(5, 38)) * 6 + alone)
    offset = np.rint((rng.random((n, 10, 1)) < 0.5) * rng.normal(size=(n, 10, 3)) * 8)
    mixed, offset = mixed.astype(np.int32), offset.astype(np.int32)
    planes = {
        name: dequantise(busy(rng, plane.shape), scene.steps.planes_global)
        for name, plane in scene.global_deformation.planes[0].items()
    }
    return replace(
        scene,
        feature=dequantise(mixed[:, :32], scene.steps.feature),
        scaling_log=dequantise(mixed[:, 32:], scene.steps.scaling_log),
        offset=dequantise(offset, scene.steps.offset),
        global_deformation=replace(scene.global_deformation, planes=(planes,)),
    )


def busy(rng, shape, spread=2.0):
    """Symbols [C, H, W] that are large in some blocks of 4 by 4 places, in all channels."""
    _, h, w = shape
    places = np.kron(np.exp(rng.normal(size=(h // 4 + 1, w // 4 + 1)) * spread), np.ones((4, 4)))[:h, :w]
    return np.clip(np.rint(rng.normal(size=shape) * places), -K_MAX, K_MAX).astype(np.int32)


def section_of(payload, section):
    """(bytes, own rows) of a section."""
    (length,) = struct.unpack_from("<I", payload)
    meta = canonical.unpack(payload[4 : 4 + length])
    start = 4 + length + sum(size for other, size in meta[2].items() if other < section)
    return payload[start : start + meta[2][int(section)]], meta[1]


@pytest.fixture(scope="module")
def staged_file():
    return encode(correlated_scene(1000), layers=2, effort=2, omit="nothing")


def test_hashes_of_a_scene_in_stages(staged_file):
    chunks = take_apart(staged_file)[1]
    section, rows = section_of(chunks[0][2], Section.ATTRIBUTES)
    assert section[0] == STAGED and rows >= 400
    reader = refdec.Reader(section[1:])
    assert any([refdec.read_terms(reader, 38, c) for c in range(1, 38)])
    assert max([refdec.read_class_count(reader) for _ in range(5)]) > 1
    assert (1, 1) in [refdec.read_split(reader)[:2] for _ in range(10)]
    section, _ = section_of(chunks[1][2], Section.PLANES)
    assert section[0] == STAGED and max(section[1:3]) > 1
    assert refdec.hashes(staged_file) == hashes(staged_file)
    plain = encode(correlated_scene(1000), layers=2, effort=1, omit="nothing")
    for (_, _, payload), number in zip(take_apart(plain)[1], (Section.ATTRIBUTES, Section.PLANES), strict=True):
        assert section_of(payload, number)[0][0] == PLAIN
    assert refdec.hashes(plain) == hashes(staged_file)


def test_damage_to_a_scene_in_stages_has_the_same_outcome(staged_file):
    section, rows = section_of(take_apart(staged_file)[1][0][2], Section.ATTRIBUTES)
    assert_same_outcomes(section, lambda d: both(d, rows), 40, 1200)


def assert_same_outcomes(section, decode_both, number, begin):
    """`decode_both` agrees on copies of a section that differ in one byte, half of them in the first `begin` bytes."""
    rng, seen = random.Random(4), set()
    for i in range(number):
        at = rng.randrange(min(begin, len(section)) if i % 2 else len(section))
        cut = rng.randrange(4) == 0
        damaged = section[:at] + (b"" if cut else bytes([rng.randrange(256)])) + section[at + 1 :]
        ours, theirs = decode_both(damaged)
        assert ours == theirs, (at, damaged[at : at + 1])
        seen.add(ours if isinstance(ours, str) else "fine")
    assert {"Malformed", "LimitExceeded"} <= seen
    return seen


ROWS, WIDTHS = 9, (32, 10)
STAGE_BOUNDS = (0, 6, 12, 20, 29, 38)


def same(symbol):
    """Channels [68, ROWS] of one symbol."""
    return np.full((68, ROWS), symbol, np.int32)


def staged_attributes(coded, *, terms=None, counts=(1,) * 5, splits=None, form=STAGED, lengths=None, extra=b""):
    """A section of residuals and offsets int32 [68, n]. terms: c -> (m, [(g, w)]); splits: i -> (f, centres); lengths:
    those of stages 0..6 from the true ones of 0..7."""
    block, splits, n = bytearray([form]), splits or {}, coded.shape[1]
    for c in range(1, 38):
        number, own = (terms or {}).get(c, (0, []))
        put_varint(block, number)
        for gap, weight in own:
            put_varint(block, gap)
            put_zigzag(block, weight)
    for count in counts:
        put_varint(block, count)
    k = coded.tolist()
    stages = []
    for stage, count in enumerate((1, *counts)):
        classes = refdec.classes_by_activity(refdec.relative_magnitude(k[: STAGE_BOUNDS[stage]], n), count)
        channels = range(*STAGE_BOUNDS[stage : stage + 2]) if stage < 5 else range(38, 68, 3)
        stages.append([part for c in channels for part in parted(coded[c], classes, count)])
    stages += [[], []]
    for i in range(10):
        f, centres = splits.get(i, (0, []))
        put_varint(block, f)
        for centre in centres:
            put_zigzag(block, centre)
        split = (f & 1, f >> 1 & 1, *centres, 0, 0)[:4]
        x, y, z = range(38 + 3 * i, 41 + 3 * i)
        stages[6] += parted(coded[y], refdec.y_classes(split, k[x]), 5)
        stages[7] += parted(coded[z], refdec.z_classes(split, k[x], k[y]), 7)
    return bytes(block) + staged(stages, lengths) + extra


def staged_planes(planes, *, counts=(), form=STAGED, lengths=None, extra=b""):
    """A section of residuals int32 [C, H, W] per plane. lengths: of all stages but the last, from the true ones."""
    block = bytearray([form])
    for count in counts:
        put_varint(block, count)
    stages = []
    for stage, count in enumerate((1, *counts)):
        stages.append([])
        for plane in planes:
            first = 1 << stage if stage else 0
            channels = plane.reshape(len(plane), -1)
            classes = refdec.classes_by_activity(
                refdec.cell_activity(channels[:first].tolist(), *plane.shape[1:]), count
            )
            stages[-1] += [p for channel in channels[first : 2 << stage] for p in parted(channel, classes, count)]
    return bytes(block) + staged(stages, lengths) + extra


def parted(channel, classes, count):
    """The symbols of each class."""
    return [channel[np.array(classes) == q] for q in range(count)]


def staged(stages, lengths=None):
    """The lengths of all stages but the last, and the stages."""
    payloads, out = [encode_channels(stage, effort=1).payload for stage in stages], bytearray()
    true = [len(payload) for payload in payloads]
    for length in lengths(*true) if lengths else true[:-1]:
        put_varint(out, length)
    return bytes(out) + b"".join(payloads)


def both(section, rows=ROWS):
    """Outcome of the reference decoder and of the package: symbols or the error's name."""
    ours = outcome(lambda d: refdec.decode_attributes(d, *WIDTHS, rows, refdec.Past(), False), section, refdec.Fault)
    return ours, outcome(lambda d: read_attributes(d, Widths(*WIDTHS), rows)[1].tolist(), section, DecodeError)


def both_planes(section, shapes):
    ours = outcome(lambda d: refdec.decode_planes(d, shapes), section, refdec.Fault)

    def theirs(data):
        return [channel.ravel().tolist() for plane in read_planes(data, shapes) for channel in plane]

    return ours, outcome(theirs, section, DecodeError)


ONE = 1 << 10
FINE_BLOCKS = {  # residual, options, and symbols of some channels; channel 67 is never predicted
    "no terms": (3, {}, {1: 3, 3: 3}),
    "two terms": (3, {"terms": {3: (2, [(0, -ONE), (1, ONE >> 1)])}}, {1: 3, 3: 2}),  # -1.5 rounds to -1
    "just under a half": (3, {"terms": {3: (2, [(0, -ONE), (1, (ONE >> 1) - 1)])}}, {3: 1}),
    "all terms": (3, {"terms": {37: (37, [(0, 1 << 15)] * 37)}}, {36: 3, 37: 3 + 37 * 32 * 3}),
    "largest weights": (3, {"terms": {1: (1, [(0, -(1 << 15))]), 3: (1, [(1, 1 << 15)])}}, {1: -93, 3: -2973}),
    "splits": (3, {"splits": {0: (1, [5]), 1: (2, [-K_MAX, K_MAX]), 9: (3, [3, 3])}}, {38: 3, 42: 3, 66: 3}),
    "class counts": (3, {"counts": (8, 1, 2, 7, 8)}, {37: 3}),
    "largest symbols": (-K_MAX, {"counts": (8,) * 5, "splits": {0: (3, [K_MAX, K_MAX])}}, {39: -K_MAX}),
    "largest result": (K_MAX >> 1, {"terms": {3: (1, [(0, ONE)])}}, {3: K_MAX - 1}),
}


@pytest.mark.parametrize("name", FINE_BLOCKS)
def test_prediction_blocks_at_their_limits_are_read_by_both(name):
    residual, options, expected = FINE_BLOCKS[name]
    ours, theirs = both(staged_attributes(same(residual), **options))
    assert ours == theirs and len(ours) == 68
    for channel, symbol in {67: residual, **expected}.items():
        assert ours[channel] == [symbol] * ROWS, channel


BROKEN_BLOCKS = {
    "unknown form": ({"form": 3}, "UnsupportedFeature"),
    "more terms than channels before": ({"terms": {2: (3, [(0, 1), (0, 1), (0, 1)])}}, "LimitExceeded"),
    "predicted from itself": ({"terms": {2: (1, [(2, 1)])}}, "Malformed"),
    "predicted from a later channel": ({"terms": {2: (2, [(1, 1), (30, 1)])}}, "Malformed"),
    "gap over its limit": ({"terms": {37: (1, [(39, 1)])}}, "LimitExceeded"),
    "weight over its limit": ({"terms": {1: (1, [(0, (1 << 15) + 1)])}}, "LimitExceeded"),
    "weight under its limit": ({"terms": {1: (1, [(0, -(1 << 15) - 1)])}}, "LimitExceeded"),
    "class count 0": ({"counts": (1, 1, 1, 1, 0)}, "Malformed"),
    "class count 9": ({"counts": (9, 1, 1, 1, 1)}, "LimitExceeded"),
    "unknown split": ({"splits": {4: (4, [0])}}, "LimitExceeded"),
    "centre of x over K": ({"splits": {4: (1, [K_MAX + 1])}}, "LimitExceeded"),
    "centre of y under -K": ({"splits": {4: (2, [0, -K_MAX - 1])}}, "LimitExceeded"),
    "length over what is left": ({"lengths": lambda *n: (*n[:6], sum(n) + 3)}, "LimitExceeded"),  # takes two bytes
    "length of all that is left": ({"lengths": lambda *n: (*n[:6], sum(n) + 2)}, "Malformed"),
    "stages a byte longer than the rest": ({"lengths": lambda *n: (*n[:6], n[6] + n[7] + 1)}, "Malformed"),
    "stage 0 a byte short": ({"lengths": lambda a, b, *n: (a - 1, b + 1, *n[:5])}, "Malformed"),
    "stage 6 a byte short": ({"lengths": lambda *n: (*n[:6], n[6] - 1)}, "Malformed"),
    "bytes after the last stage": ({"extra": b"\1\0\0\0"}, "Malformed"),
}


@pytest.mark.parametrize("name", BROKEN_BLOCKS)
def test_broken_prediction_blocks_are_refused_by_both(name):
    options, fault = BROKEN_BLOCKS[name]
    assert both(staged_attributes(same(3), **options)) == (fault, fault)


def test_a_predicted_symbol_over_its_limit_is_refused_by_both():
    section = staged_attributes(same((K_MAX >> 1) + 1), terms={3: (1, [(0, ONE)])})
    assert both(section) == ("Malformed", "Malformed")


def any_terms(rng):
    """Terms of a few channels, weak enough that no symbol passes its limit."""
    terms = {}
    for c in rng.choice(np.arange(1, 38), 5, replace=False).tolist():
        channels = np.sort(rng.choice(c, min(c, 3), replace=False))
        gaps = (np.diff(channels, prepend=-1) - 1).tolist()
        terms[c] = (len(gaps), [(gap, int(rng.integers(-ONE, ONE))) for gap in gaps])
    return terms


@given(st.integers(1, 30), st.integers(0, 2**32 - 1), st.lists(st.integers(1, 8), min_size=5, max_size=5))
@settings(max_examples=8)
def test_any_attributes_in_stages_are_read_alike(rows, seed, counts):
    rng = np.random.default_rng(seed)
    coded = busy(rng, (68, 1, rows)).reshape(68, rows)
    splits = {i: (f, rng.integers(-3, 4, (0, 1, 2, 2)[f]).tolist()) for i, f in enumerate(rng.integers(0, 4, 10))}
    section = staged_attributes(coded, terms=any_terms(rng), counts=counts, splits=splits)
    ours, theirs = both(section, rows)
    assert ours == theirs and ours[0] == coded[0].tolist() and ours[38:] == coded[38:].tolist()


@pytest.mark.parametrize("rows", [2, 300])
def test_classes_of_the_largest_attributes_are_the_same(rows):
    coded = np.ones((68, rows), np.int32)
    wide = [0, 6, 12, 20, 29, 38, 39, 40]
    coded[wide] = np.random.default_rng(rows).choice([-K_MAX, -1, 0, 1, K_MAX], (len(wide), rows))
    ours, theirs = both(staged_attributes(coded, counts=(3, 4, 5, 7, 8), splits={0: (3, [K_MAX, -K_MAX])}), rows)
    assert ours == theirs == coded.tolist()


def test_damage_to_attributes_in_stages_has_the_same_outcome():
    terms = {c: (2, [(0, 700), (c % 2, -300)]) for c in range(2, 38)}
    splits = {i: (i % 4, [2, 4][: (0, 1, 2, 2)[i % 4]]) for i in range(10)}
    coded = busy(np.random.default_rng(3), (68, 1, ROWS), spread=0.5).reshape(68, ROWS)
    section = staged_attributes(coded, terms=terms, counts=(2, 3, 1, 8, 2), splits=splits)
    assert "fine" in assert_same_outcomes(section, both, 400, 300)


@given(st.integers(1, 9), st.lists(st.tuples(st.integers(1, 7), st.integers(1, 7)), min_size=1, max_size=7), st.data())
@settings(max_examples=15)
def test_any_planes_in_stages_are_read_alike(channels, sides, data):
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
    spread = data.draw(st.sampled_from((1, 16)))
    number = max(1, (channels - 1).bit_length()) - 1
    counts = data.draw(st.lists(st.integers(1, 8), min_size=number, max_size=number))
    planes = [busy(rng, (channels, h, w), spread) for h, w in sides]
    ours, theirs = both_planes(staged_planes(planes, counts=counts), [plane.shape for plane in planes])
    assert ours == theirs == [channel.ravel().tolist() for plane in planes for channel in plane]


BROKEN_PLANES = {
    "unknown form": ({"form": 2}, "UnsupportedFeature"),
    "class count 0": ({"counts": (1, 0)}, "Malformed"),
    "class count 9": ({"counts": (9, 1)}, "LimitExceeded"),
    "length over what is left": ({"lengths": lambda *n: (n[0], sum(n) + 2)}, "LimitExceeded"),
    "length of all that is left": ({"lengths": lambda *n: (n[0], sum(n) + 1)}, "Malformed"),
    "stages a byte longer than the rest": ({"lengths": lambda *n: (n[0], n[1] + n[2] + 1)}, "Malformed"),
    "stage 0 a byte short": ({"lengths": lambda a, b, c: (a - 1, b + 1)}, "Malformed"),
    "stage 1 a byte short": ({"lengths": lambda a, b, c: (a, b - 1)}, "Malformed"),
    "bytes after the last stage": ({"extra": b"\1\0\0\0"}, "Malformed"),
}
SHAPES = [(5, 3, 4), (5, 1, 7), (5, 1, 1)]


@pytest.mark.parametrize("name", BROKEN_PLANES)
def test_broken_planes_are_refused_by_both(name):
    options, fault = BROKEN_PLANES[name]
    section = staged_planes([np.full(shape, 3, np.int32) for shape in SHAPES], **{"counts": (1, 1), **options})
    assert both_planes(section, SHAPES) == (fault, fault)


def test_damage_to_planes_in_stages_has_the_same_outcome():
    rng = np.random.default_rng(5)
    section = staged_planes([busy(rng, shape, spread=1) for shape in SHAPES], counts=(3, 2))
    assert "fine" in assert_same_outcomes(section, lambda d: both_planes(d, SHAPES), 400, 12)


def take_apart(data):
    preamble, chunks = read_preamble(data), []
    offset = preamble.size
    while offset < len(data):
        chunks.append(read_chunk(data, offset))
        offset = chunks[-1].end
    return canonical.unpack(preamble.header), [(c.type, c.flags, c.payload) for c in chunks]


def put_together(header, chunks):
    """A file with right lengths, ids and CRCs, whatever its payloads say."""
    packed = canonical.pack({**header, 1: [[t, len(p)] for t, _, p in chunks]})
    scene_id = scene_id_of(packed)
    return write_preamble(packed) + b"".join(write_chunk(t, f, scene_id, p) for t, f, p in chunks)


def outcome(function, data, fault):
    try:
        return function(data)
    except fault as error:
        return getattr(error, "name", type(error).__name__)


@pytest.mark.parametrize("coding", ["ans best", "lzma"])
def test_damage_behind_right_checksums_has_the_same_outcome(coding):
    """Both accept with the same contents, or both refuse with the same error's name."""
    header, chunks = take_apart(encode(make_scene(3, anchors=20), layers=2, effort=3, **CODINGS[coding]))
    rng, seen = random.Random(1), set()
    for _ in range(100):
        damaged, which = list(chunks), rng.randrange(3)
        kind, flags, payload = damaged[which]
        parameters = 4 + struct.unpack_from("<I", payload)[0]
        at = rng.choice((rng.randrange(parameters), rng.randrange(parameters, len(payload))))
        cut = rng.randrange(4) == 0
        changed = payload[:at] + (b"" if cut else bytes([rng.randrange(256)])) + payload[at + 1 :]
        damaged[which] = (kind, flags, changed)
        data = put_together(header, damaged)
        found = outcome(refdec.hashes, data, refdec.Fault)
        assert found == outcome(hashes, data, DecodeError), changed.hex()
        seen.add(found if isinstance(found, str) else "fine")
    assert {"Malformed", "fine"} <= seen


FRAME_FAULTS = {
    "Truncated": lambda data: data[:-1],
    "Malformed": lambda data: data + b"\0",
    "BadSignature": lambda data: b"\x88" + data[1:],
    "UnsupportedVersion": lambda data: data[:8] + b"\1" + data[9:],
    "LimitExceeded": lambda data: data[:13] + b"\x41" + data[14:],
    "ChecksumMismatch": lambda data: data[:-30] + bytes([data[-30] ^ 1]) + data[-29:],
}


@pytest.mark.parametrize("name", FRAME_FAULTS)
def test_faults_of_the_frame(name):
    data = FRAME_FAULTS[name](encode(make_scene(3), layers=2, effort=1))
    assert outcome(refdec.hashes, data, refdec.Fault) == outcome(hashes, data, DecodeError) == name


def test_ancillary_and_unknown_chunks():
    data = encode(make_scene(3), layers=2, effort=1)
    header, chunks = take_apart(data)
    skipped = put_together(header, [chunks[0], (40000, 1, b"x"), *chunks[1:], (9, 1, b"")])
    assert refdec.hashes(skipped) == hashes(data)
    for wrong, name in (((9, 0, b""), "UnsupportedFeature"), ((1, 1, chunks[1][2]), "Malformed")):
        other = put_together(header, [chunks[0], wrong])
        assert outcome(refdec.hashes, other, refdec.Fault) == name


def test_an_empty_list_of_networks_is_malformed():
    header, chunks = take_apart(encode(make_scene(3, layers=(0, 1), heads=({}, {})), layers=2, effort=1))
    _, _, payload = chunks[1]
    (length,) = struct.unpack_from("<I", payload)
    meta = canonical.pack({**canonical.unpack(payload[4 : 4 + length]), 5: []})
    chunks[1] = (1, 0, struct.pack("<I", len(meta)) + meta + payload[4 + length :])
    assert outcome(refdec.hashes, put_together(header, chunks), refdec.Fault) == "Malformed"


MSGPACK = [0, 127, 128, 255, 256, 65535, 65536, 2**32 - 1, 2**32, 2**64 - 1]
MSGPACK += [-1, -32, -33, -128, -129, -32768, -32769, -(2**31), -(2**31) - 1, -(2**63)]
MSGPACK += [True, False, 0.5, -0.0, "", "é" * 16, "x" * 31, "x" * 32, "x" * 256, b"", b"x" * 255, b"x" * 65536]
MSGPACK += [[], [[]] * 16, [[[[]]]], {}, {0: 1, 2**32 - 1: 2}, {i: i for i in range(20)}, ["x" * 65536, [0] * 65536]]


@pytest.mark.parametrize("value", MSGPACK, ids=range(len(MSGPACK)))
def test_canonical_msgpack(value):
    assert refdec.unpack(canonical.pack(value)) == value


@pytest.mark.parametrize(
    "data",
    "cc7f cd00ff ce0000ffff cf00000000ffffffff d001 d0e0 d1ff80 d9 d90178 c0 cb3fe0000000000000 ca7f800000 d40000 "
    "8201010001 82010101 81a17801 81c301 9191919190 81ff00 a1ff 0000 dc0001c2 c5000178 93 "
    "81cf000000010000000000".split(),
)
def test_other_msgpack_is_malformed_to_both(data):
    data = bytes.fromhex(data)
    assert outcome(refdec.unpack, data, refdec.Fault) == outcome(canonical.unpack, data, DecodeError) == "Malformed"


def test_the_command_prints_the_hashes_and_one_line_for_a_fault(tmp_path):
    data = encode(make_scene(3), layers=2, effort=1)
    for content, code in ((data, 0), (data[:-1], 1), (None, 1)):
        path = tmp_path / f"{code}.pd4"
        if content is None:
            path.unlink()
        else:
            path.write_bytes(content)
        command = [sys.executable, "-I", "-S", str(SPEC / "refdec.py"), str(path)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60)
        assert done.returncode == code
        if code:
            assert done.stdout == "" and done.stderr.count("\n") == 1 and str(path) in done.stderr
        else:
            assert json.loads(done.stdout) == hashes(data) and done.stderr == ""


def test_it_imports_the_standard_library_alone():
    names = {a.name for n in ast.walk(ast.parse(SOURCE)) if isinstance(n, ast.Import) for a in n.names}
    names |= {n.module for n in ast.walk(ast.parse(SOURCE)) if isinstance(n, ast.ImportFrom)}
    assert "struct" in names and names <= set(sys.stdlib_module_names)


def clauses():
    """Clause number -> its text with markup and line ends removed."""
    parts = re.split(r"^#{2,3} (\d+(?:\.\d+)?) ", TEXT, flags=re.M)
    return {number: plain(text) for number, text in zip(parts[1::2], parts[2::2], strict=True)}


def plain(text):
    return re.sub(r"\s+", " ", re.sub(r"[`*|\\]", "", text)).strip()


def test_every_quotation_is_in_its_clause():
    texts = clauses()
    blocks = re.findall(r"^ *# (\d+(?:\.\d+)?) ([A-Z][^:\n]*): (\".*(?:\n *# .*)*)", SOURCE, flags=re.M)
    quoted = set()
    for number, title, body in blocks:
        for piece in re.split(r"\n *# (?=\d+(?:\.\d+)? [A-Z][^:\n]*: \")", body):
            words = plain(re.sub(r"\n *# ", " ", piece))
            head = re.match(r"(\d+(?:\.\d+)?) ([A-Z][^:]*): (.*)", words)
            number, title, words = head.groups() if head else (number, title, words)
            assert texts[number].startswith(title), (number, title)
            for quotation in words.strip('"').split('" "'):
                assert quotation in texts[number], (number, quotation)
                quoted.add(number)
    assert len(quoted) > 30


def test_the_tables_and_limits_of_the_specification():
    assert K_MAX == refdec.K and MAX_SYMBOL == refdec.MAX_SYMBOL
    for heading, table, values in (("B.1", NORMAL, refdec.T), ("B.2", OCTAVE, refdec.M)):
        printed = TEXT.split(f"### {heading} ")[1].split("```")[1].split()
        assert [int(v) for v in printed] == table.tolist() == values
    text = plain(TEXT)
    check = [int(v) for v in re.search(r"gives 0, ([\d, ]+), 2\^24", text)[1].split(",")]
    assert refdec.table_of(refdec.norm_cdf(7, 832, 0), 1) == [0, *check, 1 << 24]
    activity, classes = re.search(r"activities ([\d, ]+) and C = 3 .* and classes ([\d, ]+)\.", text).groups()
    found = refdec.classes_by_activity([int(v) for v in activity.split(",")], 3)
    assert found == [int(v) for v in classes.split(",")]
    residuals, magnitudes = re.search(
        r"residuals ([\d, −]+) of one channel have the relative magnitudes ([\d, ]+)\.", text
    ).groups()
    found = refdec.relative_magnitude([[int(v.replace("−", "-")) for v in residuals.split(",")]], 4)
    assert found == [int(v) for v in magnitudes.split(",")]


def test_the_example_of_an_octree():
    text = plain(TEXT.split("### 10.4 ")[1].split("\n## ")[0])
    places = re.search(r"Four anchors at (.*?)\. The minimum", text)[1]
    cells = np.array([[int(v) for v in place.split(",")] for place in re.findall(r"\((.*?)\)", places)], np.int32)
    head, channels = position_channels(cells[morton_order(cells)])
    assert head == bytes.fromhex(re.search(r"begins ((?:[0-9A-F]{2} ?)+);", text)[1])
    printed = re.search(r"that are not empty are ([\d ·]+) · 1,", text)[1] + " · 1"
    assert [c.tolist() for c in channels if len(c)] == [[int(v) for v in c.split()] for c in printed.split("·")]


def test_the_annotated_file():
    appendix = TEXT.split("## A An annotated file")[1].split("## B Tables")[0]
    data = b""
    for offset, cell in re.findall(r"^\| (\d+) \| (`[^|]*) \|", appendix, flags=re.M):
        assert int(offset) == len(data)
        repeated = re.fullmatch(r"`(..) × (\d+)`", cell)
        data += (
            bytes.fromhex(repeated[1]) * int(repeated[2]) if repeated else bytes.fromhex(re.sub("`|<br>", " ", cell))
        )
    assert f"{len(data)} bytes" in appendix
    (found,) = refdec.hashes(data)
    assert [found] == hashes(data)
    assert found["symbols"] in appendix and found["tensors"] in appendix
    (layer,) = refdec.decode(data)
    assert layer.symbols["anchor"] == [-1, 0, 2] and layer.symbols["mask_own"] == [77]
    assert set(layer.symbols["feature"] + layer.symbols["network.1.weight.0"]) == {2}
