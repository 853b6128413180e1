"""Mistakes that an implementer could make, each built into the reference decoder: the vectors must notice them all.

A mutant is a substitution in the source of `spec/refdec.py`: another rounding, order, width, limit or branch.
mutants.txt has them.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

from .reference import Outcome, Reference, in_processes, reference_source

LIST = Path(__file__).with_name("mutants.txt")
CHEAP_SECONDS = 0.3  #: of processor time; all but a dozen vectors take less


@dataclass(frozen=True)
class Mutant:
    """name: what is done wrong. clause: the one that says it otherwise. changes: (old, new) pieces of the source.
    equivalent: why no file shows it, if none does."""

    name: str
    clause: str
    changes: tuple[tuple[str, str], ...]
    equivalent: str = ""

    def applied(self, source: str) -> str:
        """The source of the mutant. ValueError if a piece is not there once."""
        for old, new in self.changes:
            if source.count(old) != 1:
                raise ValueError(f"{self.name}: {source.count(old)} times in refdec.py: {old!r}")
            source = source.replace(old, new)
        return source


def written(text: str | None = None) -> list[Mutant]:
    """The mutants of mutants.txt, or of a text like it."""
    text = LIST.read_text(encoding="utf-8") if text is None else text
    found = []
    for block in text.split("\n\n"):
        lines = [line for line in block.splitlines() if not line.startswith("#")]
        if not lines:
            continue
        clause, name = lines[0].split(" ", 1)
        reasons = " ".join(line[2:] for line in lines if line.startswith("= "))
        pieces = [
            (sign, "\n".join(line[2:] for line in run))
            for sign, run in groupby((line for line in lines[1:] if line[0] in "-+"), key=lambda line: line[0])
        ]
        if [sign for sign, _ in pieces] != ["-", "+"] * (len(pieces) // 2):
            raise ValueError(f"{name}: expected pieces - and + in turn")
        changes = tuple((old, new) for (_, old), (_, new) in zip(pieces[::2], pieces[1::2], strict=True))
        found.append(Mutant(name, clause, changes, reasons))
    return found


# -- what the vectors make of them -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Stored:
    """A vector as the manifest has it. answers: (highest layer asked for, None for all; what a decoder answers)."""

    name: str
    data: bytes = field(repr=False)
    clauses: tuple[str, ...]
    answers: tuple[tuple[int | None, Any], ...]


def stored(folder: Path) -> list[Stored]:
    """The vectors of a folder with a manifest."""
    found = []
    for row in json.loads((folder / "manifest.json").read_text(encoding="utf-8"))["vectors"]:
        layers = row["layers"]
        whole = (None, row.get("error", layers))
        last_may_be_cut = "error" not in row or "slices" in row
        own = {int(layer): rows for layer, rows in row.get("prefixes", {}).items()}
        numbers = [layer["layer"] for layer in layers[: len(layers) - last_may_be_cut]]
        prefixes = [(number, own.get(number, layers[: i + 1])) for i, number in enumerate(numbers)]
        data = (folder / row["file"]).read_bytes()
        found.append(Stored(row["file"].removesuffix(".pd4"), data, tuple(row["clauses"]), (whole, *prefixes)))
    return found


def in_likely_order(mutant: Mutant, vectors: Sequence[Stored], cost: dict[str, float] | None = None) -> list[Stored]:
    """The vectors of the mutant's clause first, then those of clauses beside it; the cheap ones first, by `cost`, or by
    their size."""
    chapter = mutant.clause.split(".")[0]

    def rank(vector: Stored) -> tuple[int, float]:
        near = [clause == mutant.clause for clause in vector.clauses if clause.split(".")[0] == chapter]
        return 2 - (any(near) + bool(near)), (cost or {}).get(vector.name, len(vector.data))

    return sorted(vectors, key=rank)


def wrong_answer(reference: Reference, vector: Stored) -> Outcome | None:
    """What a decoder answers to a vector where it should answer otherwise, None if it answers rightly throughout."""
    for layer, answer in vector.answers:
        outcome = reference.decode(vector.data, max_layer=layer)
        if outcome.answer != answer:
            return outcome
    return None


def noticed(mutant: Mutant, vectors: Sequence[Stored], cost: dict[str, float] | None = None) -> str | None:
    """The name of a vector that notices a mutant."""
    reference = Reference(mutant.applied(reference_source()))
    order = in_likely_order(mutant, vectors, cost)
    return next((vector.name for vector in order if wrong_answer(reference, vector)), None)


def seconds(vector: Stored) -> float:
    """Processor time that the reference decoder takes for a vector. ValueError if its answer is wrong."""
    start = time.process_time()
    outcome = wrong_answer(Reference(), vector)
    if outcome is not None:
        raise ValueError(f"{vector.name}: the reference decoder answers {outcome.error or 'other hashes'}")
    return time.process_time() - start


def verdicts(mutants: Sequence[Mutant], vectors: Sequence[Stored], jobs: int) -> Iterator[tuple[Mutant, str | None]]:
    """Each mutant with the vector that notices it, None if none does. Mutants that are said to be equivalent see the
    vectors that take little time only."""
    measured = in_processes(seconds, vectors, jobs)
    cost = {vector.name: spent for vector, spent in zip(vectors, measured, strict=True)}
    names = in_processes(partial(_noticed, vectors=vectors, cost=cost), mutants, jobs)
    return zip(mutants, names, strict=True)


def _noticed(mutant: Mutant, vectors: Sequence[Stored], cost: dict[str, float]) -> str | None:
    seen = [vector for vector in vectors if cost[vector.name] < CHEAP_SECONDS or not mutant.equivalent]
    return noticed(mutant, seen, cost)
