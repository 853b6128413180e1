"""What a file does without, and the omissions that change no picture.

`leave_out` works on the values that the file will hold, so that what it proves holds for them: cells that no
renderer reads take the cheapest values, offsets of Gaussians that no view shows the commonest ones, and inputs that
nothing reads and the weights of units that are silent or unread become 0. No array changes its shape, and all terms
that sums lose were zeros: the same arithmetic gives the same bits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from pd4dgs_codec.attributes import planes as decorrelation
from pd4dgs_codec.attributes.quantise import dequantise, quantise
from pd4dgs_codec.attributes.table import ATTRIBUTES
from pd4dgs_codec.codec.kinds import LAYER_KINDS, LayerKind
from pd4dgs_codec.codec.stages import entropy_bits
from pd4dgs_codec.codec.symbols import dequantise_deformation, map_networks, quantise_deformation
from pd4dgs_codec.evaluate.reach import reach
from pd4dgs_codec.scene import FEATURE_DIM, N_OFFSETS, PLANES, TRUNK, Deformation, Network, Scene

#: Networks whose values may exceed this are left as they are; binary32 overflows at 3.4e38.
LARGEST = 1e30


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Something that was not written. What it would have cost: `tensors` is coded to see; else that of `anchors`
    average anchors; else `bits`, the order-0 entropy that went. lossless: no picture changes."""

    what: str
    why: str
    kind: LayerKind | None = None
    tensors: Deformation | None = None
    anchors: int = 0
    bits: float = 0.0
    lossless: bool = False


def leave_out(scene: Scene, raw_deformation: bool) -> tuple[Scene, list[LeftOut]]:
    """(`scene` without what no picture needs, what went). scene: as planned, all its rows active at its highest level.

    Where nothing is left out the values stay those given; what takes another value takes one that has a symbol.
    """
    omissions = _Omissions(scene, raw_deformation)
    while omissions.within_range() and omissions.simplify_networks():
        pass
    omissions.free_offsets_and_cells()
    return omissions.scene, omissions.found


