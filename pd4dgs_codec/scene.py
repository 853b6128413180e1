"""The decoded scene: numpy arrays of documented shape, dtype, unit and axes, and the layers that are present.

The decoder returns a `Scene` and the encoder takes one. This module knows nothing of torch, bytes or files.

A *layer* is a transmitted increment, a *level* (0, 1, 2) is a render mode. Layer l carries the anchors that become
active at level l, so the arrays of prefix l are the first rows of the arrays of prefix l + 1.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from pd4dgs_codec.errors import RenderError

#: Three numbers.
Vector = Sequence[float] | np.ndarray
SCALING_DIM = 6
#: Width of the view direction, a unit vector that follows the feature in a network's input.
VIEW_DIM = 3

#: Limits of `Widths`: the feature may be twice as wide as in Scaffold-GS.
MAX_FEATURE, MAX_SLOTS = 64, 16
#: Step classes of anchors are 0 .. MAX_CLASS.
MAX_CLASS = 6

#: Plane (a, b) of a HexPlane has shape [C, reso[b], reso[a]]; axes x, y, z, t = 0, 1, 2, 3.
PLANES: tuple[tuple[str, int, int], ...] = (
    ("xy", 0, 1),
    ("xz", 0, 2),
    ("xt", 0, 3),
    ("yz", 1, 2),
    ("yt", 1, 3),
    ("zt", 2, 3),
)

#: A mask m is stored as a code 0..255 with m = code * MASK_STEP. An anchor is active at a level if its code is > 0.
MASK_STEP = np.float32(1.0 / 255.0)
MASK_THRESHOLD = 0.01
MASK_MIN_CODE = 3
#: A spread of code k, 0..255, is 1 + k / SPREAD_UNITS.
SPREAD_UNITS = 64
#: A Gaussian of less opacity is invisible and skipped.
MIN_OPACITY = 1.0 / 255.0

#: Attributes of an anchor, in coding order: fields of Scene and of Steps.
ATTRIBUTES = ("feature", "scaling_log", "offset")
#: The decoders of the scaffold, in the order of their numbers in the bitstream; output widths in `Widths.networks`.
SCAFFOLD_NETWORKS = ("opacity", "covariance", "color")


@dataclass(frozen=True)
class Widths:
    """Sizes from which other widths of anchors and networks follow. feature: length D of an anchor's feature. slots:
    number G of Gaussians per anchor. graded: whether each anchor has a step class. viewing: the scaffold's networks
    that take the view direction as well, in the order of SCAFFOLD_NETWORKS."""

    feature: int = 32
    slots: int = 10
    graded: bool = False
    viewing: tuple[str, ...] = SCAFFOLD_NETWORKS

    @property
    def attributes(self) -> dict[str, tuple[int, ...]]:
        """Shape of one anchor's value by attribute name, in coding order."""
        return dict(zip(ATTRIBUTES, ((self.feature,), (SCALING_DIM,), (self.slots, 3)), strict=True))

    @property
    def channels(self) -> int:
        """Number of scalars of an anchor: D + 6 + 3 G."""
        return self.feature + SCALING_DIM + 3 * self.slots

    @property
    def inputs(self) -> dict[str, int]:
        """Input width of each of the scaffold's networks: D, plus 3 if it takes the view direction."""
        return {name: self.feature + VIEW_DIM * (name in self.viewing) for name in SCAFFOLD_NETWORKS}

    @property
    def shapes_are_blind(self) -> bool:
        """Whether opacity and covariance do not depend on the view direction."""
        return not {"opacity", "covariance"} & {*self.viewing}

    @property
    def networks(self) -> dict[str, int]:
        """Output width of each of the scaffold's networks."""
        return dict(zip(SCAFFOLD_NETWORKS, (self.slots, 7 * self.slots, 3 * self.slots), strict=True))

    @property
    def heads(self) -> dict[str, int]:
        """Output width of each residual head of a deformation."""
        return {name: head.outputs(self) for name, head in HEADS.items()}

    @property
    def head_columns(self) -> dict[str, slice]:
        """The columns of an anchor's row to which each residual head adds: position, then the attributes in their
        order."""
        columns, end = {"length": slice(0, 3)}, 3
        for name, shape in self.attributes.items():
            columns[name] = slice(end, end := end + math.prod(shape))
        return {name: columns[head.unit] for name, head in HEADS.items()}


