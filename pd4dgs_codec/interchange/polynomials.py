"""Reads Gaussians whose means are polynomials of time, and whose opacities have windows.

SpacetimeGaussians (Li et al. 2024): a PLY file with cubic polynomials of means and linear ones of quaternions, in the
time since the centre of a bell that multiplies the opacity. The lite model has plain colours. `.splatv` files hold the
same in 64 bytes a Gaussian.

4DGS (Yang et al. 2024): a checkpoint of Gaussians in space and time. An instant shows their conditional distributions,
whose means move along lines, and the bells of the marginal ones multiply the opacities. Cosines of time may multiply
harmonics. 4dgs files have lines, bells and intervals.
"""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pd4dgs_codec.data.files import MAX_HEADER, read_vertices
from pd4dgs_codec.errors import DamageWarning, DataError, one_line
from pd4dgs_codec.interchange.runs import Config, State
from pd4dgs_codec.interchange.splats import activated, finite_rows, principal_axes, quaternions, usable
from pd4dgs_codec.kinds.splats import SH_C0, Splats, unit, visible

#: Beyond so many softnesses of its window a Gaussian is invisible. It stays there, which keeps polynomials small, but
#: lines go on until they are as long as the scene: one basis is enough for them.
REACH = 3.6
SOFTEST, TINY = 1e6, 1e-7  #: largest softness of windows, durations; least softness, and least speed that counts
SPACETIME = b"property float trbf_center"  #: in the header of SpacetimeGaussians' PLY files
SPLATV = b"\x4b\x67\0\0"  #: the first bytes of a .splatv file
#: A row of a .splatv file; `motion` has the factors of three powers, `bell` centre and width.
#: https://github.com/antimatter15/splaTV
SPLATV_ROW = np.dtype([
    ("means", "<f4", 3), ("quats", "<f2", 4), ("scales", "<f2", 3), ("unused", "<f2"), ("rgba", "u1", 4),
    ("motion", "<f2", 9), ("free", "<f2"), ("omega", "<f2", 4), ("bell", "<f2", 2),
])  # fmt: skip
SPLATV_LEAST, FOURD_LEAST = 0.02, 0.05  #: factors of bells up to which renderers of .splatv files and 4DGS draw nothing
#: Places in the tuple of a 4DGS checkpoint, and their number; coefficients of a colour without cosines.
FOURD = {"xyz": 1, "features_dc": 2, "features_rest": 3, "scaling": 4, "rotation": 5, "opacity": 6, "t": 13,
         "scaling_t": 14, "rotation_r": 15}  # fmt: skip
DEGREE, TURNS, SKY, COSINES, FOURD_PARTS, PLAIN = 0, 16, 17, 18, 19, 16
#: Durations of 4DGS's published settings, and how near to one the spread of the centres in time must be.
DURATIONS, ROUNDED = (1.0, 10.0, 50.0), 0.25
MARGIN, OUTSIDE = 0.1, 0.005  #: centres lie so many durations before and after it, but for a share
FOURD_ROWS = 1 << 16  #: covariances at once
SHARP = 1e-3  #: the share of its half width in which an interval ends
FRAMES = 4  #: Gaussians are those of frames if they are so many times those of an instant


