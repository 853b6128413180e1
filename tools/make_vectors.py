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
    of_name = dict[str, bytes]()
    for row, data in found:
        name, expected = row["file"], row.get("error", row["layers"])
        if of_name.setdefault(name, data) is not data:
            yield f"{name}: two vectors have this name"
        try:
            outcome: Any = refdec.hashes(data, base=of_name.get(row.get("base", "")))
        except refdec.Fault as fault:
            outcome = fault.name
        if outcome != expected:
            yield f"{name}: the reference decoder gives {outcome}, expected {expected}"


def differences(wanted: dict[str, bytes], folder: Path) -> Iterator[str]:
    """One line per file that is missing, different or not a vector."""
    there = {p.relative_to(folder).as_posix(): p for p in folder.rglob("*") if p.suffix in (".pd4", ".json")}
    yield from (f"{name}: unexpected file" for name in sorted(there.keys() - wanted))
    for name, content in wanted.items():
        if name not in there or there[name].read_bytes() != content:
            yield f"{name}: {'bytes differ' if name in there else 'missing'}"


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
    check, found = parser.parse_args().check, list(vectors())
    wanted = files(found)
    lines = list(differences(wanted, VECTORS) if check else wrong_outcomes(found))
    if lines:
        print(*lines, sep="\n", file=sys.stderr)
        return 1
    if not check:
        write(wanted, VECTORS)
    print(f"{len(found)} vectors, {sum(map(len, wanted.values()))} bytes {'checked' if check else 'written'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
