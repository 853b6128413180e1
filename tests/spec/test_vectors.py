"""Every conformance vector against the package, its stream and the reference decoder."""

import hashlib
import json
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import make_vectors
import pytest
import refdec
from vectors import cases

from pd4dgs_codec import decode
from pd4dgs_codec.errors import DecodeError
from pd4dgs_codec.format.container import read_preamble
from pd4dgs_codec.format.decoder import decode_partial, open_stream
from pd4dgs_codec.format.header import unpack_header
from pd4dgs_codec.format.info import hashes

SPEC = Path(__file__).parents[2] / "spec"
VECTORS, TEXT = SPEC / "vectors", (SPEC / "format.md").read_text(encoding="utf-8")
MANIFEST = json.loads((VECTORS / "manifest.json").read_text(encoding="utf-8"))["vectors"]
FAULTY = [v for v in MANIFEST if "error" in v]
ERRORS = re.findall(r"^\| ([\w, ]+) \| ", TEXT.split("## 15 ")[1].split("## 16 ")[0], flags=re.M)[1:]
#: The reference decoder, which is plain Python, takes seconds for these.
SLOW = {"valid/planes-products-over-2-53.pd4", *(v["file"] for v in MANIFEST if v["file"].startswith("worst-case/"))}
#: Names of vectors of millions of symbols: making them takes longer than making all others.
LARGE = {"planes-products-over-2-53", "symbols-at-limit", "symbols-over-limit"}
LARGE |= {"symbols-of-rows-over-limit", "symbols-of-step-classes-over-limit"}
#: Functions of the reference decoder that check on behalf of their callers.
HELPERS = {"need", "limited", "registered", "fields", "a_list", "integers", "reals", "a_step", "ranged", "indices_of"}
HELPERS |= {"table", "unpack", "msgpack_items"}


def read(vector):
    return (VECTORS / vector["file"]).read_bytes()


def base_of(vector):
    """The bytes of the base that is given with the file, None if none is."""
    return (VECTORS / vector["base"]).read_bytes() if "base" in vector else None


def named(found):
    """The name of an error, anything else as it is."""
    if isinstance(found, refdec.Fault):
        return found.name
    return type(found).__name__ if isinstance(found, DecodeError) else found


def outcome(function, *arguments, **options):
    """Its result, or the error that it raises."""
    try:
        return function(*arguments, **options)
    except (DecodeError, refdec.Fault) as error:
        return error


@cache
def answer(decoder, file):
    """The outcome of a vector, decoded once for all tests that ask."""
    (vector,) = (v for v in MANIFEST if v["file"] == file)
    return outcome(decoder, read(vector), base=base_of(vector))


def header_of(data):
    """The header, None if it cannot be read."""
    try:
        return unpack_header(read_preamble(data).header)
    except DecodeError:
        return None


def slices(vector):
    """The layer of each slice that decodes."""
    return vector.get("slices", [layer["layer"] for layer in vector["layers"]])


def prefixes(vector):
    """(highest layer, hashes) of every prefix of whole layers; of a valid file all but the longest."""
    layers = vector["layers"]
    listed = [kind for kind, _ in header_of(read(vector)).chunks] if layers else ()
    numbers = [n for n in (row["layer"] for row in layers) if slices(vector).count(n) == listed.count(n)]
    kept = numbers if "error" in vector else numbers[: len(layers) - 1]
    return [(number, layers[: i + 1]) for i, number in enumerate(kept)]


def wrong(vectors, check):
    """The files for which `check` fails, with what it says."""
    return {v["file"]: said for v in vectors if (said := check(v)) is not None}


def answers(decoder, vector):
    """None if a decoder gives the hashes or the error of the manifest for the file and its prefixes."""
    found = named(answer(decoder, vector["file"]))
    if found != vector.get("error", vector["layers"]):
        return found
    data, base = read(vector), base_of(vector)
    return next((layer for layer, expected in prefixes(vector) if decoder(data, layer, base) != expected), None)


