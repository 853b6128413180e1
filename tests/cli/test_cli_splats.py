"""The commands on a file of splats and tracks."""

import numpy as np
import pytest
from explicit import visible_splats
from PIL import Image

from pd4dgs_codec import decode, encode
from pd4dgs_codec.interchange.splats import read_splats


@pytest.fixture(scope="module")
def splats_pd4(tmp_path_factory):
    path = tmp_path_factory.mktemp("splats") / "s.pd4"
    path.write_bytes(encode(visible_splats(), effort=1, slices=4000))
    return path


def test_info_names_what_the_file_holds(cli, splats_pd4, tmp_path):
    result = cli("info", splats_pd4, "--json", "--check", "--bytes").json
    assert result["kind"] == [1] and (result["degree"], result["windows"]) == (1, False)
    assert [row["heads"] for row in result["layers"]] == [
        {},
        {"position": 2, "rotation": 2, "color": 2},
        {"position": 2},
    ]
    assert result["layers"][1]["instants"] == 5 and result["left_out"] == []
    text = cli("info", splats_pd4, "-v")
    assert b"splats with harmonics of degree 1" in text.out and "instants 5" in text.err
    still = tmp_path / "still.pd4"
    still.write_bytes(encode(visible_splats(moving=False), effort=1))
    assert cli("info", still, "--json").json["left_out"] == [] and b"left out" not in cli("info", still).out


def test_decode_writes_arrays_and_no_checkpoint(cli, splats_pd4, tmp_path):
    assert cli("decode", splats_pd4, "-o", tmp_path / "s.npz", "--symbols").code == 0
    arrays, scene = np.load(tmp_path / "s.npz"), decode(splats_pd4.read_bytes())
    np.testing.assert_array_equal(arrays["scale"], scene.tensors["scale"])
    np.testing.assert_array_equal(arrays["anchor"], scene.anchor)
    assert {"tracks.2.instants", "tracks.1.coefficients.color", "mask_0"} <= {*arrays}
    refused = cli("decode", splats_pd4, "-o", tmp_path / "s.pt")
    assert refused.code == 1 and not (tmp_path / "s.pt").exists()
    says = "found a scene of splats, which has no networks; models and checkpoints hold scaffolds only"
    assert refused.err.splitlines() == [f"pd4dgs-decode: error: {says}"]


def test_a_file_of_splats_is_encoded_again(cli, splats_pd4, tmp_path):
    result = cli("encode", splats_pd4, "-o", tmp_path / "a.pd4", "--step-scale", 2, "--slices", "4k", "--json").json
    assert result["slices"]["order"] == "opacity times area" and result["bytes"] < splats_pd4.stat().st_size
    same = cli("encode", splats_pd4, "-o", tmp_path / "b.pd4", "--slices", "4k", "--effort", 1)
    assert same.code == 0 and (tmp_path / "b.pd4").read_bytes() == splats_pd4.read_bytes()
    refused = cli("encode", splats_pd4, "-o", tmp_path / "c.pd4", "--target-size", "10k")
    assert refused.code == 1 and "target sizes of a scene of splats" in refused.err.splitlines()[-1]


@pytest.mark.parametrize("kind", ["ply", "spz", "glb", "4dgs"])
def test_every_kind_of_file_is_exported(cli, splats_pd4, tmp_path, kind):
    out = tmp_path / f"s.{kind}"
    result = cli("export", splats_pd4, "-o", out, "--json")
    count = len(decode(splats_pd4.read_bytes()).anchor_q)
    assert result.code == 0 and result.json["gaussians"] == count and result.json["sh"] == 3
    if kind in ("ply", "spz"):
        found = read_splats(out)
        assert (len(found.means), found.degree) == (count, 1)
    refused = cli("export", splats_pd4, "-o", tmp_path / "t.ply", "--data", "synthetic:local")
    assert refused.code == 2 and "--data has no effect" in refused.err


def test_pictures_scores_and_packages(cli, splats_pd4, tmp_path):
    still = tmp_path / "s.png"
    assert cli("render", splats_pd4, "-o", still, "--time", 0.5, "--level", 1).code == 0
    assert np.asarray(Image.open(still)).min() < 100
    assert cli("render", splats_pd4, "-o", tmp_path / "0.png", "--level", 0).code == 0  # nothing moves: one image
    moving = cli("render", splats_pd4, "-o", tmp_path / "1.png", "--level", 1)
    assert moving.code == 2 and "for 60 images" in moving.err
    levels = cli("eval", splats_pd4, "synthetic:local?size=24x16&frames=4", "--json").json["levels"]
    assert [row["level"] for row in levels] == [0, 1, 2] and all(row["mpsnr"] > 0 for row in levels)
    made = cli("package", splats_pd4, "-o", tmp_path / "out", "--no-video", "--json")
    assert made.code == 0 and "<img" in (tmp_path / "out" / "index.html").read_text()
    page = cli("view", splats_pd4, "-o", tmp_path / "s.html")
    assert page.code == 0 and (tmp_path / "s.html").stat().st_size > splats_pd4.stat().st_size


def test_slices_are_measured_on_a_dataset(cli, splats_pd4, tmp_path):
    data = ("--data", "synthetic:local?size=24x16&frames=4")
    result = cli("encode", splats_pd4, "-o", tmp_path / "a.pd4", "--slices", "4k", "--effort", 1, *data, "--json").json
    told = cli("info", tmp_path / "a.pd4", "--json").json["metadata"]["slices"]
    assert len(told) == sum(len(row["slices"]) for row in result["layers"])
    assert told == pytest.approx(result["slices"]["psnr"])
