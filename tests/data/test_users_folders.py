"""Folders as users have them: several models, deleted pictures, masks of all kinds, names of other systems. What can be
read is read, and what was assumed or left out is told and counted."""

import json
import os
import shutil
import struct
from pathlib import Path

import numpy as np
import pytest
from folders import COUNT, change_frames, gradient, pose, save
from PIL import Image
from test_colmap import colmap_name, write_colmap
from test_picture_kinds import oriented

from pd4dgs_codec.data.dataset import load
from pd4dgs_codec.data.files import find_image, read_mask, reading_folder
from pd4dgs_codec.data.view import up_direction
from pd4dgs_codec.errors import DataError

DISC = np.add.outer((np.arange(8) - 4) ** 2, (np.arange(12) - 6) ** 2) > 9  #: valid outside of it
LEVELS = np.where(DISC, 255, 0).astype(np.uint8)
WHITE, BLACK = (np.full((8, 12, 3), level, np.uint8) for level in (255, 0))


def told(source: Path, **options) -> str:
    """All lines about a data set."""
    data = load(source, **options)
    return "\n".join([*data.summary(), *data.remarks()])


# -- models ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kept", [(0, 1), (1,)])
@pytest.mark.parametrize("form", ["binary", "text"])
def test_the_largest_model_is_read(scene, tmp_path, kept, form):
    """COLMAP's mapper made two models, of which the first holds few pictures."""
    folder = write_colmap(scene, tmp_path / "set", form)
    (folder / "sparse" / "0").rename(folder / "sparse" / "1")
    (folder / "sparse" / "0").mkdir()
    for path in (folder / "sparse" / "1").iterdir() if 0 in kept else []:
        shutil.copy(path, folder / "sparse" / "0")
    if 0 in kept and form == "binary":
        images = folder / "sparse" / "0" / "images.bin"
        images.write_bytes(struct.pack("<Q", 3) + images.read_bytes()[8:])
    elif 0 in kept:
        images = folder / "sparse" / "0" / "images.txt"
        lines = [line for line in images.read_text().splitlines() if not line.startswith("#")]
        images.write_text("\n".join(lines[:6]) + "\n")
    save(folder / "images" / "cam" / "no_pose.png", gradient(4, 4))
    data = load(folder, holdout=0)
    assert len(data.train) == COUNT
    assert f"{COUNT} of {COUNT + 1} pictures have a pose in sparse/1" in data.summary()[0]
    other = "models besides sparse/1, which has the most pictures (1): sparse/0 with 3 pictures"
    assert data.remarks() == [other] * (0 in kept)


# -- splits and deleted pictures ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("frames", [[], [{"file_path": "test/0", "time": 0, "transform_matrix": pose()}]])
def test_a_test_split_without_pictures_counts_as_none(blender, frames):
    folder = blender(name="transforms_train.json")
    save(folder / "transforms_test.json", {"camera_angle_x": 0.8, "w": 12, "h": 8, "frames": frames})
    data = load(folder)
    assert (len(data.train), len(data.test)) == (8, 1)
    assert data.remarks() == [
        f"no picture of these test frames is there, so that they count as none (1): {len(frames)} of "
        "transforms_test.json"
    ]
    file = json.loads((folder / "transforms_train.json").read_text())
    save(folder / "transforms_val.json", file | {"frames": file["frames"][:2]})
    assert len(load(folder).test) == 2


def test_deleted_pictures_are_left_out_and_counted(blender, scene, tmp_path):
    folder = blender()
    for i in (5, 7):
        (folder / f"r_{i:03d}.png").unlink()
    data = load(folder, holdout=0)
    assert len(data.train) == 7 and data.remarks() == ["views left out, as their picture is missing (2): r_005, r_007"]
    folder = write_colmap(scene, tmp_path / "set")
    (folder / "images" / colmap_name(3)).unlink()
    data = load(folder, holdout=0)
    assert len(data.train) == COUNT - 1 and colmap_name(3) in data.remarks()[0]


