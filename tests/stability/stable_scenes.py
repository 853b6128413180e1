"""Stability of scenes: HexPlanes and deformations out of range, degenerate Gaussians and cameras, hostile training."""

from __future__ import annotations

import itertools
import math
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from promises import Found, Promise, largest, refusal
from tiny import TINY, camera_ahead, trained_like_scene
from torch import Tensor

from pd4dgs_codec.draw.gaussians import near_plane
from pd4dgs_codec.draw.hexplane import Field
from pd4dgs_codec.errors import EncodeError, NotFinite, RenderError
from pd4dgs_codec.format import decoder, encoder
from pd4dgs_codec.interchange.teacher import load_source
from pd4dgs_codec.model import checkpoint, hexplane
from pd4dgs_codec.model.deformation import DeformationField
from pd4dgs_codec.model.model import Model, from_scene, to_scene
from pd4dgs_codec.model.picture import rasterization, render
from pd4dgs_codec.scene import PLANES, Camera, Deformation, Network, Scene, deformation_unit, plane_shapes
from pd4dgs_codec.train.config import LearningRates, TrainConfig
from pd4dgs_codec.train.loop import Trainer

BOX = np.array([[-1, -1, -1], [1, 1, 1]], np.float32)
FLOAT32 = 1e-5  #: of the largest value: the float32 error of six lookups, their product and two layers
NAN, INF = math.nan, math.inf


@torch.no_grad()
def picture_error(model: Model, level: int, t: float, camera: Camera) -> float:
    """Returns the largest difference of any channel between the float32 image and the float64 reference's image of the
    same Gaussians; NaN if the float32 image is not finite."""
    picture = render(model, level, t, camera)
    g, near = picture.gaussians, near_plane(model.info)
    drawn = g.colors.isfinite().all(1)
    splats = [a[drawn] for a in (g.means, g.quats, g.scales, g.opacities, g.colors)]
    expected, _, _ = rasterization(*splats, camera, model.info.background, near_plane=near, backend="reference")
    return float((picture.image.double() - expected).abs().max())


# -- hexplane ----------------------------------------------------------------------------------------------------------

RESOLUTION = (7, 5, 9, 4)
INSIDE = np.random.default_rng(1).uniform(-0.9, 0.9, (60, 3)).astype(np.float32)
CORNERS = np.array(list(itertools.product((-1, 1), repeat=3)), np.float32)
FLAT = BOX * np.array([0, 1, 1], np.float32)
#: Each of four time rows, and the float32 on either side of it.
ROWS = [x for i in range(4) for x in (i / 3, *(float(np.nextafter(np.float32(i / 3), np.float32(s))) for s in (-9, 9)))]


def _planes(resolution: Sequence[int], channels: int) -> tuple[dict[str, np.ndarray], ...]:
    rng = np.random.default_rng(0)
    return tuple(
        {name: rng.normal(1, 0.7, shape).astype(np.float32) for name, shape in plane_shapes(channels, reso).items()}
        for reso in (tuple(resolution), (*(2 * r for r in resolution[:3]), resolution[3]))
    )


def _exact_samples(
    planes: Sequence[dict[str, np.ndarray]], box: np.ndarray, points: np.ndarray, t: float
) -> np.ndarray:
    """Samples planes by clause 13.2 of the format, float64 [n, C * scales], as a weighted sum of all cells."""
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
            columns, rows = (
                np.maximum(1 - np.abs(unit[:, axis, None] * (n - 1) - np.arange(n)), 0)
                for axis, n in ((a, plane.shape[2]), (b, plane.shape[1]))
            )
            product *= np.einsum("nr,nc,krc->nk", rows, columns, plane)
        features.append(product)
    return np.concatenate(features, 1)


def _sampling_error(
    points: np.ndarray, times: Sequence[float], resolution: Sequence[int] = RESOLUTION, box: np.ndarray = BOX
) -> Found:
    worst = {"kernel": 0.0, "torch": 0.0}
    for t, (name, channels) in itertools.product(times, (("kernel", 8), ("torch", 5))):
        planes = _planes(resolution, channels)  # the kernel takes multiples of eight
        found = hexplane.HexPlane.from_arrays(box, planes)(torch.from_numpy(points), t).detach().numpy()
        expected = _exact_samples(planes, box, points, t)
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
        errors += [float((found - expected).detach().abs().max()), float(slope[~torch.isfinite(x)].abs().max())]
    return f"{len(bad)} points, values and gradients", largest(errors)


