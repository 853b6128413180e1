"""A layer's planes and networks for the rest of the codec: symbols, checks, parameters, sections.

Only this module and `planes`, which no other module imports, know the parts of a deformation: planes, a trunk, and a
network per residual head, which `plan` may drop. The rest of the codec passes on a `Deformation`, float32 in a scene
and int32 symbols in a layer. Layer 0 has networks and no planes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import Any

import numpy as np

from pd4dgs_codec.entropy.channels import decode_channels, encode_channels
from pd4dgs_codec.entropy.fitting import histogram
from pd4dgs_codec.errors import LimitExceeded, Malformed
from pd4dgs_codec.format.canonical import Fields, as_integer, as_list, as_registered
from pd4dgs_codec.format.options import EncodeOptions
from pd4dgs_codec.format.planes import (
    PREDICTORS,
    PlaneShape,
    cells_read,
    choose_predictor,
    fill_plane,
    read_planes,
    restore,
    write_planes,
)
from pd4dgs_codec.format.quantise import MAX_SYMBOL, dequantise, expect, expect_array, is_step, magnitude, quantise
from pd4dgs_codec.format.registry import LAYER_KINDS, LayerKind, Section
from pd4dgs_codec.scene import (
    INSTANTS,
    PLANES,
    TRUNK,
    Deformation,
    Network,
    Planes,
    Steps,
    Widths,
    instant,
    plane_shapes,
    plane_sides,
)

# Keys of the layer parameters.
KEYS = STEPS, SCALES, NETWORKS, KEY = 3, 4, 5, 6

# Limits (clause 14).
MAX_PLANE_SIDE = 4096  #: cells; eight times the paper's finest plane
MAX_PLANE_CHANNELS = 256
MAX_PLANE_SCALES = 8
MAX_PLANE_CELLS = 1 << 28  #: cells times channels over all planes of one chunk: 1 GiB of float32
MAX_NETWORK_WIDTH = 4096  #: inputs or outputs of one linear layer
MAX_NETWORK_LAYERS = 16

NOTHING = Deformation((), {})  #: neither planes nor networks


# -- symbols -----------------------------------------------------------------------------------------------------------


def arrays_of(tensors: Deformation, kind: LayerKind) -> Iterator[tuple[str, str, np.ndarray]]:
    """Yields (name of the step, name, array) in coding order: the planes, scale by scale, then weight and bias of each
    linear layer of each network, by ascending number. Names are like "planes.0.xy" and "mlp.trunk.weight.0"."""
    for s, scale in enumerate(tensors.planes):
        yield from ((str(kind.planes_step), f"planes.{s}.{name}", scale[name]) for name, _, _ in PLANES)
    for name, network in _by_number(tensors, kind):
        for i, (weight, bias) in enumerate(network):
            yield kind.weights_step, f"mlp.{name}.weight.{i}", weight
            yield kind.weights_step, f"mlp.{name}.bias.{i}", bias


def _by_number(tensors: Deformation, kind: LayerKind) -> list[tuple[str, Network]]:
    """Returns (name, network) in the order of the networks' numbers."""
    return [(name, tensors.networks[name]) for name in kind.network_ids if name in tensors.networks]


def with_arrays(tensors: Deformation, kind: LayerKind, arrays: Iterable[np.ndarray]) -> Deformation:
    """Returns a deformation with the structure of `tensors` and these arrays, in the order of `arrays_of`."""
    depths = {name: len(network) for name, network in _by_number(tensors, kind)}
    return _assembled(len(tensors.planes), depths, tensors.key, iter(arrays))


def _assembled(scales: int, depths: dict[str, int], key: int | None, arrays: Iterator[np.ndarray]) -> Deformation:
    planes = tuple({name: next(arrays) for name, _, _ in PLANES} for _ in range(scales))
    networks = {name: tuple((next(arrays), next(arrays)) for _ in range(depth)) for name, depth in depths.items()}
    return Deformation(planes, networks, key)


def quantise_tensors(tensors: Deformation, kind: LayerKind, steps: Steps) -> Deformation:
    """Returns the int32 symbols of a layer's planes and networks. Raises EncodeError for a value without a symbol."""
    rows = arrays_of(tensors, kind)
    return with_arrays(tensors, kind, [quantise(x, vars(steps)[of], f"{kind.name} {name}") for of, name, x in rows])


