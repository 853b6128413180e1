"""Slices bring first what the pictures gain by, and the report and the metadata say by what it was judged."""

from dataclasses import replace

import numpy as np
import pytest
from strategies import make_scene

from pd4dgs_codec.data.view import View
from pd4dgs_codec.format.decoder import decode
from pd4dgs_codec.format.info import hashes, info, metadata_of
from pd4dgs_codec.format.options import EncodeOptions
from pd4dgs_codec.model.utility import utility, without
from pd4dgs_codec.quality.packing import Views, pack
from pd4dgs_codec.scene import Camera

SLICED = EncodeOptions(effort=1, slices=1500)


def camera():
    viewmat = np.eye(4, dtype=np.float32)
    viewmat[2, 3] = 3.0
    return Camera(viewmat, np.array([[20, 0, 12], [0, 20, 8], [0, 0, 1]], np.float32), 24, 16)


@pytest.fixture(scope="module")
def scene():
    found = make_scene(3, anchors=90)
    return replace(found, info=replace(found.info, camera=camera()))


def test_without_a_camera_the_largest_come_first(scene):
    packed = pack(replace(scene, info=replace(scene.info, camera=None)), SLICED)
    assert packed.slices == {"order": "gate times area", "cameras": None, "pictures": 0}


def test_the_files_own_camera_decides(scene):
    packed = pack(scene, SLICED)
    assert packed.json()["slices"] == {
        "order": "rendered gain per byte",
        "cameras": "the file's own camera",
        "pictures": 16,
    }
    assert hashes(packed.data) == hashes(pack(scene, replace(SLICED, slices=0)).data)
    assert metadata_of(packed.data) is None


def test_views_held_out_are_scored_after_each_slice(scene):
    own = camera()
    picture = np.full((16, 24, 3), 90, np.uint8)
    view = View(
        viewmat=own.viewmat, K=own.K, width=24, height=16, time=0.5, image=picture, mask=None, name="one", camera_id=0
    )
    packed = pack(scene, SLICED, views=Views("made up", (view,), (view,)), min_gain=0)
    slices = sum(len(row["slices"]) for row in info(packed.data)["layers"])
    assert slices > 3 and len(packed.slices["psnr"]) == slices
    np.testing.assert_allclose(metadata_of(packed.data).slices, packed.slices["psnr"], rtol=1e-6)
    assert packed.report.bytes == len(packed.data) and packed.report.metadata_bytes > 20
    decode(packed.data)


def test_anchors_that_show_nothing_are_worth_least(scene):
    values = utility(scene, [(camera(), 0.0), (camera(), 1.0)])
    assert values.shape == (len(scene.anchor_q),) and np.isfinite(values).all()
    hidden = scene.mask[-1] == 0
    assert hidden.any() and (values > 0).any() and (values[hidden] == 0).all()


def test_without_takes_rows_from_every_array(scene):
    fewer = without(scene, np.array([0, 5, len(scene.anchor_q) - 1]))
    assert fewer.rows[-1] == scene.rows[-1] - 3 == len(fewer.feature) == len(fewer.mask[-1])
    assert (
        fewer.rows[0]
        == len(fewer.mask[0])
        == scene.rows[0] - sum(r < scene.rows[0] for r in (0, 5, scene.rows[-1] - 1))
    )
    np.testing.assert_array_equal(fewer.anchor_q[:4], scene.anchor_q[1:5])
