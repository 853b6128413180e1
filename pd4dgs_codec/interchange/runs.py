"""Reads output folders of Gaussian trainers as data: iterations, options, cameras and tensors of networks.

A run holds `point_cloud/iteration_N` with a PLY file and perhaps networks, `cfg_args` with the options as Python wrote
them, and `cameras.json`.

In runs of 4DGaussians (Wu et al. 2024) and Deformable-3DGS (Yang et al. 2024) a network moves the Gaussians of
`point_cloud.ply`: it takes their means and a time.

4DGaussians (`deformation.pth` beside the PLY file): six planes over pairs of x, y, z and t, sampled bilinearly and
multiplied, give features at each resolution. A network takes the features of all resolutions. Its heads add to means,
logarithms of scales, quaternions, logits of opacities and harmonics; `cfg_args` says which heads are in use.

Deformable-3DGS (`deform/iteration_N/deform.pth`): a network with a skip takes sines and cosines of mean and time. It
adds to scales and unit quaternions, and adds to means or moves them by a screw (6DoF). The sums of quaternions are not
normalised, so the rotation matrix also scales: https://github.com/ingra14m/Deformable-3D-Gaussians/issues/18

SC-GS (Huang et al. 2024): such a network moves nodes in `deform.pth`, and Gaussians go with the nodes near them in
space and in the first features of the PLY file. The last feature may say how much of the motion they take part in.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial, reduce
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from pd4dgs_codec.archives import read_tensors
from pd4dgs_codec.data.files import LARGEST, WHITE, Color, array, number, read_file, read_vertices, whole_number
from pd4dgs_codec.data.view import check_rotation, rotation_matrix, up_direction, world_to_camera
from pd4dgs_codec.errors import DataError, one_line
from pd4dgs_codec.interchange.splats import (
    activated,
    checked,
    finite_rows,
    principal_axes,
    quaternions,
    read_parameters,
)
from pd4dgs_codec.kinds.splats import Splats, product, unit
from pd4dgs_codec.scene import Camera

PLY = "point_cloud.ply"
#: Most inputs or outputs of a layer, which bounds the time and memory of a Gaussian.
MAX_WIDTH = 1024
Layer = tuple[np.ndarray, np.ndarray]  #: weight float32 [outputs, inputs], bias float32 [outputs]


def iteration(folder: Path) -> Path | None:
    """Finds the folder with point_cloud.ply: `folder` itself, or the last iteration below it; None if it has none."""
    if (folder / PLY).is_file():
        return folder
    base = folder / "point_cloud" if (folder / "point_cloud").is_dir() else folder
    found = {
        int(match[1]): path
        for path in base.glob("iteration_*")
        if (match := re.fullmatch(r"iteration_(\d{1,9})", path.name)) and (path / PLY).is_file()
    }
    return found.get(max(found, default=0))


def run_of(place: Path) -> Path:
    """The folder of the run that an iteration belongs to."""
    return place.parent.parent if place.parent.name == "point_cloud" else place


def network_of(place: Path) -> Path | None:
    """Returns the file, perhaps missing, of the network that moves an iteration's Gaussians, None if they are static.
    4DGaussians writes it beside the PLY file, Deformable-3DGS into a folder of its own."""
    if any(place.glob("deformation*.pth")):
        return place / "deformation.pth"
    deform = run_of(place) / "deform"
    return deform / place.name / "deform.pth" if deform.is_dir() else None


@dataclass(frozen=True)
class Config:
    """The options of a run: the text `Namespace(name=value, ...)`, never evaluated. Empty if there is no file."""

    path: Path
    text: str

    @classmethod
    def of(cls, run: Path) -> Config:
        """Reads the `cfg_args` of a run."""
        path = run / "cfg_args"
        return cls(path, read_file(path).decode("utf-8", "replace") if path.is_file() else "")

    def get(self, name: str) -> str | None:
        """Returns the text of an option that is a number, a truth value or a name; None for any other."""
        found = re.search(rf"\b{name}=([-+.\w]{{1,40}})\s*[,)]", self.text)
        return found and found[1]

    def flag(self, name: str, usual: str | None) -> bool:
        """Returns a truth value. usual: its text if the option is missing, None to raise DataError."""
        found = self.get(name) or usual
        if found not in ("True", "False"):
            raise DataError(f"{self.path}: {name} is {found or 'missing'}, expected True or False")
        return found == "True"

    def number(self, name: str, usual: str = "missing") -> float:
        """Returns a number. usual: its text if the option is missing. Raises DataError."""
        found = self.get(name) or usual
        try:
            return float(found)
        except ValueError:
            raise DataError(f"{self.path}: {name} is {found}, expected a number") from None

    @property
    def background(self) -> Color:
        """White if `white_background` is True, else black."""
        return WHITE if self.get("white_background") == "True" else (0.0, 0.0, 0.0)


def read_torch(path: Path) -> Any:
    """Reads a file of torch as `archives.read_tensors` does."""
    return read_tensors(read_file(path), str(path))


@dataclass(frozen=True)
class State:
    """Tensors of networks by name; its methods check them and raise DataError."""

    path: Path
    tensors: Mapping[Any, Any]

    @classmethod
    def read(cls, path: Path) -> State:
        """Reads a state dict."""
        content = read_torch(path)
        if not isinstance(content, dict):
            raise DataError(f"{path}: holds a {type(content).__name__}, expected a dict of tensors")
        return cls(path, content)

    def take(self, name: str, *shape: int | None, finite: bool = True) -> np.ndarray:
        """Returns a tensor as float32. shape: its lengths, None for any but 0. finite: refuse any other number."""
        found = self.tensors.get(name)
        if not isinstance(found, np.ndarray):
            raise DataError(f"{self.path}: has no tensor {name}")
        if len(found.shape) != len(shape) or any(
            n != (m or max(n, 1)) for n, m in zip(found.shape, shape, strict=True)
        ):
            expected = ", ".join(str(n or "any") for n in shape)
            raise DataError(f"{self.path}: {name} has shape {found.shape}, expected ({expected})")
        if finite and not (np.abs(found) <= LARGEST).all():  # also true of NaN
            raise DataError(f"{self.path}: {name} holds a NaN or a number over {LARGEST:g}")
        return found.astype(np.float32)

    def linear(self, name: str, inputs: int | None = None, outputs: int | None = None) -> Layer:
        """Returns a linear layer. inputs, outputs: None for any number."""
        weight = self.take(f"{name}.weight", outputs, inputs)
        if max(weight.shape) > MAX_WIDTH:
            raise DataError(f"{self.path}: {name}.weight has shape {weight.shape}, expected {MAX_WIDTH} at most")
        return weight, self.take(f"{name}.bias", len(weight))

    def chain(self, name: str, places: Iterable[int], inputs: int, outputs: int | None = None) -> list[Layer]:
        """Returns the linear layers `name.place`, each of which takes the outputs of the previous one."""
        layers: list[Layer] = []
        *_, last = places = list(places)
        for place in places:
            layers.append(self.linear(f"{name}.{place}", inputs, outputs if place == last else None))
            inputs = len(layers[-1][1])
        return layers


def read_cameras(path: Path) -> tuple[list[Camera], tuple[float, float, float]]:
    """Reads (cameras, their up direction) from a cameras.json of 3D Gaussian splatting. Raises DataError."""
    try:
        rows = json.loads(read_file(path))
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path}: cannot be read as JSON: {error}") from None
    if not (isinstance(rows, list) and rows and all(isinstance(row, dict) for row in rows)):
        raise DataError(f"{path}: expected a list of cameras with position, rotation, fx, fy, width and height")
    cameras = []
    for i, row in enumerate(rows):
        where = f"{path}: camera {i}:"
        turn = array(row.get("rotation"), (3, 3), f"{where} rotation")
        check_rotation(turn, f"{where} rotation")
        place = array(row.get("position"), (3,), f"{where} position")
        fx, fy = (number(row.get(key), f"{where} {key}", positive=True) for key in ("fx", "fy"))
        width, height = (whole_number(row.get(key), f"{where} {key}", 1, 65535) for key in ("width", "height"))
        K = np.array([[fx, 0, width / 2], [0, fy, height / 2], [0, 0, 1]], np.float32)
        cameras.append(Camera(world_to_camera(turn.T, place).astype(np.float32), K, width, height))
    return cameras, up_direction([camera.viewmat for camera in cameras])


# -- Gaussians that a network moves ------------------------------------------------------------------------------------

ROWS = 1 << 13  #: Gaussians moved at once: the outputs of the widest layer take 32 MiB
MOST_LAYERS = 16  #: layers of a network, or resolutions of planes
#: Attribute -> (head of 4DGaussians, option that switches it off, value of the option in older runs without it).
HEADS = {
    "means": ("pos_deform", "no_dx", "False"),
    "scales": ("scales_deform", "no_ds", None),
    "quats": ("rotations_deform", "no_dr", None),
    "opacities": ("opacity_deform", "no_do", None),
    "sh": ("shs_deform", "no_dshs", "True"),
}
UNREAD = ("no_grid", "empty_voxel", "grid_pe")  #: options of 4DGaussians that no published setting uses
THINNEST = 1e-6  #: least side of the box that the planes cover, scene units
#: Octaves of Deformable-3DGS's encodings of means, of times that enter a network of their own, and of other times.
MEAN_OCTAVES, NET_OCTAVES, TIME_OCTAVES = 10, 6, 10
AXIS_BIAS = np.float32(1e-5)  #: added to unit vectors of screws by Deformable-3DGS

Parts = dict[str, np.ndarray]  #: Gaussians: rows of means, quats, scales, opacities and sh
Move = Callable[[Parts, float], Parts]


def read_deformed(folder: Path) -> tuple[Callable[[float], Splats], Color] | None:
    """Reads a run's last iteration, or the iteration at `folder`, as (function of time 0..1 -> Gaussians, background).
    Returns None for folders without a network that moves Gaussians. Raises DataError."""
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
    elif "nodes" in state.tensors:
        table = read_vertices(place / PLY)[good]
        names = [name for name in table.dtype.names or () if name.startswith("fea_")]
        features = np.array([table[name] for name in names], np.float32).reshape(len(names), len(table)).T
        rest, move = _node_move(state, config, rest, features)
    else:
        rest = activated(rest) | {"quats": unit(rest["quats"])}
        move = _positional_move(state)
    return lru_cache(maxsize=2)(partial(_moved, str(folder), rest, move)), config.background


def _moved(where: str, rest: Parts, move: Move, t: float) -> Splats:
    """Moves the Gaussians to time t, ROWS at a time."""
    blocks = []
    with np.errstate(over="ignore", invalid="ignore", divide="ignore", under="ignore"):
        for start in range(0, len(rest["means"]), ROWS):
            blocks.append(move({name: values[start : start + ROWS] for name, values in rest.items()}, t))
    if not blocks:
        raise DataError(f"{where}: holds no Gaussian that is finite, expected one at least")
    return checked(
        f"{where} at {t:g}", **{name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}
    )


def through(layers: list[Layer], values: np.ndarray) -> np.ndarray:
    """Applies linear layers with a ReLU between them."""
    for i, (weight, bias) in enumerate(layers):
        values = (np.maximum(values, 0) if i else values) @ weight.T + bias
    return values


# -- 4DGaussians -------------------------------------------------------------------------------------------------------


def _hexplane_move(state: State, config: Config, rest: Parts) -> Move:
    """Reads the network of 4DGaussians. Its Move takes parameters with the shapes of `rest` and activates them."""
    for name in UNREAD:
        if (value := config.get(name)) not in (None, "False", "0"):
            raise DataError(f"{config.path}: has {name}={value}, expected 0 or False")
    net = "deformation_net"
    field, features = _field(state, f"{net}.grid")
    places = [i for i in range(0, 2 * MOST_LAYERS, 2) if f"{net}.feature_out.{i}.weight" in state.tensors]
    trunk = state.chain(f"{net}.feature_out", places or [0], features)  # every second layer is a ReLU
    width = len(trunk[-1][1])
    heads = {
        name: state.chain(f"{net}.{head}", (1, 3), width, int(np.prod(rest[name].shape[1:])))
        for name, (head, option, usual) in HEADS.items()
        if not config.flag(option, usual)
    }
    static = state.chain(f"{net}.static_mlp", (1, 3), width, 1) if config.flag("static_mlp", "False") else None
    turns = config.flag("apply_rotation", "False")

    def move(parts: Parts, t: float) -> Parts:
        hidden = np.maximum(through(trunk, field(parts["means"], t)), 0)
        keep = through(static, hidden) if static else np.ones((len(hidden), 1), np.float32)
        moved = dict(parts)
        for name, head in heads.items():
            values = parts[name]
            change = through(head, hidden).reshape(values.shape)
            if name == "quats":
                moved[name] = product(values, change) if turns else values + change
            else:
                moved[name] = values * keep.reshape(-1, *[1] * (values.ndim - 1)) + change
        return activated(moved)

    return move


def _field(state: State, name: str) -> tuple[Callable[[np.ndarray, float], np.ndarray], int]:
    """Returns (function of means [n, 3] and a time -> features [n, F] of all resolutions side by side, F)."""
    count = sum(f"{name}.grids.{i}.0" in state.tensors for i in range(MOST_LAYERS))
    levels = [_planes(state, f"{name}.grids.{i}") for i in range(max(count, 1))]
    corner, other = state.take(f"{name}.aabb", 2, 3)
    if not (np.abs(corner - other) > THINNEST).all():
        raise DataError(f"{state.path}: {name}.aabb is flat, expected sides over {THINNEST:g}")

    def field(means: np.ndarray, t: float) -> np.ndarray:
        # the first corner is at -1; times 0..1 are not rescaled, so they fill half of their axis
        places = (means - corner) * (2 / (other - corner)) - 1
        axes = [*places.T, np.full(len(means), t, np.float32)]
        features = []
        for planes in levels:
            samples = (_bilinear(plane, *pair) for plane, pair in zip(planes, combinations(axes, 2), strict=True))
            features.append(reduce(np.multiply, samples))
        return np.concatenate(features, axis=1)

    return field, sum(planes[0].shape[2] for planes in levels)


def _planes(state: State, name: str) -> list[np.ndarray]:
    """Returns one resolution's planes [rows, columns, features] over xy, xz, xt, yz, yt, zt; x is the column of xy."""
    planes = [state.take(f"{name}.0", 1, None, None, None)]
    features = planes[0].shape[1]
    if features > MAX_WIDTH:
        raise DataError(f"{state.path}: {name}.0 has {features} features, expected {MAX_WIDTH} at most")
    planes += [state.take(f"{name}.{i}", 1, features, None, None) for i in range(1, 6)]
    return [np.ascontiguousarray(plane[0].transpose(1, 2, 0)) for plane in planes]


