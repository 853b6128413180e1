"""Stability of HexPlanes, deformations and masks: out of range, at borders, at one cell, torn and overflowing."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from functools import partial
from typing import Any

import numpy as np
import torch

from pd4dgs_codec.bench.stability import cases as shared
from pd4dgs_codec.bench.stability.cases import BOX, CAMERA, Case, Found, largest, picture_error, refusal, small_scene
from pd4dgs_codec.errors import EncodeError
from pd4dgs_codec.format import decoder, encoder, quantise, residuals
from pd4dgs_codec.model import hexplane, masks
from pd4dgs_codec.model.convert import from_scene
from pd4dgs_codec.model.deformation import DeformationField
from pd4dgs_codec.quality.levels import level_of
from pd4dgs_codec.scene import MASK_THRESHOLD, PLANES, Deformation, Network, deformation_unit

FLOAT32 = 1e-5  #: of the largest value: what float32 loses in six lookups, their product and two layers
RESOLUTION = (7, 5, 9, 4)
Planes = tuple[dict[str, np.ndarray], ...]


def cases() -> Iterator[Case]:
    """Groups hexplane, deformation and masks."""
    yield from _hexplane()
    yield from _deformation()
    yield from _masks()


# -- hexplane ----------------------------------------------------------------------------------------------------------


def _hexplane() -> Iterator[Case]:
    """Times, points, resolutions and boxes, then what is not a number, then gradients."""
    row, inside = partial(Case, "hexplane"), _points(60, 0.9)
    rows = [i / 3 for i in range(4)]
    around = [float(np.nextafter(np.float32(r), np.float32(s))) for r in rows for s in (-9, 9)]
    low, high = BOX.astype(np.float64)
    corners = np.array(list(itertools.product(*zip(low, high, strict=True))), np.float32)
    far = np.concatenate([corners * 2, corners * 1e30])
    flat = BOX.copy()
    flat[:, 0] = 0.25
    sampled: list[tuple[Any, ...]] = [
        ("time before the range", "t = -1e-7, -3, -1e30, -inf", inside, (-1e-7, -3.0, -1e30, -math.inf)),
        ("time after the range", "t = 1 + 1e-7, 7, 1e30, inf", inside, (1 + 1e-7, 7.0, 1e30, math.inf)),
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
    yield row("time not a number", "t = NaN", "as t = 0", 0.0, partial(_nan_time_error, inside))
    border = "as at the lower, upper, lower border; no gradient to the point"
    yield row("points not finite", "NaN, inf, -inf in each coordinate", border, 0.0, _bad_points_error)
    measure = partial(_gradient_error, np.concatenate([corners, corners * 2, inside]))
    fed, promised = "corners, points outside, points inside", "the float64 gradients, of planes and points"
    yield row("gradients at borders and outside", f"{fed}; t = -1, 0, 0.4, 1, 2", promised, FLOAT32, measure)


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
    """float64 [n, C * scales] by clause 13.2 of the format: each cell of a plane with its weights, most of them 0."""
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
            columns, rows = (
                np.maximum(1 - np.abs(x[:, None] - np.arange(n)), 0)
                for x, n in zip((u, v), plane.shape[:0:-1], strict=True)
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
                module = hexplane.HexPlane.from_plane_arrays(box, planes)
                found = module(torch.from_numpy(points), t).detach().numpy()
            expected = exact_samples(planes, box, points, t)
            worst[name] = largest([worst[name], float(np.abs(found - expected).max() / np.abs(expected).max())])
    return ", ".join(f"{name} {error:.1e}" for name, error in worst.items()), largest(worst.values())


def _modules() -> list[hexplane.HexPlane]:
    """One that the kernel samples and one that torch does."""
    return [hexplane.HexPlane.from_plane_arrays(BOX, _planes(RESOLUTION, channels)) for channels in (8, 5)]


def _nan_time_error(points: np.ndarray) -> Found:
    x = torch.from_numpy(points)
    errors = [float((m(x, math.nan) - m(x, 0.0)).detach().abs().max()) for m in _modules()]
    return f"kernel and torch differ from t = 0 by {errors[0]:g} and {errors[1]:g}", largest(errors)


def _bad_points_error() -> Found:
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
    return f"{len(bad)} points, values and gradients", largest(errors)


def _gradient_error(points: np.ndarray) -> Found:
    errors = []
    for module, t in itertools.product(_modules(), (-1.0, 0.0, 0.4, 1.0, 2.0)):
        doubled = hexplane.HexPlane.from_plane_arrays(BOX, module.plane_arrays()).double()
        found, expected = (_gradients(m, points, t) for m in (module, doubled))
        errors += [float((f - e).abs().max() / e.abs().max()) for f, e in zip(found, expected, strict=True)]
    return f"{len(points)} points at 5 times, kernel and torch", largest(errors)


def _gradients(module: hexplane.HexPlane, points: np.ndarray, t: float) -> list[torch.Tensor]:
    x = torch.from_numpy(points).to(module.grid.dtype).requires_grad_()
    features = module(x, t)
    weights = torch.linspace(-1, 1, features.numel(), dtype=features.dtype).view_as(features)
    return [g.double() for g in torch.autograd.grad((features * weights).sum(), [module.grid, x])]


# -- deformation -------------------------------------------------------------------------------------------------------


def _deformation() -> Iterator[Case]:
    """Each field's residuals and the pictures of its file, then what overflows."""
    row = partial(Case, "deformation")
    swing, still = np.linspace(0, 1, 31).tolist(), [0.0, 0.5, 1.0]
    exact, finite = "the residuals of float64, by model and encoder", "finite pictures"
    rows = np.arange(12)[:, None]  # of time
    tearing = partial(_field, xy=np.where(np.arange(36).reshape(6, 6) % 2, 3.0, -3.0))
    teleporting = partial(_field, xt=np.where(rows > 5, 3.0, 0.0) * np.ones(6))
    swinging = partial(_field, xt=np.where(rows % 2, 2.0, -2.0) * np.ones(6))
    fields: list[tuple[str, str, Callable[[], Deformation], Sequence[float]]] = [
        ("tears", "neighbouring cells of xy at -3 and 3 scene units", tearing, still),
        ("teleports", "0 up to a time row, 3 scene units from the next on", teleporting, _around(11, 5, 6)),
        ("oscillates faster than the time grid", "+-2 scene units in alternate time rows, and between them", swinging,
         swing),
        ("moves everything by 5e5", "every anchor leaves the view by 5e5 scene units", partial(_moved, 5e5), (0.5,)),
    ]  # fmt: skip
    for name, fed, make, times in fields:
        yield row(name, f"{fed}; {len(times)} instants", exact, FLOAT32, partial(_residual_error, make, times))
        close = f"{finite}, within 1/255 of the float64 oracle's"
        measure = partial(_file_pictures, make, times)
        yield row(f"{name}: pictures of its file", f"{fed}; packed, unpacked and drawn", close, 1 / 255, measure)
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
    return _field(xy=np.full((6, 6), by), **({"xz": np.full((6, 6), by)} if by >= 1e20 else {}))


