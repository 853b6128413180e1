"""Models of other programs packed as they are: bytes, quality and seconds of `pd4dgs-import`, beside PLY, SPZ and 4dgs.

`python benchmarks/direct.py -o docs/img` measures the sample exported to a PLY sequence whose rows keep their order,
of which every second frame is packed and the others are held out; bodies that fly, bounce, bend and appear, several
seeds each; and the static captures of the shared data. It prints a table, and draws dB against bytes and the sample's
source beside the file. SPZ and 4dgs need the extra `interchange`.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from common import ROOT, SHARED, Row, command, say, table
from PIL import Image

from pd4dgs_codec import decode, sample
from pd4dgs_codec.data.view import rotation_matrix
from pd4dgs_codec.draw.player import Player
from pd4dgs_codec.interchange.export import bake, eyes_of_scene
from pd4dgs_codec.interchange.splats import evenly, fourdgs_bytes, picture, ply_bytes, read_splats, sphere, spz_bytes
from pd4dgs_codec.interchange.teacher import Options, Teacher, cameras_of, read_model
from pd4dgs_codec.kinds.splats import SH_C0, Splats, SplatScene, product, unit
from pd4dgs_codec.quality.image import mpsnr, to_uint8
from pd4dgs_codec.scene import Scene

GOALS = (34, 38, 42, 46)  #: dB of the curve
GOAL, STILL_GOAL = 43, 50  #: dB of the table
UP = (0.0, 0.0, 1.0)  #: of the sample
FRAMES, EYES = 149, 6  #: of the sample, and viewpoints from which it is exported
FAINT = 1e-4  #: opacity of the sample's Gaussians in frames that do not show them
SEEDS, FPS = 3, 30.0
JUDGES = 12  #: pictures that measure other formats and held-out instants
BODIES, EACH = 10, 1500
Triple = tuple[float, float, float]
BLACK = (0.0, 0.0, 0.0)

# -- sources -----------------------------------------------------------------------------------------------------------


def __getattr__(name: str) -> Callable[[float], Splats]:
    """`direct:bouncing_2` and the like: bodies of a kind and a seed, for pd4dgs-import."""
    kind, _, seed = name.partition("_")
    if kind not in MOTIONS or not seed.isdecimal():
        raise AttributeError(name)
    return bodies(kind, int(seed))


def bodies(kind: str, seed: int) -> Callable[[float], Splats]:
    """BODIES spotted balls of EACH Gaussians as a function of time 0..1."""
    rng, parts = np.random.default_rng(seed), []
    for i in range(BODIES):
        at, size, tint = rng.uniform(-1, 1, 3), rng.uniform(0.15, 0.4), rng.uniform(0.1, 0.9, (2, 3))
        ball = sphere(EACH) * size
        spots = (np.sin(9 / size * ball @ rng.normal(size=(3, 3))).prod(axis=1) > 0)[:, None]
        colors = np.where(spots, *tint) * (0.8 + 0.2 * ball[:, 1:2] / size) + rng.normal(0, 0.02, (EACH, 3))
        quats = unit(rng.normal(size=(EACH, 4)))
        scales = size * 2.2 / np.sqrt(EACH) * rng.lognormal(0, 0.2, (EACH, 3))
        opacities = rng.uniform(0.8, 0.99, EACH)
        motion = MOTIONS[kind](rng, i)
        parts.append((at, ball, quats, scales, opacities, ((colors - 0.5) / SH_C0)[:, None], motion))

    def splats(t: float) -> Splats:
        rows = []
        for at, ball, quats, scales, opacities, sh, motion in parts:
            turn, shift, bend, shown = motion(t)
            x, y, z = (rotation_matrix(turn) @ ball.T).astype(np.float64)
            y = y + bend * (x**2 - z**2)
            means = np.stack([x, y, z], axis=1) + at + shift
            rows.append((means, product(turn, quats), scales, opacities * shown, sh))
        return Splats(*(np.concatenate(part).astype(np.float32) for part in zip(*rows, strict=True)))

    return splats


Motion = Callable[[float], tuple[np.ndarray, np.ndarray, float, float]]  #: rotation, shift, bend, visibility


def _spin(rng: np.random.Generator) -> Callable[[float], np.ndarray]:
    axis, speed = unit(rng.normal(size=3)), rng.uniform(0.5, 3)
    return lambda t: np.array([np.cos(speed * t), *(np.sin(speed * t) * axis)])


def _flying(rng: np.random.Generator, i: int) -> Motion:
    spin, speed, sway = _spin(rng), rng.normal(0, 1, 3), rng.normal(0, 0.3, 3)
    return lambda t: (spin(t), speed * (t - 0.5) + sway * np.sin(5 * t), 0.0, 1.0)


def _bouncing(rng: np.random.Generator, i: int) -> Motion:
    spin, phase, rate = _spin(rng), rng.uniform(), rng.uniform(1.5, 3)
    return lambda t: (spin(t), np.array([0, -abs(np.sin(np.pi * (rate * t + phase))), 0]), 0.0, 1.0)


def _bending(rng: np.random.Generator, i: int) -> Motion:
    spin, depth, rate = _spin(rng), rng.uniform(0.5, 1.5), rng.uniform(2, 8)
    return lambda t: (spin(0.2 * t), np.zeros(3), depth * np.sin(rate * t), 1.0)


def _appearing(rng: np.random.Generator, i: int) -> Motion:
    flying, start = _flying(rng, i), rng.uniform(0.1, 0.9)
    sign = 1 if i % 2 else -1
    return lambda t: (*flying(t)[:3], float(1 / (1 + np.exp(-sign * 40 * (t - start)))))


MOTIONS = {"flying": _flying, "bouncing": _bouncing, "bending": _bending, "appearing": _appearing}


def write_sample(folder: Path) -> None:
    """The sample as FRAMES PLY files with harmonics of degree 1. Every file has every Gaussian that any frame shows."""
    scene = decode(sample().read_bytes())
    assert isinstance(scene, Scene)
    player = Player(scene)
    eyes = eyes_of_scene(player, EYES)
    baked = [bake(player, i / (FRAMES - 1), eyes, 1) for i in range(FRAMES)]
    slots = np.unique(np.concatenate([own for _, own in baked]))
    shapes = {name: part.shape[1:] for name, part in vars(baked[0][0]).items()}
    last = Splats(**{name: np.zeros((len(slots), *shape), np.float32) for name, shape in shapes.items()})
    frames = list(enumerate(baked))
    for i, (splats, own) in [(-1, row) for row in baked[::-1]] + frames:  # backwards first: what comes before a start
        at = np.searchsorted(slots, own)
        last.opacities[:] = FAINT
        for name, part in vars(splats).items():
            getattr(last, name)[at] = part
        if i >= 0:
            (folder / f"{i:05d}.ply").write_bytes(ply_bytes(last))


# -- measures ----------------------------------------------------------------------------------------------------------


def scene_of(data: bytes) -> SplatScene:
    """Decodes a file of explicit Gaussians."""
    scene = decode(data)
    assert isinstance(scene, SplatScene)
    return scene


def packed(source: str | Path, *options: object) -> tuple[bytes, Row]:
    """The file that pd4dgs-import makes, and its report with `encode` and `decode` seconds."""
    with tempfile.TemporaryDirectory() as folder:
        path, start = Path(folder) / "scene.pd4", time.perf_counter()
        report = command("import_model", source, "-o", path, *options)
        middle = time.perf_counter()
        data = path.read_bytes()
        decode(data)
        return data, report | {"encode": middle - start, "decode": time.perf_counter() - middle}


def differences(
    model: Teacher, shown: Callable[[float], Splats], place: Path, times: Sequence[float], background: Triple = BLACK
) -> float:
    """Mean PSNR in dB of the pictures of `shown` against the model's, from JUDGES cameras of a dome at these times."""
    middle = model.splats(model.nearest(0.5))
    cameras, _ = cameras_of(place, middle.means[middle.opacities > 0.1], Options(views=5 * JUDGES))
    found = []
    for camera, t in zip(cameras[2::5], evenly(times, JUDGES), strict=False):
        truth = picture(model.splats(t), camera, background)
        found.append(min(mpsnr(picture(shown(t), camera, background), truth), 100.0))
    return float(np.mean(found))