def _bilinear(plane: np.ndarray, across: np.ndarray, down: np.ndarray) -> np.ndarray:
    """Samples a plane [rows, columns, F] at coordinates [n] from -1 (first cell) to 1 (last), clamped to its border."""
    ends = []
    for place, size in ((down, plane.shape[0]), (across, plane.shape[1])):
        cell = np.clip((place + 1) / 2 * (size - 1), 0, size - 1)
        low = np.minimum(cell.astype(np.int64), max(size - 2, 0))
        ends.append((low, np.minimum(low + 1, size - 1), (cell - low).astype(np.float32)[:, None]))
    (top, bottom, v), (left, right, u) = ends
    above = plane[top, left] * (1 - u) + plane[top, right] * u
    below = plane[bottom, left] * (1 - u) + plane[bottom, right] * u
    return np.asarray(above * (1 - v) + below * v)


# -- Deformable-3DGS ---------------------------------------------------------------------------------------------------


def positional(state: State, prefix: str = "") -> tuple[Callable[[np.ndarray, float], np.ndarray], int, int]:
    """Reads a network of layers with a skip, whose names begin with `prefix`. Returns (function of points [n, 3] and a
    time -> what enters the network and its last features, [n, F + W]; F; W)."""
    has_net = f"{prefix}timenet.0.weight" in state.tensors  # the option is_blender
    octaves = NET_OCTAVES if has_net else TIME_OCTAVES
    timenet = state.chain(f"{prefix}timenet", (0, 2), 1 + 2 * octaves) if has_net else []
    inputs = 3 * (1 + 2 * MEAN_OCTAVES) + (len(timenet[-1][1]) if timenet else 1 + 2 * octaves)
    count = sum(f"{prefix}linear.{i}.weight" in state.tensors for i in range(MOST_LAYERS))
    layers = [state.linear(f"{prefix}linear.0", inputs)]
    for i in range(1, count):
        joined = inputs if i == count // 2 + 1 else 0
        layers.append(state.linear(f"{prefix}linear.{i}", joined + len(layers[-1][1])))

    def features(points: np.ndarray, t: float) -> np.ndarray:
        time = through(timenet, _waves(np.full((1, 1), t, np.float32), octaves))
        given = np.concatenate([_waves(points, MEAN_OCTAVES), np.repeat(time, len(points), axis=0)], axis=1)
        hidden = given
        for i, layer in enumerate(layers):
            taken = np.concatenate([given, hidden], axis=1) if i == count // 2 + 1 else hidden
            hidden = np.maximum(through([layer], taken), 0)
        return np.concatenate([given, hidden], axis=1)

    return features, inputs, len(layers[-1][1])


