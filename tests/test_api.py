"""The package as a library: what the README and the docs show, by their own code."""

import gc
import os
import re
import subprocess
import sys
import weakref
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from explicit import visible_splats
from strategies import small_file
from tiny import camera_around, trained_like_scene

import pd4dgs_codec
from pd4dgs_codec import Camera, Scene, decode, encode, render
from pd4dgs_codec import draw as drawing
from pd4dgs_codec.errors import RenderError, Truncated

ROOT = Path(__file__).resolve().parents[1]
PAGES = {name: re.findall(r"^```python\n(.*?)^```$", (ROOT / name).read_text("utf-8"), re.DOTALL | re.MULTILINE)
         for name in ("README.md", "docs/python.md")}  # fmt: skip
WITHOUT = "import sys\nsys.modules.update(dict.fromkeys({!r}))\n"


@pytest.fixture(scope="module")
def scene() -> Scene:
    return decode(encode(trained_like_scene(), effort=1))


def run(code: str, folder: Path, *missing: str) -> str:
    """Runs Python code in `folder` without some packages; returns what it prints."""
    command = [sys.executable, "-W", "error", "-c", WITHOUT.format(missing) + code]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("page", PAGES)
def test_the_python_of_a_page_runs_as_pasted_without_torch(page, tmp_path):
    (tmp_path / "scene.pd4").write_bytes(encode(trained_like_scene(), effort=1))
    assert PAGES[page]
    for block in PAGES[page]:
        run(block, tmp_path, "torch")


def test_a_file_is_decoded_by_its_path_or_its_bytes(tmp_path):
    data, path = small_file(), tmp_path / "scene.pd4"
    path.write_bytes(data)
    for given in (data, bytearray(data), memoryview(data), path, str(path)):
        assert decode(given, max_layer=1).layers == (0, 1)
    path.write_bytes(data[:-9])
    assert decode(path, allow_partial=True).layers == (0, 1)
    with pytest.raises(Truncated):
        decode(path)
    with pytest.raises(FileNotFoundError, match="missing.pd4"):
        decode("missing.pd4")


def test_gaussians_need_numpy_alone_and_pictures_numba(tmp_path):
    (tmp_path / "scene.pd4").write_bytes(encode(trained_like_scene(), effort=1))
    code = (
        "import pd4dgs_codec\nscene = pd4dgs_codec.decode('scene.pd4')\nprint(len(scene.gaussians(0.5).means))\n"
        "try:\n    pd4dgs_codec.render(scene, scene.info.camera, 0.5)\n"
        "except pd4dgs_codec.errors.DataError as error:\n    print(error)"
    )
    count, told = run(code, tmp_path, "torch", "numba", "scipy", "PIL").splitlines()
    assert int(count) > 50
    assert told == "pictures need the package numba, which is not installed: pip install 'pd4dgs-codec[draw]'"


def test_levels_times_and_eyes(scene):
    usual = scene.gaussians(0.5)
    again = scene.gaussians(0.5, 2, scene.info.camera.eye.tolist())
    assert all(np.array_equal(getattr(usual, name), getattr(again, name)) for name in vars(usual))
    assert len(scene.gaussians(0.5, 0).means) < len(usual.means)
    assert np.array_equal(scene.prefix(1).gaussians(0.5).means, scene.gaussians(0.5, 1).means)
    assert not np.array_equal(scene.gaussians(0.5, eye=[3, 0, 0]).colors[:9], usual.colors[:9])
    hidden = replace(scene, mask=tuple(np.zeros_like(codes) for codes in scene.mask))
    assert (
        len(hidden.gaussians(0.5).means) == 0 and np.ptp(render(hidden, scene.info.camera, 0.5), axis=(0, 1)).max() == 0
    )
    for call in (scene.gaussians, lambda *given: render(scene, scene.info.camera, *given)):
        with pytest.raises(RenderError, match=r"time is 1.5, expected 0 to 1, from 0 to 2 s of the scene"):
            call(1.5)
        with pytest.raises(RenderError, match="time is nan"):
            call(float("nan"))
        with pytest.raises(RenderError, match="level is 3, expected 0, 1, 2 or None"):
            call(0.5, 3)
    with pytest.raises(RenderError, match=r"eye is \[0.0, 1.0\], expected 3 finite numbers"):
        scene.gaussians(0.5, eye=[0, 1])


def test_pictures_of_levels_are_drawn_and_nothing_of_a_scene_stays(scene):
    own = decode(encode(scene, effort=1))
    pictures = [render(own, own.info.camera, 0.5, level) for level in (0, 1, 2)]
    assert all(p.dtype == np.float32 and p.shape == (24, 32, 3) and np.ptp(p) > 0.1 for p in pictures)
    assert not np.array_equal(pictures[0], pictures[2])
    assert np.array_equal(render(own, own.info.camera, 0.5), pictures[2])
    assert len(drawing._players[own]) == 3
    explicit = visible_splats()
    render(explicit, explicit.info.camera, 0.5)
    kept = [weakref.ref(one) for one in (own, explicit)]
    del own, explicit
    gc.collect()
    assert [one() for one in kept] == [None, None]


def test_a_camera_that_looks_at_a_point():
    eye, target = np.array([1.0, -2.0, 3.0]), np.array([0.5, 0.5, 0.0])
    camera = Camera.look_at(eye, target, (0, -1, 0), width=64, height=48, fov=60)
    np.testing.assert_allclose(camera.eye, eye, atol=1e-6)
    seen = camera.viewmat @ [*target, 1]
    np.testing.assert_allclose(seen[:3], [0, 0, np.linalg.norm(target - eye)], atol=1e-6)
    assert (camera.viewmat @ [*(target + [0, -0.1, 0]), 1])[1] < 0, "up is up in the picture"
    assert np.linalg.det(camera.viewmat[:3, :3]) == pytest.approx(1)
    top = camera.K @ [0, -np.tan(np.pi / 6), 1]
    np.testing.assert_allclose(top[:2], [32, 0], atol=1e-4)
    np.testing.assert_allclose(camera_around(np.random.default_rng(1)).eye @ [1, 0, 0], -8 * _row(1), atol=1e-4)
    for target, up, fov in ((eye, (0, 1, 0), 60), ((1, 5, 3), (0, 1, 0), 60), ((0, 0, 0), (0, 1, 0), 180)):
        with pytest.raises(RenderError, match="determine no view"):
            Camera.look_at(eye, target, up, width=8, height=8, fov=fov)


def _row(seed: int) -> float:
    return float(camera_around(np.random.default_rng(seed)).viewmat[2, 0])


def test_the_sample_lies_in_the_package():
    assert pd4dgs_codec.sample().parent.parent == Path(pd4dgs_codec.__file__).parent
