"""Stability of scenes: HexPlanes and deformations out of range, degenerate Gaussians and cameras, hostile training."""

from __future__ import annotations

import itertools
import math
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pd4dgs_codec.bench.stability import BOX, CAMERA, Case, Found, largest, refusal, small_scene
from pd4dgs_codec.data.view import Dataset, View
from pd4dgs_codec.draw.gaussians import near_plane
from pd4dgs_codec.errors import EncodeError, NotFinite, RenderError
from pd4dgs_codec.format import decoder, encoder, residuals
from pd4dgs_codec.model import checkpoint, hexplane
from pd4dgs_codec.model.config import DeformationConfig, ModelConfig
from pd4dgs_codec.model.convert import from_scene, to_scene
from pd4dgs_codec.model.deformation import DeformationField
from pd4dgs_codec.model.model import Model
from pd4dgs_codec.model.picture import rasterization, render
from pd4dgs_codec.scene import GLOBAL_HEADS, LOCAL_HEADS, PLANES, Camera, Deformation, Network, deformation_unit
from pd4dgs_codec.train.config import LearningRates, TrainConfig
from pd4dgs_codec.train.loop import Trainer

FLOAT32 = 1e-5  #: of the largest value: the float32 error of six lookups, their product and two layers
NAN, INF = math.nan, math.inf


def cases() -> Iterator[Case]:
    """Groups hexplane, deformation, rasteriser and training."""
    yield from _hexplane()
    yield from _deformation()
    yield from _rasteriser()
    yield from _training()


@torch.no_grad()
def picture_error(model: Model, level: int, t: float, camera: Camera = CAMERA) -> float:
    """Largest difference of a channel of a pixel between the float32 image and the image of the float64 reference from
    the same Gaussians; NaN if the former is not finite."""
    picture = render(model, level, t, camera)
    g, near = picture.gaussians, near_plane(model.info)
    drawn = g.colors.isfinite().all(1)
    means, quats, scales, opacities, colors = (a[drawn] for a in (g.means, g.quats, g.scales, g.opacities, g.colors))
    expected, _, _ = rasterization(
        means, quats, scales, opacities, colors, camera, model.info.background, near_plane=near, backend="reference"
    )
    return float((picture.image.double() - expected).abs().max())


# -- hexplane ----------------------------------------------------------------------------------------------------------

RESOLUTION = (7, 5, 9, 4)
Planes = tuple[dict[str, np.ndarray], ...]


def _hexplane() -> Iterator[Case]:
    row, inside = partial(Case, "hexplane"), _points(60, 0.9)
    rows = [i / 3 for i in range(4)]
    around = [float(np.nextafter(np.float32(r), np.float32(s))) for r in rows for s in (-9, 9)]
    corners = np.array(list(itertools.product(*zip(*BOX.astype(np.float64), strict=True))), np.float32)
    far = np.concatenate([corners * 2, corners * 1e30])
    flat = BOX.copy()
    flat[:, 0] = 0.25
    sampled: list[tuple[Any, ...]] = [
        ("time before the range", "t = -1e-7, -3, -1e30, -inf", inside, (-1e-7, -3.0, -1e30, -INF)),
        ("time after the range", "t = 1 + 1e-7, 7, 1e30, inf", inside, (1 + 1e-7, 7.0, 1e30, INF)),
        ("time on the rows", "t on each of 4 time rows, and one float32 beside", inside, rows + around),
        ("points on the border", "the corners of the box", corners, (0.0, 0.4, 1.0)),
        ("points outside", "corners times 2 and 1e30", far, (0.4,)),
        ("one cell in all", "resolution 1, 1, 1, 1", inside, (0.0, 0.4, 1.0), (1, 1, 1, 1)),
        ("one cell along x and t", "resolution 1, 5, 9, 1", inside, (0.0, 0.4, 1.0), (1, 5, 9, 1)),
        ("a flat box", "a box without extent along x; points on both sides", inside, (0.4,), RESOLUTION, flat),
        *(
            (f"a box {s:.0e} wide", "points inside, outside and on the border", inside * s, (0.4,), RESOLUTION, BOX * s)
            for s in (np.float32(1e-30), np.float32(1e30))
        ),
    ]
    exact = "the float64 value of the definition, by kernel, torch and encoder alike"
    for name, fed, *given in sampled:
        yield row(name, fed, exact, FLOAT32, partial(_sampling_error, *given))
    border = "as at the lower, upper, lower border; no gradient to the point"
    yield row("points not finite", "NaN, inf, -inf in each coordinate", border, 0.0, _bad_points_error)


