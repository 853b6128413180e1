"""The codec's error against bytes and seconds: quantisation step x mode x effort, for a checkpoint; a file's own point.

Error is measured twice: on the values, against those of the checkpoint, and on pictures, against the checkpoint's own.
"""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pd4dgs_codec.bench.report import Panel, markdown, pareto_front
from pd4dgs_codec.bench.timing import Cold, Timing, cold, measure
from pd4dgs_codec.format.decoder import decode
from pd4dgs_codec.format.encoder import Report, encode_with_report
from pd4dgs_codec.format.info import hashes, info
from pd4dgs_codec.format.kinds import LAYER_KINDS
from pd4dgs_codec.format.options import EncodeOptions
from pd4dgs_codec.format.plan import plan
from pd4dgs_codec.format.symbols import float_tensors
from pd4dgs_codec.quality.frames import Frame
from pd4dgs_codec.quality.image import mssim
from pd4dgs_codec.quality.levels import Level, load_levels
from pd4dgs_codec.scene import ATTRIBUTES, MASK_STEP, Scene

#: What an error of 1 is, per field of Steps; what is not here has no unit.
UNITS = {"scaling_log": "ln(scene unit)", "offset": "exp(scaling_log)", "mask": "share of opacity and scale"}


@dataclass(frozen=True)
class Sweep:
    """What to run: every step scale with every mode and effort. repeats: of warm work. cold: fresh processes, at the
    step scale nearest to 1 alone: what they add to warm work does not depend on the step."""

    step_scales: tuple[float, ...] = (0.5, 1.0, 2.0, 4.0)
    modes: tuple[str, ...] = ("ans", "lzma")
    efforts: tuple[int, ...] = (1, 5, 9)
    repeats: int = 5
    cold: int = 1

    def __len__(self) -> int:
        return len(self.step_scales) * len(self.modes) * len(self.efforts)


@dataclass(frozen=True)
class Deviation:
    """Of all tensors that share a step. what: that field of Steps, or mask. In the unit of the values."""

    what: str
    unit: str
    step: float
    largest: float
    rms: float


@dataclass(frozen=True)
class PictureDeviation:
    """One level's pictures against the checkpoint's own. rmse: over all pixels of all pictures, 0..1, not rounded to 8
    bits; psnr in dB, infinite for equal pictures; ssim: mean over the pictures, which are rounded to 8 bits for it."""

    level: int
    rmse: float
    psnr: float
    ssim: float


@dataclass(frozen=True)
class Point:
    """One file. layer_bytes: whole chunks, ascending. coded_bits and rate_bits: attributes, planes, weights (in mode
    lzma the masks too), and the sum of R(a) on them. None: what a file alone cannot tell."""

    step_scale: float | None
    mode: str
    effort: int | None
    bytes: int
    layer_bytes: tuple[int, ...]
    coded_bits: int | None
    rate_bits: float | None
    decode: Timing
    encode: Timing | None = None
    decode_cold: Cold | None = None
    encode_cold: Cold | None = None
    values: tuple[Deviation, ...] = ()
    pictures: tuple[PictureDeviation, ...] = ()

    @property
    def error(self) -> float | None:
        """RMSE of the highest level's pictures."""
        return self.pictures[-1].rmse if self.pictures else None


def sweep(
    model: str, scene: Scene, frames: Sequence[Frame], what: Sweep, step: Callable[[], None] = lambda: None
) -> list[Point]:
    """A point per step scale, mode and effort of the checkpoint `model`, whose scene is `scene`; `step` is called after
    each. Encoding is timed without verification, which costs one decoding more. Raises EncodeError, Pd4Error."""
    reference = {level.level: [level.picture(f.camera, f.time) for f in frames] for level in load_levels(model)}
    encode_with_report(scene, effort=1, verify=False)  # as in file_point
    nearest = min(abs(math.log(scale)) for scale in what.step_scales)
    pictures: dict[str, tuple[PictureDeviation, ...]] = {}
    points = []
    for scale in what.step_scales:
        scaled = replace(scene, steps=scene.steps.scaled(scale))
        fresh = what.cold if abs(math.log(scale)) == nearest else 0
        for mode in what.modes:
            for effort in what.efforts:
                point, data = _point(model, scene, scale, mode, effort, what.repeats, fresh)
                key = json.dumps(hashes(data))  # modes change no value: their pictures are the same
                if key not in pictures:
                    pictures[key] = picture_deviations(load_levels(data), frames, reference)
                planned, _ = plan(scaled, EncodeOptions(effort=effort))  # what no picture reads has other values
                values = tuple(deviations(planned, decode(data)))
                points.append(replace(point, values=values, pictures=pictures[key]))
                step()
    return points


