"""Folders of phones and rigs: written, read back, damaged."""

import io
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from folders import (
    CAMERAS,
    COUNT,
    FPS,
    INSTANTS,
    NAN,
    POINTS,
    SOCKET,
    assert_same,
    changed,
    eye,
    npy,
    quaternion,
    rig_videos,
    rig_views,
    save,
)
from test_colmap import write_synchronised

from pd4dgs_codec.data.captures import read_cameras
from pd4dgs_codec.data.dataset import load
from pd4dgs_codec.data.files import shrink_image, shrink_mask
from pd4dgs_codec.data.view import OPENGL_TO_OPENCV, Dataset, View
from pd4dgs_codec.errors import DataError


def _camera(view: View, factor: int = 1, scale: float = 1.0, center: float | np.ndarray = 0.0) -> dict[str, Any]:
    rotation, place = eye(view)
    K = view.K.astype(np.float64) * factor
    return {
        "orientation": rotation.tolist(), "position": (place / scale + center).tolist(), "focal_length": K[0, 0],
        "pixel_aspect_ratio": K[1, 1] / K[0, 0], "principal_point": [K[0, 2], K[1, 2]],
        "image_size": [factor * view.width, factor * view.height], "skew": 0.0,
        "radial_distortion": [0.0] * 3, "tangential_distortion": [0.0] * 2,
    }  # fmt: skip


def write_iphone(dataset: Dataset, folder: Path, factors: tuple[int, ...] = (1,)) -> Path:
    """The layout has no masks of training views and no colours of points. factors: of the sets of pictures."""
    views = [*dataset.train, *dataset.test]
    for view in views:
        save(folder / "camera" / f"{view.name}.json", _camera(view))
        for k in factors:
            save(folder / "rgb" / f"{k}x" / f"{view.name}.png", shrink_image(view.image, k))
            if dataset.masked and view in dataset.test:
                mask = shrink_mask(view.mask, k).astype(np.uint8) * 255
                save(folder / "covisible" / f"{k}x" / "val" / f"{view.name}.png", mask)
    for split, part in (("train", dataset.train), ("val", dataset.test)):
        save(folder / "splits" / f"{split}.json", {"frame_names": [view.name for view in part]})
    rows = {view.name: {"warp_id": view.time, "camera_id": view.camera_id} for view in views}
    save(folder / "metadata.json", rows)
    save(folder / "scene.json", {"center": [0.0] * 3, "scale": 1.0, "near": dataset.near, "far": dataset.far})
    extra = {"factor": 1, "fps": 1 / (dataset.time_range[1] - dataset.time_range[0]), "bbox": dataset.box.tolist()}
    save(folder / "extra.json", extra | {"up": list(dataset.up), "background": list(dataset.background)})
    if dataset.points is not None:
        np.save(folder / "points.npy", dataset.points)
    return folder


def write_hypernerf(scene: Dataset, folder: Path, scale: float = 0.25, center: float = 3.0) -> Path:
    """In other units and around another centre; pictures of half the size of the cameras."""
    names = [f"{i:06d}" for i in range(COUNT)]
    for name, view in zip(names, scene.train, strict=False):
        save(folder / "camera" / f"{name}.json", _camera(view, 2, scale, center))
        save(folder / "rgb" / "2x" / f"{name}.png", view.image)
    save(folder / "dataset.json", {"ids": names, "train_ids": names[::2], "val_ids": names[1::2], "count": COUNT})
    save(folder / "metadata.json", {name: {"warp_id": i, "camera_id": 0} for i, name in enumerate(names)})
    save(folder / "scene.json", {"scale": scale, "center": [center] * 3, "near": 0.1, "far": 9.0})
    np.save(folder / "points.npy", scene.points[:POINTS] / scale + center)
    return folder


