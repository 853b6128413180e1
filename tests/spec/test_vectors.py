"""Every conformance vector against the package, its stream, and the reference decoder."""

import hashlib
import importlib.util
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from vectors.reference import Reference, reference_source

from pd4dgs_codec.errors import DecodeError
from pd4dgs_codec.format.container import read_preamble
from pd4dgs_codec.format.decoder import decode_partial
from pd4dgs_codec.format.header import unpack_header
from pd4dgs_codec.format.info import hashes
from pd4dgs_codec.format.stream import open_stream

ROOT = Path(__file__).parents[2]
SPEC, VECTORS, TOOL = ROOT / "spec", ROOT / "spec" / "vectors", ROOT / "tools" / "make_vectors.py"
TEXT = (SPEC / "format.md").read_text(encoding="utf-8")
MANIFEST = json.loads((VECTORS / "manifest.json").read_text(encoding="utf-8"))["vectors"]
ERRORS = re.findall(r"^\| (\w+) \| ", TEXT.split("## 15 ")[1].split("## 16 ")[0], flags=re.M)[1:]

_module = importlib.util.spec_from_file_location("refdec", SPEC / "refdec.py")
refdec = importlib.util.module_from_spec(_module)
_module.loader.exec_module(refdec)

each_vector = pytest.mark.parametrize("vector", MANIFEST, ids=[v["file"] for v in MANIFEST])
DEAR = {v["file"] for v in MANIFEST if v["file"].startswith("dear/")}
#: The reference decoder, which is plain Python, takes up to a quarter of a minute for these.
LARGE = {"valid/planes-products-over-2-53.pd4", "faulty/low-bits-symbols-over-limit.pd4", *DEAR}


def but_slow(files):
    """Every vector; those of `files` with `-m slow` only."""
    marks = [pytest.mark.slow]
    listed = [pytest.param(v, id=v["file"], marks=marks if v["file"] in files else []) for v in MANIFEST]
    return pytest.mark.parametrize("vector", listed)


def read(vector):
    return (VECTORS / vector["file"]).read_bytes()


def outcome(function, *arguments):
    """What it returns, or the name of the error it raises."""
    try:
        return function(*arguments)
    except DecodeError as error:
        return type(error).__name__
    except refdec.Fault as error:
        return error.name


def slices(vector):
    """The layer of each slice that decodes."""
    return vector.get("slices", [layer["layer"] for layer in vector["layers"]])


def prefixes(vector):
    """(highest layer, hashes) of every prefix that must decode; of a valid file all but the longest, which is all."""
    layers = vector["layers"]
    listed = header_of(read(vector)).chunks if layers else ()
    whole = [row for row in layers if slices(vector).count(row["layer"]) == [t for t, _ in listed].count(row["layer"])]
    own = {int(layer): rows for layer, rows in vector.get("prefixes", {}).items()}
    numbers = [row["layer"] for row in whole]
    return [
        (number, own.get(number, layers[: i + 1]))
        for i, number in enumerate(numbers)
        if "error" in vector or i + 1 < len(layers)
    ]


def test_the_manifest_lists_the_files_that_are_there():
    listed = [v["file"] for v in MANIFEST]
    there = {p.relative_to(VECTORS).as_posix() for p in VECTORS.rglob("*") if p.is_file()}
    assert len(listed) == len(set(listed))
    assert there == {*listed, "manifest.json", "README.md"}


def test_the_vectors_exercise_every_clause_and_error():
    clauses = set(re.findall(r"^#{2,3} (\d+(?:\.\d+)?|[A-E]) ", TEXT, flags=re.M))
    used = {clause for v in MANIFEST for clause in v["clauses"]}
    divided = {c.split(".")[0] for c in clauses if "." in c}
    bit_exact = {c for c in clauses - divided if c[0].isdigit() and 3 <= int(c.split(".")[0]) <= 12}
    assert {"3.1", "4", "12.4"} <= bit_exact
    assert used <= clauses and bit_exact <= used
    assert {v["error"] for v in MANIFEST if "error" in v} == set(ERRORS)


def test_a_faulty_vector_names_the_clause_that_it_breaks():
    for vector in MANIFEST:
        assert ("clause" in vector) == ("error" in vector)
        assert vector.get("clause", vector["clauses"][0]) == vector["clauses"][0]


