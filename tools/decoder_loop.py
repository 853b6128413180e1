"""Packs checkpoints and decodes files as lines on stdin ask, and answers with a line of JSON each.

Runs with the package of another commit too, so it imports what both have.

    {"pack": CHECKPOINT, "to": FILE, "anchors": N}  -> {}, FILE as `pd4dgs-encode` packs it, grown to N anchors (0: not)
    {"time": FILE}                                  -> {"wall", "cpu"}, seconds of decoding it once
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pd4dgs_codec import decode, encode
from pd4dgs_codec.format.plan import plan
from pd4dgs_codec.scene import Scene

try:
    from pd4dgs_codec.morton import morton_order
except ImportError:
    from pd4dgs_codec.entropy.morton import morton_order  # type: ignore[no-redef]


def grown(scene: Scene, anchors: int) -> Scene:
    """At least so many anchors: copies of the scene's side by side along x, networks and planes as they are."""
    copies = -(-anchors // scene.rows[-1])
    shift = int(np.ptp(scene.anchor_q[:, 0])) + 1
    rows, voxels, first = list[np.ndarray](), list[np.ndarray](), 0
    for last in scene.rows:
        own = np.tile(np.arange(first, last), copies)
        moved = scene.anchor_q[own]
        moved[:, 0] += np.repeat(np.arange(copies), last - first).astype(np.int32) * shift
        order = morton_order(moved)
        rows.append(own[order])
        voxels.append(moved[order])
        first = last
    index = np.concatenate(rows)
    changed: dict[str, Any] = {
        "rows": tuple(copies * n for n in scene.rows),
        "anchor_q": np.concatenate(voxels),
        "mask": tuple(codes[index[: copies * len(codes)]] for codes in scene.mask),
    }
    changed |= {name: getattr(scene, name)[index] for name in ("feature", "scaling_log", "offset")}
    if getattr(scene, "grading", None) is not None:
        changed["grading"] = scene.grading.take(index)
    return replace(scene, **changed)


def pack(checkpoint: str, file: str, anchors: int) -> dict[str, float]:
    """Writes `file`."""
    from pd4dgs_codec.model.checkpoint import load
    from pd4dgs_codec.model.convert import to_scene

    scene = plan(to_scene(load(checkpoint)[0]))[0]
    if anchors:  # of values as a file has them
        scene = grown(decode(encode(scene, omit="nothing", verify=False)), anchors)
    Path(file).write_bytes(encode(scene, omit="nothing", verify=False, effort=1 if anchors else 5))
    return {}


def seconds(data: bytes) -> dict[str, float]:
    """Of decoding once."""
    cpu, wall = time.process_time(), time.perf_counter()
    decode(data)
    return {"wall": time.perf_counter() - wall, "cpu": time.process_time() - cpu}


def main() -> None:
    """Until stdin ends."""
    try:
        from pd4dgs_codec.threads import configure
    except ImportError:
        from pd4dgs_codec.render.threads import configure  # type: ignore[import-not-found,no-redef]
    configure(None)
    files: dict[str, bytes] = {}
    for line in sys.stdin:
        asked = json.loads(line)
        if "pack" in asked:
            answer = pack(asked["pack"], asked["to"], asked["anchors"])
        else:
            path = asked["time"]
            if path not in files:
                files[path] = Path(path).read_bytes()
            answer = seconds(files[path])
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
