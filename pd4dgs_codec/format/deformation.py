"""A layer's planes and networks: their symbols, their parameters in the layer's chunk, and their sections.

This module alone reads and writes what a deformation is made of; `heads` and `omissions` know it too, for the encoder.
The rest of the codec passes a `Deformation` on, of float32 values in a scene and of int32 symbols in a layer. Layer 0
has networks and no planes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

import numpy as np

from pd4dgs_codec.entropy.channels import decode_channels, decode_joined, encode_channels
from pd4dgs_codec.entropy.varint import ByteReader, put_varint
from pd4dgs_codec.errors import LimitExceeded, Malformed, UnsupportedFeature
from pd4dgs_codec.format.canonical import Fields, as_integer, as_list, as_registered
from pd4dgs_codec.format.kinds import LayerKind, Section
from pd4dgs_codec.format.limits import (
    MAX_NETWORK_LAYERS,
    MAX_NETWORK_WIDTH,
    MAX_PLANE_CELLS,
    MAX_PLANE_CHANNELS,
    MAX_PLANE_SCALES,
    MAX_PLANE_SIDE,
)
from pd4dgs_codec.format.options import EncodeOptions
from pd4dgs_codec.format.planes import PREDICTORS, choose_predictor, restore
from pd4dgs_codec.format.quantise import MAX_SYMBOL, dequantise, is_step, magnitude, quantise
from pd4dgs_codec.format.stages import (
    PLAIN,
    STAGED,
    Activity,
    CodedSection,
    Group,
    Places,
    activity_classes,
    cheapest_class_count,
    coded_stages,
    parts_of,
    read_class_count,
    read_stages,
    smaller_form,
)
from pd4dgs_codec.scene import PLANES, TRUNK, Deformation, Steps, Widths, plane_sides

# Keys of the layer parameters.
STEPS, SCALES, NETWORKS = 3, 4, 5

PlaneShape = tuple[int, int, int]  #: channels, rows, columns

NOTHING = Deformation((), {})  #: neither planes nor networks


# -- symbols -----------------------------------------------------------------------------------------------------------


def mapped(
    tensors: Deformation, kind: LayerKind, function: Callable[[str, str, np.ndarray], np.ndarray]
) -> Deformation:
    """`tensors` with function(name of its step, name for messages, array) in place of every array; networks in the
    order of their numbers."""
    planes = tuple(
        {name: function(str(kind.planes_step), f"plane {name}", scale[name]) for name, _, _ in PLANES}
        for scale in tensors.planes
    )
    step = kind.weights_step
    networks = {
        name: tuple(
            (function(step, f"{name} weight", w), function(step, f"{name} bias", b)) for w, b in tensors.networks[name]
        )
        for name in kind.network_ids
        if name in tensors.networks
    }
    return Deformation(planes, networks)


def quantise_tensors(tensors: Deformation, kind: LayerKind, steps: Steps) -> Deformation:
    """int32 symbols of a layer's planes and networks. Raises EncodeError for a value that has none."""
    return mapped(tensors, kind, lambda of, name, x: quantise(x, getattr(steps, of), f"{kind.name} {name}"))


def dequantise_tensors(symbols: Deformation, kind: LayerKind, steps: Steps) -> Deformation:
    """The float32 planes and networks that the symbols stand for."""
    return mapped(symbols, kind, lambda of, _, k: dequantise(k, getattr(steps, of)))


def arrays_of(tensors: Deformation, kind: LayerKind) -> Iterator[tuple[str, np.ndarray]]:
    """(name of its step, array) in coding order: the planes, scale by scale, then weight and bias of each linear layer
    of each network."""
    for scale in tensors.planes:
        yield from ((str(kind.planes_step), scale[name]) for name, _, _ in PLANES)
    for network in (tensors.networks[name] for name in kind.network_ids if name in tensors.networks):
        yield from ((kind.weights_step, array) for pair in network for array in pair)


def layer_steps(steps: Steps, kind: LayerKind, tensors: Deformation) -> dict[str, float]:
    """The steps in a layer's chunk by name; none if it has no networks."""
    return {name: float(getattr(steps, name)) for name in kind.step_names} if tensors.networks else {}


# -- parameters --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Scale:
    """A scale of a HexPlane: channels, resolution along x, y, z, t, and a predictor id per plane in PLANES' order."""

    channels: int
    sides: tuple[int, int, int, int]
    predictors: tuple[int, ...]