# -- deformation -------------------------------------------------------------------------------------------------------


def _field(name: str, plane: np.ndarray) -> Deformation:
    """Makes a deformation with x residuals `plane` [H, W], scene units, over `name`; y residuals mirror them by row."""
    planes = {name: np.ones(shape, np.float32) for name, shape in plane_shapes(8, (6, 6, 6, 12)).items()}
    planes[name][:2] = plane, plane[::-1]
    both = np.zeros((4, 8), np.float32)  # ReLU of a channel and of its negative
    both[:, :2] = [[1, 0], [0, 1], [-1, 0], [0, -1]]
    head = np.array([[1, 0, -1, 0], [0, 1, 0, -1], [0, 0, 0, 0]], np.float32) / deformation_unit(BOX)
    networks: dict[str, Network] = {
        "trunk": ((both, np.zeros(4, np.float32)),),
        "position": ((head, np.zeros(3, np.float32)),),
    }
    return Deformation((planes,), networks)


def _residual_error(field: Deformation, times: Sequence[float]) -> Found:
    points = INSIDE * np.float32(1.4)
    module, player, worst = DeformationField.from_arrays(field, BOX), Field(field, BOX, {"position": slice(3)}), 0.0
    ((head, _),), ((trunk, _),) = (field.networks[name] for name in ("position", "trunk"))
    scale = max(float(np.abs(plane).max()) for plane in field.planes[0].values())
    for t in times:
        hidden = np.maximum(_exact_samples(field.planes, BOX, points, t) @ trunk.T.astype(np.float64), 0)
        expected = hidden @ head.T.astype(np.float64) * float(deformation_unit(BOX))
        tensor = torch.from_numpy(points)
        still = tensor.new_zeros(len(tensor), 3)
        moved = module.moved(still, lambda time: module.planes(tensor, time), {"position": slice(3)}, t)  # noqa: B023
        played = np.zeros_like(points)
        player.move(played, points, t)
        for found in (moved.detach().numpy(), played):
            worst = largest([worst, float(np.abs(found - expected).max()) / scale])
    return f"{len(times)} instants", worst


def _file_pictures(field: Deformation, times: Sequence[float]) -> Found:
    data = encoder.encode(_moved_by(field), effort=1)
    model = from_scene(decoder.decode(data))
    errors = [picture_error(model, 1, t, camera_ahead()) for t in times]
    return f"{len(data):,} bytes, {len(times)} images", largest(errors)


def _moved_by(field: Deformation) -> Scene:
    return replace(trained_like_scene().prefix(1), global_deformation=field)


_ROW = np.arange(12)[:, None] * np.ones(6)  #: of time
_AROUND = [0.0, 1.0, *(x / 11 + d for x in (5, 5.5, 6) for d in (-1e-6, 1e-6))]
#: (case, description, field, instants)
FIELDS: list[tuple[str, str, Deformation, Sequence[float]]] = [
    ("tears", "neighbouring cells of xy at -3 and 3 scene units",
     _field("xy", np.where(np.arange(36).reshape(6, 6) % 2, 3.0, -3.0)), (0.0, 0.5, 1.0)),
    ("teleports", "0 up to a time row, 3 scene units from the next on",
     _field("xt", np.where(_ROW > 5, 3.0, 0.0)), _AROUND),
    ("oscillates faster than the time grid", "+-2 scene units in alternate time rows",
     _field("xt", np.where(_ROW % 2, 2.0, -2.0)), np.linspace(0, 1, 31).tolist()),
    ("moves everything by 5e5", "every anchor leaves the view", _field("xy", np.full((6, 6), 5e5)), (0.5,)),
]  # fmt: skip

# -- rasteriser --------------------------------------------------------------------------------------------------------

NAMES = ("means", "quats", "scales", "opacities", "colors")
WIDTH, HEIGHT, NEAR = 40, 30, 0.01
#: Bound of the relative errors of the image and of each gradient, in the norm; the kernels compute in float32.
BOUND = 1e-4


def _camera(width: int = WIDTH, height: int = HEIGHT, shift: Sequence[float] = (0.0, 0.0), **bad: float) -> Camera:
    """Makes a camera at the origin that looks along z. bad: first element of a matrix by its name."""
    f = 1.2 * width
    K = np.array([[f, 0, width / 2 + shift[0]], [0, 1.1 * f, height / 2 + shift[1]], [0, 0, 1]], np.float32)
    camera = Camera(np.eye(4, dtype=np.float32), K, width, height)
    for name, value in bad.items():
        getattr(camera, name)[0, 0] = value
    return camera


