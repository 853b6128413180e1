"""The registry of priors: parameters <-> bytes, and the integer table of each.

A prior covers a window of symbols kmin .. kmin + n - 1. Symbols outside it are exceptions, listed beside the prior.

A new prior needs a subclass of `_Tabled` with an id, `cum`, `write` and `read`, and its name in `Prior`. `make_models`
only saves time: a family that it does not list makes its tables one by one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, TypeVar, get_args

import numpy as np

from pd4dgs_codec.entropy.ans import Model, model_of, models_of_each
from pd4dgs_codec.entropy.tables import (
    OCTAVE,
    SI_MAX,
    SI_MIN,
    histogram_table,
    histogram_tables_of_each,
    norm_cdf28_of_each,
    tables_of_each,
)
from pd4dgs_codec.entropy.varint import ByteReader, put_varint, put_zigzag
from pd4dgs_codec.errors import Malformed, UnsupportedFeature

K_MAX = (1 << 24) - 1  #: |k| of any symbol
MAX_WINDOW = 1 << 14
#: Most entries of all tables that a section defines, beyond one per symbol: without and with earlier priors. They bound
#: memory: eight bytes can define a table of 2**14 entries, 128 KiB, in each section of each slice.
FREE_ENTRIES, MORE_ENTRIES = 1 << 18, 1 << 10
MU8_MAX = 1 << 31
FLOORS = (1, 16)  #: 16 / 2**24 is the clip of R(a)
HEIGHT_STEPS = (8, 16, 32, 64)  #: units of a histogram's heights, in 1/64 octave

CONST, GAUSS, GMM2, HIST = 0, 1, 2, 3
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

    def write(self, out: bytearray, n: int, extra: int = 0) -> None:
        put_zigzag(out, self.mu8 - 128 * (n - 1))  # from the window's middle: most often two bytes
        put_varint(out, 2 * (self.si - SI_MIN) + extra)

    @classmethod
    def read(cls, reader: ByteReader, n: int) -> tuple[Normal, int]:
        mu8 = reader.zigzag(MU8_MAX, "a Gaussian's mean") + 128 * (n - 1)
        code = reader.varint(2 * (SI_MAX - SI_MIN) + 1, "a Gaussian's width")
        return cls(mu8, (code >> 1) + SI_MIN), code & 1


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

    id: ClassVar[int] = CONST
    window: Window

    def write(self, out: bytearray) -> None:
        put_zigzag(out, self.window.kmin)

    @classmethod
    def read(cls, reader: ByteReader) -> Const:
        return cls(Window(reader.zigzag(K_MAX, "a constant"), 1))


@dataclass(frozen=True, eq=False)
class Gauss(_Tabled):
    """A quantised Gaussian, the model of R(a)."""

    id: ClassVar[int] = GAUSS
    window: Window
    normal: Normal
    floor: int

    def write(self, out: bytearray) -> None:
        self.window.write(out)
        self.normal.write(out, self.window.n, FLOORS.index(self.floor))

    @classmethod
    def read(cls, reader: ByteReader) -> Gauss:
        window = Window.read(reader)
        normal, floor = Normal.read(reader, window.n)
        return cls(window, normal, FLOORS[floor])


@dataclass(frozen=True, eq=False)
class Mixture(_Tabled):
    """Two quantised Gaussians; `weight` 1..255 is the second one's share in 1/256."""

    id: ClassVar[int] = GMM2
    window: Window
    first: Normal
    second: Normal
    weight: int
    floor: int

    def write(self, out: bytearray) -> None:
        self.window.write(out)
        self.first.write(out, self.window.n, FLOORS.index(self.floor))
        self.second.write(out, self.window.n)
        out.append(self.weight)

    @classmethod
    def read(cls, reader: ByteReader) -> Mixture:
        window = Window.read(reader)
        first, floor = Normal.read(reader, window.n)
        second, reserved = Normal.read(reader, window.n)
        weight = reader.byte("a mixture's weight")
        if reserved or weight == 0:
            raise Malformed("a mixture with a reserved bit set or a weight of 0", offset=reader.offset)
        return cls(window, first, second, weight, FLOORS[floor])


