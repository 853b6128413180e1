"""Seconds of one piece of work, as one line of JSON. `tools/performance.py` runs it with the package of two commits, so
it imports what both have. argv: what, a checkpoint, a .pd4 file, an effort."""

from __future__ import annotations

import ctypes
import json
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

SIZE = (480, 360)  #: of the picture drawn
PICTURES = 10
STEPS = 9  #: of training at each level
SHARE = 0.55  #: of its run, where a checkpoint is taken to stand


def timed(work: Callable[[], Any]) -> tuple[Any, dict[str, float]]:
    """(what the work gives, its wall and processor seconds)."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = work()
    return result, {"wall": time.perf_counter() - wall, "cpu": time.process_time() - cpu}


def encode(checkpoint: str, file: str, effort: str) -> dict[str, float]:
    """Of a loaded scene, kernels warm; writes `file`. memory: MiB at the most, beside the scene and the
    kernels."""
    from pd4dgs_codec.format.encoder import encode_with_report
    from pd4dgs_codec.model.checkpoint import load
    from pd4dgs_codec.model.convert import to_scene

    scene = to_scene(load(checkpoint)[0])
    encode_with_report(scene, effort=2, layers=0, verify=False)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    (data, _), seconds = timed(lambda: encode_with_report(scene, effort=int(effort)))
    Path(file).write_bytes(data)
    memory = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    return {**seconds, "bytes": len(data), "memory": memory}


def symbols_of(scene: Any) -> int:
    """How many integers a scene was decoded from."""
    arrays = [scene.anchor_q, *(getattr(scene, name) for name in ("feature", "scaling_log", "offset")), *scene.mask]
    networks = [*scene.networks.values()]
    for deformation in filter(None, (scene.global_deformation, scene.local_deformation)):
        arrays += [plane for scale in deformation.planes for plane in scale.values()]
        networks += deformation.networks.values()
    arrays += [array for network in networks for pair in network for array in pair]
    return sum(array.size for array in arrays)


def decode(checkpoint: str, file: str, effort: str) -> dict[str, float]:
    """The second time in a process."""
    from pd4dgs_codec import decode

    data = Path(file).read_bytes()
    symbols = symbols_of(decode(data))
    seconds = timed(lambda: decode(data))[1]
    return {**seconds, "rate": symbols / seconds["cpu"]}


def draw(checkpoint: str, file: str, effort: str) -> dict[str, float]:
    """One picture of the top level, the mean of several at as many times, after a first that is not timed."""
    try:
        from pd4dgs_codec.quality.frames import own_frames
        from pd4dgs_codec.quality.levels import load_levels
    except ImportError:
        from pd4dgs_codec.report.frames import own_frames  # type: ignore[import-not-found,no-redef]
        from pd4dgs_codec.report.levels import load_levels  # type: ignore[import-not-found,no-redef]

    level = load_levels(file)[-1]
    frames = own_frames(level.model.info, PICTURES, 20.0)
    width, height = SIZE
    cameras = []
    for frame in frames:
        scale = [[width / frame.camera.width], [height / frame.camera.height], [1.0]]
        cameras.append(replace(frame.camera, K=(frame.camera.K * scale).astype("float32"), width=width, height=height))
    level.picture(cameras[0], 0.123)
    _, seconds = timed(lambda: [level.picture(c, f.time) for c, f in zip(cameras, frames, strict=True)])
    return {name: value / PICTURES for name, value in seconds.items()}


def start(checkpoint: str, file: str, effort: str) -> dict[str, float]:
    """A command of its own: from nothing to a picture on disk, numba's cache warm."""
    return _command("render", file, "-o", str(Path(file).with_suffix(".png")), "--frames", "1", "-f")


def command(checkpoint: str, file: str, effort: str) -> dict[str, float]:
    """pd4dgs-decode FILE: every byte decoded and checked."""
    return _command("decode", file)


def first(checkpoint: str, file: str, effort: str) -> dict[str, float]:
    """From nothing to the first step of training and its checkpoint, numba's cache warm: one iteration."""
    from pd4dgs_codec.model import checkpoint as checkpoints

    config, own = json.loads(checkpoints.load(checkpoint)[1]["config"]), str(Path(file).with_suffix(".pt"))
    source = [config["source"], "--downscale", str(config["downscale"])]
    return _command("train", *source, "-o", own, "--iterations", "1", "-f")


def _command(name: str, *arguments: str) -> dict[str, float]:
    code = f"import sys; from pd4dgs_codec.cli.{name} import main; sys.exit(main())"
    command = [sys.executable, "-c", code, *arguments]
    wall, used = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, check=True, capture_output=True)
    now = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = now.ru_utime + now.ru_stime - used.ru_utime - used.ru_stime
    return {"wall": time.perf_counter() - wall, "cpu": cpu}