def write_record3d(scene: Dataset, folder: Path, *, stamps: bool = True) -> Path:
    """stamps: a time and intrinsics for each frame."""
    poses, coefficients = [], []
    for i, view in enumerate(scene.train[:COUNT]):
        (w, x, y, z), K = quaternion(eye(view)[0].T @ OPENGL_TO_OPENCV), view.K.astype(float)
        poses.append([x, y, z, w, *eye(view)[1]])
        coefficients.append([K[0, 0], K[1, 1], K[0, 2], K[1, 2]])
        save(folder / "rgbd" / f"{i}.png", view.image)
    first = scene.train[0]
    meta = {"w": first.width, "h": first.height, "K": first.K.T.ravel().tolist(), "fps": 30, "poses": poses}
    if stamps:
        meta |= {"frameTimestamps": [5.0 + i / 20 for i in range(COUNT)], "perFrameIntrinsicCoeffs": coefficients}
    save(folder / "metadata", meta)
    return folder


def tiny(test_times=(1 / 3,)) -> Dataset:
    """Training views 0_00000 to 0_00002, held-out ones from 1_00001 on."""
    rng = np.random.default_rng(0)
    K = np.array([[20, 0, 7], [0, 22, 6.5], [0, 0, 1]], np.float32)

    def view(i: int, t: float, camera: int) -> View:
        viewmat = np.eye(4, dtype=np.float32)
        viewmat[:3, 3] = i
        image = rng.integers(0, 256, (12, 16, 3)).astype(np.uint8)
        return View(viewmat, K, 16, 12, t, image, None, f"{camera}_{i:05d}", camera)

    train = tuple(view(i, t, 0) for i, t in enumerate((0.0, 1 / 3, 1.0)))
    test = tuple(view(i, t, 1) for i, t in enumerate(test_times, 1))
    box = np.array([[-1, -1, -1], [1, 1, 1]], np.float32)
    return Dataset("tiny", train, test, None, box, 0.1, 9.0, (0, 0, 0), (0, 1), (0, 1, 0), False)


def masked(dataset: Dataset, mask: np.ndarray) -> Dataset:
    """The dataset with this covisibility mask of every held-out view."""
    return replace(dataset, test=tuple(replace(view, mask=mask) for view in dataset.test), masked=True)


def write_whole(_: object, folder: Path) -> Path:
    """Every file that the layout may have."""
    points = np.arange(12, dtype=np.float32).reshape(4, 3)
    return write_iphone(replace(masked(tiny(), np.ones((12, 16), bool)), points=points), folder)


def write_neu3d(scene: Dataset, folder: Path, cameras: int = CAMERAS) -> Path:
    """Nearest depth 1, farthest 9."""
    folder.mkdir()
    rig_videos(scene, folder, cameras)
    rows = []
    for camera in range(cameras):
        view = rig_views(scene, camera)[0]
        (right, down, ahead), place = eye(view)
        lens = [view.height, view.width, float(view.K[0, 0])]
        rows.append([*np.stack([down, right, -ahead, place, lens], axis=1).ravel(), 1.0, 9.0])
    np.save(folder / "poses_bounds.npy", np.array(rows))
    return folder


def write_panoptic(scene: Dataset, folder: Path) -> Path:
    """The view of camera c at instant t is training view t * CAMERAS + c."""
    instants = [scene.train[t * CAMERAS : (t + 1) * CAMERAS] for t in range(INSTANTS)]
    names = [[f"{camera}/{t:06d}.png" for camera in range(CAMERAS)] for t in range(INSTANTS)]
    for row, views in zip(names, instants, strict=True):
        for name, view in zip(row, views, strict=True):
            save(folder / "ims" / name, view.image)
    meta = {
        "w": scene.train[0].width, "h": scene.train[0].height, "fn": names,
        "k": [[view.K.tolist() for view in views] for views in instants],
        "w2c": [[view.viewmat.tolist() for view in views] for views in instants],
        "cam_id": [list(range(CAMERAS))] * INSTANTS,
    }  # fmt: skip
    save(folder / "train_meta.json", meta)
    rows = np.concatenate([scene.points[:POINTS], np.full((POINTS, 4), 0.5)], axis=1)
    np.savez(folder / "init_pt_cld.npz", data=rows)
    return folder


#: The header of a .npy file; its shape is filled in.
DESCRIBED = "{{'descr': '<f8', 'fortran_order': False, 'shape': {}}}"


def header(text: str) -> bytes:
    """A .npy file of this header and a few bytes."""
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode() + bytes(80)