@dataclass(frozen=True, eq=False)
class Hist(_Tabled):
    """A histogram: frequencies as heights in units of `step` / 64 octaves, up to `top`; height 0 is an absent symbol.

    The heights (or their differences) are coded in the ANS stream, before all channels, under a Gaussian of their own.
    """

    id: ClassVar[int] = HIST
    window: Window
    step: int
    top: int
    differences: bool
    height_si16: int  #: si = 16 * height_si16 - 160
    height_mean16: int  #: mu8 = 16 * height_mean16; 0 and not stored for differences, whose mean is 0
    heights: np.ndarray | None  #: int [n] in 0..top; None until the stream has given them

    @property
    def height_normal(self) -> tuple[int, Normal]:
        """(number of entries, Gaussian) of the heights' table."""
        n, mu8 = (2 * self.top + 1, 256 * self.top) if self.differences else (self.top + 1, 16 * self.height_mean16)
        return n, Normal(mu8, 16 * self.height_si16 - 160)

    @cached_property
    def height_cum(self) -> np.ndarray:
        return normal_tables([self])[0]

    @cached_property
    def height_model(self) -> Model | None:
        return model_of(self.height_cum)

    @property
    def height_symbols(self) -> np.ndarray:
        """The heights as symbols of height_cum, int64 [n]."""
        heights = np.asarray(self.heights, dtype=np.int64)
        return np.diff(heights, prepend=0) + self.top if self.differences else heights

    @cached_property
    def cum(self) -> np.ndarray:
        heights = np.asarray(self.heights, dtype=np.int64)
        below = (self.top - heights) * self.step
        return histogram_table(np.where(heights > 0, OCTAVE[below & 63] >> (below >> 6), 0))

    def write(self, out: bytearray) -> None:
        self.window.write(out)
        out.append(HEIGHT_STEPS.index(self.step) | 4 * self.differences)
        put_varint(out, self.top)
        out.append(self.height_si16)
        if not self.differences:
            put_varint(out, self.height_mean16)

    @classmethod
    def read(cls, reader: ByteReader) -> Hist:
        window = Window.read(reader)
        mode = reader.bits("a histogram's mode", 3)
        step, differences = HEIGHT_STEPS[mode & 3], bool(mode & 4)
        top = reader.varint(top_limit(step), "a histogram's largest height")
        if top == 0:
            raise Malformed("a histogram without heights", offset=reader.offset)
        si16 = reader.byte("a histogram's spread of heights", 63)
        mean16 = 0 if differences else reader.varint(16 * top, "a histogram's mean height")
        return cls(window, step, top, differences, si16, mean16, None)


Prior = Const | Gauss | Mixture | Hist
AnyPrior = TypeVar("AnyPrior", bound=Prior)
_FAMILIES: dict[int, type[Prior]] = {family.id: family for family in get_args(Prior)}


#: Table entries made at a time: enough to save numpy calls, few enough to save memory.
BATCH = 1 << 14


