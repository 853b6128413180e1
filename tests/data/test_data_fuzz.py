"""Datasets damaged with their structure in mind: each is read into finite numbers or refused in one line.

Values of the JSON files are replaced, removed, nested or made huge; headers of PLY, PNG and npy files likewise; bytes
are flipped and files cut. A case is known by its seed.
"""

from __future__ import annotations

import copy
import io
import json
import random
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from folders import gradient, pose
from PIL import Image

from pd4dgs_codec.data.dataset import load
from pd4dgs_codec.errors import DataError

VALUES: list[Any] = [
    *(None, True, False, 0, -1, 1, 2, 0.5, -0.0, 1e-300, 1e300, -1e300, 1e38, 3e38, float("nan"), float("inf")),
    *(65_536, 2**31, 10**40, "", "0", "\0", "r_000", "../r_000", "/dev/null", "é\ud800", "x" * 5000, "FISHEYE"),
    *([], {}, [1], [[]], [1e300] * 3, [0, 0, 0], [[1, 2], [3]], {"0": 1}, [9, 9, 9, 9], [[[1.0] * 4] * 4]),
]  # fmt: skip
PLY = b"ply\nformat ascii 1.0\nelement vertex 2\n" + b"".join(b"property float %c\n" % c for c in b"xyz")
PLY += b"end_header\n0 0 0\n1 1 1\n"
WORDS = b"ply -1 2 0 vertex face ascii binary_little_endian binary_big_endian list uchar double x y nan inf".split()
WORDS += [b"1e300", b"property", b"element", b"end_header", b"\n", b"\0", b"9" * 5000]


def blender_files() -> dict[str, Any]:
    frames = [{"file_path": f"r_{i}", "time": i / 3, "transform_matrix": pose(0.3 * i)} for i in range(4)]
    file = {"camera_angle_x": 0.8, "w": 6, "h": 4, "k1": 0.01, "frames": frames, "near_far_per_frame": [[1, 9]] * 4}
    return {"transforms.json": {**file, "ply_file_path": "points.ply"}, "points.ply": PLY, **pictures("r_{}.png")}


def iphone_files() -> dict[str, Any]:
    camera = {
        "orientation": np.diag([1.0, -1.0, -1.0]).tolist(),
        **{"position": [0, 0, 4], "focal_length": 7.0, "principal_point": [3, 2], "image_size": [6, 4], "skew": 0.0},
        **{"radial_distortion": [0.01, 0, 0], "tangential_distortion": [0, 0], "pixel_aspect_ratio": 1.0},
    }
    names = [f"0_{i}" for i in range(4)]
    points = io.BytesIO()
    np.save(points, np.arange(12, dtype=np.float32).reshape(4, 3))
    return {
        **{f"camera/{name}.json": copy.deepcopy(camera) for name in names},
        "splits/train.json": {"frame_names": names[:3], "camera_ids": [0] * 3, "time_ids": [0, 1, 2]},
        "splits/val.json": {"frame_names": names[3:], "camera_ids": [1], "time_ids": [1]},
        "metadata.json": {name: {"warp_id": i, "camera_id": 0} for i, name in enumerate(names)},
        "scene.json": {"center": [0, 0, 0], "scale": 1.0, "near": 0.5, "far": 9.0},
        "extra.json": {"factor": 1, "fps": 30.0, "bbox": [[-1] * 3, [1] * 3], "up": [0, 1, 0], "background": [0] * 3},
        "points.npy": points.getvalue(),
        **pictures("rgb/1x/0_{}.png"),
        **pictures("covisible/1x/val/0_{}.png"),
    }  # fmt: skip


def pictures(name: str) -> dict[str, bytes]:
    result = {}
    for i in range(4):
        stream = io.BytesIO()
        Image.fromarray(gradient(6, 4, i)).save(stream, "PNG")
        result[name.format(i)] = stream.getvalue()
    return result


def damage_json(value: Any, rng: random.Random) -> Any:
    """A copy with one place of it, however deep, replaced, removed, wrapped or repeated."""
    if isinstance(value, (dict, list)) and value and rng.random() < 0.85:
        result = copy.copy(value)
        key = rng.choice(list(value)) if isinstance(value, dict) else rng.randrange(len(value))
        result[key] = damage_json(value[key], rng)
        return result
    kind = rng.randrange(8)
    if kind == 0 and isinstance(value, (dict, list)):
        return type(value)()
    if kind == 1:
        return [value]
    if kind == 2 and isinstance(value, (int, float)):
        return value * rng.choice([-1, 0, 1e-30, 1e9, 1e30, 1e300])
    if kind == 3 and isinstance(value, list):
        return value * 3
    return rng.choice(VALUES)


