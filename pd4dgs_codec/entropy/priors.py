"""The registry of priors: parameters <-> bytes, and the integer table of each.

A prior covers a window of symbols kmin .. kmin + n - 1. Symbols outside it are exceptions, listed beside the prior.

A table is ``cum`` int64 [n + 1], strictly increasing from 0 to 2**24; symbol q owns the interval [cum[q], cum[q + 1]).
Tables are the only probabilities in the format. Their rules use integers below 2**53 only, so Python, C and JavaScript
build the same table on every machine.

A new family needs its fields in `Prior` and `read_prior` and its table in `normal_tables` and `_few_entries`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

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
FAMILIES = range(3)
FIRST_REUSE = 8  #: family codes from here on refer to an earlier prior


@dataclass(frozen=True)
class Window:
    kmin: int
    n: int

    @property
    def end(self) -> int:
        """The first symbol above the window."""
        return self.kmin + self.n


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


_ANY = Normal(0, 0)  # of a table of one entry


@dataclass(frozen=True, eq=False)
class Prior:
    """A family of priors is numbered by its Gaussians. 0: every symbol is kmin, at no cost. 1: a Gaussian, the model of
    R(a). 2: a mixture, whose `weight` 1..255 is the second one's share in 1/256."""

    window: Window
    normals: tuple[Normal, ...] = ()
    weight: int = 0

    @property
    def family(self) -> int:
        """Its number in the bitstream."""
        return len(self.normals)

    @cached_property
    def cum(self) -> np.ndarray:
        """The table, int64 [n + 1]."""
        return np.array(_few_entries(self)) if self.window.n <= FEW else normal_tables([self])[0]

    @cached_property
    def model(self) -> Model | None:
        """The model of the table; `make_models` can set it for many priors at once."""
        return model_of(self.cum)

    def write(self, out: bytearray) -> None:
        put_zigzag(out, self.window.kmin)
        if self.normals:
            put_varint(out, self.window.n - 2)
        for normal in self.normals:
            normal.write(out, self.window.n)
        if self.family == 2:
            out.append(self.weight)


def read_prior(reader: ByteReader, family: int) -> Prior:
    """Reads a prior of a family. Raises UnsupportedFeature for a family outside the registry."""
    if family not in FAMILIES:
        raise UnsupportedFeature(f"prior family {family}, expected one of {list(FAMILIES)}", offset=reader.offset)
    at, kmin = reader.offset, reader.zigzag(K_MAX, "the window's first symbol")
    n = 2 + reader.varint(MAX_WINDOW - 2, "the window's size") if family else 1
    if kmin + n - 1 > K_MAX:
        raise Malformed(f"a window of symbols {kmin}..{kmin + n - 1}, limit {K_MAX}", offset=at)
    normals, weight = tuple(Normal.read(reader, n) for _ in range(family)), 0
    if family == 2 and (weight := reader.byte("a mixture's weight")) == 0:
        raise Malformed("a mixture with a weight of 0", offset=reader.offset)
    return Prior(Window(kmin, n), normals, weight)


#: Table entries made at a time: enough to save numpy calls, few enough to save memory.
BATCH = 1 << 14


#: A table of so few entries takes Python less time than numpy.
FEW = 16


def make_models(priors: Sequence[Prior]) -> None:
    """Sets `model` of priors, many in one pass. A few narrow ones are left: Python makes them in less time."""
    if len(priors) < 8:
        priors = [prior for prior in priors if prior.window.n > FEW]
    for batch in _batches(priors):
        for prior, model in zip(batch, models_of_each(*normal_tables(batch)), strict=True):
            prior.__dict__["model"] = model  # where cached_property keeps it


def _batches(priors: Sequence[Prior]) -> Iterator[list[Prior]]:
    """Yields the priors in order, in batches whose windows have about BATCH entries together."""
    batch, entries = list[Prior](), 0
    for prior in priors:
        batch.append(prior)
        entries += prior.window.n
        if entries > BATCH:
            yield batch
            batch, entries = [], 0
    if batch:
        yield batch


