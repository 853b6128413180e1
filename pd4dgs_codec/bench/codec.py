"""The codec's error against bytes and seconds, for each quantisation step x mode x effort.

The error is that of rendered images against those of the checkpoint. The error of values is at most half a step;
`pd4dgs-info` shows its bounds.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from pd4dgs_codec.bench.report import Panel, markdown, optional, pareto_front
from pd4dgs_codec.bench.timing import Timing, clock, summary
from pd4dgs_codec.format.decoder import decode
from pd4dgs_codec.format.encoder import Report, encode_with_report
from pd4dgs_codec.format.info import hashes, info
from pd4dgs_codec.quality.frames import Frame
from pd4dgs_codec.quality.image import mssim
from pd4dgs_codec.quality.levels import Level, load_levels
from pd4dgs_codec.scene import Scene


@dataclass(frozen=True)
class Sweep:
    """Every step scale with every mode and effort. repeats: runs per time."""

    step_scales: tuple[float, ...] = (0.5, 1.0, 2.0, 4.0)
    modes: tuple[str, ...] = ("ans", "lzma")
    efforts: tuple[int, ...] = (1, 5, 9)
    repeats: int = 5

    def __len__(self) -> int:
        return len(self.step_scales) * len(self.modes) * len(self.efforts)


@dataclass(frozen=True)
class PictureDeviation:
    """Errors of one level's images from those of the checkpoint. rmse: over all pixels of all images, 0..1, not rounded
    to 8 bits; psnr in dB, infinite for equal images; ssim: mean over the images, rounded to 8 bits."""

    level: int
    rmse: float
    psnr: float
    ssim: float


@dataclass(frozen=True)
class Point:
    """One file. layer_bytes: whole chunks, ascending. coded_bits and rate_bits: of attributes, planes and weights (in
    mode lzma also masks), and their sum of R(a). None: unknown for a file without its checkpoint."""

    step_scale: float | None
    mode: str
    effort: int | None
    bytes: int
    layer_bytes: tuple[int, ...]
    coded_bits: int | None
    rate_bits: float | None
    decode: Timing
    encode: Timing | None = None
    pictures: tuple[PictureDeviation, ...] = ()

    @property
    def error(self) -> float | None:
        """RMSE of the images of the highest level."""
        return self.pictures[-1].rmse if self.pictures else None


def sweep(
    model: str, scene: Scene, frames: Sequence[Frame], what: Sweep, step: Callable[[], None] = lambda: None
) -> list[Point]:
    """A point per step scale, mode and effort of the checkpoint `model`, whose scene is `scene`. `step` is called after
    each. Encoding is timed without verification, which takes one decoding more. Raises EncodeError, Pd4Error."""
    reference = {level.level: [level.picture(f.camera, f.time) for f in frames] for level in load_levels(model)}
    encode_with_report(scene, effort=1, verify=False)  # loads the libraries, before any timing
    pictures: dict[str, tuple[PictureDeviation, ...]] = {}
    points = []
    for scale in what.step_scales:
        for mode in what.modes:
            for effort in what.efforts:
                point, data = _point(scene, scale, mode, effort, what.repeats)
                key = json.dumps(hashes(data))  # modes change no value, so that their images are equal
                if key not in pictures:
                    pictures[key] = picture_deviations(load_levels(data), frames, reference)
                points.append(replace(point, pictures=pictures[key]))
                step()
    return points


def _point(scene: Scene, scale: float, mode: str, effort: int, repeats: int) -> tuple[Point, bytes]:
    options: dict[str, Any] = {"mode": mode, "effort": effort, "step_scale": scale, "verify": False}
    (data, report), seconds = clock(lambda: encode_with_report(scene, **options), repeats)
    point = file_point(data, repeats, report)
    return replace(point, encode=summary(seconds), step_scale=scale, effort=effort), data


def file_point(data: bytes, repeats: int, report: Report | None = None) -> Point:
    """The point of a file alone, with the time of decoding. report: that of its encoding, if known."""
    decode(data)  # loads the libraries
    _, seconds = clock(lambda: decode(data), repeats)
    about, layers = info(data), report.layers if report else []
    return Point(
        step_scale=None,
        mode=about["mode"],
        effort=None,
        bytes=len(data),
        layer_bytes=tuple(row["bytes"] for row in about["layers"]),
        coded_bits=sum(layer.payload_bits for layer in layers) if report else None,
        rate_bits=sum(layer.rate_bits for layer in layers) if report else None,
        decode=summary(seconds),
    )


def picture_deviations(
    levels: Sequence[Level], frames: Sequence[Frame], reference: Mapping[int, Sequence[np.ndarray]]
) -> tuple[PictureDeviation, ...]:
    """One per level of the checkpoint, whose images are `reference`. A level whose layer the file leaves out is
    rendered from the level below."""
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

#: Costs by the name in the table: title and axis of the plot, and the cost of a point.
COSTS: dict[str, tuple[str, str, Callable[[Point], float | None]]] = {
    "bytes": ("size", "bytes", lambda p: p.bytes),
    "encode": ("encoding time", "s", lambda p: p.encode.median if p.encode else None),
    "decode": ("decoding time", "s", lambda p: p.decode.median),
}


def _pairs(points: Sequence[Point], cost: Callable[[Point], float | None]) -> list[tuple[float, float]]:
    """(cost, error) of the points that have both."""
    return [(c, p.error) for p in points for c in [cost(p)] if c is not None and p.error is not None]


def fronts(points: Sequence[Point]) -> list[list[str]]:
    """Per point the costs for which it lies on the Pareto front of image errors."""
    best = {name: pareto_front(_pairs(points, cost)) for name, (_, _, cost) in COSTS.items()}
    return [[name for name, (_, _, cost) in COSTS.items() if (cost(p), p.error) in best[name]] for p in points]


def points_table(points: Sequence[Point]) -> str:
    """A row per point: sizes, times, and the error of the images of the highest level."""
    head = ("steps x", "mode", "effort", "bytes", "per layer", "coded / ΣR", "PSNR dB", "SSIM", "encode s", "decode s",
            "on the front of")  # fmt: skip
    rows = []
    for p, on in zip(points, fronts(points), strict=True):
        picture = p.pictures[-1] if p.pictures else None
        coded = optional(p.coded_bits / p.rate_bits if p.rate_bits and p.coded_bits else None, ".4f")
        error = (optional(picture and picture.psnr, ".2f"), optional(picture and picture.ssim, ".5f"))
        seconds = (p.encode.text() if p.encode else "-", p.decode.text())
        sizes = (f"{p.bytes:,}", " + ".join(f"{n:,}" for n in p.layer_bytes))
        what = (optional(p.step_scale, "g"), p.mode, optional(p.effort, "d"))
        rows.append((*what, *sizes, coded, *error, *seconds, ", ".join(on) or "-"))
    return markdown(head, rows)


def panels(points: Sequence[Point]) -> list[Panel]:
    """Image error against bytes, encoding and decoding seconds; a series per mode and effort."""
    kinds = dict.fromkeys((p.mode, p.effort) for p in points)
    own = {kind: [p for p in points if (p.mode, p.effort) == kind] for kind in kinds}
    return [
        Panel(f"error against {title}", axis, [(f"{m}, effort {e}", _pairs(own[m, e], cost)) for m, e in kinds])
        for title, axis, cost in COSTS.values()
    ]


def as_json(points: Sequence[Point]) -> list[dict[str, Any]]:
    """The points as plain dicts, each with its error and `fronts`."""
    return [{**asdict(p), "error": p.error, "fronts": on} for p, on in zip(points, fronts(points), strict=True)]
