"""What `pd4dgs-export` writes, parsed here or by fourdgs, is what the scene shows at that time."""

import gzip
import json
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from explicit import covariances
from tiny import sighted, trained_like_scene

from pd4dgs_codec.draw.player import Player
from pd4dgs_codec.format.decoder import decode
from pd4dgs_codec.format.encoder import encode
from pd4dgs_codec.kinds.splats import SH_C0, harmonics, unit
from pd4dgs_codec.scene import MIN_OPACITY, Gaussians, Scene

UP, SECONDS = (0.3, -0.8, 0.5), 2.0
EYE = np.array([0.4, -0.3, -2.7])
#: Most differences of positions, covariances relative to their largest entry, opacities and colours, by kind. SPZ has
#: 12 fractional bits of positions, 16 scales per factor e, and bytes for the rest; harmonics of degree 3 come to .01.
EXACT = (1e-6, 1e-5, 1e-6, 0.01)
BOUNDS = {
    "ply": EXACT,
    "ply-seq": EXACT,
    "glb": EXACT,
    "spz": (2e-4, 0.07, 0.003, 0.08),
    "4dgs": (4e-3, 0.06, 0.005, 0.05),
}


@dataclass
class Read:
    """Gaussians of a file, with the scales and opacities themselves and quaternions wxyz."""

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    sh: np.ndarray  #: [N, J, 3]

    @property
    def covariances(self) -> np.ndarray:
        """[N, 3, 3]."""
        return covariances(self.quats, self.scales)

    def colors(self, eye: np.ndarray, degree: int = 3) -> np.ndarray:
        """[N, 3] seen from `eye`, by the harmonics up to a degree."""
        basis = harmonics(unit(self.means.astype(float) - eye), degree)
        return np.maximum(np.einsum("nj,njc->nc", basis, self.sh[:, : basis.shape[1]]) + 0.5, 0)


def ply(raw: bytes) -> Read:
    """The layout of 3D Gaussian Splatting: all floats, harmonics channel by channel."""
    head, body = raw.split(b"end_header\n", 1)
    lines = head.decode().splitlines()
    names = [line.split()[2] for line in lines if line.startswith("property float ")]
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"] and len(lines) == 3 + len(names)
    table = np.frombuffer(body, "<f4").reshape(int(lines[2].removeprefix("element vertex ")), len(names))
    column = dict(zip(names, table.T, strict=True))
    count = sum(name.startswith("f_rest_") for name in names) // 3

    def stack(prefix: str, keys: Any) -> np.ndarray:
        return np.stack([column[f"{prefix}{key}"] for key in keys], axis=1)

    sh = [stack("f_", [f"dc_{c}", *(f"rest_{c * count + j}" for j in range(count))]) for c in range(3)]
    opacities, scales = (
        1 / (1 + np.exp(-column["opacity"].astype(float))),
        np.exp(stack("scale_", range(3)).astype(float)),
    )
    return Read(stack("", "xyz"), stack("rot_", range(4)), scales, opacities, np.stack(sh, axis=2))


def glb(raw: bytes) -> Read:
    """KHR_gaussian_splatting: float accessors, quaternions xyzw, scales and opacities themselves."""
    magic, version, size, length, kind = struct.unpack_from("<4sIIII", raw)
    assert (magic, version, size, kind) == (b"glTF", 2, len(raw), 0x4E4F534A) and length % 4 == 0
    document, blob = json.loads(raw[20 : 20 + length]), raw[28 + length :]
    assert struct.unpack_from("<II", raw, 20 + length) == (len(blob), 0x004E4942)
    (primitive,), found = document["meshes"][0]["primitives"], {}
    for name, index in primitive["attributes"].items():
        row = document["accessors"][index]
        start, width = (
            document["bufferViews"][row["bufferView"]]["byteOffset"],
            int(row["type"].removeprefix("VEC").replace("SCALAR", "1")),
        )
        found[name.split(":")[-1]] = np.frombuffer(blob, "<f4", row["count"] * width, start).reshape(-1, width)
    position = document["accessors"][primitive["attributes"]["POSITION"]]
    np.testing.assert_array_equal(
        np.float32([position["min"], position["max"]]), [f(found["POSITION"], axis=0) for f in (np.min, np.max)]
    )
    display, opacities = found["COLOR_0"], found["OPACITY"][:, 0]  # linear light, for viewers of points
    sh = np.stack([found[f"SH_DEGREE_{d}_COEF_{i}"] for d in range(4) for i in range(2 * d + 1)], axis=1)
    shown = np.clip(0.5 + SH_C0 * sh[:, 0], 0, 1)
    np.testing.assert_allclose(
        np.where(display[:, :3] <= 0.0031308, 12.92 * display[:, :3], 1.055 * display[:, :3] ** (1 / 2.4) - 0.055),
        shown,
        atol=1e-5,
    )
    np.testing.assert_array_equal(display[:, 3], opacities)
    return Read(found["POSITION"], found["ROTATION"][:, [3, 0, 1, 2]], found["SCALE"], opacities, sh)