def make_models(priors: Sequence[Prior]) -> None:
    """Sets `model` of Gaussians and mixtures, and `height_model` of histograms, many in one pass."""
    for batch in _batches([prior for prior in priors if isinstance(prior, Gauss | Mixture | Hist)]):
        for prior, model in zip(batch, models_of_each(*normal_tables(batch)), strict=True):
            # where cached_property keeps it
            prior.__dict__["height_model" if isinstance(prior, Hist) else "model"] = model


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
    """Returns (concatenated tables int64, their sizes int64 [m]); for histograms, the tables of their heights.

    Raises TypeError for a prior of another class, which has to define `cum` itself."""
    rows = list[tuple[int, Normal, int]]()
    for prior in priors:
        if isinstance(prior, Gauss):
            rows.append((prior.window.n, prior.normal, prior.floor))
        elif isinstance(prior, Mixture):
            rows.append((prior.window.n, prior.first, prior.floor))
        elif isinstance(prior, Hist):
            rows.append((*prior.height_normal, 1))
        elif isinstance(prior, Const):
            rows.append((1, Normal(0, 0), 1))
        else:
            raise TypeError(f"{type(prior).__name__}: its table is not one of Gaussians")
    sizes, floors = (np.array([row[i] for row in rows], dtype=np.int64) for i in (0, 2))
    cdf = norm_cdf28_of_each(sizes, *_columns([normal for _, normal, _ in rows]))
    if mixtures := [prior for prior in priors if isinstance(prior, Mixture)]:
        mixed = np.array([isinstance(prior, Mixture) for prior in priors])
        second = norm_cdf28_of_each(sizes[mixed], *_columns([prior.second for prior in mixtures]))
        weight = np.repeat(np.array([prior.weight for prior in mixtures]), sizes[mixed] + 1)
        inside = np.repeat(mixed, sizes + 1)
        cdf[inside] = ((256 - weight) * cdf[inside] + weight * second) >> 8
    return tables_of_each(cdf, sizes, floors), sizes


def with_height_symbols(priors: Sequence[Hist], symbols: Sequence[np.ndarray]) -> list[Hist]:
    """Returns the histograms with `heights` from their symbols under height_cum, int32 [n] each, and with `model` set.

    Raises Malformed for heights out of range."""
    whole = list[Hist]()
    rest = iter(symbols)
    for batch in _batches(priors):
        sizes = np.array([prior.window.n for prior in batch], np.int64)
        tops, steps = (np.array([getattr(p, name) for p in batch], np.int64) for name in ("top", "step"))
        of_each = np.repeat(np.arange(len(batch)), sizes)
        heights = np.concatenate([next(rest) for _ in batch]).astype(np.int64)
        summed = np.array([prior.differences for prior in batch])[of_each]
        running = np.cumsum(np.where(summed, heights - tops[of_each], 0))
        firsts = np.cumsum(sizes) - sizes
        before = np.concatenate([[0], running])[firsts]
        heights = np.where(summed, running - before[of_each], heights)
        low, high = np.minimum.reduceat(heights, firsts), np.maximum.reduceat(heights, firsts)
        wrong = np.flatnonzero((low < 0) | (high > tops) | (high == 0))
        if wrong.size:
            at = wrong[0]
            raise Malformed(f"histogram heights {low[at]}..{high[at]}, expected 0..{tops[at]}, not all 0")
        below = (tops[of_each] - heights) * steps[of_each]
        freqs = np.where(heights > 0, OCTAVE[below & 63] >> (below >> 6), 0)
        models = models_of_each(histogram_tables_of_each(freqs, sizes), sizes)
        for prior, first, model in zip(batch, firsts.tolist(), models, strict=True):
            whole.append(replace(prior, heights=heights[first : first + prior.window.n]))
            whole[-1].__dict__["model"] = model
    return whole


def _columns(normals: Sequence[Normal]) -> tuple[np.ndarray, np.ndarray]:
    mu8, si = zip(*((normal.mu8, normal.si) for normal in normals), strict=True)
    return np.array(mu8, dtype=np.int64), np.array(si, dtype=np.int64)


def top_limit(step: int) -> int:
    """Returns the largest height of a histogram: heights reach 31 octaves below the largest frequency."""
    return 1 + 31 * 64 // step


def read_prior(reader: ByteReader, family: int) -> Prior:
    """Reads a prior of a family. Raises UnsupportedFeature for a family outside the registry."""
    if family not in _FAMILIES:
        raise UnsupportedFeature(f"prior family {family}, expected one of {sorted(_FAMILIES)}", offset=reader.offset)
    return _FAMILIES[family].read(reader)