def archive(method: int = zipfile.ZIP_DEFLATED, size: int = 80) -> bytes:
    """A .npz file whose `data` is `size` zeros."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as file:
        file.writestr("data.npy", bytes(size))
    return stream.getvalue()


def times(factors: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Columns of poses_bounds.npy times factors."""
    return lambda poses: poses * factors


COLUMN = np.arange(17)
LAYOUTS = {"iphone": write_whole, "record3d": write_record3d, "panoptic": write_panoptic, "neu3d": write_neu3d}
CAMERA = "camera/0_00000.json"
FAULTS = {
    "iphone": [
        (CAMERA, {"focal_length": NAN}, "0_00000.json: focal_length is nan"),
        (CAMERA, {"focal_length": None}, "0_00000.json: focal_length is None"),
        (CAMERA, {"orientation": (2 * np.eye(3)).tolist()}, "orientation is not a rotation: determinant 8"),
        (CAMERA, {"position": [0, 0]}, "position has shape (2,), expected (3,)"),
        (CAMERA, {"image_size": [1, 1]}, "expected at least 2x2"),
        (CAMERA, {"image_size": [14, 8]}, "image is 16x12, expected 14x8"),
        ("rgb/1x/0_00000.png", SOCKET, "0_00000.png: is not a regular file"),
        ("metadata.json", b"{}", "no entry for frame '0_00000'"),
        ("metadata.json", {"0_00000": {}}, "warp_id is None"),
        ("splits/train.json", {"frame_names": []}, "0 training frames, expected at least 1"),
        ("splits/train.json", {"frame_names": [3]}, "not a list of frame names"),
        ("scene.json", {"scale": 0}, "scale is 0"),
        ("scene.json", {"near": 10}, "near 10 and far 9"),
        ("scene.json", None, "scene.json: cannot be read"),
        ("extra.json", {"factor": 1.5}, "factor is 1.5"),
        ("extra.json", {"bbox": [[1, 1, 1], [0, 0, 0]]}, "expected a lower and an upper corner"),
        ("extra.json", {"fps": 0}, "fps is 0"),
        ("points.npy", b"junk", "points.npy: not a .npy file"),
        ("points.npy", npy(np.zeros((3, 2))), "found float64 (3, 2), expected floats [M, 3]"),
        ("points.npy", npy(np.array([{}], dtype=object)), "points.npy: not a .npy file"),
        ("splits/train.json", {"frame_names": ["../camera/0_00000"]}, "no entry for frame"),
        ("splits/train.json", {"frame_names": ["0_00000"] * 2}, "names a frame twice"),
        ("metadata.json", {"0_00000": {"warp_id": [1]}}, "warp_id is [1]"),
    ],
    "record3d": [
        ("metadata", SOCKET, "metadata: is not a regular file"),
        ("metadata", {"poses": []}, "found no poses"),
        ("metadata", lambda m: m | {"poses": [row[:6] for row in m["poses"]]}, "expected (12, 7)"),
        ("metadata", {"poses": [[0, 0, 0, 2, 0, 0, 0]] * COUNT}, "pose 0: quaternion of length 2, expected 1"),
        ("metadata", {"frameTimestamps": [0.0]}, "frameTimestamps are not 12 numbers"),
        ("metadata", {"perFrameIntrinsicCoeffs": [[0, 1, 2, 3]] * COUNT}, "a focal length is not above 0"),
        ("metadata", {"perFrameIntrinsicCoeffs": None, "K": None}, "K"),
        ("metadata", {"w": 8}, "expected 8x"),
    ],
    "panoptic": [
        ("train_meta.json", lambda m: m | {"k": m["k"][:1]}, "lists of equal length"),
        ("train_meta.json", lambda m: m | {"fn": [row[:1] for row in m["fn"]]}, "instant 0: expected lists"),
        ("train_meta.json", {"fn": [["../x.png"] * CAMERAS] * INSTANTS}, "../x.png' is not the name"),
        ("train_meta.json", {"fn": [["9/a.png"] * CAMERAS] * INSTANTS}, "image is missing"),
        (
            "train_meta.json", {"w2c": [[(2 * np.eye(4)).tolist()] * CAMERAS] * INSTANTS},
            "instant 0: 0/000000.png: w2c is not a rotation",
        ),
        ("train_meta.json", {"k": [[np.zeros((3, 3)).tolist()] * CAMERAS] * INSTANTS}, "with fx, fy > 0"),
        ("train_meta.json", {"w": 7}, "expected 7x"),
        ("train_meta.json", {"h": 0}, "h is 0"),
        ("init_pt_cld.npz", lambda _: archive(size=50_000_000), "data unpacks to more than 1,"),
        ("init_pt_cld.npz", npy(np.array([{}]), archive=True), "data: not a .npy file"),
        ("init_pt_cld.npz", npy(np.zeros((4, 2)), archive=True), "expected numbers [M, 6]"),
        ("init_pt_cld.npz", archive(zipfile.ZIP_BZIP2), "compressed by method 12, expected deflate"),
        ("init_pt_cld.npz", archive(zipfile.ZIP_LZMA), "compressed by method 14, expected deflate"),
        ("init_pt_cld.npz", archive()[:-30], "not an archive of numpy"),
        ("init_pt_cld.npz", b"no archive", "not an archive of numpy"),
    ],
    "neu3d": [
        ("poses_bounds.npy", lambda poses: poses[:2], "3 videos cam*.mp4, expected 2 as in poses"),
        ("poses_bounds.npy", lambda poses: poses[:, :16], "rows of 17"),
        ("poses_bounds.npy", times(COLUMN * NAN), "expected finite numbers"),
        ("poses_bounds.npy", times(np.where(COLUMN < 3, 1.5, 1)), "is not a rotation"),
        ("poses_bounds.npy", times(np.where(COLUMN == 4, 2, 1)), "expected the same shape"),
        ("poses_bounds.npy", times(np.where(COLUMN == 15, 20, 1)), "0 < nearest < farthest"),
        ("poses_bounds.npy", npy(np.array([{}])), "not a .npy file"),
        ("poses_bounds.npy", header("{'descr': '<f8', 'shape': " + "(" * 3000), "not a .npy file of numbers"),
        ("poses_bounds.npy", header("{'descr': '<f8', 'shape': \'\'\'"), "not a .npy file of numbers"),
        *(
            ("poses_bounds.npy", header(DESCRIBED.format(shape)), "not a .npy file of numbers")
            for shape in ("(" + "9" * 40 + ",)", "(-3, 17)", "(1 << 40, 17)", "(1000000000, 17)")
        ),
        ("poses_bounds.npy", header("{'descr': [('a', 'f8')], 'fortran_order': False, 'shape': ()}"), "expected"),
        ("poses_bounds.npy", b"PK\x03\x04", "not a .npy file of numbers"),
        ("cam1.mp4", b"no video", "cam1.mp4: cannot be decoded"),
        ("cam1.mp4", None, "2 videos cam*.mp4, expected 3 as in poses"),
    ],
}  # fmt: skip


