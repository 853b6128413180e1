"""Exported glTF files beside those of splat-transform (PlayCanvas, Node).

It is looked for in the `node_modules` that PD4DGS_NODE_MODULES names, else in that of the checkout's root:
`npm install --ignore-scripts @playcanvas/splat-transform@3.7.0`.
"""

import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from test_formats import make_splats, read_glb

from pd4dgs_codec.interchange.splats import Splats, glb_bytes, harmonics, ply_bytes, unit

MODULES = Path(os.environ.get("PD4DGS_NODE_MODULES", Path(__file__).parents[2] / "node_modules"))
PROGRAM = MODULES / "@playcanvas" / "splat-transform" / "bin" / "cli.mjs"
pytestmark = pytest.mark.skipif(
    not (shutil.which("node") and PROGRAM.is_file()), reason=f"node and {PROGRAM} are needed"
)


def transform(source: Path, target: Path) -> Path:
    done = subprocess.run(["node", PROGRAM, "-w", source, target], capture_output=True, text=True, timeout=600)
    assert done.returncode == 0 and target.is_file(), done.stdout + done.stderr
    return target


def test_splat_transform_writes_the_same_glb(tmp_path):
    """It turns a PLY half around z, for +y to be up. Each attribute is that of ours, turned by hand."""
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

    (_, mine), (_, others) = map(read_glb, (ours, theirs))
    assert mine.keys() == others.keys() and len(mine) == 4 + 16
    for name, values in mine.items():
        if name.endswith("ROTATION"):
            assert np.abs(np.einsum("nd,nd->n", values, others[name])).min() > 1 - 1e-6
        else:
            np.testing.assert_allclose(values, others[name], atol=1e-5, err_msg=name)
