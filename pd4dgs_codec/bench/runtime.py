"""Measures error against run time of codec, rasterisers and trainer. Errors are RMSE of images in 0..1, not rounded to
8 bits. A point or run is a dict, as in the report's JSON."""

from __future__ import annotations

import json
import math
import re
import subprocess
import tempfile
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pd4dgs_codec.bench.report import Panel, clock, markdown, optional, quartiles, summary
from pd4dgs_codec.errors import DataError, RenderError
from pd4dgs_codec.format.decoder import decode
from pd4dgs_codec.format.encoder import encode
from pd4dgs_codec.format.info import hashes, info
from pd4dgs_codec.quality.frames import Frame
from pd4dgs_codec.quality.levels import Level, load_levels
from pd4dgs_codec.web.page import player_folder

if TYPE_CHECKING:
    from pd4dgs_codec.model.model import Model

Point = dict[str, Any]
Step = Callable[[], None]
Setting = tuple[float, str, int]  #: step scale, mode, effort


def rmse(found: Iterable[np.ndarray], expected: Iterable[np.ndarray]) -> float:
    """Returns the RMSE over all pixels of images of one size."""
    pairs = zip(found, expected, strict=True)
    return math.sqrt(np.mean([np.square(got.astype(np.float64) - want).mean() for got, want in pairs]))


def _psnr(error: float | None) -> str:
    return "-" if error is None else f"{-20 * math.log10(error):.2f}" if error else "inf"


# -- codec -------------------------------------------------------------------------------------------------------------


def codec_points(
    model: Model, frames: Sequence[Frame], settings: Iterable[Setting], repeats: int, step: Step
) -> list[Point]:
    """Measures a point per setting for a checkpoint's model. error: of the highest level's images from the model's.
    `step` is called after each point. Encoding is timed without verification, which takes one more decoding. Raises
    Pd4Error."""
    from pd4dgs_codec.model.model import to_scene
    from pd4dgs_codec.quality.measure import pictures

    def images(data: bytes) -> list[np.ndarray]:
        (level,) = load_levels(data, last_only=True)
        return [level.picture(frame.camera, frame.time) for frame in frames]

    scene = to_scene(model)
    expected = pictures(model, model.level, [(frame.camera, frame.time) for frame in frames])
    encode(scene, effort=1, verify=False)  # loads the libraries, before any timing
    errors: dict[str, float] = {}
    points = []
    for scale, mode, effort in settings:
        options: dict[str, Any] = {"mode": mode, "effort": effort, "step_scale": scale, "verify": False}
        data, seconds = clock(partial(encode, scene, **options), repeats)
        key = json.dumps(hashes(data))  # all modes code the same values and give the same images
        if key not in errors:
            errors[key] = rmse(images(data), expected)
        given = {"step_scale": scale, "effort": effort, "error": errors[key], "encode": summary(seconds)}
        points.append(file_point(data, repeats) | given)
        step()
    return points


def file_point(data: bytes, repeats: int) -> Point:
    """Measures the point of a file whose error and encoding time are unknown."""
    decode(data)  # loads the libraries
    seconds = clock(lambda: decode(data), repeats)[1]
    unknown = dict.fromkeys(("step_scale", "effort", "error", "encode"))
    return {"mode": info(data)["mode"], "bytes": len(data), "decode": summary(seconds), **unknown}


def codec_table(points: Sequence[Point]) -> str:
    """Formats a row per point."""
    rows = [
        (optional(p["step_scale"], "g"), p["mode"], optional(p["effort"], "d"), f"{p['bytes']:,}")
        + (_psnr(p["error"]), quartiles(p["encode"]), quartiles(p["decode"]))
        for p in points
    ]
    return markdown(("steps x", "mode", "effort", "bytes", "PSNR dB", "encode s", "decode s"), rows)


