"""Networks and HexPlanes of a decoded scene in the form that the kernels take."""

from __future__ import annotations

import numpy as np

from pd4dgs_codec import threads
from pd4dgs_codec.model import hexplane_kernels
from pd4dgs_codec.model.plane_layout import PlaneLayout
from pd4dgs_codec.playback import kernels
from pd4dgs_codec.render.simd import LANES
from pd4dgs_codec.scene import LENGTH_HEADS, PLANES, TRUNK, Deformation, Network, deformation_unit, plane_sides


class Layers:
    """Linear layers with ReLU between them, and after the last if `relu_last`."""

    def __init__(self, layers: Network, relu_last: bool = False):
        self.outputs = len(layers[-1][1])
        self._relu_last = relu_last
        widths, parts = [layers[0][0].shape[1]], []
        for weight, bias in layers:
            inputs, outputs = widths[-1], -(-len(bias) // kernels.WIDTH) * kernels.WIDTH
            table = np.zeros((inputs + 1, outputs), np.float32)
            table[: weight.shape[1], : len(bias)] = weight.T
            table[-1, : len(bias)] = bias
            widths.append(outputs)
            parts.append(table.ravel())
        self._widths, self._weights = np.array(widths), np.concatenate(parts)

    def __call__(self, x: np.ndarray, outputs: int | None = None) -> np.ndarray:
        """float32 [n, outputs] of x float32 [n, inputs]; more outputs than there are come out as 0."""
        out = np.empty((len(x), self.outputs if outputs is None else outputs), np.float32)
        threads.limit_numba()
        kernels.forward(out, np.ascontiguousarray(x), self._widths, self._weights, self._relu_last)
        return out


class Field:
    """A deformation: residuals of all heads side by side at points and a time."""

    def __init__(self, deformation: Deformation, box: np.ndarray):
        self._box = np.ascontiguousarray(box, np.float32)
        self._layout = PlaneLayout.build([plane_sides(scale) for scale in deformation.planes])
        channels = deformation.planes[0]["xy"].shape[0]
        self._channels = -(-channels // LANES) * LANES  # the padding is 0, and so are its products
        self._grid = np.zeros((self._layout.n_cells, self._channels), np.float32)
        for start, scale in zip(self._layout.start, deformation.planes, strict=True):
            for first, (name, _, _) in zip(start, PLANES, strict=True):
                cells = scale[name].reshape(channels, -1).T
                self._grid[first : first + len(cells), :channels] = cells
        self._rows: tuple[float, np.ndarray] | None = None
        heads = {name: network for name, network in deformation.networks.items() if name != TRUNK}
        self.widths = {name: len(network[-1][1]) for name, network in heads.items()}
        trunk = _with_padded_inputs(deformation.networks[TRUNK], channels, self._channels)
        unit = deformation_unit(box)
        scaled = {n: _scaled(net, unit if n in LENGTH_HEADS else np.float32(1)) for n, net in heads.items()}
        self._together: Layers | None = None
        if heads and all(len(network) == 1 for network in heads.values()):  # one product for all heads
            layers = [network[0] for network in scaled.values()]
            last = np.concatenate([weight for weight, _ in layers]), np.concatenate([bias for _, bias in layers])
            self._together = Layers((*trunk, last))
        self._trunk, self._heads = Layers(trunk, relu_last=True), {n: Layers(net) for n, net in scaled.items()}

    def __call__(self, points: np.ndarray, t: float) -> np.ndarray:
        """float32 [n, sum of widths] at points float32 [n, 3] and normalised time t; lengths in scene units."""
        layout = self._layout
        tables = layout.reso, layout.start, layout.rows
        threads.limit_numba()
        if self._rows is None or self._rows[0] != t:  # what depends on time alone is kept
            rows = np.empty((layout.n_rows, self._channels), np.float32)
            hexplane_kernels.collapse(rows, self._grid, *tables, t, 0.0)
            self._rows = t, rows
        features = np.empty((len(points), len(layout.reso) * self._channels), np.float32)
        spatial = self._grid[: layout.n_spatial]
        hexplane_kernels.sample(features, spatial, self._rows[1], *tables, np.ascontiguousarray(points), self._box)
        if self._together is not None:
            return self._together(features)
        hidden = self._trunk(features)
        return np.concatenate([head(hidden) for head in self._heads.values()], axis=1)

    def split(self, residuals: np.ndarray) -> dict[str, np.ndarray]:
        """head -> its columns of what a call answers."""
        ends = np.cumsum(list(self.widths.values()))[:-1]
        return dict(zip(self.widths, np.split(residuals, ends, axis=1), strict=True))


def hidden_layers(network: Network) -> Layers:
    """All but the last layer, with the ReLU behind them."""
    return Layers(network[:-1], relu_last=True)


def _with_padded_inputs(network: Network, channels: int, padded: int) -> Network:
    """The network for features of `padded` channels per scale, of which the first `channels` count."""
    (weight, bias), *rest = network
    scales = weight.shape[1] // channels
    wide = np.zeros((len(weight), scales, padded), np.float32)
    wide[:, :, :channels] = weight.reshape(len(weight), scales, channels)
    return ((wide.reshape(len(weight), -1), bias), *rest)


def _scaled(network: Network, unit: np.float32) -> Network:
    """The network with its outputs times `unit`."""
    *rest, (weight, bias) = network
    return (*rest, (weight * unit, bias * unit))
