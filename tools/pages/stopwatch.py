"""Seconds of one piece of work, as one line of JSON. `tools/performance.py` runs it with the package of two commits, so
it imports what both have. argv: what, a checkpoint, a .pd4 file, an effort."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

SIZE = (480, 360)  #: of the picture drawn
PICTURES = 10


def timed(work: Callable[[], Any]) -> tuple[Any, dict[str, float]]:
    """(what the work gives, its wall and processor seconds)."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = work()
    return result, {"wall": time.perf_counter() - wall, "cpu": time.process_time() - cpu}


def encode(checkpoint: str, file: str, effort: str) -> dict[str, float]:
    """Of a loaded scene, kernels warm; writes `file`. memory: MiB at the most, beside the scene and the
    kernels."""
    from pd4dgs_codec.codec.encoder import encode_with_report
    from pd4dgs_codec.model.checkpoint import load
    from pd4dgs_codec.model.convert import to_scene

    scene = to_scene(load(checkpoint)[0])
    encode_with_report(scene, effort=2, layers=0, verify=False)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    (data, _), seconds = timed(lambda: encode_with_report(scene, effort=int(effort)))
    Path(file).write_bytes(data)
    memory = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    return {**seconds, "bytes": len(data), "memory": memory}


def decode(checkpoint: str, file: str, effort: str) -> dict[str, float]:
    """The second time in a process."""
    from pd4dgs_codec import decode

    data = Path(file).read_bytes()
    decode(data)
    return timed(lambda: decode(data))[1]


def draw(checkpoint: str, file: str, effort: str) -> dict[str, float]:
    """One picture of the top level, the mean of several at as many times, after a first that is not timed."""
    try:
        from pd4dgs_codec.view.frames import own_frames
        from pd4dgs_codec.view.levels import load_levels
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
    code = "import sys; from pd4dgs_codec.cli.render import main; sys.exit(main())"
    picture = str(Path(file).with_suffix(".png"))
    command = [sys.executable, "-c", code, file, "-o", picture, "--frames", "1", "-f"]
    wall, used = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, check=True, capture_output=True)
    now = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = now.ru_utime + now.ru_stime - used.ru_utime - used.ru_stime
    return {"wall": time.perf_counter() - wall, "cpu": cpu}


def main() -> None:
    """Policy of threads first, as the commands have it; its place moved between the commits."""
    try:
        from pd4dgs_codec.threads import configure
    except ImportError:
        from pd4dgs_codec.render.threads import configure  # type: ignore[import-not-found,no-redef]
    configure()
    what, *arguments = sys.argv[1:]
    works = {"encode": encode, "decode": decode, "draw": draw, "start": start}
    print(json.dumps(works[what](*arguments)))


if __name__ == "__main__":
    main()
