"""The promises that hold for every input: the oracle of the fuzzer.

Every entry point ends in tensors, in a scene or in a DecodeError of one line, and all agree. Damage under a CRC never
decodes. Time and memory stay within bounds. The three decoders accept the same files, with the same hashes of their
tensors, and those that know kinds make scenes of the same tensors.
"""

from __future__ import annotations

import base64
import json
import random
import subprocess
import time
import tracemalloc
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from vectors import ROOT, refdec

from pd4dgs_codec import decode, open_stream
from pd4dgs_codec.errors import DecodeError
from pd4dgs_codec.format.container import CHUNK_OVERHEAD, read_chunk, read_preamble
from pd4dgs_codec.format.decoder import decode_partial
from pd4dgs_codec.format.header import unpack_header
from pd4dgs_codec.format.info import hashes, info
from pd4dgs_codec.format.parameters import Declared, read_parameters
from pd4dgs_codec.tensors.tables import Tables

from .legal import Case

MAX_SECONDS = 2.0  #: of processor time, per input
#: Peak memory of decoding is at most these times the symbols declared, the bytes given, and a constant, a larger one
#: where a layer has several slices (clause 15).
BYTES_PER_SYMBOL, BYTES_PER_BYTE, BYTES_ALWAYS, BYTES_OF_SLICES = 48, 48, 64 << 20, 256 << 20
REFERENCE_SYMBOLS = 20_000  #: the reference decoder is plain Python: inputs that declare more are left out
DECODED = "decoded"
JUNK = {"f4": 0x7F800001, "f8": 0x7FF0000000000001}  #: signalling NaN: every operation on one is a warning


class Finding(Exception):
    """A promise that an input breaks. kind: one word for counting."""

    def __init__(self, kind: str, message: str):
        self.kind = kind
        super().__init__(message)


@dataclass(frozen=True)
class Answer:
    """What a decoder makes of a file: DECODED or the name of an error, and the hashes or the error. scene: the same
    name for the scene; "" if its tensors do not decode, or the decoder knows no kinds."""

    name: str
    result: Any = None
    scene: str = ""


def outcome(function: Callable[..., Any], *args: Any, **options: Any) -> tuple[str, Any]:
    """(DECODED or the name of the error, the result or the error). Finding for anything else that is raised."""
    try:
        return DECODED, function(*args, **options)
    except DecodeError as error:
        if "\n" in str(error) or len(str(error)) > 500:
            raise Finding("message", f"not one line: {str(error)[:200]!r}") from None
        return type(error).__name__, error
    except BaseException as error:  # a panic of the coder library is no Exception
        if isinstance(error, KeyboardInterrupt):
            raise
        name = getattr(function, "__name__", "?")
        raise Finding("exception", f"{name} raised {type(error).__name__}: {str(error)[:200]}") from error


@contextmanager
def junk_in_new_memory() -> Iterator[None]:
    """Within the block `numpy.empty` returns memory full of JUNK, as after other work of the process, never zeros."""
    empty = np.empty

    def filled(shape: Any, dtype: Any = float, **options: Any) -> np.ndarray:
        made: np.ndarray = empty(shape, dtype, **options)
        if made.dtype.kind in "fiu":
            made.view(f"u{made.itemsize}")[...] = JUNK.get(made.dtype.str[1:], 113)
        return made

    np.empty = filled
    try:
        yield
    finally:
        np.empty = empty


# -- the package -------------------------------------------------------------------------------------------------------


def declared(data: bytes) -> tuple[int, bool]:
    """(symbols, whether a layer has several slices) that `data` declares within the limits, up to the first slice that
    is refused."""
    total, first, sliced = Declared(), dict[int, Tables](), False
    try:
        preamble = read_preamble(data)
        header, offset = unpack_header(preamble.header), preamble.size
        total = header.declared
        for number, length in header.chunks:
            if number < 3:
                payload = read_chunk(data, offset, length=length).payload
                found, _, total = read_parameters(payload, number, header.table, total, first.get(number))
                sliced |= number in first
                first.setdefault(number, found.tables)
            offset += CHUNK_OVERHEAD + length
    except DecodeError:
        pass
    return total.symbols, sliced


def check_memory(data: bytes, base: bytes | None = None) -> float:
    """Peak memory of decoding (numpy's arrays are counted) as a share of its bound; Finding if it is over."""
    parts = [declared(part) for part in (data, base) if part is not None]
    symbols, size = sum(count for count, _ in parts), len(data) + len(base or b"")
    always = BYTES_OF_SLICES if any(sliced for _, sliced in parts) else BYTES_ALWAYS
    bound = BYTES_PER_SYMBOL * symbols + BYTES_PER_BYTE * size + always
    tracemalloc.start()
    try:
        outcome(decode, data, base=base)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    if peak > bound:
        raise Finding("memory", f"peak of {peak} bytes, bound {bound} for {symbols} symbols, {size} bytes")
    return peak / bound


def streamed(data: bytes, base: bytes | None, rng: random.Random) -> Any:
    """The last scene that a stream yields for `data` in pieces; DecodeError as decode would raise."""
    stream, scenes = open_stream(base), list[Any]()
    cuts = sorted(rng.randint(0, len(data)) for _ in range(rng.randint(0, 4)))
    for a, b in zip([0, *cuts], [*cuts, len(data)], strict=True):
        scenes += stream.feed(data[a:b])
    stream.finish()
    return scenes[-1]


