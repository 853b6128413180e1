"""Gaussians of other programs as datasets for training."""

import gzip
import json
import struct
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from common import SHARED
from test_splats import gsplat_state, make_splats
from tiny import write_views

from pd4dgs_codec.data.dataset import load
from pd4dgs_codec.errors import DataError
from pd4dgs_codec.interchange.splats import fourdgs_bytes, picture, ply_bytes, read_splats, spz_bytes
from pd4dgs_codec.interchange.teacher import load_source, read_model
from pd4dgs_codec.kinds.splats import Splats


def _same(found: Splats, expected: Splats, **tolerance: float) -> None:
    for name, values in vars(expected).items():
        got = getattr(found, name)
        if name == "quats":
            got = got * np.sign(np.einsum("nd,nd->n", got, values))[:, None]
        np.testing.assert_allclose(got, values, err_msg=name, **(tolerance or {"atol": 1e-5}))


def _moved(splats: Splats, x: float) -> Splats:
    return replace(splats, means=splats.means + np.float32([x, 0, 0]))


def _sequence(folder: Path, frames: int = 3) -> Path:
    folder.mkdir()
    for i in range(frames):
        (folder / f"frame_{8 + i}.ply").write_bytes(ply_bytes(_moved(make_splats(200, 1), 0.2 * i)))  # 8, 9, 10
    return folder


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_ply_comes_back_as_it_was(tmp_path, degree):
    path = tmp_path / "a.ply"
    path.write_bytes(ply_bytes(make_splats(degree=degree)))
    _same(read_splats(path), make_splats(degree=degree))


def test_spz_and_4dgs_come_back_rounded(tmp_path):
    pytest.importorskip("gaussforge")
    pytest.importorskip("fourdgs")
    splats = make_splats(30, 1)
    path = tmp_path / "a.spz"
    path.write_bytes(spz_bytes(splats))
    _same(read_splats(path), splats, atol=0.07)
    still = make_splats(30, 0)  # without harmonics but the constant
    path.write_bytes(spz_bytes(still))
    _same(read_splats(path), still, atol=0.07)
    path = tmp_path / "a.4dgs"
    path.write_bytes(fourdgs_bytes([(0.0, splats, np.arange(30)), (0.5, _moved(splats, 1), np.arange(30))], 1.0))
    teacher = read_model(str(path), 30)
    assert teacher.seconds == 1 and teacher.times is None
    for t, shift in ((0.0, 0.0), (0.25, 0.5), (1.0, 1.0)):
        found = teacher.splats(t)
        goal = splats.means + np.float32([shift, 0, 0])
        distance = np.abs(found.means[:, None] - goal[None]).max(axis=2)
        assert len(found.means) == 30 and distance.min(axis=0).max() < 0.02


@pytest.mark.parametrize("name, count", [("guitar.compressed.ply", 90_854), ("biker.spz", 152_746)])
def test_splat_files_of_other_programs(name, count):
    pytest.importorskip("gaussforge")
    path = SHARED / "splats" / name
    if not path.is_file():
        pytest.skip(f"{path} is not there")
    splats = read_splats(path)
    assert len(splats.means) == count and splats.degree == 0
    assert (splats.scales > 0).all() and np.ptp(splats.means, axis=0).max() > 1


def test_frames_are_in_the_order_of_their_numbers(tmp_path):
    folder = _sequence(tmp_path / "seq")
    (folder / "._hidden.ply").write_bytes(b"of macOS")
    teacher = read_model(str(folder), 10)
    assert teacher.times == (0.0, 0.5, 1.0) and teacher.seconds == pytest.approx(0.2)
    base = make_splats(200, 1).means[:, 0].mean()
    shifts = [teacher.splats(t).means[:, 0].mean() - base for t in teacher.times]
    np.testing.assert_allclose(shifts, [0, 0.2, 0.4], atol=1e-6)


def test_a_checkpoint_of_gsplat(tmp_path):
    splats = make_splats(20, 2)
    path, state = tmp_path / "ckpt_29999_rank0.pt", gsplat_state(splats)
    torch.save({"step": 29999, "splats": state}, path)
    _same(read_model(str(path), 30).splats(0.0), splats)
    for key, shape in (("shN", (20, 24)), ("shN", (19, 8, 3)), ("sh0", (20, 1, 0)), ("sh0", (20, 3))):
        torch.save({"step": 1, "splats": state | {key: torch.zeros(shape)}}, path)
        with pytest.raises(DataError, match=r"sh0 and shN have shapes .*, expected \(n, 1, 3\) and"):
            read_model(str(path), 30)
    torch.save({"step": 1, "splats": {"means": state["means"]}}, path)
    with pytest.raises(DataError, match="has no splats.quats; expected a checkpoint of gsplat"):
        read_model(str(path), 30)