def _point(
    model: str, scene: Scene, scale: float, mode: str, effort: int, repeats: int, fresh: int
) -> tuple[Point, bytes]:
    options: dict[str, Any] = {"mode": mode, "effort": effort, "step_scale": scale, "verify": False}
    (data, report), seconds = measure(lambda: encode_with_report(scene, **options), repeats)
    point = replace(file_point(data, repeats, fresh, report), encode=seconds, step_scale=scale, effort=effort)
    if not fresh:
        return point, data
    flags = ["--mode", mode, "--effort", str(effort), "--step-scale", repr(scale), "--no-verify", "--overwrite"]
    with tempfile.TemporaryDirectory() as folder:
        output = str(Path(folder) / "scene.pd4")
        return replace(point, encode_cold=cold("encode", [model, "-o", output, *flags], fresh)), data


def file_point(data: bytes, repeats: int, fresh: int, report: Report | None = None) -> Point:
    """The point of a file's bytes alone; its decoding is timed, `fresh` times in fresh processes. report: of its
    encoding, if that is known."""
    decode(data)  # the first time pays for loading libraries
    _, seconds = measure(lambda: decode(data), repeats)
    about, own = info(data), None
    if fresh:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "scene.pd4"
            path.write_bytes(data)
            own = cold("decode", [str(path)], fresh)
    return Point(
        step_scale=None,
        mode=about["mode"],
        effort=None,
        bytes=len(data),
        layer_bytes=tuple(row["bytes"] for row in about["layers"]),
        coded_bits=None if report is None else sum(layer.payload_bits for layer in report.layers),
        rate_bits=None if report is None else sum(layer.rate_bits for layer in report.layers),
        decode=seconds,
        decode_cold=own,
    )


def deviations(given: Scene, decoded: Scene) -> list[Deviation]:
    """One per step that the scenes' tensors use, in the order of Steps. given: planned, its steps those of the file."""
    errors: dict[str, list[np.ndarray]] = {}
    for index, layer in enumerate(given.layers):
        kind = LAYER_KINDS[layer]
        before, after = float_tensors(given, index), float_tensors(decoded, index)
        names = ["anchor", *ATTRIBUTES]
        names += [str(kind.planes_step) if x.ndim == 3 else kind.weights_step for x in before[len(names) :]]
        for name, x, y in zip(names, before, after, strict=True):
            errors.setdefault(name, []).append(np.abs(x.astype(np.float64) - y))
    return [_deviation(name, step, errors[name]) for name, step in vars(given.steps).items() if name in errors]


def mask_deviation(masks: Sequence[np.ndarray], codes: Sequence[np.ndarray]) -> Deviation:
    """Masks in 0..1 of each level against those that their codes (uint8, same shapes) stand for."""
    step = np.float64(MASK_STEP)
    errors = [np.abs(m.astype(np.float64) - c * step) for m, c in zip(masks, codes, strict=True)]
    return _deviation("mask", float(step), [np.concatenate(errors)])


def _deviation(what: str, step: float, errors: Sequence[np.ndarray]) -> Deviation:
    square, count = sum(float(np.square(e).sum()) for e in errors), sum(e.size for e in errors)
    largest = max(float(e.max(initial=0.0)) for e in errors)
    return Deviation(what, UNITS.get(what, ""), step, largest, math.sqrt(square / max(count, 1)))


def picture_deviations(
    levels: Sequence[Level], frames: Sequence[Frame], reference: Mapping[int, Sequence[np.ndarray]]
) -> tuple[PictureDeviation, ...]:
    """One per level of the checkpoint, whose pictures are `reference`. A level whose layer the file leaves out looks
    like the level below it, and is held against the checkpoint's own all the same."""
    errors = []
    for number, wanted in reference.items():
        level = [level for level in levels if level.level <= number][-1]
        square, ssim = 0.0, 0.0
        for frame, want in zip(frames, wanted, strict=True):
            got = level.picture(frame.camera, frame.time)
            square += float(np.square(got.astype(np.float64) - want).mean())
            ssim += mssim(got, want)
        rmse = math.sqrt(square / len(frames))
        psnr = math.inf if rmse == 0 else -20 * math.log10(rmse)
        errors.append(PictureDeviation(number, rmse, psnr, ssim / len(frames)))
    return tuple(errors)