def dequantise_tensors(symbols: Deformation, kind: LayerKind, steps: Steps) -> Deformation:
    """Returns the float32 planes and networks of int32 symbols."""
    return with_arrays(symbols, kind, [dequantise(k, vars(steps)[of]) for of, _, k in arrays_of(symbols, kind)])


def layer_steps(steps: Steps, kind: LayerKind, tensors: Deformation) -> dict[str, float]:
    """Returns the steps in a layer's chunk by name; none if it has no networks."""
    return {name: float(getattr(steps, name)) for name in kind.step_names} if tensors.networks else {}


def check_tensors(tensors: Deformation, kind: LayerKind, widths: Widths, below: Deformation | None) -> None:
    """Raises EncodeError unless planes and networks of a layer have the shapes and dtypes that scene.Deformation and
    Widths document, and finite values. below: the deformation of the layer below."""
    own, required = kind.name, (TRUNK,) if kind.layer else tuple(kind.network_ids)
    unknown = [name for name in tensors.networks if name not in kind.network_ids]
    expect(not unknown, f"{own}: networks {unknown}, expected some of {list(kind.network_ids)}")
    missing = [name for name in required if name not in tensors.networks]
    expect(not missing, f"{own} networks {missing} are missing")
    scales, some = len(tensors.planes), "at least one" if kind.layer else "none"
    expect(bool(scales) == bool(kind.layer), f"{own}: {scales} scales of planes, expected {some}")
    expect(not below or len(below.networks) > 1, f"{LAYER_KINDS[1].name} has no head, expected one below {own}")
    channels_below = len(below.planes[0]["xy"]) if below else 0
    for s, planes in enumerate(tensors.planes):
        expect(set(planes) == {p for p, _, _ in PLANES}, f"{own} scale {s}: planes {sorted(planes)}, expected six")
        flat = [name for name, plane in planes.items() if plane.ndim != 3]
        expect(not flat, f"{own} scale {s}: planes {flat} do not have 3 axes")
        channels, first = len(planes["xy"]), channels_below or len(tensors.planes[0]["xy"])
        expect(channels == first, f"{own} scale {s}: {channels} channels, expected {first} as in the first scale")
        expect(min(channels, *plane_sides(planes)) >= 1, f"{own} scale {s}: an empty plane")
    key = tensors.key
    valid = key is None or (kind.layer > 0 and type(key) is int and 0 <= key <= INSTANTS)
    expect(valid, f"{own}: key instant {key!r}, expected None or, in a deformation, an integer 0..{INSTANTS}")
    for name, network in tensors.networks.items():
        expect(len(network) > 0, f"{own} network {name}: no layers")
    shape = Shape.of(tensors, kind, widths, below.channels if below else 0)
    for (_, name, array), expected in zip(arrays_of(tensors, kind), shape.planes + shape.weights, strict=True):
        expect_array(f"{own} {name}", array, np.float32, expected)
    for name, outputs in shape.networks.items():
        wanted = kind.heads(widths).get(name, outputs[-1])
        expect(outputs[-1] == wanted, f"{own} network {name}: {outputs[-1]} outputs, expected {wanted}")


# -- parts without effect ----------------------------------------------------------------------------------------------


def is_zero(tensors: Deformation, head: str) -> bool:
    """Whether the last layer makes a head's residuals 0 everywhere; a key instant cancels the last bias."""
    weight, bias = tensors.networks[head][-1]
    return not weight.any() and (tensors.key is not None or not bias.any())


def without_unread(symbols: Deformation, unit: np.ndarray) -> tuple[Deformation, str, float]:
    """Gives plane cells that no point reads values of little cost. unit: float32 [n, 3], points in 0..1 of the box.

    Returns (symbols, text with the number of these cells, bits saved by order-0 entropy); `symbols` itself if nothing
    changes.
    """
    filled, free, cells, saved = [], 0, 0, 0.0
    for scale in symbols.planes:
        marks = {n: cells_read(scale[n].shape, unit[:, a], unit[:, b] if b < 3 else None) for n, a, b in PLANES}
        found = {name: fill_plane(scale[name], mark) for name, mark in marks.items()}
        filled.append({name: samples for name, (samples, _) in found.items()})
        saved += sum(bits for _, bits in found.values())
        free += sum(int((~mark).sum()) for mark in marks.values())
        cells += sum(mark.size for mark in marks.values())
    if all((new[n] == old[n]).all() for new, old in zip(filled, symbols.planes, strict=True) for n in new):
        return symbols, "", 0.0
    return replace(symbols, planes=tuple(filled)), f"{free:,} of {cells:,} plane cells", max(saved, 0.0)


