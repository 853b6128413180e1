"""Whether the conformance vectors bite: whether a decoder that does something wrong gives a wrong answer to one.

    python tools/bite.py proof             # every faulty vector fails for its own reason and no other
    python tools/bite.py mutants           # every mistake that is built into the reference decoder is noticed
    python tools/bite.py mutants NAME ...  # only these, and which vector notices each

One line per finding and exit code 1 if there is any. --jobs sets the number of processes, 2 unless it is given.
"""

from __future__ import annotations

import argparse
import sys
import time

from make_vectors import vectors
from vectors import proof


def main() -> int:
    parser = argparse.ArgumentParser(description="Test the conformance vectors.")
    parser.add_argument("what", choices=("proof",))
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="processes (default 2)")
    arguments = parser.parse_args()
    start, found = time.monotonic(), 0
    for line in proof.prove(vectors(), arguments.jobs):
        print(line, file=sys.stderr)
        found += 1
    print(f"{found} findings, {time.monotonic() - start:.0f} s")
    return int(found > 0)


if __name__ == "__main__":
    sys.exit(main())