# -- masks -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "pixels"),
    {
        "m.png": LEVELS,
        "labels.png": LEVELS // 255,
        "one-bit.png": DISC,
        "deep.png": LEVELS.astype(np.uint16) * 257,
        "m.jpg": LEVELS,
        "white.png": np.dstack([WHITE, LEVELS]),
        "black.png": np.dstack([BLACK, LEVELS]),
        "opaque.png": np.dstack([np.repeat(LEVELS[..., None], 3, 2), np.full((8, 12), 255, np.uint8)]),
        "large.png": LEVELS.repeat(2, 0).repeat(2, 1),
    }.items(),
)
def test_masks_of_all_kinds(tmp_path, name, pixels):
    Image.fromarray(pixels).save(tmp_path / name, **({"quality": 75} if name.endswith("jpg") else {}))
    assert (read_mask(tmp_path / name, (12, 8)) == DISC).mean() > 0.98


def test_a_black_jpeg_mask_has_no_valid_pixel_in_spite_of_its_noise(tmp_path):
    Image.fromarray(np.random.default_rng(0).integers(0, 9, (8, 12), dtype=np.uint8)).save(tmp_path / "m.jpg")
    assert not read_mask(tmp_path / "m.jpg", (12, 8)).any()


def test_a_mask_of_half_the_size_is_scaled_and_one_of_another_shape_refused(blender, refused):
    folder = blender(n=3, frame0={"mask_path": "masks/0.png"})
    save(folder / "masks" / "0.png", LEVELS[::2, ::2])
    data = load(folder, holdout=0)
    assert data.train[0].mask.shape == (8, 12) and (data.train[0].mask == DISC).mean() > 0.85
    assert data.remarks() == ["masks scaled to 12x8 (1): 0.png of 6x4"]
    save(folder / "masks" / "0.png", LEVELS[::2])
    refused(folder, "mask is 12x4, expected 12x8 or a multiple or fraction of it", holdout=0)


@pytest.mark.parametrize("named", ["{}.png", "{}"])
def test_masks_beside_a_colmap_model_are_read(scene, tmp_path, named):
    folder = write_colmap(scene, tmp_path / "set")
    height, width = scene.train[0].image.shape[:2]
    valid = np.arange(width) < width // 2
    for i in range(1, COUNT):
        mask = np.where(valid, 255, 0).astype(np.uint8)[None].repeat(height, 0)
        save(folder / "masks" / named.format(colmap_name(i)), mask)
    data = load(folder, holdout=0)
    assert data.train[0].mask is None and all((view.mask == valid).all() for view in data.train[1:])
    assert data.remarks() == [f"pictures without a mask in masks/ (1): {colmap_name(0)}"]
    assert "masks leave out 46 % of the pixels" in data.summary()[2]


# -- names -------------------------------------------------------------------------------------------------------------

NAMED = {  # in the file, on disk, and whether it is told
    "images\\0.png": ("images/0.png", False),
    ".\\images\\0": ("images/0.png", False),
    "images/0.jpg": ("images/0.JPG", True),
    "Images/0.png": ("images/0.png", False),
    "images/0": ("images/0.webp", False),
    "images/0.tif": ("images/0.tiff", False),
    "images/0.png": ("images/0.jpg", True),
    "0.png": ("0.png.png", False),
    "a b/厨房 0.PNG": ("a b/厨房 0.png", True),
}


@pytest.mark.parametrize("name", NAMED)
def test_names_of_other_systems(tmp_path, name):
    disk, remark = NAMED[name]
    save(tmp_path / disk, gradient(12, 8))
    with reading_folder(tmp_path) as reading:
        assert find_image(tmp_path, name) == tmp_path / disk
    assert len(reading.remarks()) == remark


