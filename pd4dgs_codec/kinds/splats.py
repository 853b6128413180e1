"""The scene kind "splats": every anchor is a Gaussian under the laws of 3D Gaussian splatting (clause 13.7).

Colours are as in its reference implementation (Kerbl et al. 2023), in PLY, SPZ and KHR_gaussian_splatting: real
harmonics Y_j with their signs, and max(0, 0.5 + sum c_j Y_j(d)), d the unit vector from the eye to the mean.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from pd4dgs_codec.errors import Malformed
from pd4dgs_codec.scene import MASK_STEP, MIN_OPACITY, Gaussians, Grading, LayeredScene, SceneInfo, relative_area
from pd4dgs_codec.tensors.quantise import RowTable, dequantise
from pd4dgs_codec.tensors.tables import Kind, Tables, Tensors

NUMBER, NAME = 1, "splats"

#: Tensors of rows in the order of their numbers, with their channels, and those that a scene may lack.
TENSORS = {"offset": (3,), "color": (3,), "opacity": (1,), "scale": (3,), "rotation": (3,), "harmonics": (9, 24, 45),
           "window": (3,)}  # fmt: skip
OPTIONAL = ("harmonics", "window")
#: What deformations add to, in the order of the heads of tracks, with its components: see `Moving.at`.
HEADS = {"position": 3, "rotation": 4, "scale": 3, "opacity": 1, "color": 3}

MAX_DEGREE = 3
#: Y_0, a constant: the factor between a colour and its first coefficient.
SH_C0 = 0.28209479177387814

# -- Gaussians at an instant -------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Splats:
    """N Gaussians at an instant, float32."""

    means: np.ndarray  #: [N, 3] world, scene units
    quats: np.ndarray  #: [N, 4] wxyz, unit
    scales: np.ndarray  #: [N, 3] standard deviations, scene units
    opacities: np.ndarray  #: [N] 0..1
    sh: np.ndarray  #: [N, (degree + 1)^2, 3] coefficients of red, green and blue

    @property
    def degree(self) -> int:
        """Degree of the harmonics, 0 to 3."""
        return int(np.sqrt(self.sh.shape[1])) - 1

    def colors(self, eye: np.ndarray) -> np.ndarray:
        """Returns the colours float32 [N, 3] >= 0 seen from `eye` [3], world."""
        if self.degree == 0:
            return np.asarray(np.maximum(self.sh[:, 0] * np.float32(SH_C0) + np.float32(0.5), 0))
        basis = harmonics(unit(np.asfortranarray(self.means - eye.astype(np.float32))), self.degree)
        colors = np.einsum("jn,cjn->cn", basis.T, self.sh.T)  # a tenth of the time if `sh` lies in memory by columns
        return np.ascontiguousarray(np.maximum(colors + np.float32(0.5), 0).T)

    def seen_from(self, eye: np.ndarray, slots: np.ndarray) -> Gaussians:
        """Returns the Gaussians with their colours seen from `eye` [3], world."""
        return Gaussians(self.means, self.quats, self.scales, self.opacities, self.colors(eye), slots)

    @property
    def base_colors(self) -> np.ndarray:
        """float32 [N, 3] 0..1: the mean colours over all directions."""
        return np.asarray(np.clip(self.sh[:, 0] * np.float32(SH_C0) + np.float32(0.5), 0, 1))

    @property
    def rest(self) -> np.ndarray:
        """float32 [N, 3 ((degree + 1)^2 - 1)]: coefficients from degree 1 on, channel by channel as in files."""
        return np.asarray(self.sh[:, 1:].transpose(0, 2, 1).reshape(len(self.sh), 3 * (self.sh.shape[1] - 1)))

    def taken(self, rows: np.ndarray) -> Splats:
        """Returns the Gaussians `rows`, indices or a mask."""
        rows = np.flatnonzero(rows) if rows.dtype == bool else rows
        taken = {name: part[rows] for name, part in vars(self).items() if name != "sh"}
        return Splats(**taken, sh=np.take(self.sh.T, rows, axis=2).T)

    def scaled(self, factor: float) -> Splats:
        """Returns the Gaussians with all lengths multiplied by `factor`."""
        return replace(self, means=self.means * np.float32(factor), scales=self.scales * np.float32(factor))


def unit(vectors: np.ndarray) -> np.ndarray:
    """Divides vectors [..., d] by their length; zero vectors stay zero."""
    length = np.sqrt(np.einsum("...d,...d->...", vectors, vectors))[..., None]
    return np.asarray(vectors / np.maximum(length, np.finfo(vectors.dtype).tiny))


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The Hamilton products of quaternions [..., 4] wxyz."""
    (w, x, y, z), (i, j, k, l) = np.moveaxis(a, -1, 0), np.moveaxis(b, -1, 0)
    parts = (w * i - x * j - y * k - z * l, w * j + x * i + y * l - z * k, w * k - x * l + y * i + z * j,
             w * l + x * k - y * j + z * i)  # fmt: skip
    return np.moveaxis(np.stack(parts), 0, -1)