@dataclass(frozen=True)
class Shape:
    """Sizes of a layer's planes and networks. networks: by name the outputs of its linear layers. inputs: input width
    of the networks of layer 0, 0 for a deformation, whose widths follow from the scales and the trunk."""

    scales: tuple[Scale, ...] = ()
    networks: dict[str, tuple[int, ...]] | None = None
    inputs: int = 0

    @property
    def planes(self) -> list[PlaneShape]:
        """[C, H, W] of all planes, scale by scale."""
        return [(s.channels, s.sides[b], s.sides[a]) for s in self.scales for _, a, b in PLANES]

    @property
    def weights(self) -> list[tuple[int, ...]]:
        """Shapes of weight, bias, weight, bias ... of all networks in order."""
        shapes: list[tuple[int, ...]] = []
        networks = self.networks or {}
        for name, widths in networks.items():
            features = sum(scale.channels for scale in self.scales)
            width = self.inputs or (features if name == TRUNK else networks[TRUNK][-1])
            for outputs in widths:
                shapes += [(outputs, width), (outputs,)]
                width = outputs
        return shapes

    def json(self) -> dict[str, Any]:
        """planes: [C, x, y, z, t] per scale. networks: output widths by name."""
        networks = {name: list(widths) for name, widths in (self.networks or {}).items()}
        return {"planes": [[scale.channels, *scale.sides] for scale in self.scales], "networks": networks}

    @property
    def symbols(self) -> int:
        """Plane samples, weights and biases."""
        return sum(map(math.prod, self.planes)) + sum(map(math.prod, self.weights))


def pack_parameters(
    tensors: Deformation, kind: LayerKind, steps: dict[str, float], predictors: Sequence[int]
) -> dict[int, object]:
    """The entries of the layer parameters for planes and networks; none without networks."""
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
    return fields


def unpack_parameters(
    fields: Fields, kind: LayerKind, widths: Widths, later: bool, where: str
) -> tuple[Shape, dict[str, float]]:
    """(shape, steps by name) of a slice; every count is within its limit. later: behind the first of its layer, where
    it has neither planes nor networks. Raises DecodeError's subclasses."""
    networks = {} if later else _unpack_networks(fields, kind, widths, where)
    scales = _unpack_scales(fields, where) if networks and kind.layer > 0 else ()
    for key, expected in ((STEPS, bool(networks)), (SCALES, bool(scales)), (NETWORKS, bool(networks))):
        if (key in fields) != expected:
            found, wanted = ("missing", "it") if expected else ("there", "no such key")
            raise Malformed(f"{where}: key {key} is {found}, expected {wanted}")
    shape = Shape(scales, networks, 0 if kind.layer else widths.inputs)
    cells = sum(map(math.prod, shape.planes))
    if cells > MAX_PLANE_CELLS:
        raise LimitExceeded(f"{where}: planes of {cells} cells, limit {MAX_PLANE_CELLS}")
    return shape, _unpack_steps(fields, kind, where) if networks else {}


def _unpack_steps(fields: Fields, kind: LayerKind, where: str) -> dict[str, float]:
    steps = dict(zip(kind.step_names, fields.reals(STEPS, len(kind.step_names)), strict=True))
    for name, step in steps.items():
        if not is_step(step):
            raise Malformed(f"{where}: step {step!r} of {name}, expected a positive normal binary32 value")
    return steps


def _unpack_scales(fields: Fields, where: str) -> tuple[Scale, ...]:
    rows = fields.sequence(SCALES)
    as_integer(len(rows), MAX_PLANE_SCALES, f"{where}: number of scales", low=1)
    scales: list[Scale] = []
    for i, row in enumerate(rows):
        channels, *rest = as_list(row, f"{where} scale {i}", 5 + len(PLANES))
        as_integer(channels, MAX_PLANE_CHANNELS, f"{where} scale {i} channels", low=1)
        if scales and channels != scales[0].channels:
            raise Malformed(f"{where} scale {i}: {channels} channels, expected {scales[0].channels} as in scale 0")
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
        raise Malformed(f"{where}: an empty list of networks, expected some or no list")
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
    """Each plane under the predictor that is likely to code it for the fewest bits."""
    tensors = [array for _, array in arrays_of(symbols, kind)]
    count = len(PLANES) * len(symbols.planes)
    chosen = [choose_predictor(plane) for plane in tensors[:count]]
    return Decorrelated([p for p, _ in chosen], [r for _, r in chosen], [array.ravel() for array in tensors[count:]])


def write_sections(coded: Decorrelated, options: EncodeOptions) -> dict[Section, tuple[bytes, float]]:
    """(bytes, sum of R(a)) of the sections of mode ans."""
    sections = {}
    if coded.planes:
        sections[Section.PLANES] = write_planes(coded.planes, options.priors, options.effort)
    if coded.weights:
        weights = encode_channels(coded.weights, priors=options.priors, effort=options.effort)
        sections[Section.WEIGHTS] = weights.payload, weights.rate_bits
    return sections


def read_sections(take: Callable[[Section, int], bytes], shape: Shape) -> Deformation:
    """The symbols in the sections of mode ans. take: (section, number of its symbols) -> its bytes."""
    sizes = [math.prod(one) for one in shape.weights]
    data = take(Section.PLANES, sum(map(math.prod, shape.planes)))
    residuals = read_planes(data, shape.planes) if data else []
    weights = take(Section.WEIGHTS, sum(sizes))
    return _restored(shape, residuals, decode_channels(weights, sizes) if weights else [])


def channel_sizes(shape: Shape) -> tuple[list[int], list[int]]:
    """Symbols in each channel of the planes, and of the weights and biases."""
    return [h * w for c, h, w in shape.planes for _ in range(c)], [math.prod(one) for one in shape.weights]