@dataclass(frozen=True, eq=False)
class Paths:
    """n Gaussians at normalised times.

    rest: at the centres of their windows. windows: float32 [n, 3] as in clause 13.7. least: factors of windows up to it
    count as 0. reach: float32 [n, 1], the time from its centre after which a Gaussian stays as it is. terms: float32
    [n, 3] each, the factors of the powers 1, 2, .. of the time since the centre. spin: float32 [n, 4], added to
    quaternions per duration. waves: float32 [n, J, 3] each, times the cosines of 1, 2, .. turns since the centre.
    """

    rest: Splats
    windows: np.ndarray
    least: float
    reach: np.ndarray
    terms: list[np.ndarray]
    spin: np.ndarray
    waves: list[np.ndarray]

    @staticmethod
    def of(
        where: str,
        rest: dict[str, np.ndarray],
        window: Sequence[np.ndarray],
        terms: Iterable[np.ndarray],
        *,
        spin: np.ndarray | None = None,
        waves: Iterable[np.ndarray] = (),
        least: float = 0.0,
    ) -> Paths:
        """Returns the rows that are usable at all times, and warns of the others. rest: by the names of Splats.
        window: centre, half width and softness, [n, 1] each. Raises DataError if there is none."""
        terms, waves, spin = list(terms), list(waves), np.zeros_like(rest["quats"]) if spin is None else spin
        (center, half, softness), windows = window, np.concatenate(window, axis=1)
        far = np.maximum(np.abs(center), np.abs(1 - center))  # the longest time since the centre
        bound = sum((np.abs(term) * far**i for i, term in enumerate(terms, 1)), np.abs(rest["means"]))
        columns = [windows, bound, np.abs(rest["quats"]) + np.abs(spin) * far, *waves]
        good = finite_rows({str(i): column for i, column in enumerate(columns)})
        splats, good = usable(where, rest, good & ((half >= 0) & (softness > 0) & (softness <= SOFTEST))[:, 0])
        spin = spin / np.linalg.norm(rest["quats"], axis=1, keepdims=True)
        reach = half + REACH * softness
        if len(terms) == 1:
            length = np.ptp(np.quantile(rest["means"][good], [MARGIN, 1 - MARGIN], axis=0), axis=0).max()
            reach = np.maximum(reach, length / np.maximum(np.abs(terms[0]).max(axis=1, keepdims=True), TINY))
        reach, windows, spin, *rows = (x[good].astype(np.float32) for x in (reach, windows, spin, *terms, *waves))
        return Paths(splats, windows, least, reach, rows[: len(terms)], spin, rows[len(terms) :])

    def splats(self, t: float, *, bare: bool = False) -> Splats:
        """Returns the Gaussians at time t. bare: without their windows, and with harmonics above the constant that are
        means over the windows."""
        center, softness = self.windows[:, :1], self.windows[:, 2:]
        past, found = np.clip(np.float32(t) - center, -self.reach, self.reach), self.rest
        means = found.means + sum(term * past**i for i, term in enumerate(self.terms, 1))
        if self.spin.any():
            quats = unit(found.quats + past * self.spin)
            found = replace(found, quats=np.where(quats.any(axis=1, keepdims=True), quats, found.quats))
        for turns, wave in enumerate(self.waves, 1):
            factors = np.repeat(np.cos(2 * np.pi * turns * past), wave.shape[1], axis=1)
            if bare:
                factors[:, 1:] = np.exp(-0.5 * np.square(2 * np.pi * turns * softness))
            found = replace(found, sh=found.sh + factors[..., None] * wave)
        shown = np.ones(1, np.float32) if bare else visible(self.windows, t)
        return replace(found, means=means, opacities=found.opacities * np.where(shown > self.least, shown, 0))


def read(path: Path, raw: bytes, content: Any, seconds: float | None) -> tuple[Paths, float] | None:
    """Reads a file of this kind as (Paths, duration), None for others. content: its `torch_content`. seconds: the
    duration of a checkpoint, None to find it. Raises DataError."""
    if raw.startswith(SPLATV):
        return _splatv(path, raw), 1.0
    if SPACETIME in raw[:MAX_HEADER]:
        return _spacetime(path, raw), 1.0
    return _fourd(path, content, seconds) if isinstance(content, tuple) else None


def _plain(colors: np.ndarray) -> np.ndarray:
    """Returns the harmonics [n, 1, 3] of colours [n, 3]."""
    return np.asarray((colors[:, None] - np.float32(0.5)) / np.float32(SH_C0))


@np.errstate(all="ignore")
def _spacetime(path: Path, raw: bytes) -> Paths:
    """Reads a PLY file of SpacetimeGaussians' lite model."""
    rows = read_vertices(path, raw)
    names = set(rows.dtype.names or ())
    if names & {"f_t_0", "f_dc_3"}:
        found = "is SpacetimeGaussians' full model, whose colours come from a network"
        todo = "expected the lite model with plain colours: train that, or pd4dgs-train on the images"
        raise DataError(f"{path}: {found}, {todo}")

    def stack(prefix: str, places: Iterable[object]) -> np.ndarray:
        wanted = [f"{prefix}{place}" for place in places]
        if missing := [name for name in wanted if name not in names]:
            raise DataError(f"{path}: has no property {missing[0]}, expected those of SpacetimeGaussians")
        return np.stack([rows[name] for name in wanted], axis=1).astype(np.float32)

    rest = {
        "means": stack("", "xyz"), "quats": stack("rot_", range(4)), "scales": stack("scale_", range(3)),
        "opacities": stack("opacity", [""])[:, 0], "sh": _plain(stack("f_dc_", range(3))),
    }  # fmt: skip
    center, softness = stack("trbf_", ["center"]), np.exp(stack("trbf_", ["scale"])) / np.float32(2**0.5)
    terms, omega = np.split(stack("motion_", range(9)), 3, axis=1), stack("omega_", range(4))
    return Paths.of(str(path), activated(rest), (center, 0 * center, softness), terms, spin=omega)