def test_a_time_beyond_binary32_is_refused(tmp_path, refused):
    folder = write_whole(None, tmp_path)
    changed(folder / "metadata.json", {"1_00001": {"warp_id": 9}})
    changed(folder / "extra.json", {"fps": 1e-300})
    refused(folder, "times from 0 to 9e+300, expected at most 3.4e+38")


# -- iPhone, Nerfies, HyperNeRF ----------------------------------------------------------------------------------------


def same_views(a: tuple[View, ...], b: tuple[View, ...]) -> None:
    for x, y in zip(a, b, strict=True):
        assert (x.name, x.camera_id, x.width, x.height) == (y.name, y.camera_id, y.width, y.height)
        assert x.time == pytest.approx(y.time, abs=1e-6) and (x.mask is None) == (y.mask is None)
        assert_same(x, y)
        np.testing.assert_array_equal(x.mask, y.mask)


def test_an_iphone_scene_is_read_back(scene, tmp_path):
    a, b = scene, load(write_iphone(scene, tmp_path / "out"))
    same_views(a.train + a.test, b.train + b.test)
    assert a.masked and b.masked
    np.testing.assert_array_equal(a.points, b.points)
    np.testing.assert_allclose(a.box, b.box)
    assert (a.near, a.far, a.up, a.background) == (b.near, b.far, b.up, b.background)
    assert b.time_range == pytest.approx(a.time_range)


