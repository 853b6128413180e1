"""Stability of the rasteriser: degenerate and extreme Gaussians, pixels and cameras, against the float64 oracle."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pd4dgs_codec import threads
from pd4dgs_codec.bench.stability.cases import Case, Found, refusal
from pd4dgs_codec.errors import NotFinite, RenderError
from pd4dgs_codec.model.rasterization import rasterization
from pd4dgs_codec.scene import Camera

NAMES = ("means", "quats", "scales", "opacities", "colors")
NEAR = 0.01
#: Relative errors of the picture and of each gradient, in the norm; the backend computes in float32.
BOUND = 1e-4
WIDTH, HEIGHT = 40, 30
SKIPPED = "skipped: finite pictures and gradients, the others drawn as if it were not there"
ORACLE = f"finite; pictures and gradients within {BOUND:g} of the float64 oracle's"
NAN, INF = math.nan, math.inf

#: (case, tensor, value of the first three Gaussians) drawn as the oracle draws them.
DRAWN: tuple[tuple[str, str, Any], ...] = (
    ("quaternion 0", "quats", (0.0,) * 4), ("quaternion 1e-20", "quats", (1e-20,) * 4),
    ("quaternion 1e20", "quats", (1e20,) * 4), ("quaternion 3e38", "quats", (3e38,) * 4),
    ("scales 0", "scales", (0.0,) * 3), ("scales 1e-20", "scales", (1e-20,) * 3),
    ("flat", "scales", (0.5, 0.5, 0.0)), ("a needle", "scales", (5.0, 1e-6, 1e-6)),
    ("scales 1e6", "scales", (1e6,) * 3), ("scales 1e18", "scales", (1e18,) * 3),
    ("scales negative", "scales", (-0.1,) * 3),
    ("z just beyond near", "means", (0.001, 0.0, NEAR + 1e-7)), ("z = 1e9", "means", (0.1, 0.0, 1e9)),
    ("far off the axis near the camera", "means", (4.0, -3.0, NEAR + 1e-6)),
    ("far off the axis, far away", "means", (1e8, 1e8, 1e9)),
    ("opacity 1/255", "opacities", 1 / 255), ("opacity just above 1/255", "opacities", 1 / 255 + 1e-7),
    ("opacity 1", "opacities", 1.0), ("opacity above 1", "opacities", 1.5),
)  # fmt: skip
#: The same, not drawn.
HIDDEN: tuple[tuple[str, str, Any], ...] = (
    ("z = near", "means", (0.1, 0.0, NEAR)), ("z = 0", "means", (0.1, 0.0, 0.0)),
    ("behind", "means", (0.1, 0.0, -3.0)), ("at the camera's centre", "means", (0.0, 0.0, 0.0)),
    ("beyond far", "means", (0.1, 0.0, 2e10)), ("opacity 0", "opacities", 0.0),
    ("opacity below 0", "opacities", -0.5), ("opacity infinite", "opacities", INF),
    *((f"{name} {value}", name, value) for name in NAMES[:4] for value in (NAN, INF, -INF)),
)  # fmt: skip


def cases() -> Iterator[Case]:
    """Single Gaussians that are hard, then crowds, cameras and sizes, then types and threads, then refusals."""
    row, refuse = partial(Case, "rasteriser"), partial(refusal, "rasteriser")
    for name, tensor, value in DRAWN:
        measure = partial(_oracle_error, partial(_with, tensor, value))
        yield row(name, f"{tensor} {value} in 3 of 30", ORACLE, BOUND, measure)
    for name, tensor, value in HIDDEN:
        yield row(name, f"{tensor} {value} in 3 of 30", SKIPPED, 0.0, partial(_not_skipped, tensor, value))
    for name, fed, scene, *size in CROWDS:
        yield row(name, fed, ORACLE, BOUND, partial(_oracle_error, scene, *size))
    fed, same = "80 depths 1e-4 apart, permuted", "the same picture, bit for bit"
    yield row("order of the input", fed, same, 0.0, _permutation_error)
    for width, height in ((17, 13), (1, 1), (33, 1)):
        measure = partial(_oracle_error, partial(_scene, 30), width, height)
        yield row(f"{width} x {height} pixels", "a size that is no multiple of a tile", ORACLE, BOUND, measure)
    for shift in ((3.3, -2.6), (25.0, -20.0)):
        fed = f"cx and cy {shift[0]:g} and {shift[1]:g} pixels from the middle of {WIDTH} x {HEIGHT}"
        measure = partial(_oracle_error, partial(_scene, 60), view=_camera(WIDTH, HEIGHT, shift))
        yield row(f"principal point off by {shift[0]:g}", fed, ORACLE, BOUND, measure)
    fed = "z just before and beyond near, far from the axis"
    beside = partial(_scene, 4, 6, means=_BESIDE, scales=(0.002, 0.001, 0.003))
    yield row("planes off the axis", fed, ORACLE, BOUND, partial(_oracle_error, beside))
    yield row("not contiguous", "every tensor as a strided view", same, 0.0, _strided_error)
    promised = "the picture of the same values in float32, bit for bit"
    yield row("float16", "every tensor in float16", promised, 0.0, _half_error)
    fed, promised = "8 pictures with gradients by two threads of the caller", "the same, bit for bit"
    yield row("two callers at once", fed, f"{promised}, as one after the other", 0.0, _concurrent_error)
    if threads.available() >= 2:
        fed = "3,000 Gaussians, picture and gradients"
        yield row("one thread against two", fed, promised, 0.0, _threads_error)
    for value in (NAN, INF, -INF):
        bad, background = partial(_draw, _with("colors", value)), (0.0, value, 0.0)
        yield refuse(f"colors {value}", f"colors {value} in 3 of 30", NotFinite, bad)
        bad = partial(_draw, _scene(5), background=background)
        yield refuse(f"background {value}", f"a background of {value}", NotFinite, bad)
    for name in ("viewmat", "K"):
        view = _camera(WIDTH, HEIGHT)
        getattr(view, name)[0, 0] = NAN
        yield refuse(f"{name}s nan", f"NaN in {name}", RenderError, partial(_draw, _scene(5), view=view))
    for width in (0, -1, 65536):
        yield refuse(f"width {width}", "a size outside 1..65535", RenderError, partial(_draw, _scene(5), width))


# -- scenes ------------------------------------------------------------------------------------------------------------


def _camera(width: int, height: int, shift: Sequence[float] = (0.0, 0.0)) -> Camera:
    """At the origin, looking along z."""
    f = 1.2 * width
    K = np.array([[f, 0, width / 2 + shift[0]], [0, 1.1 * f, height / 2 + shift[1]], [0, 0, 1]], np.float32)
    return Camera(np.eye(4, dtype=np.float32), K, width, height)


def _scene(n: int, seed: int = 0, first: int | None = None, **changes: Any) -> list[Tensor]:
    """n Gaussians at depths 2..6, spread over the view: means, quats, scales, opacities, colors. changes: values of
    the first ones (of all for None) by the tensor's name; depth: of their z alone."""
    g = torch.Generator().manual_seed(seed)
    z = torch.rand(n, generator=g) * 4 + 2
    xy = (torch.rand(n, 2, generator=g) - 0.5) / 1.2 * z[:, None]
    scene = [
        torch.cat([xy, z[:, None]], -1),
        torch.randn(n, 4, generator=g),
        torch.exp(torch.randn(n, 3, generator=g) * 0.6) * 0.1,
        torch.rand(n, generator=g) * 0.9 + 0.05,
        torch.rand(n, 3, generator=g),
    ]
    for name, value in changes.items():
        tensor = scene[0][:, 2] if name == "depth" else scene[NAMES.index(name)]
        tensor[:first] = torch.as_tensor(value)
    return scene


