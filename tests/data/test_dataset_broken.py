"""Broken datasets: each reader raises a DataError of one line, which says what is wrong and where."""

import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from folders import changed

from pd4dgs_codec.data.dataset import READERS, dataset_folders, load
from pd4dgs_codec.errors import DataError

#: The tests of each reader. Their LAYOUTS write a synthetic scene into whole folders. Each of their FAULTS is a file of
#: such a folder, its change (see `folders.changed`), and a part of the error.
READERS_TESTS = [import_module(f"test_{name}") for name in sorted({r.function.split(":")[0] for r in READERS})]
LAYOUTS: dict[str, Callable[[Any, Path], Path]] = {}
FAULTS: dict[str, list[tuple[str, Any, str]]] = {}
for module in READERS_TESTS:
    LAYOUTS |= module.LAYOUTS
    FAULTS |= module.FAULTS
VIDEOS = [layout for layout, faults in FAULTS.items() if any(file.endswith(".mp4") for file, *_ in faults)]
SECONDS = 20  #: of processor time that a case may take; most take a hundredth of it
UNREAD = ("frames", "rigs")  #: files of COLMAP's that no reader opens


@pytest.mark.parametrize("layout", LAYOUTS)
def test_broken_folders(layout, scene, tmp_path, refused):
    folder = LAYOUTS[layout](scene, tmp_path / "set")
    for name, change, text in FAULTS[layout]:
        path = folder / name
        whole = path.read_bytes() if path.exists() else None
        changed(path, change)
        start = time.process_time()
        refused(folder, text)
        assert time.process_time() - start < SECONDS, name
        path.unlink(missing_ok=True)
        if whole is not None:
            path.write_bytes(whole)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_no_file_of_a_folder_is_a_link_out_of_it(layout, scene, tmp_path, refused):
    """Neither those that the layout names nor those that other files name: a stranger's archive may link anywhere."""
    folder, elsewhere = LAYOUTS[layout](scene, tmp_path / "set"), tmp_path / "elsewhere"
    every = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.stem not in UNREAD]
    of_each_kind = {(path.parent, path.suffix in (".png", ".jpg") or path.name): path for path in every}
    for path in of_each_kind.values():
        path.rename(elsewhere)
        path.symlink_to(elsewhere)
        refused(folder, "the name of a file in this folder")
        path.unlink()
        elsewhere.rename(path)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_file_that_is_a_circle_of_links_is_named(layout, scene, tmp_path):
    """Or it counts as missing."""
    folder, elsewhere = LAYOUTS[layout](scene, tmp_path / "set"), tmp_path / "elsewhere"
    for path in sorted(path for path in folder.rglob("*") if path.suffix not in (".png", ".jpg") and path.is_file()):
        path.rename(elsewhere)
        path.symlink_to(path.name)
        try:
            load(folder)
        except DataError as error:
            assert "cannot be read as" not in str(error), path
        path.unlink()
        elsewhere.rename(path)


def test_other_faults_of_folders(tmp_path, blender, refused):
    refused(tmp_path / "gone", "gone: found nothing, expected a dataset folder")
    refused(tmp_path, "found an empty folder, expected camera/ and rgb/ (iPhone")
    (tmp_path / "readme.txt").write_text("x")
    refused(tmp_path, "found other files")
    refused(tmp_path / "readme.txt", "found a file")
    blender(name="transforms_a.json")
    (tmp_path / "transforms_b.json").write_text("{}")
    refused(tmp_path, "found transforms_a.json, transforms_b.json; expected")


def test_folders_of_datasets_are_found_in_a_tree():
    names = ["a/camera/0.json", "b/transforms_train.json", "c/poses_bounds.npy", "d/sparse/0/cameras.bin"]
    names += ["d/sparse/0/images.bin", "e/metadata", "e/rgbd/0.jpg", "f/metadata", "g/x/train_meta.json", "notes.txt"]
    assert dataset_folders([*names, "transforms.json"]) == ["a", "b", "c", "d", "e", "g/x"]


def test_bad_options(blender, refused):
    folder = blender()
    for k in (0, -1, 2.0, True):
        refused(folder, f"downscale is {k}, expected", downscale=k)
    refused(folder, "downscale 9", downscale=9)
    refused("synthetic:static", "downscale 200 leaves nothing of 160x120", downscale=200)
    for k in (1, -2):
        refused(folder, f"holdout {k} leaves", holdout=k)


SYNTHETIC = {
    "": "expected synthetic:static|global|local|fast|flyby|dart|rods|dancer|random[?seed=n&size=WxH&frames=N",
    "Static": "expected synthetic:static",
    "nothing?seed=1": "expected synthetic:static",
    **{
        f"static?{key}={value}": f"{key} is {value!r}; expected for example"
        for key, values in {"seed": ("-1", "x"), "size": ("160", "9000x90"), "frames": ("",), "path": ("1",)}.items()
        for value in values
    },
    "static?size=7x160": "size is '7x160'; expected for example size=960x540, each 8 to 8192",
    "static?seconds=0": "seconds is '0'; expected for example seconds=60, 1 to 3600",
    "rods?seconds=5": "found seconds, expected them of synthetic:static|global|local|fast alone",
    "static?frames=2": "frames is '2'; expected for example frames=300, 3 to 10000",
    **{
        f"static?{query}": "expected each of seed, size, frames, seconds, path once at most, as key=value"
        for query in ("", "a", "seed=1&a", "seed=1&seed=1", "seed=1&")
    },
}


@pytest.mark.parametrize("name", SYNTHETIC)
def test_broken_synthetic_sources(name, refused):
    refused(f"synthetic:{name}", SYNTHETIC[name])