def step(checkpoint: str, file: str, effort: str) -> dict[str, float]:
    """Median processor seconds of a step at each level, on one thread."""
    return _steps(checkpoint, "cpu")


def steps(checkpoint: str, file: str, effort: str) -> dict[str, float]:
    """Median wall seconds of a step at each level, on all threads, as a run takes it."""
    try:
        from pd4dgs_codec.threads import one_torch_thread
    except ImportError:  # the first commits' runs have all threads for torch too
        return _steps(checkpoint, "wall")
    with one_torch_thread():
        return _steps(checkpoint, "wall")


def _steps(checkpoint: str, clock: str) -> dict[str, float]:
    """Of a step at each level, the levels in turn, as if at SHARE of the run."""
    from pd4dgs_codec.data.dataset import load as load_data
    from pd4dgs_codec.model.checkpoint import load
    from pd4dgs_codec.train.config import TrainConfig
    from pd4dgs_codec.train.loop import Trainer

    config = TrainConfig.from_json(load(checkpoint)[1]["config"], checkpoint)
    trainer = Trainer(config, load_data(config.source, downscale=config.downscale, holdout=config.holdout))
    trainer.resume(Path(checkpoint))
    levels = range(trainer.model.level + 1)

    def one(level: int) -> float:
        learner = getattr(trainer, "learner", trainer)
        learner.iteration = round(trainer.total * SHARE)
        if learner is trainer:  # as the first commits had it
            trainer._draw_levels = lambda schedule: ((level,), (1 / 3,) * 3)
            return timed(trainer.step)[1][clock]
        return timed(lambda: learner.step((level,)))[1][clock]

    for level in levels:
        one(level)  # compiles
    turns = [[one(level) for level in levels] for _ in range(STEPS)]
    return {f"level {level}": statistics.median(times) for level, times in enumerate(zip(*turns, strict=True))}


def parts(checkpoint: str, file: str, effort: str) -> dict[str, float]:
    """Processor seconds of encoding, of decoding and of a picture, kernels warm, by what they go to: "work: part"."""
    from parts import Stopwatch

    from pd4dgs_codec.draw import player
    from pd4dgs_codec.format import decoder, encoder, payload
    from pd4dgs_codec.model.checkpoint import load
    from pd4dgs_codec.model.convert import to_scene
    from pd4dgs_codec.quality.frames import own_frames
    from pd4dgs_codec.quality.levels import load_levels

    stopwatch, scene = Stopwatch(), to_scene(load(checkpoint)[0])
    level = load_levels(file)[-1]
    frame = own_frames(level.model.info, 1, 20.0)[0]
    works: dict[str, tuple[Callable[[], Any], tuple[tuple[Any, str, str], ...]]] = {
        "encode": (
            lambda: encoder.encode_with_report(scene, effort=int(effort)),
            (
                (encoder, "plan", "what no picture needs"),
                (payload, "write_attributes", "attributes"),
                (payload, "write_planes", "planes"),
                (payload, "encode_positions", "positions"),
                (payload, "encode_channels", "weights and masks"),
                (encoder, "verify_errors", "verifying"),
                (encoder, "_verify", "verifying"),
                (encoder, "_fingerprint", "verifying"),
                (encoder, "encode_with_report", "the rest"),
            ),
        ),
        "decode": (
            lambda: decoder.decode(Path(file).read_bytes()),
            (
                (payload, "read_attributes", "attributes"),
                (payload, "read_planes", "planes"),
                (payload, "decode_positions", "positions"),
                (payload, "decode_channels", "weights and masks"),
                (decoder, "decode", "the rest"),
            ),
        ),
        "picture": (
            lambda: level.picture(frame.camera, frame.time),
            (
                (player, "draw", "rasteriser"),
                (player.Field, "move", "deformations"),
                (player.Player, "picture", "scaffold networks and the rest"),
            ),
        ),
    }
    found = {}
    for work, (run, wraps) in works.items():
        run()
        level.picture(frame.camera, 0.123)  # what the level keeps of one time is not of the next
        for owner, name, part in wraps:
            stopwatch.wrap(owner, name, part)
        run()
        stopwatch.unwrap()
        found |= {f"{work}: {part}": seconds for part, seconds in stopwatch.take().items()}
    return found


