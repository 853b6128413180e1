"""Damaged datasets: each is read into finite numbers or refused in one line.

A seed replaces, removes, nests or enlarges values in JSON files, words in PLY and text files and numbers in headers; or
it changes bytes or cuts a file.
"""

import copy
import json
import random
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from test_dataset_broken import LAYOUTS, VIDEOS

from pd4dgs_codec.data.dataset import load
from pd4dgs_codec.errors import DataError

KINDS = [kind for kind in LAYOUTS if kind not in VIDEOS]
MANY = [range(500 * part, 500 * (part + 1)) for part in range(10)]
VALUES: list[Any] = [
    *(None, True, False, 0, -1, 1, 2, 0.5, -0.0, 1e-300, 1e300, -1e300, 1e38, 3e38, float("nan"), float("inf")),
    *(65_536, 2**31, 10**40, "", "0", "\0", "r_000", "../r_000", "/dev/null", "é\ud800", "x" * 5000, "FISHEYE"),
    *([], {}, [1], [[]], [1e300] * 3, [0, 0, 0], [[1, 2], [3]], {"0": 1}, [9, 9, 9, 9], [[[1.0] * 4] * 4]),
]  # fmt: skip
WORDS = b"ply -1 2 0 vertex face ascii binary_little_endian binary_big_endian list uchar double x y nan inf".split()
WORDS += [b"1e300", b"property", b"element", b"end_header", b"\n", b"\0", b"9" * 5000]


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
    if kind == 1 and (data.startswith(b"ply") or data[:1] == b"#"):
        words = data.split(b" ")
        words[rng.randrange(len(words))] = rng.choice(WORDS)
        return b" ".join(words)
    if kind == 2:  # four bytes of a header, which count or measure something there
        place = rng.randrange(min(len(data), 64) or 1)
        four = rng.choice([b"\xff" * 4, bytes(4), b"\0\0\xff\xff", b"\x7f\xff\xff\xff"])
        return data[:place] + four + data[place + 4 :]
    changed = bytearray(data)
    for _ in range(rng.choice([1, 1, 3])):
        if changed:
            changed[rng.randrange(len(changed))] = rng.randrange(256)
    return bytes(changed)


def written(content: Any) -> bytes:
    return content if isinstance(content, bytes) else json.dumps(content).encode("ascii")


def parsed(path: Path) -> Any:
    """A file's JSON, or its bytes."""
    return json.loads(path.read_bytes()) if path.suffix == ".json" or path.name == "metadata" else path.read_bytes()


BINARY32 = float(np.finfo(np.float32).max)


class Folder:
    """A whole dataset on the disk, of which single files are damaged and mended again."""

    def __init__(self, root: Path):
        self.root = root
        files = sorted(path for path in root.rglob("*") if path.is_file())
        self.files = {path.relative_to(root).as_posix(): parsed(path) for path in files}
        self.heads = [name for name in self.files if not name.endswith(".png")]

    def try_damage(self, seed: int) -> str:
        """The result of one damaged copy: "read" or "refused"."""
        rng = random.Random(seed)
        names = list(self.files)
        chosen = [rng.choice(names if rng.random() < 0.3 else self.heads)]
        if rng.random() < 0.2:
            chosen.append(rng.choice(names))
        try:
            for name in chosen:
                content = self.files[name]
                if isinstance(content, bytes) or rng.random() < 0.1:
                    (self.root / name).write_bytes(damage_bytes(written(content), rng))
                else:
                    (self.root / name).write_bytes(written(damage_json(content, rng)))
            return self.examine(f"seed {seed}: {', '.join(chosen)}")
        finally:
            for name in chosen:
                (self.root / name).write_bytes(written(self.files[name]))

    def examine(self, case: str) -> str:
        """Returns "read" or "refused". An error names the folder, or a file that the damaged one names."""
        try:
            dataset = load(self.root)
        except DataError as error:
            message = str(error)
            assert message.isprintable() and len(message) < 500, f"{case}: {message!r}"
            assert str(self.root) in message or "/dev/null" in message, f"{case}: {message!r}"
            return "refused"
        except BaseException as error:
            raise AssertionError(f"{case}: {type(error).__name__}: {error}") from error
        numbers = [dataset.box, dataset.near, dataset.far, dataset.background, dataset.time_range, dataset.up]
        numbers += [x for view in (*dataset.train, *dataset.test) for x in (view.viewmat, view.K, view.time)]
        for x in numbers:
            assert (np.abs(np.asarray(x, np.float64)) <= BINARY32).all(), f"{case}: {x!r}"
        return "read"


@pytest.mark.parametrize("seeds", [range(40), *(pytest.param(many, marks=pytest.mark.slow) for many in MANY)])
@pytest.mark.parametrize("kind", KINDS)
def test_damaged_datasets(scene, tmp_path, kind, seeds):
    folder, counts = Folder(LAYOUTS[kind](scene, tmp_path / "set")), {"read": 0, "refused": 0}
    assert folder.examine("whole") == "read"
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # a warning on the terminal is no answer
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        for seed in seeds:
            counts[folder.try_damage(seed)] += 1
    assert min(counts.values()) > 2, counts  # the damage is neither harmless nor fatal throughout
