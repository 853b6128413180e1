"""encode with quality in renderings: target sizes, the effect of single anchors."""

import re
from dataclasses import replace

import numpy as np
import pytest

from pd4dgs_codec.data.view import View
from pd4dgs_codec.format.plan import plan
from pd4dgs_codec.model import checkpoint, sensitivity
from pd4dgs_codec.model.model import from_scene
from pd4dgs_codec.quality import packing, target
from pd4dgs_codec.quality.frames import own_frames
from pd4dgs_codec.quality.measure import RenderedLoss, true_psnr

#: Fitting the priors of mode ans takes ten times as long.
FAST = ("--mode", "lzma", "--effort", 1, "--json", "-f")


@pytest.fixture(autouse=True)
def _few_values(monkeypatch):
    """Each value costs an encode and its pictures: a few do here."""
    monkeypatch.setattr(target, "OCTAVES", (0.0, 1.5, 3.0))
    monkeypatch.setattr(target, "SHARES", (0.0, 0.1, 0.5))
    monkeypatch.setattr(packing, "OWN_PICTURES", 2)


def first_layer(cli, path) -> int:
    return cli("info", path, "--json").json["layers"][0]["end"]


def test_a_target_is_met_and_its_loss_is_reported(cli, model_pt, tmp_path):
    output = tmp_path / "s.pd4"
    cli("encode", model_pt, "-o", output, *FAST)
    most = int(0.75 * first_layer(cli, output))
    result = cli("encode", model_pt, "-o", output, "--target-size", f"L0={most}", *FAST)
    assert result.code == 0 and 0.97 * most <= first_layer(cli, output) <= most
    target = result.json["target"]
    (row,) = target["layers"]
    assert row["bytes"] == first_layer(cli, output) and row["target"] == most
    assert target["cameras"] == "the file's own camera" and [level["level"] for level in target["levels"]] == [0, 1, 2]
    assert all(10 < level["error_psnr"] < 100 for level in target["levels"])


def test_cameras_in_a_checkpoint_measure_and_their_absence_is_said(cli, model_pt, scene, tmp_path):
    seen = [(scene.info.camera, time) for time in (0.0, 0.5, 1.0)]
    checkpoint.save(tmp_path / "m.pt", from_scene(scene), {"viewpoints": seen})
    arguments = ("--slices", 2000, "--effort", 1, "-f", "-o", tmp_path / "s.pd4")
    found, older = (cli("encode", path, *arguments) for path in (tmp_path / "m.pt", model_pt))
    report, before = found.err, older.err
    assert "on 2 views: training cameras in the checkpoint" in report and "no training cameras" not in report
    assert "on 2 views: the file's own camera" in before and "holds no training cameras" in before
    row = r"^level [012]: \d+\.\d+ dB with slices, \d+\.\d+ dB without, on the model's own pictures$"
    assert len(re.findall(row, report, re.MULTILINE)) == 3
    assert re.search(r"^first slices of layers \[.*\] exceed 2,000 bytes", report, re.MULTILINE)
    told = re.search(r"^fill and spread of each slice: (#.*) \(-: the background\)$", before, re.MULTILINE)[1]
    told = told.split(", ")
    shown = re.findall(r"(#\w{6}(?: x[\d.]+)?|-) +-$", cli("info", tmp_path / "s.pd4").out.decode(), re.MULTILINE)
    assert shown == told and len(set(told)) > 2
    kept = cli("encode", model_pt, *arguments, "--keep-levels")
    assert kept.code == 0 and "dB with slices" not in kept.err


def test_a_picture_that_equals_its_image_does_not_decide_a_mean(scene, monkeypatch):
    views = [View(*[None] * 2, 4, 3, t, np.full((3, 4, 3), 255, np.uint8), None, "", 0) for t in (0.0, 1.0)]
    draw = lambda model, level, time, *_: np.full((3, 4, 3), 1 - 0.1 * time, np.float32)  # noqa: E731
    monkeypatch.setattr("pd4dgs_codec.quality.measure.render_image", draw)
    assert true_psnr(scene, (0, 2), views) == {level: pytest.approx(60, abs=0.1) for level in (0, 2)}  # 100, 20 dB


def test_the_estimated_omission_error_is_close_to_the_measured_one(scene, monkeypatch):
    monkeypatch.setattr(sensitivity, "PROBES", 64)  # the anchors differ less here than in a trained scene
    planned = plan(scene).scene
    ground = planned.prefix(0)  # the pictures of other levels are not compared
    loss = RenderedLoss(ground, [(frame.camera, frame.time) for frame in own_frames(planned.info, 2, 20.0)])
    harm = loss.omission_error(planned, 0)
    anchors = range(planned.rows[0])
    measured = []
    for anchor in anchors:
        mask = ground.mask[0].copy()
        mask[anchor] = 0
        measured.append(loss.mse(replace(ground, mask=(mask,)))[0])
    scalars = 3 * len(loss.viewpoints) * planned.info.camera.width * planned.info.camera.height
    harm, measured = harm[: len(anchors)], scalars * np.array(measured)
    assert np.isfinite(harm).all() and 0.5 < np.median(harm / measured) < 2
    ranks = np.corrcoef(harm.argsort().argsort(), measured.argsort().argsort())[0, 1]
    assert ranks > 0.7