def test_the_manifest_lists_the_present_files():
    listed = [v["file"] for v in MANIFEST]
    there = {p.relative_to(VECTORS).as_posix() for p in VECTORS.rglob("*") if p.is_file()}
    assert len(listed) == len(set(listed)) > 700
    assert there == {*listed, "manifest.json", "README.md"}
    for v in MANIFEST:
        data = read(v)
        assert (len(data), hashlib.sha256(data).hexdigest()) == (v["size"], v["sha256"]), v["file"]


def test_the_vectors_cover_every_clause_and_error():
    clauses = set(re.findall(r"^#{2,3} (\d+(?:\.\d+)?|[A-E]) ", TEXT, flags=re.M))
    used = {clause for v in MANIFEST for clause in v["clauses"]}
    divided = {c.split(".")[0] for c in clauses if "." in c}
    bit_exact = {c for c in clauses - divided if c[0].isdigit() and 3 <= int(c.split(".")[0]) <= 12}
    assert {"3.1", "4", "12.4"} <= bit_exact
    assert used <= clauses and bit_exact <= used
    assert {v["error"] for v in FAULTY} == {name for names in ERRORS for name in names.split(", ")}
    assert all(v["clause"] == v["clauses"][0] for v in FAULTY)
    assert len({(v["clause"], v["error"]) for v in FAULTY}) >= 58


def test_the_package_decodes_every_vector_as_the_manifest_says():
    assert wrong(MANIFEST, lambda v: answers(hashes, v)) == {}