def spz(raw: bytes) -> Read:
    """SPZ 3: one array after the other; positions in 24 bits, the three smallest components of quaternions xyzw."""
    data = gzip.decompress(raw)
    magic, version, count, degree, bits = struct.unpack_from("<4sIIBB", data)
    assert (magic, version, degree) == (b"NGSP", 3, 3)
    widths = (9, 1, 3, 3, 4, 45)
    assert len(data) == 16 + sum(widths) * count
    ends = 16 + count * np.cumsum(widths)
    parts = [
        np.frombuffer(data[e - w * count : e], "u1").reshape(count, w).astype(int)
        for e, w in zip(ends, widths, strict=True)
    ]
    positions, opacities, colors, scales, rotations, sh = parts
    fixed = positions.reshape(count, 3, 3) @ (1, 1 << 8, 1 << 16)
    means = np.where(fixed >= 1 << 23, fixed - (1 << 24), fixed) / (1 << bits)
    quats = np.zeros((count, 4))
    for quat, word in zip(quats, rotations @ (1, 1 << 8, 1 << 16, 1 << 24), strict=True):
        largest = word >> 30
        for place, i in enumerate([i for i in (3, 2, 1, 0) if i != largest]):  # 9 bits and a sign each, the last first
            part = word >> 10 * place & 1023
            quat[i] = (part & 511) / 511 * 0.5**0.5 * (-1 if part >> 9 else 1)
        quat[largest] = np.sqrt(1 - np.square(quat).sum())
    first = (colors / 255 - 0.5) / 0.15
    sh = np.concatenate([first[:, None], (sh.reshape(count, 15, 3) - 128) / 128], axis=1)
    return Read(means, quats[:, [3, 0, 1, 2]], np.exp(scales / 16 - 10), opacities[:, 0] / 255, sh)


def fourdgs_at(raw: bytes, seconds: float) -> Read:
    """A .4dgs file at a time, by fourdgs; bytes of harmonics stand for -4 to 4, channel by channel."""
    scene = pytest.importorskip("fourdgs").read(raw)
    state, g = scene.state_at(seconds), scene.gaussians
    rows = state["indices"]
    first = (g.colors[rows, :3] - 0.5) / SH_C0
    rest = (g.sh[rows].reshape(len(rows), 3, 15).transpose(0, 2, 1) * (8 / 255)) - 4
    sh = np.concatenate([first[:, None], rest], axis=1)
    return Read(state["centers"], state["orientations"][:, [3, 0, 1, 2]], g.scales[rows], state["opacity"], sh)


def upright() -> np.ndarray:
    """The smallest rotation from UP to +y, by Rodrigues."""
    a = np.array(UP) / np.linalg.norm(UP)
    x, y, z = np.cross(a, (0, 1, 0))
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + k + k @ k / (1 + a[1])


def shown(player: Player, t: float) -> Gaussians:
    """The scene's Gaussians from EYE."""
    g = player.gaussians_of_eyes(player.active, t, EYE[None].astype(np.float32))
    return Gaussians(*(part[g.opacities >= MIN_OPACITY] for part in vars(g).values()))


def check(read: Read, g: Gaussians, turn: np.ndarray, bounds: tuple[float, ...]) -> None:
    """Asserts that the file's Gaussians are those of the scene, turned, up to `bounds`."""
    place, shape, opacity, color = bounds
    here = [g.means @ turn.T / place, g.opacities[:, None] / opacity, g.colors / color]
    there = [read.means / place, read.opacities[:, None] / opacity, read.colors(EYE @ turn.T) / color]
    difference = np.abs(np.hstack(here)[:, None] - np.hstack(there)).max(axis=2)  # 1 is the most of all
    rows = difference.argmin(axis=1)
    assert len(read.means) == len(g.means) == len(np.unique(rows))
    assert difference.min(axis=1).max() < 1
    expected = turn @ covariances(g.quats, g.scales) @ turn.T
    off = np.abs(read.covariances[rows] - expected).max(axis=(1, 2)) / np.abs(expected).max(axis=(1, 2))
    assert off.max() < shape and np.abs(np.linalg.norm(read.quats, axis=1) - 1).max() < 1e-5


def written(scene: Scene, tmp_path: Path) -> tuple[Path, Player]:
    """The scene as a file, and its player."""
    scene = replace(scene, info=replace(scene.info, up=UP, time_range=(0.5, 0.5 + SECONDS)))
    path = tmp_path / "scene.pd4"
    path.write_bytes(encode(scene, effort=1))
    return path, Player(decode(path.read_bytes()))


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> tuple[Path, Player]:
    """Of a scene whose colours alone depend on the view, so that the rest is exact."""
    return written(sighted(trained_like_scene(), "color"), tmp_path_factory.mktemp("scene"))


STILLS: dict[str, Callable[[bytes], Read]] = {"ply": ply, "glb": glb, "spz": spz}