@pytest.mark.parametrize(
    "name", ["/home/me/0.png", "C:\\data\\0.png", "c:/data/0.png", "..\\0.png", "a\\..\\..\\0.png"]
)
def test_names_that_lead_out_of_the_folder_are_refused(tmp_path, name):
    with pytest.raises(DataError, match="is not the name of a file in this folder"):
        find_image(tmp_path, name)


def test_names_that_are_not_utf_8_are_found(scene, tmp_path):
    folder, names = write_colmap(scene, tmp_path / "set"), {}
    for i in range(COUNT):
        names[colmap_name(i).encode()] = "厨房".encode("gbk") + f"_{i:06d}.png".encode()  # as long as the other
    model = folder / "sparse" / "0" / "images.bin"
    raw = model.read_bytes()
    for plain, name in names.items():
        assert len(name.rjust(len(plain), b"_")) == len(plain)
        other = b"cam/" + name.rjust(len(plain) - 4, b"_")
        raw = raw.replace(plain, other)
        os.rename(folder / "images" / plain.decode(), os.fsencode(folder / "images") + b"/" + other)
    model.write_bytes(raw)
    data = load(folder, holdout=0)
    assert len(data.train) == COUNT and data.remarks() == [] and data.train[3].time == pytest.approx(3 / 11)


# -- pictures of other sizes -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("flag", [3, 6, 8])
@pytest.mark.parametrize("stored", [True, False])
def test_exif_rotation(blender, flag, stored):
    """The camera has the size of the stored pixels, as COLMAP takes them, or that of the turned ones."""
    folder, smooth = blender(n=2, size=(12, 8), w=12, h=8), gradient(12, 8) // 8 + 100
    turned = np.rot90(smooth, {3: 2, 6: 1, 8: -1}[flag])  # a viewer turns it back
    for i in range(2):
        name = f"r_{i:03d}.jpg"
        (folder / name).with_suffix(".png").unlink()
        Image.fromarray(smooth if stored else np.ascontiguousarray(turned)).save(
            folder / name, quality=100, exif=oriented(flag)
        )
    data = load(folder, holdout=0)
    expected = turned if flag == 3 and not stored else smooth  # a half turn shows in no size
    assert np.abs(data.train[0].image.astype(int) - expected).max() < 8
    noted = "not turned as EXIF says, since the camera has the stored size (2): r_000.jpg, r_001.jpg"
    assert data.remarks() == [noted] * (stored or flag == 3)


def test_a_lens_is_scaled_to_smaller_pictures_and_refused_for_cropped_ones(blender, refused):
    folder = blender(n=3, w=24, h=17, fl_x=20, fl_y=40, cx=12, cy=8.5)
    data = load(folder, holdout=0)
    np.testing.assert_allclose(data.train[0].K, [[10, 0, 6], [0, 40 * 8 / 17, 4], [0, 0, 1]], rtol=1e-6)
    assert data.remarks()[0].startswith("lens scaled to the size of the picture (3): r_000.png of 12x8, not as the")
    change_frames(folder, lambda i: {"w": 13, "h": 8})
    refused(folder, "r_000.png: image is 12x8, expected 13x8 as the camera has; correct one of them")


@pytest.mark.parametrize("lens", [{"k1": 1e-320}, {"k1": 1, "k3": 1e-310}, {"k1": -1e-300, "k2": 5e-324}])
def test_coefficients_of_almost_nothing_are_none(blender, lens):
    """Numbers that cannot be divided by."""
    view = load(blender(n=1, fl_x=10, **lens), holdout=0).train[0]
    np.testing.assert_allclose(view.K[0, 0], 10)