#: The widths of Scaffold-GS.
DEFAULT_WIDTHS = Widths()


@dataclass(frozen=True)
class Head:
    """A residual head. outputs: its output width as a function of Widths. unit: the quantity that its output is added
    to, "length" (the position, in units of `deformation_unit`) or the name of an attribute."""

    outputs: Callable[[Widths], int]
    unit: str


#: The residual heads that a deformation may have, in the order of their numbers 1, 2, .. in the bitstream. The trunk
#: has number 0.
HEADS: dict[str, Head] = {
    "position": Head(lambda widths: 3, "length"),
    "feature": Head(lambda widths: widths.feature, "feature"),
    "offset": Head(lambda widths: 3 * widths.slots, "offset"),
    "scaling": Head(lambda widths: SCALING_DIM, "scaling_log"),
}
#: Heads whose output is a length, in units of `deformation_unit`.
LENGTH_HEADS = tuple(name for name, head in HEADS.items() if head.unit == "length")


def deformation_unit(box: np.ndarray) -> np.float32:
    """Returns the unit of LENGTH_HEADS in scene units: a quarter of the longest side of the HexPlanes' box [2, 3].

    With outputs in scene units, rounding a weight would shift a small scene by whole pixels.
    """
    unit: np.float32 = np.float32(0.25) * (box[1] - box[0]).astype(np.float32).max()
    return unit


#: Name of a deformation's network whose outputs the heads read.
TRUNK = "trunk"

#: A network: per linear layer (weight float32 [out, in], bias float32 [out]); ReLU between layers, none at the end.
Network = tuple[tuple[np.ndarray, np.ndarray], ...]
#: Planes of a HexPlane: scale -> plane name -> array [C, reso[b], reso[a]].
Planes = tuple[dict[str, np.ndarray], ...]


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera, OpenCV axes (x right, y down, z forward); pixel centres at +0.5."""

    viewmat: np.ndarray  #: float32 [4, 4], world to camera, last row 0 0 0 1
    K: np.ndarray  #: float32 [3, 3], pixels
    width: int
    height: int

    @classmethod
    def look_at(cls, eye: Vector, target: Vector, up: Vector, *, width: int, height: int, fov: float = 50.0) -> Camera:
        """A camera at `eye` whose optical axis goes through `target`, both [3], world. up: a world direction, such as
        `SceneInfo.up`. fov: vertical angle of view, degrees. Raises RenderError if these determine no view."""
        ahead = np.subtract(target, eye, dtype=np.float64)
        right = np.cross(ahead, up)
        rows = np.stack([right, np.cross(ahead, right), ahead])
        lengths = np.linalg.norm(rows, axis=1, keepdims=True)
        if not (0 < fov < 180 and np.isfinite(rows).all() and lengths.all()):
            raise RenderError("eye, target, up and fov determine no view, expected up across the line of sight")
        focal = height / 2 / math.tan(math.radians(fov) / 2)
        K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], np.float32)
        viewmat = np.eye(4, dtype=np.float32)
        viewmat[:3, :3] = rows / lengths
        viewmat[:3, 3] = -(rows / lengths) @ np.asarray(eye, np.float64)
        return cls(viewmat, K, width, height)

    @property
    def eye(self) -> np.ndarray:
        """float32 [3]: the camera's centre, world."""
        rotation = np.asarray(self.viewmat, np.float32)[:3]
        centre: np.ndarray = -rotation[:, :3].T @ rotation[:, 3]
        return centre


