"""The reference decoder agrees with the package, and quotes the specification that it claims to follow."""

import ast
import math
import re
import sys
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import refdec
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import busy, make_scene, scenes, small_file

from pd4dgs_codec.entropy.positions import position_channels
from pd4dgs_codec.entropy.priors import K_MAX, NORMAL, OCTAVE
from pd4dgs_codec.format.decoder import decode
from pd4dgs_codec.format.encoder import encode
from pd4dgs_codec.format.info import hashes
from pd4dgs_codec.kinds.splats import harmonics
from pd4dgs_codec.morton import morton_order
from pd4dgs_codec.tensors.quantise import MAX_SYMBOL, dequantise

SPEC = Path(__file__).parents[2] / "spec"
TEXT = (SPEC / "format.md").read_text(encoding="utf-8")
SOURCE = (SPEC / "refdec.py").read_text(encoding="utf-8")

CODINGS = {
    "ans best": {},
    "ans gauss": {"priors": "gauss"},
    "lzma": {"mode": "lzma"},
    "slices": {"slices": 1500},
    "fills": {"slices": 1500, "fill": lambda prefix: (prefix.level, 0, 255, 64)},
}


@given(scenes(), st.sampled_from(sorted(CODINGS)))
@settings(max_examples=15)
def test_hashes_of_any_scene_are_those_of_the_package(scene, coding):
    data = encode(scene, layers=2, effort=1, verify=False, **CODINGS[coding])
    assert refdec.hashes(data) == hashes(data)


def test_tensors_by_name_and_prefixes():
    data = small_file()
    scene, layers = decode(data), refdec.decode(data)
    assert [layer.number for layer in layers] == [0, 1, 2]
    own = slice(scene.rows[0], scene.rows[1])
    for tensor, name in (("position", "anchor"), ("row.0", "feature"), ("row.1", "scaling_log"), ("row.2", "offset")):
        assert layers[1].tensors[tensor] == getattr(scene, name)[own].ravel().tolist(), name
    assert layers[1].tensors["plane.0.4"] == scene.global_deformation.planes[0]["yt"].ravel().tolist()
    assert layers[2].tensors["bias.4.0"] == scene.local_deformation.networks["offset"][0][1].tolist()
    assert layers[0].cells == list(map(tuple, scene.anchor_q[: scene.rows[0]].tolist()))
    prefix = refdec.decode(data, max_layer=1)
    assert [p.tensors for p in prefix] == [p.tensors for p in layers[:2]] and len(prefix) == 2


def test_hashes_of_busy_planes():
    scene, rng = make_scene(5, layers=(0, 1), anchors=50, channels=5, sides=(20, 25, 22, 4)), np.random.default_rng(6)
    planes = {
        name: dequantise(busy(plane.shape, rng), scene.steps.planes_global)
        for name, plane in scene.global_deformation.planes[0].items()
    }
    scene = replace(scene, global_deformation=replace(scene.global_deformation, planes=(planes,)))
    data = encode(scene, layers=2, effort=2, omit="nothing")
    assert refdec.hashes(data) == hashes(data)


def test_it_imports_the_standard_library_alone():
    nodes = list(ast.walk(ast.parse(SOURCE)))
    names = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    names |= {node.module for node in nodes if isinstance(node, ast.ImportFrom)}
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
    text = plain(TEXT)
    sums = re.search(r"as u32 they have the CRC-32 (\w{8}) and (\w{8})\.", text).groups()
    for crc, table, values in zip(sums, (NORMAL, OCTAVE), (refdec.T, refdec.M), strict=True):
        assert table.tolist() == values and zlib.crc32(table.astype("<u4").tobytes()) == int(crc, 16)
    tail, term = 0.0, 0.7  # the series of T, at x = 0.7
    for k in range(1, 30):
        tail, term = tail + term, term * 0.7**2 / (2 * k + 1)
    assert math.exp(-(0.7**2) / 2) / math.sqrt(2 * math.pi) * tail == pytest.approx(math.erf(0.7 / math.sqrt(2)) / 2)
    check = [int(v) for v in re.search(r"gives 0, ([\d, ]+), 2\^24", text)[1].split(",")]
    assert refdec.table_of(refdec.norm_cdf(7, 832, 0)) == [0, *check, 1 << 24]
    sentence = r"mu8 = (\d+), si = (\d+), w = (\d+) give 0, ([\d, ]+), 2\^24"
    (mu8,), (si,), (w,), cum = ([int(v) for v in part.split(",")] for part in re.search(sentence, text).groups())
    first, second = refdec.norm_cdf(7, 832, 0), refdec.norm_cdf(7, mu8, si)
    mixed = [((256 - w) * a + w * b) >> 8 for a, b in zip(first, second, strict=True)]
    assert refdec.table_of(mixed) == [0, *cum, 1 << 24]
    stream, symbols = re.search(r"the stream ((?:[0-9A-F]{2} )+)yields ([\d, ]+)\.", text).groups()
    ans, symbols = refdec.Ans(bytes.fromhex(stream)), [int(v) for v in symbols.split(",")]
    assert ans.take(len(symbols), refdec.table_of(first)) == symbols
    ans.finish()
    activity, classes = re.search(r"activities ([\d, ]+) give A = .* and classes ([\d, ]+)\.", text).groups()
    found = refdec.classes_by_activity([int(v) for v in activity.split(",")])
    assert found == [int(v) for v in classes.split(",")]
    sentence = r"residuals ([\d, −]+) of one channel have the relative magnitudes ([\d, ]+)\."
    residuals, magnitudes = re.search(sentence, text).groups()
    found = refdec.relative_magnitude([[int(v.replace("−", "-")) for v in residuals.split(",")]], 4)
    assert found == [int(v) for v in magnitudes.split(",")]
    sentence = r"predictor 1 and m = (\d+), symbols ([\d, −]+) of classes ([\d, ]+) give v = ([\d, ]+)\."
    sentence += r"\s+With predictor 2 they give v = ([\d, ]+)\."
    (m,), *lists = ([int(v.replace("−", "-")) for v in part.split(",")] for part in re.search(sentence, text).groups())
    assert [refdec.row_values(*lists[:2], m, predictor) for predictor in (1, 2)] == lists[2:]