# -- parameters --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Scale:
    """A scale of a HexPlane: channels, resolution along x, y, z, t, and a predictor id per plane in PLANES' order."""

    channels: int
    sides: tuple[int, int, int, int]
    predictors: tuple[int, ...]


@dataclass(frozen=True)
class Shape:
    """Sizes of a layer's planes and networks. networks: output widths of the linear layers by name. inputs: input
    widths of layer 0's networks by name; None for a deformation, where they follow from the planes and the trunk.
    key: as in Deformation. below: number of features of the planes in the layers below."""

    scales: tuple[Scale, ...]
    networks: dict[str, tuple[int, ...]]
    inputs: dict[str, int] | None
    key: int | None
    below: int

    @staticmethod
    def of(tensors: Deformation, kind: LayerKind, widths: Widths, below: int) -> Shape:
        """Returns the shape of a deformation, without predictors."""
        scales = tuple(Scale(len(scale["xy"]), plane_sides(scale), ()) for scale in tensors.planes)
        networks = {name: tuple(len(bias) for _, bias in network) for name, network in _by_number(tensors, kind)}
        return Shape(scales, networks, None if kind.layer else widths.inputs, tensors.key, below)

    @property
    def channels(self) -> int:
        """As in Deformation."""
        return sum(scale.channels for scale in self.scales)

    @property
    def planes(self) -> list[PlaneShape]:
        """[C, H, W] of all planes, scale by scale."""
        return [shape for s in self.scales for shape in plane_shapes(s.channels, s.sides).values()]

    @property
    def weights(self) -> list[tuple[int, ...]]:
        """Shapes of weight, bias, weight, bias ... of all networks in order."""
        shapes: list[tuple[int, ...]] = []
        for name, widths in self.networks.items():
            read = self.below + self.channels
            width = self.inputs[name] if self.inputs else read if name == TRUNK else self.networks[TRUNK][-1]
            for outputs in widths:
                shapes += [(outputs, width), (outputs,)]
                width = outputs
        return shapes

    def json(self) -> dict[str, Any]:
        """planes: [C, x, y, z, t] per scale. networks: output widths by name. key_instant: normalised time, if any."""
        networks = {name: list(widths) for name, widths in self.networks.items()}
        found = {"planes": [[scale.channels, *scale.sides] for scale in self.scales], "networks": networks}
        return found if self.key is None else found | {"key_instant": instant(self.key)}

    @property
    def symbols(self) -> int:
        """Number of plane samples, weights and biases."""
        return sum(map(math.prod, self.planes)) + sum(map(math.prod, self.weights))


def pack_parameters(
    tensors: Deformation, kind: LayerKind, steps: dict[str, float], predictors: Sequence[int]
) -> dict[int, object]:
    """Returns the entries of the layer parameters for planes and networks; none without networks."""
    if not tensors.networks:
        return {}
    fields: dict[int, object] = {STEPS: [steps[name] for name in kind.step_names]}
    if tensors.planes:
        own = [predictors[first : first + len(PLANES)] for first in range(0, len(predictors), len(PLANES))]
        fields[SCALES] = [
            [len(scale["xy"]), *plane_sides(scale), *ids] for scale, ids in zip(tensors.planes, own, strict=True)
        ]
    networks = tensors.networks.items()
    fields[NETWORKS] = [[kind.network_ids[name], *(len(bias) for _, bias in network)] for name, network in networks]
    if tensors.key is not None:
        fields[KEY] = tensors.key
    return fields