@dataclass(frozen=True, eq=False)
class Gaussians:
    """K Gaussians with their activations and masks applied, float32."""

    means: np.ndarray  #: [K, 3] world, scene units
    quats: np.ndarray  #: [K, 4] rotations wxyz, unit
    scales: np.ndarray  #: [K, 3] standard deviations, scene units
    opacities: np.ndarray  #: [K] 0..1
    colors: np.ndarray  #: [K, 3] RGB as displayed, 0..1
    slots: np.ndarray  #: int64 [K]: Gaussian i is number slots[i] % G of the G of anchor slots[i] // G


Viewpoint = tuple[Camera, float]  #: a camera and a normalised time


@dataclass(frozen=True, eq=False)
class SceneInfo:
    """Values that every layer and a player need. All reals are exact binary32 values."""

    voxel_size: float  #: scene units; anchors are integer multiples of it
    box: np.ndarray  #: float32 [2, 3], lower and upper corner; the HexPlanes' normalisation box, scene units
    time_range: tuple[float, float]  #: seconds; normalised time 0 and 1
    background: tuple[float, float, float]  #: RGB as displayed, 0..1, behind every Gaussian of a complete file
    near: float
    far: float
    up: tuple[float, float, float]  #: world direction
    unit: float  #: metres per scene unit, 0 if unknown
    camera: Camera | None  #: one default camera


@dataclass(frozen=True, eq=False)
class Deformation:
    """The planes of a layer, and the residual MLP F(x, t) of its level, which replaces the MLP of the layer below.

    planes: float32, sampled bilinearly (align corners, border clamp), multiplied within a scale, concatenated over
    scales. networks: "trunk" and the heads that are present. key: the code of the key instant t* (see `instant`) if the
    residuals are F(x, t) - F(x, t*), so that the layer changes nothing at t*; None if they are F(x, t).
    """

    planes: Planes
    networks: dict[str, Network]
    key: int | None = None

    @property
    def channels(self) -> int:
        """Number of features that the planes give: the sum of channels over all scales."""
        return sum(len(scale["xy"]) for scale in self.planes)

    def residuals(self, points: np.ndarray, t: float, box: np.ndarray) -> dict[str, np.ndarray]:
        """Returns F(x, t), less F(x, t*) if there is a key instant, at points [n, 3] and normalised time t: float32
        [n, outputs] by `Head.unit`, lengths in scene units. box: see SceneInfo."""
        low, high = box.astype(np.float64)
        where, products = [*((points - low) / (high - low)).T, np.full(1, t)], []
        for scale in self.planes:
            sampled = [_bilinear(scale[name], where[a], where[b]) for name, a, b in PLANES]
            products.append(math.prod(sampled[1:], start=sampled[0]))
        hidden = np.maximum(_perceptron(self.networks[TRUNK], np.concatenate(products, axis=1)), 0)
        found = dict[str, np.ndarray]()
        for name in HEADS.keys() & self.networks.keys():
            unit = deformation_unit(box) if name in LENGTH_HEADS else np.float32(1)
            found[HEADS[name].unit] = found.get(HEADS[name].unit, 0) + unit * _perceptron(self.networks[name], hidden)
        if self.key is None:
            return found
        still = replace(self, key=None).residuals(points, instant(self.key), box)
        return {unit: moved - still[unit] for unit, moved in found.items()}