def _scene(n: int = 30, seed: int = 1, first: int | None = None, **changes: Any) -> list[Tensor]:
    """Makes the tensors of NAMES for n Gaussians at depths 2..6, spread over the view. changes: values of the first
    `first` Gaussians (None: of all) by the tensor's name; depth: of their z only."""
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


def _draw(
    tensors: list[Tensor], camera: Camera | None = None, background: Sequence[float] = (0.0,) * 3, backend: str = "cpu"
) -> dict[str, Tensor]:
    """Returns the image, its alphas, and the gradients of a fixed weighting of both, float64."""
    leaves = [t.detach().requires_grad_() for t in tensors]
    image, alphas, _ = rasterization(*leaves, camera or _camera(), background, near_plane=NEAR, backend=backend)
    both = torch.cat([image.double().flatten(), alphas.double().flatten()])
    loss = (both * torch.randn(both.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)).sum()
    found = {"picture": image.detach().double(), "alphas": alphas.detach().double()}
    gradients = torch.autograd.grad(loss, leaves, allow_unused=True) if loss.requires_grad else [None] * len(leaves)
    for name, leaf, gradient in zip(NAMES, leaves, gradients, strict=True):
        found["d " + name] = torch.zeros_like(leaf).double() if gradient is None else gradient.double()
    return found


def _reference_error(scene: list[Tensor], camera: Camera | None = None) -> Found:
    found, expected = (_draw(scene, camera, backend=backend) for backend in ("cpu", "reference"))
    errors = {k: float((found[k] - value).norm() / value.norm().clamp(min=1e-12)) for k, value in expected.items()}
    worst = max(errors, key=lambda name: INF if math.isnan(errors[name]) else errors[name])
    return f"picture {errors['picture']:.1e}; worst is {worst}", errors[worst]


def _not_skipped(tensor: str, value: Any) -> Found:
    scene = _scene(first=3, **{tensor: value})
    found, rest = _draw(scene), _draw([t[3:] for t in scene])
    stray = largest(float(found["d " + name][:3].abs().max()) for name in NAMES)
    others = {k: v[3:] if k.startswith("d ") else v for k, v in found.items()}
    error = largest(float((others[k] - rest[k]).abs().max()) for k in rest)
    return f"gradients {stray:g}, the others changed by {error:g}", error + stray


#: (case, tensor, value in three Gaussians), which must be rendered as by the reference.
DRAWN: tuple[tuple[str, str, Any], ...] = (
    ("quaternion 0", "quats", (0.0,) * 4), ("quaternion 1e-20", "quats", (1e-20,) * 4),
    ("quaternion 3e38", "quats", (3e38,) * 4), ("scales 0", "scales", (0.0,) * 3),
    ("flat", "scales", (0.5, 0.5, 0.0)), ("a needle", "scales", (5.0, 1e-6, 1e-6)),
    ("scales 1e18", "scales", (1e18,) * 3), ("scales negative", "scales", (-0.1,) * 3),
    ("z just beyond near", "means", (0.001, 0.0, NEAR + 1e-7)), ("z = 1e9", "means", (0.1, 0.0, 1e9)),
    ("far off the axis near the camera", "means", (4.0, -3.0, NEAR + 1e-6)),
    ("opacity 1/255", "opacities", 1 / 255), ("opacity just above 1/255", "opacities", 1 / 255 + 1e-7),
    ("opacity above 1", "opacities", 1.5),
)  # fmt: skip
#: (case, tensor, value in three Gaussians), which must be skipped.
HIDDEN: tuple[tuple[str, str, Any], ...] = (
    ("z = near", "means", (0.1, 0.0, NEAR)), ("behind", "means", (0.1, 0.0, -3.0)),
    ("at the camera's centre", "means", (0.0, 0.0, 0.0)), ("beyond far", "means", (0.1, 0.0, 2e10)),
    ("opacity 0", "opacities", 0.0), ("opacity below 0", "opacities", -0.5),
    *((f"{name} {value}", name, value) for name in NAMES[:4] for value in (NAN, INF)),
)  # fmt: skip
SMALL = _camera(16, 16)
EQUAL: dict[str, Any] = {"means": (0.1, -0.1, 3.0), "quats": (0.3, 0.5, -1.0, 0.2), "scales": (0.2, 0.4, 0.6)}
#: (case, description, scene, camera), which must be rendered as by the reference.
CROWDS: tuple[tuple[Any, ...], ...] = (
    ("nothing", "no Gaussian", _scene(0)),
    ("all behind", "20 Gaussians behind the camera", _scene(20, depth=-3.0)),
    ("64 coincident, opaque", "64 equal Gaussians of opacity 1", _scene(64, opacities=1.0, **EQUAL), SMALL),
    ("2,000 coincident, faint", "2,000 equal, opacity 0.005", _scene(2000, opacities=0.005, **EQUAL), SMALL),
    ("centre on a pixel", "opacity 1 at a pixel's centre, before another",
     _scene(2, 3, means=((0.0, 0.0, 2.0), (0.0, 0.0, 3.0)), scales=0.001, opacities=1.0), _camera(1, 1)),
    # Six of alpha 0.9 at their centre: after four T is 1e-4, and the pixels around lie on both sides of it.
    ("transmittance near 1e-4", "layers that stop just before, at and after T = 1e-4",
     _scene(6, 5, means=[(0.0, 0.0, 2 + 0.1 * i) for i in range(6)], scales=(4.0, 6.0, 8.0), opacities=0.9), SMALL),
    ("equal depths", "80 Gaussians of one depth: the index decides", _scene(80, 4, depth=3.0)),
    ("17 x 13 pixels", "a size that is no multiple of a tile", _scene(), _camera(17, 13)),
    ("principal point off the image", "cx and cy 25 and -20 pixels from the middle of 40 x 30", _scene(60),
     _camera(shift=(25.0, -20.0))),
)  # fmt: skip

