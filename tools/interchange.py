"""What exported files cost: dB, bytes, seconds, memory, and what independent readers find. Writes docs/interchange.md.

    python tools/interchange.py [--only NAME ...] [--out out] [--docs docs] [--render]

Reads the files that tools/results.py left in --out/NAME/scene.pd4. Needs the extra `interchange`, plyfile
and pygltflib.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pages.page import Page, Row, make, options, paragraph, say, unpadded
from pages.scenes import SCENES, present

from pd4dgs_codec.bench.report import markdown
from pd4dgs_codec.interchange.splats import Splats
from pd4dgs_codec.threads import configure

NAMES = ("shelf-hand", "bouncing-balls")
FRAMES = 5  #: of a sequence
VIEWS = 2  #: held-out views that the cost is measured on
STEPS = 300  #: of refinement
#: (eyes, degree, steps) of the rows on what exporting costs.
VARIANTS = (("data", 3, 0), ("data", 0, STEPS), ("data", 3, STEPS), ("file", 3, STEPS))


def measure(name: str, out: Path) -> Row:
    """The rows of one scene."""
    from pd4dgs_codec.draw.player import Player
    from pd4dgs_codec.format.decoder import decode
    from pd4dgs_codec.interchange.export import Export, cost, eyes_of_cameras, eyes_of_scene

    path, dataset = out / name / "scene.pd4", SCENES[name].load()
    player = Player(decode(path.read_bytes()))
    views = dataset.test[:: max(1, len(dataset.test) // VIEWS)][:VIEWS]
    eyes = {"data": eyes_of_cameras([view.camera for view in dataset.train]), "file": eyes_of_scene(player)}
    costs = []
    for which, degree, steps in VARIANTS:
        say(f"{name}: harmonics of degree {degree}, {steps} steps, eyes of the {which}")
        start = time.perf_counter()
        report = cost(Export(player, eyes[which], degree, steps), views)
        seconds = (time.perf_counter() - start) / len(views)
        costs.append({"eyes": which, "degree": degree, "steps": steps, "seconds": seconds} | vars(report))
    info = player.info
    fps = (FRAMES - 1) / (info.time_range[1] - info.time_range[0])
    source, middle = SCENES[name], views[len(views) // 2]
    files = []
    with tempfile.TemporaryDirectory() as folder:
        for kind, (reader, read) in READERS.items():
            say(f"{name}: {kind}")
            target = Path(folder) / f"{name}.{kind}"
            still = ["--time", repr(middle.time)] if kind not in ("ply-seq", "4dgs") else ["--fps", repr(fps)]
            command = ["export", path, "-o", target, "--to", kind, "--data", source.source, *still]
            command += ["--downscale", source.downscale, "--refine", STEPS, "--json"]
            result = _run([str(part) for part in command])
            files.append({"kind": kind, "reader": reader, "psnr": read(target, player, middle)} | result)
    return {"file_bytes": path.stat().st_size, "views": len(views), "frames": FRAMES, "costs": costs, "files": files}


def _run(command: list[str]) -> Row:
    """Frames, Gaussians, bytes, seconds and peak memory of one command."""
    start = time.perf_counter()
    process = subprocess.Popen([sys.executable, "-m", "pd4dgs_codec", *command], stdout=subprocess.PIPE)
    assert process.stdout is not None
    text = process.stdout.read()
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        sys.exit(f"pd4dgs-{command[0]} failed")
    told = json.loads(text)
    seconds, megabytes = time.perf_counter() - start, usage.ru_maxrss / 1024
    return {key: told[key] for key in ("frames", "gaussians", "bytes")} | {"seconds": seconds, "megabytes": megabytes}


# -- readers of others -------------------------------------------------------------------------------------------------


def _psnr(splats: Splats, player: Any, view: Any, turned: bool = False) -> float:
    """Of the Gaussians as a reader found them, drawn from the view's camera, against the scene's own picture, dB."""
    from pd4dgs_codec.draw.visibility import near_plane
    from pd4dgs_codec.interchange.export import turned_camera, upright
    from pd4dgs_codec.interchange.splats import picture

    camera = turned_camera(view.camera, upright(player.info.up) if turned else None)
    image = picture(splats, camera, player.info.background, near_plane(player.info))
    error = float(np.square(image.astype(np.float64) - player.picture(view.camera, view.time)).mean())
    return float(-10 * np.log10(error))


def _sigmoid(values: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-values))


def _contiguous(*parts: np.ndarray) -> Splats:
    return Splats(*(np.ascontiguousarray(part, np.float32) for part in parts))


def _plyfile(path: Path, player: Any, view: Any) -> float:
    from plyfile import PlyData

    rows = PlyData.read(str(path))["vertex"].data

    def stack(prefix: str, count: int) -> np.ndarray:
        return np.stack([rows[f"{prefix}{i}"] for i in range(count)], axis=1)

    rest = stack("f_rest_", 45).reshape(len(rows), 3, 15).transpose(0, 2, 1)
    sh = np.concatenate([stack("f_dc_", 3)[:, None], rest], axis=1)
    means = np.stack([rows[axis] for axis in "xyz"], axis=1)
    splats = _contiguous(means, stack("rot_", 4), np.exp(stack("scale_", 3)), _sigmoid(rows["opacity"]), sh)
    return _psnr(splats, player, view)


def _plyfile_sequence(path: Path, player: Any, view: Any) -> float:
    files = sorted(path.iterdir())
    at = round(view.time * (len(files) - 1))
    return _plyfile(files[at], player, _at(view, at / (len(files) - 1)))


def _gaussforge(path: Path, player: Any, view: Any) -> float:
    import gaussforge

    from pd4dgs_codec.interchange.formats import quiet

    with quiet():
        found = gaussforge.GaussForge().read(path.read_bytes(), "spz")["data"]
    n = found["numPoints"]
    keys = ("positions", "scales", "rotations", "alphas", "colors", "sh")
    fields = {key: np.frombuffer(found[key], "<f4") for key in keys}
    sh = np.concatenate([fields["colors"].reshape(n, 1, 3), fields["sh"].reshape(n, 15, 3)], axis=1)
    scales, quats = np.exp(fields["scales"]).reshape(n, 3), fields["rotations"].reshape(n, 4)
    splats = _contiguous(fields["positions"].reshape(n, 3), quats, scales, _sigmoid(fields["alphas"]), sh)
    return _psnr(splats, player, view, turned=True)


def _pygltflib(path: Path, player: Any, view: Any) -> float:
    import pygltflib

    document = pygltflib.GLTF2().load(str(path))
    attributes = document.meshes[0].primitives[0].attributes

    def accessor(name: str) -> np.ndarray:
        row = document.accessors[getattr(attributes, name)]
        start, width = document.bufferViews[row.bufferView].byteOffset, {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[row.type]
        return np.frombuffer(document.binary_blob(), "<f4", row.count * width, start).reshape(-1, width)

    prefix = "KHR_gaussian_splatting:"
    sh = [accessor(f"{prefix}SH_DEGREE_{degree}_COEF_{i}") for degree in range(4) for i in range(2 * degree + 1)]
    quats, opacities = accessor(f"{prefix}ROTATION")[:, [3, 0, 1, 2]], accessor(f"{prefix}OPACITY")[:, 0]
    splats = _contiguous(accessor("POSITION"), quats, accessor(f"{prefix}SCALE"), opacities, np.stack(sh, axis=1))
    return _psnr(splats, player, view, turned=True)


def _fourdgs(path: Path, player: Any, view: Any) -> float:
    """At the start of the frame next to the view's time."""
    import fourdgs

    scene = fourdgs.read(path.read_bytes())
    g, seconds = scene.gaussians, player.info.time_range[1] - player.info.time_range[0]
    frames = round(view.time * (FRAMES - 1))
    t = frames * seconds / (FRAMES - 1)
    state = g.state_at(t + 1e-4 * seconds)
    rows = state["indices"]
    rest = (g.sh[rows].astype(np.float32) * (8 / 255) - 4).reshape(len(rows), 3, 15).transpose(0, 2, 1)
    dc = (g.colors[rows, :3] - 0.5) / 0.28209479177387814
    sh = np.concatenate([dc[:, None], rest], axis=1)
    splats = _contiguous(state["centers"], g.rotations[rows][:, [3, 0, 1, 2]], g.scales[rows], state["opacity"], sh)
    return _psnr(splats, player, _at(view, frames / (FRAMES - 1)))