def _points(n: int, spread: float) -> np.ndarray:
    """float32 [n, 3], random in -spread..spread."""
    return np.random.default_rng(1).uniform(-spread, spread, (n, 3)).astype(np.float32)


def _planes(resolution: Sequence[int], channels: int) -> Planes:
    rng = np.random.default_rng(0)
    return tuple(
        {name: rng.normal(1, 0.7, (channels, reso[b], reso[a])).astype(np.float32) for name, a, b in PLANES}
        for reso in (tuple(resolution), (*(2 * r for r in resolution[:3]), resolution[3]))
    )


def exact_samples(planes: Planes, box: np.ndarray, points: np.ndarray, t: float) -> np.ndarray:
    """float64 [n, C * scales] by clause 13.2 of the format: all cells of a plane, weighted; most weights are 0."""
    low, high = box.astype(np.float64)
    x = points.astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        inside = (x - low) / (high - low)
    unit = np.where(x <= low, 0.0, np.where(x >= high, 1.0, inside))
    unit = np.concatenate([unit, np.full((len(x), 1), min(max(t, 0.0), 1.0))], 1)
    features = []
    for scale in planes:
        product = np.ones((len(points), scale["xy"].shape[0]))
        for name, a, b in PLANES:
            plane = scale[name].astype(np.float64)
            u, v = unit[:, a] * (plane.shape[2] - 1), unit[:, b] * (plane.shape[1] - 1)
            columns, rows = (
                np.maximum(1 - np.abs(place[:, None] - np.arange(n)), 0)
                for place, n in zip((u, v), plane.shape[:0:-1], strict=True)
            )
            product *= np.einsum("nr,nc,krc->nk", rows, columns, plane)
        features.append(product)
    return np.concatenate(features, 1)


def _sampling_error(
    points: np.ndarray, times: Sequence[float], resolution: Sequence[int] = RESOLUTION, box: np.ndarray = BOX
) -> Found:
    worst = {"kernel": 0.0, "torch": 0.0, "encoder": 0.0}
    for t in times:
        for name, channels in (("kernel", 8), ("torch", 5), ("encoder", 5)):  # the kernel takes multiples of eight
            planes = _planes(resolution, channels)
            if name == "encoder":
                found = residuals.sample_planes(planes, box, points, t)
            else:
                module = hexplane.HexPlane.from_arrays(box, planes)
                found = module(torch.from_numpy(points), t).detach().numpy()
            expected = exact_samples(planes, box, points, t)
            worst[name] = largest([worst[name], float(np.abs(found - expected).max() / np.abs(expected).max())])
    return ", ".join(f"{name} {error:.1e}" for name, error in worst.items()), largest(worst.values())


def _bad_points_error() -> Found:
    low, high = BOX
    bad = np.array(list(itertools.product((NAN, INF, -INF, 0.3), repeat=3)), np.float32)
    border = np.where(np.isnan(bad) | np.isneginf(bad), low, np.where(np.isposinf(bad), high, bad)).astype(np.float32)
    errors = []
    for channels in (8, 5):  # sampled by the kernel and by torch
        module = hexplane.HexPlane.from_arrays(BOX, _planes(RESOLUTION, channels))
        x = torch.from_numpy(bad).requires_grad_()
        found, expected = module(x, 0.4), module(torch.from_numpy(border), 0.4)
        (slope,) = torch.autograd.grad(found.sum(), x)
        stray = slope[~torch.isfinite(x)]
        errors += [float((found - expected).detach().abs().max()), float(stray.abs().max())]
    return f"{len(bad)} points, values and gradients", largest(errors)


# -- deformation -------------------------------------------------------------------------------------------------------