def _with(tensor: str, value: Any) -> list[Tensor]:
    return _scene(30, 1, 3, **{tensor: value})


def _coincident(n: int, opacity: float) -> list[Tensor]:
    scene = _scene(n, 2, means=(0.1, -0.1, 3.0), scales=(0.2, 0.4, 0.6), opacities=opacity)
    scene[1][:] = scene[1][0].clone()  # a sphere has no rotation to learn
    return scene


#: At the edge of the view, wide enough to be seen; every second one lies before the near plane.
_DEPTHS = torch.tensor([NEAR * 0.99, NEAR * 1.01, NEAR * 0.999, NEAR * 1.001])
_BESIDE = torch.stack([0.5 * _DEPTHS, -0.3 * _DEPTHS, _DEPTHS], 1)
#: Six of alpha 0.9 at their centre: after four T is 1e-4, and the pixels around lie on both sides of it.
_LAYERS = partial(_scene, 6, 5, means=[(0.0, 0.0, 2 + 0.1 * i) for i in range(6)], scales=(4.0, 6.0, 8.0))
_PIXEL = partial(_scene, 2, 3, means=((0.0, 0.0, 2.0), (0.0, 0.0, 3.0)), scales=0.001, opacities=1.0)
#: (case, what it is, scene, size): drawn as the oracle draws them.
CROWDS: tuple[tuple[Any, ...], ...] = (
    ("nothing", "no Gaussian", partial(_scene, 0)),
    ("all behind", "20 Gaussians behind the camera", partial(_scene, 20, 2, depth=-3.0)),
    ("64 coincident, opaque", "64 equal Gaussians of opacity 1", partial(_coincident, 64, 1.0), 16, 16),
    ("2,000 coincident, faint", "2,000 equal, opacity 0.005", partial(_coincident, 2000, 0.005), 16, 16),
    ("centre on a pixel", "opacity 1 at a pixel's centre, before another", _PIXEL, 1, 1),
    ("transmittance near 1e-4", "layers that stop just before, at and after T = 1e-4", partial(_LAYERS, opacities=0.9),
     16, 16),
    ("equal depths", "80 Gaussians of one depth: the index decides", partial(_scene, 80, 4, depth=3.0)),
)  # fmt: skip


