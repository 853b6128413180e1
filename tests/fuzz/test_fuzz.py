"""Hostile input: a short run of the fuzzer, bounds of time and memory, and faults that the fuzzer must notice."""

import os
import random
import shutil
import struct
import time
from functools import cache, partial
from pathlib import Path
from unittest.mock import Mock

import fuzz
import pytest
from fuzzing import check, legal, mutate
from strategies import flipped, make_scene, slice_ends, small_file
from vectors.blocks import varint

from pd4dgs_codec import decode, encode
from pd4dgs_codec.errors import DecodeError, LimitExceeded
from pd4dgs_codec.format.container import read_preamble
from pd4dgs_codec.format.info import hashes

NODE = shutil.which("node")
VECTORS = Path(__file__).parents[2] / "spec" / "vectors"
POSITIONS, PLANES, WEIGHTS, SCALES, NETWORKS = 0, 3, 4, 4, 5  # sections and keys of the layer parameters


@cache
def seeds():
    """Built by the first test that needs them, not while tests are collected."""
    return legal.seeds()


def run_inputs(run, inputs, decoders):
    figures = fuzz.Figures()
    for index in inputs:
        figures.add(fuzz.examine(seeds(), run, index, decoders))
    return figures


def kinds(figures):
    return {row["kind"] for row in figures.findings}


# -- the decoders ------------------------------------------------------------------------------------------------------


def test_a_short_run_finds_nothing():
    names = [name for name in fuzz.DECODERS if name != "javascript" or NODE]
    decoders = fuzz.make_decoders(names)
    figures = run_inputs(20, range(300), decoders)
    assert figures.findings == []
    assert figures.inputs == 300 == figures.outcomes.total() and figures.sealed > 120 and figures.legal > 40
    assert set(figures.compared) == set(names) - {"python"} and figures.compared["refdec"] > 60
    assert figures.differences.total() < 20
    assert {"decoded", "Malformed", "LimitExceeded", "UnsupportedFeature", "ChecksumMismatch"} <= {*figures.outcomes}