def _positional_move(state: State) -> Move:
    """Reads the network of Deformable-3DGS. Its Move takes activated Gaussians with unit quaternions."""
    features, inputs, width = positional(state)
    screw = "branch_w.weight" in state.tensors  # the option is_6dof
    shifts = [state.linear(name, width, 3) for name in (("branch_w", "branch_v") if screw else ("gaussian_warp",))]
    turn, grow = state.linear("gaussian_rotation", width, 4), state.linear("gaussian_scaling", width, 3)

    def move(parts: Parts, t: float) -> Parts:
        means = parts["means"]
        hidden = features(means, t)[:, inputs:]
        shift, *more = (through([layer], hidden) for layer in shifts)
        factors = rotation_matrix(parts["quats"] + through([turn], hidden))
        factors = factors * (parts["scales"] + through([grow], hidden))[:, None, :]
        scales, axes = principal_axes(factors @ factors.transpose(0, 2, 1))
        moved = _screwed(means, shift, more[0]) if more else means + shift
        return parts | {"means": moved, "scales": scales, "quats": quaternions(axes)}

    return move


def _waves(values: np.ndarray, octaves: int) -> np.ndarray:
    """Returns [n, d (1 + 2 octaves)]: values [n, d] and, per octave, sines and cosines of values times 1, 2, 4, ..."""
    waves = [wave(values * np.float32(2**i)) for i in range(octaves) for wave in (np.sin, np.cos)]
    return np.concatenate([values, *waves], axis=1)