def _deformation() -> Iterator[Case]:
    row, rows = partial(Case, "deformation"), np.arange(12)[:, None]  # of time
    exact = "the residuals of float64, by model and encoder"
    close = "finite images within 1/255 of those of the float64 reference"
    swing, around = (
        np.linspace(0, 1, 31).tolist(),
        [0.0, 1.0, *(x / 11 + d for x in (5, 5.5, 6) for d in (-1e-6, 1e-6))],
    )
    tearing = partial(_field, xy=np.where(np.arange(36).reshape(6, 6) % 2, 3.0, -3.0))
    teleporting = partial(_field, xt=np.where(rows > 5, 3.0, 0.0) * np.ones(6))
    swinging = partial(_field, xt=np.where(rows % 2, 2.0, -2.0) * np.ones(6))
    fields: list[tuple[str, str, Callable[[], Deformation], Sequence[float]]] = [
        ("tears", "neighbouring cells of xy at -3 and 3 scene units", tearing, [0.0, 0.5, 1.0]),
        ("teleports", "0 up to a time row, 3 scene units from the next on", teleporting, around),
        ("oscillates faster than the time grid", "+-2 scene units in alternate time rows", swinging, swing),
        ("moves everything by 5e5", "every anchor leaves the view by 5e5 scene units", partial(_moved, 5e5), (0.5,)),
    ]
    for name, fed, make, times in fields:
        yield row(name, f"{fed}; {len(times)} instants", exact, FLOAT32, partial(_residual_error, make, times))
        measure = partial(_file_pictures, make, times)
        yield row(f"{name}: pictures of its file", f"{fed}; encoded, decoded, rendered", close, 1 / 255, measure)
    fed = "planes of 1e20 at a step of 0.1: over 2^23 steps"
    act = lambda: encoder.encode(small_scene(_moved(1e20)))  # noqa: E731
    yield refusal("deformation", "overflows: as symbols", fed, EncodeError, act)


def _field(**values: np.ndarray) -> Deformation:
    """Planes of 1 but for those given, [H, W]; channel 0 is the position's x residual in scene units, 1 is its y."""
    reso = (6, 6, 6, 12)
    planes = {name: np.ones((8, reso[b], reso[a]), np.float32) for name, a, b in PLANES}
    for name, plane in values.items():
        planes[name][0] = plane
        planes[name][1] = plane[::-1]
    both = np.zeros((4, 8), np.float32)  # ReLU of a channel and of its negative
    both[0, 0] = both[1, 1] = 1
    both[2, 0] = both[3, 1] = -1
    head = np.array([[1, 0, -1, 0], [0, 1, 0, -1], [0, 0, 0, 0]], np.float32) / deformation_unit(BOX)
    trunk: Network = ((both, np.zeros(4, np.float32)),)
    return Deformation((planes,), {"trunk": trunk, "position": ((head, np.zeros(3, np.float32)),)})


def _moved(by: float) -> Deformation:
    return _field(xy=np.full((6, 6), by))


def _residual_error(make: Callable[[], Deformation], times: Sequence[float]) -> Found:
    deformation, places = make(), _points(60, 1.2)
    module = DeformationField.from_arrays(deformation, BOX)
    worst = {"model": 0.0, "encoder": 0.0}
    ((head, _),), ((trunk, _),) = (deformation.networks[name] for name in ("position", "trunk"))
    scale = max(float(np.abs(plane).max()) for plane in deformation.planes[0].values())
    for t in times:
        hidden = np.maximum(exact_samples(deformation.planes, BOX, places, t) @ trunk.T.astype(np.float64), 0)
        expected = hidden @ head.T.astype(np.float64) * float(deformation_unit(BOX))
        found = {
            "model": module(torch.from_numpy(places), t)["position"].detach().numpy(),
            "encoder": residuals.residuals(deformation, BOX, places, t)["position"],
        }
        for name, value in found.items():
            worst[name] = largest([worst[name], float(np.abs(value - expected).max()) / scale])
    return ", ".join(f"{name} {error:.1e}" for name, error in worst.items()), largest(worst.values())


def _file_pictures(make: Callable[[], Deformation], times: Sequence[float]) -> Found:
    data = encoder.encode(small_scene(make()), effort=1)
    model = from_scene(decoder.decode(data))
    return f"{len(data):,} bytes, {len(times)} images", largest(picture_error(model, 1, t) for t in times)


# -- rasteriser --------------------------------------------------------------------------------------------------------