def test_the_manifest_says_what_a_decoder_of_mode_ans_only_answers():
    """As the reference decoder does where its header knows mode ans and coded deformations alone."""
    both, ans_only = "registered(header[key], (0, 1), ", "registered(header[key], (0,), "
    reference = Reference(reference_source().replace(both, ans_only))
    assert reference.source.count(ans_only) == 1
    for vector in MANIFEST:
        if vector["ans_only"] == "same":
            header = header_of(read(vector))
            assert header is None or (header.mode == "ans" and header.deformation == "coded")
        else:
            assert reference.decode(read(vector)).error == vector["ans_only"] == "UnsupportedFeature"


def header_of(data):
    """The header, if there is one that can be read."""
    try:
        return unpack_header(read_preamble(data).header)
    except DecodeError:
        return None


@each_vector
def test_the_package_gives_what_the_manifest_says(vector):
    data = read(vector)
    assert (len(data), hashlib.sha256(data).hexdigest()) == (vector["size"], vector["sha256"])
    assert outcome(hashes, data) == vector.get("error", vector["layers"])
    for layer, expected in prefixes(vector):
        assert hashes(data, layer) == expected


@but_slow(LARGE)
def test_the_reference_decoder_gives_what_the_manifest_says(vector):
    data = read(vector)
    assert outcome(refdec.hashes, data) == vector.get("error", vector["layers"])
    for layer, expected in prefixes(vector):
        assert refdec.hashes(data, layer) == expected


@but_slow(DEAR)
def test_a_stream_yields_the_layers_before_the_fault(vector):
    stream, scenes = open_stream(), []
    error = outcome(lambda: scenes.extend(stream.feed(read(vector))))
    assert [scene.layers[-1] for scene in scenes] == sorted(set(slices(vector)))
    assert stream.slices == len(slices(vector))
    assert (error or outcome(stream.finish)) == vector.get("error")


@pytest.mark.parametrize("vector", [v for v in MANIFEST if "error" in v], ids=lambda v: v["file"])
def test_the_package_says_where_the_fault_lies(vector):
    with pytest.raises(DecodeError) as caught:
        hashes(read(vector))
    assert caught.value.chunk == vector.get("chunk")
    if "offset" in vector:
        assert caught.value.offset == vector["offset"]
    assert vector["prefix"] == (vector["layers"][-1]["layer"] if vector["layers"] else None)


@pytest.mark.parametrize("vector", [v for v in MANIFEST if v.get("error") == "Truncated"], ids=lambda v: v["file"])
def test_a_cut_file_gives_its_longest_prefix_if_asked(vector):
    if vector["prefix"] is None:
        assert outcome(decode_partial, read(vector)) == "Truncated"
    else:
        scene, complete = decode_partial(read(vector))
        assert not complete and scene.layers == tuple(layer["layer"] for layer in vector["layers"])


@pytest.mark.parametrize("name", ["valid/layers-0-1-2", "uncommon/ancillary-private", "faulty/crc-layer-1"])
def test_the_reference_decoder_as_a_command(name):
    (vector,) = (v for v in MANIFEST if v["file"] == name + ".pd4")
    command = [sys.executable, "-I", "-S", str(SPEC / "refdec.py"), str(VECTORS / vector["file"])]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    if "error" in vector:
        assert done.returncode == 1 and f": {vector['error']}: " in done.stderr and done.stderr.count("\n") == 1
    else:
        assert done.returncode == 0 and json.loads(done.stdout) == vector["layers"]


def test_the_tool_rebuilds_the_same_bytes(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [str(TOOL), "--check"])
    assert importlib.import_module("make_vectors").main() == 0, capsys.readouterr().err


def test_the_tool_names_every_difference(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(TOOL.parent))
    tool = importlib.import_module("make_vectors")
    wanted = {"manifest.json": b"{}", "valid/a.pd4": b"a", "valid/b.pd4": b"b"}
    tool.write(wanted, tmp_path)
    assert list(tool.differences(wanted, tmp_path)) == []
    (tmp_path / "valid" / "a.pd4").write_bytes(b"A")
    (tmp_path / "valid" / "b.pd4").rename(tmp_path / "valid" / "c.pd4")
    differences = ["valid/c.pd4: not a vector", "valid/a.pd4: other bytes", "valid/b.pd4: missing"]
    assert list(tool.differences(wanted, tmp_path)) == differences
    tool.write(wanted, tmp_path)
    assert list(tool.differences(wanted, tmp_path)) == []
