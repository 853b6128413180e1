"""The registry of priors: parameters <-> bytes, and the integer table of each.

A prior covers a window of symbols kmin .. kmin + n - 1. Symbols outside it are exceptions, listed beside the prior.

A table is ``cum`` int64 [n + 1], strictly increasing from 0 to 2**24; symbol q owns the interval [cum[q], cum[q + 1]).
Tables are the only probabilities in the format. Their rules use integers below 2**53 only, so Python, C and JavaScript
build the same table on every machine.

A new prior needs a subclass of `_Tabled` with an id, `cum`, `write` and `read`, and its name in `Prior`. `make_models`
only saves time: a family that it does not list makes its tables one by one.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, TypeVar, get_args

import numpy as np

from pd4dgs_codec.entropy.ans import TOTAL, Model, model_of, models_of_each
from pd4dgs_codec.entropy.varint import ByteReader, put_varint, put_zigzag
from pd4dgs_codec.errors import Malformed, UnsupportedFeature

K_MAX = 1 << 24  #: |k| of any symbol
MAX_WINDOW = 1 << 14
#: Most entries of all tables that a layer defines, beyond one per symbol of the file so far. They bound memory: eight
#: bytes can define a table of 2**14 entries, 128 KiB.
FREE_ENTRIES = 1 << 18
MU8_MAX = 1 << 31
SI_MIN, SI_MAX = -640, 1280  #: sigma = Q * 2 ** (si / 64)
FIRST_REUSE = 8  #: family codes from here on refer to an earlier prior


@dataclass(frozen=True)
class Window:
    kmin: int
    n: int

    @property
    def end(self) -> int:
        """The first symbol above the window."""
        return self.kmin + self.n

    def write(self, out: bytearray) -> None:
        put_zigzag(out, self.kmin)
        put_varint(out, self.n - 2)

    @classmethod
    def read(cls, reader: ByteReader) -> Window:
        at = reader.offset
        kmin = reader.zigzag(K_MAX, "the window's first symbol")
        n = 2 + reader.varint(MAX_WINDOW - 2, "the window's size")
        if kmin + n - 1 > K_MAX:
            raise Malformed(f"a window of symbols {kmin}..{kmin + n - 1}, limit {K_MAX}", offset=at)
        return cls(kmin, n)


@dataclass(frozen=True)
class Normal:
    """One Gaussian in a window: mean kmin + mu8 / 256 and standard deviation 2**(si / 64), in table entries."""

    mu8: int
    si: int

    def write(self, out: bytearray, n: int) -> None:
        put_zigzag(out, self.mu8 - 128 * (n - 1))  # from the window's middle: most often two bytes
        put_varint(out, self.si - SI_MIN)

    @classmethod
    def read(cls, reader: ByteReader, n: int) -> Normal:
        mu8 = reader.zigzag(MU8_MAX, "a Gaussian's mean") + 128 * (n - 1)
        return cls(mu8, reader.varint(SI_MAX - SI_MIN, "a Gaussian's width") + SI_MIN)


class _Tabled:
    """Base of all priors: the table cum int64 [n + 1] and its model, which `make_models` can set for many at once."""

    @cached_property
    def cum(self: Any) -> np.ndarray:
        return normal_tables([self])[0]

    @cached_property
    def model(self) -> Model | None:
        return model_of(self.cum)


@dataclass(frozen=True, eq=False)
class Const(_Tabled):
    """Every symbol is kmin; costs nothing per symbol."""

    id: ClassVar[int] = 0
    window: Window

    def write(self, out: bytearray) -> None:
        put_zigzag(out, self.window.kmin)

    @classmethod
    def read(cls, reader: ByteReader) -> Const:
        return cls(Window(reader.zigzag(K_MAX, "a constant"), 1))


@dataclass(frozen=True, eq=False)
class Gauss(_Tabled):
    """A quantised Gaussian, the model of R(a)."""

    id: ClassVar[int] = 1
    window: Window
    normal: Normal

    def write(self, out: bytearray) -> None:
        self.window.write(out)
        self.normal.write(out, self.window.n)

    @classmethod
    def read(cls, reader: ByteReader) -> Gauss:
        window = Window.read(reader)
        return cls(window, Normal.read(reader, window.n))


@dataclass(frozen=True, eq=False)
class Mixture(_Tabled):
    """Two quantised Gaussians; `weight` 1..255 is the second one's share in 1/256."""

    id: ClassVar[int] = 2
    window: Window
    first: Normal
    second: Normal
    weight: int

    def write(self, out: bytearray) -> None:
        self.window.write(out)
        self.first.write(out, self.window.n)
        self.second.write(out, self.window.n)
        out.append(self.weight)

    @classmethod
    def read(cls, reader: ByteReader) -> Mixture:
        window = Window.read(reader)
        first, second = Normal.read(reader, window.n), Normal.read(reader, window.n)
        weight = reader.byte("a mixture's weight")
        if weight == 0:
            raise Malformed("a mixture with a weight of 0", offset=reader.offset)
        return cls(window, first, second, weight)