NAMES = ("means", "quats", "scales", "opacities", "colors")
NEAR = 0.01
#: Relative errors of the image and of each gradient, in the norm; the kernels compute in float32.
BOUND = 1e-4
SKIPPED = "skipped: finite image and gradients, the others rendered as without it"
REFERENCE = f"finite; image and gradients within {BOUND:g} of those of the float64 reference"
WIDTH, HEIGHT = 40, 30
#: (case, tensor, value of the first three Gaussians) that must be rendered like the reference.
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
#: The same, which must be skipped.
HIDDEN: tuple[tuple[str, str, Any], ...] = (
    ("z = near", "means", (0.1, 0.0, NEAR)), ("z = 0", "means", (0.1, 0.0, 0.0)),
    ("behind", "means", (0.1, 0.0, -3.0)), ("at the camera's centre", "means", (0.0, 0.0, 0.0)),
    ("beyond far", "means", (0.1, 0.0, 2e10)), ("opacity 0", "opacities", 0.0),
    ("opacity below 0", "opacities", -0.5),
    *((f"{name} {value}", name, value) for name in NAMES[:4] for value in (NAN, INF, -INF)),
)  # fmt: skip


def _rasteriser() -> Iterator[Case]:
    row, refuse = partial(Case, "rasteriser"), partial(refusal, "rasteriser")
    for name, tensor, value in DRAWN:
        measure = partial(_reference_error, partial(_with, tensor, value))
        yield row(name, f"{tensor} {value} in 3 of 30", REFERENCE, BOUND, measure)
    for name, tensor, value in HIDDEN:
        yield row(name, f"{tensor} {value} in 3 of 30", SKIPPED, 0.0, partial(_not_skipped, tensor, value))
    for name, fed, scene, *size in CROWDS:
        yield row(name, fed, REFERENCE, BOUND, partial(_reference_error, scene, *size))
    for width, height in ((17, 13), (1, 1), (33, 1)):
        measure = partial(_reference_error, partial(_scene, 30), width, height)
        yield row(f"{width} x {height} pixels", "a size that is no multiple of a tile", REFERENCE, BOUND, measure)
    for shift in ((3.3, -2.6), (25.0, -20.0)):
        fed = f"cx and cy {shift[0]:g} and {shift[1]:g} pixels from the middle of {WIDTH} x {HEIGHT}"
        measure = partial(_reference_error, partial(_scene, 60), view=_camera(WIDTH, HEIGHT, shift))
        yield row(f"principal point off by {shift[0]:g}", fed, REFERENCE, BOUND, measure)
    for value in (NAN, INF, -INF):
        yield refuse(f"colors {value}", "3 of 30 Gaussians", NotFinite, partial(_draw, _with("colors", value)))
        act = partial(_draw, _scene(5), background=(0.0, value, 0.0))
        yield refuse(f"background {value}", f"a background of {value}", NotFinite, act)
    for name in ("viewmat", "K"):
        view = _camera(WIDTH, HEIGHT)
        getattr(view, name)[0, 0] = NAN
        yield refuse(f"{name}s nan", f"NaN in {name}", RenderError, partial(_draw, _scene(5), view=view))
    for width in (0, -1, 65536):
        yield refuse(f"width {width}", "a size outside 1..65535", RenderError, partial(_draw, _scene(5), width))


def _camera(width: int, height: int, shift: Sequence[float] = (0.0, 0.0)) -> Camera:
    """At the origin, looking along z."""
    f = 1.2 * width
    K = np.array([[f, 0, width / 2 + shift[0]], [0, 1.1 * f, height / 2 + shift[1]], [0, 0, 1]], np.float32)
    return Camera(np.eye(4, dtype=np.float32), K, width, height)


def _scene(n: int, seed: int = 0, first: int | None = None, **changes: Any) -> list[Tensor]:
    """n Gaussians at depths 2..6, spread over the view: the tensors of NAMES. changes: values of the first ones (of all
    for None) by the tensor's name; depth: of their z alone."""
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
    scene[1][:] = scene[1][0].clone()
    return scene


#: Six of alpha 0.9 at their centre: after four T is 1e-4, and the pixels around lie on both sides of it.
_LAYERS = partial(_scene, 6, 5, means=[(0.0, 0.0, 2 + 0.1 * i) for i in range(6)], scales=(4.0, 6.0, 8.0))
_PIXEL = partial(_scene, 2, 3, means=((0.0, 0.0, 2.0), (0.0, 0.0, 3.0)), scales=0.001, opacities=1.0)
#: (case, description, scene, size) that must be rendered like the reference.
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