def codec_panels(points: Sequence[Point]) -> list[Panel]:
    """Returns panels of error against bytes, encoding and decoding seconds, with a series per mode and effort."""
    panels = []
    for label, cost in (("bytes", None), ("encoding, s", "encode"), ("decoding, s", "decode")):
        series: dict[str, list[tuple[float, float]]] = {}
        for p in points:
            x = p[cost]["median"] if cost else p["bytes"]
            series.setdefault(f"{p['mode']}, effort {p['effort']}", []).append((x, p["error"]))
        panels.append(Panel(label, list(series.items())))
    return panels


# -- the player --------------------------------------------------------------------------------------------------------


def player_times(data: bytes, pictures: int) -> dict[str, Any]:
    """Plays a file in Node: `gaussians` of the last picture, and `steps`, milliseconds of CPU by name. Raises DataError
    where there is no Node, or it cannot play the file."""
    script = player_folder() / "render" / "timings.js"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.pd4"
        path.write_bytes(data)
        try:
            run = subprocess.run(["node", script, path, str(pictures)], capture_output=True, text=True, check=False)
        except OSError as error:
            raise DataError(f"node: {error.strerror}, expected Node.js 20 or later") from None
    if run.returncode:
        faults = re.findall(r"^\w*Error: .*", run.stderr, re.MULTILINE) or [f"exit code {run.returncode}"]
        raise DataError(f"node: {faults[0]}")
    found: dict[str, Any] = json.loads(run.stdout)
    return found


def player_table(found: dict[str, Any]) -> str:
    """Formats a row per step."""
    return markdown(("step", "CPU ms"), [(step, f"{ms:.2f}") for step, ms in found["steps"].items()])


# -- rasterisers -------------------------------------------------------------------------------------------------------

ORACLE, KERNELS, GSPLAT = "oracle float64", "kernels", "gsplat"
#: Name -> backend of `rasterization`.
BACKENDS = {ORACLE: "reference", KERNELS: "cpu", GSPLAT: "gsplat"}
#: Arguments of `rasterization` for one view.
View = dict[str, Any]


def view(level: Level, frame: Frame) -> View:
    """Returns the Gaussians that the camera of `frame` sees at its time, with their colours in this view."""
    import torch

    from pd4dgs_codec.draw.gaussians import near_plane
    from pd4dgs_codec.draw.player import Drawer

    model, camera = level.model, frame.camera
    gaussians: Any
    if isinstance(model, Drawer):
        gaussians = model.gaussians(camera, frame.time)
    else:
        with torch.no_grad():
            gaussians = model.gaussians(level.level, frame.time, camera)
    names = ("means", "quats", "scales", "opacities", "colors")
    splats = {name: torch.as_tensor(np.ascontiguousarray(getattr(gaussians, name))) for name in names}
    return {**splats, "camera": camera, "background": level.background, "near_plane": near_plane(model.info)}


def render_points(views: Sequence[View], names: Sequence[str], repeats: int, step: Step = lambda: None) -> list[Point]:
    """Measures a point per name of BACKENDS: milliseconds per image over all images and repeats (the reference renders
    each once) and rmse from the reference, or `missing`, why it cannot run. `step` is called after each point."""
    exact = _rendered(views, ORACLE, 1)
    points: list[Point] = []
    for name in names:
        missing = _without_gsplat() if name == GSPLAT else None
        point: Point = {"name": name, "milliseconds": None, "rmse": None, "missing": missing}
        if not missing:
            images, seconds = exact if name == ORACLE else _rendered(views, name, repeats)
            point |= {"milliseconds": summary([1e3 * s for s in seconds]), "rmse": rmse(images, exact[0])}
        points.append(point)
        step()
    return points