FUNCTION = """
import numpy as np, torch
def ball(t):
    rng = np.random.default_rng(0)
    means = rng.normal(0, 0.3, (300, 3)); means[:, 0] += t
    return {"means": means, "quats": np.tile([1.0, 0, 0, 0], (300, 1)), "scales": torch.full((300, 3), 0.08),
            "opacities": np.full(300, 0.9), "colors": np.tile([0.9, 0.2, 0.1], (300, 1))}
def wrong(t):
    return {"means": np.zeros((3, 2))}
def nothing(t):
    raise KeyError("model")
def number(t):
    return ball(t) | {"colors": np.array(0.5)}
class Broken:
    @property
    def means(self):
        raise KeyError("means")
def lazy(t):
    return Broken()
"""


def test_function_source(tmp_path, monkeypatch):
    (tmp_path / "my_model.py").write_text(FUNCTION)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "my_model", raising=False)
    data = load_source("teacher:my_model:ball?views=16&size=40x30&background=white")
    assert len(data.train) == 14 and len(data.test) == 2 and data.background == (1.0, 1.0, 1.0)
    assert len({view.time for view in data.train}) == 14
    for view in (data.train[0], data.test[1]):
        assert view.image.shape == (30, 40, 3)
        middle = view.image[10:20, 13:27].reshape(-1, 3).astype(int)  # the cameras look at it
        assert (middle[:, 0] > middle[:, 2] + 60).mean() > 0.2
        x, y, depth = view.viewmat[:3, :3] @ [0.5, 0, 0] + view.viewmat[:3, 3]
        assert depth > 0 and data.near < depth < data.far
    assert (data.box[0] < [-0.3, -0.3, -0.3]).all() and (data.box[1] > [1.2, 0.3, 0.3]).all()
    assert np.abs(data.points[:, 0].mean() - 0.5) < 0.1 and data.points.shape[1] == 3
    for name, message in (
        ("wrong", "colors is NoneType, expected an array"),
        ("nothing", "raised KeyError"),
        ("absent", "cannot be imported"),
        ("number", r"sh has shape .1, 1., expected .300, 1, 3."),
        ("lazy", "raised KeyError: 'means'"),
    ):
        with pytest.raises(DataError, match=message):
            load_source(f"teacher:my_model:{name}?views=8")
    (tmp_path / "my_broken_model.py").write_text("1 / 0")
    with pytest.raises(DataError, match="my_broken_model:ball: importing it raised ZeroDivisionError"):
        load_source("teacher:my_broken_model:ball")


def test_pictures_are_those_of_the_frame_next_to_each_view(tmp_path):
    folder = _sequence(tmp_path / "seq")
    data = load_source(f"teacher:{folder}?views=12&size=40x30&fps=5", holdout=0)
    assert data.time_range == (0.0, pytest.approx(0.4)) and not data.test
    assert {view.time for view in data.train} == {0.0, 0.5, 1.0}
    for view in data.train:
        splats = _moved(make_splats(200, 1), 0.4 * view.time)
        expected = np.rint(picture(splats, view.camera, (0.0, 0.0, 0.0), data.near) * 255)
        assert np.abs(view.image - expected).max() <= 1
    assert np.ptp([view.image for view in data.train]) > 100


def test_cameras_of_a_dataset_keep_its_held_out_pictures(tmp_path):
    folder, like = _sequence(tmp_path / "seq"), write_views(tmp_path / "set")
    data, truth = load_source(f"teacher:{folder}?cameras={like}"), load(like)
    assert [view.image.tobytes() for view in data.test] == [view.image.tobytes() for view in truth.test]
    assert len(data.train) == len(truth.train)
    for mine, theirs in zip(data.train, truth.train, strict=True):
        np.testing.assert_array_equal(mine.viewmat, theirs.viewmat)
        assert mine.image.tobytes() != theirs.image.tobytes()
    assert data.origin.points == "the teacher"


def test_frame_rates_and_cameras_of_another_source(tmp_path):
    folder, like = _sequence(tmp_path / "seq"), write_views(tmp_path / "set")
    file = like / "transforms.json"
    about = json.loads(file.read_text())
    for frame in about["frames"]:
        frame.pop("time", None)
    file.write_text(json.dumps(about))
    assert load_source(f"teacher:{folder}?cameras={like}", fps=5).time_range == load(like, fps=5).time_range
    assert load(like, fps=5).time_range != load(like).time_range


