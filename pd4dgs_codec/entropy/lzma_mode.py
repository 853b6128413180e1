"""Mode lzma: channels coded by LZMA2 instead of ANS, in the byte layout that LZMA2 codes best.

The codes have a varint (zigzag(base) << 2 | log2(width)) per non-empty channel. The stream is one raw LZMA2 stream of
the channels in order, each as little-endian signed integers k - base of the narrowest width in bytes, and all bytes of
lowest weight before those of the next.
"""

import itertools
import lzma
from collections.abc import Sequence

import numpy as np

from pd4dgs_codec.entropy import EFFORTS
from pd4dgs_codec.entropy.channels import check_channels
from pd4dgs_codec.entropy.priors import K_MAX
from pd4dgs_codec.entropy.varint import ByteReader, put_varint
from pd4dgs_codec.errors import EncodeError, LimitExceeded, Malformed

MAX_RAW = 1 << 31  #: bytes before compression, per payload
_DICT_MAX = 1 << 26  #: a decoder never needs more memory than this plus the data
_SAMPLE = 1 << 19  #: bytes on which the search compares settings
_SIGNED: list[np.dtype] = [np.dtype("<i1"), np.dtype("<i2"), np.dtype("<i4")]


def encode_channels_lzma(channels: Sequence[np.ndarray], effort: int = 5) -> tuple[bytes, bytes]:
    """Encodes int32 channels (1-D, |k| <= 2**24): (codes, stream), both empty without symbols. effort: 1..9, settings
    to try. Raises EncodeError."""
    codes, numbers = bytearray(), list[np.ndarray]()
    for array in check_channels(channels):
        if len(array):
            base, log_width = _narrowest(int(array.min()), int(array.max()))
            put_varint(codes, (2 * base if base >= 0 else -2 * base - 1) << 2 | log_width)
            numbers.append((array - base).astype(_SIGNED[log_width]))
    return bytes(codes), _compress(numbers, effort) if numbers else b""


def decode_channels_lzma(codes: bytes | memoryview, stream: bytes, counts: Sequence[int]) -> list[np.ndarray]:
    """Inverse of encode_channels_lzma: one int32 [count] array per count. Raises Malformed or LimitExceeded."""
    reader = ByteReader(codes)
    bases, dtypes = list[int](), list[np.dtype]()
    for count in counts:
        code = reader.varint(8 * K_MAX + 3, "a channel's base and width") if count else 0
        if code & 3 == 3:
            raise Malformed("a channel of 8-byte symbols, expected 1, 2 or 4", offset=reader.offset)
        bases.append(-((code >> 2) + 1) // 2 if code & 4 else code >> 3)
        dtypes.append(_SIGNED[code & 3])
    if reader.remaining:
        raise Malformed(f"{reader.remaining} bytes of codes behind the last channel", offset=reader.offset)
    arrays = []
    for base, numbers in zip(bases, _decompress(stream, dtypes, counts), strict=True):
        symbols = numbers.astype(np.int64) + base
        if len(symbols) and int(np.abs(symbols).max()) > K_MAX:
            raise Malformed(f"symbols {symbols.min()}..{symbols.max()}, limit |k| <= {K_MAX}")
        arrays.append(symbols.astype(np.int32))
    return arrays


def _narrowest(low: int, high: int) -> tuple[int, int]:
    """Returns (base, log2(width)) of the narrowest width; base is 0 if numbers without a base fit that width."""
    for log_width, limit in enumerate((1 << 7, 1 << 15)):
        if -limit <= low and high < limit:
            return 0, log_width
        if high - low < 2 * limit:
            return min(low + limit, K_MAX), log_width
    return 0, 2


def _filters(size: int, lc: int, lp: int, pb: int) -> list[dict[str, int]]:
    # The dictionary's size is not stored: it is the power of two that holds all data.
    dict_size = min(max(4096, 1 << (size - 1).bit_length() if size else 0), _DICT_MAX)
    preset = 9 | lzma.PRESET_EXTREME
    return [{"id": lzma.FILTER_LZMA2, "preset": preset, "dict_size": dict_size, "lc": lc, "lp": lp, "pb": pb}]


def _packed(data: bytes, setting: tuple[int, int, int]) -> bytes:
    return lzma.compress(data, format=lzma.FORMAT_RAW, filters=_filters(len(data), *setting))


def _settings(effort: int) -> list[tuple[int, int, int]]:
    """(lc, lp, pb) to try; lc + lp <= 4 is LZMA2's own limit."""
    if effort < 4:
        return [(3, 0, 0)]
    if effort < 7:
        return [(0, 0, 0), (2, 0, 0), (4, 0, 0)]
    triples = itertools.product((0, 1, 2, 3, 4), (0, 1, 2), (0, 2))
    return [t for t in triples if t[0] + t[1] <= 4]


def _sample(data: bytes) -> bytes:
    """Eight evenly spaced pieces of long data."""
    if len(data) <= _SAMPLE:
        return data
    piece = _SAMPLE // 8
    return b"".join(data[(len(data) - piece) * i // 7 & ~3 :][:piece] for i in range(8))


def _compress(numbers: Sequence[np.ndarray], effort: int) -> bytes:
    if effort not in EFFORTS:
        raise EncodeError(f"effort is {effort}, expected 1..9")
    data = b"".join(n.view(np.uint8).reshape(-1, n.itemsize).T.tobytes() for n in numbers)
    if len(data) > MAX_RAW:
        raise EncodeError(f"LZMA: {len(data)} bytes uncompressed, limit {MAX_RAW}")
    settings = _settings(effort)
    if len(settings) > 1:
        sample = _sample(data)
        settings.sort(key=lambda setting: len(_packed(sample, setting)))
    return _packed(data, settings[0])


def _decompress(stream: bytes, dtypes: Sequence[np.dtype], counts: Sequence[int]) -> list[np.ndarray]:
    size = sum(count * dtype.itemsize for count, dtype in zip(counts, dtypes, strict=True))
    if size > MAX_RAW:
        raise LimitExceeded(f"LZMA: {size} bytes uncompressed, limit {MAX_RAW}")
    if not size and stream:
        raise Malformed(f"LZMA: a stream of {len(stream)} bytes without symbols, expected none")
    data, arrays, at = _inflate(stream, size) if size else b"", [], 0
    for count, dtype in zip(counts, dtypes, strict=True):
        part = np.frombuffer(data, dtype=np.uint8, count=count * dtype.itemsize, offset=at)
        at += part.size
        arrays.append(np.ascontiguousarray(part.reshape(dtype.itemsize, count).T).reshape(-1).view(dtype))
    return arrays


def _inflate(packed: bytes, size: int) -> bytes:
    """Decompresses exactly `size` bytes. Asks for one more to detect a longer stream. Raises Malformed."""
    decoder = lzma.LZMADecompressor(lzma.FORMAT_RAW, filters=_filters(size, 3, 0, 0))
    try:
        data = decoder.decompress(packed, max_length=size + 1)
    except lzma.LZMAError as error:
        raise Malformed(f"LZMA: {error}") from None
    if len(data) != size or not decoder.eof or decoder.unused_data:
        end = "then ends" if decoder.eof else "does not end"
        raise Malformed(f"LZMA: the stream holds {len(data)} bytes and {end}, expected the end after {size}")
    return data