def check_package(case: Case, rng: random.Random) -> Answer:
    """What the package makes of an input, by `hashes`, `decode` and one other entry point. Raises Finding for a broken
    promise."""
    with junk_in_new_memory(), warnings.catch_warnings():
        warnings.simplefilter("error")  # a warning is a line on somebody's terminal
        start = time.process_time()
        name, result = outcome(hashes, case.data, base=case.base)
        between = time.process_time()
        scene, found = outcome(decode, case.data, base=case.base)
        seconds = max(between - start, time.process_time() - between)
        if seconds > MAX_SECONDS:
            raise Finding("time", f"{seconds:.2f} s of processor time, limit {MAX_SECONDS} s")
        if name == DECODED and not case.sealed and case.data not in case.origins:
            raise Finding("silent", "decoded a mutated file without an error, although its CRCs are wrong")
        if scene not in (name, "Malformed", "UnsupportedFeature") or (case.scene and scene != name):
            raise Finding("disagreement", f"tensors end in {name}, the scene in {scene} ({found})")
        _other_entry_point(case.data, case.base, scene, found, rng)
    return Answer(name, result, scene if name == DECODED else "")


def _other_entry_point(data: bytes, base: bytes | None, name: str, result: Any, rng: random.Random) -> None:
    """name, result: of decode."""
    entry = rng.randrange(4)
    if entry == 0:
        way, (other, found) = "a stream", outcome(streamed, data, base, rng)
        ends = [(r.chunk, r.offset) if isinstance(r, DecodeError) else r.layers for r in (result, found)]
        right = other == name and ends[0] == ends[1]
    elif entry == 1:
        way, (other, found) = "with allow_partial", outcome(decode_partial, data, allow_partial=True, base=base)
        whole = name == DECODED
        right = found[1] == whole and name in (DECODED, "Truncated") if other == DECODED else other == name
    elif entry == 2:
        way, (other, found) = "with max_layer=0", outcome(decode, data, max_layer=0, base=base)
        right = other in (DECODED, name)
    else:
        way, (other, found), right = "info", outcome(info, data), True
    if not right:
        raise Finding("disagreement", f"decode ends in {name}, {way} in {other} ({result!s:.200}; {found!s:.200})")


# -- the other decoders ------------------------------------------------------------------------------------------------


def reference(data: bytes, base: bytes | None) -> Answer | None:
    """That of the specification; None for an input that would take long."""
    if sum(declared(part)[0] for part in (data, base or b"")) > REFERENCE_SYMBOLS:
        return None
    try:
        return Answer(DECODED, refdec.hashes(data, base=base))
    except refdec.Fault as fault:
        return Answer(fault.name, fault)
    except Exception as error:
        return Answer(f"crash, {type(error).__name__}: {error}", error)


class JavaScript:
    """The player's decoder, in a process of Node. It is an ans-only decoder (clause 16)."""

    def __init__(self) -> None:
        command = ["node", str(ROOT / "player" / "testing" / "decoder_loop.mjs")]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def __call__(self, data: bytes, base: bytes | None) -> Answer | None:
        """None for an input that it need not decode."""
        parts = [part for part in (data, base) if part is not None]
        for part in parts:
            with suppress(DecodeError):
                if unpack_header(read_preamble(part).header).mode != "ans":
                    return None
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(" ".join(base64.b64encode(part).decode() for part in parts) + "\n")
        self._process.stdin.flush()
        line = self._process.stdout.readline()
        found = json.loads(line) if line else {"crash": f"the process ended with exit code {self._process.wait()}"}
        if "crash" in found:
            return Answer(f"crash, {found['crash']}")
        if "error" in found:
            return Answer(found["error"], found["message"])
        return Answer(DECODED, found["hashes"], found["scene"]["error"] if found["scene"] else DECODED)


Decoder = Callable[[bytes, bytes | None], Answer | None]


def compare(answers: Mapping[str, Answer]) -> str | None:
    """None if all answers agree, or the two names that differ: a file with several faults may be refused for any of
    them. Finding if one accepts a file that another refuses, for other hashes, or for a crash."""
    (first, expected), *others = answers.items()
    difference = None
    for name, found in others:
        both = f"{first}: {expected.name} ({expected.result}), {name}: {found.name} ({found.result})"
        if found.name.startswith("crash"):
            raise Finding("crash", f"{name}: {found.name[:300]}")
        if DECODED in (found.name, expected.name) and found.name != expected.name:
            raise Finding("disagreement", both[:600])
        if found.name == DECODED and found.result != expected.result:
            raise Finding("disagreement", f"{first} and {name} give different hashes")
        scenes = {found.scene, expected.scene} - {""}
        if len(scenes) > 1 and DECODED in scenes:
            raise Finding("disagreement", f"the scene of {first}: {expected.scene}, of {name}: {found.scene}")
        if found.name != expected.name or len(scenes) > 1:
            both = (f"{of} {answer.name} {answer.scene}".strip() for of, answer in ((name, found), (first, expected)))
            difference = ", ".join(both)
    return difference
