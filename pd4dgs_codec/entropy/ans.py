"""One ANS stream: symbols and integer tables <-> bytes. constriction's AnsCoder is the reference coder.

The stream is u32 words, little-endian, in the order in which the decoder consumes them. The decoder's whole arithmetic:

    x = 0; while words are left and x < 2**32: x = x << 32 | next()
    symbol: q = x & 0xFFFFFF; s with cum[s] <= q < cum[s + 1]; x = (x >> 24) * (cum[s + 1] - cum[s]) + q - cum[s]
            if x < 2**32 and words are left: x = x << 32 | next()
    end:    x == 0 and no words left

constriction panics with a BaseException on a bad table, leaves half a channel encoded on a bad symbol, and aborts the
process on a count that it cannot allocate. So everything is checked first.
"""

from collections.abc import Sequence
from typing import TypeAlias

import constriction
import numpy as np

from pd4dgs_codec.errors import EncodeError, LimitExceeded, Malformed

TOTAL = 1 << 24  #: of the frequencies of a table
MAX_COUNT = 1 << 26  #: symbols in one channel; decoding allocates four bytes for each
_U32 = np.dtype("<u4")
_INVALID = f"a frequency table does not ascend from 0 to {TOTAL}"


#: constriction's model of a table. Given frequencies less one, its rounding has scale exactly 1 and restores the table.
Model: TypeAlias = constriction.stream.model.Categorical


def model_of(cum: np.ndarray) -> Model | None:
    """Returns the model of a table int64 [n + 1], None if it has one symbol. Raises Malformed for an invalid table."""
    frequencies = cum[1:] - cum[:-1]  # without `models_of_each`, which takes twice as long for one table
    if not len(frequencies) or cum[0] or cum[-1] != TOTAL or frequencies[frequencies.argmin()] < 1:
        raise Malformed(_INVALID)
    return Model((frequencies - 1).astype(np.float64), perfect=False) if len(frequencies) > 1 else None


def models_of_each(cums: np.ndarray, sizes: np.ndarray) -> list[Model | None]:
    """Returns the models of concatenated tables int64 [sum of (size + 1)] in one pass; see `model_of`."""
    ends = np.cumsum(sizes + 1)
    firsts = ends - sizes - 1
    frequencies = np.zeros(len(cums))  # the last number belongs to no table; junk there could make numpy warn
    np.subtract(cums[1:], cums[:-1], out=frequencies[:-1])
    frequencies -= 1
    frequencies[ends - 1] = 0  # the difference between two tables
    if cums[firsts].any() or np.any(cums[ends - 1] != TOTAL) or frequencies.min(initial=0) < 0:
        raise Malformed(_INVALID)
    pairs = zip(firsts.tolist(), sizes.tolist(), strict=True)
    return [Model(frequencies[at : at + n], perfect=False) if n > 1 else None for at, n in pairs]


def ans_encode(channels: Sequence[np.ndarray], cums: Sequence[np.ndarray], sizes: list[int] | None = None) -> bytes:
    """Encodes channels (int, 1-D, symbols 0 .. n - 1) in order, each under its own table cum [n + 1].

    A channel whose table has one symbol costs nothing. sizes: gets the bits of the last channel, of the last two, and
    so on. Raises EncodeError for a bad symbol, Malformed for a bad table.
    """
    if len(channels) != len(cums):
        raise EncodeError(f"{len(channels)} channels need as many frequency tables, found {len(cums)}")
    coder = constriction.stream.stack.AnsCoder()
    for index in range(len(channels) - 1, -1, -1):  # a stack: last in, first out
        symbols, cum = np.asarray(channels[index]), np.asarray(cums[index], dtype=np.int64)
        model = model_of(cum)
        if symbols.size:
            if symbols.ndim != 1 or symbols.dtype.kind not in "iu":
                found = f"{symbols.dtype} {symbols.shape}"
                raise EncodeError(f"channel {index}: expected a 1-D integer array, found {found}")
            low, high = int(symbols.min()), int(symbols.max())
            if low < 0 or high > len(cum) - 2:
                raise EncodeError(f"channel {index}: symbols {low}..{high} outside the table's 0..{len(cum) - 2}")
            if model is not None:
                coder.encode_reverse(np.ascontiguousarray(symbols, dtype=np.int32), model)
        if sizes is not None:
            sizes.append(coder.num_valid_bits())
    words: np.ndarray = coder.get_compressed()
    return words[::-1].astype(_U32).tobytes()


class AnsDecoder:
    """Sequential decoder of one stream. `data` holds the stream's words and nothing else."""

    def __init__(self, data: bytes | memoryview):
        if len(data) % 4:
            raise Malformed(f"an ANS stream of {len(data)} bytes, expected a multiple of 4")
        words = np.frombuffer(data, dtype=_U32).astype(np.uint32)[::-1]
        if len(words) and words[-1] == 0:
            raise Malformed("an ANS stream begins with a zero word")
        self._coder = constriction.stream.stack.AnsCoder(np.ascontiguousarray(words))

    def take(self, count: int, model: Model | None) -> np.ndarray:
        """Decodes the next `count` symbols under a table, int32 [count]. Corrupt bytes give junk: see finish()."""
        if not 0 <= count <= MAX_COUNT:
            raise LimitExceeded(f"{count} symbols in one channel, limit {MAX_COUNT}")
        if count == 0 or model is None:
            return np.zeros(count, dtype=np.int32)
        symbols: np.ndarray = self._coder.decode(model, count)
        return symbols

    @property
    def left(self) -> int:
        """Number of bits not taken yet."""
        bits: int = self._coder.num_valid_bits()
        return bits

    def finish(self) -> None:
        """Raises Malformed unless exactly the stream's symbols have been taken: state 0 and no words left.

        This finds nearly every damaged stream, not all: state 0 is a fixed point that yields first symbols for ever, so
        a cut stream can end in it too. Only the chunk's length and CRC-32 guarantee complete bytes.
        """
        if not self._coder.is_empty():
            raise Malformed("an ANS stream does not end in state 0: corrupt bytes or wrong counts")
