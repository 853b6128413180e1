"""Runs of 4DGaussians (Wu et al. 2024) and Deformable-3DGS (Yang et al. 2024): Gaussians that a network moves.

Both have the Gaussians at rest in `point_cloud.ply`, and a network that takes their means and a time.

4DGaussians (`deformation.pth` beside them): at each resolution the product of six planes over pairs of x, y, z and t,
sampled bilinearly, gives features; those of all resolutions enter a network, whose outputs enter heads that add to
means, logarithms of scales, quaternions, logits of opacities and harmonics. `cfg_args` says which heads are in use.

Deformable-3DGS (`deform/iteration_N/deform.pth`): a network with a skip takes sines and cosines of mean and time. It
adds to means, or turns and shifts them as a screw (6DoF), to scales and to unit quaternions. The sum stays as it is in
the formula of the rotation matrix, which then stretches as well: https://github.com/ingra14m/Deformable-3D-Gaussians/issues/18
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial, reduce
from itertools import combinations
from pathlib import Path

import numpy as np

from pd4dgs_codec.data.cameras import rotation_matrix
from pd4dgs_codec.data.files import Color
from pd4dgs_codec.errors import DataError
from pd4dgs_codec.interchange.formats import activated, checked, finite_rows, read_parameters
from pd4dgs_codec.interchange.runs import MAX_WIDTH, PLY, Config, Layer, State, iteration, network_of, run_of
from pd4dgs_codec.interchange.splats import Splats, principal_axes, quaternions, unit

ROWS = 1 << 13  #: Gaussians moved at once: the outputs of the widest layer take 32 MiB
MOST_LAYERS = 16  #: layers of a network, or resolutions of planes
#: The heads of 4DGaussians by what they change, and the option that switches each off with its value in older runs,
#: which lack it.
HEADS = {
    "means": ("pos_deform", "no_dx", "False"),
    "scales": ("scales_deform", "no_ds", None),
    "quats": ("rotations_deform", "no_dr", None),
    "opacities": ("opacity_deform", "no_do", None),
    "sh": ("shs_deform", "no_dshs", "True"),
}
UNREAD = ("no_grid", "empty_voxel", "grid_pe")  #: options of 4DGaussians that no published setting uses
THINNEST = 1e-6  #: sides of the box that the planes cover, scene units
#: Frequencies of Deformable-3DGS: of means, of times that a network of their own takes, and of other times.
MEAN_OCTAVES, NET_OCTAVES, TIME_OCTAVES = 10, 6, 10
AXIS_BIAS = np.float32(1e-5)  #: added to unit vectors of screws by Deformable-3DGS

Parts = dict[str, np.ndarray]  #: Gaussians: rows of means, quats, scales, opacities and sh
Move = Callable[[Parts, float], Parts]


def read_deformed(folder: Path) -> tuple[Callable[[float], Splats], Color] | None:
    """(time 0..1 -> Gaussians, background) of a run's last iteration, or of the iteration at `folder`; None for other
    folders. Raises DataError."""
    place = iteration(folder)
    network = network_of(place) if place else None
    if place is None or network is None:
        return None
    config = Config.of(run_of(place))
    rest = read_parameters(place / PLY)
    good = finite_rows(rest)
    rest = {name: values[good] for name, values in rest.items()}
    state = State.read(network)
    if network.parent == place:
        move = _hexplane_move(state, config, rest)
    else:
        rest = activated(rest) | {"quats": unit(rest["quats"])}
        move = _positional_move(state)
    return lru_cache(maxsize=2)(partial(_moved, str(folder), rest, move)), config.background


def _moved(where: str, rest: Parts, move: Move, t: float) -> Splats:
    """The Gaussians at a time, some rows after the others."""
    blocks = []
    with np.errstate(over="ignore", invalid="ignore", divide="ignore", under="ignore"):
        for start in range(0, len(rest["means"]), ROWS):
            blocks.append(move({name: values[start : start + ROWS] for name, values in rest.items()}, t))
    if not blocks:
        raise DataError(f"{where}: holds no Gaussian that is finite, expected one at least")
    return checked(f"{where} at {t:g}", **{name: np.concatenate([block[name] for block in blocks]) for name in rest})


def _through(layers: list[Layer], values: np.ndarray) -> np.ndarray:
    """Linear layers with a ReLU between them."""
    for i, (weight, bias) in enumerate(layers):
        values = (np.maximum(values, 0) if i else values) @ weight.T + bias
    return values


def _places(state: State, name: str) -> list[int]:
    """Numbers of the linear layers of a sequence, of which every second one is a ReLU."""
    return [i for i in range(0, 2 * MOST_LAYERS, 2) if f"{name}.{i}.weight" in state.tensors] or [0]


# -- 4DGaussians -------------------------------------------------------------------------------------------------------


def _hexplane_move(state: State, config: Config, rest: Parts) -> Move:
    """The network of 4DGaussians, for Gaussians at rest."""
    for name in UNREAD:
        if (value := config.get(name)) not in (None, "False", "0"):
            raise DataError(f"{config.path}: has {name}={value}, expected a model without")
    net = "deformation_net"
    field, features = _field(state, f"{net}.grid")
    trunk = state.chain(f"{net}.feature_out", _places(state, f"{net}.feature_out"), features)
    width = len(trunk[-1][1])
    heads = {
        name: state.chain(f"{net}.{head}", (1, 3), width, int(np.prod(rest[name].shape[1:])))
        for name, (head, option, usual) in HEADS.items()
        if not config.flag(option, usual)
    }
    static = state.chain(f"{net}.static_mlp", (1, 3), width, 1) if config.flag("static_mlp", "False") else None
    turns = config.flag("apply_rotation", "False")

    def move(parts: Parts, t: float) -> Parts:
        hidden = np.maximum(_through(trunk, field(parts["means"], t)), 0)
        keep = _through(static, hidden) if static else np.ones((len(hidden), 1), np.float32)
        moved = dict(parts)
        for name, head in heads.items():
            values = parts[name]
            change = _through(head, hidden).reshape(values.shape)
            if name == "quats":
                moved[name] = _product(values, change) if turns else values + change
            else:
                moved[name] = values * keep.reshape(-1, *[1] * (values.ndim - 1)) + change
        return activated(moved)

    return move


def _field(state: State, name: str) -> tuple[Callable[[np.ndarray, float], np.ndarray], int]:
    """(means [n, 3] and a time -> features [n, F], those of each resolution side by side; F)."""
    count = sum(f"{name}.grids.{i}.0" in state.tensors for i in range(MOST_LAYERS))
    levels = [_planes(state, f"{name}.grids.{i}") for i in range(max(count, 1))]
    corner, other = state.take(f"{name}.aabb", 2, 3)
    if not (np.abs(corner - other) > THINNEST).all():
        raise DataError(f"{state.path}: {name}.aabb is flat, expected sides over {THINNEST:g}")

    def field(means: np.ndarray, t: float) -> np.ndarray:
        # the first corner is at -1; times are 0..1 on an axis from -1 to 1
        places = (means - corner) * (2 / (other - corner)) - 1
        axes = [*places.T, np.full(len(means), t, np.float32)]
        features = []
        for planes in levels:
            samples = (_bilinear(plane, *pair) for plane, pair in zip(planes, combinations(axes, 2), strict=True))
            features.append(reduce(np.multiply, samples))
        return np.concatenate(features, axis=1)

    return field, sum(planes[0].shape[2] for planes in levels)


def _planes(state: State, name: str) -> list[np.ndarray]:
    """The planes [rows, columns, features] of a resolution, over xy, xz, xt, yz, yt and zt; the first is the column."""
    planes = [state.take(f"{name}.0", 1, None, None, None)]
    features = planes[0].shape[1]
    if features > MAX_WIDTH:
        raise DataError(f"{state.path}: {name}.0 has {features} features, expected {MAX_WIDTH} at most")
    planes += [state.take(f"{name}.{i}", 1, features, None, None) for i in range(1, 6)]
    return [np.ascontiguousarray(plane[0].transpose(1, 2, 0)) for plane in planes]


def _bilinear(plane: np.ndarray, across: np.ndarray, down: np.ndarray) -> np.ndarray:
    """A plane [rows, columns, F] at coordinates [n] from -1, its first cell, to 1, its last; beyond, its border."""
    ends = []
    for place, size in ((down, plane.shape[0]), (across, plane.shape[1])):
        cell = np.clip((place + 1) / 2 * (size - 1), 0, size - 1)
        low = np.minimum(cell.astype(np.int64), max(size - 2, 0))
        ends.append((low, np.minimum(low + 1, size - 1), (cell - low).astype(np.float32)[:, None]))
    (top, bottom, v), (left, right, u) = ends
    above = plane[top, left] * (1 - u) + plane[top, right] * u
    below = plane[bottom, left] * (1 - u) + plane[bottom, right] * u
    return np.asarray(above * (1 - v) + below * v)


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Products of quaternions [n, 4] wxyz."""
    w, v = a[:, :1] * b[:, :1] - (a[:, 1:] * b[:, 1:]).sum(axis=1, keepdims=True), np.cross(a[:, 1:], b[:, 1:])
    return np.concatenate([w, a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:] + v], axis=1)