Prior = Const | Gauss | Mixture
AnyPrior = TypeVar("AnyPrior", bound=Prior)
_FAMILIES: dict[int, type[Prior]] = {family.id: family for family in get_args(Prior)}


#: Table entries made at a time: enough to save numpy calls, few enough to save memory.
BATCH = 1 << 14


def make_models(priors: Sequence[Prior]) -> None:
    """Sets `model` of Gaussians and mixtures, many in one pass."""
    for batch in _batches([prior for prior in priors if isinstance(prior, Gauss | Mixture)]):
        for prior, model in zip(batch, models_of_each(*normal_tables(batch)), strict=True):
            prior.__dict__["model"] = model  # where cached_property keeps it


def _batches(priors: Sequence[AnyPrior]) -> Iterator[list[AnyPrior]]:
    """Yields the priors in order, in batches whose windows have about BATCH entries together."""
    batch, entries = list[AnyPrior](), 0
    for prior in priors:
        batch.append(prior)
        entries += prior.window.n
        if entries > BATCH:
            yield batch
            batch, entries = [], 0
    if batch:
        yield batch


def normal_tables(priors: Sequence[Prior]) -> tuple[np.ndarray, np.ndarray]:
    """Returns (concatenated tables int64, their sizes int64 [m]).

    Raises TypeError for a prior of another class, which has to define `cum` itself."""
    normals = list[Normal]()
    for prior in priors:
        if isinstance(prior, Gauss):
            normals.append(prior.normal)
        elif isinstance(prior, Mixture):
            normals.append(prior.first)
        elif isinstance(prior, Const):
            normals.append(Normal(0, 0))
        else:
            raise TypeError(f"{type(prior).__name__}: its table is not one of Gaussians")
    sizes = np.array([prior.window.n for prior in priors], dtype=np.int64)
    cdf = norm_cdf28_of_each(sizes, *_columns(normals))
    if mixtures := [prior for prior in priors if isinstance(prior, Mixture)]:
        mixed = np.array([isinstance(prior, Mixture) for prior in priors])
        second = norm_cdf28_of_each(sizes[mixed], *_columns([prior.second for prior in mixtures]))
        weight = np.repeat(np.array([prior.weight for prior in mixtures]), sizes[mixed] + 1)
        inside = np.repeat(mixed, sizes + 1)
        cdf[inside] = ((256 - weight) * cdf[inside] + weight * second) >> 8
    return tables_of_each(cdf, sizes), sizes


def _columns(normals: Sequence[Normal]) -> tuple[np.ndarray, np.ndarray]:
    mu8, si = zip(*((normal.mu8, normal.si) for normal in normals), strict=True)
    return np.array(mu8, dtype=np.int64), np.array(si, dtype=np.int64)


def read_prior(reader: ByteReader, family: int) -> Prior:
    """Reads a prior of a family. Raises UnsupportedFeature for a family outside the registry."""
    if family not in _FAMILIES:
        raise UnsupportedFeature(f"prior family {family}, expected one of {sorted(_FAMILIES)}", offset=reader.offset)
    return _FAMILIES[family].read(reader)


# -- integer frequency tables ------------------------------------------------------------------------------------------