def _around(intervals: int, *rows: int) -> list[float]:
    """Instants on the time rows, beside them, and between them."""
    on = [row / intervals for row in rows]
    return sorted([0.0, 1.0, *on, *(x + d for x in on for d in (-1e-6, 1e-6)), float(np.mean(on))])


def _residual_error(make: Callable[[], Deformation], times: Sequence[float]) -> Found:
    deformation, places = make(), _points(60, 1.2)
    module = DeformationField.from_arrays(deformation, BOX)
    worst = {"model": 0.0, "encoder": 0.0}
    ((head, _),) = deformation.networks["position"]
    ((trunk, _),) = deformation.networks["trunk"]
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
    return f"{len(data):,} bytes, {len(times)} pictures", largest(picture_error(model, 1, t) for t in times)


# -- masks -------------------------------------------------------------------------------------------------------------

LOGITS = (-100.0, -10.0, -4.59512, 0.0, 4.0, 10.0, 100.0)
FAR = (-1e4, *LOGITS, 1e4)  #: float32 sums of these lose up to 5e-4


def _masks() -> Iterator[Case]:
    """Values, gradients, codes, what is sent and drawn, refusals."""
    row = partial(Case, "masks")
    for logits, bound in ((LOGITS, 1e-5), (FAR, 2e-4)):
        name, promised = f"logits {logits[0]:g}..{logits[-1]:g}", f"the exact masks within {bound:g}"
        rising, measure = f"{promised}, never falling with the level", partial(_level_mask_error, logits)
        yield row(f"masks of {name}", f"{name} at all three levels", rising, bound, measure)
    for name, fed, promised, count in (
        ("gradients of masks at 0 and 1", "logits -1e4..1e4 at all three levels", "all finite", _mask_gradients),
        ("codes at 0, 1 and the threshold", "0, -0, 0.01, its float32 neighbours, 1, halves of a code",
         "0 up to 0.01, else at least 3, ties to even", _code_errors),
        ("every code there and back", "codes 0 and 3..255 as masks of a model, and as codes again", "unchanged",
         _codes_changed),
        ("drawn where sent", "anchors with masks around the threshold", "drawn if and only if in the file",
         _drawn_against_sent),
    ):  # fmt: skip
        yield row(name, fed, promised, 0.0, count)
    for mask, what in ((0, "no anchor is in the file, the picture is the background"), (255, "the oracle's picture")):
        fed = f"40 anchors of mask {mask // 255}; packed, unpacked and drawn"
        yield row(f"all masks {mask // 255}", fed, what, 1e-5, partial(_picture_of_mask, mask))
    for value in (-0.001, 1.001, math.nan, math.inf):
        act = partial(quantise.mask_codes, np.array([value]))
        yield refusal("masks", f"mask {value:g}", "a mask outside 0..1", EncodeError, act)