def _screwed(means: np.ndarray, axis: np.ndarray, way: np.ndarray) -> np.ndarray:
    """Moves means [n, 3] by the exponential of screws (axis, way), both [n, 3]. The angle is the length of `axis`."""
    angle = np.linalg.norm(axis, axis=1, keepdims=True)
    axis, way = axis / angle + AXIS_BIAS, way / angle + AXIS_BIAS

    def combined(vectors: np.ndarray, *factors: np.ndarray | float) -> np.ndarray:
        once = np.cross(axis, vectors)
        return factors[0] * vectors + factors[1] * once + factors[2] * np.cross(axis, once)

    sine, versine = np.sin(angle), 1 - np.cos(angle)
    return np.asarray(combined(means, 1.0, sine, versine) + combined(way, angle, versine, angle - sine))


# -- SC-GS -------------------------------------------------------------------------------------------------------------

MOST_NODES, MOST_NEAR = 1 << 12, 16  #: nodes, and those that move a Gaussian
FLOOR = 1e-7  #: added to the weights of nodes
#: Tensors of SC-GS's options use_hash, progressive_brand_time, pred_opacity and pred_color.
UNREAD_BY_NODES = tuple(f"network.{name}" for name in ("hashgrid", "embed_time", "gaussian_opacity", "gaussian_color"))
NODE_LAYERS = {"gaussian_warp": 3, "gaussian_scaling": 3, "gaussian_rotation": 4, "local_rotation": 4}


