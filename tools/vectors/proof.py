"""Proof that every faulty vector fails for its own reason and no other.

The reference decoder refuses the vector at one check, which follows the clause that the vector names. Without that
check the decoder accepts the file or fails otherwise. So a decoder that forgets the rule answers wrongly to the vector.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import cache

from .blocks import Vector
from .reference import Check, Outcome, Reference, in_processes

#: Vectors that are refused once more under the same name, and why no other bytes would do better.
AGAIN = {
    "what is missing is missed again where it is read": (
        "section-positions-missing",
        "section-masks-missing",
        "section-attributes-missing",
        "section-planes-missing",
        "section-weights-missing",
        "section-floats-missing",
        "layer-0-section-length-largest",
        "predicted-stages-over-rest",
        "planes-stages-over-rest",
        "planes-stage-of-rest",
        "low-bits-section-missing",
    ),
    "a section of no bytes or fewer is missing, or has nothing to code": (
        "layer-0-section-length-zero",
        "layer-0-section-length-negative",
        "low-bits-section-besides",
    ),
    "slices that are not there, or have no rows, leave section 7 nothing to code": (
        "low-bits-slices-0",
        "low-bits-slices-twice",
        "low-bits-slices-named-again",
        "low-bits-behind-refining-slice",
        "low-bits-of-no-rows",
    ),
    "the rule spares a decoder work: exceptions take a place and two bytes each, which are checked as well": (
        "exceptions-more-than-symbols",
        "exceptions-number-largest",
        "exceptions-counts-that-lie",
        "exceptions-cut",
    ),
    "the rule spares a decoder memory: what is stated is held against the tree once more": (
        "positions-single-over-nodes",
        "positions-further-over-six",
        "positions-more-than-declared",
        "positions-fewer-than-declared",
        "positions-sizes-over-nodes",
    ),
    "a bound of clause 6.5 is passed by far as well, in any file of less than 8 MB": (
        "layer-0-rows-over-limit",
        "layer-0-rows-largest",
        "layer-1-rows-over-limit",
        "slices-later-rows-over-limit",
        "bomb-most-cells",
    ),
    "2^28 samples are over the bound of clause 6.5 too, in any payload of less than 1 MB": ("samples-over-limit",),
    "no number of rows under 0 is that of a tree": ("layer-0-rows-negative",),
    "layers that ascend begin with layer 0, if it is there": ("chunk-list-layer-0-second",),
    "where no network is, neither a trunk nor a head is": ("layer-1-networks-empty",),
    "classes up to 0 are all 0": ("histogram-top-0",),
    "a row of no class leaves a channel short": ("step-classes-7", "step-classes-negative"),
    "no network has 0 outputs": ("header-slots-zero",),
    "the symbols of attributes have a narrower range (11.2)": ("predicted-result-over-k",),
}
#: What the reference decoder asks for, and no vector can show: why.
UNSHOWN = {
    "top": "classes up to 0 are all 0",
    "number <= min(count, reader.left // 2)": "exceptions take a place and two bytes each",
    "all((abs(v) <= K for v in k[-1]))": "the symbols of attributes have a narrower range (11.2)",
    "sum(sizes) <= several": "as many nodes have so many children",
    "single <= nodes and more <= 6 * (nodes - single)": "as many nodes have so many children",
    "nodes <= count": "the tree ends with as many nodes",
    "count <= MAX_COUNT": "clause 6.5 bounds a channel below 2^26 in any file of less than 30 MB",
    "samples <= 1 << 28": "clause 6.5 bounds the samples in any file of less than 258 kB",
    "rows": "where no row is, section 7 has nothing to code",
    "size <= 1 << 31": "clause 6.5 bounds the bytes in any file of less than 250 kB",
}
FAULTY = "faulty/"


@cache
def _reference() -> Reference:
    return Reference()


def _both(vector: Vector) -> tuple[Outcome, Outcome | None]:
    """What becomes of a vector, and what without the check that refuses it."""
    outcome = _reference().decode(vector.data)
    return outcome, _reference().decode(vector.data, outcome.check) if outcome.check else None


def _faults(vector: Vector, outcome: Outcome, without: Outcome | None, excused: bool) -> Iterator[str]:
    if outcome.error != vector.error or outcome.check is None or without is None:
        yield f"{outcome.error or 'accepted'}, meant was {vector.error}"
        return
    if vector.clauses[0] not in outcome.check.clauses:
        clauses = ", ".join(sorted(outcome.check.clauses))
        yield f"named for clause {vector.clauses[0]}, refused at {outcome.check}, which quotes {clauses}"
    again = without.error == outcome.error
    if again and not excused:
        yield f"refused at {outcome.check} ({outcome.what}), and without that check once more: {without.what}"
    if excused and not again:
        yield "listed as refused once more, but it is not"


def prove(vectors: Iterable[Vector], jobs: int = 1) -> Iterator[str]:
    """One line per vector of those that are faulty which does not fail for its own reason alone, and per rule of the
    reference decoder that no such vector shows."""
    excused = {name for names in AGAIN.values() for name in names}
    faulty = [v for v in vectors if v.error is not None]
    shown: set[int] = set()
    for vector, (outcome, without) in zip(faulty, in_processes(_both, faulty, jobs), strict=True):
        name = vector.name.removeprefix(FAULTY)
        for fault in _faults(vector, outcome, without, name in excused):
            yield f"{vector.name}: {fault}"
        if without is not None and without.error != outcome.error:
            assert isinstance(outcome.check, Check)
            shown.add(outcome.check.line)
    unknown = excused - {v.name.removeprefix(FAULTY) for v in faulty}
    yield from (f"{name}: listed as refused once more, but there is no such vector" for name in sorted(unknown))
    rules = _reference().rules()
    for line in sorted(set(rules) - shown):
        if rules[line] not in UNSHOWN:
            yield f"refdec.py:{line}: no vector shows that {rules[line]} is asked for"