def test_warnings_of_libraries_do_not_reach_the_terminal(blender, recwarn):
    folder = blender(n=1)
    (folder / "r_000.png").unlink()
    tags = {256: 12, 257: 8, 258: 8, 259: 1, 262: 1, 273: 8, 277: 1, 278: 8, 279: 96}
    rows = b"".join(struct.pack("<HHII", tag, 3, 2 if tag == 278 else 1, value) for tag, value in tags.items())
    (folder / "r_000.tif").write_bytes(b"II*\0" + struct.pack("<IH", 8, len(tags)) + rows + bytes(200))
    with pytest.warns(UserWarning, match="too many entries"):
        Image.open(folder / "r_000.tif").load()
    assert load(folder, holdout=0).train[0].image.shape == (8, 12, 3) and not recwarn.list


# -- what is told ------------------------------------------------------------------------------------------------------


def test_four_lines_tell_what_was_read(blender):
    folder = blender(n=9)
    assert load(folder).summary() == [
        "views: 8 to train on, 1 held out, of 12x8, 9 of 9 pictures have a pose, 0.0 MB in memory",
        "times: 9 instants, 0 to 0.8 s, from `time` of each frame",
        "colours: no alpha, background 0,0,0",
        "start points: 0",
    ]
    for source in ("synthetic:static?frames=3&size=16x12", folder):
        assert len(load(source, holdout=0).summary()) == 4


# -- up ----------------------------------------------------------------------------------------------------------------


def looking(eyes: np.ndarray, roll: np.ndarray | float = 0.0) -> list[np.ndarray]:
    """World-to-camera rotations of cameras that look at 0, level but for a roll in radians."""
    views = []
    for eye, angle in zip(eyes, np.broadcast_to(roll, len(eyes)), strict=True):
        ahead = -eye / np.linalg.norm(eye)
        right = np.cross(ahead, [0, 0, 1])
        right /= np.linalg.norm(right)
        down = np.cross(ahead, right)
        c, s = np.cos(angle), np.sin(angle)
        views.append(np.stack([c * right + s * down, c * down - s * right, ahead]))
    return views


def tilt(views: list[np.ndarray]) -> float:
    """Degrees from up_direction to +z."""
    return float(np.degrees(np.arccos(np.clip(up_direction(views)[2], -1, 1))))


ARC = np.linspace(0, np.pi / 2, 30)
DOWN = np.stack([3 * np.cos(ARC), 3 * np.sin(ARC), np.full(30, 2.5)], axis=1)  #: cameras on an arc that look down
DOME = np.random.default_rng(0).normal(size=(60, 3)) * [1, 1, 0.5] + [0, 0, 1]


def test_up_of_cameras_that_look_down():
    views = looking(DOWN)
    mean = -np.mean([view[1] for view in views], axis=0)
    assert mean[2] / np.linalg.norm(mean) < np.cos(np.radians(30))  # what was taken before
    assert tilt(views) < 0.01
    roll = np.radians(2) * np.random.default_rng(1).normal(size=30)
    assert tilt(looking(DOWN, roll)) < 1.5
    straight = [np.stack([[np.cos(a), np.sin(a), 0], [np.sin(a), -np.cos(a), 0], [0, 0, -1]]) for a in 4 * ARC]
    assert tilt(straight) < 0.01
    assert tilt([view @ np.diag([1, -1, -1]) for view in straight]) > 179.9  # they look up


def test_up_of_a_dome():
    assert tilt(looking(DOME)) < 0.01


@pytest.mark.parametrize("count", [1, 20])
def test_up_of_cameras_that_face_one_way_is_the_mean_of_theirs(count):
    """Of a single camera, and of a row: their right vectors are parallel."""
    view = looking(DOWN)[0]
    assert up_direction([view] * count) == pytest.approx(tuple(-view[1]))


def test_up_of_cameras_that_roll_is_the_mean_of_theirs():
    views = looking(DOME, np.random.default_rng(2).uniform(-1.5, 1.5, len(DOME)))
    mean = -np.mean([view[1] for view in views], axis=0)
    assert up_direction(views) == pytest.approx(tuple(mean / np.linalg.norm(mean)))
