"""Stability of HexPlanes, deformations and masks: out of range, at borders, at one cell, torn and overflowing."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from functools import partial

import numpy as np
import torch

from pd4dgs_codec.attributes import quantise
from pd4dgs_codec.bench.stability.rows import Case, mpmath, refusal
from pd4dgs_codec.bench.stability.scenes import BOX, CAMERA, picture_error, small_scene
from pd4dgs_codec.codec import decoder, encoder
from pd4dgs_codec.errors import EncodeError
from pd4dgs_codec.evaluate import residuals
from pd4dgs_codec.model import hexplane, masks
from pd4dgs_codec.model.convert import from_scene
from pd4dgs_codec.model.deformation import DeformationField
from pd4dgs_codec.model.picture import render_image
from pd4dgs_codec.scene import MASK_THRESHOLD, PLANES, Deformation, Network, deformation_unit

HEXPLANE, DEFORMATION, MASKS = "hexplane", "deformation", "masks"
FLOAT32 = 1e-5  #: of the largest value: what float32 loses in six lookups, their product and two layers
RESOLUTION = (7, 5, 9, 4)
Planes = tuple[dict[str, np.ndarray], ...]


def cases() -> Iterator[Case]:
    """Of the three groups in turn."""
    yield from _hexplane_cases()
    yield from _deformation_cases()
    yield from _mask_cases()


# -- HexPlane ----------------------------------------------------------------------------------------------------------


def _hexplane_cases() -> Iterator[Case]:
    inside = _points(60, 0.9)
    exact = "the float64 value of the definition, by kernel, torch and encoder alike"

    def row(name: str, fed: str, points: np.ndarray, times: Sequence[float], **options) -> Case:
        return Case(HEXPLANE, name, fed, exact, FLOAT32, partial(_sampling_error, points, times, **options))

    rows = [i / 3 for i in range(4)]
    around = [float(np.nextafter(np.float32(r), np.float32(s))) for r in rows for s in (-9, 9)]
    low, high = BOX.astype(np.float64)
    corners = np.array(list(itertools.product(*zip(low, high, strict=True))), np.float32)
    yield row("time before the range", "t = -1e-7, -3, -1e30, -inf", inside, (-1e-7, -3.0, -1e30, -math.inf))
    yield row("time after the range", "t = 1 + 1e-7, 7, 1e30, inf", inside, (1 + 1e-7, 7.0, 1e30, math.inf))
    yield row("time on the rows", "t on each of 4 time rows, and one float32 beside", inside, rows + around)
    yield row("points on the border", "the corners of the box", corners, (0.0, 0.4, 1.0))
    yield row("points outside", "corners times 2 and 1e30", np.concatenate([corners * 2, corners * 1e30]), (0.4,))
    yield row("one cell in all", "resolution 1, 1, 1, 1", inside, (0.0, 0.4, 1.0), resolution=(1, 1, 1, 1))
    yield row("one cell along x and t", "resolution 1, 5, 9, 1", inside, (0.0, 0.4, 1.0), resolution=(1, 5, 9, 1))
    flat = BOX.copy()
    flat[:, 0] = 0.25
    yield row("a flat box", "a box without extent along x; points on both sides", inside, (0.4,), box=flat)
    for scale in (1e-30, 1e30):
        name, fed = f"a box {scale:.0e} wide", "points inside, outside and on the border"
        yield row(name, fed, inside * np.float32(scale), (0.4,), box=BOX * np.float32(scale))
    yield Case(
        HEXPLANE, "time not a number", "t = NaN", "as t = 0", 0.0, partial(_nan_time_error, inside)
    )  # fmt: skip
    yield Case(
        HEXPLANE, "points not finite", "NaN, inf, -inf in each coordinate",
        "as at the lower, upper, lower border; no gradient to the point", 0.0, _bad_points_error,
    )  # fmt: skip
    stiff = np.concatenate([corners, corners * 2, inside])
    yield Case(
        HEXPLANE, "gradients at borders and outside", "corners, points outside, points inside; t = -1, 0, 0.4, 1, 2",
        "the float64 gradients, of planes and points", FLOAT32, partial(_gradient_error, stiff),
    )  # fmt: skip


def _points(n: int, spread: float) -> np.ndarray:
    return np.random.default_rng(1).uniform(-spread, spread, (n, 3)).astype(np.float32)


def _planes(resolution: Sequence[int], channels: int, seed: int = 0) -> Planes:
    rng = np.random.default_rng(seed)
    return tuple(
        {
            name: rng.normal(1, 0.7, (channels, reso[b], reso[a])).astype(np.float32)
            for name, a, b in PLANES
        }
        for reso in (tuple(resolution), (*(2 * r for r in resolution[:3]), resolution[3]))
    )  # fmt: skip


def exact_samples(planes: Planes, box: np.ndarray, points: np.ndarray, t: float) -> np.ndarray:
    """float64 [n, C * scales] by clause 13.2 of the format, one point, plane and corner after the other."""
    low, high = box.astype(np.float64)
    unit = np.zeros((len(points), 4))
    for axis in range(3):
        x = points[:, axis].astype(np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):
            inside = (x - low[axis]) / (high[axis] - low[axis])
        unit[:, axis] = np.where(x <= low[axis], 0.0, np.where(x >= high[axis], 1.0, inside))
    unit[:, 3] = min(max(t, 0.0), 1.0)
    features = []
    for scale in planes:
        product = np.ones((len(points), scale["xy"].shape[0]))
        for name, a, b in PLANES:
            plane = scale[name].astype(np.float64)
            u, v = unit[:, a] * (plane.shape[2] - 1), unit[:, b] * (plane.shape[1] - 1)
            value = np.zeros_like(product)
            for row in range(plane.shape[1]):
                for column in range(plane.shape[2]):
                    weight = np.maximum(1 - np.abs(u - column), 0) * np.maximum(1 - np.abs(v - row), 0)
                    value += weight[:, None] * plane[:, row, column]
            product *= value
        features.append(product)
    return np.concatenate(features, 1)


def _sampling_error(
    points: np.ndarray, times: Sequence[float], resolution: Sequence[int] = RESOLUTION, box: np.ndarray = BOX
) -> tuple[str, float]:
    worst = {"kernel": 0.0, "torch": 0.0, "encoder": 0.0}
    for t in times:
        for name, channels in (("kernel", 8), ("torch", 5), ("encoder", 5)):  # the kernel takes multiples of eight
            planes = _planes(resolution, channels)
            if name == "encoder":
                found = residuals.sample_planes(planes, box, points, t)
            else:
                module = hexplane.HexPlane.from_plane_arrays(box, planes)
                found = module(torch.from_numpy(points), t).detach().numpy()
            expected = exact_samples(planes, box, points, t)
            error = float(np.abs(found - expected).max() / np.abs(expected).max())
            worst[name] = error if not error <= worst[name] else worst[name]
    return ", ".join(f"{name} {error:.1e}" for name, error in worst.items()), _largest(worst.values())


def _largest(errors: object) -> float:
    """The largest of some numbers, NaN if one is."""
    return float(np.max(np.array(list(errors))))  # type: ignore[call-overload]


def _modules() -> list[hexplane.HexPlane]:
    """One that the kernel samples and one that torch does."""
    return [hexplane.HexPlane.from_plane_arrays(BOX, _planes(RESOLUTION, channels)) for channels in (8, 5)]


def _nan_time_error(points: np.ndarray) -> tuple[str, float]:
    x = torch.from_numpy(points)
    errors = [float((m(x, math.nan) - m(x, 0.0)).detach().abs().max()) for m in _modules()]
    return f"kernel and torch differ from t = 0 by {errors[0]:g} and {errors[1]:g}", _largest(errors)


def _bad_points_error() -> tuple[str, float]:
    low, high = BOX
    bad = np.array(list(itertools.product((math.nan, math.inf, -math.inf, 0.3), repeat=3)), np.float32)
    border = np.where(np.isnan(bad) | np.isneginf(bad), low, np.where(np.isposinf(bad), high, bad)).astype(np.float32)
    errors = []
    for module in _modules():
        x = torch.from_numpy(bad).requires_grad_()
        found = module(x, 0.4)
        expected = module(torch.from_numpy(border), 0.4)
        (slope,) = torch.autograd.grad(found.sum(), x)
        stray = slope[~torch.isfinite(x)]
        errors += [float((found - expected).detach().abs().max()), float(stray.abs().max())]
    return f"{len(bad)} points, values and gradients", _largest(errors)


def _gradient_error(points: np.ndarray) -> tuple[str, float]:
    errors = []
    for module, t in itertools.product(_modules(), (-1.0, 0.0, 0.4, 1.0, 2.0)):
        found, expected = (_gradients(m, points, t) for m in (module, _doubled(module)))
        errors += [float((f - e).abs().max() / e.abs().max()) for f, e in zip(found, expected, strict=True)]
    return f"{len(points)} points at 5 times, kernel and torch", _largest(errors)


def _doubled(module: hexplane.HexPlane) -> hexplane.HexPlane:
    return hexplane.HexPlane.from_plane_arrays(BOX, module.plane_arrays()).double()


def _gradients(module: hexplane.HexPlane, points: np.ndarray, t: float) -> list[torch.Tensor]:
    x = torch.from_numpy(points).to(module.grid.dtype).requires_grad_()
    features = module(x, t)
    weights = torch.linspace(-1, 1, features.numel(), dtype=features.dtype).view_as(features)
    return [g.double() for g in torch.autograd.grad((features * weights).sum(), [module.grid, x])]


# -- deformation -------------------------------------------------------------------------------------------------------


def _deformation_cases() -> Iterator[Case]:
    kinds: list[tuple[str, str, Callable[[], Deformation], Sequence[float]]] = [
        ("tears", "neighbouring cells of xy at -3 and 3 scene units", _tearing, (0.0, 0.5, 1.0)),
        ("teleports", "0 up to a time row, 3 scene units from the next on", _teleporting, _around(11, 5, 6)),
        ("oscillates faster than the time grid", "+-2 scene units in alternate time rows, and between them", _swinging,
         np.linspace(0, 1, 31).tolist()),
        ("moves everything by 5e5", "every anchor leaves the view by 5e5 scene units", partial(_moved, 5e5), (0.5,)),
    ]  # fmt: skip
    for name, fed, make, times in kinds:
        yield Case(
            DEFORMATION, name, f"{fed}; {len(times)} instants", "the residuals of float64, by model and encoder",
            FLOAT32, partial(_residual_error, make, times),
        )  # fmt: skip
        yield Case(
            DEFORMATION, f"{name}: pictures of its file", f"{fed}; packed, unpacked and drawn",
            "finite pictures, within 1/255 of the float64 oracle's", 1 / 255, partial(_file_pictures, make, times, {}),
        )  # fmt: skip
    yield Case(
        DEFORMATION, "overflows: pictures of its file", "planes of 1e20, whose product is beyond float32, as float32",
        "finite pictures; what is not finite is not drawn", 1 / 255,
        partial(_file_pictures, partial(_moved, 1e20), (0.5,), {"deformation": "float32"}),
    )  # fmt: skip
    yield refusal(
        DEFORMATION, "overflows: as symbols", "planes of 1e20 at a step of 0.1: over 2^23 steps", EncodeError,
        lambda: encoder.encode(small_scene(_moved(1e20))),
    )  # fmt: skip


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
    networks: dict[str, Network] = {
        "trunk": ((both, np.zeros(4, np.float32)),),
        "position": ((head, np.zeros(3, np.float32)),),
    }
    return Deformation((planes,), networks)


def _tearing() -> Deformation:
    return _field(xy=np.where(np.arange(36).reshape(6, 6) % 2, 3.0, -3.0))


def _teleporting() -> Deformation:
    return _field(xt=np.where(np.arange(12)[:, None] > 5, 3.0, 0.0) * np.ones((1, 6)))


def _swinging() -> Deformation:
    return _field(xt=np.where(np.arange(12)[:, None] % 2, 2.0, -2.0) * np.ones((1, 6)))


def _moved(by: float) -> Deformation:
    return _field(xy=np.full((6, 6), by), **({"xz": np.full((6, 6), by)} if by >= 1e20 else {}))


def _around(intervals: int, *rows: int) -> list[float]:
    """Instants on the time rows, beside them, and between them."""
    on = [row / intervals for row in rows]
    return sorted([0.0, 1.0, *on, *(x + d for x in on for d in (-1e-6, 1e-6)), float(np.mean(on))])


def _residual_error(make: Callable[[], Deformation], times: Sequence[float]) -> tuple[str, float]:
    deformation, points = make(), _points(60, 1.2)
    module = DeformationField.from_arrays(deformation, BOX)
    worst = {"model": 0.0, "encoder": 0.0}
    ((head, _),) = deformation.networks["position"]
    ((trunk, _),) = deformation.networks["trunk"]
    unit = float(deformation_unit(BOX))
    for t in times:
        hidden = np.maximum(exact_samples(deformation.planes, BOX, points, t) @ trunk.T.astype(np.float64), 0)
        expected = hidden @ head.T.astype(np.float64) * unit
        found = {
            "model": module(torch.from_numpy(points), t)["position"].detach().numpy(),
            "encoder": residuals.residuals(deformation, BOX, points, t)["position"],
        }
        scale = max(float(np.abs(plane).max()) for plane in deformation.planes[0].values())
        for name, value in found.items():
            worst[name] = _largest([worst[name], float(np.abs(value - expected).max()) / scale])
    return ", ".join(f"{name} {error:.1e}" for name, error in worst.items()), _largest(worst.values())


def _file_pictures(make: Callable[[], Deformation], times: Sequence[float], options: dict) -> tuple[str, float]:
    data = encoder.encode(small_scene(make()), effort=1, **options)
    model = from_scene(decoder.decode(data))
    error = _largest([picture_error(model, 1, t) for t in times])
    return f"{len(data):,} bytes, {len(times)} pictures", error


# -- masks -------------------------------------------------------------------------------------------------------------

LOGITS = (-100.0, -10.0, -4.59512, 0.0, 4.0, 10.0, 100.0)
FAR = (-1e4, *LOGITS, 1e4)  #: float32 sums of these lose up to 5e-4


def _mask_cases() -> Iterator[Case]:
    for logits, bound in ((LOGITS, 1e-5), (FAR, 2e-4)):
        fed = f"logits {logits[0]:g}..{logits[-1]:g}"
        yield Case(
            MASKS, f"masks of {fed}", f"{fed} at all three levels",
            f"the exact masks within {bound:g}, never falling with the level", bound,
            partial(_level_mask_error, logits),
        )  # fmt: skip
    yield Case(
        MASKS, "gradients of masks at 0 and 1", "logits -1e4..1e4 at all three levels", "all finite", 0.0,
        _mask_gradients,
    )  # fmt: skip
    yield Case(
        MASKS, "codes at 0, 1 and the threshold", "0, -0, 0.01, its float32 neighbours, 1, halves of a code",
        "0 up to 0.01, else at least 3, ties to even", 0.0, _code_errors,
    )  # fmt: skip
    yield Case(
        MASKS, "every code there and back", "codes 0 and 3..255 as masks of a model, and as codes again", "unchanged",
        0.0, _codes_changed,
    )  # fmt: skip
    yield Case(
        MASKS, "drawn where sent", "anchors with masks around the threshold", "drawn if and only if in the file", 0.0,
        _drawn_against_sent,
    )  # fmt: skip
    for mask, what in ((0, "no anchor is in the file, the picture is the background"), (255, "the oracle's picture")):
        yield Case(
            MASKS, f"all masks {mask // 255}", f"40 anchors of mask {mask // 255}; packed, unpacked and drawn", what,
            1e-5, partial(_picture_of_mask, mask),
        )  # fmt: skip
    for value in (-0.001, 1.001, math.nan, math.inf):
        yield refusal(
            MASKS, f"mask {value:g}", "a mask outside 0..1", EncodeError,
            partial(quantise.mask_codes, np.array([value])),
        )  # fmt: skip


def _triples(logits: Sequence[float]) -> torch.Tensor:
    return torch.tensor(list(itertools.product(logits, repeat=3)))


def _level_mask_error(values: Sequence[float]) -> tuple[str, float]:
    mp = mpmath()
    logits = _triples(values)
    masks = [masks.level_mask(logits, level) for level in range(3)]
    worst = 0.0
    with mp.workdps(40):
        for i, (a, b, c) in enumerate(logits.tolist()):
            total = mp.mpf(a)
            for level, rise in enumerate((None, b, c)):
                total += 0 if rise is None else max(mp.mpf(rise), 0) + mp.log1p(mp.exp(-abs(mp.mpf(rise))))
                worst = _largest([worst, abs(float(masks[level][i]) - float(1 / (1 + mp.exp(-total))))])
    falls = max(float((low - high).max()) for low, high in itertools.pairwise(masks))
    return f"{len(logits)} triples, largest fall {max(falls, 0.0):g}", worst if falls <= 0 else math.nan


def _mask_gradients() -> tuple[str, float]:
    bad = 0
    for level in range(3):
        logits = _triples(FAR).requires_grad_()
        (slope,) = torch.autograd.grad(masks.level_mask(logits, level).sum(), logits)
        bad += int((~torch.isfinite(slope)).sum())
    return f"{bad} of {9 * len(FAR) ** 3} gradients not finite", float(bad)


def _threshold_neighbours() -> list[float]:
    at = np.float32(MASK_THRESHOLD)
    return [float(x) for x in (np.nextafter(at, np.float32(0)), at, np.nextafter(at, np.float32(1)))]


def _code_errors() -> tuple[str, float]:
    masks = [0.0, -0.0, 1e-30, MASK_THRESHOLD, *_threshold_neighbours(), 0.0118, 1.0, float(np.float32(1 - 2**-24))]
    masks += [float(np.float32((c + 0.5) / 255)) for c in range(3, 254)]
    expected = [0 if m <= MASK_THRESHOLD else max(3, round(Fraction(m) * 255)) for m in masks]
    wrong = int((quantise.mask_codes(np.array(masks)) != np.array(expected)).sum())
    return f"{wrong} of {len(masks)} codes wrong", float(wrong)


def _codes_changed() -> tuple[str, float]:
    codes = np.array([0, *range(3, 256)], np.uint8)
    logits = torch.from_numpy(masks.mask_logits(np.repeat(codes[:, None] / 255, 3, axis=1)))
    wrong = sum(
        int((quantise.mask_codes(masks.level_mask(logits, level).numpy()) != codes).sum()) for level in range(3)
    )
    return f"{wrong} of {3 * codes.size} codes changed", float(wrong)


def _drawn_against_sent() -> tuple[str, float]:
    masks = [*_threshold_neighbours(), 0.0, 0.0099, 0.0101, 0.5, 1.0]
    model = from_scene(small_scene(anchors=len(masks)))
    logit = np.log(np.clip(masks, 1e-7, 1 - 1e-7)) - np.log1p(-np.clip(masks, 1e-7, 1 - 1e-7))
    with torch.no_grad():
        model.mask_logits[:, 0] = torch.from_numpy(logit).float()
    drawn = set(model.visible(0, CAMERA).tolist())
    sent = set(np.flatnonzero(quantise.mask_codes(model.masks(0).detach().numpy())).tolist())
    return f"{len(drawn)} drawn, {len(sent)} sent", float(len(drawn ^ sent))


def _picture_of_mask(mask: int) -> tuple[str, float]:
    scene = small_scene(mask=mask)
    decoded = decoder.decode(encoder.encode(scene, effort=1))
    model = from_scene(decoded)
    error = picture_error(model, 0, 0.0)
    if not mask:
        picture = render_image(model, 0, 0.0, CAMERA)
        background = np.array(scene.info.background, np.float32)
        error = _largest([error, float(np.abs(picture - background).max())])
    kept = len(decoded.anchor_q)
    return f"{kept} anchors in the file", error if kept == (40 if mask else 0) else math.nan
