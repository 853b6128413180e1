"""What must hold for every input, whatever its bytes: the oracle of the fuzzer and of its tests.

Every entry point ends in a scene or in a DecodeError; all of them agree; nothing that a checksum should have caught is
decoded to other symbols; time and memory stay within bounds.
"""

from __future__ import annotations

import importlib.util
import random
import time
import tracemalloc
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

from fuzzing.files import digests
from fuzzing.mutate import Case
from pd4dgs_codec import decode, open_stream
from pd4dgs_codec.errors import DecodeError, Truncated
from pd4dgs_codec.format.container import CHUNK_OVERHEAD, read_chunk, read_preamble
from pd4dgs_codec.format.decoder import decode_partial
from pd4dgs_codec.format.header import unpack_header
from pd4dgs_codec.format.info import hashes, info
from pd4dgs_codec.format.kinds import BY_CHUNK_TYPE
from pd4dgs_codec.format.layer_meta import Declared, check_declared
from pd4dgs_codec.format.payload import read_meta

MAX_SECONDS = 2.0  #: of processor time, per input
#: Peak memory of decoding is at most these times the symbols declared, the bytes given, and a constant, a larger one
#: where a layer has several slices (clause 15).
BYTES_PER_SYMBOL, BYTES_PER_BYTE, BYTES_ALWAYS, BYTES_OF_SLICES = 48, 48, 64 << 20, 256 << 20

REFERENCE = Path(__file__).resolve().parents[2] / "spec" / "refdec.py"
REFERENCE_SYMBOLS = 20_000

DECODED = "decoded"


class Finding(Exception):
    """A promise that an input breaks. kind: one word for counting."""

    def __init__(self, kind: str, message: str):
        self.kind = kind
        super().__init__(message)


@dataclass(frozen=True)
class Outcome:
    """name: DECODED or the error's class. seconds: of processor time. checksums: right ones, header's and chunks'."""

    name: str
    seconds: float
    checksums: int


def _end(function: Callable[..., Any], *args: Any, **options: Any) -> tuple[str, object]:
    """(DECODED or the error's class name, the result or the error). Finding for anything else that is raised."""
    try:
        return DECODED, function(*args, **options)
    except DecodeError as error:
        if "\n" in str(error) or len(str(error)) > 500:
            raise Finding("message", f"not one clear line: {str(error)[:200]!r}") from None
        return type(error).__name__, error
    except BaseException as error:  # the coder library panics with one
        if isinstance(error, KeyboardInterrupt):
            raise
        name = getattr(function, "__name__", "?")
        raise Finding("exception", f"{name} raised {type(error).__name__}: {str(error)[:200]}") from error


def _place(result: object) -> tuple[int | None, int | None] | None:
    """Where an error says it lies; None for what is decoded."""
    return (result.chunk, result.offset) if isinstance(result, DecodeError) else None


def _streamed(data: bytes, rng: random.Random) -> list[tuple[int, ...]]:
    """The layers of each scene that a stream yields for `data` in pieces; DecodeError at its end as decode would."""
    stream, layers = open_stream(), []
    cuts = sorted(rng.randint(0, len(data)) for _ in range(rng.randint(0, 4)))
    for a, b in zip([0, *cuts], [*cuts, len(data)], strict=True):
        layers += [scene.layers for scene in stream.feed(data[a:b])]
    stream.finish()
    return layers


def count_checksums(data: bytes) -> int:
    """How many checksums hold, in the order of reading: the header's, then each chunk's, as the frames follow."""
    count = 0
    try:
        offset, count = read_preamble(data).size, 1
        while offset < len(data):
            offset, count = read_chunk(data, offset).end, count + 1
    except DecodeError:
        pass
    return count


def declared(data: bytes) -> tuple[int, int]:
    """(symbols, slices behind a layer's first) that `data` declares within the limits, up to the first slice that is
    refused."""
    total, later = Declared(), 0
    rows, refined = dict[int, list[int]](), Counter[int]()  # by layer: anchors of each slice, slices with low bits
    try:
        preamble = read_preamble(data)
        header, offset = unpack_header(preamble.header), preamble.size
        for kind_number, length in header.chunks:
            kind = BY_CHUNK_TYPE.get(kind_number)
            if kind is not None:
                payload = read_chunk(data, offset, length=length).payload
                again = kind.layer in rows
                meta, _, total = read_meta(payload, kind, header.widths, total, header.raw_deformation, again)
                later += again
                if meta.refines:
                    layer, count = meta.refines
                    named = rows.get(layer, [])[refined[layer] :][:count]
                    total = check_declared(total.and_slice(0, sum(named) * header.widths.channels, 0), kind)
                    refined[layer] += count
                rows.setdefault(kind.layer, []).append(meta.rows)
            offset += CHUNK_OVERHEAD + length
    except DecodeError:
        pass
    return total.symbols, later