@pytest.fixture
def exported(tmp_path) -> Path:
    return write_iphone(tiny(), tmp_path / "out")


def test_a_scene_without_masks_and_points(exported):
    d = load(exported)
    assert not d.masked and d.points is None
    same_views(tiny().train + tiny().test, d.train + d.test)


def test_center_and_scale(exported):
    changed(exported / "scene.json", {"center": [1.0, 2.0, 3.0], "scale": 0.5})
    points = np.array([[3.0, 2.0, 5.0], [5.0, 2.0, 5.0], [3.0, 4.0, 5.0], [3.0, 2.0, 7.0], [np.nan, 0, 0]])
    np.save(exported / "points.npy", points)
    d = load(exported)
    before = np.array([-1.0, -1.0, -1.0])  # view 1: t = (1, 1, 1), no rotation
    np.testing.assert_allclose(-d.train[1].viewmat[:3, 3], (before - [1, 2, 3]) * 0.5, atol=1e-6)
    np.testing.assert_allclose(d.points, [[1, 0, 1], [2, 0, 1], [1, 1, 1], [1, 0, 2]])
    assert (d.near, d.far) == (0.1, 9.0)  # already scaled


def test_factor_and_aspect(tmp_path):
    folder = write_iphone(tiny(), tmp_path / "out", factors=(1, 2))
    changed(folder / "extra.json", {"factor": 2})
    changed(folder / CAMERA, {"focal_length": 30.0, "pixel_aspect_ratio": 1.2, "principal_point": [7.5, 5.0]})
    d = load(folder)
    assert d.train[0].image.shape == (6, 8, 3)
    np.testing.assert_allclose(d.train[0].K, [[15, 0, 3.75], [0, 18, 2.5], [0, 0, 1]])


def test_distorted_and_skewed_views_get_a_border_mask(exported):
    distortion = {"tangential_distortion": [0.02, -0.03], "radial_distortion": [0.3, 0.1, 0.0]}
    changed(exported / "camera" / "1_00001.json", distortion)
    changed(exported / CAMERA, {"skew": 4.0})
    d = load(exported)
    assert d.test[0].mask is not None and 0.3 < d.test[0].mask.mean() < 1
    assert d.train[0].K[0, 1] == 0 and d.train[0].mask is not None and d.train[1].mask is None


def test_border_and_covisibility_both_mask(tmp_path):
    mask = np.ones((12, 16), bool)
    mask[:, 8] = False
    folder = write_iphone(masked(tiny(test_times=(1 / 3, 1.0)), mask), tmp_path / "out")
    changed(folder / "camera" / "1_00001.json", {"radial_distortion": [0.9, 0.0, 0.0]})
    mask = load(folder).test[0].mask
    assert not mask[:, 8].any() and not mask[0, 0] and not mask[-1, -1] and mask[6, 7]
    next((folder / "covisible" / "1x" / "val").iterdir()).unlink()
    with pytest.raises(DataError, match="covisibility mask is missing"):
        load(folder)