# -- as tables and plots -----------------------------------------------------------------------------------------------

#: Cost of a point, by the name that the table gives it: its title and axis in the plots, and the cost itself.
COSTS: dict[str, tuple[str, str, Callable[[Point], float | None]]] = {
    "bytes": ("size", "bytes", lambda p: p.bytes),
    "encode": ("encoding", "s, warm", lambda p: p.encode.median if p.encode else None),
    "decode": ("decoding", "s, warm", lambda p: p.decode.median),
}


def _pairs(points: Sequence[Point], cost: Callable[[Point], float | None]) -> list[tuple[float, float]]:
    """(cost, error) of the points that have both."""
    return [(c, p.error) for p in points for c in [cost(p)] if c is not None and p.error is not None]


def fronts(points: Sequence[Point]) -> list[list[str]]:
    """Per point the costs against which it lies on the Pareto front of picture errors."""
    best = {name: pareto_front(_pairs(points, cost)) for name, (_, _, cost) in COSTS.items()}
    return [[name for name, (_, _, cost) in COSTS.items() if (cost(p), p.error) in best[name]] for p in points]


def points_table(points: Sequence[Point]) -> str:
    """A row per point: sizes, times, and the error of the highest level's pictures."""
    head = ("steps x", "mode", "effort", "bytes", "per layer", "coded / ΣR", "PSNR dB", "SSIM", "encode s", "decode s",
            "cold encode s", "MiB", "cold decode s", "MiB", "on the front of")  # fmt: skip
    rows = []
    for p, on in zip(points, fronts(points), strict=True):
        picture = p.pictures[-1] if p.pictures else None
        layers = " + ".join(f"{n:,}" for n in p.layer_bytes)
        coded = _or_dash(p.coded_bits / p.rate_bits if p.rate_bits and p.coded_bits else None, ".4f")
        error = (_or_dash(picture and picture.psnr, ".2f"), _or_dash(picture and picture.ssim, ".5f"))
        seconds = (p.encode.text() if p.encode else "-", p.decode.text())
        fresh = (*_cold_cells(p.encode_cold), *_cold_cells(p.decode_cold))
        what = (_or_dash(p.step_scale, "g"), p.mode, _or_dash(p.effort, "d"), f"{p.bytes:,}", layers, coded)
        rows.append((*what, *error, *seconds, *fresh, ", ".join(on) or "-"))
    return markdown(head, rows)


def values_table(points: Sequence[Point], masks: Deviation | None = None) -> str:
    """A row per step scale and tensor group: the largest error and the root of the mean square."""
    head = ("steps x", "what", "unit", "step Q", "largest error", "RMS error", "largest / Q")
    by_scale = {p.step_scale: p.values for p in reversed(points) if p.values}
    rows = [(f"{scale:g}", v) for scale, values in reversed(by_scale.items()) for v in values]
    rows += [("any", masks)] if masks else []
    cells = []
    for scale, v in rows:
        errors = (f"{v.largest:.3g}", f"{v.rms:.3g}", f"{v.largest / v.step:.3f}")
        cells.append((scale, v.what, v.unit or "1", f"{v.step:.4g}", *errors))
    return markdown(head, cells)


def panels(points: Sequence[Point]) -> list[Panel]:
    """Picture error against bytes, encoding and decoding seconds; a series per mode and effort."""
    kinds = dict.fromkeys((p.mode, p.effort) for p in points)
    own = {kind: [p for p in points if (p.mode, p.effort) == kind] for kind in kinds}
    return [
        Panel(f"error against {title}", axis, [(f"{m}, effort {e}", _pairs(own[m, e], cost)) for m, e in kinds])
        for title, axis, cost in COSTS.values()
    ]


def as_json(points: Sequence[Point]) -> list[dict[str, Any]]:
    """The points as plain dicts, each with the costs on whose front it lies."""
    return [{**asdict(p), "error": p.error, "fronts": on} for p, on in zip(points, fronts(points), strict=True)]


def _cold_cells(fresh: Cold | None) -> tuple[str, str]:
    return ("-", "-") if fresh is None else (fresh.seconds.text(), f"{fresh.peak_bytes / 2**20:.0f}")


def _or_dash(value: Any, form: str) -> str:
    return "-" if value is None else format(value, form)