def from_channels(planes: Sequence[np.ndarray], weights: Sequence[np.ndarray], shape: Shape) -> Deformation:
    """The symbols of the channels int32 [n] of planes and weights."""
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
    samples = iter(restore(list(zip(predictors, residuals, strict=True))))
    planes = tuple({name: next(samples) for name, _, _ in PLANES} for _ in shape.scales)
    rest = iter(weight.reshape(one) for weight, one in zip(weights, shape.weights, strict=True))
    networks = {
        name: tuple((next(rest), next(rest)) for _ in widths) for name, widths in (shape.networks or {}).items()
    }
    return Deformation(planes, networks)


# -- the planes section of mode ans (clause 8.8) -----------------------------------------------------------------------


def write_planes(residuals: Sequence[np.ndarray], priors: str, effort: int) -> tuple[bytes, float]:
    """(section bytes, sum of R(a) over all channels) of residuals int32 [C, H, W] per plane, in the smaller form."""
    channels = [channel.ravel() for plane in residuals for channel in plane]
    section, rate_bits = smaller_form(lambda: channels, lambda: _write_staged(residuals, effort), priors, effort)
    return section.data, rate_bits


def read_planes(data: bytes, shapes: Sequence[PlaneShape]) -> list[np.ndarray]:
    """Residuals int32 [C, H, W] per plane; the inverse of write_planes. shapes were checked against the limits."""
    reader = ByteReader(data)
    form = reader.byte("the form of the planes")
    if form == PLAIN:
        symbols = decode_joined(reader.rest(), [h * w for c, h, w in shapes for _ in range(c)])
        ends = accumulate(c * h * w for c, h, w in shapes)
        return [symbols[end - c * h * w : end].reshape(c, h, w) for (c, h, w), end in zip(shapes, ends, strict=True)]
    if form != STAGED:
        raise UnsupportedFeature(f"form {form} of the planes, expected {PLAIN} or {STAGED}")
    number = _stage_count(shapes)
    counts = [read_class_count(reader, stage) for stage in range(1, number)]
    planes = [np.zeros((c, h * w), np.int32) for c, h, w in shapes]
    read_stages(reader, number, _groups(planes, shapes, counts))
    return [plane.reshape(shape) for plane, shape in zip(planes, shapes, strict=True)]


def _write_staged(residuals: Sequence[np.ndarray], effort: int) -> CodedSection:
    shapes: list[PlaneShape] = [plane.shape for plane in residuals]
    planes = [plane.reshape(len(plane), -1) for plane in residuals]
    counts, activities = [], [Activity(plane.shape[1]) for plane in planes]
    for stage in range(_stage_count(shapes)):
        first, end = _bounds(stage)
        if stage:
            groups = [
                (plane[first:end], _around(activity.now, shape))
                for plane, activity, shape in zip(planes, activities, shapes, strict=True)
            ]
            counts.append(cheapest_class_count(groups))
        for plane, activity in zip(planes, activities, strict=True):
            activity.add(plane[first:end])
    out = bytearray([STAGED])
    for count in counts:
        put_varint(out, count)
    return coded_stages(out, map(parts_of, _groups(planes, shapes, counts)), effort)


def _stage_count(shapes: Sequence[PlaneShape]) -> int:
    """All planes of a layer have the same number of channels."""
    return max(1, (shapes[0][0] - 1).bit_length())


def _bounds(stage: int) -> tuple[int, int]:
    """Its first channel, and that of the next stage."""
    return (1 << stage if stage else 0), 2 << stage


def _groups(planes: Sequence[np.ndarray], shapes: Sequence[PlaneShape], counts: Sequence[int]) -> Iterator[list[Group]]:
    """Per stage, what it codes of each plane. `planes` int32 [C, H * W] are read only as far as the stages before
    reach."""
    activities = [Activity(plane.shape[1]) for plane in planes]
    for stage, count in enumerate((1, *counts)):
        first, end = _bounds(stage)
        groups: list[Group] = []
        for plane, activity, shape in zip(planes, activities, shapes, strict=True):
            places = Places.whole(plane.shape[1])
            if count > 1:
                places = Places.by(activity_classes(_around(activity.now, shape), count), count)
            groups.append((plane[first:end], places))
        yield groups
        if any(later > 1 for later in counts[stage:]):
            for plane, activity in zip(planes, activities, strict=True):
                activity.add(plane[first:end])


def _around(activity: np.ndarray, shape: PlaneShape) -> np.ndarray:
    """[H * W]: activity [H * W] summed over 3 x 3 cells, the border repeated."""
    _, height, width = shape
    cells = activity.reshape(height, width)
    around: np.ndarray = _of_three(_of_three(cells).T).T.ravel()
    return around


def _of_three(cells: np.ndarray) -> np.ndarray:
    """[H, W]: each cell with the one before and the one behind it in its row, the first and the last repeated."""
    sums: np.ndarray = cells.copy(order="K")
    sums[:, 1:] += cells[:, :-1]
    sums[:, :-1] += cells[:, 1:]
    sums[:, 0] += cells[:, 0]
    sums[:, -1] += cells[:, -1]
    return sums