def others(model: Teacher, place: Path, times: Sequence[float], seconds: float) -> Row:
    """Bytes of PLY, SPZ and 4dgs files of these instants, and dB of the last two."""
    frames = [model.splats(t) for t in times]
    row: Row = {"ply": sum(len(ply_bytes(frame)) for frame in frames)}
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(folder) / f"{i}.spz" for i in range(len(frames))]
        for path, frame in zip(files, frames, strict=True):
            path.write_bytes(spz_bytes(frame))
        row["spz"] = sum(path.stat().st_size for path in files)
        at = {t: path for t, path in zip(times, files, strict=True)}
        row["spz_db"] = differences(model, lambda t: read_splats(at[t]), place, times)
        if len(frames) == 1:
            return row
        path = Path(folder) / "scene.4dgs"
        starts, rows = np.asarray(times) * seconds, np.arange(len(frames[0].means))
        spans = [(float(t), frame, rows) for t, frame in zip(starts[:-1], frames, strict=False)]
        path.write_bytes(fourdgs_bytes(spans, seconds))
        row["4dgs"] = path.stat().st_size
        read = read_model(str(path), FPS)
        row["4dgs_db"] = differences(model, read.splats, place, times[1:-1])
    return row


def measured(name: str, source: str, goal: float, *, held_out: Path | None = None, peers: bool = True) -> Row:
    """One source: its file, and those of other formats. held_out: a folder with the frames between the source's."""
    options = ("--fps", FPS / 2, "--up", "0,0,1") if held_out else ()
    data, report = packed(source, "--psnr", goal, *options)
    scene, model = scene_of(data), read_model(source, FPS)
    top = str(max(map(int, report["psnr"])))
    row = {"name": name, "gaussians": report["gaussians"], "bytes": len(data), "psnr": report["psnr"][top]}
    row |= {key: report[key] for key in ("encode", "decode", "static", "instants")} | {"levels": report["psnr"]}
    row["prefixes"] = [layer["bytes"] for layer in report["layers"]]
    if held_out:
        whole = read_model(str(held_out), FPS)
        assert whole.times
        between = whole.times[1::2]
        row["between"] = differences(whole, lambda t: scene.splats(t)[0], held_out, between)
    elif model.times is None:
        row["between"] = row["psnr"]  # the cameras of a function measure at any time
    if peers:
        times = model.times or tuple(np.linspace(0, 1, round(FPS) + 1))
        row |= others(model, Path(source), times, report["instants"] * 2 / FPS if held_out else 1.0)
    say(json.dumps(row))
    return row


