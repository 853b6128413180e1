"""Long sequences of Gaussians as folders of segments."""

from dataclasses import replace

import numpy as np
import pytest
from test_import import body, moved, small_views  # noqa: F401 - a fixture

from pd4dgs_codec import decode
from pd4dgs_codec.format.info import info
from pd4dgs_codec.interchange import segmented
from pd4dgs_codec.interchange.segmented import Still
from pd4dgs_codec.interchange.splats import picture, ply_bytes
from pd4dgs_codec.quality.image import mpsnr
from pd4dgs_codec.segments import INDEX, read_index

pytestmark = pytest.mark.usefixtures("small_views")
FRAMES, FPS = 13, 4


def write(folder, frames):
    folder.mkdir()
    for i, splats in enumerate(frames):
        (folder / f"{i:04d}.ply").write_bytes(ply_bytes(splats))
    return folder


def swaying(shuffled=False):
    """A body of which 60 % stand still."""
    rng = np.random.default_rng(0)
    for i in range(FRAMES):
        frame = moved(body(), np.sin(i / 3) / (4 if shuffled else 2))
        yield frame.taken(rng.permutation(300)) if shuffled else frame


def imported(cli, source, out, *more, segments=1):
    return cli("import_model", source, "-o", out, "--segments", segments, "--psnr", 40, "--fps", FPS, "--json", *more)


def scenes(folder):
    folder, index = read_index(folder)
    bases = [(folder / base.file).read_bytes() for base in index.bases]
    return index, [
        decode((folder / s.file).read_bytes(), base=None if s.base is None else bases[s.base]) for s in index.segments
    ]


@pytest.mark.parametrize("shuffled", [False, True])
def test_what_stands_still_is_in_the_base_once(tmp_path, cli, shuffled):
    result = imported(cli, write(tmp_path / "set", swaying(shuffled)), tmp_path / "out")
    assert result.code == 0, result.err
    index, found = scenes(tmp_path / "out")
    assert result.json["still"] == [180] and result.json["segments"] == 3 and result.json["psnr"] > 36
    assert [s.time_range for s in index.segments] == [(0, 1), (1, 2), (2, 3)] and index.time_range == (0, 3)
    still = decode((tmp_path / "out" / index.bases[0].file).read_bytes())
    n = len(still.anchor_q)
    assert n > 170
    for scene in found:
        for name, values in still.tensors.items():
            assert np.array_equal(scene.tensors[name][:n], values)
        assert scene.level > 0 and len(scene.anchor_q) - n >= (120 if shuffled else 110)
        assert not any(
            head.coefficients[:n].any() for tracks in scene.tracks.values() for head in tracks.heads.values()
        )
    for k, t in [(k, t) for k in range(3) for t in (0.0, 1.0)]:  # both sides of each seam, against the source
        truth = shown(list(swaying(shuffled))[4 * k + (4 if t else 0)], found[k].info)
        assert mpsnr(shown(found[k].splats(t)[0], found[k].info), truth) > 36


def shown(splats, info):
    return picture(splats, info.camera, info.background, info.near)


def test_a_frame_that_lost_a_row_has_no_order(tmp_path, cli):
    frames = list(swaying())
    frames[4] = frames[4].taken(np.arange(299))
    result = imported(cli, write(tmp_path / "set", frames), tmp_path / "out")
    assert result.code == 0, result.err
    assert result.json["still"] == [179] and result.json["psnr"] > 36
    assert "window" in scenes(tmp_path / "out")[1][0].tensors


def test_segments_that_are_there_are_kept_and_the_others_are_made_again(tmp_path, cli):
    source, out = write(tmp_path / "set", swaying()), tmp_path / "out"
    assert imported(cli, source, out).json["kept"] == 0
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    (out / "00002.pd4").unlink()
    (out / "00001.pd4").write_bytes(before["00001.pd4"][:-1])
    again = imported(cli, source, out)
    assert again.json["kept"] == 1, again.err
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    (out / "base-0000.pd4").write_bytes(b"")  # segments of another base would not fit
    assert imported(cli, source, out).json["kept"] == 3
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    other = imported(cli, source, out, "--psnr", 30)
    assert other.code == 1 and "holds another import" in other.err
    assert imported(cli, source, out, "--psnr", 30, "--overwrite").json["kept"] == 0


def test_an_interruption_leaves_a_folder_that_can_be_read_and_continued(tmp_path, cli, monkeypatch):
    source, out = write(tmp_path / "set", swaying()), tmp_path / "out"
    make, count = segmented.SegmentPacker._scene, []

    def cut(self, theta):
        count.append(0)
        if len(count) > limit:
            raise KeyboardInterrupt
        return make(self, theta)

    limit = 1 << 30
    monkeypatch.setattr(segmented.SegmentPacker, "_scene", cut)
    imported(cli, source, tmp_path / "whole")
    limit, count[:] = len(count) - 1, []
    assert "interrupted" in imported(cli, source, out).err
    assert len(scenes(out)[1]) == 2
    limit, count[:] = 1 << 30, []
    assert imported(cli, source, out).json["kept"] == 2 and len(count) == 1
    for path in (tmp_path / "whole").iterdir():
        assert (out / path.name).read_bytes() == path.read_bytes()


def test_a_scene_that_changes_gets_a_new_base_and_one_that_rests_empty_segments(tmp_path, cli):
    frames = [body(), replace(body(), means=body().means[::-1].copy())]
    source = write(tmp_path / "set", [frames[i > 6] for i in range(FRAMES)])
    result = imported(cli, source, tmp_path / "out", segments=0.5)
    assert result.code == 0, result.err
    index, found = scenes(tmp_path / "out")
    assert [s.base for s in index.segments] == [0, 0, 0, None, 1, 1] and result.json["psnr"] > 36
    resting = (tmp_path / "out" / index.segments[0].file).read_bytes()
    assert info(resting)["anchors"] == 0 and len(resting) < 600 and found[0].level == 0
    assert imported(cli, source, tmp_path / "out", segments=0.5).json["kept"] == 6


def test_drift_is_no_rest():
    """Each step is small, the way is not."""
    still, frame = Still.of(body(), None), body()
    for _ in range(9):
        size = frame.scales.max(axis=1, keepdims=True)
        frame = replace(frame, means=frame.means + 0.004 * size * (np.arange(300) < 100)[:, None])
        still = still.add(frame)
    assert len(still.rows) == 200 and len(still.others(frame).means) == 100


FAULTS = {
    "one": (lambda: [body()], (), "stands still, expected frames for --segments"),
    "short": (lambda: [body()] * 3, ("--segments", "0.1"), "has 3 frames in 0.5 s, expected two at least"),
    "size": (lambda: [body()] * 3, ("--slices", "40k"), "makes one file, without --segments"),
    "URI": (lambda: [body()] * 3, ("-o", "s3://a/b"), "looks like a URI"),
}


@pytest.mark.parametrize("frames, more, message", FAULTS.values(), ids=FAULTS)
def test_faults_are_named_in_one_line(tmp_path, cli, frames, more, message):
    found = imported(cli, write(tmp_path / "set", frames()), tmp_path / "out", *more)
    assert found.code and message in found.err and not (tmp_path / "out" / INDEX).exists()
