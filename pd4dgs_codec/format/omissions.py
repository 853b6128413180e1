"""Encoder: omissions that change no picture, found and made on the symbols of a scene.

Dead units of networks, features and plane channels that nothing reads, and plane cells that no anchor ever touches. No
array changes its shape, and sums lose only zeros: the same arithmetic gives the same bits.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from pd4dgs_codec.entropy.bits import entropy_bits
from pd4dgs_codec.format.deformation import arrays_of, mapped
from pd4dgs_codec.format.kinds import LAYER_KINDS, LayerKind
from pd4dgs_codec.format.left_out import LeftOut
from pd4dgs_codec.format.planes import choose_predictor, fill_plane
from pd4dgs_codec.format.quantise import Grid, dequantise
from pd4dgs_codec.format.symbols import LayerSymbols, SceneSymbols
from pd4dgs_codec.scene import PLANES, TRUNK, Deformation, Network, Scene, plane_sides

#: Nothing is left out of networks whose values may exceed this: 0 times infinity is not 0. Binary32 ends at 3.4e38.
LARGEST = 1e30
#: Cells by which a position may be off in another renderer, which rounds its coordinates otherwise.
CELL_SLACK = 0.02


def leave_out_unseen(symbols: SceneSymbols) -> tuple[SceneSymbols, list[LeftOut]]:
    """(`symbols` with 0 or values of little cost in parts that no picture depends on, these parts).

    symbols: of a planned scene, all rows active at its highest level.
    """
    omissions = _Omissions(symbols)
    while omissions.within_range() and omissions.simplify_networks():
        pass
    omissions.free_cells()
    return omissions.symbols(), omissions.found


def with_omissions(scene: Scene, before: SceneSymbols, after: SceneSymbols) -> Scene:
    """`scene` with dequantised values wherever its symbols `before` were replaced by those `after`."""
    feature, first = scene.feature, 0
    for old, new in zip(before.layers, after.layers, strict=True):
        rows = slice(first, first + len(old.anchor_q))
        if new.attributes is not old.attributes:
            feature = feature.copy() if feature is scene.feature else feature
            same = (old.attributes == new.attributes)[: feature.shape[1]].T
            values = after.grid.dequantise(new.attributes, new.classes)["feature"]
            feature[rows] = np.where(same, feature[rows], values)
        first = rows.stop
        if new.tensors is not old.tensors:
            layer = old.kind.layer
            scene = scene.with_tensors(layer, _edited(scene.tensors(layer), old, new))
    return replace(scene, feature=feature)


def _edited(given: Deformation, old: LayerSymbols, new: LayerSymbols) -> Deformation:
    both = zip(arrays_of(old.tensors, old.kind), arrays_of(new.tensors, new.kind), strict=True)

    def edited(step: str, _: str, x: np.ndarray) -> np.ndarray:
        (_, before), (_, after) = next(both)
        values: np.ndarray = np.where(before == after, x, dequantise(after, new.steps[step]))
        return values

    return mapped(given, new.kind, edited)


class _Omissions:
    """The symbols of a scene, edited in place of copies. found: what was left out so far."""

    def __init__(self, given: SceneSymbols):
        self.given, self.found = given, list[LeftOut]()
        self.kinds = {layer.kind.layer: layer.kind for layer in given.layers if layer.tensors.networks}
        self.tensors = {layer.kind.layer: layer.tensors for layer in given.layers if layer.tensors.networks}
        self.steps = vars(given.steps)
        self.unread = np.zeros(given.grid.widths.feature, bool)  # feature channels that were set to their centre

    def symbols(self) -> SceneSymbols:
        """The symbols with all edits."""
        layers = []
        for layer in self.given.layers:
            changes: dict[str, Any] = {}
            if self.tensors.get(layer.kind.layer, layer.tensors) is not layer.tensors:
                changes["tensors"] = self.tensors[layer.kind.layer]
            if self.unread.any():
                changes["attributes"] = layer.attributes.copy()
                changes["attributes"][: len(self.unread)][self.unread] = 0
            layers.append(replace(layer, **changes) if changes else layer)
        return replace(self.given, layers=layers)

    # -- networks ----------------------------------------------------------------------------------------------------

    def within_range(self) -> bool:
        """Whether no value in a network can come near overflow, for any input."""
        moved: dict[str, np.ndarray] = {}
        sizes: list[np.ndarray] = []
        for layer in (1, 2):
            if layer in self.tensors:
                step, planes = self.steps[str(self.kinds[layer].planes_step)], self.tensors[layer].planes
                largest = [
                    np.prod([np.abs(s[n]).max((1, 2)).astype(np.float64) * step for n, _, _ in PLANES], axis=0)
                    for s in planes
                ]
                hidden = self._largest(layer, TRUNK, np.concatenate(largest))
                heads = [name for name in self.tensors[layer].networks if name != TRUNK]
                found = {name: self._largest(layer, name, hidden) for name in heads}
                moved |= found if layer == 1 else {}
                sizes += found.values()
        inputs = np.concatenate([_largest_feature(self.given) + moved.get("feature", 0.0), np.ones(3)])
        sizes += [self._largest(0, name, inputs) for name in self.tensors[0].networks]
        return all((size < LARGEST).all() for size in sizes)

    def _largest(self, layer: int, name: str, inputs: np.ndarray) -> np.ndarray:
        """float64 [outputs], no less than the magnitude of any output or hidden value of a network for inputs up to
        `inputs` in magnitude; infinite from LARGEST on."""
        size, step = inputs, self.steps[self.kinds[layer].weights_step]
        network = self.tensors[layer].networks[name]
        with np.errstate(all="ignore"):
            for weight, bias in network:
                size = (np.abs(weight.astype(np.float64)) @ size + np.abs(bias)) * step
                if not (size < LARGEST).all():
                    return np.full(len(network[-1][1]), np.inf)
        return size

    def simplify_networks(self) -> bool:
        """One pass over all networks and their inputs; whether anything was left out."""
        before = len(self.found)
        self._zero_unread_features()
        for layer in self.tensors:
            if layer:
                self._zero_unread_channels(self.kinds[layer])
        for kind in self.kinds.values():
            self._zero_dead_units(kind)
        return len(self.found) > before

    def _zero_unread_features(self) -> None:
        """Zero feature channels that no network reads, in all anchors, and their residuals; and weights of channels
        that are 0 in all anchors and have no residual."""
        width, scaffold = len(self.unread), self.tensors[0].networks
        unread = ~np.any([network[0][0][:, :width].any(axis=0) for network in scaffold.values()], axis=0)
        head = self.tensors[1].networks.get("feature") if 1 in self.tensors else None
        moved = np.zeros(width, bool) if head is None else np.any([head[-1][0].any(1), head[-1][1] != 0], axis=0)
        stale = unread & ~self.unread
        if stale.any():
            features = np.concatenate([layer.attributes[:width][stale] for layer in self.given.layers], axis=1)
            stale[stale] = features.any(axis=1)
            features = features[features.any(axis=1)]
        if stale.any():
            self._note(f"{int(stale.sum())} feature channels", "no network reads them", _bits(features))
            self.unread |= stale
        if (unread & moved).any():
            self._zero_weights(self.kinds[1], "feature", -1, "rows", unread)
        zero = np.logical_and.reduce([~_set_features(layer, self.given.grid) for layer in self.given.layers])
        idle = np.concatenate([zero & ~moved, np.zeros(3, bool)])
        for name, network in scaffold.items():
            if network[0][0][:, idle].any():
                self._zero_weights(self.kinds[0], name, 0, "columns", idle)

    def _zero_unread_channels(self, kind: LayerKind) -> None:
        """Zero plane channels that the trunk does not read, and weights of those whose product is 0."""
        planes = self.tensors[kind.layer].planes
        alive = [np.all([scale[n].any(axis=(1, 2)) for n, _, _ in PLANES], axis=0) for scale in planes]
        silent = ~np.concatenate(alive)
        if self.tensors[kind.layer].networks[TRUNK][0][0][:, silent].any():
            self._zero_weights(kind, TRUNK, 0, "columns", silent)
        weight = self.tensors[kind.layer].networks[TRUNK][0][0]
        edited, count, bits = [], 0, 0.0
        for scale, dead in zip(planes, np.split(~weight.any(axis=0), len(planes)), strict=True):
            stale = [n for n, _, _ in PLANES if scale[n][dead].any()]
            count += int(dead.sum()) if stale else 0
            bits += sum(_bits(scale[n][dead].reshape(int(dead.sum()), -1)) for n in stale)
            edited.append(scale | {n: np.where(dead[:, None, None], np.int32(0), scale[n]) for n in stale})
        if count:
            self._note(f"{kind.name}: {count} plane channels", "the trunk does not read them", bits)
            self.tensors[kind.layer] = replace(self.tensors[kind.layer], planes=tuple(edited))

    def _zero_dead_units(self, kind: LayerKind) -> None:
        """Zero hidden units whose input weights are 0 and whose bias is not positive, or whose output nothing reads.

        Smaller matrices would cost less, but BLAS sums those in another order, so pictures would change in their last
        bits.
        """
        for name in list(self.tensors[kind.layer].networks):
            depth = len(self.tensors[kind.layer].networks[name])
            for i in range(depth - (name != TRUNK)):
                networks = self.tensors[kind.layer].networks
                weight, bias = networks[name][i]
                readers = [(head, 0) for head in networks if head != TRUNK] if i == depth - 1 else [(name, i + 1)]
                read = np.any([networks[h][j][0].any(axis=0) for h, j in readers], axis=0)
                dead = ~(read & (weight.any(axis=1) | (bias > 0)))
                stale = dead & (read | weight.any(axis=1) | (bias != 0))
                if stale.any():
                    bits = self._cost(kind, [(name, i), *readers])
                    self._zero(kind, name, i, "rows", stale)
                    for reader, j in readers:
                        self._zero(kind, reader, j, "columns", stale)
                    bits -= self._cost(kind, [(name, i), *readers])
                    what = f"{kind.name} {name}: {int(stale.sum())} units of layer {i + 1}"
                    self._note(what, "always 0, or read by nothing", bits)

    def _zero_weights(self, kind: LayerKind, name: str, index: int, of: str, dead: np.ndarray) -> None:
        before = self._cost(kind, [(name, index)])
        self._zero(kind, name, index, of, dead)
        saved = before - self._cost(kind, [(name, index)])
        self._note(f"{kind.name} {name}: {of} of weights", "read by nothing, or always times 0", saved)

    def _zero(self, kind: LayerKind, name: str, index: int, of: str, dead: np.ndarray) -> None:
        """Zero the rows (outputs, with their biases) or columns (inputs) `dead` bool of a linear layer."""
        tensors = self.tensors[kind.layer]
        network = list(tensors.networks[name])
        weight, bias = (array.copy() for array in network[index])
        if of == "rows":
            weight[dead], bias[dead] = 0, 0
        else:
            weight[:, dead] = 0
        network[index] = weight, bias
        networks: dict[str, Network] = {**tensors.networks, name: tuple(network)}
        self.tensors[kind.layer] = replace(tensors, networks=networks)

    # -- cells -------------------------------------------------------------------------------------------------------

    def free_cells(self) -> None:
        """Give cells of the global planes that no anchor reads values of little cost."""
        if 1 not in self.tensors:
            return
        kind, planes = self.kinds[1], self.tensors[1].planes
        filled, free, cells, saved = [], 0, 0, 0.0
        for scale, marks in zip(planes, cells_read(self.given), strict=True):
            filled.append({name: fill_plane(scale[name], marks[name]) for name, _, _ in PLANES})
            free += sum(int((~mark).sum()) for mark in marks.values())
            cells += sum(mark.size for mark in marks.values())
            saved += sum(_plane_bits(scale[name]) - _plane_bits(filled[-1][name]) for name, _, _ in PLANES)
        if any((new[n] != old[n]).any() for new, old in zip(filled, planes, strict=True) for n, _, _ in PLANES):
            self._note(f"{kind.name}: {free:,} of {cells:,} plane cells", "no anchor is ever there", saved)
            self.tensors[1] = replace(self.tensors[1], planes=tuple(filled))

    # -- report ------------------------------------------------------------------------------------------------------

    def _note(self, what: str, why: str, bits: float) -> None:
        self.found.append(LeftOut(what, why, bits=max(bits, 0.0), lossless=True))

    def _cost(self, kind: LayerKind, layers: list[tuple[str, int]]) -> float:
        """Order-0 entropy of the weights and biases of linear layers (network, index)."""
        return _bits(a.ravel() for name, i in layers for a in self.tensors[kind.layer].networks[name][i])


def cells_read(symbols: SceneSymbols) -> list[dict[str, np.ndarray]]:
    """Per scale, by plane name, bool [H, W]: the cells of the global planes that an anchor reads at some time."""
    low, high = symbols.info.box
    extent = np.maximum(high - low, np.finfo(np.float32).tiny)
    positions = [dequantise(layer.anchor_q, symbols.info.voxel_size) for layer in symbols.layers]
    unit = np.clip((np.concatenate(positions) - low) / extent, 0.0, 1.0)
    (planes,) = (layer.tensors.planes for layer in symbols.layers if layer.kind is LAYER_KINDS[1])
    read = []
    for scale in planes:
        cells = [_cells(unit[:, axis], side) for axis, side in enumerate(plane_sides(scale)[:3])]
        marks = {}
        for name, a, b in PLANES:
            marks[name] = np.zeros(scale[name].shape[1:], bool)
            for i in cells[a]:
                for j in cells[b] if b < 3 else [slice(None)]:
                    marks[name][j, i] = True
        read.append(marks)
    return read


def _cells(unit: np.ndarray, side: int) -> list[np.ndarray]:
    """int64 [n] each: the cells that samples at unit float32 [n], 0..1, may read on an axis of `side` cells."""
    first = np.floor(unit * (side - 1) - CELL_SLACK)
    last = np.floor(unit * (side - 1) + CELL_SLACK) + 1
    return [np.clip(cell, 0, side - 1).astype(np.int64) for cell in (first, first + 1, last)]


def _set_features(layer: LayerSymbols, grid: Grid) -> np.ndarray:
    """bool [D]: the feature channels in which some anchor of the layer is not 0."""
    symbols = layer.attributes[: grid.widths.feature]
    if not grid.widths.graded:
        return np.array(symbols.any(axis=1))
    return np.array(
        [(m + (k.astype(np.int64) << layer.classes)).any() for m, k in zip(grid.centre, symbols, strict=False)]
    )


def _largest_feature(symbols: SceneSymbols) -> np.ndarray:
    """float64 [D]: no less than the magnitude of each feature channel."""
    grid, width = symbols.grid, symbols.grid.widths.feature
    centre, largest = np.abs(grid.centre[:width]), np.zeros(width)
    for layer in symbols.layers:
        spacing = 1 << int(layer.classes.max(initial=0))
        symbol = np.abs(layer.attributes[:width]).max(axis=1, initial=0).astype(np.float64)
        largest = np.maximum(largest, (centre + symbol * spacing) * grid.steps["feature"])
    return largest


def _bits(channels: Iterable[np.ndarray]) -> float:
    """Order-0 entropy of channels, each under its own distribution."""
    return sum(entropy_bits(channel) for channel in channels)


def _plane_bits(symbols: np.ndarray) -> float:
    """Order-0 entropy of the residuals of a plane [C, H, W]."""
    residual = choose_predictor(symbols)[1]
    return _bits(residual.reshape(len(residual), -1))
