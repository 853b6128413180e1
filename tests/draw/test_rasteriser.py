"""Drawing numpy arrays: the picture of `rasterization`, without torch, and what is refused."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import pd4dgs_codec
from pd4dgs_codec.draw import rasteriser
from pd4dgs_codec.errors import NotFinite, RenderError
from pd4dgs_codec.scene import Camera

CAMERA = Camera(np.eye(4, dtype=np.float32), np.array([[60, 0, 25], [0, 66, 20], [0, 0, 1]], np.float32), 50, 40)


def gaussians(n=300, channels=3, seed=5):
    """means, quats, scales, opacities and colors, float32, of n Gaussians in front of CAMERA."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(2, 6, n)
    means = np.stack([*(rng.uniform(-0.5, 0.5, (2, n)) / 1.2 * z), z], 1)
    scales = 0.1 * np.exp(0.6 * rng.normal(size=(n, 3)))
    rest = rng.uniform(0.05, 0.95, n), rng.uniform(size=(n, channels))
    return [a.astype(np.float32) for a in (means, rng.normal(size=(n, 4)), scales, *rest)]


@pytest.mark.parametrize("channels", [1, 3, 5])
@pytest.mark.parametrize("options", [{}, {"near_plane": 3.0, "far_plane": 5.0}, {"eps2d": 1.0, "radius_clip": 4.0}])
def test_the_picture_is_that_of_rasterization(channels, options):
    torch = pytest.importorskip("torch")
    from pd4dgs_codec.model.autograd.rasterization import rasterization

    arrays, background = gaussians(channels=channels), np.linspace(0.1, 0.9, channels, dtype=np.float32)
    image, alpha = rasteriser.draw(*arrays, CAMERA, background, **options)
    assert image.dtype == alpha.dtype == np.float32 and image.shape == (40, 50, channels) and alpha.shape == (40, 50)
    tensors = [torch.from_numpy(a) for a in (*arrays, CAMERA.viewmat[None], CAMERA.K[None], background[None])]
    out, alphas, _ = rasterization(*tensors[:7], 50, 40, backgrounds=tensors[7], **options)
    np.testing.assert_array_equal(image, out[0].numpy())
    np.testing.assert_array_equal(alpha, alphas[0, ..., 0].numpy())
    assert image.std() > 0.05 and 0.1 < alpha.mean() < 0.99


def test_other_float_types_and_orders_of_memory_give_the_same_picture():
    arrays = gaussians()
    expected, _ = rasteriser.draw(*arrays, CAMERA)
    for change in (np.asfortranarray, lambda a: a.astype(np.float64), lambda a: np.repeat(a, 2, axis=0)[::2]):
        np.testing.assert_array_equal(rasteriser.draw(*map(change, arrays), CAMERA)[0], expected)


def test_nothing_to_draw_is_the_background():
    for arrays in (gaussians(0), [-gaussians()[0], *gaussians()[1:]]):
        image, alpha = rasteriser.draw(*arrays, CAMERA, (0.25, 0.5, 0.75))
        assert (image == np.float32([0.25, 0.5, 0.75])).all() and not alpha.any()


def test_gaussians_that_are_not_finite_are_skipped():
    arrays = gaussians()
    expected, _ = rasteriser.draw(*(a[4:] for a in arrays), CAMERA)
    for n, (array, value) in enumerate(zip(arrays[:4], (np.nan, np.inf, np.nan, np.inf), strict=True)):
        array[n] = value
    np.testing.assert_array_equal(rasteriser.draw(*arrays, CAMERA)[0], expected)


WRONG = {
    "means": lambda a: a[:, :2],
    "quats": lambda a: a[:-1],
    "scales": lambda a: a.astype(np.int32),
    "opacities": lambda a: a[:, None],
    "colors": lambda a: a.tolist(),
}


@pytest.mark.parametrize("name", WRONG)
def test_arrays_that_are_refused(name):
    arrays = dict(zip(WRONG, gaussians(), strict=True))
    with pytest.raises(RenderError, match=f"{name}.*expected") as caught:
        rasteriser.draw(**arrays | {name: WRONG[name](arrays[name])}, camera=CAMERA)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "change, options, word",
    [
        ({"width": 0}, {}, "width"),
        ({"height": 8.5}, {}, "height"),
        ({"viewmat": np.zeros((4, 4))}, {}, "last row"),
        ({"viewmat": np.eye(3)}, {}, "viewmat has shape"),
        ({"K": np.eye(3) * -1.0}, {}, "expected"),
        ({"K": np.full((3, 3), np.nan)}, {}, "not finite"),
        ({}, {"background": (0.0,)}, "background"),
        ({}, {"near_plane": 2.0, "far_plane": 1.0}, "far_plane"),
        ({}, {"eps2d": -1.0}, "eps2d"),
    ],
)
def test_cameras_and_options_that_are_refused(change, options, word):
    with pytest.raises(RenderError, match=word):
        rasteriser.draw(*gaussians(), replace(CAMERA, **change), **options)


def test_colours_that_are_not_finite_are_refused():
    arrays = gaussians()
    arrays[4][7, 1] = np.nan
    with pytest.raises(NotFinite, match="colors"):
        rasteriser.draw(*arrays, CAMERA)
    with pytest.raises(NotFinite, match="background"):
        rasteriser.draw(*gaussians(), CAMERA, (0.0, np.inf, 0.0))


SCRIPT = """
import pkgutil, sys
sys.path[:0] = sys.argv[1:]
sys.modules["torch"] = None
import numpy as np
import pd4dgs_codec.draw
for module in pkgutil.iter_modules(pd4dgs_codec.draw.__path__, "pd4dgs_codec.draw."):
    if not module.ispkg:
        __import__(module.name)
assert "pd4dgs_codec.draw.rasteriser" in sys.modules and "pd4dgs_codec.model.autograd" not in sys.modules
from test_rasteriser import CAMERA, gaussians
from pd4dgs_codec.draw.rasteriser import draw
print(float(draw(*gaussians(), CAMERA)[0].astype(np.float64).sum()).hex())
"""


def test_every_module_but_those_of_autograd_works_without_torch():
    expected = float(rasteriser.draw(*gaussians(), CAMERA)[0].astype(np.float64).sum()).hex()
    paths = [str(Path(__file__).parent), str(Path(pd4dgs_codec.__file__).parents[1])]
    done = subprocess.run([sys.executable, "-c", SCRIPT, *paths], capture_output=True, text=True, timeout=300)
    assert (done.returncode, done.stdout.strip()) == (0, expected), done.stderr