class _Omissions:
    """scene: as given, less what went so far. decoded: the same as a decoder will see it."""

    def __init__(self, scene: Scene, raw: bool):
        self.scene, self.raw = scene, raw
        self.found: list[LeftOut] = []
        self.decoded = _as_decoded(scene, raw)

    # -- networks ----------------------------------------------------------------------------------------------------

    def within_range(self) -> bool:
        """Whether no network can overflow: a term that is 0 times infinity is not nothing."""
        sizes: dict[str, np.ndarray] = {}  # the scaffold's networks and the heads share some names
        with np.errstate(all="ignore"):
            for kind in LAYER_KINDS[1:]:
                networks = self._networks(kind)
                if networks:
                    planes = getattr(self.decoded, kind.deformation or "").planes
                    largest = [np.prod([np.abs(s[n]).max((1, 2)) for n, _, _ in PLANES], axis=0) for s in planes]
                    hidden = _largest(networks[TRUNK], np.concatenate(largest))
                    sizes |= {f"{kind.layer} {n}": _largest(net, hidden) for n, net in networks.items() if n != TRUNK}
            feature = np.abs(self.decoded.feature).max(axis=0, initial=0.0) + sizes.get("1 feature", 0.0)
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
        if kind.deformation is None:
            return self.decoded.networks
        deformation = getattr(self.decoded, kind.deformation)
        return {} if deformation is None else deformation.networks

    def _zero_unread_features(self) -> None:
        """Feature channels that no network reads: 0 in all anchors, and no residual; and the reverse, weights of
        channels that are 0 in all anchors and have no residual."""
        firsts = {name: self.decoded.networks[name][0][0] for name in self.decoded.networks}
        unread = ~np.any([w[:, :FEATURE_DIM].any(axis=0) for w in firsts.values()], axis=0)
        head = self._networks(LAYER_KINDS[1]).get("feature")
        moved = np.zeros(FEATURE_DIM, bool) if head is None else np.any([head[-1][0].any(1), head[-1][1] != 0], axis=0)
        zero = ~self.decoded.feature.any(axis=0)
        stale = unread & ~zero
        if stale.any():
            feature = np.where(unread, np.float32(0), self.scene.feature)
            symbols = quantise(self.decoded.feature[:, stale], self.scene.steps.feature, "feature")
            self._note(f"{int(stale.sum())} feature channels", "no network reads them", _bits(symbols.T))
            self._set(feature=feature)
        if (unread & moved).any():
            self._edit_layer(LAYER_KINDS[1], "feature", -1, lambda w, b: _zero(w, b, rows=unread), "rows")
        idle = np.concatenate([zero & ~moved, np.zeros(3, bool)])
        for name, weight in firsts.items():
            if weight[:, idle].any():
                self._edit_layer(LAYER_KINDS[0], name, 0, lambda w, b: _zero(w, b, columns=idle), "columns")

    def _zero_unread_channels(self, kind: LayerKind) -> None:
        """Plane channels that the trunk does not read, or whose product is 0 because one plane is 0."""
        deformation: Deformation = getattr(self.decoded, kind.deformation or "")
        alive = [np.all([scale[n].any(axis=(1, 2)) for n, _, _ in PLANES], axis=0) for scale in deformation.planes]
        silent = ~np.concatenate(alive)
        weight = deformation.networks[TRUNK][0][0]
        if weight[:, silent].any():
            self._edit_layer(kind, TRUNK, 0, lambda w, b: _zero(w, b, columns=silent), "columns")
            weight = getattr(self.decoded, kind.deformation or "").networks[TRUNK][0][0]
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
        self._note(f"{kind.deformation}: {count} plane channels", "the trunk does not read them", bits)
        given = getattr(self.scene, kind.deformation or "")
        planes = tuple(
            {n: np.where(dead[:, None, None], np.float32(0), scale[n]) for n, _, _ in PLANES}
            for scale, dead in zip(given.planes, unread, strict=True)
        )
        self._set_deformation(kind, Deformation(planes, given.networks))

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
        self._replace_layer(kind, name, index, lambda w, b: _zero(w, b, rows=dead))
        for reader, j in readers:
            self._replace_layer(kind, reader, j, lambda w, b: _zero(w, b, columns=dead))
        where = f"{kind.deformation or 'scaffold'} {name}"
        bits -= self._cost(kind, [(name, index), *readers])
        self._note(f"{where}: {int(dead.sum())} units of layer {index + 1}", "always 0, or read by nothing", bits)

    # -- offsets and cells -------------------------------------------------------------------------------------------

    def free_offsets_and_cells(self) -> None:
        """Offsets of Gaussians never shown, and plane cells never read, as `reach` proves; in this order, for the
        offsets say where cells are read."""
        reached = reach(self.decoded)
        shown = reached[2]
        if not shown.all():
            self._free_offsets(shown)
        for kind, cells in zip(LAYER_KINDS[1:], reached[:2], strict=True):
            if cells:
                self._free_cells(kind, cells)

    def _free_offsets(self, shown: np.ndarray) -> None:
        step = self.scene.steps.offset
        symbols = quantise(self.decoded.offset, step, "offset").reshape(len(shown), -1)
        free = np.repeat(~shown, 3, axis=1)
        freed = symbols.copy()
        for channel in range(symbols.shape[1]):
            taken = symbols[~free[:, channel], channel]
            values, counts = np.unique(taken, return_counts=True)
            freed[free[:, channel], channel] = values[counts.argmax()] if taken.size else 0
        if (freed == symbols).all():
            return
        bits = _bits(symbols.T) - _bits(freed.T)
        self._note(f"offsets of {int((~shown).sum())} Gaussians", "no view shows them at any time", bits)
        values = dequantise(freed, step).reshape(-1, N_OFFSETS, 3)
        self._set(offset=np.where(shown[..., None], self.scene.offset, values))

    def _free_cells(self, kind: LayerKind, reached: tuple[dict[str, np.ndarray], ...]) -> None:
        given: Deformation = getattr(self.scene, kind.deformation or "")
        decoded: Deformation = getattr(self.decoded, kind.deformation or "")
        planes, saved, count, cells = [], 0.0, 0, 0
        for scale, values, marks in zip(given.planes, decoded.planes, reached, strict=True):
            filled = dict(scale)
            for name, _, _ in PLANES:
                read = marks[name]
                cells += read.size
                if read.all():
                    continue
                count += int((~read).sum())
                symbols = self._plane_symbols(kind, values[name])
                if self.raw:
                    free = np.zeros_like(scale[name])
                    saved += 32.0 * len(free) * int((~read).sum())
                else:
                    fill = decorrelation.fill(symbols, read)
                    saved += _plane_bits(symbols) - _plane_bits(fill)
                    free = dequantise(fill, getattr(self.scene.steps, kind.planes_step or ""))
                filled[name] = np.where(read, scale[name], free)
            planes.append(filled)
        changed = any((p[n] != s[n]).any() for p, s in zip(planes, decoded.planes, strict=True) for n in p)
        if changed:
            why = "no anchor is ever there" if kind.layer == 1 else "no Gaussian shown is ever there"
            self._note(f"{kind.deformation}: {count:,} of {cells:,} plane cells", why, saved)
            self._set_deformation(kind, Deformation(tuple(planes), given.networks))

    # -- bookkeeping -------------------------------------------------------------------------------------------------

    def _note(self, what: str, why: str, bits: float) -> None:
        self.found.append(LeftOut(what, why, bits=max(bits, 0.0), lossless=True))

    def _set(self, **fields) -> None:
        self.scene = replace(self.scene, **fields)
        self.decoded = _as_decoded(self.scene, self.raw)

    def _set_deformation(self, kind: LayerKind, deformation: Deformation) -> None:
        self._set(**{kind.deformation or "": deformation})

    def _edit_layer(self, kind: LayerKind, name: str, index: int, edit: Callable, of: str) -> None:
        where = f"{kind.deformation or 'scaffold'} {name}"
        before = self._cost(kind, [(name, index)])
        self._replace_layer(kind, name, index, edit)
        saved = before - self._cost(kind, [(name, index)])
        self._note(f"{where}: {of} of weights", "read by nothing, or always times 0", saved)

    def _replace_layer(self, kind: LayerKind, name: str, index: int, edit: Callable) -> None:
        """Puts edit(weight, bias) in place of one linear layer of the scene's network `name`."""
        given = self.scene.networks if kind.deformation is None else getattr(self.scene, kind.deformation).networks
        layers = list(given[name])
        layers[index] = tuple(np.ascontiguousarray(a) for a in edit(*layers[index]))
        networks = {**given, name: tuple(layers)}
        if kind.deformation is None:
            self._set(networks=networks)
        else:
            self._set_deformation(kind, Deformation(getattr(self.scene, kind.deformation).planes, networks))

    def _cost(self, kind: LayerKind, layers: list[tuple[str, int]]) -> float:
        """Order-0 entropy of the weights and biases of linear layers (network, index); 0 if they are float32 values."""
        if self.raw and kind.deformation is not None:
            return 0.0
        step = getattr(self.scene.steps, kind.weights_step)
        arrays = [a for name, index in layers for a in self._networks(kind)[name][index]]
        return _bits([quantise(a, step, "weight").ravel() for a in arrays])

    def _plane_symbols(self, kind: LayerKind, plane: np.ndarray) -> np.ndarray:
        """int32 symbols, or of float32 values their bits."""
        if self.raw:
            return np.ascontiguousarray(plane).view(np.int32)
        return quantise(plane, getattr(self.scene.steps, kind.planes_step or ""), "plane")