def unpack_parameters(
    fields: Fields, kind: LayerKind, widths: Widths, below: tuple[Scale, ...], later: bool, where: str
) -> tuple[Shape, dict[str, float]]:
    """Returns (shape, steps by name) of a slice, every count within its limit. below: the scales of the layers below.
    later: whether it is not the layer's first slice and so has no networks. Raises subclasses of DecodeError."""
    networks = {} if later else _unpack_networks(fields, kind, widths, where)
    scales = _unpack_scales(fields, where, below) if networks and kind.layer > 0 else ()
    for key, expected in ((STEPS, bool(networks)), (SCALES, bool(scales)), (NETWORKS, bool(networks))):
        if (key in fields) != expected:
            found, wanted = ("missing", "it") if expected else ("present", "none")
            raise Malformed(f"{where}: key {key} is {found}, expected {wanted}")
    instant_code = _unpack_key(fields, kind, networks, where)
    features = sum(scale.channels for scale in below)
    shape = Shape(scales, networks, None if kind.layer else widths.inputs, instant_code, features)
    cells = sum(map(math.prod, shape.planes))
    if cells > MAX_PLANE_CELLS:
        raise LimitExceeded(f"{where}: planes of {cells} cells, limit {MAX_PLANE_CELLS}")
    return shape, _unpack_steps(fields, kind, where) if networks else {}


def _unpack_key(fields: Fields, kind: LayerKind, networks: dict[str, tuple[int, ...]], where: str) -> int | None:
    if KEY not in fields:
        return None
    if kind.layer == 0 or not networks:
        raise Malformed(f"{where}: key {KEY} is present, expected only in a deformation")
    return fields.integer(KEY, INSTANTS)


def _unpack_steps(fields: Fields, kind: LayerKind, where: str) -> dict[str, float]:
    steps = dict(zip(kind.step_names, fields.reals(STEPS, len(kind.step_names)), strict=True))
    for name, step in steps.items():
        if not is_step(step):
            raise Malformed(f"{where}: step {step!r} of {name}, expected a positive normal binary32 value")
    return steps


def _unpack_scales(fields: Fields, where: str, below: tuple[Scale, ...]) -> tuple[Scale, ...]:
    rows = fields.sequence(SCALES)
    as_integer(len(rows), MAX_PLANE_SCALES, f"{where}: number of scales", low=1)
    scales: list[Scale] = []
    for i, row in enumerate(rows):
        channels, *rest = as_list(row, f"{where} scale {i}", 5 + len(PLANES))
        as_integer(channels, MAX_PLANE_CHANNELS, f"{where} scale {i} channels", low=1)
        first = (*below, *scales)[:1]
        if first and channels != first[0].channels:
            raise Malformed(
                f"{where} scale {i}: {channels} channels, expected {first[0].channels} as in the first scale"
            )
        for side in rest[:4]:
            as_integer(side, MAX_PLANE_SIDE, f"{where} scale {i} side", low=1)
        for predictor in rest[4:]:
            as_registered(predictor, PREDICTORS, f"{where} scale {i} predictor")
        scales.append(Scale(channels, tuple(rest[:4]), tuple(rest[4:])))
    return tuple(scales)


def _unpack_networks(fields: Fields, kind: LayerKind, widths: Widths, where: str) -> dict[str, tuple[int, ...]]:
    rows = fields.sequence(NETWORKS) if NETWORKS in fields else []
    names, heads = {number: name for name, number in kind.network_ids.items()}, kind.heads(widths)
    if NETWORKS in fields and not rows:
        raise Malformed(f"{where}: an empty list of networks, expected entries or no list")
    networks: dict[str, tuple[int, ...]] = {}
    last = -1
    for row in rows:
        entry = as_list(row, f"{where} network")
        if not entry:
            raise Malformed(f"{where}: an empty network entry, expected an id and widths")
        number, *outputs = entry
        if as_registered(number, names, f"{where} network id") <= last:
            raise Malformed(f"{where}: network {number} after {last}, expected ascending ids")
        last, name = number, names[number]
        as_integer(len(outputs), MAX_NETWORK_LAYERS, f"{where} network {name} layers", low=1)
        for width in outputs:
            as_integer(width, MAX_NETWORK_WIDTH, f"{where} network {name} width", low=1)
        if outputs[-1] != heads.get(name, outputs[-1]):
            raise Malformed(f"{where} network {name}: {outputs[-1]} outputs, expected {heads[name]}")
        networks[name] = tuple(outputs)
    if kind.layer == 0 and len(networks) != len(names):
        raise Malformed(f"{where}: networks {list(networks)}, expected {list(kind.network_ids)}")
    if networks and kind.layer > 0 and (TRUNK not in networks or len(networks) == 1):
        raise Malformed(f"{where}: networks {list(networks)}, expected '{TRUNK}' and at least one head")
    return networks