def test_cameras_json_beside_the_frames_is_used(tmp_path):
    folder = _sequence(tmp_path / "seq", 1)
    row = {"rotation": np.eye(3).tolist(), "width": 80, "height": 60, "fx": 70, "fy": 70}
    rows = [row | {"position": [0.1 * i, 0, -4]} for i in range(3)]
    (folder / "cameras.json").write_text(json.dumps(rows))
    data = load_source(f"teacher:{folder}?size=40x30", holdout=0)
    assert len(data.train) == 3 and data.up == (0.0, -1.0, 0.0) and data.train[0].width == 40
    np.testing.assert_allclose([v.camera.eye for v in data.train], [r["position"] for r in rows], atol=1e-6)


def test_an_instant_without_gaussians_is_one_line(tmp_path):
    pytest.importorskip("fourdgs")
    splats, path = make_splats(5, 1), tmp_path / "late.4dgs"
    path.write_bytes(fourdgs_bytes([(0.5, splats, np.arange(5))], 1.0))
    assert len(read_model(str(path), 30).splats(0.9).means) == 5
    with pytest.raises(DataError, match="late.4dgs at 0.1: none of 0 Gaussians"):
        read_model(str(path), 30).splats(0.1)


@pytest.mark.parametrize(
    "source, message",
    [
        ("teacher:", "names no teacher"),
        ("teacher:nothing-here", "found nothing, expected a folder"),
        ("teacher:{folder}?colour=red", "found 'colour=red', expected each of cameras, views"),
        ("teacher:{folder}?views=1", "views is '1'; expected for example views=200, 2 to 100000"),
        ("teacher:{folder}?size=9", "size is '9'"),
        ("teacher:{empty}", "holds no file that ends in .ply, .spz, .sog, .splat"),
        ("teacher:{rest}", "has 10 properties f_rest_"),
        ("teacher:{plain}", "is a point cloud without f_dc_0"),
        ("teacher:{nan}", "none of 40 Gaussians is finite"),
        ("teacher:{faint}", "no Gaussian is as opaque as 0.1"),
        ("teacher:{cut}", "bytes of vertices, expected"),
    ],
)
def test_bad_teachers_are_one_line(tmp_path, source, message):
    folder = _sequence(tmp_path / "seq", 1)
    places = {"folder": folder, "empty": tmp_path / "empty"}
    places["empty"].mkdir()
    whole = ply_bytes(make_splats(degree=1))
    splats = make_splats(degree=0)
    for name, data in {
        "rest": whole.replace(b"property float nx", b"property float f_rest_9"),
        "plain": b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
        b"end_header\n0 0 0\n",
        "nan": ply_bytes(replace(splats, means=splats.means + np.float32(np.nan))),
        "faint": ply_bytes(replace(splats, opacities=np.full(40, 0.01, np.float32))),
        "cut": whole[:-40],
    }.items():
        places[name] = tmp_path / f"{name}.ply"
        places[name].write_bytes(data)
    with pytest.raises(DataError, match=message):
        load_source(source.format(**places))


def _header(version: int, count: int, streams: int = 0) -> bytes:
    return struct.pack("<4sIIBBBB", b"NGSP", version, count, 0, 12, 0, streams)


@pytest.mark.parametrize(
    "data, message",
    [
        (gzip.compress(b"abc"), "is not an SPZ file, expected it to begin with NGSP"),
        (gzip.compress(_header(3, 5) + bytes(1 << 24)), "unpacks to more bytes than 5 Gaussians need"),
        (gzip.compress(_header(3, 2**32 - 1) + bytes(99)), "declares 4,294,967,295 Gaussians, expected 10,000,000"),
        (_header(4, 5, 1) + struct.pack("<IIQQQ", 32, 0, 0, 9, 1 << 40), "unpacks to more bytes than 5 Gaussians need"),
        (gzip.compress(_header(3, 5)), "unpacks to 16 bytes, too few for the 5 Gaussians that it declares"),
        (gzip.compress(_header(3, 5_000_000) + bytes(6000)), "too few for the 5,000,000 Gaussians that it declares"),
        (_header(4, 5_000_000, 1) + struct.pack("<IIQQQ", 32, 0, 0, 9, 6000), "too few for the 5,000,000 Gaussians"),
        (gzip.compress(_header(3, 5) + bytes(80)), "gaussforge cannot read it"),
    ],
    ids=["other", "a bomb", "a count", "a bomb of version 4", "none", "few", "few of version 4", "cut"],
)
def test_bad_spz_files_are_refused_before_they_fill_memory(tmp_path, capfd, data, message):
    pytest.importorskip("gaussforge")
    path = tmp_path / "a.spz"
    path.write_bytes(data)
    with pytest.raises(DataError, match=message):
        read_splats(path)
    assert capfd.readouterr() == ("", "")  # the library has its own words on stdout and stderr