def _as_decoded(scene: Scene, raw: bool) -> Scene:
    """`scene` with the values that the file will hold."""
    steps = scene.steps
    fields: dict = {
        a.name: dequantise(quantise(getattr(scene, a.name), getattr(steps, a.name), a.name), getattr(steps, a.name))
        for a in ATTRIBUTES
    }
    step = steps.weights_scaffold
    fields["networks"] = map_networks(scene.networks, lambda name, x: dequantise(quantise(x, step, name), step))
    for kind in LAYER_KINDS[1:]:
        deformation = getattr(scene, kind.deformation or "")
        if deformation is not None and not raw:
            symbols = quantise_deformation(deformation, kind, steps)
            fields[kind.deformation or ""] = dequantise_deformation(symbols, kind, steps)
    return replace(scene, **fields)


def _largest(network: Network, inputs: np.ndarray) -> np.ndarray:
    """float64 [outputs], no less than the magnitude of any output or of anything on the way, inputs being up to
    `inputs` in magnitude."""
    size = np.asarray(inputs, np.float64)
    for weight, bias in network:
        size = np.abs(weight.astype(np.float64)) @ size + np.abs(bias)
        if not (size < LARGEST).all():
            return np.full(len(network[-1][1]), np.inf)
    return size


def _zero(weight: np.ndarray, bias: np.ndarray, rows=None, columns=None) -> tuple[np.ndarray, np.ndarray]:
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
    residual = decorrelation.choose_predictor(symbols)[1]
    return _bits(residual.reshape(len(residual), -1))
