"""A folder of segments as one scene with one time axis."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import segmented
from PIL import Image

from pd4dgs_codec import decode
from pd4dgs_codec.draw.player import drawer
from pd4dgs_codec.interchange import splats
from pd4dgs_codec.interchange.splats import picture, read_splats
from pd4dgs_codec.quality.image import mpsnr, to_uint8
from pd4dgs_codec.quality.levels import Timeline, load_levels
from pd4dgs_codec.segments import INDEX, read_index


@pytest.fixture
def own(tmp_path):
    """A copy of the folder that a test may change."""
    return shutil.copytree(segmented.folder(), tmp_path / "scene")


def truth(seconds, info):
    return picture(segmented.scene(seconds), info.camera, info.background, info.near)


def test_a_folder_is_drawn_over_all_of_its_time(cli, tmp_path):
    levels = load_levels(segmented.folder())
    assert [level.level for level in levels] == [0, 1]
    assert levels[0].cumulative_bytes < levels[1].cumulative_bytes == levels[1].model.bytes
    drawer = levels[-1].model
    assert drawer.info.time_range == (0, 4)
    for t in (0, 0.25, 0.4, 0.5, 0.99, 1):  # seams too
        assert mpsnr(levels[-1].picture(drawer.info.camera, t), truth(4 * t, drawer.info)) > 35
    for t in (0.25, 0.5, 0.75):
        before, after = (levels[-1].picture(drawer.info.camera, t + d) for d in (-1e-9, 1e-9))
        assert mpsnr(before, after) > 37
    red = load_levels(segmented.folder(), background=(1.0, 0.0, 0.0))[-1]
    assert red.picture(drawer.info.camera, 0.6)[0, 0].tolist() == [1, 0, 0]


def test_pictures_of_segments_that_overlap_are_blended_linearly_in_time(own):
    _, index = read_index(own)
    later = replace(index.segments[1], time_range=(0.5, 2.0))
    (own / INDEX).write_bytes(replace(index, segments=(index.segments[0], later, *index.segments[2:])).packed())
    timeline, camera = Timeline(own), Timeline(own).info.camera
    first, second = (drawer(decode(own / f"0000{k}.pd4", base=own / "base-0000.pd4")) for k in (0, 1))
    for seconds, weight in ((0.5, 0), (0.625, 0.25), (0.875, 0.75), (1, 1)):
        pictures = first.picture(camera, seconds), second.picture(camera, (seconds - 0.5) / 1.5)
        assert mpsnr(*pictures) < 60, "else nothing is tested"
        expected = (1 - weight) * pictures[0] + weight * pictures[1]
        assert np.allclose(timeline.picture(camera, seconds / 4), expected, atol=1e-6)
        nearer, _ = timeline.at(seconds / 4)  # of which exports of Gaussians are
        assert nearer.scene.info.time_range == ((0, 1) if weight < 0.5 else (1, 2))


@pytest.mark.parametrize("place", ["", INDEX])
def test_commands_take_a_folder_or_its_index(cli, tmp_path, place):
    scene = segmented.folder() / place
    found = cli("info", scene, "--check", "--json").json
    assert found["checked"] and len(found["segments"]) == 4 and found["time_range"] == [0, 4]
    text = cli("info", scene).out.decode()
    assert "4 segments, 0 to 4 s" in text and "00003.pd4" in text
    assert cli("render", scene, "-o", tmp_path / "a.png", "--time", 0.6, "--json").json["width"] == 64
    assert cli("render", scene, "-o", tmp_path / "%d.png", "--frames", 2, "--json").json["frames"] == 2
    info = load_levels(scene)[-1].model.info
    assert mpsnr(np.asarray(Image.open(tmp_path / "a.png")) / 255, to_uint8(truth(2.4, info)) / 255) > 35
    out = cli("export", scene, "-o", tmp_path / "ply", "--to", "ply-seq", "--fps", 2, "--json").json
    assert out["frames"] == 9
    for i in range(9):
        shown = picture(read_splats(tmp_path / "ply" / f"{i:05d}.ply"), info.camera, info.background, info.near)
        assert mpsnr(shown, truth(i / 2, info)) > 35
    source = f"teacher:{segmented.folder().parent / 'frames'}?views=4&size=48x48&fps=4"
    levels = cli("eval", scene, source, "--holdout", 2, "--json").json["levels"]
    assert len(levels) == 2 and levels[1]["mpsnr"] > 34


def test_a_part_is_compared_with_the_views_of_its_time(cli, own):
    """A file of a folder, and a folder that is not finished, show less time than the data."""
    source = f"teacher:{segmented.folder().parent / 'frames'}?views=12&size=48x48&fps=4"
    index = json.loads((own / INDEX).read_text())
    index["segments"] = index["segments"][:2]
    (own / INDEX).write_text(json.dumps(index))
    for part, times in (("00001.pd4", "1 to 2"), ("", "0 to 2")):
        found = cli("eval", own / part, source, "--holdout", 2, "--json")
        assert found.json["levels"][1]["mpsnr"] > 34, found.err
        assert f"shows {times} of 0 to 4 s: compared with these views" in found.err
    other = cli("eval", own, f"{source}0", "--holdout", 2)  # 40 frames a second
    assert "lasts 0.4 s" in other.err and "2 s: compared at the same shares of both" in other.err


def test_no_gaussian_of_a_4dgs_file_moves_to_one_of_another_segment(cli, tmp_path, monkeypatch):
    kept = []
    monkeypatch.setattr(splats, "fourdgs_bytes", lambda frames, seconds: kept.extend(frames) or b"4")
    assert cli("export", segmented.folder(), "-o", tmp_path / "a.4dgs", "--fps", 4).code == 0
    same = [len(np.intersect1d(a[2], b[2])) for a, b in zip(kept[:-1], kept[1:], strict=True)]
    assert [i for i, count in enumerate(same) if not count] == [3, 7, 11] and max(same) > 200


def test_one_segment_finds_its_base_in_its_folder(cli, own, tmp_path):
    assert cli("render", own / "00002.pd4", "-o", tmp_path / "a.png", "--time", 0.4, "--json").code == 0
    told = cli("info", own / "00002.pd4", "--check")
    assert told.code == 0 and b"rows of layer 0 of scene" in told.out
    assert cli("decode", own / "00002.pd4").code == 0
    assert cli("export", own / "00002.pd4", "-o", tmp_path / "a.ply").code == 0
    (own / INDEX).unlink()
    assert "give this file as its base" in cli("decode", own / "00002.pd4").err


def test_what_is_missing_or_damaged_is_named(cli, own):
    (own / "00001.pd4").unlink()
    (own / "00002.pd4").write_bytes((own / "00002.pd4").read_bytes()[:-1])
    found = cli("info", own, "--check")
    assert found.code == 1 and "00001.pd4" in found.err and cli("info", own).code == 0
    folder, index = read_index(own)
    shutil.copy(segmented.folder() / "00001.pd4", own)
    found = cli("info", own, "--check")
    assert (
        found.code == 1
        and f"has {index.segments[2].bytes - 1:,} bytes, expected the {index.segments[2].bytes:,} bytes" in found.err
    )
    assert "needs a .pd4 file" in cli("info", own, "--bytes").err
    assert "segments have slices of their own" in cli("render", own, "-o", "a.png", "--max-bytes", "1k").err
