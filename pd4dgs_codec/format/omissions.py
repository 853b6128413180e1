"""The omissions that change no picture.

`leave_out_unseen` works on the values that the file will hold, so that what it proves holds for them: cells that no
renderer reads take the cheapest values, offsets of Gaussians that no view shows the commonest ones, and inputs that
nothing reads and the weights of units that are silent or unread become 0. No array changes its shape, and all terms
that sums lose were zeros: the same arithmetic gives the same bits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import numpy as np

from pd4dgs_codec.entropy.bits import entropy_bits, symbol_counts
from pd4dgs_codec.evaluate.reach import Reached, global_cells, local_cells, shown_gaussians
from pd4dgs_codec.format.kinds import LAYER_KINDS, LayerKind
from pd4dgs_codec.format.left_out import LeftOut
from pd4dgs_codec.format.plane_choice import choose_predictor, fill_plane
from pd4dgs_codec.format.quantise import dequantise, quantise
from pd4dgs_codec.format.symbols import rounded
from pd4dgs_codec.format.table import Grid, classes_of
from pd4dgs_codec.scene import PLANES, TRUNK, Deformation, Network, Planes, Scene

#: Networks whose values may exceed this are left as they are; binary32 overflows at 3.4e38.
LARGEST = 1e30
#: Bits that must be in sight for an evaluation of the global networks at one anchor, over one stretch of time, at the
#: usual effort: some 40 kB for a second. A proof finds a part of them. Two levels of effort are a factor of ten.
PRICE, USUAL_EFFORT = 0.3, 5
#: Planes with cheapest values in cells take so much less than their order-0 entropies differ: 2 to 3 times on trained
#: scenes, for their neighbours are predicted better.
CELLS_GAIN = 3


def leave_out_unseen(scene: Scene, raw_deformation: bool, effort: int) -> tuple[Scene, list[LeftOut]]:
    """(`scene` without what no picture needs, what went). scene: as planned, all its rows active at its highest level.

    Where nothing is left out the values stay those given; what takes another value takes one that has a symbol. effort:
    1..9, how little a proof may save that takes its time.
    """
    omissions = _Omissions(scene, raw_deformation)
    del scene  # see `plan`
    while omissions.within_range() and omissions.simplify_networks():
        pass
    omissions.free_offsets_and_cells(PRICE * 10.0 ** ((USUAL_EFFORT - effort) / 2))
    return omissions.scene, omissions.found


#: (weight, bias) of a linear layer -> what takes its place.
LinearEdit = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]

#: Per scale, by name: the symbols of a plane int32 [C, H, W], and the bits that they take.
CodedPlanes = list[dict[str, tuple[np.ndarray, float]]]


class _Omissions:
    """scene: as given, less what went so far. decoded: the same as a decoder will see it."""

    def __init__(self, scene: Scene, raw_deformation: bool):
        self.scene, self.raw_deformation = scene, raw_deformation
        self.found: list[LeftOut] = []
        self.decoded = rounded(scene, raw_deformation)

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

    # -- offsets and cells -------------------------------------------------------------------------------------------

    def free_offsets_and_cells(self, price: float) -> None:
        """Offsets of Gaussians never shown, and plane cells never read, as `reach` proves where that may save `price`
        bits an evaluation; in this order, for the offsets say where cells are read."""
        self._free_cells(LAYER_KINDS[1], self._coded_planes(LAYER_KINDS[1]), global_cells(self.decoded))
        shown = shown_gaussians(
            self.decoded,
            lambda certain, evaluations: sum(bits for *_, bits in self._cheaper(certain)) > price * evaluations,
        )
        self._free_offsets(shown)
        kind = LAYER_KINDS[2]
        coded = self._coded_planes(kind)
        cells = local_cells(
            self.decoded,
            shown,
            lambda read, evaluations: CELLS_GAIN * self._without_cells(kind, coded, read)[1] > price * evaluations,
        )
        if cells:
            self._free_cells(kind, coded, cells)

    def _cheaper(self, shown: np.ndarray) -> Iterator[tuple[int, np.ndarray, float, float]]:
        """(channel of the offsets, rows of Gaussians that are not `shown` bool [N, G], value, bits saved) where these
        take fewer bits with the commonest symbol of their step class, or of those shown if there are any."""
        grid, classes = Grid.of(self.decoded), classes_of(self.decoded)
        groups = [(int(k), np.flatnonzero(classes == k)) for k in np.unique(classes)]
        offset = self.decoded.offset.reshape(len(shown), 3 * shown.shape[1])
        for channel in range(offset.shape[1]):
            one = slice(channel, channel + 1)
            (symbols,) = grid.symbols_of("offset", offset[:, one], classes, one)
            for step_class, rows in groups or [(0, np.arange(len(shown)))]:
                own, before = shown[rows, channel // 3], symbols[rows]
                if own.all():
                    continue
                values, counts = symbol_counts(before[own]) if own.any() else (np.zeros(1, int), np.ones(1, int))
                symbol = int(values[counts.argmax()])
                bits = entropy_bits(before) - entropy_bits(np.where(own, before, symbol))
                if bits > 0:
                    yield channel, rows[~own], grid.value_of("offset", symbol, channel, step_class), bits

    def _free_offsets(self, shown: np.ndarray) -> None:
        if shown.all():
            return
        given, decoded, saved = self.scene.offset.copy(), self.decoded.offset.copy(), 0.0
        for channel, rows, value, bits in self._cheaper(shown):
            for offset in (given, decoded):
                offset[rows, channel // 3, channel % 3] = value
            saved += bits
        if saved:
            what = f"offsets of {int((~shown).sum())} Gaussians"
            self._note(what, "no view shows them at any time", saved)
            self.scene, self.decoded = replace(self.scene, offset=given), replace(self.decoded, offset=decoded)

    def _coded_planes(self, kind: LayerKind) -> CodedPlanes:
        scales = self.decoded.tensors(kind.layer).planes if self._networks(kind) else ()
        symbols = [{name: self._plane_symbols(kind, scale[name]) for name, _, _ in PLANES} for scale in scales]
        return [
            {name: (own, 0.0 if self.raw_deformation else _plane_bits(own)) for name, own in scale.items()}
            for scale in symbols
        ]

    def _without_cells(
        self, kind: LayerKind, coded: CodedPlanes, read: Reached
    ) -> tuple[list[dict[str, np.ndarray]], float]:
        """(per scale, by name, the planes that may take other values in cells that are not `read`; bits saved)."""
        planes: list[dict[str, np.ndarray]] = []
        saved = 0.0
        for scale, marks in zip(coded, read, strict=True):
            planes.append({})
            for name, mark in marks.items():
                symbols, bits = scale[name]
                cheap = np.where(mark, symbols, 0) if self.raw_deformation else fill_plane(symbols, mark)
                if (cheap == symbols).all():
                    continue
                if self.raw_deformation:
                    planes[-1][name] = cheap.view(np.float32)
                    saved += 32.0 * len(symbols) * int((~mark).sum())
                else:
                    planes[-1][name] = dequantise(cheap, self.scene.steps.planes(kind.layer))
                    saved += bits - _plane_bits(cheap)
        return planes, saved

    def _free_cells(self, kind: LayerKind, coded: CodedPlanes, read: Reached) -> None:
        values, saved = self._without_cells(kind, coded, read)
        if not any(values):
            return
        marks = [mark for scale in read for mark in scale.values()]
        free, cells = sum(int((~mark).sum()) for mark in marks), sum(mark.size for mark in marks)
        why = "no anchor is ever there" if kind.layer == 1 else "no Gaussian shown is ever there"
        self._note(f"{kind.name}: {free:,} of {cells:,} plane cells", why, saved)
        self._edit_planes(
            kind,
            lambda planes: tuple(
                scale | {name: np.where(marks[name], scale[name], cheap[name]) for name in cheap}
                for scale, marks, cheap in zip(planes, read, values, strict=True)
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
        """Order-0 entropy of the weights and biases of linear layers (network, index); 0 if they are float32 values."""
        if self.raw_deformation and kind.layer > 0:
            return 0.0
        step = self.scene.steps.weights(kind.layer)
        arrays = [a for name, index in layers for a in self._networks(kind)[name][index]]
        return _bits([quantise(a, step, "weight").ravel() for a in arrays])

    def _plane_symbols(self, kind: LayerKind, plane: np.ndarray) -> np.ndarray:
        """int32 symbols, or of float32 values their bits."""
        if self.raw_deformation:
            return np.ascontiguousarray(plane).view(np.int32)
        return quantise(plane, self.scene.steps.planes(kind.layer), "plane")


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