def _draw(
    tensors: list[Tensor],
    width: int = WIDTH,
    height: int = HEIGHT,
    *,
    backend: str = "cpu",
    background: Sequence[float] = (0.0, 0.0, 0.0),
    view: Camera | None = None,
) -> dict[str, Tensor]:
    """The image, its alphas, and the gradients of a fixed weighting of both, float64."""
    leaves = [t.detach().requires_grad_() for t in tensors]
    means, quats, scales, opacities, colors = leaves
    camera = view or _camera(width, height)
    image, alphas, _ = rasterization(
        means, quats, scales, opacities, colors, camera, background, near_plane=NEAR, backend=backend
    )
    both = torch.cat([image.double().flatten(), alphas.double().flatten()])
    loss = (both * torch.randn(both.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)).sum()
    found = {"picture": image.detach().double(), "alphas": alphas.detach().double()}
    gradients = torch.autograd.grad(loss, leaves, allow_unused=True) if loss.requires_grad else [None] * len(leaves)
    for name, leaf, gradient in zip(NAMES, leaves, gradients, strict=True):
        found["d " + name] = torch.zeros_like(leaf).double() if gradient is None else gradient.double()
    return found


def _reference_error(scene: Callable[[], list[Tensor]], *size: int, **options: Any) -> Found:
    found, expected = (_draw(scene(), *size, backend=backend, **options) for backend in ("cpu", "reference"))
    errors = {k: float((found[k] - value).norm() / value.norm().clamp(min=1e-12)) for k, value in expected.items()}
    worst = max(errors, key=lambda name: INF if math.isnan(errors[name]) else errors[name])
    return f"picture {errors['picture']:.1e}; worst is {worst}", errors[worst]


def _not_skipped(tensor: str, value: Any) -> Found:
    scene = _with(tensor, value)
    found, rest = _draw(scene), _draw([t[3:] for t in scene])
    stray = largest(float(found["d " + name][:3].abs().max()) for name in NAMES)
    others = {k: v[3:] if k.startswith("d ") else v for k, v in found.items()}
    error = largest(float((others[k] - rest[k]).abs().max()) for k in rest)
    return f"gradients {stray:g}, the others changed by {error:g}", error + stray


# -- training: runs that could fail end in a whole checkpoint, a file that decodes and finite images -------------------

ITERATIONS = 60
PROMISED = "finite checkpoint, a file that decodes, images of all levels within 1/255 of the float64 reference"
_FIELD = DeformationConfig(4, 4, 8, (1,), 8, tuple(GLOBAL_HEADS))
#: Like the preset `tiny`, but a step takes milliseconds.
SMALLEST = ModelConfig(
    _FIELD, replace(_FIELD, heads=tuple(LOCAL_HEADS)), hidden=8, initial_anchors=300, max_anchors=600
)


