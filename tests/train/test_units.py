"""A scene trains alike in any unit of length and at any place."""

import json

import numpy as np
import pytest
from PIL import Image
from runs import trainer_of
from tiny import disc

from pd4dgs_codec import encode
from pd4dgs_codec.data.dataset import load
from pd4dgs_codec.data.view import OPENGL_TO_OPENCV
from pd4dgs_codec.model import checkpoint
from pd4dgs_codec.model.model import to_scene

POINTS = np.random.default_rng(1).uniform((-1.5, -1.2, -1), (1.5, 1.2, 1), (150, 3))
HEADER = (
    "ply\nformat ascii 1.0\nelement vertex {}\nproperty double x\nproperty double y\nproperty double z\nend_header\n"
)


def write_disc(folder, scale: float, place: float):
    """A folder of the disc's views and of points, with the world's lengths times `scale`, moved to `place`."""
    folder.mkdir()
    frames, to_place = [], place * np.array([1.0, 0.7, -0.2])
    for i, view in enumerate(disc(tuple(np.linspace(0.1, 0.9, 5))).train):
        Image.fromarray(view.image).save(folder / f"{i}.png")
        rotation, centre = view.viewmat[:3, :3].T, -view.viewmat[:3, :3].T.astype(np.float64) @ view.viewmat[:3, 3]
        pose = np.column_stack([rotation @ OPENGL_TO_OPENCV, centre * scale + to_place])
        frames.append({"file_path": f"{i}.png", "time": view.time, "transform_matrix": [*pose.tolist(), [0, 0, 0, 1]]})
    lines = "".join(" ".join(map(repr, p)) + "\n" for p in (POINTS * scale + to_place).tolist())
    (folder / "points.ply").write_text(HEADER.format(len(POINTS)) + lines)
    keys = {"fl_x": 30.0, "cx": 16.0, "cy": 12.0, "w": 32, "h": 24, "ply_file_path": "points.ply"}
    (folder / "transforms.json").write_text(json.dumps(keys | {"frames": frames}))
    return load(folder, holdout=0)


def trained(folder, scale: float = 1.0, place: float = 0.0) -> tuple[list[float], int, float]:
    """(dB by level, bytes of the file, distance of the farthest anchor from 0 in sides of the box)."""
    data = write_disc(folder, scale, place)
    trainer = trainer_of(data, 150)
    trainer.run(folder / "m.pt")
    model = checkpoint.load(folder / "m.pt")[0]
    far = float(model.anchor.abs().max()) / float((data.box[1] - data.box[0]).max())
    return trainer.learner.level_psnr(data.train), len(encode(to_scene(model), effort=1)), far


@pytest.fixture(scope="module")
def as_usual(tmp_path_factory):
    from tiny import TINY

    from pd4dgs_codec.model.config import PRESETS

    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(PRESETS, "tiny", TINY)
        return trained(tmp_path_factory.mktemp("units") / "usual")


@pytest.mark.parametrize("scale, place", [(1e-4, 0), (1e-3, 0), (1e3, 0), (1e6, 0), (1, 1e5), (1e-3, 1e5)])
def test_a_scene_trains_alike_in_any_unit_and_at_any_place(as_usual, tmp_path, scale, place):
    psnr, size, far = trained(tmp_path / "given", scale, place)
    assert psnr == pytest.approx(as_usual[0], abs=0.5) and as_usual[0][2] > 19
    assert size == pytest.approx(as_usual[1], rel=0.03) and far < 101