def test_hypernerf_is_read_back(scene, tmp_path):
    data = load(write_hypernerf(scene, tmp_path / "set"))
    assert len(data.train) == len(data.test) == COUNT // 2 and (data.near, data.far) == (0.1, 9.0)
    for i, view in enumerate(scene.train[:COUNT]):
        found = (data.test if i % 2 else data.train)[i // 2]
        assert_same(found, view)
        assert found.name == f"{i:06d}" and found.time == pytest.approx(i / (COUNT - 1))
    np.testing.assert_allclose(data.points, scene.points[:POINTS], atol=1e-5)
    changed(tmp_path / "set" / "dataset.json", {"val_ids": []})  # then HyperNeRF's rule holds
    data = load(tmp_path / "set")
    assert [v.name for v in data.train] == ["000000", "000004", "000008"]
    assert [v.name for v in data.test] == ["000002", "000006", "000010"]


def test_paper_windmill_cameras(shared):
    files = read_cameras(shared("paper-windmill"))
    assert (len(files.train), len(files.test)) == (277, 419) and files.factor == 2
    assert {f.camera_id for f in files.train} == {0} and {f.camera_id for f in files.test} == {1, 2}
    lens = files.train[0].lens
    assert (lens.width, lens.height) == (360, 480) and lens.is_pinhole
    expected = (719.9471435546875 / 2, 358.8895263671875 / 2, 484.92236328125 / 2)
    assert (lens.fx, lens.cx, lens.cy) == pytest.approx(expected)
    center = -files.train[0].viewmat[:3, :3].T @ files.train[0].viewmat[:3, 3]
    expected = np.array([0, 4.656612873077393e-10, 0]) - [-0.20061972737312317, 0.1705830693244934, -1.1717479228973389]
    np.testing.assert_allclose(center, expected * 0.2715916376300303, atol=1e-9)
    assert files.train[-1].time == 276
    with pytest.raises(DataError, match=r"rgb/2x/0_00000.png: image is missing"):
        load(shared("paper-windmill"))


# -- Record3D ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("stamps", [True, False])
def test_record3d_is_read_back(scene, tmp_path, stamps):
    data = load(write_record3d(scene, tmp_path / "set", stamps=stamps), holdout=0)
    first, rate = (5.0, 20) if stamps else (0.0, 30)
    assert len(data.train) == COUNT and data.time_range == pytest.approx((first, first + (COUNT - 1) / rate))
    for found, view in zip(data.train, scene.train, strict=False):
        assert_same(found, view)


def test_panoptic_is_read_back(scene, tmp_path):
    data = load(write_panoptic(scene, tmp_path / "set"))
    assert len(data.test) == INSTANTS and len(data.train) == INSTANTS * (CAMERAS - 1)
    assert data.time_range == pytest.approx((0, (INSTANTS - 1) / 30))
    for found in (*data.train, *data.test):
        assert_same(found, scene.train[round(found.time * (INSTANTS - 1)) * CAMERAS + found.camera_id])
    assert {view.camera_id for view in data.test} == {0}
    np.testing.assert_allclose(data.points, scene.points[:POINTS], atol=1e-6)
    assert not load(tmp_path / "set", holdout=0).test
    (tmp_path / "set" / "test_meta.json").write_text((tmp_path / "set" / "train_meta.json").read_text())
    assert len(load(tmp_path / "set").test) == INSTANTS * CAMERAS


@pytest.mark.parametrize("write", [write_neu3d, write_synchronised])
def test_rigs_of_videos_are_read_back(scene, tmp_path, write):
    data = load(write(scene, tmp_path / "set"))
    assert len(data.train) == (CAMERAS - 1) * INSTANTS and len(data.test) == INSTANTS
    assert data.time_range == (0.0, pytest.approx((INSTANTS - 1) / FPS)) and {v.camera_id for v in data.test} == {0}
    for found in (*data.train, *data.test):
        views, t = rig_views(scene, found.camera_id), round(found.time * (INSTANTS - 1))
        np.testing.assert_allclose(found.viewmat, views[0].viewmat, atol=1e-6)
        np.testing.assert_array_equal(found.image, views[t].image)
        assert found.name == f"cam{found.camera_id}_{t:04d}" and found.K[0, 0] == pytest.approx(views[0].K[0, 0])
        centre = views[0].width / 2 if write == write_neu3d else views[0].K[0, 2]
        assert found.K[0, 2] == pytest.approx(centre)
    assert write != write_neu3d or (data.near, data.far) == (0.5, 9)
    assert not load(tmp_path / "set", holdout=0).test


def test_videos_smaller_than_their_poses_scale_the_lens(scene, tmp_path):
    folder = write_neu3d(scene, tmp_path / "set", cameras=1)
    poses = np.load(folder / "poses_bounds.npy")
    poses[:, :15].reshape(-1, 3, 5)[:, :, 4] *= 2  # height, width and focal length of the full pictures
    np.save(folder / "poses_bounds.npy", poses)
    view = load(folder, downscale=2, holdout=0).train[0]
    np.testing.assert_allclose(view.K[0, 0], scene.train[0].K[0, 0] / 2, rtol=1e-6)
    assert (view.width, view.height) == (scene.train[0].width // 2, scene.train[0].height // 2)