def test_the_formulas_of_harmonics():
    block = TEXT.split("### 13.7 Splats")[1].split("```")[3]
    formulas = dict(re.findall(r"H_(\d+) = (.*?)(?=\s+H_\d|\n)", block))
    d = np.random.default_rng(1).normal(size=(20, 3))
    d /= np.linalg.norm(d, axis=1)[:, None]
    of_axes = dict(zip("xyz", d.T, strict=True))

    def value(formula):
        """Of each direction."""
        formula = re.sub(r"√\((\d+)/(\d+)π\)", r"sqrt(\1/(\2*pi))", formula)
        formula = re.sub(r"(\d)([xyz])", r"\1*\2", formula.replace("²", "**2"))
        formula = formula.replace("−", "-").replace("·", "*")
        return eval(formula, {"sqrt": np.sqrt, "pi": np.pi}, of_axes) * np.ones(len(d))

    found = np.stack([value(formulas[str(j)]) for j in range(16)], axis=1)
    assert np.abs(found - harmonics(d, 3)).max() < 1e-12


def test_the_example_of_an_octree():
    text = plain(TEXT.split("### 10.3 ")[1].split("\n## ")[0])
    places = re.search(r"Four anchors at (.*?)\. The minimum", text)[1]
    cells = np.array([[int(v) for v in place.split(",")] for place in re.findall(r"\((.*?)\)", places)], np.int32)
    head, channels = position_channels(cells[morton_order(cells)])
    assert head == bytes.fromhex(re.search(r"information begins ((?:[0-9A-F]{2} ?)+);", text)[1])
    differences = re.search(r"10\.3's anchors give ([\d, −·]+)\.", plain(TEXT))[1].replace("−", "-")
    axes = [[int(v) for v in axis.split(",")] for axis in differences.split("·")]
    assert refdec.voxels_in_order(zip(*axes, strict=True)) == list(map(tuple, cells[morton_order(cells)].tolist()))
    printed = re.search(r"that are not empty are ([\d ·]+) · 1,", text)[1] + " · 1"
    assert [c.tolist() for c in channels if len(c)] == [[int(v) for v in c.split()] for c in printed.split("·")]


def test_the_annotated_file():
    appendix = TEXT.split("## A An annotated file")[1].split("## B Numerical")[0]
    data = b""
    for offset, cell in re.findall(r"^\| (\d+) \| (`[^|]*) \|", appendix, flags=re.M):
        assert int(offset) == len(data)
        repeated = re.fullmatch(r"`(..) × (\d+)`", cell)
        written, times = (repeated[1], int(repeated[2])) if repeated else (re.sub("`|<br>", " ", cell), 1)
        data += bytes.fromhex(written) * times
    assert f"{len(data)} bytes" in appendix
    (found,) = refdec.hashes(data)
    assert [found] == hashes(data)
    assert found["symbols"] in appendix and found["tensors"] in appendix
    (layer,) = refdec.decode(data)
    assert layer.cells == [(-1, 0, 2)] and layer.symbols["own"] == [[77]]
    assert layer.symbols["row.1"] == [[2]] * 6 and layer.symbols["weight.1.0"] == [[2] * 14]
    assert decode(data).anchor_q.tolist() == [[-1, 0, 2]]  # a scene of a registered kind
