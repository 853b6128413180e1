"""Hostile input: a short run of the fuzzer, bounds of time and memory, and faults that the fuzzer must notice."""

import os
import random
import shutil
import time
from functools import cache
from pathlib import Path
from unittest.mock import Mock

import fuzz
import numpy as np
import pytest
from fuzzing import check, legal, mutate
from strategies import flipped, make_scene, slice_ends, small_file
from vectors import cases
from vectors.blocks import Grid, Prior, constant, line, make_file, make_layer, read_file

from pd4dgs_codec import decode, encode
from pd4dgs_codec.errors import DecodeError, LimitExceeded
from pd4dgs_codec.format.container import read_preamble
from pd4dgs_codec.format.info import hashes

NODE = shutil.which("node")
VECTORS = Path(__file__).parents[2] / "spec" / "vectors"


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
    names = [name for name in fuzz.DECODERS if name == "refdec" or NODE]
    decoders = fuzz.make_decoders(names)
    figures = run_inputs(21, range(150), decoders)
    assert figures.findings == []
    counts = figures.counts
    assert counts["inputs"] == 150 == sum(count for name, count in counts.items() if name.startswith("ends in "))
    assert counts["CRCs recomputed after the mutation"] > 60 and counts["legal files"] > 20
    assert all(f"compared with {name}" in counts for name in names) and counts["compared with refdec"] > 30
    assert figures.differences.total() < 20
    assert {
        "decoded",
        "decoded, the scene Malformed",
        "Malformed",
        "LimitExceeded",
        "UnsupportedFeature",
        "ChecksumMismatch",
    } <= {name.removeprefix("ends in ") for name in counts}


