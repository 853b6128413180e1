"""One coverage-guided run of the decoder under atheris; `fuzz.py --atheris` starts it. Arguments go to libFuzzer.

libFuzzer changes the whole input, or one section, parameter block or header of it; then lengths, chunk list, scene id
and checksums are made right again, so that its feedback comes from the parsers and tables behind them.
"""

from __future__ import annotations

import random
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

import atheris  # noqa: E402

with atheris.instrument_imports(include=[f"pd4dgs_codec.{p}" for p in ("bitstream", "entropy", "attributes", "codec")]):
    from fuzzing.check import examine

from fuzzing.files import put_together, take_apart  # noqa: E402
from fuzzing.mutate import Case  # noqa: E402

from pd4dgs_codec.errors import Pd4Error  # noqa: E402
from pd4dgs_codec.format import canonical  # noqa: E402


def examine_one(data: bytes) -> None:
    """Every promise but the one about unrepaired checksums, of which an input here knows nothing."""
    examine(Case(data, True, "atheris"), frozenset(), random.Random(len(data)))


def mutate(data: bytes, max_size: int, seed: int) -> bytes:
    """libFuzzer's own mutations, inside one part of a file that is put together again, or of all bytes."""
    rng = random.Random(seed)
    try:
        parts = take_apart(data)
    except (Pd4Error, LookupError, ValueError, AttributeError):  # not a file that has all its parts
        return bytes(atheris.Mutate(data, len(data)))
    if rng.random() < 0.1:
        return bytes(atheris.Mutate(data, len(data)))
    chunk = rng.choice(parts.chunks)
    if rng.random() < 0.15:
        parts.header = _mutated_map(parts.header)
    elif chunk.sections and chunk.meta is not None and rng.random() < 0.75:
        number = rng.choice(list(chunk.sections))
        section = chunk.sections[number]
        chunk.sections[number] = atheris.Mutate(section, len(section) + 16)
    elif chunk.meta is not None:
        chunk.meta = _mutated_map(chunk.meta)
    else:
        chunk.payload = atheris.Mutate(chunk.payload, len(chunk.payload) + 16)
    return put_together(parts)[:max_size]


def _mutated_map(value: dict[Any, Any]) -> dict[Any, Any]:
    """A changed map, or the same where the changed bytes are no map."""
    packed = canonical.pack(value)
    try:
        changed = canonical.unpack(atheris.Mutate(packed, len(packed) + 8))
    except Pd4Error:
        return value
    return changed if isinstance(changed, dict) else value


if __name__ == "__main__":
    atheris.Setup(sys.argv, examine_one, custom_mutator=mutate)
    atheris.Fuzz()
