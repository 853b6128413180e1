"""Writes the conformance vectors and their manifest, or checks those that are there.

    python tools/make_vectors.py           # (re)writes spec/vectors/
    python tools/make_vectors.py --check   # one line per difference and exit code 1 if anything is not as it would be

Nothing is written that the package decodes to something else than was meant; a test asks the same of what is there.
The bytes are the same on every machine: `tools/vectors/` says what each file holds and searches for nothing.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections.abc import Iterator
from pathlib import Path

from vectors import dear, faulty, refining, slices, uncommon, valid
from vectors.blocks import Vector

from pd4dgs_codec.errors import DecodeError, UnsupportedFeature
from pd4dgs_codec.format.container import read_preamble
from pd4dgs_codec.format.header import layers_of, unpack_header
from pd4dgs_codec.format.info import hashes

VECTORS = Path(__file__).resolve().parents[1] / "spec" / "vectors"
MANIFEST = "manifest.json"
SUFFIX = ".pd4"


def vectors() -> list[Vector]:
    """All vectors, in the manifest's order."""
    found = [*valid.cases(), *uncommon.cases(), *faulty.cases(), *slices.cases(), *refining.cases(), *dear.cases()]
    names = [v.name for v in found]
    doubled = {name for name in names if names.count(name) > 1}
    if doubled:
        raise SystemExit(f"make_vectors: names used twice: {sorted(doubled)}")
    return found


def entry(vector: Vector) -> dict:
    """A vector's entry in the manifest."""
    row: dict = {
        "file": vector.name + SUFFIX,
        "what": vector.sentence,
        "clauses": list(vector.clauses),
        "size": len(vector.data),
        "sha256": hashlib.sha256(vector.data).hexdigest(),
    }
    if vector.error is not None:
        row["error"], row["clause"] = vector.error, vector.clauses[0]
        row |= {key: value for key, value in (("chunk", vector.chunk), ("offset", vector.offset)) if value is not None}
        row["prefix"] = vector.layers[-1]["layer"] if vector.layers else None
    row["ans_only"] = "same" if _for_all(vector.data) else UnsupportedFeature.__name__
    listed = _listed(vector.data)
    if len(listed) > len(set(listed)):
        row["slices"] = list(vector.slices)
    if vector.prefixes:
        row["prefixes"] = {str(layer): rows for layer, rows in vector.prefixes.items()}
    row["layers"] = vector.layers
    return row


def _listed(data: bytes) -> list[int]:
    """The layer of each slice in the header's list, none of a header that cannot be read."""
    try:
        return layers_of(unpack_header(read_preamble(data).header).chunks)
    except DecodeError:
        return []


def _for_all(data: bytes) -> bool:
    """Whether a decoder of mode ans only gives the answer of any other: mode and deformation are those that it knows,
    or it gets no further than the header."""
    try:
        header = unpack_header(read_preamble(data).header)
    except DecodeError:
        return True
    return header.mode == "ans"


def files(found: list[Vector]) -> dict[str, bytes]:
    """Path below spec/vectors -> content."""
    rows = ",\n".join(json.dumps(entry(v), ensure_ascii=False) for v in found)
    manifest = f'{{"format": "2.0-draft", "vectors": [\n{rows}\n]}}\n'
    return {MANIFEST: manifest.encode(), **{v.name + SUFFIX: v.data for v in found}}


def surprises(found: list[Vector]) -> Iterator[str]:
    """One line per vector that the package decodes to something else than was meant."""
    for vector in found:
        expected: object = vector.error or vector.layers
        try:
            outcome: object = hashes(vector.data)
        except DecodeError as error:
            outcome = type(error).__name__
        if outcome != expected:
            yield f"{vector.name}: the package gives {outcome}, meant was {expected}"


def differences(wanted: dict[str, bytes], folder: Path) -> Iterator[str]:
    """One line per file that is missing, different or not wanted."""
    there = {str(p.relative_to(folder)) for p in folder.rglob("*") if p.suffix in (SUFFIX, ".json")}
    for name in sorted(there - set(wanted)):
        yield f"{name}: not a vector"
    for name, content in wanted.items():
        if name not in there:
            yield f"{name}: missing"
        elif (folder / name).read_bytes() != content:
            yield f"{name}: other bytes"


def write(wanted: dict[str, bytes], folder: Path) -> None:
    """Make `folder` hold these files and no other vectors."""
    for path in folder.rglob("*" + SUFFIX):
        if str(path.relative_to(folder)) not in wanted:
            path.unlink()
    for name, content in wanted.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)


def main() -> int:
    parser = argparse.ArgumentParser(description="Write or check the conformance vectors.")
    parser.add_argument("--check", action="store_true", help="compare with what is there, write nothing")
    arguments = parser.parse_args()
    found = vectors()
    wanted = files(found)
    lines = list(differences(wanted, VECTORS) if arguments.check else surprises(found))
    for line in lines:
        print(line, file=sys.stderr)
    if lines:
        return 1
    if not arguments.check:
        write(wanted, VECTORS)
    verb = "are as they should be" if arguments.check else "written"
    print(f"{len(found)} vectors, {sum(map(len, wanted.values()))} bytes {verb}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
