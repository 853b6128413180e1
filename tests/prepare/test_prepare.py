"""`pd4dgs-prepare` on a room whose camera poses are known."""

import json
import subprocess
import sys
from unittest.mock import Mock

import numpy as np
import pytest
from PIL import Image
from rooms import FOCAL, picture, pose, texture, walk

from pd4dgs_codec.cli.prepare import main
from pd4dgs_codec.data.dataset import load
from pd4dgs_codec.errors import DataError
from pd4dgs_codec.prepare import poses, stages

pytest.importorskip("pycolmap")
COUNT = 9


def write(folder, pictures):
    folder.mkdir()
    for i, frame in enumerate(pictures):
        Image.fromarray(frame).save(folder / f"{i:03d}.png")
    return folder


@pytest.fixture(scope="module")
def room(once):
    """A folder of frames in which a square moves, and the true poses."""
    folder = once("room", lambda folder: write(folder / "frames", walk(COUNT, moves=True)[0]))
    return folder / "frames", [pose(i / (COUNT - 1)) for i in range(COUNT)]


@pytest.fixture(scope="module")
def prepared(room, once):
    """What the command makes of the room when it is interrupted once."""
    return once("prepared", lambda folder: prepare(room, folder / "out")) / "out"


def prepare(room, output):
    arguments = [str(room[0]), "-o", str(output), "--fps", "10", "--camera", "SIMPLE_PINHOLE", "-j", "2"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(poses, "reconstruct", Mock(side_effect=KeyboardInterrupt))
        assert main(arguments) == 1
    assert not output.exists() and output.with_name("out.partial").is_dir()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stages, "write_frames", Mock(side_effect=AssertionError("the frames were written before")))
        assert main(arguments) == 0


def test_the_poses_are_those_of_the_camera(prepared, room):
    data = load(prepared, holdout=0)
    assert len(data.train) == COUNT and data.time_range == (0.0, pytest.approx((COUNT - 1) / 10))
    assert data.train[0].K[0, 0] == pytest.approx(FOCAL, rel=0.05)
    found = np.stack([view.viewmat for view in data.train]).astype(np.float64)
    true = np.stack(room[1])
    for k in range(COUNT):  # rotations against the first picture's
        turn = found[k, :3, :3] @ found[0, :3, :3].T @ (true[k, :3, :3] @ true[0, :3, :3].T).T
        assert np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))) < 1.0
    places, expected = (np.stack([-v[:3, :3].T @ v[:3, 3] for v in views]) for views in (found, true))
    gaps, wanted = (np.linalg.norm(p[:, None] - p, axis=2) for p in (places, expected))
    np.testing.assert_allclose(gaps / gaps.max(), wanted / wanted.max(), atol=0.03)


def test_the_model_stands_upright_around_0(prepared):
    data = load(prepared, holdout=0)
    assert data.up == pytest.approx((0, -1, 0), abs=1e-3)
    assert np.abs(np.median(data.points, axis=0)).max() < 1e-3


def test_report(prepared):
    report = json.loads((prepared / "report.json").read_text())
    assert report["frames"] == {"seen": COUNT, "blurred": 0, "repeated": 0, "chosen": COUNT, "registered": COUNT}
    assert 0 < report["reprojection_error"] < 1.5 and report["points"] > 200
    assert 0.005 < report["moving_share"] < 0.4
    assert len(report["pictures"]) == COUNT and all(row["pose"] for row in report["pictures"])
    assert Image.open(prepared / "report.png").width > 1000
    assert sorted(path.name for path in prepared.iterdir()) == [
        "images", "report.json", "report.png", "sparse", "times.txt",
    ]  # fmt: skip