def test_no_flipped_bit_of_a_file_decodes():
    """All near the ends of header and chunks, and some between them."""
    data = small_file()
    ends = (0, read_preamble(data).size, *slice_ends(data))
    near = [at for end in ends for at in range(end - 4, end + 20) if 0 <= at < len(data)]
    for bit in [*(8 * at + rest for at in near for rest in (0, 5)), *range(0, 8 * len(data), 397)]:
        with pytest.raises(DecodeError):
            hashes(flipped(data, bit // 8, 1 << bit % 8))


def anchors(mode):
    scene = make_scene(1, layers=(0, 1), anchors=5000, extent=30, kind="gaussian")
    return encode(scene, layers=2, effort=1, mode=mode, verify=False)


def planes(predictor):
    """1.4 million cells, all of one symbol."""
    sides = [(4096, 40 - i, 40 - i, 40 - i) for i in range(3)]
    return cases.deformed(*[Grid(1, own, (predictor,) * 6, constant(1), i) for i, own in enumerate(sides)]).data()


def exceptions():
    """Weights that are exceptions, of two bytes each."""
    ones = [np.ones(shape, np.int32) for shape in ((300, 2), 300, (300, 300), 300, (1, 300), 1)]
    chains = {0: ones, 1: (2, 7), 2: (2, 3)}
    return make_file(make_layer(chains=chains, choose=lambda piece, *_: Prior(piece != "chains"))).data()


def predicted_rows():
    """1.5 million coefficients of tracks, each predicted by the row before."""
    rows, widths, heads = 3000, (3, 3, 1, 3, 3), {0: 85, 1: 64, 2: 85, 3: 200, 4: 64}
    grids = [Grid(1, (2,), fill=lambda i, s: np.arange(2).reshape(s)), *(
        Grid(m * (3, 4, 3, 1, 3)[h], (2,), fill=constant(1), id=h + 1) for h, m in heads.items())]  # fmt: skip
    layer_rows = {h: np.ones((m, rows), np.int32) for h, m in heads.items()}
    kinds = {"widths": widths, "chains": {}}
    moved = make_layer(1, (), before=rows, grids=grids, layer_rows=layer_rows, kind=[1], **kinds)
    header = {3: [1], 4: [[i, c, 0.125, 1] for i, c in enumerate(widths)]}
    file = make_file(make_layer(0, line(rows), **kinds), moved, header=header)
    table = [[h, m, 0.125, 1] for h, m in heads.items()]
    return file.with_chunk(1, payload=cases.replace(moved, meta={**moved.meta, 7: table}).payload()).data()


BIG = {
    "planes by the median": lambda: planes(1),
    "planes by sums": lambda: planes(0),
    "planes in stages": lambda: cases.deformed(Grid(3, (600, 600, 80, 80), fill=constant(1))).data(),
    "exceptions": exceptions,
    "rows": predicted_rows,
    "tables": lambda: cases.entries_at_limit().data(),
    "anchors": lambda: anchors("ans"),
    "anchors, lzma": lambda: anchors("lzma"),
    "worst case in seconds": (VECTORS / "worst-case" / "seconds-0.pd4").read_bytes,
    "worst case in memory": (VECTORS / "worst-case" / "memory-0.pd4").read_bytes,
}


@pytest.mark.parametrize("name", BIG)
def test_memory_and_time_stay_within_their_bounds(name):
    data = BIG[name]()
    answer = check.check_package(legal.Case(name, data), random.Random(3))
    assert (answer.name, answer.scene) == ("decoded", "decoded")
    assert 0.02 < check.check_memory(data) <= 1


def crafted(meta, codes=b""):
    """A file of one anchor with other parameters and codes, all else right."""
    file = read_file(make_file(make_layer()).data())
    layer = file.layer(0)
    layer.meta |= meta
    layer.pieces["codes"] += codes
    return file.with_chunk(0, payload=layer.payload()).data()


ONCE_BROKE_A_PROMISE = {
    "entries": lambda: cases.entries_at_limit(1).data(),
    "parameters": lambda: crafted({64: [[[]] * 16] * 2000}),
    "anchors": lambda: crafted({1: 1 << 17}, bytes(4000)),
}


@pytest.mark.parametrize("limit", ONCE_BROKE_A_PROMISE)
def test_a_file_that_once_broke_a_promise_is_refused_by_every_entry_point(limit):
    data = ONCE_BROKE_A_PROMISE[limit]()
    with pytest.raises(LimitExceeded, match=limit):
        decode(data)
    for seed in range(8):
        check.check_package(legal.Case(limit, data), random.Random(seed))
    check.check_memory(data)


# -- inputs ------------------------------------------------------------------------------------------------------------


def test_inputs_are_named_by_their_numbers():
    cases = [mutate.make_case(seeds(), 3, index) for index in range(60)]
    assert cases == [mutate.make_case(seeds(), 3, index) for index in range(60)]
    assert len({case.data for case in cases}) > 54
    assert cases[0] != mutate.make_case(seeds(), 4, 0)


def test_random_files_are_legal_and_of_every_sort():
    parts = []
    for i in range(150):
        case = legal.numbered(i)
        assert hashes(case.data, base=case.base) == case.meaning
        parts.append(read_file(case.data))
    slices = [chunk for file in parts for chunk in file.chunks if chunk.layer is not None]
    assert {len(file.header[4]) for file in parts} >= {1, 2, 3, 4, 5, 6}
    assert {5 in file.header for file in parts} == {True, False}
    assert {file.header[3][0] for file in parts} >= {0, 1, 2} and {file.header[2] for file in parts} == {0, 1}
    assert set().union(*(chunk.layer.meta for chunk in slices)) >= {1, 3, 4, 5, 6, 7}
    assert {len(grid[2]) for chunk in slices for grid in chunk.layer.meta.get(4, [0])[1:]} == {1, 2, 3, 4}
    assert any(c.type > 2 for file in parts for c in file.chunks) and any(c.flags >> 6 > 4 for c in slices)


def test_taking_apart_and_putting_together_changes_nothing():
    for seed in seeds():
        file = read_file(seed.data)
        assert file.data() == seed.data
        assert all(chunk.layer.payload() == chunk.payload for chunk in file.chunks if chunk.layer)


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
        check.check_package(legal.Case("it", small_file(), sealed=False), random.Random(0))


def test_an_entry_point_that_disagrees(monkeypatch):
    monkeypatch.setattr(check, "decode", lambda data, **options: decode(small_file()))
    assert "disagreement" in kinds(run_inputs(0, range(40), {}))


def test_a_decoder_that_is_wrong():
    right = check.Answer("decoded", [1], "decoded")

    def compared(*answer, first=right):
        return check.compare({"python": first, "other": check.Answer(*answer)})

    assert compared("decoded", [1]) is None  # of one that knows no kinds
    for answer in (("decoded", [2]), ("crash, TypeError",), ("Malformed", "it"), ("decoded", [1], "Malformed")):
        with pytest.raises(check.Finding):
            compared(*answer)
    with pytest.raises(check.Finding, match="of python: Malformed, of other: decoded"):
        compared("decoded", [1], "decoded", first=check.Answer("decoded", [1], "Malformed"))
    assert compared("Malformed", first=check.Answer("Truncated")) == "other Malformed, python Truncated"


@pytest.mark.parametrize("kind", ["crash", "stuck"])
def test_a_process_that_ends_or_gets_stuck_while_the_run_goes_on(monkeypatch, tmp_path, capsys, kind):
    bad = mutate.make_case(seeds(), 5, 13)

    def examine(case, rng):
        if case == bad and kind == "crash":
            os._exit(134)
        if case == bad:
            time.sleep(60)
        return check.Answer("decoded", case.meaning)

    monkeypatch.setattr(fuzz, "check_package", examine)
    monkeypatch.setattr(fuzz, "check_memory", lambda data, base: 0.0)
    monkeypatch.setattr(fuzz, "seeds", lambda paths: seeds())
    monkeypatch.setattr(fuzz, "STUCK_SECONDS", 8.0 if kind == "stuck" else 300.0)
    command = ["--inputs", "30", "--seed", "5", "--decoders", "python", "--out", str(tmp_path)]
    assert fuzz.main(command) == 1
    assert (tmp_path / "5-13-crash.pd4").read_bytes() == bad.data
    told = capsys.readouterr().out
    assert "| inputs | 30 |" in told and "| ends in decoded | 29 |" in told and "| findings | 1 |" in told


def test_the_command_refuses_an_unknown_decoder(capsys):
    with pytest.raises(SystemExit):
        fuzz.main(["--decoders", "python,rust"])
    assert "expected some of python, refdec, javascript, found rust" in capsys.readouterr().err