@pytest.mark.parametrize("t", [0, 0.13, 1])
@pytest.mark.parametrize("kind", STILLS)
def test_an_instant_is_the_scenes(cli, scene, tmp_path, kind, t):
    if kind == "spz":
        pytest.importorskip("gaussforge")
    path, player = scene
    out = tmp_path / f"scene.{kind}"
    assert cli("export", path, "-o", out, "--time", t).code == 0
    read, turn = STILLS[kind](out.read_bytes()), np.eye(3) if kind == "ply" else upright()
    check(read, shown(player, t), turn, BOUNDS[kind])
    eye = EYE @ turn.T
    assert np.abs(read.colors(eye) - read.colors(eye, degree=0)).max() > 0.1, "harmonics count"


@pytest.mark.parametrize("kind", ["ply-seq", "4dgs"])
def test_each_frame_is_the_scenes(cli, scene, tmp_path, kind):
    path, player = scene
    out = tmp_path / f"scene.{kind}"
    assert cli("export", path, "-o", out, "--to", kind, "--fps", 4).code == 0
    for i in (0, 3, 8):  # 9 frames of two seconds
        read = ply((out / f"{i:05d}.ply").read_bytes()) if kind == "ply-seq" else fourdgs_at(out.read_bytes(), i / 4)
        check(read, shown(player, i / 4 / SECONDS), np.eye(3), BOUNDS[kind])
    if kind == "4dgs":  # between frames positions alone change
        first, later, last = (fourdgs_at(out.read_bytes(), t) for t in (0.5, 0.5 + 0.9 / 4, 0.75))
        np.testing.assert_array_equal(later.opacities, first.opacities)
        np.testing.assert_array_equal(later.covariances, first.covariances)
        goal = shown(player, 0.75 / SECONDS).means
        nearest = [np.abs(goal[:, None] - read.means[None]).max(axis=2).min(axis=1) for read in (first, later, last)]
        assert np.median(nearest[1]) < 0.2 * np.median(nearest[0]) and nearest[2].max() < BOUNDS["4dgs"][0]


def extreme(name: str) -> Scene:
    """Scenes at an end of what a file can hold."""
    scene = sighted(trained_like_scene(), "color")
    if name == "layer 0":
        return scene.prefix(0)
    if name == "one anchor":
        arrays = {key: getattr(scene, key)[:1] for key in ("anchor_q", "feature", "scaling_log", "offset")}
        return replace(scene.prefix(0), rows=(1,), mask=(scene.mask[0][:1],), **arrays)
    if name == "opaque":
        *rest, (weight, bias) = scene.networks["opacity"]
        return replace(
            scene,
            networks=scene.networks | {"opacity": (*rest, (weight, bias + 30))},
            mask=tuple(np.full(r, 255, np.uint8) for r in scene.rows),
        )
    scaling = scene.scaling_log.copy()
    scaling[:, {"flat": slice(4, 5), "needles": slice(4, 6), "huge": slice(3, 6)}[name]] += 8 if name == "huge" else -30
    return replace(scene, scaling_log=scaling)


EXTREMES = ("layer 0", "one anchor", "opaque", "flat", "needles", "huge")


@pytest.mark.parametrize("name", EXTREMES)
@pytest.mark.parametrize("kind", STILLS)
def test_extreme_scenes(cli, tmp_path, kind, name):
    if kind == "spz":
        pytest.importorskip("gaussforge")
    path, player = written(extreme(name), tmp_path)
    out = tmp_path / f"out.{kind}"
    done = cli("export", path, "-o", out, "--time", 0.5)
    assert done.code == 0, done.err
    read, turn = STILLS[kind](out.read_bytes()), np.eye(3) if kind == "ply" else upright()
    check(read, shown(player, 0.5), turn, BOUNDS[kind])
    told = re.search(r"warning: \d+ Gaussians are larger than 379 units, to which SPZ shrinks them; --scale", done.err)
    assert bool(told) == ((kind, name) == ("spz", "huge"))


@pytest.mark.parametrize("name", EXTREMES)
def test_extreme_scenes_over_time(cli, tmp_path, name):
    pytest.importorskip("fourdgs")
    path, player = written(extreme(name), tmp_path)
    out = tmp_path / "out.4dgs"
    done = cli("export", path, "-o", out, "--fps", 1)
    if name == "needles":
        found = (
            r"fourdgs cannot write Gaussians 2\.\d+ units apart, with a median scale of \S+e-\d+: symbol \d+ exceeds"
        )
        assert done.code == 1 and re.search(found, done.err) and not out.exists()
        return
    assert done.code == 0, done.err
    read, g = fourdgs_at(out.read_bytes(), 1.0), shown(player, 0.5)
    if name == "huge":  # steps of positions are a tenth of the median scale, so that all seem to be at one place
        assert len(read.means) == len(g.means) and np.ptp(read.means) < 0.1 * np.median(g.scales)
    else:
        check(read, g, np.eye(3), BOUNDS["4dgs"])