def _triples(logits: Sequence[float]) -> torch.Tensor:
    return torch.tensor(list(itertools.product(logits, repeat=3)))


def _level_mask_error(values: Sequence[float]) -> Found:
    mp = shared.mpmath()
    logits = _triples(values)
    masks_of = [masks.level_mask(logits, level) for level in range(3)]
    worst = 0.0
    with mp.workdps(40):
        for i, (a, b, c) in enumerate(logits.tolist()):
            total = mp.mpf(a)
            for level, rise in enumerate((None, b, c)):
                total += 0 if rise is None else max(mp.mpf(rise), 0) + mp.log1p(mp.exp(-abs(mp.mpf(rise))))
                worst = largest([worst, abs(float(masks_of[level][i]) - float(1 / (1 + mp.exp(-total))))])
    falls = max(float((low - high).max()) for low, high in itertools.pairwise(masks_of))
    return f"{len(logits)} triples, largest fall {max(falls, 0.0):g}", worst if falls <= 0 else math.nan


def _mask_gradients() -> Found:
    bad = 0
    for level in range(3):
        logits = _triples(FAR).requires_grad_()
        (slope,) = torch.autograd.grad(masks.level_mask(logits, level).sum(), logits)
        bad += int((~torch.isfinite(slope)).sum())
    return f"{bad} of {9 * len(FAR) ** 3} gradients not finite", float(bad)


def _threshold_neighbours() -> list[float]:
    at = np.float32(MASK_THRESHOLD)
    return [float(x) for x in (np.nextafter(at, np.float32(0)), at, np.nextafter(at, np.float32(1)))]


def _code_errors() -> Found:
    masks = [0.0, -0.0, 1e-30, MASK_THRESHOLD, *_threshold_neighbours(), 0.0118, 1.0, float(np.float32(1 - 2**-24))]
    masks += [float(np.float32((c + 0.5) / 255)) for c in range(3, 254)]
    expected = [0 if m <= MASK_THRESHOLD else max(3, round(Fraction(m) * 255)) for m in masks]
    wrong = int((quantise.mask_codes(np.array(masks)) != np.array(expected)).sum())
    return f"{wrong} of {len(masks)} codes wrong", float(wrong)


def _codes_changed() -> Found:
    codes = np.array([0, *range(3, 256)], np.uint8)
    logits = torch.from_numpy(masks.mask_logits(np.repeat(codes[:, None] / 255, 3, axis=1)))
    again = [quantise.mask_codes(masks.level_mask(logits, level).numpy()) for level in range(3)]
    wrong = sum(int((found != codes).sum()) for found in again)
    return f"{wrong} of {3 * codes.size} codes changed", float(wrong)


def _drawn_against_sent() -> Found:
    masks = [*_threshold_neighbours(), 0.0, 0.0099, 0.0101, 0.5, 1.0]
    model = from_scene(small_scene(anchors=len(masks)))
    logit = np.log(np.clip(masks, 1e-7, 1 - 1e-7)) - np.log1p(-np.clip(masks, 1e-7, 1 - 1e-7))
    with torch.no_grad():
        model.mask_logits[:, 0] = torch.from_numpy(logit).float()
    drawn = set(model.visible(0, CAMERA).tolist())
    sent = set(np.flatnonzero(quantise.mask_codes(model.masks(0).detach().numpy())).tolist())
    return f"{len(drawn)} drawn, {len(sent)} sent", float(len(drawn ^ sent))


def _picture_of_mask(mask: int) -> Found:
    decoded = decoder.decode(encoder.encode(small_scene(mask=mask), effort=1))
    level = level_of(decoded)
    error = picture_error(from_scene(decoded), 0, 0.0)
    if not mask:
        background = np.array(decoded.info.background, np.float32)
        error = largest([error, float(np.abs(level.picture(CAMERA, 0.0) - background).max())])
    kept = len(decoded.anchor_q)
    return f"{kept} anchors in the file", error if kept == (40 if mask else 0) else math.nan
