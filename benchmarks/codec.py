"""The codec: error against run time, speed, other coders, exported files and batches."""

from __future__ import annotations

import json
import lzma
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from common import ONE, TWO, Benchmark, Row, Run, Scene, command, number, package, table

from pd4dgs_codec.errors import DataError

# -- error against run time --------------------------------------------------------------------------------------------


def measure_error(run: Run, scene: Scene) -> list[Row]:
    """The points of `pd4dgs-bench codec` and `render`; training is in `quality` over time."""
    model, _ = run.trained(scene)
    run.images.mkdir(parents=True, exist_ok=True)
    plots = [run.images / f"error-{kind}-{scene.name}.png" for kind in ("codec", "render")]
    few = ("--quick",) if run.quick else ("--efforts", "1,5", "--repeats", 3)
    found = command("bench", "codec", model, *scene.data, *few, "--plot", plots[0], "-f")
    rows = [{"what": "codec"} | point for point in found["points"]]
    few = ("--only", "kernels", "--views", 1) if run.quick else ()
    found = command("bench", "render", run.packed(scene), *scene.data, *few, "--plot", plots[1], "-f")
    rows += [{"what": "render"} | point for point in found["points"]]
    keys = ("what", "name", "step_scale", "mode", "effort", "bytes", "error", "rmse", "missing")
    times = ("encode", "decode", "milliseconds")
    return [
        {"scene": scene.name}
        | {key: row[key] for key in keys if key in row}
        | {key: row[key]["median"] for key in times if row.get(key)}
        for row in rows
    ]


def error_text(rows: Sequence[Row]) -> str:
    """Both tables."""
    codec = [
        (r["scene"], f"{r['step_scale']:g}", r["mode"], r["effort"], number(r["bytes"], 0), decibels(r["error"]))
        + (number(r["encode"]), number(1e3 * r["decode"], 0))
        for r in rows
        if r["what"] == "codec"
    ]
    render = [
        (r["scene"], r["name"], number(r["milliseconds"]), f"{r['rmse']:.1e}")
        for r in rows
        if r["what"] == "render" and not r.get("missing")
    ]
    return (
        "`pd4dgs-bench codec`: PSNR against pictures of the checkpoint, whose tensors are multiples of the steps at "
        "scale 1.\n\n"
        f"{table(('scene', 'steps x', 'mode', 'effort', 'bytes', 'PSNR dB', 'encode s', 'decode ms'), codec)}\n\n"
        "`pd4dgs-bench render`: the same Gaussians against a float64 reference; times are of rasterising alone.\n\n"
        f"{table(('scene', 'rasteriser', 'ms', 'RMSE'), render)}"
    )


def decibels(rmse: float | None) -> str:
    """PSNR of an RMSE in 0..1; a dash where it is not known, "inf" for 0."""
    return "-" if rmse is None else f"{-20 * np.log10(rmse):.2f}" if rmse else "inf"


def error_pictures(rows: Sequence[Row], folder: Path) -> list[str]:
    """The plots that the reports drew."""
    scenes = dict.fromkeys(row["scene"] for row in rows)
    return [f"error-{kind}-{scene}.png" for scene in scenes for kind in ("codec", "render")]


# -- speed -------------------------------------------------------------------------------------------------------------


def measure_speed(run: Run, scene: Scene) -> list[Row]:
    """One row: medians of wall time, seconds. Steps are those of the training: one thread beside another training."""
    model, _ = run.trained(scene)
    file, count = run.packed(scene), 1 if run.quick else 5
    still = file.with_name("still.png")

    def cold(*words: str) -> float:
        start = time.perf_counter()
        subprocess.run([sys.executable, "-m", "pd4dgs_codec", *words], check=True, capture_output=True)
        return time.perf_counter() - start

    drawn = command("render", file, "-o", file.with_name("frame-%03d.png"), "-f", "--frames", 4 * count)
    row = {
        "scene": scene.name,
        "anchors": command("info", file)["anchors"],
        "encode": median(command("encode", model, "-o", file, "-f")["seconds"] for _ in range(count)),
        "decode": median(command("decode", file)["seconds"] for _ in range(count)),
        "picture": drawn["render_ms"] / 1e3,
        "decode_command": median(cold("decode", str(file)) for _ in range(count)),
        "render_command": median(
            cold("render", str(file), "-o", str(still), "--frames", "1", "-f") for _ in range(count)
        ),
    }
    return [row | {"steps": step_seconds(model.with_suffix(".jsonl"))}]


