"""Encoder, for `deformation`: parts of planes and networks that no picture depends on.

Dead units of networks, features and plane channels that nothing reads, and plane cells that no anchor ever touches. No
array changes its shape, and sums lose only zeros: the same arithmetic gives the same bits.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pd4dgs_codec.entropy.bits import entropy_bits
from pd4dgs_codec.format.planes import cells_read, fill_plane
from pd4dgs_codec.format.registry import LAYER_KINDS
from pd4dgs_codec.scene import PLANES, TRUNK, VIEW_DIM, Deformation

#: Nothing is left out of networks whose values may exceed this: 0 times infinity is not 0. Binary32 ends at 3.4e38.
LARGEST = 1e30


@dataclass(frozen=True, eq=False)
class Anchors:
    """The anchors of a scene, of D feature channels. features: int32 [D, n] symbols by layer. nonzero: bool [D],
    channels in which some value is not 0. largest: float64 [D], no less than the magnitude of any value. unit: float32
    [N, 3] positions in the box of the deformations, 0..1."""

    features: Sequence[np.ndarray]
    nonzero: np.ndarray
    largest: np.ndarray
    unit: np.ndarray


class Omissions:
    """Edits the planes and networks of a scene's layers, in copies.

    tensors: int32 symbols by layer, of layers with networks. steps: by field of Steps. unread: bool [D], feature
    channels that may be 0 in all anchors. found: what was left out, why, and the bits of order-0 entropy that it saves.
    """

    def __init__(self, tensors: dict[int, Deformation], steps: dict[str, float], anchors: Anchors):
        self.tensors, self.anchors, self._steps = tensors, anchors, steps
        self.unread = np.zeros(len(anchors.nonzero), bool)
        self.found: list[tuple[str, str, float]] = []

    def run(self) -> None:
        """Leave out everything that no picture depends on."""
        while self._within_range() and self._simplify_networks():
            pass
        for layer in self.tensors:
            self._free_cells(layer)

    def _within_range(self) -> bool:
        """Whether no value in a network can come near overflow, for any input."""
        moved: np.ndarray | float = 0.0
        products: list[np.ndarray] = []
        sizes: list[np.ndarray] = []
        for layer in sorted(self.tensors.keys() - {0}):
            step = self._steps[str(LAYER_KINDS[layer].planes_step)]
            products += [
                np.prod([np.abs(scale[n]).max((1, 2)).astype(np.float64) * step for n, _, _ in PLANES], axis=0)
                for scale in self.tensors[layer].planes
            ]
            hidden = self._largest(layer, TRUNK, np.concatenate(products))
            found = {name: self._largest(layer, name, hidden) for name in self.tensors[layer].networks if name != TRUNK}
            moved = np.maximum(moved, found.get("feature", 0.0))
            sizes += found.values()
        inputs = np.concatenate([self.anchors.largest + moved, np.ones(VIEW_DIM)])
        networks = self.tensors[0].networks.items()
        sizes += [self._largest(0, name, inputs[: network[0][0].shape[1]]) for name, network in networks]
        return all((size < LARGEST).all() for size in sizes)

    def _largest(self, layer: int, name: str, inputs: np.ndarray) -> np.ndarray:
        """float64 [outputs], no less than the magnitude of any output or hidden value of a network for inputs up to
        `inputs` in magnitude; infinite from LARGEST on."""
        size, step = inputs, self._steps[LAYER_KINDS[layer].weights_step]
        network = self.tensors[layer].networks[name]
        with np.errstate(all="ignore"):
            for weight, bias in network:
                size = (np.abs(weight.astype(np.float64)) @ size + np.abs(bias)) * step
                if not (size < LARGEST).all():
                    return np.full(len(network[-1][1]), np.inf)
        return size

    # -- networks ------------------------------------------------------------------------------------------------------

    def _simplify_networks(self) -> bool:
        """One pass over all networks and their inputs; whether anything was left out."""
        before = len(self.found)
        self._zero_unread_features()
        self._zero_unread_channels()
        for layer in self.tensors:
            self._zero_dead_units(layer)
        return len(self.found) > before

    def _zero_unread_features(self) -> None:
        """Zero feature channels that no network reads, in all anchors, and their residuals; and weights of channels
        that are 0 in all anchors and have no residual."""
        width, scaffold = len(self.unread), self.tensors[0].networks
        unread = ~np.any([network[0][0][:, :width].any(axis=0) for network in scaffold.values()], axis=0)
        moved = np.zeros(width, bool)
        heads = {layer: t.networks["feature"] for layer, t in self.tensors.items() if "feature" in t.networks}
        for head in heads.values():
            moved |= head[-1][0].any(axis=1) | (head[-1][1] != 0)
        stale = unread & ~self.unread
        if stale.any():
            features = np.concatenate([symbols[stale] for symbols in self.anchors.features], axis=1)
            stale[stale] = features.any(axis=1)
            features = features[features.any(axis=1)]
        if stale.any():
            self._note(f"{int(stale.sum())} feature channels", "no network reads them", _bits(features))
            self.unread |= stale
        for layer in heads if (unread & moved).any() else ():
            self._zero_weights(layer, "feature", -1, "rows", unread)
        idle = np.concatenate([~self.anchors.nonzero & ~moved, np.zeros(VIEW_DIM, bool)])
        for name, network in scaffold.items():
            own = idle[: network[0][0].shape[1]]
            if network[0][0][:, own].any():
                self._zero_weights(0, name, 0, "columns", own)

    def _zero_unread_channels(self) -> None:
        """Zero plane channels that no trunk reads, and trunks' weights of channels whose product is 0. A trunk reads
        the planes of its layer behind those of the layers below."""
        layers = sorted(self.tensors.keys() - {0})
        alive = [
            np.all([scale[n].any(axis=(1, 2)) for n, _, _ in PLANES], axis=0)
            for layer in layers
            for scale in self.tensors[layer].planes
        ]
        silent, read = ~np.concatenate([*alive, np.zeros(0, bool)]), np.zeros(sum(map(len, alive)), bool)
        for layer in layers:
            own = silent[: self.tensors[layer].networks[TRUNK][0][0].shape[1]]
            if self.tensors[layer].networks[TRUNK][0][0][:, own].any():
                self._zero_weights(layer, TRUNK, 0, "columns", own)
            read[: len(own)] |= self.tensors[layer].networks[TRUNK][0][0].any(axis=0)
        for layer in layers:
            own, read = np.split(read, [self.tensors[layer].channels])
            self._zero_planes(layer, ~own)

    def _zero_planes(self, layer: int, dead: np.ndarray) -> None:
        """Zero the channels `dead`, bool over all scales."""
        planes = self.tensors[layer].planes
        edited, count, bits = [], 0, 0.0
        for scale, own in zip(planes, np.split(dead, len(planes)), strict=True):
            stale = [n for n, _, _ in PLANES if scale[n][own].any()]
            count += int(own.sum()) if stale else 0
            bits += sum(_bits(scale[n][own].reshape(int(own.sum()), -1)) for n in stale)
            edited.append(scale | {n: np.where(own[:, None, None], np.int32(0), scale[n]) for n in stale})
        if count:
            self._note(f"{LAYER_KINDS[layer].name}: {count} plane channels", "no trunk reads them", bits)
            self.tensors[layer] = replace(self.tensors[layer], planes=tuple(edited))

    def _zero_dead_units(self, layer: int) -> None:
        """Zero hidden units whose input weights are 0 and whose bias is not positive, or whose output nothing reads.

        Smaller matrices would cost less, but BLAS sums those in another order, so pictures would change in their last
        bits.
        """
        for name in list(self.tensors[layer].networks):
            depth = len(self.tensors[layer].networks[name])
            for i in range(depth - (name != TRUNK)):
                networks = self.tensors[layer].networks
                weight, bias = networks[name][i]
                readers = [(head, 0) for head in networks if head != TRUNK] if i == depth - 1 else [(name, i + 1)]
                read = np.any([networks[h][j][0].any(axis=0) for h, j in readers], axis=0)
                alive = weight.any(axis=1)
                stale = ~(read & (alive | (bias > 0))) & (read | alive | (bias != 0))
                if stale.any():
                    saved = self._zero(layer, name, i, "rows", stale)
                    saved += sum(self._zero(layer, reader, j, "columns", stale) for reader, j in readers)
                    what = f"{LAYER_KINDS[layer].name} {name}: {int(stale.sum())} units of layer {i + 1}"
                    self._note(what, "always 0, or read by nothing", saved)

    def _zero_weights(self, layer: int, name: str, index: int, of: str, dead: np.ndarray) -> None:
        saved = self._zero(layer, name, index, of, dead)
        what = f"{LAYER_KINDS[layer].name} {name}: {of} of weights"
        self._note(what, "read by nothing, or always times 0", saved)

    def _zero(self, layer: int, name: str, index: int, of: str, dead: np.ndarray) -> float:
        """Zero the rows (outputs, with their biases) or columns (inputs) `dead` bool of a linear layer; the bits that
        this saves."""
        network = list(self.tensors[layer].networks[name])
        given = network[index]
        weight, bias = (array.copy() for array in given)
        if of == "rows":
            weight[dead], bias[dead] = 0, 0
        else:
            weight[:, dead] = 0
        network[index] = weight, bias
        networks = {**self.tensors[layer].networks, name: tuple(network)}
        self.tensors[layer] = replace(self.tensors[layer], networks=networks)
        return _bits(array.ravel() for array in given) - _bits((weight.ravel(), bias))

    # -- cells ---------------------------------------------------------------------------------------------------------

    def _free_cells(self, layer: int) -> None:
        """Give cells of a layer's planes that no anchor reads values of little cost."""
        planes = self.tensors[layer].planes
        filled, free, cells, saved = [], 0, 0, 0.0
        for scale, marks in zip(planes, cells_read(planes, self.anchors.unit), strict=True):
            found = {name: fill_plane(scale[name], marks[name]) for name, _, _ in PLANES}
            filled.append({name: samples for name, (samples, _) in found.items()})
            saved += sum(bits for _, bits in found.values())
            free += sum(int((~mark).sum()) for mark in marks.values())
            cells += sum(mark.size for mark in marks.values())
        if any((new[n] != old[n]).any() for new, old in zip(filled, planes, strict=True) for n, _, _ in PLANES):
            what = f"{LAYER_KINDS[layer].name}: {free:,} of {cells:,} plane cells"
            self._note(what, "no anchor is ever there", saved)
            self.tensors[layer] = replace(self.tensors[layer], planes=tuple(filled))

    def _note(self, what: str, why: str, bits: float) -> None:
        self.found.append((what, why, max(bits, 0.0)))


def _bits(channels: Iterable[np.ndarray]) -> float:
    """Order-0 entropy of channels, each under its own distribution."""
    return sum(entropy_bits(channel) for channel in channels)
