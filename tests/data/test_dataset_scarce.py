"""Valid datasets that hold little: one frame, one place, one instant, views without a valid pixel."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from folders import change_frames, gradient, pose, save
from test_captures import write_iphone

from pd4dgs_codec.data.dataset import load
from pd4dgs_codec.errors import DataError

#: A lens without a valid pixel: its picture lies thousands of pixels off the axis.
BLIND = {"cx": 4000, "k1": 0.5}


def test_ordinary_data_has_no_remarks(blender):
    dataset = load(blender())
    assert dataset.left_out == () and dataset.remarks() == []


def test_one_frame(blender):
    dataset = load(blender(n=1))
    assert len(dataset.train) == 1 and dataset.train[0].time == 0.0 and dataset.time_range == (0.0, 1.0)
    assert [remark.split(":")[0] for remark in dataset.remarks()] == [
        "all training views show one instant",
        "all training views are from one viewpoint",
    ]


def test_one_place_and_one_instant_are_remarked(blender):
    folder = blender()
    change_frames(folder, lambda i: {"transform_matrix": pose(0.3)})
    assert ["one viewpoint" in r for r in load(folder).remarks()] == [True]
    change_frames(folder, lambda i: {"transform_matrix": pose(0.2 * i), "time": 7.5})
    dataset = load(folder)
    assert ["one instant" in r for r in dataset.remarks()] == [True] and dataset.time_range == (0.0, 1.0)
    assert {view.time for view in dataset.train} == {0.0}


@pytest.mark.parametrize("start", [0.0, -5.0, 100.0, 1.7e9])
def test_times_may_start_anywhere_repeat_and_come_in_any_order(blender, start):
    folder = blender(n=5)
    times = [3.0, 0.0, 3.0, 4.0, 1.0]
    change_frames(folder, lambda i: {"time": start + times[i]})
    dataset = load(folder, holdout=0)
    assert [view.time for view in dataset.train] == pytest.approx([t / 4 for t in times])
    assert np.diff(np.float32(dataset.time_range)) == 4


def test_views_without_a_valid_pixel_are_left_out(blender):
    folder = blender(n=9)
    change_frames(folder, lambda i: BLIND if i in (1, 4) else {})
    dataset = load(folder)
    assert dataset.left_out == ("r_001", "r_004") and [len(dataset.train), len(dataset.test)] == [7, 0]
    assert dataset.remarks() == ["2 of 9 views left out, no valid pixel in the mask: r_001, r_004"]
    assert dataset.train[1].time == pytest.approx(2 / 8)  # the others keep their instants


def test_no_valid_pixel_in_any_training_view_is_refused(blender):
    folder = blender(n=3, **BLIND)
    with pytest.raises(DataError, match="masks of all 3 training views hold no valid pixel") as caught:
        load(folder)
    assert str(folder) in str(caught.value)


def test_test_views_that_were_never_covisible_do_not_count(tmp_path):
    scene = load("synthetic:local?frames=4&size=16x12")
    blind, *others = scene.test
    scene = replace(scene, test=(replace(blind, mask=np.zeros_like(blind.mask)), *others))
    dataset = load(write_iphone(scene, tmp_path))
    assert dataset.left_out == (blind.name,) and dataset.masked
    assert [view.name for view in dataset.test] == [view.name for view in others]


def test_a_dataset_is_read_only(blender):
    """Nothing is written beside it: it may lie on a medium that cannot be written to."""
    folder = blender()
    files = sorted(folder.iterdir())
    for path in (*files, folder):
        path.chmod(0o555 if path is folder else 0o444)  # root may write all the same, which the times show

    def state():
        return [(path, path.stat().st_mtime_ns, path.stat().st_size) for path in (folder, *sorted(folder.iterdir()))]

    before = state()
    try:
        dataset = load(str(folder))
        for view in (*dataset.train, *dataset.test):
            assert view.image.size
        assert state() == before
    finally:
        folder.chmod(0o755)


def test_a_fingerprint_changes_with_what_is_trained_on_and_not_with_names(blender, tmp_path):
    folder = blender()
    whole = load(folder).fingerprint()
    renamed = tmp_path.parent / f"{tmp_path.name}-renamed"
    shutil.copytree(folder, renamed)
    assert whole == load(renamed).fingerprint() and len(whole) == 16
    found = {whole, load(folder, downscale=2).fingerprint(), load(folder, holdout=0).fingerprint()}
    for i, change in enumerate(({"time": 0.31}, {"transform_matrix": pose(0.61)}, {"fl_x": 20})):
        change_frames(folder, lambda n, change=change: change if n == 3 else {})
        found.add(load(folder).fingerprint())
        assert len(found) == 4 + i, change
    save(folder / "r_003.png", gradient(12, 8, 90))
    assert load(folder).fingerprint() not in found