def test_an_interruption_says_how_to_go_on(room, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(poses, "extract", Mock(side_effect=KeyboardInterrupt))
    assert main([str(room[0]), "-o", str(tmp_path / "out")]) == 1
    line = f"interrupted; the same command resumes from {tmp_path / 'out'}.partial"
    assert capsys.readouterr().err.splitlines()[-1].endswith(line)


def test_pictures_that_changed_since_an_interruption_are_read_anew(tmp_path, monkeypatch):
    frames = write(tmp_path / "frames", walk(COUNT)[0])
    with monkeypatch.context() as patch:
        patch.setattr(poses, "extract", Mock(side_effect=KeyboardInterrupt))
        for _ in range(2):
            assert main([str(frames), "-o", str(tmp_path / "out")]) == 1
            written = np.asarray(Image.open(tmp_path / "out.partial" / "images" / "frame_000003.png"))
            np.testing.assert_array_equal(written, np.asarray(Image.open(frames / "003.png")))
            for file in frames.iterdir():
                Image.fromarray(255 - np.asarray(Image.open(file))).save(file)  # the folder stays as it was


def test_what_a_stopped_run_left_damaged_is_made_anew(tmp_path, monkeypatch, capsys):
    frames, work = write(tmp_path / "frames", walk(COUNT)[0]), tmp_path / "out.partial"
    monkeypatch.setattr(poses, "extract", Mock(side_effect=KeyboardInterrupt))

    def run() -> str:
        assert main([str(frames), "-o", str(tmp_path / "out")]) == 1
        assert "interrupted; the same command resumes from" in capsys.readouterr().err
        return (work / "frames.json").read_text()

    stored, picture = run(), work / "images" / "frame_000003.png"
    elsewhere = stored.replace('"frame_000003.png"', '"../colmap.db"')
    for name, content in (("frames.json", "[]"), ("frames.json", elsewhere), ("prepare.json", "[" * 100_000)):
        (work / name).write_text(content)
        assert run() == stored
    picture.unlink()
    assert run() == stored and picture.is_file()


def test_a_second_run_on_one_output_is_refused_and_leaves_the_first_alone(tmp_path, monkeypatch, capsys):
    frames, work = write(tmp_path / "frames", walk(COUNT)[0]), tmp_path / "out.partial"
    codes = []

    def second(*_):
        codes.append(main([str(frames), "-o", str(tmp_path / "out"), "--frames", "8"]))
        assert sorted(path.name for path in work.iterdir()) == ["frames.json", "images", "prepare.json"]
        raise KeyboardInterrupt

    monkeypatch.setattr(poses, "extract", second)
    assert main([str(frames), "-o", str(tmp_path / "out")]) == 1 and codes == [1]
    assert f"{work}: another process is at work here" in capsys.readouterr().err
    assert json.loads((work / "prepare.json").read_text())["frames"] == 120


@pytest.mark.parametrize("number", ["SIGINT", "SIGTERM"])
def test_signals_are_ours_once_pycolmap_is_loaded(number):
    """The handlers of pycolmap's C++ would print a stack."""
    program = f"""
import os, signal
from pd4dgs_codec.prepare.poses import colmap
from pd4dgs_codec.signals import interruptible
with interruptible():
    try:
        colmap()
        os.kill(os.getpid(), signal.{number})
        while True: pass
    except KeyboardInterrupt:
        print("interrupted")
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=200)
    assert (done.returncode, done.stdout, done.stderr) == (0, "interrupted\n", "")


def test_a_camera_that_stands_still_is_told(tmp_path, capsys):
    textures = [texture(seed) for seed in range(4)]
    pictures = [picture(pose(0.5), textures, -0.9 + 0.2 * step, (160, 120), FOCAL / 2) for step in range(10)]
    frames = write(tmp_path / "tripod", pictures)
    assert main([str(frames), "-o", str(tmp_path / "out"), "-j", "2"]) == 1
    told = capsys.readouterr().err.strip().splitlines()
    assert "10 frames take up to 1 min on 2 cores" in told[0] and "the camera stands still" in told[-1]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["tripod"]


def test_the_estimate_grows_with_frames_and_shrinks_with_cores():
    assert 100 < poses.estimate(80, (854, 480), 2) < 150  # 226 CPU seconds were measured
    assert poses.estimate(80, (854, 480), 1) == 2 * poses.estimate(80, (854, 480), 2)
    large, shrunk = (poses.estimate(80, size, 2) for size in ((3840, 2160), (1600, 900)))
    assert large == pytest.approx(shrunk)  # features are found in shrunk pictures


def test_unregistrable_recording_is_refused_and_leaves_nothing(tmp_path, capsys):
    rng = np.random.default_rng(0)
    frames = write(tmp_path / "noise", [rng.integers(0, 255, (96, 128, 3), np.uint8) for _ in range(10)])
    assert main([str(frames), "-o", str(tmp_path / "out"), "-j", "2"]) == 1
    lines = capsys.readouterr().err.strip().splitlines()
    assert "found camera poses for 0 of 10 frames, expected at least 8" in lines[-1]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["noise"]


def test_foreign_folder_is_not_replaced(room, tmp_path, capsys):
    (tmp_path / "out").mkdir()
    assert main([str(room[0]), "-o", str(tmp_path / "out")]) == 1
    assert "exists already; --overwrite replaces" in capsys.readouterr().err
    (tmp_path / "out" / "letter.txt").write_text("dear")
    assert main([str(room[0]), "-o", str(tmp_path / "out"), "--overwrite"]) == 1
    assert "expected an output of pd4dgs-prepare" in capsys.readouterr().err
    assert (tmp_path / "out" / "letter.txt").is_file()
    (tmp_path / "new.partial").mkdir()
    assert main([str(room[0]), "-o", str(tmp_path / "new")]) == 1
    assert "expected nothing here or the partial output of an earlier run" in capsys.readouterr().err


def test_a_link_is_not_replaced(tmp_path):
    (tmp_path / "link").symlink_to(tmp_path)
    with pytest.raises(DataError, match="link: found a link"):
        stages.check_folder(tmp_path / "link", True)


def test_a_folder_without_a_name_of_its_own_is_refused(room, tmp_path, monkeypatch, capsys):
    (tmp_path / "sparse").mkdir()
    (tmp_path / "report.json").write_text("{}")
    monkeypatch.chdir(tmp_path)
    assert main([str(room[0]), "-o", ".", "--overwrite"]) == 1
    assert ".: has no name of its own, expected the name of an output folder" in capsys.readouterr().err
    assert (tmp_path / "report.json").is_file()


def test_a_failure_of_colmap_names_the_recording_and_leaves_nothing(room, tmp_path, monkeypatch, capsys):
    def fail(*_: object, **__: object) -> None:
        raise RuntimeError("no space")

    for name in ("extract", "match"):
        monkeypatch.setattr(poses, name, lambda *_: None)
    monkeypatch.setattr(poses, "travel", lambda database: -1.0)
    monkeypatch.setattr(poses.colmap(), "incremental_mapping", fail)
    assert main([str(room[0]), "-o", str(tmp_path / "out")]) == 1
    assert f"{room[0]}: COLMAP failed: no space" in capsys.readouterr().err.splitlines()[-1]
    assert not list(tmp_path.iterdir())