def harmonics(directions: np.ndarray, degree: int) -> np.ndarray:
    """Evaluates (degree + 1)^2 real harmonics [..., j], degree 0 to 3, at unit vectors [..., 3] in their dtype."""
    x, y, z = np.moveaxis(directions, -1, 0)
    rows = [np.full_like(x, SH_C0)]
    if degree >= 1:
        c = 0.4886025119029199
        rows += [-c * y, c * z, -c * x]
    if degree >= 2:
        c = 1.0925484305920792
        xx, yy, zz = x * x, y * y, z * z
        rows += [c * x * y, -c * y * z, 0.31539156525252005 * (2 * zz - xx - yy), -c * x * z, c / 2 * (xx - yy)]
    if degree >= 3:
        rows += [
            -0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy),
            0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.4570457994644658 * x * (4 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ]
    return np.moveaxis(np.stack(rows).astype(directions.dtype, copy=False), 0, -1)


#: Red, green and blue -> Y, Co and Cg.
YCOCG = np.array([[0.25, 0.5, 0.25], [0.5, 0.0, -0.5], [-0.25, 0.5, -0.25]])


def rgb(channels: np.ndarray) -> np.ndarray:
    """The inverse of YCOCG: both [..., 3, n]."""
    y, co, cg = np.moveaxis(channels, -2, 0)
    return np.stack([y - cg + co, y + cg, y - cg - co], axis=-2)


