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

from pd4dgs_codec.attributes.table import ATTRIBUTES
from pd4dgs_codec.bench.markdown import markdown
from pd4dgs_codec.bench.plot import Panel, Series, pareto_front
from pd4dgs_codec.bench.timing import Cold, Timing, cold, measure
from pd4dgs_codec.codec.decoder import decode
from pd4dgs_codec.codec.encoder import Report, encode_with_report
from pd4dgs_codec.codec.info import hashes, info
from pd4dgs_codec.codec.kinds import LAYER_KINDS
from pd4dgs_codec.codec.plan import plan
from pd4dgs_codec.codec.symbols import float_tensors
from pd4dgs_codec.metrics.image import mssim
from pd4dgs_codec.scene import MASK_STEP, PLANES, Scene
from pd4dgs_codec.view.frames import Frame
from pd4dgs_codec.view.levels import Level, load_levels

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
    pictures: dict[str, tuple[PictureDeviation, ...]] = {}
    points = []
    for scale in what.step_scales:
        planned, _ = plan(replace(scene, steps=scene.steps.scaled(scale)))
        for mode in what.modes:
            for effort in what.efforts:
                options: dict[str, Any] = {"mode": mode, "effort": effort, "step_scale": scale}
                point, data = _point(model, scene, options, what)
                key = json.dumps(hashes(data))  # modes and efforts change no value: their pictures are the same
                if key not in pictures:
                    pictures[key] = picture_deviations(load_levels(data), frames, reference)
                values = tuple(deviations(planned, decode(data)))
                points.append(replace(point, values=values, pictures=pictures[key]))
                step()
    return points


def _point(model: str, scene: Scene, options: dict[str, Any], what: Sweep) -> tuple[Point, bytes]:
    (data, report), seconds = measure(lambda: encode_with_report(scene, verify=False, **options), what.repeats)
    scale = options["step_scale"]
    fresh = what.cold if abs(math.log(scale)) == min(abs(math.log(s)) for s in what.step_scales) else 0
    point = file_point(data, what.repeats, fresh, report)
    point = replace(point, encode=seconds, step_scale=scale, effort=options["effort"])
    if not fresh:
        return point, data
    with tempfile.TemporaryDirectory() as folder:
        output = str(Path(folder) / "scene.pd4")
        flags = ["--mode", options["mode"], "--effort", str(options["effort"])]
        flags += ["--step-scale", repr(scale), "--no-verify", "--overwrite"]
        return replace(point, encode_cold=cold("encode", [model, "-o", output, *flags], fresh)), data


def file_point(data: bytes, repeats: int, cold_repeats: int, report: Report | None = None) -> Point:
    """The point of a file's bytes alone; its decoding is timed. report: of its encoding, if that is known."""
    decode(data)  # the first time pays for loading libraries
    _, seconds = measure(lambda: decode(data), repeats)
    about, fresh = info(data), None
    if cold_repeats:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "scene.pd4"
            path.write_bytes(data)
            fresh = cold("decode", [str(path)], cold_repeats)
    return Point(
        step_scale=None,
        mode=about["mode"],
        effort=None,
        bytes=len(data),
        layer_bytes=tuple(row["bytes"] for row in about["layers"]),
        coded_bits=None if report is None else sum(layer.payload_bits for layer in report.layers),
        rate_bits=None if report is None else sum(layer.rate_bits for layer in report.layers),
        decode=seconds,
        decode_cold=fresh,
    )


def deviations(given: Scene, decoded: Scene) -> list[Deviation]:
    """One per step that the scenes' tensors use, in the order of Steps. given: planned, its steps those of the file."""
    squares: dict[str, list[float]] = {}
    for index, layer in enumerate(given.layers):
        kind = LAYER_KINDS[layer]
        before, after = float_tensors(given, index), float_tensors(decoded, index)
        names = ["anchor", *(a.name for a in ATTRIBUTES)]
        names += [str(kind.planes_step)] * (len(PLANES) * len(given.tensors(layer).planes))
        names += [kind.weights_step] * (len(before) - len(names))
        for name, x, y in zip(names, before, after, strict=True):
            error = np.abs(x.astype(np.float64) - y)
            largest, total, count = squares.setdefault(name, [0.0, 0.0, 0])
            squares[name] = [max(largest, float(error.max(initial=0.0))), total + float((error**2).sum()),
                             count + error.size]  # fmt: skip
    steps = vars(given.steps)
    return [
        Deviation(name, UNITS.get(name, ""), steps[name], largest, math.sqrt(total / max(count, 1)))
        for name in steps
        if name in squares
        for largest, total, count in [squares[name]]
    ]


def mask_deviation(masks: Sequence[np.ndarray], codes: Sequence[np.ndarray]) -> Deviation:
    """Masks in 0..1 of each level against those that their codes (uint8, same shapes) stand for."""
    errors = np.concatenate(
        [np.abs(m.astype(np.float64) - c * np.float64(MASK_STEP)) for m, c in zip(masks, codes, strict=True)]
    )
    rms = math.sqrt(float((errors**2).mean())) if errors.size else 0.0
    return Deviation("mask", UNITS["mask"], float(MASK_STEP), float(errors.max(initial=0.0)), rms)


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


