"""LPIPS, ST-LPIPS, FLIP: mask and mean by hand, the packages' own values, and absent packages."""

import sys
from types import ModuleType, SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from pd4dgs_codec.errors import DataError
from pd4dgs_codec.quality.perceptual import VGG, Distance, load_perceptual

MEAN_DIFFERENCE = Distance("mean difference", "by hand", lambda a, b: np.abs(a - b).mean(axis=2), least=2)


@pytest.fixture(scope="module")
def distance():
    """distance(name) -> the installed Distance; skips where it is absent."""
    loaded = load_perceptual()

    def get(name):
        if name in loaded.absent:
            pytest.skip(f"{name}: {loaded.absent[name]}")
        return loaded.distances[name]

    return get


def pair(height=40, width=50, seed=0):
    rng = np.random.default_rng(seed)
    coarse = rng.uniform(0, 1, (height // 5, width // 5, 3)).repeat(5, 0).repeat(5, 1)
    a = np.rint(255 * coarse).astype(np.uint8)
    b = np.clip(a.astype(int) + rng.integers(-40, 41, a.shape), 0, 255).astype(np.uint8)
    return a, b, rng.uniform(size=(height, width)) < 0.7


# -- mask, mean and time, with an error map by hand --------------------------------------------------------------------


def test_masked_mean_by_hand():
    a, b = np.zeros((2, 2, 3), np.uint8), np.zeros((2, 2, 3), np.uint8)
    b[0, 0], b[1, 1] = 51, (153, 0, 0)  # errors .2 and .6 / 3
    assert MEAN_DIFFERENCE(a, b) == pytest.approx((0.2 + 0.2) / 4)
    assert MEAN_DIFFERENCE(a, b, np.array([[1, 1], [1, 0]], bool)) == pytest.approx(0.2 / 3)
    assert MEAN_DIFFERENCE(a, b, np.array([[0, 1], [1, 0]], bool)) == 0
    assert MEAN_DIFFERENCE(a, b, np.zeros((2, 2), bool)) == 0
    assert MEAN_DIFFERENCE(np.full((2, 2, 3), 0.2 + 0.4 / 255), np.full((2, 2, 3), 51, np.uint8)) == 0  # 8 bits first


def test_the_map_sees_masked_pictures():
    seen = []
    spy = Distance("spy", "", lambda a, b: seen.extend((a, b)) or np.ones(a.shape[:2]))
    a, b, m = pair()
    assert spy(a, b, m) == pytest.approx(1)
    for picture, found in zip((a, b), seen, strict=True):
        assert found.dtype == np.float32 and (found[~m] == 0).all()
        assert np.array_equal(np.rint(255 * found[m]), picture[m])


def test_temporal_by_hand():
    frames = [np.full((2, 2, 3), value, np.uint8) for value in (0, 51, 51, 204)]
    assert MEAN_DIFFERENCE.temporal(frames) == pytest.approx((0.2 + 0 + 0.6) / 3)
    assert MEAN_DIFFERENCE.temporal(iter(frames[1:3])) == 0
    with pytest.raises(DataError, match="at least 2 frames"):
        MEAN_DIFFERENCE.temporal(frames[:1])


def test_refusals():
    with pytest.raises(DataError, match="image is 3x1, expected at least 2x2 for mean difference"):
        MEAN_DIFFERENCE(np.zeros((1, 3, 3)), np.zeros((1, 3, 3)))
    with pytest.raises(DataError, match="expected the same"):
        MEAN_DIFFERENCE(np.zeros((4, 4, 3)), np.zeros((4, 5, 3)))
    with pytest.raises(DataError, match="holds NaN"):
        MEAN_DIFFERENCE(np.full((4, 4, 3), np.nan), np.zeros((4, 4, 3)))


# -- the packages ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["lpips", "stlpips", "flip"])
def test_zero_for_equal_and_growing_with_flicker(name, distance):
    metric = distance(name)
    still, other, mask = pair()
    assert metric(still, still) == metric(still, still, mask) == 0
    assert metric.temporal([still] * 3) == 0
    noise = other.astype(int) - still

    def flicker(amount):
        flash = np.clip(still + amount * noise, 0, 255).astype(np.uint8)
        return metric.temporal([still, flash, still])

    assert 0 < flicker(0.25) < flicker(0.5) < flicker(1.0)


@pytest.mark.parametrize("name", ["lpips", "stlpips"])
def test_least_size(name, distance):
    metric = distance(name)
    a, b, _ = (z[: metric.least, : metric.least] for z in pair())
    assert np.isfinite(metric(a, b))
    with pytest.raises(RuntimeError):  # the network's own refusal, which says nothing of the picture
        metric.error_map(*(np.float32(z[1:]) for z in (a, b)))
    with pytest.raises(DataError, match=f"expected at least {metric.least}x{metric.least}"):
        metric(a[1:], b[1:])


def test_lpips_is_the_package_s(monkeypatch, tmp_path):
    """With random ImageNet weights, which stand where torchvision would put the true ones."""
    try:
        from torchvision.models import AlexNet_Weights, alexnet
    except Exception as error:  # a torchvision built for another torch raises RuntimeError
        pytest.skip(f"torchvision: {error}")
    lpips = pytest.importorskip("lpips")
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    folder = tmp_path / "hub" / "checkpoints"
    folder.mkdir(parents=True)
    torch.save(alexnet().state_dict(), folder / AlexNet_Weights.IMAGENET1K_V1.url.split("/")[-1])
    a, b, mask = pair()
    inputs = [lpips.im2tensor(z / 255 * mask[..., None], factor=1 / 2) for z in (a, b)]
    with torch.inference_mode():
        error = lpips.LPIPS(net="alex", spatial=True, verbose=False)(*inputs)[0, 0].numpy()
    assert load_perceptual().distances["lpips"](a, b, mask) == pytest.approx(error[mask].mean(), rel=1e-5)


def test_flip_is_the_package_s(distance):
    metric = distance("flip")
    import flip_evaluator

    a, b, _ = pair()
    expected = flip_evaluator.evaluate(np.float32(b / 255), np.float32(a / 255), "LDR")[1]
    assert metric(a, b) == pytest.approx(expected, rel=1e-5)


# -- where something is missing ----------------------------------------------------------------------------------------


def test_missing_packages_are_named(monkeypatch):
    for name in ("torchvision", "lpips", "stlpips_pytorch", "flip_evaluator"):
        monkeypatch.setitem(sys.modules, name, None)
    loaded = load_perceptual()
    assert loaded.distances == {} and set(loaded.absent) == {"lpips", "stlpips", "flip"}
    assert "stlpips_pytorch" in loaded.absent["stlpips"] and "flip_evaluator" in loaded.absent["flip"]


def test_broken_package_is_one_line(monkeypatch):
    broken = ModuleType("flip_evaluator")
    broken.__getattr__ = Mock(side_effect=RuntimeError("built for\nanother machine"))
    monkeypatch.setitem(sys.modules, "flip_evaluator", broken)
    assert load_perceptual().absent["flip"] == "RuntimeError: built for another machine"


def stand_in(monkeypatch, folder, weights):
    """A torchvision that knows the address of these weights alone; the file that it would keep them in."""
    models, kept = ModuleType("torchvision.models"), folder / "hub" / "checkpoints" / "weights-x.pth"
    setattr(models, weights, SimpleNamespace(IMAGENET1K_V1=SimpleNamespace(url=f"https://example.org/{kept.name}")))
    for module in (ModuleType("torchvision"), models):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setenv("TORCH_HOME", str(folder))
    return kept


def test_lpips_without_weights_fetches_nothing(monkeypatch, tmp_path):
    kept = stand_in(monkeypatch, tmp_path, "AlexNet_Weights")
    monkeypatch.setitem(sys.modules, "lpips", None)  # not even loaded
    assert load_perceptual().absent["lpips"].endswith(str(kept))


def test_vgg_is_called_as_3d_gaussian_splatting_calls_it(monkeypatch, tmp_path):
    """One number for a picture in 0..1, whatever the mask; only with weights where torchvision keeps them."""
    given, lpips, answer = [], ModuleType("lpips"), torch.full((1,) * 4, 0.25)
    lpips.LPIPS = lambda net, spatial, verbose: lambda *z: given.extend((net, spatial, *z)) or answer
    kept = stand_in(monkeypatch, tmp_path, "VGG16_Weights")
    monkeypatch.setitem(sys.modules, "lpips", lpips)
    monkeypatch.setattr("importlib.metadata.version", lambda name: "0.1.4")
    assert load_perceptual([VGG]).absent == {VGG: f"its ImageNet weights are not in {kept}"}
    kept.parent.mkdir(parents=True)
    kept.touch()
    a, b, _ = pair()
    distance = load_perceptual([VGG]).distances[VGG]
    assert distance(a, b) == 0.25 and given[:2] == ["vgg", False] and distance.source == "lpips 0.1.4, vgg"
    for found, picture in zip(given[2:], (a, b), strict=True):
        np.testing.assert_allclose(found[0].permute(1, 2, 0), picture / 255, atol=1e-6)


def test_st_lpips_may_be_what_imports_torch(distance, python):
    """As pd4dgs-eval of a .pd4 does."""
    distance("stlpips")
    python("from pd4dgs_codec.quality.perceptual import load_perceptual as load; assert not load(['stlpips']).absent")


def test_stand_ins_do_not_stay(distance):
    distance("stlpips")
    names = {"torchvision", "IPython", "torchsummary"} & set(sys.modules)
    assert all(sys.modules[name].__spec__ is not None for name in names)
