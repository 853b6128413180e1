"""Evaluates a decoded deformation without torch. Another kind of deformation changes only `Field` here."""

import numpy as np

from pd4dgs_codec.draw import hexplane
from pd4dgs_codec.draw.hexplane import PlaneLayout
from pd4dgs_codec.draw.layers import Layers
from pd4dgs_codec.draw.simd import LANES
from pd4dgs_codec.scene import LENGTH_HEADS, PLANES, TRUNK, Deformation, Network, deformation_unit, instant, plane_sides


class Field:
    """Adds a deformation's residuals to rows of anchors, whose columns are those of all heads of the registry."""

    def __init__(self, deformation: Deformation, box: np.ndarray, columns: dict[str, slice]):
        """box: float32 [2, 3], see SceneInfo. columns: see `Widths.head_columns`."""
        self._box = np.ascontiguousarray(box, np.float32)
        self._layout = PlaneLayout.build([plane_sides(scale) for scale in deformation.planes])
        channels = deformation.planes[0]["xy"].shape[0]
        self._channels = -(-channels // LANES) * LANES  # padded channels and their products are 0
        self._grid = np.zeros((self._layout.n_cells, self._channels), np.float32)
        for views, scale in zip(self._layout.views(self._grid), deformation.planes, strict=True):
            for name, _, _ in PLANES:
                views[name][:, :, :channels] = scale[name].transpose(1, 2, 0)
        self._rows: tuple[float, np.ndarray] | None = None
        trunk = _with_padded_inputs(deformation.networks[TRUNK], channels, self._channels)
        self._key = deformation.key
        unit, networks = deformation_unit(box), deformation.networks
        heads = {
            n: _scaled(networks[n], unit if n in LENGTH_HEADS else np.float32(1)) for n in columns if n in networks
        }
        self._trunk: Layers | None = None
        if all(len(network) == 1 for network in heads.values()):  # one product for all heads
            self._heads = [(slice(None), Layers((*trunk, _joined(heads, columns, len(trunk[-1][1])))))]
        else:
            self._trunk = Layers(trunk, relu_last=True)
            self._heads = [(columns[n], Layers(network)) for n, network in heads.items()]

    def rest(self, values: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Returns values - F(x, t*) if there is a key instant t*, else `values`: the rows to which `move` adds F(x, t)
        at any time t. Arguments as for `move`."""
        if self._key is None:
            return values
        still = np.zeros_like(values)
        self.move(still, points, instant(self._key))
        moved: np.ndarray = values - still
        return moved

    def move(self, values: np.ndarray, points: np.ndarray, t: float) -> None:
        """Adds F(x, t) at points x float32 [n, 3] and normalised time t to values float32 [n, columns],
        C-contiguous; lengths in scene units."""
        layout = self._layout
        tables = layout.reso, layout.start, layout.rows
        if self._rows is None or self._rows[0] != t:
            rows = np.empty((layout.n_rows, self._channels), np.float32)
            hexplane.collapse(rows, self._grid, *tables, t, 0.0)
            self._rows = t, rows
        features = np.empty((len(points), len(layout.reso) * self._channels), np.float32)
        spatial = self._grid[: layout.n_spatial]
        hexplane.sample(features, spatial, self._rows[1], *tables, np.ascontiguousarray(points), self._box)
        if self._trunk is None:
            ((_, together),) = self._heads
            together.add(values, features)
            return
        hidden = self._trunk(features)
        for own, head in self._heads:
            values[:, own] += head(hidden)


def _with_padded_inputs(network: Network, channels: int, padded: int) -> Network:
    """Returns the network for features that are padded from `channels` to `padded` channels per scale."""
    (weight, bias), *rest = network
    scales = weight.shape[1] // channels
    wide = np.zeros((len(weight), scales, padded), np.float32)
    wide[:, :, :channels] = weight.reshape(len(weight), scales, channels)
    return ((wide.reshape(len(weight), -1), bias), *rest)


def _joined(heads: dict[str, Network], columns: dict[str, slice], inputs: int) -> tuple[np.ndarray, np.ndarray]:
    """Joins heads of one layer each into one layer whose outputs are all columns; those without a head are 0."""
    outputs = max(own.stop for own in columns.values())
    weight, bias = np.zeros((outputs, inputs), np.float32), np.zeros(outputs, np.float32)
    for name, ((of_head, shift),) in heads.items():
        weight[columns[name]] += of_head
        bias[columns[name]] += shift
    return weight, bias


def _scaled(network: Network, unit: np.float32) -> Network:
    """Returns the network with its outputs multiplied by `unit`."""
    *rest, (weight, bias) = network
    return (*rest, (weight * unit, bias * unit))


def still(head: str, width: int) -> Deformation:
    """Returns the smallest deformation that the kernels take, with one head of `width` residuals, all 0."""
    planes = {name: np.ones((LANES, 2, 2), np.float32) for name, _, _ in PLANES}
    return Deformation((planes,), {TRUNK: constant_network(LANES, LANES), head: constant_network(LANES, width)})


def constant_network(inputs: int, outputs: int, value: float = 0.0) -> Network:
    """Returns a network of one layer whose outputs are all `value`."""
    return ((np.zeros((outputs, inputs), np.float32), np.full(outputs, value, np.float32)),)