# -- sections ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Decorrelated:
    """Symbols as they are coded. predictors: id per plane. planes: int32 [C, H, W] residuals. weights: int32 [n]."""

    predictors: list[int]
    planes: list[np.ndarray]
    weights: list[np.ndarray]

    @property
    def plane_channels(self) -> list[np.ndarray]:
        """int32 [H * W] of each channel of each plane."""
        return [channel.ravel() for plane in self.planes for channel in plane]


def decorrelate(symbols: Deformation, kind: LayerKind) -> Decorrelated:
    """Applies to each plane the predictor with the fewest estimated bits."""
    tensors = [array for *_, array in arrays_of(symbols, kind)]
    count = len(PLANES) * len(symbols.planes)
    chosen = [choose_predictor(plane) for plane in tensors[:count]]
    weights = [array.ravel() for array in tensors[count:]]
    return Decorrelated([p for p, *_ in chosen], [r for _, r, _ in chosen], weights)


def plane_rate_bits(planes: Planes, step: float) -> float:
    """Returns the sum of R(a) of the residuals of float32 planes quantised at `step`, each plane under the predictor
    that `decorrelate` picks."""
    chosen = (choose_predictor(quantise(plane, step, name)) for scale in planes for name, plane in scale.items())
    return sum(histogram(channel.ravel()).rate_bits for _, residuals, _ in chosen for channel in residuals)


def write_sections(coded: Decorrelated, options: EncodeOptions) -> dict[Section, tuple[bytes, float]]:
    """Returns (bytes, sum of R(a)) of each section of mode ans."""
    sections = {}
    if coded.planes:
        sections[Section.PLANES] = write_planes(coded.planes, options.priors, options.effort)
    if coded.weights:
        weights = encode_channels(coded.weights, priors=options.priors, effort=options.effort)
        sections[Section.WEIGHTS] = weights.payload, weights.rate_bits
    return sections


def read_sections(take: Callable[[Section, int], bytes], shape: Shape) -> Deformation:
    """Decodes the symbols in the sections of mode ans. take: (section, number of its symbols) -> its bytes."""
    sizes = [math.prod(one) for one in shape.weights]
    data = take(Section.PLANES, sum(map(math.prod, shape.planes)))
    residuals = read_planes(data, shape.planes) if data else []
    return _restored(shape, residuals, decode_channels(take(Section.WEIGHTS, sum(sizes)), sizes))


def channel_sizes(shape: Shape) -> tuple[list[int], list[int]]:
    """Returns the numbers of symbols in the channels of the planes, and of the weights and biases."""
    return [h * w for c, h, w in shape.planes for _ in range(c)], [math.prod(one) for one in shape.weights]


def from_channels(planes: Sequence[np.ndarray], weights: Sequence[np.ndarray], shape: Shape) -> Deformation:
    """Returns the symbols of planes and networks from their channels int32 [n], the inverse of `decorrelate`."""
    ends = list(accumulate((c for c, _, _ in shape.planes), initial=0))
    residuals = [
        np.concatenate(planes[first:end]).reshape(one)
        for first, end, one in zip(ends, ends[1:], shape.planes, strict=False)
    ]
    return _restored(shape, residuals, weights)


def _restored(shape: Shape, residuals: Sequence[np.ndarray], weights: Sequence[np.ndarray]) -> Deformation:
    if any(magnitude(weight) > MAX_SYMBOL for weight in weights):
        raise Malformed(f"a weight over {MAX_SYMBOL} steps in magnitude")
    predictors = [predictor for scale in shape.scales for predictor in scale.predictors]
    samples = restore(list(zip(predictors, residuals, strict=True)))
    reshaped = [weight.reshape(one) for weight, one in zip(weights, shape.weights, strict=True)]
    depths = {name: len(widths) for name, widths in shape.networks.items()}
    return _assembled(len(shape.scales), depths, shape.key, iter([*samples, *reshaped]))