def grow(checkpoint: str, file: str, anchors: str) -> dict[str, float]:
    """So many anchors: the checkpoint's own, and copies of them some voxels off with noise of two steps. arrays: MiB of
    the scene's float32 arrays; memory: MiB of these and of what encoding takes beside them and beside imports and
    kernels."""
    import numpy as np

    from pd4dgs_codec import decode
    from pd4dgs_codec.entropy.fitting import loops
    from pd4dgs_codec.format.encoder import encode_with_report
    from pd4dgs_codec.format.symbols import float_tensors
    from pd4dgs_codec.model.checkpoint import load
    from pd4dgs_codec.model.convert import to_scene

    given, rng, wanted = to_scene(load(checkpoint)[0]), np.random.default_rng(0), int(anchors)
    loops()
    encode_with_report(given)  # imports and compiles what it needs
    own = len(given.anchor_q)
    copies = -(-2 * wanted // own)
    places = np.concatenate([given.anchor_q + (rng.integers(-6, 7, (own, 3)) if i else 0) for i in range(copies)])
    source = np.tile(np.arange(own), copies)
    chosen = np.sort(np.unique(places, axis=0, return_index=True)[1])[:wanted]
    source = source[chosen]
    values = {}
    for name, step_of in (("feature", "feature"), ("scaling_log", "scaling_log"), ("offset", "offset")):
        value = getattr(given, name)[source]
        noise = rng.standard_normal(value.shape, np.float32) * np.float32(2 * getattr(given.steps, step_of))
        noise[:own] = 0
        values[name] = value + noise
        del noise
    masks = tuple(codes[source] for codes in given.full_masks())
    scene = replace(
        given,
        rows=(len(chosen),) * len(given.layers),
        anchor_q=places[chosen].astype(np.int32),
        mask=masks,
        grading=None,
        **values,
    )
    del places, values
    arrays = sum(array.nbytes for i in range(len(scene.layers)) for array in float_tensors(scene, i)[1:])
    arrays += scene.anchor.nbytes
    ctypes.CDLL(None).malloc_trim(0)  # else encoding takes what making the scene has left, unseen
    Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
    before = _memory("VmRSS") - arrays / 2**20
    (data, _), coded = timed(lambda: encode_with_report(scene))
    memory = _memory("VmHWM") - before
    Path(file).write_bytes(data)
    decoded = timed(lambda: decode(data))[1]
    return {
        "anchors": len(chosen),
        "bytes": len(data),
        "encode": coded["cpu"],
        "decode": decoded["cpu"],
        "memory": memory,
        "arrays": arrays / 2**20,
    }


def _memory(what: str) -> float:
    """MiB that the process has in memory: VmRSS now, VmHWM at the most."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(what):
            return int(line.split()[1]) / 1024
    return 0.0


def beside(checkpoint: str, file: str, effort: str) -> dict[str, float]:
    """What others take for the same symbols: constriction's QuantizedGaussian, one per channel of the attributes of
    layer 0, against their section here; xz for all of the file's symbols."""
    import constriction
    import numpy as np

    from pd4dgs_codec import decode, encode
    from pd4dgs_codec.format.attribute_section import read_attributes, write_attributes
    from pd4dgs_codec.format.decoder import decode_layers

    data = Path(file).read_bytes()
    layer = decode_layers(data)[1][0]
    channels = layer.attributes
    coder = constriction.stream.stack.AnsCoder()
    models = []
    for channel in channels:
        low, high = int(channel.min()), int(channel.max())
        family = constriction.stream.model.QuantizedGaussian(low - 1, high + 1)
        models.append((family, float(channel.mean()), max(float(channel.std()), 0.05)))
    rows = channels.shape[1]

    def parameters(mean: float, spread: float) -> list[Any]:
        return [np.full(rows, mean), np.full(rows, spread)]

    for channel, (family, mean, spread) in zip(channels[::-1], models[::-1], strict=True):
        coder.encode_reverse(np.ascontiguousarray(channel), family, *parameters(mean, spread))
    words = coder.get_compressed()

    def gaussians() -> None:
        again = constriction.stream.stack.AnsCoder(words)
        for family, mean, spread in models:
            again.decode(family, *parameters(mean, spread))

    section = write_attributes(channels, layer.classes, layer.widths, "best", 5)[0]
    scene = decode(data)
    packed, own = encode(scene, mode="lzma", verify=False), encode(scene, verify=False)
    return {
        "symbols": channels.size,
        "gaussian bytes": 4 * len(words),
        "gaussian decode": timed(gaussians)[1]["cpu"],
        "own bytes": len(section),
        "own decode": timed(lambda: read_attributes(section, layer.widths, rows))[1]["cpu"],
        "xz file": len(packed),
        "xz decode": timed(lambda: decode(packed))[1]["cpu"],
        "own file": len(own),
        "own file decode": timed(lambda: decode(own))[1]["cpu"],
    }


def main() -> None:
    """Policy of threads first, as the commands have it; its place moved between the commits."""
    try:
        from pd4dgs_codec.threads import configure
    except ImportError:
        from pd4dgs_codec.render.threads import configure  # type: ignore[import-not-found,no-redef]
    what, *arguments = sys.argv[1:]
    configure(1 if what == "step" else None)
    works = {
        "encode": encode, "decode": decode, "command": command, "draw": draw, "start": start, "first": first,
        "steps": steps, "step": step, "parts": parts, "grow": grow, "beside": beside,
    }  # fmt: skip
    print(json.dumps(works[what](*arguments)))


if __name__ == "__main__":
    main()
