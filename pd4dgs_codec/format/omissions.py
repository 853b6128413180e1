"""Omissions that change no picture: dead units of networks, features nobody reads, plane cells no anchor reads.

All of it works on the values that the file will hold. No array changes its shape, and all terms that sums lose were
zeros: the same arithmetic gives the same bits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np

from pd4dgs_codec.entropy.bits import entropy_bits
from pd4dgs_codec.format.kinds import LAYER_KINDS, LayerKind
from pd4dgs_codec.format.left_out import LeftOut
from pd4dgs_codec.format.plane_choice import choose_predictor, fill_plane
from pd4dgs_codec.format.quantise import dequantise, quantise
from pd4dgs_codec.format.symbols import rounded
from pd4dgs_codec.format.table import Grid, classes_of
from pd4dgs_codec.scene import PLANES, TRUNK, Deformation, Network, Planes, Scene, plane_sides

#: Networks whose values may exceed this are left as they are; binary32 overflows at 3.4e38.
LARGEST = 1e30
#: Cells by which a position may be off: another renderer rounds its coordinates otherwise.
CELL_SLACK = 0.02


def leave_out_unseen(scene: Scene) -> tuple[Scene, list[LeftOut]]:
    """(`scene` without what no picture needs, what went). scene: as planned, all its rows active at its highest level.

    Where nothing is left out the values stay those given; what takes another value takes one that has a symbol.
    """
    omissions = _Omissions(scene)
    del scene  # see `plan`
    while omissions.within_range() and omissions.simplify_networks():
        pass
    omissions.free_cells()
    return omissions.scene, omissions.found


#: (weight, bias) of a linear layer -> what takes its place.
LinearEdit = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


class _Omissions:
    """scene: as given, less what went so far. decoded: the same as a decoder will see it."""

    def __init__(self, scene: Scene):
        self.scene = scene
        self.found: list[LeftOut] = []
        self.decoded = rounded(scene)

    # -- networks ----------------------------------------------------------------------------------------------------

    def within_range(self) -> bool:
        """Whether no network can overflow: a term that is 0 times infinity is not nothing."""
        sizes: dict[str, np.ndarray] = {}  # the scaffold's networks and the heads share some names
        with np.errstate(all="ignore"):
            for kind in LAYER_KINDS[1:]:
                networks = self._networks(kind)
                if networks:
                    planes = self.decoded.tensors(kind.layer).planes
                    largest = [np.prod([np.abs(s[n]).max((1, 2)) for n, _, _ in PLANES], axis=0) for s in planes]
                    hidden = _largest(networks[TRUNK], np.concatenate(largest))
                    sizes |= {f"{kind.layer} {n}": _largest(net, hidden) for n, net in networks.items() if n != TRUNK}
            own = self.decoded.feature
            feature = np.maximum(own.max(axis=0, initial=0.0), -own.min(axis=0, initial=0.0))
            feature = feature + sizes.get("1 feature", 0.0)
            inputs = np.concatenate([feature, np.ones(3)])
            sizes |= {name: _largest(network, inputs) for name, network in self.decoded.networks.items()}
        return all((size < LARGEST).all() for size in sizes.values())

    def simplify_networks(self) -> bool:
        """One pass over all networks and their inputs; whether anything went."""
        before = len(self.found)
        self._zero_unread_features()
        for kind in LAYER_KINDS[1:]:
            if self._networks(kind):
                self._zero_unread_channels(kind)
        for kind in LAYER_KINDS:
            self._zero_dead_units(kind)
        return len(self.found) > before

    def _networks(self, kind: LayerKind) -> dict[str, Network]:
        """The decoded networks of a layer, none if it has none."""
        return self.decoded.tensors(kind.layer).networks

    def _zero_unread_features(self) -> None:
        """Feature channels that no network reads: 0 in all anchors, and no residual; and the reverse, weights of
        channels that are 0 in all anchors and have no residual."""
        width = self.scene.widths.feature
        firsts = {name: self.decoded.networks[name][0][0] for name in self.decoded.networks}
        unread = ~np.any([w[:, :width].any(axis=0) for w in firsts.values()], axis=0)
        head = self._networks(LAYER_KINDS[1]).get("feature")
        moved = np.zeros(width, bool) if head is None else np.any([head[-1][0].any(1), head[-1][1] != 0], axis=0)
        zero = ~self.decoded.feature.any(axis=0)
        grid, classes = Grid.of(self.decoded), classes_of(self.decoded)
        idle_value = dequantise(grid.centre[:width], grid.steps["feature"])  # which anchors of every class can have
        stale = unread.copy()
        stale[unread] = (self.decoded.feature[:, unread] != idle_value[unread]).any(axis=0)
        if stale.any():
            symbols = grid.symbols_of("feature", self.decoded.feature[:, stale], classes, stale)
            self._note(f"{int(stale.sum())} feature channels", "no network reads them", _bits(symbols))
            self._edit(lambda scene: replace(scene, feature=np.where(unread, idle_value, scene.feature)))
        if (unread & moved).any():
            self._zero_weights(LAYER_KINDS[1], "feature", -1, lambda w, b: _zero(w, b, rows=unread), "rows")
        idle = np.concatenate([zero & ~moved, np.zeros(3, bool)])
        for name, weight in firsts.items():
            if weight[:, idle].any():
                self._zero_weights(LAYER_KINDS[0], name, 0, lambda w, b: _zero(w, b, columns=idle), "columns")

    def _zero_unread_channels(self, kind: LayerKind) -> None:
        """Plane channels that the trunk does not read, or whose product is 0 because one plane is 0."""
        deformation = self.decoded.tensors(kind.layer)
        alive = [np.all([scale[n].any(axis=(1, 2)) for n, _, _ in PLANES], axis=0) for scale in deformation.planes]
        silent = ~np.concatenate(alive)
        weight = deformation.networks[TRUNK][0][0]
        if weight[:, silent].any():
            self._zero_weights(kind, TRUNK, 0, lambda w, b: _zero(w, b, columns=silent), "columns")
            weight = self._networks(kind)[TRUNK][0][0]
        unread = np.split(~weight.any(axis=0), len(deformation.planes))
        stale = [
            [n for n, _, _ in PLANES if s[n][dead].any()] for s, dead in zip(deformation.planes, unread, strict=True)
        ]
        if not any(stale):
            return
        bits = sum(
            _bits(self._plane_symbols(kind, scale[n])[dead].reshape(int(dead.sum()), -1))
            for scale, dead, names in zip(deformation.planes, unread, stale, strict=True)
            for n in names
        )
        count = sum(int(dead.sum()) for dead, names in zip(unread, stale, strict=True) if names)
        self._note(f"{kind.name}: {count} plane channels", "the trunk does not read them", bits)
        self._edit_planes(
            kind,
            lambda planes: tuple(
                {n: np.where(dead[:, None, None], np.float32(0), scale[n]) for n, _, _ in PLANES}
                for scale, dead in zip(planes, unread, strict=True)
            ),
        )

    def _zero_dead_units(self, kind: LayerKind) -> None:
        """Hidden units whose input weights are all 0 and whose bias is not positive, or whose output nothing reads.

        Their weights become 0 and stay where they are: smaller matrices would cost less, but BLAS sums those in another
        order, and pictures would change in their last bits.
        """
        for name in list(self._networks(kind)):
            network = self._networks(kind)[name]
            for i in range(len(network) - (name != TRUNK)):
                networks = self._networks(kind)
                weight, bias = networks[name][i]
                last = i == len(network) - 1
                readers = [(h, 0) for h in networks if h != TRUNK] if last else [(name, i + 1)]
                read = np.any([networks[h][j][0].any(axis=0) for h, j in readers], axis=0)
                dead = ~(read & (weight.any(axis=1) | (bias > 0)))
                stale = dead & (read | weight.any(axis=1) | (bias != 0))
                if stale.any():
                    self._zero_units(kind, name, i, stale, readers)

    def _zero_units(
        self, kind: LayerKind, name: str, index: int, dead: np.ndarray, readers: list[tuple[str, int]]
    ) -> None:
        """Zeroes the outputs `dead` (bool) of a linear layer, and those inputs of the linear layers that read it."""
        bits = self._cost(kind, [(name, index), *readers])
        self._edit_linear(kind, name, index, lambda w, b: _zero(w, b, rows=dead))
        for reader, j in readers:
            self._edit_linear(kind, reader, j, lambda w, b: _zero(w, b, columns=dead))
        bits -= self._cost(kind, [(name, index), *readers])
        what = f"{kind.name} {name}: {int(dead.sum())} units of layer {index + 1}"
        self._note(what, "always 0, or read by nothing", bits)

    # -- cells -----------------------------------------------------------------------------------------------------

    def free_cells(self) -> None:
        """Cells of the global planes that no anchor reads take values that cost little."""
        kind = LAYER_KINDS[1]
        deformation, free, cells, saved = self.decoded.global_deformation, 0, 0, 0.0
        if deformation is None:
            return
        step, planes = self.scene.steps.planes(kind.layer), []
        read = cells_read(self.decoded, deformation)
        for scale, marks in zip(deformation.planes, read, strict=True):
            filled = {}
            for name, _, _ in PLANES:
                symbols = quantise(scale[name], step, "plane")
                cheap = fill_plane(symbols, marks[name])
                filled[name] = np.where(marks[name] | (cheap == symbols), np.nan, dequantise(cheap, step))
                free, cells = free + int((~marks[name]).sum()), cells + marks[name].size
                saved += _plane_bits(symbols) - _plane_bits(cheap)
            planes.append(filled)
        if all(np.isnan(plane).all() for scale in planes for plane in scale.values()):
            return
        self._note(f"{kind.name}: {free:,} of {cells:,} plane cells", "no anchor is ever there", saved)
        self._edit_planes(
            kind,
            lambda given: tuple(
                {n: np.where(np.isnan(new[n]), old[n], new[n]) for n, _, _ in PLANES}
                for old, new in zip(given, planes, strict=True)
            ),
        )

    # -- bookkeeping -------------------------------------------------------------------------------------------------

    def _note(self, what: str, why: str, bits: float) -> None:
        self.found.append(LeftOut(what, why, bits=max(bits, 0.0), lossless=True))

    def _edit(self, edit: Callable[[Scene], Scene]) -> None:
        """Every edit puts in values that come back as they are: what holds for the scene holds for the decoded one."""
        self.scene, self.decoded = edit(self.scene), edit(self.decoded)

    def _edit_planes(self, kind: LayerKind, edit: Callable[[Planes], Planes]) -> None:
        def edited(scene: Scene) -> Scene:
            tensors = scene.tensors(kind.layer)
            return scene.with_tensors(kind.layer, Deformation(edit(tensors.planes), tensors.networks))

        self._edit(edited)

    def _edit_linear(self, kind: LayerKind, name: str, index: int, edit: LinearEdit) -> None:
        """Puts edit(weight, bias) in place of one linear layer of the network `name`."""

        def edited(scene: Scene) -> Scene:
            tensors = scene.tensors(kind.layer)
            layers = list(tensors.networks[name])
            weight, bias = edit(*layers[index])
            layers[index] = np.ascontiguousarray(weight), np.ascontiguousarray(bias)
            return scene.with_tensors(
                kind.layer, Deformation(tensors.planes, {**tensors.networks, name: tuple(layers)})
            )

        self._edit(edited)

    def _zero_weights(self, kind: LayerKind, name: str, index: int, edit: LinearEdit, of: str) -> None:
        before = self._cost(kind, [(name, index)])
        self._edit_linear(kind, name, index, edit)
        saved = before - self._cost(kind, [(name, index)])
        self._note(f"{kind.name} {name}: {of} of weights", "read by nothing, or always times 0", saved)

    def _cost(self, kind: LayerKind, layers: list[tuple[str, int]]) -> float:
        """Order-0 entropy of the weights and biases of linear layers (network, index)."""
        step = self.scene.steps.weights(kind.layer)
        arrays = [a for name, index in layers for a in self._networks(kind)[name][index]]
        return _bits([quantise(a, step, "weight").ravel() for a in arrays])

    def _plane_symbols(self, kind: LayerKind, plane: np.ndarray) -> np.ndarray:
        """int32 symbols."""
        return quantise(plane, self.scene.steps.planes(kind.layer), "plane")


def cells_read(scene: Scene, deformation: Deformation) -> list[dict[str, np.ndarray]]:
    """Per scale, by plane name, bool [H, W]: the cells of the global planes that an anchor reads at some time."""
    low, high = scene.info.box
    extent = np.maximum(high - low, np.finfo(np.float32).tiny)
    unit = np.clip((scene.anchor - low) / extent, 0.0, 1.0)
    read = []
    for scale in deformation.planes:
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


def _largest(network: Network, inputs: np.ndarray) -> np.ndarray:
    """float64 [outputs], no less than the magnitude of any output or of anything on the way, inputs being up to
    `inputs` in magnitude."""
    size = np.asarray(inputs, np.float64)
    for weight, bias in network:
        size = np.abs(weight.astype(np.float64)) @ size + np.abs(bias)
        if not (size < LARGEST).all():
            return np.full(len(network[-1][1]), np.inf)
    return size


def _zero(
    weight: np.ndarray, bias: np.ndarray, rows: np.ndarray | None = None, columns: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """The layer with its rows (outputs) or columns (inputs) `rows`, `columns` bool set to 0."""
    if columns is not None:
        weight = np.where(columns[None, :], np.float32(0), weight)
    if rows is not None:
        weight, bias = np.where(rows[:, None], np.float32(0), weight), np.where(rows, np.float32(0), bias)
    return weight, bias


def _bits(channels: Iterable[np.ndarray]) -> float:
    """Order-0 entropy of channels, each under a distribution of its own."""
    return sum(entropy_bits(channel) for channel in channels)


def _plane_bits(symbols: np.ndarray) -> float:
    """Order-0 entropy of the residuals of a plane [C, H, W]."""
    residual = choose_predictor(symbols)[1]
    return _bits(residual.reshape(len(residual), -1))