def _at(view: Any, t: float) -> Any:
    from dataclasses import replace

    return replace(view, time=t)


#: kind -> (who reads it, path, player and view -> dB against the scene's own picture).
READERS: dict[str, tuple[str, Callable[[Path, Any, Any], float]]] = {
    "ply": ("plyfile", _plyfile),
    "spz": ("gaussforge", _gaussforge),
    "glb": ("pygltflib", _pygltflib),
    "ply-seq": ("plyfile", _plyfile_sequence),
    "4dgs": ("fourdgs", _fourdgs),
}


# -- the page ----------------------------------------------------------------------------------------------------------


def render(rows: Sequence[Row]) -> str:
    """Costs of variants, then files."""
    costs, files = [], []
    for row in rows:
        for c in row["costs"]:
            direct, exported = c["direct_mpsnr"], c["exported_mpsnr"]
            decibels = (direct, exported, direct - exported, c["exported_to_direct_psnr"])
            cells = (row["name"], c["eyes"], str(c["degree"]), str(c["steps"]), *(f"{v:.2f}" for v in decibels))
            costs.append((*cells, f"{c['seconds']:.1f}"))
        files.append((row["name"], ".pd4, all times and views", "-", "-", f"{row['file_bytes']:,}", "-", "-", "-"))
        for f in row["files"]:
            what = f["kind"] + (f", {f['frames']} frames" if f["frames"] > 1 else "")
            counts = f"{f['gaussians']:,}", f"{f['bytes']:,}", f"{f['psnr']:.2f}"
            files.append((row["name"], what, f["reader"], *counts, f"{f['seconds']:.0f}", f"{f['megabytes']:.0f}"))
    about_costs = f"""Held-out views, up to {VIEWS} per scene, each exported at its own instant: mPSNR of the scene's
own picture and of the exported Gaussians against the truth, and PSNR of the second against the first. Eyes are those
of the data set's training cameras or of the file alone."""
    about_files = f"""Files of degree 3 after {STEPS} steps, eyes of the data set, each read by a library that is not
ours and drawn by our rasteriser against the scene's own picture. Sequences are read at the frame nearest to the
view's instant. Seconds and peak memory are of the whole command."""
    head = ("scene", "eyes", "degree", "steps", "direct dB", "exported dB", "cost dB", "to direct dB", "s an instant")
    files_head = ("scene", "file", "read by", "Gaussians", "bytes", "to direct dB", "seconds", "MiB")
    lines = [*paragraph(about_costs), "", unpadded(markdown(head, costs)), "", *paragraph(about_files), ""]
    return "\n".join([*lines, unpadded(markdown(files_head, files))])


PAGE = Page("interchange", "interchange.py", render)


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = options(__doc__, NAMES).parse_args(argv)
    configure(None)
    todo = [scene.name for scene in present(args, NAMES)]
    return make(PAGE, NAMES, todo, args, lambda name: measure(name, args.out))


if __name__ == "__main__":
    sys.exit(main())