# -- Deformable-3DGS ---------------------------------------------------------------------------------------------------


def _positional_move(state: State) -> Move:
    """The network of Deformable-3DGS, for Gaussians at rest with their scales and unit quaternions."""
    has_net = "timenet.0.weight" in state.tensors  # the option is_blender
    octaves = NET_OCTAVES if has_net else TIME_OCTAVES
    timenet = state.chain("timenet", (0, 2), 1 + 2 * octaves) if has_net else []
    inputs = 3 * (1 + 2 * MEAN_OCTAVES) + (len(timenet[-1][1]) if timenet else 1 + 2 * octaves)
    count = sum(f"linear.{i}.weight" in state.tensors for i in range(MOST_LAYERS))
    layers = [state.linear("linear.0", inputs)]
    for i in range(1, count):
        joined = inputs if i == count // 2 + 1 else 0
        layers.append(state.linear(f"linear.{i}", joined + len(layers[-1][1])))
    width = len(layers[-1][1])
    screw = "branch_w.weight" in state.tensors  # the option is_6dof
    shifts = [state.linear(name, width, 3) for name in (("branch_w", "branch_v") if screw else ("gaussian_warp",))]
    turn, grow = state.linear("gaussian_rotation", width, 4), state.linear("gaussian_scaling", width, 3)

    def move(parts: Parts, t: float) -> Parts:
        means = parts["means"]
        time = _through(timenet, _waves(np.full((1, 1), t, np.float32), octaves))
        given = np.concatenate([_waves(means, MEAN_OCTAVES), np.repeat(time, len(means), axis=0)], axis=1)
        hidden = given
        for i, layer in enumerate(layers):
            taken = np.concatenate([given, hidden], axis=1) if i == count // 2 + 1 else hidden
            hidden = np.maximum(_through([layer], taken), 0)
        shift, *more = (_through([layer], hidden) for layer in shifts)
        factors = rotation_matrix(parts["quats"] + _through([turn], hidden))
        factors = factors * (parts["scales"] + _through([grow], hidden))[:, None, :]
        scales, axes = principal_axes(factors @ factors.transpose(0, 2, 1))
        moved = _screwed(means, shift, more[0]) if more else means + shift
        return parts | {"means": moved, "scales": scales, "quats": quaternions(axes)}

    return move


def _waves(values: np.ndarray, octaves: int) -> np.ndarray:
    """[n, d (1 + 2 octaves)]: values [n, d], and per octave the sines and cosines of values times 1, 2, 4, ..."""
    waves = [wave(values * np.float32(2**i)) for i in range(octaves) for wave in (np.sin, np.cos)]
    return np.concatenate([values, *waves], axis=1)


def _screwed(means: np.ndarray, axis: np.ndarray, way: np.ndarray) -> np.ndarray:
    """Means [n, 3] turned and shifted by the exponential of a screw, whose angle is the length of `axis` [n, 3]."""
    angle = np.linalg.norm(axis, axis=1, keepdims=True)
    axis, way = axis / angle + AXIS_BIAS, way / angle + AXIS_BIAS

    def combined(vectors: np.ndarray, *factors: np.ndarray | float) -> np.ndarray:
        once = np.cross(axis, vectors)
        return factors[0] * vectors + factors[1] * once + factors[2] * np.cross(axis, once)

    sine, versine = np.sin(angle), 1 - np.cos(angle)
    return np.asarray(combined(means, 1.0, sine, versine) + combined(way, angle, versine, angle - sine))