@np.errstate(all="ignore")
def _splatv(path: Path, raw: bytes) -> Paths:
    """Reads a .splatv file: its signature, the size of a list in JSON, the list, and the parts that it lists."""
    start = 8 + int.from_bytes(raw[4:8], "little")
    try:
        part, size = {}, 0
        for part in json.loads(raw[8:start]):
            start, size = start + size, int(part["size"])
            if part["type"] == "splat" or not 0 <= size <= len(raw):
                break
        if part.get("type") != "splat" or not 0 <= size <= len(raw) - start:
            raise ValueError(f"it lists {size:,} bytes of Gaussians, and {max(len(raw) - start, 0):,} are there")
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise DataError(f"{path}: is a damaged .splatv file ({one_line(str(error), 120)})") from None
    rows = np.frombuffer(raw, SPLATV_ROW, size // SPLATV_ROW.itemsize, start)
    rows = rows[rows["bell"][:, 1] != 0]  # the last rows of the texture are empty
    found = {name: rows[name].astype(np.float32) for name in ("means", "quats", "scales", "motion", "omega", "bell")}
    color = rows["rgba"] / np.float32(255)
    rest = {name: found[name] for name in ("means", "quats", "scales")}
    rest |= {"opacities": color[:, 3], "sh": _plain(color[:, :3])}
    center, width = np.split(found["bell"], 2, axis=1)
    window, terms = (center, 0 * center, np.abs(width) / np.float32(2**0.5)), np.split(found["motion"], 3, axis=1)
    return Paths.of(str(path), rest, window, terms, spin=found["omega"], least=SPLATV_LEAST)


# -- 4DGS --------------------------------------------------------------------------------------------------------------


def last_checkpoint(folder: Path) -> Path | None:
    """Finds the last checkpoint of a run of 4DGS, or its best, None if it has none."""
    found = {path.name: path for path in folder.glob("chkpnt*.pth")}
    numbers = [int(match[1]) for name in found if (match := re.fullmatch(r"chkpnt(\d{1,9})\.pth", name))]
    return found.get(f"chkpnt{max(numbers)}.pth" if numbers else "chkpnt_best.pth")


@np.errstate(all="ignore")
def _fourd(path: Path, content: tuple[Any, ...], seconds: float | None) -> tuple[Paths, float]:
    """Reads what a 4DGS checkpoint holds, as `read` does. It does not say its duration."""
    parts = content[0] if content and isinstance(content[0], tuple) else ()
    if len(parts) != FOURD_PARTS:
        wanted = f"expected {FOURD_PARTS} as of 4DGS, or the PLY file of static Gaussians"
        raise DataError(f"{path}: is a checkpoint of {len(parts)} parts, {wanted}")
    degree, cosines, turns = numbers = tuple(parts[place] for place in (DEGREE, COSINES, TURNS))
    if [type(x) for x in numbers] != [int, int, bool] or degree not in range(4) or cosines not in range(3):
        found = f"degrees and rot_4d {one_line(repr(numbers), 60)}"
        raise DataError(f"{path}: has {found}, expected 0 to 3, 0 to 2, and True or False")
    state = State(path, {name: parts[place] for name, place in FOURD.items()})
    xyz = state.take("xyz", None, 3, finite=False)

    def take(name: str, *shape: int | None) -> np.ndarray:
        return state.take(name, len(xyz), *shape, finite=False)

    sh = np.concatenate([take("features_dc", 1, 3), take("features_rest", None, 3)], axis=1)
    if sh.shape[1] < (count := (degree + 1) ** 2):
        raise DataError(f"{path}: {sh.shape[1]} coefficients per colour, expected {count} for degree {degree}")
    cosines *= count == PLAIN and sh.shape[1] == 3 * PLAIN
    waves = [sh[:, PLAIN * i : PLAIN * (i + 1)] for i in range(1, cosines + 1)]
    if getattr(parts[SKY], "size", 0):
        warnings.warn(DamageWarning(f"{path}: its environment map is left out"), stacklevel=2)
    scales, quats, opacities = take("scaling", 3), take("rotation", 4), take("opacity", 1)[:, 0]
    rest = {"means": xyz, "quats": quats, "scales": scales, "opacities": opacities, "sh": sh[:, :count]}
    # without turns the scale of time is its variance
    rest, variance, speed = activated(rest), np.exp(take("scaling_t", 1)), np.zeros_like(xyz)
    right = take("rotation_r", 4) if turns else speed
    for start in range(0, len(xyz) if turns else 0, FOURD_ROWS):
        block = slice(start, start + FOURD_ROWS)
        made = _conditional(quats[block], right[block], rest["scales"][block], variance[block])
        quats[block], rest["scales"][block], variance[block], speed[block] = made
    variance += np.float32(max(Config.of(path.parent).number("prefilter_var", "-1"), 0.0))
    first, seconds = _span(take("t", 1), seconds)
    center, softness = (take("t", 1) - first) / seconds, np.minimum(np.sqrt(variance) / seconds, SOFTEST)
    window, terms = (center, 0 * center, softness), [speed * seconds]
    return Paths.of(str(path), rest, window, terms, waves=waves, least=FOURD_LEAST), seconds


def _conditional(left: np.ndarray, right: np.ndarray, scales: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, ...]:
    """Returns (quaternions [n, 4], scales [n, 3], variances of time [n, 1], means per time [n, 3]) of Gaussians in
    space and time. left, right: quaternions [n, 4] whose products from both sides turn the axes, of `scales` [n, 3] in
    space and `last` [n, 1] in time."""
    (a, b, c, d), (p, q, r, s) = (unit(x.astype(np.float64)).T for x in (left, right))
    by_left = np.array([[a, -b, -c, -d], [b, a, -d, c], [c, d, a, -b], [d, -c, b, a]]).transpose(2, 0, 1)
    by_right = np.array([[p, q, r, s], [-q, p, -s, r], [-r, s, p, -q], [-s, -r, q, p]]).transpose(2, 0, 1)
    factor = by_left @ by_right * np.concatenate([scales, last], axis=1)[:, None]
    covariance = factor @ factor.transpose(0, 2, 1)
    variance = covariance[:, 3, 3:]
    speed = covariance[:, :3, 3] / variance
    sizes, axes = principal_axes(covariance[:, :3, :3] - speed[:, :, None] * covariance[:, 3:, :3])
    return quaternions(axes), sizes, variance, speed


def _span(centers: np.ndarray, seconds: float | None) -> tuple[float, float]:
    """Returns (first instant, duration) of 4DGS Gaussians with these centres in time. They begin at 0, or half of the
    duration before. seconds: the duration, None for that of a published setting, or of the centres."""
    known = centers[np.isfinite(centers)]
    low, high = np.quantile(known, [OUTSIDE, 1 - OUTSIDE]) if len(known) else (0.0, 1.0)
    if not seconds:
        spread = max(float(high - low) / (1 + 2 * MARGIN), TINY)
        seconds = next((known for known in DURATIONS if abs(spread / known - 1) < ROUNDED), spread)
    return (-seconds / 2 if low < -seconds / 4 else 0.0), seconds


# -- 4dgs files --------------------------------------------------------------------------------------------------------


def read_lines(
    where: str, rest: dict[str, np.ndarray], speed: np.ndarray, bell: np.ndarray, interval: np.ndarray
) -> Paths | None:
    """Returns the Paths of lines in normalised time, None if no windows are equal to theirs, or if they are of frames.
    rest: at the centres of the bells. speed: [n, 3]. bell: [n, 2], centres and deviations, perhaps infinite. interval:
    [n, 2], in which a Gaussian is shown. Raises DataError."""
    center, deviation = bell.T
    low = np.where(interval[:, 0] <= 0, -0.5, interval[:, 0])  # nothing ends at the ends of the duration
    high = np.where(interval[:, 1] >= 1, 1.5, interval[:, 1])
    fades = np.isfinite(deviation)
    ends = np.where(fades, center + np.multiply.outer([-2, 2], deviation), [low, high])
    cut = fades & ((low > 0) & (ends[0] < low) | (high < 1) & (ends[1] > high))
    if cut.any() or not len(center) <= FRAMES * np.ptp(np.clip(ends, 0, 1), axis=0).sum():
        return None
    half, middle = np.where(fades, 0, (high - low) / 2), np.where(fades, center, (high + low) / 2)
    softness = np.where(fades, np.minimum(deviation, SOFTEST), np.maximum(SHARP * half, TINY))
    rest = rest | {"means": rest["means"] + speed * (middle - center)[:, None]}
    return Paths.of(where, rest, [column[:, None] for column in (middle, half, softness)], [speed])
