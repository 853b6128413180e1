"""The vectors bite: each faulty one for its own reason, and each mistake of a decoder is noticed by one.

Samples here; `pytest -m slow` and tools/bite.py take all.
"""

import re
from dataclasses import replace
from functools import cache

import pytest
from make_vectors import VECTORS, vectors
from vectors import mutants, proof
from vectors.blocks import make_file, make_layer
from vectors.faulty import cases
from vectors.mutants import Mutant, in_likely_order, noticed, stored, written
from vectors.reference import HELPERS, Reference, reference_source

MUTANTS = written()
STORED = stored(VECTORS)
SAMPLE = 9  #: every so many vectors and mutants are taken by default


@cache
def faulty():
    """All of them. They take seconds to make, which not every process that collects these tests need spend."""
    return list(cases())


def of_name(name):
    (found,) = (v for v in faulty() if v.name == f"faulty/{name}")
    return found


def findings(*found):
    """What is said of these vectors; not what is said of those that are missing."""
    return [line for line in proof.prove(found) if "no such vector" not in line and "no vector shows" not in line]


# -- the proof ---------------------------------------------------------------------------------------------------------


def test_faulty_vectors_fail_for_their_own_reason():
    assert findings(*faulty()[::SAMPLE]) == []


@pytest.mark.slow
def test_every_faulty_vector_fails_for_its_own_reason_and_every_check_is_shown():
    assert list(proof.prove(vectors(), jobs=2)) == []


def test_a_second_fault_is_found():
    """As the vectors had it once: what is not canonical is refused, but so would be the scene id."""
    vector = of_name("msgpack-uint8")
    assert findings(vector) == []
    at = vector.data.index(make_file(make_layer()).chunks[0].payload) - 1
    (line,) = findings(replace(vector, data=sealed(vector.data[:at] + b"\0" + vector.data[at + 1 :])))
    assert "faulty/msgpack-uint8: refused at msgpack_head" in line and "once more" in line and "scene id" in line


def sealed(data):
    """With a right CRC-32 of the last chunk."""
    import struct
    import zlib

    start = len(data) - 20 - len(make_file(make_layer()).chunks[0].payload)
    return data[:-4] + struct.pack("<I", zlib.crc32(data[start:-4]))


def test_another_clause_and_another_error_are_found():
    vector = of_name("header-unit-negative")
    (line,) = findings(replace(vector, clauses=("5.3",)))
    assert "named for clause 5.3, refused at read_header" in line and "5.1" in line
    (line,) = findings(replace(vector, error="LimitExceeded"))
    assert line.endswith("Malformed, meant was LimitExceeded")
    (line,) = findings(replace(vector, data=make_file(make_layer()).data()))
    assert line.endswith("accepted, meant was Malformed")


def test_a_list_of_exceptions_that_is_stale_is_found(monkeypatch):
    monkeypatch.setitem(proof.AGAIN, "a reason", ("header-unit-negative", "a-vector-that-is-gone"))
    lines = list(proof.prove([of_name("header-unit-negative")]))
    assert "faulty/header-unit-negative: listed as refused once more, but it is not" in lines
    assert "a-vector-that-is-gone: listed as refused once more, but there is no such vector" in lines


def test_a_check_that_no_vector_shows_is_found():
    lines = list(proof.prove([of_name("header-unit-negative")]))
    assert any("no vector shows that near < far" in line or "0 <= near < far" in line for line in lines)
    assert not any("unit >= 0" in line for line in lines)


def test_every_check_of_the_reference_decoder_can_be_left_out():
    """Faults are raised by `need` alone, and the functions that check for others are there."""
    source = reference_source()
    assert re.findall(r"^.*\braise\b.*$", source, flags=re.M) == ["        raise Fault(name, what)"]
    assert all(f"\ndef {name}(" in source for name in HELPERS)
    assert len(Reference().rules()) > 90


# -- the mutants -------------------------------------------------------------------------------------------------------


def test_the_mutants_are_many_and_apply_to_the_reference_decoder():
    assert len(MUTANTS) > 270 and len({m.name for m in MUTANTS}) == len(MUTANTS)
    assert sum(not m.equivalent for m in MUTANTS) > 255
    clauses = set(re.findall(r"^#{2,3} (\d+(?:\.\d+)?) ", (VECTORS.parent / "format.md").read_text(), flags=re.M))
    for mutant in MUTANTS:
        assert mutant.clause in clauses and mutant.changes
        assert mutant.applied(reference_source()) != reference_source()


@pytest.mark.parametrize("mutant", [m for m in MUTANTS if not m.equivalent][::SAMPLE], ids=lambda m: m.name)
def test_a_mutant_is_noticed(mutant):
    likely = in_likely_order(mutant, STORED)
    small = [v for v in likely if len(v.data) < 6000 or mutant.clause in v.clauses]
    assert noticed(mutant, small)


@pytest.mark.slow
def test_every_mutant_is_noticed_but_those_that_are_equivalent():
    wrong = [m.name for m, name in mutants.verdicts(MUTANTS, STORED, jobs=2) if (name is None) != bool(m.equivalent)]
    assert wrong == []


def test_a_mutant_that_changes_nothing_is_not_noticed():
    same = Mutant("nothing", "5.1", (("need(unit >= 0,", "need(not unit < 0,"),))
    assert noticed(same, [v for v in STORED if "5.1" in v.clauses]) is None


def test_a_mutant_that_does_not_apply_is_refused():
    with pytest.raises(ValueError, match="0 times in refdec.py: 'no such piece'"):
        Mutant("gone", "4", (("no such piece", ""),)).applied(reference_source())
    with pytest.raises(ValueError, match="expected pieces - and \\+ in turn"):
        written("4 a name\n+ new\n- old\n")


def test_a_decoder_that_crashes_or_runs_away_is_noticed(monkeypatch):
    monkeypatch.setattr("vectors.reference.SECONDS", 0.2)
    one = [v for v in STORED if v.name == "valid/one-anchor"]
    crash = Mutant("crash", "5.1", (("need(unit >= 0,", "need(unit.no_such >= 0,"),))
    runs = Mutant("runs", "5.1", (("    need(unit >= 0,", "    while True:\n        pass\n    need(unit >= 0,"),))
    for mutant, error in ((crash, "crash"), (runs, "runs away")):
        assert noticed(mutant, one) == "valid/one-anchor"
        assert Reference(mutant.applied(reference_source())).decode(one[0].data).error == error
