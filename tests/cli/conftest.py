"""A small scene as a checkpoint and as a `.pd4`, a small dataset, and a way to call the commands."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

FRAMES, WIDTH, HEIGHT = 6, 32, 24


@dataclass(frozen=True)
class Result:
    """What a command did."""

    code: int
    out: bytes
    err: str

    @property
    def json(self) -> dict:
        return json.loads(self.out)

    @property
    def error_lines(self) -> list[str]:
        return self.err.splitlines()


@pytest.fixture(autouse=True)
def _one_thread(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "1")


@pytest.fixture
def cli(capfdbinary, monkeypatch) -> Callable[..., Result]:
    """cli("info", path, "--json", stdin=b"...") -> Result."""

    def call(verb: str, *argv: object, stdin: bytes | None = None) -> Result:
        import io

        if stdin is not None:
            stream = SimpleNamespace(buffer=io.BytesIO(stdin), isatty=lambda: False)
            monkeypatch.setattr("sys.stdin", stream)
        capfdbinary.readouterr()
        code = import_module(f"pd4dgs_codec.cli.{verb}").main([str(a) for a in argv])
        out, err = capfdbinary.readouterr()
        return Result(code, out, err.decode())

    return call


def _network(rng: np.random.Generator, *widths: int, scale: float = 0.3):
    pairs = zip(widths, widths[1:], strict=False)
    return tuple(
        (rng.normal(0, scale, (b, a)).astype(np.float32), rng.normal(0, scale, b).astype(np.float32)) for a, b in pairs
    )


def _deformation(rng: np.random.Generator, heads: dict[str, int]):
    from pd4dgs_codec.scene import PLANES, Deformation

    reso = (3, 4, 5, 6)
    planes = tuple(
        {name: rng.normal(1, 0.3, (2, reso[b], reso[a])).astype(np.float32) for name, a, b in PLANES} for _ in range(2)
    )
    networks = {"trunk": _network(rng, 4, 8, 8)}
    return Deformation(planes, networks | {name: _network(rng, 8, width, scale=0.05) for name, width in heads.items()})


@pytest.fixture(scope="session")
def scene():
    """60 anchors, three layers, in front of the camera that the dataset's first frame has."""
    from pd4dgs_codec.scene import GLOBAL_HEADS, LOCAL_HEADS, SCAFFOLD_NETWORKS, Camera, Scene, SceneInfo, Steps

    rng = np.random.default_rng(5)
    n, rows = 60, (40, 50, 60)
    cells = np.unique(rng.integers(-20, 20, (200, 3)), axis=0)
    viewmat = np.eye(4, dtype=np.float32)
    viewmat[2, 3] = 3
    K = np.array([[30, 0, WIDTH / 2], [0, 30, HEIGHT / 2], [0, 0, 1]], np.float32)
    info = SceneInfo(
        voxel_size=float(np.float32(0.05)),
        box=np.array([[-1, -1, -1], [1, 1, 1]], np.float32),
        time_range=(0.0, 2.0),
        background=(1.0, 1.0, 1.0),
        near=float(np.float32(0.1)),
        far=10.0,
        up=(0.0, -1.0, 0.0),
        unit=0.0,
        camera=Camera(viewmat, K, WIDTH, HEIGHT),
    )
    return Scene(
        info=info,
        steps=Steps().scaled(1.0),
        layers=(0, 1, 2),
        rows=rows,
        anchor_q=rng.permutation(cells)[:n].astype(np.int32),
        feature=rng.normal(0, 0.5, (n, 32)).astype(np.float32),
        scaling_log=rng.normal(-2.5, 0.3, (n, 6)).astype(np.float32),
        offset=rng.normal(0, 0.5, (n, 10, 3)).astype(np.float32),
        mask=tuple(np.full(r, 200, np.uint8) for r in rows),
        networks={name: _network(rng, 35, 16, width) for name, width in SCAFFOLD_NETWORKS.items()},
        global_deformation=_deformation(rng, GLOBAL_HEADS),
        local_deformation=_deformation(rng, LOCAL_HEADS),
    )


@pytest.fixture(scope="session")
def shared_folder(tmp_path_factory, scene) -> Path:
    """Holds model.pt and scene.pd4; tests read it and never write there."""
    from pd4dgs_codec.codec.encoder import encode
    from pd4dgs_codec.model import checkpoint
    from pd4dgs_codec.model.convert import from_scene

    folder = tmp_path_factory.mktemp("files")
    checkpoint.save(folder / "model.pt", from_scene(scene))
    (folder / "scene.pd4").write_bytes(encode(scene, effort=1))
    return folder


@pytest.fixture(scope="session")
def model_pt(shared_folder) -> Path:
    return shared_folder / "model.pt"


@pytest.fixture(scope="session")
def scene_pd4(shared_folder) -> Path:
    return shared_folder / "scene.pd4"


def write_dataset(folder: Path) -> Path:
    """A Blender-style folder of FRAMES noisy pictures from cameras on a short line, looking at the origin."""
    from PIL import Image

    rng = np.random.default_rng(3)
    folder.mkdir(parents=True)
    frames = []
    for i in range(FRAMES):
        picture = rng.integers(0, 255, (HEIGHT // 4, WIDTH // 4, 3), dtype=np.uint8).repeat(4, 0).repeat(4, 1)
        Image.fromarray(picture).save(folder / f"{i:03d}.png")
        pose = [[1, 0, 0, 0.1 * i], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]
        frames.append({"file_path": f"{i:03d}.png", "time": i / (FRAMES - 1), "transform_matrix": pose})
    content = {"fl_x": 30.0, "fl_y": 30.0, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content, indent=1))
    return folder


@pytest.fixture(scope="session")
def shared_dataset(tmp_path_factory) -> Path:
    return write_dataset(tmp_path_factory.mktemp("data") / "set")


@pytest.fixture
def dataset(tmp_path) -> Path:
    """A dataset that a test may damage."""
    return write_dataset(tmp_path / "set")
