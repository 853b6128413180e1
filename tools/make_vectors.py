"""Writes the conformance vectors and their manifest, or checks the present ones.

    python tools/make_vectors.py           # (re)writes spec/vectors/
    python tools/make_vectors.py --check   # one line per difference, and exit code 1 if there is any

`tools/vectors/table.txt` says what each vector holds; the bytes are the same on every machine. Vectors that the
reference decoder decodes to anything else than what their writer put in are not written.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from vectors import ROOT, refdec
from vectors.blocks import MAJOR
from vectors.cases import vectors

VECTORS = ROOT / "spec" / "vectors"
Vectors = list[tuple[dict[str, Any], bytes]]  #: entry in the manifest, bytes


def files(found: Vectors) -> dict[str, bytes]:
    """Path below spec/vectors -> content."""
    rows = ",\n".join(json.dumps(row, ensure_ascii=False) for row, _ in found)
    manifest = f'{{"format": "{MAJOR}.0-draft", "vectors": [\n{rows}\n]}}\n'
    return {"manifest.json": manifest.encode(), **{row["file"]: data for row, data in found}}


def wrong_outcomes(found: Vectors) -> Iterator[str]:
    """One line per vector that the reference decoder does not decode as its table says."""
    names = [row["file"] for row, _ in found]
    yield from (f"{name}: two vectors have this name" for name in sorted(set(names)) if names.count(name) > 1)
    of_name = {row["file"]: data for row, data in found}
    for row, data in found:
        try:
            outcome: Any = refdec.hashes(data, base=of_name[row["base"]] if "base" in row else None)
        except refdec.Fault as fault:
            outcome = fault.name
        if outcome != row.get("error", row["layers"]):
            yield f"{row['file']}: the reference decoder gives {outcome}, expected {row.get('error', row['layers'])}"


def differences(wanted: dict[str, bytes], folder: Path) -> Iterator[str]:
    """One line per file that is missing, different or not a vector."""
    there = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.suffix in (".pd4", ".json")}
    for name in sorted(there - set(wanted)):
        yield f"{name}: unexpected file"
    for name, content in wanted.items():
        if name not in there:
            yield f"{name}: missing"
        elif (folder / name).read_bytes() != content:
            yield f"{name}: bytes differ"


def write(wanted: dict[str, bytes], folder: Path) -> None:
    """Make `folder` hold these files and no other vectors."""
    for path in folder.rglob("*.pd4"):
        if path.relative_to(folder).as_posix() not in wanted:
            path.unlink()
    for name, content in wanted.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)


def main() -> int:
    """Entry point; returns the exit code."""
    parser = argparse.ArgumentParser(description="Write or check the conformance vectors.")
    parser.add_argument("--check", action="store_true", help="compare with the existing files, write nothing")
    arguments = parser.parse_args()
    found = list(vectors())
    wanted = files(found)
    lines = list(differences(wanted, VECTORS) if arguments.check else wrong_outcomes(found))
    for line in lines:
        print(line, file=sys.stderr)
    if lines:
        return 1
    if not arguments.check:
        write(wanted, VECTORS)
    print(f"{len(found)} vectors, {sum(map(len, wanted.values()))} bytes {'checked' if arguments.check else 'written'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
