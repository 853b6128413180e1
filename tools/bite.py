"""Whether the conformance vectors bite: whether a decoder that does something wrong gives a wrong answer to one.

    python tools/bite.py proof             # every faulty vector fails for its own reason and no other
    python tools/bite.py mutants           # every mistake that is built into the reference decoder is noticed
    python tools/bite.py mutants WORD ...  # those with one of these words in their names, and what notices each

One line per finding and exit code 1 if there is any. --jobs sets the number of processes.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator

from make_vectors import VECTORS, vectors
from vectors import mutants, proof


def prove(jobs: int) -> Iterator[str]:
    """One line per vector that proves nothing."""
    yield from proof.prove(vectors(), jobs)


def hunt(words: list[str], jobs: int) -> Iterator[str]:
    """One line per mutant that no vector notices, or that one notices though it is said to be equivalent."""
    chosen = [m for m in mutants.written() if not words or any(word in m.name for word in words)]
    found = 0
    for mutant, name in mutants.verdicts(chosen, mutants.stored(VECTORS), jobs):
        found += name is not None
        if words:
            print(f"{mutant.clause} {mutant.name}: {name or 'not noticed'}")
        if name is None and not mutant.equivalent:
            yield f"{mutant.clause} {mutant.name}: no vector notices it"
        if name is not None and mutant.equivalent:
            yield f"{mutant.clause} {mutant.name}: said to be equivalent ({mutant.equivalent}), but {name} notices it"
    print(f"{len(chosen)} mutants, {found} noticed, {sum(bool(m.equivalent) for m in chosen)} equivalent")


def main() -> int:
    parser = argparse.ArgumentParser(description="Test the conformance vectors.")
    parser.add_argument("what", choices=("proof", "mutants"))
    parser.add_argument("words", nargs="*", help="of mutants: words of their names")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="processes (default 2)")
    arguments = parser.parse_args()
    found = 0
    for line in prove(arguments.jobs) if arguments.what == "proof" else hunt(arguments.words, arguments.jobs):
        print(line, file=sys.stderr, flush=True)
        found += 1
    print(f"{found} findings")
    return int(found > 0)


if __name__ == "__main__":
    sys.exit(main())