def text(rows: Sequence[Row]) -> str:
    """The table in Markdown."""
    head = ["source", "Gaussians", "bytes", "dB", "dB between instants", "encode s", "decode s", "PLY", "SPZ (dB)",
            "4dgs (dB)"]  # fmt: skip

    def peer(row: Row, name: str) -> str:
        return f"{row[name]:,} ({row[f'{name}_db']:.1f})" if name in row else "-"

    return table(head, [
        [row["name"], f"{row['gaussians']:,}", f"{row['bytes']:,}", f"{row['psnr']:.2f}",
         f"{row['between']:.2f}" if "between" in row else "-", f"{row['encode']:.0f}", f"{row['decode']:.2f}",
         f"{row['ply']:,}" if "ply" in row else "-", peer(row, "spz"), peer(row, "4dgs")]
        for row in rows
    ])  # fmt: skip


def draw_curve(curves: dict[str, list[tuple[float, float]]], path: Path) -> None:
    """dB against kilobytes."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(5, 3.2), dpi=110)
    for name, points in curves.items():
        axes.plot([size / 1e3 for size, _ in points], [db for _, db in points], "o-", label=name, markersize=3)
    axes.set(xlabel="kB", ylabel="dB against the source", xlim=(0, None))
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(path)


def draw_beside(frames: Path, data: bytes, path: Path) -> None:
    """Source and file at three instants, side by side."""
    model, scene, rows = read_model(str(frames), FPS), scene_of(data), []
    middle = model.splats(model.nearest(0.5))
    cameras, _ = cameras_of(frames, middle.means[middle.opacities > 0.1], Options(views=20, size=(240, 240), up=UP))
    for t in (0.1, 0.5, 0.9):
        at = model.nearest(t)
        pair = [picture(splats, cameras[8], (1.0, 1.0, 1.0)) for splats in (model.splats(at), scene.splats(at)[0])]
        rows.append(np.concatenate([to_uint8(image) for image in pair], axis=0))
    Image.fromarray(np.concatenate(rows, axis=1)).save(path, quality=90)


def main() -> None:
    """Measures, prints and draws."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", dest="pictures", type=Path, help="folder for the pictures")
    parser.add_argument("--seeds", type=int, default=SEEDS)
    args = parser.parse_args()
    rows, curves = [], dict[str, list[tuple[float, float]]]()
    with tempfile.TemporaryDirectory() as folder:
        whole, half = ROOT / "out" / "direct-frames", Path(folder) / "half"
        half.mkdir()
        if not whole.is_dir():
            whole.mkdir(parents=True)
            write_sample(whole)
        for i, path in enumerate(sorted(whole.iterdir())[::2]):  # the first and last of both are the same
            (half / f"{i:05d}.ply").symlink_to(path)
        rows.append(measured("dancer, PLY sequence", str(half), GOAL, held_out=whole))
        for seed in range(args.seeds):
            for kind in MOTIONS:
                rows.append(measured(f"{kind}, seed {seed}", f"direct:{kind}_{seed}", GOAL, peers=seed == 0))
        stills = [SHARED / "splats" / name for name in ("guitar.compressed.ply", "biker.spz")]
        rows += [measured(path.name, str(path), STILL_GOAL) for path in stills if path.exists()]
        print(text(rows), flush=True)
        if args.pictures:
            for name, source in (("dancer", str(half)), ("bouncing bodies", "direct:bouncing_0")):
                made = [(goal, *packed(source, "--psnr", goal, "--up", "0,0,1")) for goal in GOALS]
                curves[name] = [(len(data), report["psnr"][max(report["psnr"])]) for _, data, report in made]
                if source == str(half):
                    draw_beside(half, made[-2][1], args.pictures / "import.jpg")
            draw_curve(curves, args.pictures / "import-curve.png")
            say(json.dumps(curves))


if __name__ == "__main__":
    main()