# -- training: runs that could fail end in a whole checkpoint, a file that decodes and finite images -------------------

SOURCE = "synthetic:local?size=32x24&frames=6"


def _trainer(
    prepare: Callable[[Model], object] = lambda model: None,
    factor: float = 1.0,
    anchors: int = 0,
    view: Mapping[str, Any] = {},  # noqa: B006 - never changed
    **fields: Any,
) -> Trainer:
    """Makes a run of 60 steps on six views. prepare: changes the model before its first step; factor: of all learning
    rates; anchors: their number, if fixed; view, fields: replaced in each view and in the dataset."""
    data = load_source(SOURCE)
    views = tuple(replace(v, **view) for v in data.train)
    rates = LearningRates(**{k: (factor * a, factor * b) for k, (a, b) in asdict(LearningRates()).items()})
    size = replace(TINY, initial_anchors=anchors, max_anchors=anchors) if anchors else TINY
    run = TrainConfig(preset="tiny", iterations=60, rates=rates, cooldown=0.0)
    trainer = Trainer(run, replace(data, train=views, **fields), size=size)
    with torch.no_grad():
        prepare(trainer.model)
    return trainer


def _single(model: Model) -> None:
    """Hides all Gaussians of the anchor except the first."""
    model.network("opacity").layers[-1].bias[1:] = -3.0


def _two_scales(model: Model) -> None:
    model.scaling_log[::2] = 0.0
    model.scaling_log[1::2] = np.log(1e-6)


def _passing_nan() -> Found:
    trainer = _trainer()
    bias = trainer.model.network("color").layers[-1].bias.data
    kept = bias.clone()
    bias.fill_(NAN)
    for _ in range(2):
        trainer.learner.step()
    bias.copy_(kept)
    got, error = _run(trainer)
    return got, error if trainer.learner.skipped == 2 else NAN


def _run(trainer: Trainer) -> Found:
    """Trains to the end, saves, encodes, decodes and renders; returns (description, error of the images)."""
    with tempfile.TemporaryDirectory() as folder:
        trainer.run(Path(folder) / "model.pt")
        model, _ = checkpoint.load(Path(folder) / "model.pt")
    data = encoder.encode(to_scene(model), effort=1)
    scene = decoder.decode(data)
    decoded, view = from_scene(scene), trainer.dataset.train[-1]
    error = largest(picture_error(decoded, level, view.time, view.camera) for level in (0, 1, 2))
    skipped = f"{trainer.learner.skipped} of {trainer.iteration} steps skipped"
    return f"{skipped}, {len(scene.anchor_q):,} anchors, {len(data):,} bytes", error


# -- the promises ------------------------------------------------------------------------------------------------------