def _bilinear(plane: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Samples a plane float32 [C, H, W] at u (along W) and v (along H), [n] or [1], 0..1: float32 [n, C]."""
    (i, i2, fu), (j, j2, fv) = (_cells(at, side) for at, side in ((u, plane.shape[2]), (v, plane.shape[1])))
    table = plane.transpose(1, 2, 0)
    upper = table[j, i] * (1 - fu) + table[j, i2] * fu
    sampled: np.ndarray = upper * (1 - fv) + (table[j2, i] * (1 - fu) + table[j2, i2] * fu) * fv
    return sampled


def _cells(at: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the cells int64 [n] on both sides of `at` [n], 0..1, and the weight float32 [n, 1] of the second."""
    place = np.nan_to_num(at).clip(0, 1) * (side - 1)
    cell = place.astype(np.int64).clip(max=max(side - 2, 0))
    return cell, (cell + 1).clip(max=side - 1), (place - cell).astype(np.float32)[:, None]


def _perceptron(network: Network, x: np.ndarray) -> np.ndarray:
    """Evaluates a network for x float32 [n, inputs]: float32 [n, outputs]."""
    for i, (weight, bias) in enumerate(network):
        x = (np.maximum(x, 0) if i else x) @ weight.T + bias
    return x


def relative_area(logs: np.ndarray) -> np.ndarray:
    """Returns the largest area that each of n Gaussians may cover, float32 [n], relative to the largest of all. logs:
    float32 [n, 3], natural logarithms of their standard deviations."""
    area = np.sort(logs, axis=1)[:, 1:].sum(axis=1)
    return np.asarray(np.exp(area - area.max(initial=0)))


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Returns vectors [n, any] divided by their lengths."""
    unit: np.ndarray = vectors / np.linalg.norm(vectors, axis=1, keepdims=True).clip(min=1e-12)
    return unit


#: A file stores normalised times as multiples of 1 / INSTANTS.
INSTANTS = 65535


def instant(code: int) -> float:
    """Returns the normalised time, a binary32 value, of a code 0..INSTANTS."""
    return float(np.float32(code) / np.float32(INSTANTS))


def plane_sides(planes: dict[str, np.ndarray]) -> tuple[int, int, int, int]:
    """Returns the resolutions along x, y, z, t of one scale, from the shapes of its planes xy and zt."""
    return planes["xy"].shape[2], planes["xy"].shape[1], planes["zt"].shape[2], planes["zt"].shape[1]


def plane_shapes(channels: int, sides: Sequence[int]) -> dict[str, tuple[int, int, int]]:
    """Returns [C, H, W] of the planes of one scale by name, in the order of PLANES. sides: along x, y, z, t."""
    return {name: (channels, sides[b], sides[a]) for name, a, b in PLANES}


@dataclass(frozen=True)
class Steps:
    """Quantisation steps Q, each a positive normal binary32: x_hat = k * Q."""

    feature: float = 0.04
    scaling_log: float = 0.04
    offset: float = 0.05
    planes_global: float = 0.1
    planes_local: float = 0.12
    weights_scaffold: float = 0.004
    weights_global: float = 0.001
    weights_local: float = 0.001

    @property
    def attributes(self) -> dict[str, float]:
        """Steps by attribute name."""
        return {name: getattr(self, name) for name in ATTRIBUTES}

    def planes(self, layer: int) -> float:
        """Step of the planes of layer 1 or 2."""
        return {1: self.planes_global, 2: self.planes_local}[layer]

    def weights(self, layer: int) -> float:
        """Step of the networks of layer 0, 1 or 2."""
        return (self.weights_scaffold, self.weights_global, self.weights_local)[layer]

    def scaled(self, factor: float) -> Steps:
        """Returns every step times `factor`, rounded to binary32."""
        with np.errstate(over="ignore"):  # the encoder refuses infinite steps
            return Steps(**{k: float(np.float32(v * factor)) for k, v in self.__dict__.items()})


@dataclass(frozen=True, eq=False)
class Grading:
    """Step classes, which give each anchor its own quantisation steps of the attributes.

    classes: uint8 [N], 0 .. MAX_CLASS; an anchor of class c has 2^c times the steps. centre: float32 [channels], the
    value of symbol 0 in each channel for every class; in decoded scenes it is a multiple of the step.
    """

    classes: np.ndarray
    centre: np.ndarray


@dataclass(frozen=True, eq=False, kw_only=True)
class LayeredScene:
    """What scenes of all kinds have in common. A scene, or a prefix of one, consists of the layers `layers`.

    layers: ascending layer numbers present, starting with 0, e.g. (0,), (0, 1), (0, 2), (0, 1, 2).
    rows: rows[i] = number of anchors in the prefix that ends with layers[i].
    anchor_q: int32 [N, 3] voxel indices.
    mask: per present layer i, uint8 [rows[i]] codes (see MASK_STEP), non-decreasing from layer to layer.
    grading: None if all anchors have the same steps. fills: per present layer, the background while this layer is the
    highest one, RGB 0..255, and with four integers the `spread`; None for that of `info`. Without entries all are None.
    """

    info: SceneInfo
    layers: tuple[int, ...]
    rows: tuple[int, ...]
    anchor_q: np.ndarray
    mask: tuple[np.ndarray, ...]
    grading: Grading | None = None
    fills: tuple[tuple[int, ...] | None, ...] = ()

    @property
    def attributes(self) -> dict[str, np.ndarray]:
        """Arrays float32 [N, ...] by attribute name, in coding order."""
        raise NotImplementedError

    @property
    def row_steps(self) -> dict[str, float]:
        """Quantisation steps by attribute name."""
        raise NotImplementedError

    @property
    def all_steps(self) -> dict[str, float]:
        """Quantisation steps of attributes and of what layers share, by name."""
        return self.row_steps

    def scaled(self: S, factor: float) -> S:
        """Returns the scene with every step times `factor`, rounded to binary32."""
        raise NotImplementedError

    def of_anchors(self, rows: np.ndarray | slice) -> dict[str, Any]:
        """Returns the fields of the anchors `rows`, without masks, as arguments of `dataclasses.replace`."""
        grading = None if self.grading is None else replace(self.grading, classes=self.grading.classes[rows])
        return {"anchor_q": self.anchor_q[rows], "grading": grading}

    def of_layers(self) -> dict[str, Any]:
        """Returns the deformations without those of absent layers, as arguments of `dataclasses.replace`."""
        raise NotImplementedError

    def deformation(self, layer: int) -> Any:
        """Returns what a layer moves the level by, None without any."""
        raise NotImplementedError

    def _evaluated(self, t: float, eye: np.ndarray) -> Gaussians:
        """Returns the visible Gaussians of the highest level, seen from `eye` float32 [3]."""
        raise NotImplementedError

    def background(self, level: int = 2) -> tuple[float, float, float]:
        """Returns what is behind every Gaussian at a level, RGB as displayed, 0..1: the fill of an incomplete file, or
        the background of `info`."""
        fill = self._fill(level)
        red, green, blue = [code / 255 for code in fill[:3]] if fill else self.info.background
        return red, green, blue

    def spread(self, level: int = 2) -> float:
        """Returns the factor on the scales of all Gaussians at a level of an incomplete file, 1 for others: they stand
        for their absent neighbours (clause 13.6)."""
        fill = self._fill(level)
        return 1 + fill[3] / SPREAD_UNITS if len(fill) > 3 else 1.0

    def _fill(self, level: int) -> tuple[int, ...]:
        found = [fill for layer, fill in zip(self.layers, self.fills, strict=False) if layer <= level][-1:]
        return (found[0] or ()) if found else ()

    @property
    def utility(self) -> np.ndarray:
        """Estimates each anchor's utility without views, float32 [N]: its mask code in the highest layer, times what
        its kind knows."""
        return self.mask[-1].astype(np.float32)

    @property
    def level(self) -> int:
        """The highest level this scene can render."""
        return self.layers[-1]

    @property
    def still(self) -> bool:
        """Whether the scene is the same at all times."""
        return all(self.deformation(layer) is None for layer in self.layers[1:])

    @property
    def anchor(self) -> np.ndarray:
        """float32 [N, 3] positions of the anchors at rest, world, scene units, computed at each access."""
        return self.anchor_at(slice(None))

    def anchor_at(self, rows: np.ndarray | slice) -> np.ndarray:
        """Returns the positions float32 [n, 3] of the anchors `rows`, world, scene units."""
        voxel = np.float64(np.float32(self.info.voxel_size))
        with np.errstate(over="ignore"):  # a huge voxel size gives infinities, which the decoder refuses
            position: np.ndarray = (self.anchor_q[rows].astype(np.float64) * voxel).astype(np.float32)
        return position

    @property
    def active(self) -> np.ndarray:
        """int64 [n]: the anchors active at the highest level, ascending."""
        return np.flatnonzero(self.mask[-1] * MASK_STEP > MASK_THRESHOLD)

    def at(self: S, t: float, level: int | None) -> S:
        """Returns the prefix to draw at a level, None for the highest. Raises RenderError unless normalised time t is
        from 0 to 1 and the level 0, 1 or 2."""
        if not 0 <= t <= 1:
            low, high = self.info.time_range
            raise RenderError(f"time is {t:g}, expected 0 to 1, from {low:g} to {high:g} s of the scene")
        if level not in (None, 0, 1, 2):
            raise RenderError(f"level is {level}, expected 0, 1, 2 or None for the highest")
        return self if level is None else self.prefix(level)

    def gaussians(self, t: float, level: int | None = None, eye: Vector | None = None) -> Gaussians:
        """Returns the visible Gaussians at normalised time t in 0..1, evaluated by numpy alone.

        level: 0, 1 or 2, by default the highest; a level that the scene lacks equals the one below. eye: centre [3] of
        the camera, world, on which colours depend, and of a scaffold opacities and sizes as far as `widths.viewing`
        says; by default that of the file's camera, without one the middle of the box. Raises RenderError for other
        values.
        """
        scene, info = self.at(t, level), self.info
        if eye is None:
            eye = info.box.mean(axis=0) if info.camera is None else info.camera.eye
        centre = np.asarray(eye, np.float32)
        if centre.shape != (3,) or not np.isfinite(centre).all():
            raise RenderError(f"eye is {centre.tolist()}, expected 3 finite numbers")
        with np.errstate(all="ignore"):
            return scene._evaluated(t, centre)

    def full_masks(self) -> list[np.ndarray]:
        """Returns mask codes uint8 [N] per layer present; anchors that a layer's prefix lacks have code 0."""
        return [np.concatenate([codes, np.zeros(self.rows[-1] - codes.size, np.uint8)]) for codes in self.mask]

    def prefix(self: S, max_layer: int) -> S:
        """Returns the layers <= max_layer, or `self` if it has no others. Raises ValueError if max_layer < 0."""
        n = sum(layer <= max_layer for layer in self.layers)
        if n == len(self.layers):
            return self
        if n == 0:
            raise ValueError(f"max_layer must be >= 0, found {max_layer}")
        kept: dict[str, Any] = {name: getattr(self, name)[:n] for name in ("layers", "rows", "mask", "fills")}
        part = replace(self, **kept, **self.of_anchors(slice(self.rows[n - 1])))
        return replace(part, **part.of_layers())


S = TypeVar("S", bound=LayeredScene)


@dataclass(frozen=True, eq=False, kw_only=True)
class Scene(LayeredScene):
    """A scene of the kind scaffold: anchors, each of which spawns G Gaussians by networks.

    anchor_q: position = anchor_q * voxel_size, world, scene units.
    feature: float32 [N, D]. scaling_log: float32 [N, 6], natural log of scene units (0..2 spread of the offsets,
    3..5 base scale). offset: float32 [N, G, 3], in units of exp(scaling_log[:3]).
    networks: "opacity", "covariance", "color". global_deformation belongs to layer 1, local_deformation to layer 2;
    each may be None (left out). The trunk of layer 2 reads the planes of layer 1 as well, see `motion`.
    """

    steps: Steps
    feature: np.ndarray
    scaling_log: np.ndarray
    offset: np.ndarray
    networks: dict[str, Network]
    global_deformation: Deformation | None = None
    local_deformation: Deformation | None = None

    @property
    def widths(self) -> Widths:
        """Sizes read from the arrays; a network with more inputs than the feature takes the view direction."""
        inputs = {name: network[0][0].shape[1:] for name, network in self.networks.items() if network}
        viewing = tuple(name for name in SCAFFOLD_NETWORKS if inputs.get(name) != self.feature.shape[1:])
        return Widths(self.feature.shape[1], self.offset.shape[1], self.grading is not None, viewing)

    @property
    def attributes(self) -> dict[str, np.ndarray]:
        return {name: getattr(self, name) for name in ATTRIBUTES}

    def of_anchors(self, rows: np.ndarray | slice) -> dict[str, Any]:
        return super().of_anchors(rows) | {name: values[rows] for name, values in self.attributes.items()}

    def deformation(self, layer: int) -> Deformation | None:
        """Returns the deformation of layer 1 or 2, None if it is left out; None for layer 0, which has none."""
        return (None, self.global_deformation, self.local_deformation)[layer]

    def motion(self, layer: int) -> Deformation | None:
        """Returns the deformation of the prefix that ends with `layer`: the planes of all its layers, and the networks
        and key instant of its highest layer with a deformation; None if no layer has one."""
        found = [one for one in (self.global_deformation, self.local_deformation)[:layer] if one is not None]
        return replace(found[-1], planes=tuple(s for one in found for s in one.planes)) if found else None

    def _evaluated(self, t: float, eye: np.ndarray) -> Gaussians:
        slots, rows = self.widths.slots, self.active
        mask, values = self.mask[-1][rows] * MASK_STEP, {"length": self.anchor_at(rows)}
        for name, shape in self.widths.attributes.items():
            values[name] = self.attributes[name][rows].reshape(-1, math.prod(shape))
        if motion := self.motion(self.level):
            for unit, added in motion.residuals(values["length"], t, self.info.box).items():
                values[unit] = values[unit] + added
        position, extent = values["length"], np.exp(values["scaling_log"])
        inputs = np.concatenate([values["feature"], _unit(position - eye)], axis=1)
        networks = [self.networks[name] for name in SCAFFOLD_NETWORKS]
        outputs = [_perceptron(network, inputs[:, : network[0][0].shape[1]]) for network in networks]
        opacity = np.tanh(outputs[0])
        seen = opacity * mask[:, None] >= np.float32(MIN_OPACITY)
        owner, slot = np.nonzero(seen)
        shape, color = (values.reshape(*seen.shape, n)[seen] for values, n in zip(outputs[1:], (7, 3), strict=True))
        offset = values["offset"].reshape(*seen.shape, 3)[seen]
        return Gaussians(
            means=position[owner] + offset * extent[owner, :3],
            quats=_unit(shape[:, 3:]),
            scales=extent[owner, 3:] / (1 + np.exp(-shape[:, :3])) * mask[owner, None] * np.float32(self.spread()),
            opacities=opacity[seen] * mask[owner],
            colors=1 / (1 + np.exp(-color)),
            slots=rows[owner] * slots + slot,
        )

    @property
    def utility(self) -> np.ndarray:
        return np.asarray(super().utility * relative_area(self.scaling_log[:, 3:]))

    def with_deformation(self, layer: int, deformation: Deformation | None) -> Scene:
        """Returns the scene with this deformation in layer 1 or 2."""
        if layer == 1:
            return replace(self, global_deformation=deformation)
        return replace(self, local_deformation=deformation)

    def of_layers(self) -> dict[str, Any]:
        names = ("global_deformation", "local_deformation")
        return {name: getattr(self, name) if layer in self.layers else None for layer, name in enumerate(names, 1)}

    @property
    def row_steps(self) -> dict[str, float]:
        return self.steps.attributes

    @property
    def all_steps(self) -> dict[str, float]:
        return vars(self.steps)

    def scaled(self, factor: float) -> Scene:
        return replace(self, steps=self.steps.scaled(factor))
