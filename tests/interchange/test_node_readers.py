"""Exported files as splat-transform (PlayCanvas, Node) reads and writes them.

It is looked for in the `node_modules` that PD4DGS_NODE_MODULES names, else in that of the checkout's root:
`npm install --ignore-scripts @playcanvas/splat-transform@3.7.0`.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from test_formats import make_splats

from pd4dgs_codec.interchange.formats import glb_bytes, ply_bytes, spz_bytes
from pd4dgs_codec.interchange.splats import Splats, harmonics, unit

MODULES = Path(os.environ.get("PD4DGS_NODE_MODULES", Path(__file__).parents[2] / "node_modules"))
PROGRAM = MODULES / "@playcanvas" / "splat-transform" / "bin" / "cli.mjs"
pytestmark = pytest.mark.skipif(
    not (shutil.which("node") and PROGRAM.is_file()), reason=f"node and {PROGRAM} are needed"
)


def transform(source: Path, target: Path) -> Path:
    done = subprocess.run(["node", PROGRAM, "-w", source, target], capture_output=True, text=True, timeout=600)
    assert done.returncode == 0 and target.is_file(), done.stdout + done.stderr
    return target


def table(path: Path) -> dict[str, np.ndarray]:
    """A CSV file's columns by name."""
    names = path.read_text().split("\n", 1)[0].split(",")
    return dict(zip(names, np.loadtxt(path, delimiter=",", skiprows=1, dtype=np.float64).T, strict=True))


def columns(found: dict[str, np.ndarray], *names: str) -> np.ndarray:
    return np.stack([found[name] for name in names], axis=1)


@pytest.mark.parametrize("kind", ["ply", "spz"])
def test_splat_transform_reads_each_number(kind, tmp_path):
    if kind == "spz":
        pytest.importorskip("gaussforge")
    splats = make_splats()
    source = tmp_path / f"scene.{kind}"
    source.write_bytes((ply_bytes if kind == "ply" else spz_bytes)(splats))
    found = table(transform(source, tmp_path / "scene.csv"))
    exact = kind == "ply"
    np.testing.assert_allclose(columns(found, "x", "y", "z"), splats.means, atol=1e-6 if exact else 1 / 4096)
    scales = np.exp(columns(found, "scale_0", "scale_1", "scale_2"))
    np.testing.assert_allclose(scales, splats.scales, rtol=1e-5 if exact else 0.04)
    opacities = 1 / (1 + np.exp(-found["opacity"]))
    np.testing.assert_allclose(opacities, splats.opacities, atol=1e-6 if exact else 1 / 255)
    dots = np.abs(np.einsum("nd,nd->n", columns(found, "rot_0", "rot_1", "rot_2", "rot_3"), splats.quats))
    assert dots.min() > (1 - 1e-6 if exact else 0.999)
    base = columns(found, "f_dc_0", "f_dc_1", "f_dc_2")
    np.testing.assert_allclose(base, splats.sh[:, 0], atol=1e-6 if exact else 0.03)
    rest = columns(found, *(f"f_rest_{i}" for i in range(45))).reshape(-1, 3, 15).transpose(0, 2, 1)
    np.testing.assert_allclose(rest, splats.sh[:, 1:], atol=1e-6 if exact else 0.07)


def test_splat_transform_writes_the_same_glb(tmp_path):
    """It turns a PLY half around z, for +y to be up. Each attribute is that of ours, turned by hand."""
    pygltflib = pytest.importorskip("pygltflib")
    splats = make_splats()
    (tmp_path / "scene.ply").write_bytes(ply_bytes(splats))
    theirs = transform(tmp_path / "scene.ply", tmp_path / "theirs.glb")
    ours = tmp_path / "ours.glb"
    w, x, y, z = splats.quats.T
    direction = unit(np.array([[0.3, 0.5, 0.7]]))
    before, after = (harmonics(d, 3)[0] for d in (direction, direction * (-1, -1, 1)))
    turned = Splats(
        splats.means * np.float32([-1, -1, 1]), np.stack([-z, -y, x, w], axis=1), splats.scales, splats.opacities,
        (splats.sh * np.sign(before * after)[:, None]).astype(np.float32),
    )  # fmt: skip
    ours.write_bytes(glb_bytes(turned))

    def attributes(path: Path) -> dict[str, np.ndarray]:
        document = pygltflib.GLTF2().load(str(path))
        result = {}
        for name, index in vars(document.meshes[0].primitives[0].attributes).items():
            if index is not None and name != "COLOR_0":  # for viewers that know no splats
                row = document.accessors[index]
                view = document.bufferViews[row.bufferView]
                width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[row.type]
                start = view.byteOffset + (row.byteOffset or 0)
                values = np.frombuffer(document.binary_blob(), "<f4", row.count * width, start)
                result[name] = values.reshape(-1, width)
        return result

    mine, others = attributes(ours), attributes(theirs)
    assert mine.keys() == others.keys() and len(mine) == 4 + 16
    for name, values in mine.items():
        if name.endswith("ROTATION"):
            assert np.abs(np.einsum("nd,nd->n", values, others[name])).min() > 1 - 1e-6
        else:
            np.testing.assert_allclose(values, others[name], atol=1e-5, err_msg=name)