@pytest.mark.parametrize("slow", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_reference_decoder_decodes_every_vector_as_the_manifest_says(slow):
    assert wrong([v for v in MANIFEST if (v["file"] in SLOW) == slow], lambda v: answers(refdec.hashes, v)) == {}


def quoted_clauses():
    """First line of each function of the reference decoder -> the clauses quoted above it, or above its class."""
    found, above, of_class = {}, [], None
    for number, line in enumerate((SPEC / "refdec.py").read_text(encoding="utf-8").splitlines(), 1):
        clauses = re.findall(r'^ *# (\d+(?:\.\d+)?) [A-Z][^:]*: "', line)
        if line.lstrip().startswith("#"):
            above += clauses
            continue
        if line.startswith("class "):
            of_class = above
        elif line.startswith("def "):
            found[number], of_class = set(above), None
        elif line.startswith("    def ") and of_class is not None:
            found[number] = set(above or of_class)
        above = []
    return found


def test_each_faulty_vector_is_refused_by_a_check_that_quotes_its_clause():
    quoted = quoted_clauses()

    def check(vector):
        frames, traceback = [], answer(refdec.hashes, vector["file"]).__traceback__
        while traceback is not None:
            frames.append(traceback.tb_frame)
            traceback = traceback.tb_next
        clauses = set()
        for frame in reversed(frames):
            clauses |= quoted.get(frame.f_code.co_firstlineno, set())
            helper = frame.f_code.co_name in HELPERS or isinstance(frame.f_locals.get("self"), refdec.Reader)
            if not helper and frame.f_code.co_firstlineno in quoted and not frame.f_code.co_name.startswith("<"):
                break
        return None if vector["clause"] in clauses else (vector["clause"], clauses)

    assert wrong(FAULTY, check) == {}


def test_the_package_says_where_each_fault_lies():
    def check(vector):
        error = answer(hashes, vector["file"])
        assert isinstance(error, DecodeError) and str(error).isprintable(), vector["file"]  # one line
        place = error.chunk, error.offset if "offset" in vector else None
        return None if place == (vector.get("chunk"), vector.get("offset")) else place

    assert wrong(FAULTY, check) == {}
    assert all(v["prefix"] == (v["layers"][-1]["layer"] if v["layers"] else None) for v in FAULTY)


def test_scenes_are_made_of_the_tensors_that_obey_their_kinds():
    def check(vector):
        found = named(outcome(decode, read(vector), base=base_of(vector)))
        wanted = vector.get("error", vector.get("scene"))
        return None if (found if isinstance(found, str) else None) == wanted else found

    assert wrong(MANIFEST, check) == {}
    assert {v["scene"] for v in MANIFEST if "scene" in v} == {"Malformed", "UnsupportedFeature"}


def test_a_stream_yields_the_slices_before_a_fault():
    def check(vector):
        stream, scenes = open_stream(base_of(vector)), []
        error = outcome(lambda: scenes.extend(stream.feed(read(vector)))) or outcome(stream.finish)
        found = [scene.layers[-1] for scene in scenes], stream.slices, named(error)
        return None if found == (sorted(set(slices(vector))), len(slices(vector)), vector.get("error")) else found

    made = [v for v in MANIFEST if "scene" not in v and not v["file"].startswith("worst-case/")]
    assert wrong(made, check) == {}


def test_a_cut_file_gives_its_longest_prefix_if_asked():
    def check(vector):
        found = named(outcome(decode_partial, read(vector)))
        if vector["prefix"] is None:
            return None if found == "Truncated" else found
        scene, complete = found
        return None if scene.layers == tuple(x["layer"] for x in vector["layers"]) and not complete else scene.layers

    assert wrong([v for v in MANIFEST if v.get("error") == "Truncated"], check) == {}


def test_the_manifest_says_what_a_decoder_of_mode_ans_only_answers():
    for v in MANIFEST:
        headers = [outcome(refdec.unpack, data[20 : 20 + int.from_bytes(data[12:16], "little")])
            for data in (read(v), base_of(v)) if data is not None]  # fmt: skip
        lzma = any(isinstance(header, dict) and header.get(2) == 1 and header[2] is not True for header in headers)
        assert v["ans_only"] == ("UnsupportedFeature" if lzma else "same"), v["file"]


@pytest.mark.parametrize("name", ["valid/layers-0-1-2", "faulty/crc-layer-1", "valid/adds-slices"])
def test_the_reference_decoder_as_a_command(name):
    (vector,) = (v for v in MANIFEST if v["file"] == name + ".pd4")
    files = [str(VECTORS / vector[key]) for key in ("file", "base") if key in vector]
    command = [sys.executable, "-I", "-S", str(SPEC / "refdec.py"), *files]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    if "error" in vector:
        assert done.returncode == 1 and f": {vector['error']}: " in done.stderr and done.stderr.count("\n") == 1
    else:
        assert done.returncode == 0 and json.loads(done.stdout) == vector["layers"]


def test_the_tool_rebuilds_the_same_bytes():
    built = [v for v in MANIFEST if Path(v["file"]).stem not in LARGE]
    assert len(built) == len(MANIFEST) - len(LARGE)
    for (row, data), vector in zip(cases.vectors(LARGE), built, strict=True):
        assert row == vector and data == read(vector), vector["file"]


@pytest.mark.slow
def test_the_tool_finds_no_difference(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["make_vectors.py", "--check"])
    assert make_vectors.main() == 0, capsys.readouterr().err


def test_the_tool_names_every_difference(tmp_path):
    wanted = {"manifest.json": b"{}", "valid/a.pd4": b"a", "valid/b.pd4": b"b"}
    make_vectors.write(wanted, tmp_path)
    assert list(make_vectors.differences(wanted, tmp_path)) == []
    (tmp_path / "valid" / "a.pd4").write_bytes(b"A")
    (tmp_path / "valid" / "b.pd4").rename(tmp_path / "valid" / "c.pd4")
    differences = ["valid/c.pd4: unexpected file", "valid/a.pd4: bytes differ", "valid/b.pd4: missing"]
    assert list(make_vectors.differences(wanted, tmp_path)) == differences
    make_vectors.write(wanted, tmp_path)
    assert list(make_vectors.differences(wanted, tmp_path)) == []