def step_seconds(log: Path) -> list[float]:
    """Median seconds of a training step at each level, over the second half of a run."""
    records = [json.loads(line) for line in log.read_text().splitlines()]
    spent: dict[int, list[float]] = {}
    for before, record in zip(records[len(records) // 2 :], records[len(records) // 2 + 1 :], strict=False):
        spent.setdefault(record["level"], []).append(record["seconds"] - before["seconds"])
    return [median(spent[level]) for level in sorted(spent)]


def speed_text(rows: Sequence[Row]) -> str:
    """A row per scene."""
    cells = [
        (r["scene"], number(r["anchors"], 0), number(r["encode"]), number(1e3 * r["decode"], 0))
        + (number(1e3 * r["picture"], 1), number(r["decode_command"]), number(r["render_command"]))
        + (" / ".join(number(1e3 * s, 0) for s in r["steps"]),)
        for r in rows
    ]
    commands = ("`pd4dgs-decode` s", "`pd4dgs-render` s")
    head = ("scene", "anchors", "encode s", "decode ms", "picture ms", *commands, "step ms")
    return (
        "Medians of wall time on all threads. Encoding includes verification. Commands run in new processes; "
        "`pd4dgs-render` draws one picture. *step*: a training step at levels 0 / 1 (/ 2) on one thread, beside "
        "another training.\n\n" + table(head, cells)
    )


# -- other coders ------------------------------------------------------------------------------------------------------

#: Bytes per channel that a Gaussian coder must store: mean, deviation, least and largest symbol.
GAUSS_PARAMETERS = 16


def measure_coders(run: Run, scene: Scene) -> list[Row]:
    """A row per part of the file: its bytes, and those of other lossless coders of the same integers."""
    file = run.packed(scene)
    arrays = file.with_name("symbols.npz")
    command("decode", file, "--symbols", "-o", arrays, "-f")
    own = {part["part"]: part["bytes"] for part in command("info", file, "--bytes")["parts"]}
    with np.load(arrays) as stored:
        values = {name[:-2]: stored[name] for name in stored if name.endswith("_q")}
    rows = []
    for part, found in grouped(values).items():
        row = {"scene": scene.name, "part": part, "symbols": sum(c.size for c in found), "ours": own[part]}
        if part == "positions":
            rows.append(row | {"draco": draco_bytes(values["anchor"]), "lzma": lzma_bytes(found)})
        else:
            rows.append(row | {"gauss": gauss_bytes(found), "lzma": lzma_bytes(found)})
    return rows


def grouped(values: dict[str, np.ndarray]) -> dict[str, list[np.ndarray]]:
    """Part of the file -> its channels, each int32 [N]: columns of attributes, channels of planes, whole weights."""
    parts: dict[str, list[np.ndarray]] = {"positions": [], "masks": [], "attributes": [], "planes": [], "weights": []}
    for name, value in values.items():
        if name == "anchor" or name in ("feature", "scaling_log", "offset"):
            columns = np.ascontiguousarray(value.reshape(len(value), -1).T)
            parts["positions" if name == "anchor" else "attributes"] += list(columns)
        elif name.startswith("planes."):
            parts["planes"] += [channel.ravel() for channel in value]
        else:
            parts["masks" if name.startswith("mask") else "weights"].append(value.ravel())
    return {part: [c for c in channels if c.size] for part, channels in parts.items() if any(c.size for c in channels)}


def gauss_bytes(channels: Sequence[np.ndarray]) -> int:
    """Of constriction's QuantizedGaussian, one per channel. Raises DataError if a channel is decoded differently."""
    from constriction import stream

    size = GAUSS_PARAMETERS * len(channels)
    for channel in channels:
        if channel.min() == channel.max():
            continue
        low, high = int(channel.min()), int(channel.max())
        model = stream.model.QuantizedGaussian(low, high, float(channel.mean()), max(float(channel.std()), 2.0**-10))
        coder = stream.stack.AnsCoder()
        coder.encode_reverse(np.ascontiguousarray(channel, np.int32), model)
        words = coder.get_compressed()
        size += words.nbytes
        if not np.array_equal(stream.stack.AnsCoder(words).decode(model, channel.size), channel):
            raise DataError("constriction decoded a channel to different symbols")
    return size


def lzma_bytes(channels: Sequence[np.ndarray]) -> int:
    """Of LZMA at its highest preset on the narrowest integers, channel by channel."""
    top = [max(int(channel.max()), -int(channel.min()) - 1) for channel in channels]
    kinds = ["<i1" if t < 1 << 7 else "<i2" if t < 1 << 15 else "<i4" for t in top]
    data = b"".join(channel.astype(kind).tobytes() for channel, kind in zip(channels, kinds, strict=True))
    return len(lzma.compress(data, preset=9 | lzma.PRESET_EXTREME))


def draco_bytes(cells: np.ndarray) -> int:
    """Of Draco's kd-tree coder at its highest level on distinct cells int32 [N, 3], in an order of its own."""
    import DracoPy

    offsets = cells - cells.min(axis=0)
    bits = max(1, int(offsets.max()).bit_length())
    data = DracoPy.encode(
        offsets.astype(np.float32),
        quantization_bits=bits,
        compression_level=10,
        quantization_range=float((1 << bits) - 1),
        quantization_origin=[0.0, 0.0, 0.0],
        preserve_order=False,
    )
    return len(data)


def coders_text(rows: Sequence[Row]) -> str:
    """A row per scene and part."""
    cells = [
        (r["scene"], r["part"], number(r["symbols"], 0), number(r["ours"], 0))
        + tuple(number(r.get(key), 0) for key in ("gauss", "lzma", "draco"))
        for r in rows
    ]
    head = ("scene", "part", "symbols", "ours", "Gaussian per channel", "LZMA", "Draco")
    return (
        "Bytes of the same integers in other lossless coders: constriction's QuantizedGaussian with "
        f"{GAUSS_PARAMETERS} bytes of parameters per channel, LZMA (preset 9, extreme) on the narrowest integers, "
        f"Draco's kd-tree for positions.\n\n{table(head, cells)}"
    )


# -- exported files ----------------------------------------------------------------------------------------------------

KINDS = {"ply": (), "spz": (), "glb": (), "4dgs": ("--fps", "2")}


def measure_export(run: Run, scene: Scene) -> list[Row]:
    """A row per kind of file, of one instant or of two frames a second."""
    file = run.packed(scene)
    rows: list[Row] = [{"scene": scene.name, "kind": "pd4, all instants and views", "bytes": file.stat().st_size}]
    for kind, options in list(KINDS.items())[: 1 if run.quick else None]:
        output = file.with_name(f"exported.{kind}")
        compare = ("--compare", scene.source) if kind == "ply" else ()
        found = command("export", file, "-o", output, "--to", kind, *options, *scene.data, *compare, "-f")
        keys = ("frames", "gaussians", "bytes", "seconds", "cost")
        rows.append({"scene": scene.name, "kind": kind} | {key: found[key] for key in keys if key in found})
    return rows


def export_text(rows: Sequence[Row]) -> str:
    """A row per scene and kind."""
    cells = []
    for row in rows:
        cost = row.get("cost")
        told = f"{cost['direct_mpsnr']:.2f} -> {cost['exported_mpsnr']:.2f}" if cost else "-"
        numbers = (number(row.get(key), 0) for key in ("frames", "gaussians", "bytes", "seconds"))
        cells.append((row["scene"], row["kind"], *numbers, told))
    head = ("scene", "file", "frames", "Gaussians", "bytes", "s", "held-out mPSNR dB")
    return (
        "`pd4dgs-export` with spherical harmonics of degree 3, seen by the training cameras. The last column "
        f"compares the scene with exports at the instants of the held-out views.\n\n{table(head, cells)}"
    )


# -- batches -----------------------------------------------------------------------------------------------------------


def measure_batch(run: Run, scene: Scene) -> list[Row]:
    """A row per number of workers: one model, encoded many times over."""
    model, _ = run.trained(scene)
    count, rows = 4 if run.quick else 12, []
    for workers in (0, 2):
        with tempfile.TemporaryDirectory() as name:
            manifest = Path(name) / "manifest.jsonl"
            lines = [{"source": str(model.resolve()), "output": f"{i}.pd4"} for i in range(count)]
            manifest.write_text("".join(json.dumps(line) + "\n" for line in lines))
            found: Any = command("batch", manifest, "--op", "encode", "-o", Path(name) / "out", "--workers", workers)
        keys = ("done", "retried", "seconds", "cpu_seconds", "work_cpu_seconds")
        rows.append({"scene": scene.name, "workers": workers} | {key: found[key] for key in keys})
    return rows


def batch_text(rows: Sequence[Row]) -> str:
    """A sentence."""
    told = []
    for row in rows:
        rate, beside = (60 * row["done"] / row["seconds"], row["cpu_seconds"] - row["work_cpu_seconds"])
        workers = f"{row['workers'] or 'no'} workers"
        told.append(
            f"{rate:,.0f} scenes per minute with {workers} (overhead {beside / row['done']:.3f} CPU seconds per scene)"
        )
    what = f"`pd4dgs-batch --op encode` of {rows[0]['scene']}, {rows[0]['done']} times, on one machine"
    return f"{what}: {'; '.join(told)}."


ERROR = Benchmark("error-time", "Error against run time", ONE, measure_error, error_text, error_pictures)
SPEED = Benchmark("speed", "Speed", TWO, measure_speed, speed_text)
CODERS = Benchmark("rivals", "Other coders", TWO, measure_coders, coders_text)
EXPORT = Benchmark("export", "Exported files", ("orbit",), measure_export, export_text, measured=package("export"))
BATCH = Benchmark("batch", "Batches", ONE, measure_batch, batch_text, measured=package("batch"))