FLOOR = 16  #: least frequency: 16 / 2**24 is the clip of R(a), and keeps outliers from steering a fit

# The two constants of NormTable v1. Computing them in float64 is safe: no entry comes closer than 1e-4 to a rounding
# boundary (a test checks that), while float64 is off by less than 1e-6 whatever the C library.
_T = [round(2**27 * math.erf(i / (32 * math.sqrt(2)))) for i in range(257)]
NORMAL = np.array([*_T, _T[-1]], dtype=np.int64)  #: T[i] = round(2**28 (Phi(i / 32) - 1/2)), T[257] = T[256]
OCTAVE = np.array([round(2.0 ** (31 - j / 64)) for j in range(64)], dtype=np.int64)  #: M[j]


def _mass(t: np.ndarray, si: np.ndarray) -> np.ndarray:
    """Returns a Gaussian's mass up to t / 256 from its mean, in units of 2**-28; si broadcasts against t."""
    e, nb = si >> 6, np.maximum(0, (si >> 6) - 8)
    a = np.minimum(np.abs(t) >> nb, (1 << 21) - 1)
    z = np.minimum((a * OCTAVE[si & 63]) >> (23 + e - nb), 8 << 16)
    i, f = z >> 11, z & 2047
    v = NORMAL[i] + (((NORMAL[i + 1] - NORMAL[i]) * f) >> 11)
    mass: np.ndarray = (1 << 27) + np.where(t < 0, -v, v)
    return mass


def norm_cdf28_of_each(sizes: np.ndarray, mu8: np.ndarray, si: np.ndarray) -> np.ndarray:
    """Returns C(k), the mass up to k + 1/2 in units of 2**-28, for k = -1 .. n - 1 of many Gaussians, concatenated.

    sizes, mu8, si: int64 [m], the n of each Gaussian, 256 * (mean - kmin) in symbols, and 64 * log2(sigma / Q). A table
    uses neither the first nor the last value. Calling numpy for each short table would take longer than decoding it.
    """
    lengths = sizes + 1
    return _mass(_counted(lengths) * 256 - np.repeat(128 + mu8, lengths), np.repeat(si, lengths))


def tables_of_each(cdf: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """NormTable v1: returns the concatenated tables of a result of norm_cdf28_of_each. sizes: int64 [m].

    Each symbol gets FLOOR plus its share of the rest; the first also gets the mass below the window, the last the
    mass above it. The caller has checked the limits of clause 8.2: sizes 1 .. 2**14, si within SI_MIN .. SI_MAX, |mu8|
    < 2**40.
    """
    lengths = sizes + 1
    ends = np.cumsum(lengths)
    cum: np.ndarray = (cdf * np.repeat(TOTAL - sizes * FLOOR, lengths)) >> 28
    cum += FLOOR * _counted(lengths)
    cum[ends - lengths], cum[ends - 1] = 0, TOTAL
    return cum


def _counted(lengths: np.ndarray) -> np.ndarray:
    """Returns 0 .. length - 1 for each of `lengths`, concatenated."""
    counted: np.ndarray = np.arange(int(lengths.sum())) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    return counted


# -- the cost of a frequency -------------------------------------------------------------------------------------------

BIT = 1 << 20  #: one bit in integer costs, whose sums do not depend on their order
#: log2(1 + i / 4096) in these units, the last one twice. Linear interpolation is off by less than 2e-8 bits.
LOG2 = np.rint(np.log2(1 + np.minimum(np.arange(4098), 4096) / 4096) * BIT).astype(np.int64)


def frequency_costs(frequencies: np.ndarray) -> np.ndarray:
    """Returns the costs 24 - log2(f), int64 [...] in units of 2^-20 bits, of frequencies f int64 [...], 1 .. 2^24."""
    bits = frequencies.astype(np.float64).view(np.int64)  # exponent and mantissa, IEEE 754
    i, f = (bits >> 40) & 4095, (bits >> 28) & 4095
    log2: np.ndarray = (((bits >> 52) - 1023) * BIT) + LOG2[i] + (((LOG2[i + 1] - LOG2[i]) * f) >> 12)
    return 24 * BIT - log2