def _rendered(views: Sequence[View], name: str, repeats: int) -> tuple[list[np.ndarray], list[float]]:
    """Returns (image of each view [H, W, 3], seconds of each repetition); a warm-up rendering is not timed."""
    import torch

    from pd4dgs_codec.model.picture import rasterization

    images, seconds = [], []
    for given in views:
        device = "cuda" if name == GSPLAT else "cpu"
        inputs = {key: v.to(device) if isinstance(v, torch.Tensor) else v for key, v in given.items()}

        def render(inputs: View = inputs) -> torch.Tensor:
            with torch.no_grad():
                image = rasterization(**inputs, backend=BACKENDS[name])[0]
            if image.device.type == "cuda":
                torch.cuda.synchronize()
            return image

        if name != ORACLE:
            render()
        image, own = clock(render, repeats)
        images.append(image.cpu().numpy())
        seconds += own
    return images, seconds


def _without_gsplat() -> str | None:
    """Returns why gsplat cannot render here, in one line; None if it can."""
    import torch

    from pd4dgs_codec.model.picture import check_gsplat

    if not torch.cuda.is_available():
        return "found no CUDA device"
    try:
        check_gsplat()
    except RenderError as error:
        return str(error)
    return None


def render_table(points: Sequence[Point]) -> str:
    """Formats a row per rasteriser."""
    rows = [(p["name"], p["missing"] or quartiles(p["milliseconds"]), optional(p["rmse"], ".2g")) for p in points]
    return markdown(("rasteriser", "ms per image", "RMSE"), rows)


def render_panels(points: Sequence[Point]) -> list[Panel]:
    """Returns one panel with a series per rasteriser."""
    drawn = [p for p in points if not p["missing"]]
    return [
        Panel("rasterising, ms per image", [(p["name"], [(p["milliseconds"]["median"], p["rmse"])]) for p in drawn])
    ]


# -- trainer -----------------------------------------------------------------------------------------------------------


def recorded_runs(paths: Sequence[str]) -> list[Point]:
    """Reads the runs that checkpoints record: name (that of the file, or its path where names are equal), anchors and
    curve, the run's evaluations: seconds of wall time so far, psnr per level in dB, rmse of the highest level. Raises
    DataError for a run that was never evaluated, or whose record is broken."""
    from pd4dgs_codec.model import checkpoint
    from pd4dgs_codec.train.loop import read_curve

    paths = list(dict.fromkeys(paths))
    names = [Path(path).name for path in paths]
    runs = list[Point]()
    for path, name in zip(paths, names, strict=True):
        model, training = checkpoint.load(path)
        shown = path if names.count(name) > 1 else name
        try:
            preset = json.loads(training.get("config", "{}")).get("preset", "")
            curve = [
                {"seconds": p["seconds"], "psnr": p["psnr"], "rmse": 10 ** (-p["psnr"][-1] / 20)}
                for p in read_curve(training.get("curve", "[]"))
            ]
        except Exception as error:  # a broken record can raise any exception
            reason = f"{type(error).__name__}: {error}"
            raise DataError(f"{path}: its curve of quality cannot be read: {reason}") from None
        if not curve:
            raise DataError(
                f"{path}: found no curve of quality, expected the checkpoint of a run with at least one evaluation"
            )
        name = f"{shown} ({preset})" if preset else shown
        runs.append({"name": name, "curve": curve, "anchors": len(model.anchor_q)})
    return runs


def train_table(runs: Sequence[Point]) -> str:
    """Formats a row per evaluation of each run."""
    levels = range(max(len(p["psnr"]) for run in runs for p in run["curve"]))
    rows = [
        [run["name"], f"{p['seconds']:.1f}"]
        + [f"{p['psnr'][i]:.2f}" if i < len(p["psnr"]) else "-" for i in levels]
        + [f"{p['rmse']:.4f}"]
        for run in runs
        for p in run["curve"]
    ]
    return markdown(("run", "seconds", *(f"level {i} PSNR dB" for i in levels), "RMSE"), rows)


def train_panels(runs: Sequence[Point]) -> list[Panel]:
    """Returns one panel with a series per run."""
    series = [(run["name"], [(p["seconds"], p["rmse"]) for p in run["curve"]]) for run in runs]
    return [Panel("training wall time, s", series)]