def test_no_flipped_bit_of_a_file_decodes():
    """All near the ends of header and chunks, and some between them."""
    data = small_file()
    ends = (0, read_preamble(data).size, *slice_ends(data))
    near = [at for end in ends for at in range(end - 4, end + 20) if 0 <= at < len(data)]
    for bit in [*(8 * at + rest for at in near for rest in (0, 5)), *range(0, 8 * len(data), 97)]:
        with pytest.raises(DecodeError):
            hashes(flipped(data, bit // 8, 1 << bit % 8))


def crafted(chunk, sections, meta=None):
    """A file without anchors, with other sections and layer parameters, all else right."""
    tiny = {"channels": 1, "width": 1, "hidden": (), "sides": (90, 3, 40, 2), "scales": 2}
    scene = make_scene(3, layers=(0, 1), anchors=0, kind="constant", **tiny)
    parts = mutate.take_apart(encode(scene, layers=2, effort=1))
    parts.chunks[chunk].sections |= {number: bytes(data) for number, data in sections.items()}
    parts.chunks[chunk].meta |= meta or {}
    return mutate.put_together(parts)


def alike(count):
    """A section of so many channels that hold only the symbol 1."""
    return varint(0, 2, *[16] * (count - 1))


def wide_tables(tables, channels):
    """A section of so many channels of one symbol, the first of them with tables of 2^14 entries."""
    return varint(*[2, 0, (1 << 14) - 2, 0, 1280] * tables, *[16] * (channels - tables))


ONE_CELL = {SCALES: [[2, 1, 1, 1, 1, *[0] * 6]] * 8}  #: 96 channels in one stage


def constant_planes(predictor):
    """535 bytes that declare 3.6 million plane cells, all of one symbol."""
    scales = [[1, 4096, 40 - i, 40 - i, 40 - i, *[predictor] * 6] for i in range(8)]
    return crafted(1, {PLANES: alike(48)}, {SCALES: scales})


def constant_stages():
    """400 bytes that declare 3.9 million plane cells in two stages."""
    first, second = alike(12), alike(6)
    section = varint(len(first)) + first + second
    return crafted(1, {PLANES: section}, {SCALES: [[3, 1000, 1000, 80, 80, *[0] * 6]]})


def many_exceptions():
    """Weights that are exceptions, of two bytes each."""
    count = 35 * 3000
    weights = varint(1, 0, count - 1) + bytes(2 * count) + varint(*[16] * 7)
    return crafted(0, {WEIGHTS: weights}, {NETWORKS: [[0, 3000, 10], [1, 70], [2, 30]]})


def most_tables():
    """As many wide tables as a section may have."""
    return crafted(1, {PLANES: wide_tables(16, 96)}, ONE_CELL)


def many_anchors(mode):
    scene = make_scene(1, layers=(0, 1), anchors=5000, extent=30, kind="gaussian")
    return encode(scene, layers=2, effort=1, mode=mode, verify=False)


BIG = {
    "planes by the median": partial(constant_planes, 1),
    "planes by sums": partial(constant_planes, 0),
    "planes in stages": constant_stages,
    "exceptions": many_exceptions,
    "tables": most_tables,
    "anchors": partial(many_anchors, "ans"),
    "anchors, lzma": partial(many_anchors, "lzma"),
    "worst case in seconds": (VECTORS / "worst-case" / "seconds-0.pd4").read_bytes,
    "worst case in memory": (VECTORS / "worst-case" / "memory-0.pd4").read_bytes,
}


@pytest.mark.parametrize("name", BIG)
def test_memory_and_time_stay_within_their_bounds(name):
    data = BIG[name]()
    assert check.check_package(mutate.Case(data, True, name), random.Random(3)) == "decoded"
    assert 0.02 < check.check_memory(data) <= 1


ONCE_BROKE_A_PROMISE = {
    "entries": lambda: crafted(1, {PLANES: wide_tables(96, 96)}, ONE_CELL),  # tables of 12 MB
    "parameters": lambda: crafted(0, {}, {64: [[[]] * 16] * 2000}),
    "anchors": lambda: crafted(0, {POSITIONS: struct.pack("<3i3B", 0, 0, 0, 21, 21, 21) + bytes(4000)}, {1: 1 << 17}),
}


@pytest.mark.parametrize("limit", ONCE_BROKE_A_PROMISE)
def test_a_file_that_once_broke_a_promise_is_refused_by_every_entry_point(limit):
    data = ONCE_BROKE_A_PROMISE[limit]()
    with pytest.raises(LimitExceeded, match=limit):
        decode(data)
    for seed in range(8):
        check.check_package(mutate.Case(data, True, limit), random.Random(seed))
    check.check_memory(data)


# -- inputs ------------------------------------------------------------------------------------------------------------


def test_inputs_are_named_by_their_numbers():
    cases = [mutate.make_case(seeds(), 3, index) for index in range(60)]
    assert cases == [mutate.make_case(seeds(), 3, index) for index in range(60)]
    assert len({case.data for case in cases}) > 54
    assert cases[0] != mutate.make_case(seeds(), 4, 0)


def test_random_files_are_legal_and_of_every_sort():
    chunks = []
    for i in range(150):
        file = legal.numbered(i)
        data = file.data()
        assert hashes(data) == file.hashes()
        parts = mutate.take_apart(data)
        chunks += [(parts.header, chunk) for chunk in parts.chunks]
    sections = [(h, c.meta, n, data) for h, c in chunks for n, data in (c.sections or {}).items()]
    assert {n for _, _, n, _ in sections} == set(range(6))
    assert any(3 in h for h, _ in chunks) and len({tuple(h[15]) for h, _ in chunks}) > 4
    assert {1, 2, 3, 4} <= {len(mutate.stages_of(data, n, h, meta)) for h, meta, n, data in sections}
    assert any(c.type > 2 for _, c in chunks) and any(c.flags >> 6 > 4 for _, c in chunks)


def test_taking_apart_and_putting_together_changes_nothing():
    for seed in seeds():
        parts = mutate.take_apart(seed.data)
        if read_preamble(seed.data).minor == 0:
            assert mutate.put_together(parts) == seed.data
        for chunk in parts.chunks:
            for number, section in (chunk.sections or {}).items():
                stages = mutate.stages_of(section, number, parts.header, chunk.meta)
                assert varint(*(len(stage) for stage in stages[:-1])) + b"".join(stages) == section


# -- the fuzzer notices ------------------------------------------------------------------------------------------------


class Panic(BaseException):
    """Such as the coder library raises."""


class TwoLines(DecodeError):
    """The package's own errors never have such a message."""

    def __str__(self) -> str:
        return "one\ntwo"


@pytest.mark.parametrize(
    "error, kind",
    [
        *((error, "exception") for error in (ValueError("x"), MemoryError(), RecursionError(), Panic("x"))),
        (TwoLines("it"), "message"),
    ],
)
def test_an_error_that_no_decoder_may_raise(monkeypatch, error, kind):
    monkeypatch.setattr(check, "decode", Mock(side_effect=error))
    assert kinds(run_inputs(0, range(3), {})) == {kind}


def test_too_much_time_and_memory(monkeypatch):
    monkeypatch.setattr(check, "MAX_SECONDS", 0.0)
    assert kinds(run_inputs(0, range(20), {})) == {"time"}
    for name in ("BYTES_PER_SYMBOL", "BYTES_PER_BYTE", "BYTES_ALWAYS", "BYTES_OF_SLICES"):
        monkeypatch.setattr(check, name, 1)
    with pytest.raises(check.Finding, match="peak of "):
        check.check_memory(seeds()[0].data)


def test_damage_that_decodes():
    with pytest.raises(check.Finding, match="CRCs"):
        check.check_package(mutate.Case(small_file(), False, "it"), random.Random(0))


def test_an_entry_point_that_disagrees(monkeypatch):
    monkeypatch.setattr(check, "decode", lambda data, **options: decode(small_file()))
    assert "disagreement" in kinds(run_inputs(0, range(40), {}))


def test_a_decoder_that_is_wrong():
    data = small_file()

    def compared(*answer, of=data, meaning=None):
        return check.compare(of, {"python": check.python_decoder, "other": lambda data: answer}, meaning)

    assert compared("decoded", hashes(data)) is None
    for answer in (("decoded", hashes(data)[:-1]), ("crash, TypeError", None), ("Malformed", "")):
        with pytest.raises(check.Finding):
            compared(*answer)
    with pytest.raises(check.Finding):
        compared("decoded", hashes(data), of=data[:-1])
    assert compared("Malformed", "", of=data[:-1]) == "other Malformed, python Truncated"
    with pytest.raises(check.Finding, match="the writer and python"):
        compared("decoded", hashes(data), meaning=hashes(data)[:-1])


@pytest.mark.parametrize("kind", ["crash", "stuck"])
def test_a_process_that_ends_or_gets_stuck_while_the_run_goes_on(monkeypatch, tmp_path, capsys, kind):
    bad = mutate.make_case(seeds(), 5, 13)

    def examine(case, rng):
        if case == bad and kind == "crash":
            os._exit(134)
        if case == bad:
            time.sleep(60)
        return "decoded"

    monkeypatch.setattr(fuzz, "check_package", examine)
    monkeypatch.setattr(fuzz, "check_memory", lambda data: 0.0)
    monkeypatch.setattr(fuzz, "seeds", lambda paths: seeds())
    monkeypatch.setattr(fuzz, "STUCK_SECONDS", 3.0 if kind == "stuck" else 300.0)
    command = ["--inputs", "30", "--seed", "5", "--decoders", "python", "--out", str(tmp_path)]
    assert fuzz.main(command) == 1
    assert (tmp_path / "5-13-crash.pd4").read_bytes() == bad.data
    told = capsys.readouterr().out
    assert "| inputs | 30 |" in told and "| ends in decoded | 29 |" in told and "| findings | 1 |" in told


def test_the_command_refuses_an_unknown_decoder(capsys):
    with pytest.raises(SystemExit):
        fuzz.main(["--decoders", "python,rust"])
    assert "expected some of python, refdec, javascript, found rust" in capsys.readouterr().err