def memory_bound(data: bytes) -> int:
    """The most bytes that decoding `data` may hold at once."""
    symbols, later = declared(data)
    return BYTES_PER_SYMBOL * symbols + BYTES_PER_BYTE * len(data) + (BYTES_OF_SLICES if later else BYTES_ALWAYS)


def peak_memory(data: bytes) -> int:
    """The most bytes allocated at once while `data` is decoded; numpy's arrays are counted."""
    tracemalloc.start()
    try:
        _end(decode, data)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def check_memory(data: bytes) -> float:
    """Peak memory as a share of its bound; Finding if it is over."""
    peak, bound = peak_memory(data), memory_bound(data)
    if peak > bound:
        raise Finding(
            "memory", f"{peak} bytes at once, bound {bound} for {declared(data)[0]} symbols, {len(data)} bytes"
        )
    return peak / bound


def examine(case: Case, known: frozenset[tuple[bytes, ...]], rng: random.Random) -> Outcome:
    """Decode the input by every door. Raises Finding for a broken promise.

    known: digests of what the seeds' prefixes decode to; an input whose checksums were not repaired may give no other.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # a warning is a line on somebody's terminal that says nothing
        return _examine(case, known, rng)


def _examine(case: Case, known: frozenset[tuple[bytes, ...]], rng: random.Random) -> Outcome:
    data = case.data
    start = time.process_time()
    name, result = _end(decode, data)
    seconds = time.process_time() - start
    if name == DECODED and not case.repaired and digests(data) not in known:
        raise Finding("silent", "decoded, although its checksums were not repaired, to what no seed holds")
    door = rng.randrange(5)
    if door == 0:
        other, layers = _end(_streamed, data, rng)
        if other != name or (name == DECODED and layers[-1] != result.layers):  # type: ignore[index, attr-defined]
            raise Finding("disagreement", f"decode ends in {name}, a stream in {other}")
        if _place(layers) != _place(result):
            raise Finding("disagreement", f"decode finds {name} at {_place(result)}, a stream at {_place(layers)}")
    elif door == 1:
        _check_partial(case, known, name)
    elif door == 2:
        first, _ = _end(decode, data, max_layer=0)
        if first not in (DECODED, name):
            raise Finding("disagreement", f"decode ends in {name}, with max_layer=0 in {first}")
    elif door == 3:
        _end(info, data)
    else:
        other, _ = _end(hashes, data)
        if other != name:
            raise Finding("disagreement", f"decode ends in {name}, hashes in {other}")
    if seconds > MAX_SECONDS:
        raise Finding("hang", f"{seconds:.2f} s of processor time, limit {MAX_SECONDS} s")
    return Outcome(name, seconds, count_checksums(data))


def _check_partial(case: Case, known: frozenset[tuple[bytes, ...]], name: str) -> None:
    """allow_partial forgives a cut and nothing else, and yields a true prefix."""
    other, result = _end(decode_partial, case.data, allow_partial=True)
    if other != name and not (name == Truncated.__name__ and other == DECODED):
        raise Finding("disagreement", f"decode ends in {name}, with allow_partial in {other}")
    if other == DECODED:
        if result[1] != (name == DECODED):  # type: ignore[index]
            raise Finding("disagreement", f"decode ends in {name}, with allow_partial complete is {result[1]}")  # type: ignore[index]
        if not case.repaired and digests(case.data, allow_partial=True) not in known:
            raise Finding("silent", "with allow_partial decoded to what no prefix of a seed holds")


@cache
def _reference() -> ModuleType:
    spec = importlib.util.spec_from_file_location("refdec", REFERENCE)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def compare_reference(data: bytes) -> bool:
    """Whether the specification's reference decoder was asked; Finding if it yields or refuses otherwise than ours.

    It is plain Python: an input that declares more than REFERENCE_SYMBOLS is left out.
    """
    if declared(data)[0] > REFERENCE_SYMBOLS:
        return False
    name, ours = _end(hashes, data)
    reference = _reference()
    try:
        theirs = reference.hashes(data)
    except reference.Fault as fault:
        if name == DECODED:
            raise Finding("reference", f"decoded, but the reference decoder refuses: {fault}") from None
        return True
    except Exception as error:
        raise Finding("reference", f"the reference decoder raised {type(error).__name__}: {error}") from error
    if name != DECODED or ours != theirs:
        raise Finding("reference", f"ends in {name}, but the reference decoder yields {theirs}: {ours}")
    return True
