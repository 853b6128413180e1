"""The gsplat adapter with a stand-in module; with CUDA, the real one against the CPU."""

import importlib.metadata
import sys
import types

import pytest
import torch
from raster_scenes import camera, draw_with_gradients, relative_errors, scene

from pd4dgs_codec.draw.rasteriser import Settings
from pd4dgs_codec.errors import RenderError
from pd4dgs_codec.model.autograd import gsplat_backend
from pd4dgs_codec.model.autograd.rasterization import rasterization


def _rasterize(tensors, depth=False):
    return gsplat_backend.rasterize(*tensors, *camera(8, 8), None, 8, 8, Settings(depth=depth))


def _install(monkeypatch, version):
    calls = []

    def fake(means, quats, scales, opacities, colors, viewmats, Ks, width, height, **options):
        calls.append((means, quats, scales, opacities, colors, options))
        meta = {"means2d": means[None, :, :2] * 2, "radii": 0, "depths": 1, "conics": 2, "other": 3}
        return torch.zeros(1, height, width, 3), torch.zeros(1, height, width, 1), meta

    monkeypatch.setitem(sys.modules, "gsplat", types.SimpleNamespace(rasterization=fake))
    monkeypatch.setattr(importlib.metadata, "version", lambda name: version)
    return calls


@pytest.mark.parametrize("version", ["1.6.0", "2.0.1", "1.4.0"])
def test_other_versions_are_refused(monkeypatch, version):
    _install(monkeypatch, version)
    with pytest.raises(RenderError, match=version):
        _rasterize(scene(4))


def test_missing_gsplat_is_one_clear_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "gsplat", None)
    monkeypatch.setattr(importlib.metadata, "version", lambda name: "1.5.3")
    with pytest.raises(RenderError, match="install"):
        _rasterize(scene(4))


@pytest.mark.parametrize("kernels, says", [(object(), None), (None, "no CUDA kernels"), ("absent", "do not load")])
def test_check_wants_the_compiled_kernels(monkeypatch, kernels, says):
    _install(monkeypatch, "1.5.3")
    monkeypatch.setitem(sys.modules, "gsplat.cuda", types.SimpleNamespace())
    backend = None if kernels == "absent" else types.SimpleNamespace(_C=kernels)
    monkeypatch.setitem(sys.modules, "gsplat.cuda._backend", backend)
    if says is None:
        gsplat_backend.check()
        return
    with pytest.raises(RenderError, match=says) as caught:
        gsplat_backend.check()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("channels, depth, mode", [(3, False, "RGB"), (3, True, "RGB+D"), (0, True, "D")])
def test_what_gsplat_is_asked(monkeypatch, channels, depth, mode):
    calls = _install(monkeypatch, "1.5.3+pt24cu124")
    tensors = scene(4, channels=channels)
    with torch.no_grad():
        tensors[0][0, 0], tensors[3][1] = float("nan"), float("inf")
        tensors[1][2] = 0.0
    _, _, meta = _rasterize(tensors, depth)
    means, quats, scales, opacities, colors, options = calls[0]
    assert options["packed"] is False and options["render_mode"] == mode and options["rasterize_mode"] == "classic"
    assert options["eps2d"] == 0.3 and options["near_plane"] == 0.01 and options["far_plane"] == 1e10
    assert torch.isfinite(means).all() and opacities[:2].tolist() == [0.0, 0.0] and opacities[3] == tensors[3][3]
    assert quats[2].tolist() == [1.0, 0.0, 0.0, 0.0] and colors.shape[-1] == max(channels, 1)
    assert set(meta) == {"means2d", "radii", "depths", "conics"}
    meta["means2d"].sum().backward()
    assert meta["means2d"].grad is not None and torch.isfinite(tensors[0].grad).all()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_gsplat_draws_what_the_cpu_draws():
    pytest.importorskip("gsplat")
    tensors, background = scene(300, 1), torch.tensor([[0.2, 0.4, 0.9]])
    expected = draw_with_gradients(tensors, *camera(50, 40), 50, 40, "cpu", background)
    moved = [t.detach().cuda().requires_grad_() for t in tensors]
    cameras = [t.cuda() for t in camera(50, 40)]
    out, alphas, meta = rasterization(*moved, *cameras, 50, 40, backgrounds=background.cuda())
    g = torch.Generator().manual_seed(0)
    weights = [torch.randn(t.shape, generator=g, dtype=torch.float64).cuda() for t in (out, alphas)]
    ((out.double() * weights[0]).sum() + (alphas.double() * weights[1]).sum()).backward()
    found = {"picture": out.detach().double().cpu(), "alphas": alphas.detach().double().cpu()}
    found |= {"d means2d": meta["means2d"].grad.double().cpu(), "d backgrounds": expected["d backgrounds"]}
    names = ("means", "quats", "scales", "opacities", "colors")
    found |= {f"d {k}": t.grad.double().cpu() for k, t in zip(names, moved, strict=True)}
    errors = relative_errors(found, expected)
    assert max(errors.values()) < 1e-3, errors