def damage_bytes(data: bytes, rng: random.Random) -> bytes:
    """A copy cut, with bytes changed, or with words of it replaced."""
    kind, place = rng.randrange(4), rng.randrange(max(len(data), 1))
    if kind == 0:
        return data[:place]
    if kind == 1 and data.startswith(b"ply"):
        words = data.split(b" ")
        words[rng.randrange(len(words))] = rng.choice(WORDS)
        return b" ".join(words)
    if kind == 2:  # four bytes of a header, which count or measure something there
        place = rng.randrange(min(len(data), 64) or 1)
        return (
            data[:place] + rng.choice([b"\xff" * 4, bytes(4), b"\0\0\xff\xff", b"\x7f\xff\xff\xff"]) + data[place + 4 :]
        )
    changed = bytearray(data)
    for _ in range(rng.choice([1, 1, 3])):
        if changed:
            changed[rng.randrange(len(changed))] = rng.randrange(256)
    return bytes(changed)


def written(content: Any) -> bytes:
    return content if isinstance(content, bytes) else json.dumps(content).encode("ascii")


BINARY32 = float(np.finfo(np.float32).max)


class Folder:
    """A whole dataset on the disk, of which single files are damaged and mended again."""

    def __init__(self, root: Path, files: dict[str, Any]):
        self.root, self.files = root, files
        for name, content in files.items():
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            (root / name).write_bytes(written(content))

    def try_damage(self, seed: int) -> str:
        """What became of one damaged copy: "read" or "refused"."""
        rng = random.Random(seed)
        names = list(self.files)
        chosen = [rng.choice(names) if rng.random() < 0.3 else rng.choice([n for n in names if n.endswith(".json")])]
        if rng.random() < 0.2:
            chosen.append(rng.choice(names))
        try:
            for name in chosen:
                content = self.files[name]
                if isinstance(content, bytes) or rng.random() < 0.1:
                    (self.root / name).write_bytes(damage_bytes(written(content), rng))
                else:
                    (self.root / name).write_bytes(written(damage_json(content, rng)))
            return self._examine(seed, chosen)
        finally:
            for name in chosen:
                (self.root / name).write_bytes(written(self.files[name]))

    def _names(self, message: str) -> bool:
        """Whether the message says where: in this folder, or in a file that the damaged one names."""
        return str(self.root) in message or "/dev/null" in message

    def _examine(self, seed: int, chosen: list[str]) -> str:
        said = f"seed {seed}: {', '.join(chosen)}: "
        try:
            dataset = load(self.root)
        except DataError as error:
            message = str(error)
            assert message.isprintable() and len(message) < 500 and self._names(message), said + repr(message)
            return "refused"
        except BaseException as error:
            raise AssertionError(f"{said}{type(error).__name__}: {error}") from error
        numbers = [dataset.box, dataset.near, dataset.far, dataset.background, dataset.time_range, dataset.up]
        numbers += [x for view in (*dataset.train, *dataset.test) for x in (view.viewmat, view.K, view.time)]
        for x in numbers:
            assert (np.abs(np.asarray(x, np.float64)) <= BINARY32).all(), said + repr(x)
        return "read"


KINDS: dict[str, Callable[[], dict[str, Any]]] = {"blender": blender_files, "iphone": iphone_files}


def check_cases(tmp_path: Path, kind: str, seeds: range) -> dict[str, int]:
    folder, counts = Folder(tmp_path / "set", KINDS[kind]()), {"read": 0, "refused": 0}
    assert folder._examine(-1, []) == "read"
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # a warning on the terminal is no answer
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        for seed in seeds:
            counts[folder.try_damage(seed)] += 1
    shutil.rmtree(folder.root)
    return counts


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_datasets(tmp_path, kind):
    counts = check_cases(tmp_path, kind, range(250))
    assert min(counts.values()) > 20  # the damage is neither harmless nor fatal throughout


@pytest.mark.slow
@pytest.mark.parametrize("part", range(10))
@pytest.mark.parametrize("kind", KINDS)
def test_twenty_thousand_damaged_datasets(tmp_path, kind, part):
    check_cases(tmp_path, kind, range(1000 * part, 1000 * (part + 1)))