def _node_move(state: State, config: Config, rest: Parts, features: np.ndarray) -> tuple[Parts, Move]:
    """Reads the nodes of SC-GS and their network. features: float32 [n, F], coordinates of Gaussians beside means, and
    perhaps the logit of their share of the motion. Returns (activated Gaussians and their nodes, Move of them)."""
    if odd := [name for name in state.tensors if str(name).startswith(UNREAD_BY_NODES)]:
        raise DataError(f"{state.path}: has {one_line(odd[0], 60)}, which no published setting of SC-GS has")
    nodes, near, local = state.take("nodes", None, None), config.number("K"), "network.local_rotation.weight"
    count, more, most = len(nodes), nodes.shape[1] - 3, min(len(nodes), MOST_NEAR)
    masked = features.shape[1] - more == 1  # the option gs_with_motion_mask
    if count > MOST_NODES or not 0 <= more == features.shape[1] - masked or near not in range(1, most + 1):
        found = f"nodes {nodes.shape}, {features.shape[1]} features in the PLY file, K={near:g}"
        raise DataError(f"{state.path}: {found}, expected at most {MOST_NODES}, 3 and the features, 1 to {most}")
    limit, (layers_of, inputs, width) = config.number("max_d_scale", "-1"), positional(state, "network.")
    names = [name for name in NODE_LAYERS if name != "local_rotation" or local in state.tensors]
    layers = {name: state.linear(f"network.{name}", width, NODE_LAYERS[name]) for name in names}
    radii, logits = state.take("_node_radius", count), state.take("_node_weight", count, 1)[:, 0]
    places, k = np.concatenate([rest["means"], features[:, :more]], axis=1), int(near)
    rows, weights = np.empty((len(places), k), np.int64), np.empty((len(places), k), np.float32)
    with np.errstate(over="ignore", under="ignore"):
        for start in range(0, len(places), 1 << 10):
            own = places[start : start + (1 << 10)]
            apart = np.square(nodes).sum(axis=1) - 2 * own @ nodes.T  # less the square of the place
            nearest = np.argpartition(apart, k - 1, axis=1)[:, :k]
            apart = np.square(own[:, None] - nodes[nearest]).sum(axis=2)
            bells = np.exp(-apart / (2 * np.exp(2 * radii[nearest]))) / (1 + np.exp(-logits[nearest])) + FLOOR
            rows[start : start + len(own)], weights[start : start + len(own)] = nearest, bells
        share = 1 / (1 + np.exp(-features[:, -1:])) if masked else np.ones((len(places), 1), np.float32)
    weights /= weights.sum(axis=1, keepdims=True)
    nodes = nodes[:, :3]

    @lru_cache(maxsize=2)
    def of_nodes(t: float) -> Parts:
        hidden = layers_of(nodes, t)[:, inputs:]
        made = {name: through([layer], hidden) for name, layer in layers.items()}
        if limit > 0:
            made["gaussian_scaling"] = np.tanh(made["gaussian_scaling"]) * np.float32(np.log(limit))
        return made

    def move(parts: Parts, t: float) -> Parts:
        added, means = of_nodes(t), parts["means"]

        def mean(values: np.ndarray) -> np.ndarray:
            return np.asarray(np.einsum("nk,nk...->n...", parts["weights"], values[parts["nodes"]]))

        shift = mean(added["gaussian_warp"])
        if "local_rotation" in added:  # turns what is around a node
            turns = rotation_matrix(unit(added["local_rotation"] + np.array([1, 0, 0, 0], np.float32)))
            around = mean(nodes - np.einsum("mab,mb->ma", turns, nodes))
            shift = shift + np.einsum("nab,nb->na", mean(turns), means) + around - means
        quats = parts["quats"] + mean(added["gaussian_rotation"]) * parts["share"]
        scales = np.abs(parts["scales"] + mean(added["gaussian_scaling"]) * parts["share"])
        kept = {name: parts[name] for name in ("opacities", "sh")}
        return kept | {"means": means + shift * parts["share"], "quats": quats, "scales": scales}

    return activated(rest) | {"nodes": rows, "weights": weights, "share": share}, move