def _training() -> Iterator[Case]:
    still, flat = {"time_range": (2.0, 2.0)}, {"points": None, "box": _box(0)}
    runs: list[tuple[str, str, Callable[[], Trainer]]] = [
        ("as it should be", "a disc that moves over a grey ground", _trainer),
        ("learning rates times 100", "every learning rate times 100", partial(_trainer, factor=100.0)),
        ("learning rates times 1e4", "every learning rate times 10,000", partial(_trainer, factor=1e4)),
        ("a single Gaussian", "one anchor, of whose Gaussians one is seen", _single),
        ("10^6 between scales", "Gaussians and offsets of 1 and of 1e-6 scene units", _two_scales),
        ("one instant", "six views with one time stamp, time range 0", _on(lambda v, i: replace(v, time=0.0), **still)),
        ("repeated time stamps", "three instants, two views each", _on(lambda v, i: replace(v, time=(i // 2) / 2))),
        ("the same view six times", "one image, one camera, one instant", _on(lambda v, i: _view(0.0))),
        ("black pictures", "all pixels 0", _on(lambda v, i: replace(v, image=np.zeros_like(v.image)))),
        ("nothing valid", "masks that hide every pixel", _on(lambda v, i: replace(v, mask=np.zeros((24, 32), bool)))),
        ("a flat box", "a box without depth", _on(lambda v, i: v, **flat)),
    ]
    row = partial(Case, "training")
    for name, fed, make in runs:
        yield row(name, f"{fed}; {ITERATIONS} steps", PROMISED, 1 / 255, partial(_run, make))
    fed, counted = "NaN in a network for two steps, then the weight it had", "both steps are skipped and counted"
    yield row("a weight that is not a number", fed, f"{counted}; {PROMISED}", 1 / 255, _passing_nan)


def _box(depth: float) -> np.ndarray:
    return np.array([[-1.5, -1.2, -depth], [1.5, 1.2, depth]], np.float32)


def _view(t: float) -> View:
    """A disc that moves to the right; the camera moves a little."""
    width, height = 32, 24
    y, x = np.mgrid[0:height, 0:width] + 0.5
    image = np.full((height, width, 3), 90, np.uint8)
    image[(x - 8 - 16 * t) ** 2 + (y - 12) ** 2 < 16] = (230, 60, 40)
    viewmat = np.eye(4, dtype=np.float32)
    viewmat[0, 3], viewmat[2, 3] = 0.1 * np.sin(6 * t), 3.0
    K = np.array([[30, 0, width / 2], [0, 30, height / 2], [0, 0, 1]], np.float32)
    return View(viewmat, K, width, height, t, image, None, f"{t:.2f}", 0)


def _disc(change: Callable[[View, int], View] = lambda view, i: view, **changes: Any) -> Dataset:
    """Six views, each changed, and other fields instead of these."""
    points = np.random.default_rng(0).uniform(-1, 1, (200, 3)).astype(np.float32)
    fields: dict[str, Any] = dict(
        name="disc", train=tuple(change(_view(t), i) for i, t in enumerate(np.linspace(0, 1, 6))), test=(_view(0.5),),
        points=points, point_colors=None, box=_box(1), near=0.1, far=10.0, background=(0.0, 0.0, 0.0),
        time_range=(0.0, 1.0), up=(0.0, -1.0, 0.0), unit=0.0, masked=False,
    )  # fmt: skip
    return Dataset(**(fields | changes))


def _on(change: Callable[[View, int], View], **changes: Any) -> Callable[[], Trainer]:
    """A run on the changed data."""
    return lambda: _trainer(_disc(change, **changes))


def _trainer(data: Dataset | None = None, config: ModelConfig = SMALLEST, factor: float = 1.0) -> Trainer:
    """factor: on all learning rates."""
    rates = LearningRates(**{k: (factor * a, factor * b) for k, (a, b) in asdict(LearningRates()).items()})
    run = TrainConfig(preset="tiny", iterations=ITERATIONS, rates=rates, cooldown=0.0)
    return Trainer(run, data or _disc(), size=config)


@torch.no_grad()
def _single() -> Trainer:
    one = replace(SMALLEST, initial_anchors=1, max_anchors=1)
    trainer = _trainer(_disc(points=np.zeros((1, 3), np.float32)), one)
    trainer.model.network("opacity").layers[-1].bias[1:] = -3.0
    return trainer


@torch.no_grad()
def _two_scales() -> Trainer:
    trainer = _trainer()
    trainer.model.scaling_log[::2] = 0.0
    trainer.model.scaling_log[1::2] = np.log(1e-6)
    return trainer


def _passing_nan() -> Found:
    trainer = _trainer()
    bias = trainer.model.network("color").layers[-1].bias
    kept = bias.detach().clone()
    with torch.no_grad():
        bias.fill_(NAN)
    for _ in range(2):
        trainer.learner.step()
    with torch.no_grad():
        bias.copy_(kept)
    got, error = _run(lambda: trainer)
    return got, error if trainer.learner.skipped == 2 else NAN


def _run(make: Callable[[], Trainer]) -> Found:
    """Trains to the end, saves, encodes, decodes and renders: (in words, the error of the images)."""
    trainer = make()
    with tempfile.TemporaryDirectory() as folder:
        trainer.run(Path(folder) / "model.pt")
        model, _ = checkpoint.load(Path(folder) / "model.pt")
    data = encoder.encode(to_scene(model), effort=1)
    scene = decoder.decode(data)
    decoded, view = from_scene(scene), trainer.dataset.train[-1]
    error = largest(picture_error(decoded, level, view.time, view.camera) for level in (0, 1, 2))
    skipped = f"{trainer.learner.skipped} of {trainer.iteration} steps skipped"
    return f"{skipped}, {len(scene.anchor_q):,} anchors, {len(data):,} bytes", error