def usual(points: Sequence[Point]) -> Point:
    """The point nearest to what pd4dgs-encode writes: the step scale nearest to 1, mode ans, the highest effort."""
    return min(points, key=lambda p: (abs(math.log(p.step_scale or 1.0)), p.mode != "ans", -(p.effort or 0)))


# -- as tables and plots -----------------------------------------------------------------------------------------------

#: Cost of a point, by the name that the table and the plots give it.
COSTS: dict[str, Callable[[Point], float | None]] = {
    "bytes": lambda p: p.bytes,
    "encode": lambda p: p.encode.median if p.encode else None,
    "decode": lambda p: p.decode.median,
}


def fronts(points: Sequence[Point]) -> list[list[str]]:
    """Per point the costs against which it lies on the Pareto front of picture errors."""
    on: list[list[str]] = [[] for _ in points]
    for name, cost in COSTS.items():
        pairs = [(cost(p), p.error) for p in points]
        front = pareto_front([(c, e) for c, e in pairs if c is not None and e is not None])
        for row, pair in zip(on, pairs, strict=True):
            if pair in front:
                row.append(name)
    return on


def points_table(points: Sequence[Point]) -> str:
    """A row per point: sizes, times, and the error of the highest level's pictures."""
    head = ("steps x", "mode", "effort", "bytes", "per layer", "coded / ΣR", "PSNR dB", "SSIM", "encode s", "decode s",
            "cold encode s", "MiB", "cold decode s", "MiB", "on the front of")  # fmt: skip
    rows = []
    for p, on in zip(points, fronts(points), strict=True):
        picture = p.pictures[-1] if p.pictures else None
        rows.append(
            (
                _or_dash(p.step_scale, "g"), p.mode, _or_dash(p.effort, "d"), f"{p.bytes:,}",
                " + ".join(f"{n:,}" for n in p.layer_bytes),
                _or_dash(p.coded_bits / p.rate_bits if p.rate_bits and p.coded_bits else None, ".4f"),
                _or_dash(picture and picture.psnr, ".2f"), _or_dash(picture and picture.ssim, ".5f"),
                p.encode.text() if p.encode else "-", p.decode.text(),
                *_cold_cells(p.encode_cold), *_cold_cells(p.decode_cold),
                ", ".join(on) or "-",
            )
        )  # fmt: skip
    return markdown(head, rows)


def values_table(points: Sequence[Point], masks: Deviation | None = None) -> str:
    """A row per step scale and tensor group: the largest error and the root of the mean square."""
    head = ("steps x", "what", "unit", "step Q", "largest error", "RMS error", "largest / Q")
    rows, seen = [], set()
    for point in points:
        if point.values and point.step_scale not in seen:
            seen.add(point.step_scale)
            rows += [(f"{point.step_scale:g}", *_value_cells(v)) for v in point.values]
    if masks:
        rows.append(("any", *_value_cells(masks)))
    return markdown(head, rows)


def panels(points: Sequence[Point]) -> list[Panel]:
    """Picture error against bytes, encoding and decoding seconds; a series per mode and effort."""
    labels = {"bytes": ("size", "bytes"), "encode": ("encoding", "s, warm"), "decode": ("decoding", "s, warm")}
    return [
        Panel(f"error against {labels[name][0]}", labels[name][1], tuple(_series(points, cost)))
        for name, cost in COSTS.items()
    ]


def _series(points: Sequence[Point], cost: Callable[[Point], float | None]) -> list[Series]:
    names = list(dict.fromkeys((p.mode, p.effort) for p in points))
    found = []
    for mode, effort in names:
        own = [(cost(p), p.error) for p in points if (p.mode, p.effort) == (mode, effort)]
        pairs = tuple((c, e) for c, e in own if c is not None and e is not None)
        found.append(Series(f"{mode}, effort {effort}", pairs))
    return found


def as_json(points: Sequence[Point]) -> list[dict[str, Any]]:
    """The points as plain dicts, each with the costs on whose front it lies."""
    return [{**asdict(p), "error": p.error, "fronts": on} for p, on in zip(points, fronts(points), strict=True)]


def _value_cells(v: Deviation) -> tuple[str, ...]:
    return v.what, v.unit or "1", f"{v.step:.4g}", f"{v.largest:.3g}", f"{v.rms:.3g}", f"{v.largest / v.step:.3f}"


def _cold_cells(fresh: Cold | None) -> tuple[str, str]:
    return ("-", "-") if fresh is None else (fresh.seconds.text(), f"{fresh.peak_bytes / 2**20:.0f}")


def _or_dash(value: Any, form: str) -> str:
    return "-" if value is None else format(value, form)