# -- measures ----------------------------------------------------------------------------------------------------------


def _draw(
    tensors: list[Tensor],
    width: int = WIDTH,
    height: int = HEIGHT,
    *,
    backend: str = "cpu",
    background: Sequence[float] = (0.0, 0.0, 0.0),
    view: Camera | None = None,
) -> dict[str, Tensor]:
    """The picture, its alphas, and the gradients of a fixed weighting of both, float64."""
    means, quats, scales, opacities, colors = leaves = [t.detach().requires_grad_() for t in tensors]
    out, alphas, _ = rasterization(
        means, quats, scales, opacities, colors, view or _camera(width, height), background,
        near_plane=NEAR, backend=backend,
    )  # fmt: skip
    both = torch.cat([out.double().flatten(), alphas.double().flatten()])
    loss = (both * torch.randn(both.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)).sum()
    found = {"picture": out.detach().double(), "alphas": alphas.detach().double()}
    gradients = torch.autograd.grad(loss, leaves, allow_unused=True) if loss.requires_grad else [None] * len(leaves)
    for name, leaf, gradient in zip(NAMES, leaves, gradients, strict=True):
        found["d " + name] = torch.zeros_like(leaf).double() if gradient is None else gradient.double()
    return found


def _oracle_error(scene: Callable[[], list[Tensor]], *size: int, **options: Any) -> Found:
    found, expected = (_draw(scene(), *size, backend=backend, **options) for backend in ("cpu", "reference"))
    errors = {k: float((found[k] - value).norm() / value.norm().clamp(min=1e-12)) for k, value in expected.items()}
    worst = max(errors, key=lambda name: INF if math.isnan(errors[name]) else errors[name])
    return f"picture {errors['picture']:.1e}; worst is {worst}", errors[worst]


def _difference(a: dict[str, Tensor], b: dict[str, Tensor]) -> float:
    """The largest difference of any number of `a` from that of `b`; NaN if one is not finite."""
    differences = [float((a[k] - b[k]).abs().max()) for k in a if a[k].numel()]
    return NAN if any(not math.isfinite(d) for d in differences) else max(differences, default=0.0)


def _not_skipped(tensor: str, value: Any) -> Found:
    scene = _with(tensor, value)
    found, rest = _draw(scene), _draw([t[3:] for t in scene])
    stray = max(float(found["d " + name][:3].abs().max()) for name in NAMES)
    others = {k: v[3:] if k.startswith("d ") else v for k, v in found.items()}
    error = _difference(others, rest)
    return f"gradients {stray:g}, the others changed by {error:g}", error + stray


def _permutation_error() -> Found:
    scene = _scene(80, 4, depth=3.0)
    scene[0][:, 2] += torch.arange(80) * 1e-4
    order = torch.randperm(80, generator=torch.Generator().manual_seed(1))
    drawn, permuted = _draw(scene), _draw([t[order] for t in scene])
    error = _difference({k: drawn[k] for k in ("picture", "alphas")}, permuted)
    return f"differ by {error:g}", error


def _strided_error() -> Found:
    scene = _scene(60)
    strided = [torch.stack([t, t + 1], -1)[..., 0] for t in scene]
    error = _difference(_draw(scene), _draw(strided))
    contiguous = sum(t.is_contiguous() for t in strided)
    return f"{contiguous} of 5 contiguous, differ by {error:g}", error


def _half_error() -> Found:
    half = [t.half() for t in _scene(60)]
    found, expected = _draw(half), _draw([t.float() for t in half])
    finite = all(bool(torch.isfinite(v).all()) for v in found.values())
    error = _difference({k: found[k] for k in ("picture", "alphas")}, expected)
    return f"differ by {error:g}, gradients {'finite' if finite else 'not finite'}", error if finite else NAN


def _concurrent_error() -> Found:
    scenes = [_scene(200, seed) for seed in range(8)]
    alone = [_draw(scene) for scene in scenes]
    with ThreadPoolExecutor(2) as pool:
        together = list(pool.map(_draw, scenes))
    error = max(_difference(a, b) for a, b in zip(alone, together, strict=True))
    return f"differ by {error:g}", error


def _threads_error() -> Found:
    before, scene, results = threads.kernel_threads(), _scene(3000, 7), []
    try:
        for count in (1, 2):
            threads.set_kernel_threads(count)
            results.append(_draw(scene, 96, 80))
    finally:
        threads.set_kernel_threads(before)
    error = _difference(*results)
    return f"differ by {error:g}", error