def splats_of(tensors: Mapping[str, np.ndarray]) -> Splats:
    """Returns the Gaussians of tensors [n, C] by the names of TENSORS, with "position" instead of "offset" and no
    window."""
    xyz, color = tensors["rotation"], tensors["color"]
    w = np.sqrt(np.maximum(1 - np.square(xyz).sum(axis=1, keepdims=True), 0))
    channels = np.concatenate([color.T, tensors["harmonics"].T]) if "harmonics" in tensors else color.T
    sh = rgb(channels.reshape(len(channels) // 3, 3, len(xyz)))
    return Splats(
        means=np.ascontiguousarray(tensors["position"], np.float32),
        quats=_rotations(np.concatenate([w, xyz], axis=1)).astype(np.float32),
        scales=np.exp(tensors["scale"]).astype(np.float32),
        opacities=sigmoid(tensors["opacity"][:, 0]).astype(np.float32),
        sh=np.moveaxis(sh.astype(np.float32), -1, 0),
    )


def _rotations(p: np.ndarray) -> np.ndarray:
    """Returns quaternions [n, 4] divided by their length, the identity instead of 0."""
    length = np.sqrt(np.einsum("nc,nc->n", p, p))
    if length.all():
        return np.asarray(p / length[:, None])
    found = p / np.where(length > 0, length, 1)[:, None]
    found[length == 0, 0] = 1
    return np.asarray(found)


@np.errstate(all="ignore")
def visible(windows: np.ndarray, t: float) -> np.ndarray:
    """Returns float32 [n]: the factors on opacities at normalised time t of windows float32 [n, 3], whose columns are
    centre, half width and softness."""
    centre, half, softness = windows.T
    excess = np.maximum(np.abs(np.float32(t) - centre) - half, 0)
    return np.asarray(np.where(excess > 0, np.exp(-0.5 * np.square(excess / softness)), np.float32(1)))


def sigmoid(x: np.ndarray) -> np.ndarray:
    """Returns 1 / (1 + exp(-x)) of logits of any shape."""
    with np.errstate(over="ignore"):
        return np.asarray(1 / (1 + np.exp(-x)))


# -- the scene ---------------------------------------------------------------------------------------------------------


class Motion(Protocol):
    """A deformation of splats, of any kind, whose arrays have the scene's first rows or all of them."""

    @property
    def heads(self) -> Collection[str]:
        """Names in HEADS: what it adds to."""

    def residuals(self, t: float) -> dict[str, np.ndarray]:
        """Returns what it adds at normalised time t in 0..1, once `prepared`: float32 [rows, components] by head."""

    def prepared(self, positions: np.ndarray, box: np.ndarray) -> Motion:
        """Returns it for many times. positions: float32 [rows, 3], at rest, scene units. box: see SceneInfo."""

    def of_rows(self, rows: np.ndarray | slice) -> Motion:
        """Returns that of a scene's rows `rows`, an int64 array or the first ones."""

    def scaled(self, factor: float) -> Motion:
        """Returns it with every step times `factor`, rounded to binary32."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SplatScene(LayeredScene):
    """A scene of the kind splats. tensors: float32 [N, C] by the names of TENSORS, in their order. steps: of the
    tensors. tracks: the deformations, by layer; those of layers up to a level add up."""

    steps: dict[str, float]
    tensors: dict[str, np.ndarray]
    tracks: dict[int, Any]

    @property
    def attributes(self) -> dict[str, np.ndarray]:
        return self.tensors

    @property
    def row_steps(self) -> dict[str, float]:
        return self.steps

    def anchor_at(self, rows: np.ndarray | slice) -> np.ndarray:
        place = self.anchor_q[rows] + self.tensors["offset"][rows].astype(np.float64)
        place *= np.float32(self.info.voxel_size)
        return place.astype(np.float32)

    @property
    def still(self) -> bool:
        return super().still and "window" not in self.tensors

    @property
    def utility(self) -> np.ndarray:
        opacity = super().utility * sigmoid(self.tensors["opacity"][:, 0])
        return np.asarray(opacity * relative_area(self.tensors["scale"]))

    def deformation(self, layer: int) -> Any:
        return self.tracks.get(layer)

    def of_anchors(self, rows: np.ndarray | slice) -> dict[str, Any]:
        tensors = {name: values[rows] for name, values in self.tensors.items()}
        tracks = {layer: own.of_rows(rows) for layer, own in self.tracks.items()}
        return super().of_anchors(rows) | {"tensors": tensors, "tracks": tracks}

    def of_layers(self) -> dict[str, Any]:
        return {"tracks": {layer: own for layer, own in self.tracks.items() if layer in self.layers}}

    def scaled(self, factor: float) -> SplatScene:
        steps = {name: float(np.float32(step * factor)) for name, step in self.steps.items()}
        return replace(self, steps=steps, tracks={layer: own.scaled(factor) for layer, own in self.tracks.items()})

    def splats(self, t: float, level: int | None = None) -> tuple[Splats, np.ndarray]:
        """Returns (the visible Gaussians at normalised time t in 0..1, their rows int64 [K]). Arguments and errors as
        of `gaussians`."""
        return Moving(self.at(t, level)).at(t)

    def _evaluated(self, t: float, eye: np.ndarray) -> Gaussians:
        splats, rows = Moving(self).at(t)
        return splats.seen_from(eye, rows)


class Moving:
    """The active Gaussians of a scene's highest level, prepared for any time."""

    @np.errstate(all="ignore")
    def __init__(self, scene: SplatScene):
        rows = scene.active
        mask, tensors = scene.mask[-1][rows] * MASK_STEP, {name: x[rows] for name, x in scene.tensors.items()}
        self._rest = splats_of(tensors | {"position": scene.anchor_at(rows)})
        heads = {name for own in scene.tracks.values() for name in own.heads}
        if "opacity" not in heads:  # those that no time makes visible
            seen = self._rest.opacities * mask >= np.float32(MIN_OPACITY)
            rows, mask, self._rest = rows[seen], mask[seen], self._rest.taken(seen)
            tensors = {name: x[seen] for name, x in tensors.items()}
        self._rows, self._mask, self._fades = rows, mask, "opacity" in heads or "window" in tensors
        self._sizes = (mask * np.float32(scene.spread()))[:, None]
        self._logits, self._logs, self._window = tensors["opacity"][:, 0], tensors["scale"], None
        if "window" in tensors:
            self._window = np.array(tensors["window"], order="F")
            self._window[:, 2] = np.exp(self._window[:, 2])
        if "scale" not in heads:
            self._rest = replace(self._rest, scales=self._rest.scales * self._sizes)
        columns = {name: np.asfortranarray(getattr(self._rest, name)) for name in ("means", "quats") if heads}
        self._rest = replace(self._rest, **columns)  # in the order in memory of what is added to them
        own = [motion.of_rows(rows) for motion in scene.tracks.values()]
        self._motions = [motion.prepared(self._rest.means, scene.info.box) for motion in own]

    @np.errstate(all="ignore")
    def at(self, t: float) -> tuple[Splats, np.ndarray]:
        """Returns (the visible Gaussians at normalised time t in 0..1, their rows int64 [K])."""
        rest, mask, added = self._rest, self._mask, self._added(t)
        opacities = rest.opacities if "opacity" not in added else sigmoid(self._logits + added["opacity"][:, 0])
        if self._window is not None:
            opacities = opacities * visible(self._window, t)
        changed: dict[str, np.ndarray] = {"opacities": opacities * mask}
        if "position" in added:
            changed["means"] = rest.means + added["position"]
        if "rotation" in added:
            turn = added["rotation"]
            turn[:, 0] += 1
            changed["quats"] = _rotations(product(turn, rest.quats))
        if "scale" in added:
            changed["scales"] = np.exp(self._logs + added["scale"]) * self._sizes
        if "color" in added:
            changed["sh"] = rest.sh.copy(order="K")
            changed["sh"][:, 0] += rgb(added["color"].T).T
        splats = replace(rest, **changed)
        if not self._fades or (seen := splats.opacities >= np.float32(MIN_OPACITY)).all():
            return splats, self._rows
        return splats.taken(seen), self._rows[seen]

    def _added(self, t: float) -> dict[str, np.ndarray]:
        """Returns the sum of the residuals of all layers at normalised time t: float32 [n, components] by head."""
        found = dict[str, np.ndarray]()
        for motion in self._motions:
            for name, added in motion.residuals(t).items():
                if name not in found and len(added) == len(self._rows):
                    found[name] = added
                    continue
                found.setdefault(name, np.zeros((len(self._rows), HEADS[name]), np.float32))[: len(added)] += added
        return found


def scene(
    info: SceneInfo,
    cells: np.ndarray,
    tensors: Mapping[str, np.ndarray],
    steps: Mapping[str, float],
    *,
    classes: np.ndarray | None = None,
    centres: Mapping[str, np.ndarray] | None = None,
    tracks: Mapping[int, Motion] | None = None,
    layer: np.ndarray | None = None,
) -> SplatScene:
    """Returns a scene to be encoded, of n Gaussians in any order, all of them active from their layer on.

    cells: int32 [n, 3], distinct voxels. tensors: float32 [n, C], and steps, by the names of TENSORS. classes: uint8
    [n] step classes; with them centres int32 [C] by name, in steps: values become (centre + k 2^class) step. tracks:
    by layer 1, 2. layer: [n], the layer 0, 1 or 2 with which a Gaussian comes; default 0.
    """
    names = [name for name in TENSORS if name in tensors]
    own = np.zeros(len(cells), np.int64) if layer is None else np.asarray(layer)
    tracks = dict(tracks or {})
    present = tuple(i for i in range(3) if i == 0 or i in tracks or (own == i).any())
    grading = None
    if classes is not None:
        centre = [dequantise(np.asarray((centres or {})[name], np.int32), float(steps[name])) for name in names]
        grading = Grading(classes, np.concatenate(centre))
    return SplatScene(
        info=info,
        layers=present,
        rows=(len(cells),) * len(present),
        anchor_q=cells,
        mask=tuple(np.where(own <= i, 255, 0).astype(np.uint8) for i in present),
        grading=grading,
        steps={name: float(np.float32(steps[name])) for name in names},
        tensors={name: tensors[name] for name in names},
        tracks=tracks,
    )


# -- tensors of a file -------------------------------------------------------------------------------------------------


SCENE = SplatScene


def kind_of(scene: SplatScene) -> Kind:
    """Returns the integers of the kind."""
    return (NUMBER,)


def widths_of(kind: Kind, table: RowTable) -> None:
    """Raises Malformed if a header breaks the rules of the kind. No other widths follow from those of the rows."""
    if len(kind) != 1:
        raise Malformed(f"header: kind {list(kind)}, expected [{NUMBER}]")
    found, expected = {tensor.id: tensor.channels for tensor in table.tensors}, dict(enumerate(TENSORS.items()))
    lacking = [i for i, (name, _) in expected.items() if i not in found and name not in OPTIONAL]
    odd = [i for i, channels in found.items() if i not in expected or channels not in expected[i][1]]
    if lacking or odd:
        known = ", ".join(f"{i} of {' or '.join(map(str, sizes))}" for i, (_, sizes) in expected.items())
        raise Malformed(f"header: rows {list(found.items())} (id, channels), expected {known}; 5 and 6 if wanted")


def check(tables: Tables, widths: None) -> None:
    """Raises Malformed if layer 0 breaks the rules of the kind."""
    if tables != Tables():
        raise Malformed("layer 0: grids, chains, layer rows or a deformation, expected none")


def json_of_layer(tables: Tables, layer: int) -> dict[str, Any]:
    """Returns steps and heads of a layer without a deformation, none."""
    return {"steps": {}, "heads": {}}


def json(kind: Kind, table: RowTable) -> dict[str, Any]:
    """Returns the degree of the harmonics, whether there are windows, and the steps."""
    steps = {list(TENSORS)[tensor.id]: tensor.step for tensor in table.tensors}
    degree = next((TENSORS["harmonics"].index(t.channels) + 1 for t in table.tensors if t.id == 5), 0)
    return {"degree": degree, "windows": "window" in steps, "steps": steps}


def scene_of(
    kind: Kind,
    table: RowTable,
    common: Mapping[str, Any],
    rows: Sequence[np.ndarray],
    tensors: Mapping[int, Tensors],
    tracks: dict[int, Motion],
) -> SplatScene:
    """Returns a scene. common: arguments of `LayeredScene`. rows: float32 [N, C] of each tensor. tracks: by layer."""
    names = list(TENSORS)
    return SplatScene(
        **common,
        steps={names[tensor.id]: tensor.step for tensor in table.tensors},
        tensors={names[tensor.id]: x for tensor, x in zip(table.tensors, rows, strict=True)},
        tracks=tracks,
    )