def normal_tables(priors: Sequence[Prior]) -> tuple[np.ndarray, np.ndarray]:
    """Returns (concatenated tables int64, their sizes int64 [m])."""
    sizes = np.array([prior.window.n for prior in priors], dtype=np.int64)
    cdf = norm_cdf28_of_each(sizes, *_columns([(*prior.normals, _ANY)[0] for prior in priors]))
    if mixtures := [prior for prior in priors if prior.family == 2]:
        mixed = np.array([prior.family == 2 for prior in priors])
        second = norm_cdf28_of_each(sizes[mixed], *_columns([prior.normals[1] for prior in mixtures]))
        weight = np.repeat(np.array([prior.weight for prior in mixtures]), sizes[mixed] + 1)
        inside = np.repeat(mixed, sizes + 1)
        cdf[inside] = ((256 - weight) * cdf[inside] + weight * second) >> 8
    return tables_of_each(cdf, sizes), sizes


def _columns(normals: Sequence[Normal]) -> tuple[np.ndarray, np.ndarray]:
    mu8, si = zip(*((normal.mu8, normal.si) for normal in normals), strict=True)
    return np.array(mu8, dtype=np.int64), np.array(si, dtype=np.int64)


# -- integer frequency tables ------------------------------------------------------------------------------------------

FLOOR = 16  #: least frequency: 16 / 2**24 is the clip of R(a), and keeps outliers from steering a fit

# The two constants of NormTable v1. Computing them in float64 is safe: no entry comes closer than 1e-4 to a rounding
# boundary (a test checks that), while float64 is off by less than 1e-6 whatever the C library.
_T = [round(2**27 * math.erf(min(i, 256) / (32 * math.sqrt(2)))) for i in range(258)]
_M = [round(2.0 ** (31 - j / 64)) for j in range(64)]
NORMAL = np.array(_T)  #: T[i] = round(2**28 (Phi(i / 32) - 1/2)), T[257] = T[256]
OCTAVE = np.array(_M)  #: M[j]


def _mass(t: np.ndarray, si: np.ndarray) -> np.ndarray:
    """Returns a Gaussian's mass up to t / 256 from its mean, in units of 2**-28; si broadcasts against t."""
    e, nb = si >> 6, np.maximum(0, (si >> 6) - 8)
    a = np.minimum(np.abs(t) >> nb, (1 << 21) - 1)
    z = np.minimum((a * OCTAVE[si & 63]) >> (23 + e - nb), 8 << 16)
    i, f = z >> 11, z & 2047
    v = NORMAL[i] + (((NORMAL[i + 1] - NORMAL[i]) * f) >> 11)
    mass: np.ndarray = (1 << 27) + np.where(t < 0, -v, v)
    return mass


def _few_entries(prior: Prior) -> list[int]:
    """The table of one prior of a few entries, as `normal_tables` makes it."""
    n, cum, weights = prior.window.n, [0], (256 - prior.weight, prior.weight)
    for k in range(n - 1):
        mixed = 0
        for normal, weight in zip(prior.normals, weights, strict=False):
            e, t = normal.si >> 6, 256 * k + 128 - normal.mu8
            nb = max(0, e - 8)
            a = min(abs(t) >> nb, (1 << 21) - 1)
            z = min(a * _M[normal.si & 63] >> 23 + e - nb, 8 << 16)
            v = _T[z >> 11] + ((_T[(z >> 11) + 1] - _T[z >> 11]) * (z & 2047) >> 11)
            mixed += weight * ((1 << 27) + (-v if t < 0 else v))
        cum.append(((mixed >> 8) * (TOTAL - n * FLOOR) >> 28) + FLOOR * (k + 1))
    return [*cum, TOTAL]


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