TRAINED = "finite checkpoint, a file that decodes, images of all levels within 1/255 of the float64 reference"
REFERENCE = f"finite; image and gradients within {BOUND:g} of those of the float64 reference"

PROMISES = [
    Promise("hexplane", "the float64 value of the definition, by kernel and torch alike", _sampling_error, [
        ("time before the range", "t = -1e-7, -3, -1e30, -inf", INSIDE, (-1e-7, -3.0, -1e30, -INF)),
        ("time after the range", "t = 1 + 1e-7, 7, 1e30, inf", INSIDE, (1 + 1e-7, 7.0, 1e30, INF)),
        ("time on the rows", "t on each of 4 time rows, and one float32 beside", INSIDE, ROWS),
        ("points on the border", "the corners of the box", CORNERS, (0.0, 0.4, 1.0)),
        ("points outside", "corners times 2 and 1e30", np.concatenate([CORNERS * 2, CORNERS * 1e30]), (0.4,)),
        ("one cell in all", "resolution 1, 1, 1, 1", INSIDE, (0.0, 0.4, 1.0), (1, 1, 1, 1)),
        ("a flat box", "a box without extent along x; points on both sides", INSIDE, (0.4,), RESOLUTION, FLAT),
        *((f"a box {s} wide", "points inside", INSIDE * s, (0.4,), RESOLUTION, BOX * s)
          for s in (np.float32(1e-30), np.float32(1e30))),
    ], FLOAT32),
    Promise("hexplane", "as at the lower, upper, lower border; no gradient to the point", _bad_points_error,
            [("points not finite", "NaN, inf, -inf in each coordinate")]),
    Promise("deformation", "the residuals of float64, by model and player", _residual_error, FIELDS, FLOAT32),
    Promise("deformation", "finite images within 1/255 of those of the float64 reference", _file_pictures,
            [(f"{name}: pictures of its file", *rest) for name, *rest in FIELDS], 1 / 255),
    refusal("deformation", EncodeError, lambda: encoder.encode(_moved_by(_field("xy", np.full((6, 6), 1e20)))),
            ("overflows: as symbols", "planes of 1e20 at a step of 0.1: over 2^23 steps")),
    Promise("rasteriser", REFERENCE, _reference_error,
            [*((name, f"{tensor} {value} in 3 of 30", _scene(first=3, **{tensor: value}))
               for name, tensor, value in DRAWN), *CROWDS], BOUND),
    Promise("rasteriser", "skipped: finite image and gradients, the others rendered as without it", _not_skipped,
            [(name, f"{tensor} {value} in 3 of 30", tensor, value) for name, tensor, value in HIDDEN]),
    refusal("rasteriser", NotFinite, _draw,
            *((f"colors {x}", "in 3 of 30 Gaussians", _scene(first=3, colors=x)) for x in (NAN, INF)),
            ("background nan", "in one channel", _scene(5), None, (0.0, NAN, 0.0))),
    refusal("rasteriser", RenderError, lambda camera: _draw(_scene(5), _camera(**camera)),
            *((f"{name} nan", f"NaN in {name}", {name: NAN}) for name in ("viewmat", "K")),
            *((f"width {width}", "a size outside 1..65535", {"width": width}) for width in (0, 65536))),
    Promise("training", TRAINED, lambda how: _run(_trainer(**how)), [
        ("an ordinary run", "six views of a synthetic scene", {}),
        ("learning rates times 1e4", "every learning rate times 10,000", {"factor": 1e4}),
        ("a single Gaussian", "one anchor with one visible Gaussian", {"anchors": 1, "prepare": _single}),
        ("10^6 between scales", "Gaussians and offsets of 1 and of 1e-6 scene units", {"prepare": _two_scales}),
        ("one instant", "six views with one time stamp, time range 0",
         {"view": {"time": 0.0}, "time_range": (2.0, 2.0)}),
        ("black pictures", "all pixels 0", {"view": {"image": np.zeros((24, 32, 3), np.uint8)}}),
        ("nothing valid", "masks that hide every pixel", {"view": {"mask": np.zeros((24, 32), bool)}}),
        ("a flat box", "a box without depth", {"points": None, "box": BOX * np.array([1, 1, 0], np.float32)}),
    ], 1 / 255),
    Promise("training", f"both steps are skipped and counted; {TRAINED}", _passing_nan,
            [("a NaN weight", "NaN in a network's bias for two steps, then its former value")], 1 / 255),
]  # fmt: skip
