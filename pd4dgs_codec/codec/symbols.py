"""A layer as integers: Scene -> LayerSymbols -> Scene. What lies between is exactly what a file stores."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from pd4dgs_codec.attributes.quantise import all_finite, dequantise, quantise
from pd4dgs_codec.attributes.table import ATTRIBUTES, attribute_rows, dequantise_attributes, quantise_attributes
from pd4dgs_codec.codec.kinds import LAYER_KINDS, LayerKind
from pd4dgs_codec.errors import Malformed
from pd4dgs_codec.scene import PLANES, Deformation, Network, Scene, SceneInfo, Steps

Planes = tuple[dict[str, np.ndarray], ...]


@dataclass(frozen=True, eq=False)
class LayerSymbols:
    """What one layer carries.

    anchor_q: int32 [n, 3] voxel indices of the layer's own anchors. mask_increase: int32 [rows before] rise of the
    earlier anchors' mask codes, mask_own: int32 [n] codes of its own. attributes: int32 [68, n].
    planes, networks: int32 symbols, or float32 values if `raw`; networks in the order of their registry ids.
    steps: quantisation steps of this layer's planes (if it has any), then weights, by field of Steps; empty if it has
    no networks.
    """

    kind: LayerKind
    anchor_q: np.ndarray
    mask_increase: np.ndarray
    mask_own: np.ndarray
    attributes: np.ndarray
    planes: Planes
    networks: dict[str, Network]
    steps: dict[str, float]
    raw: bool = False

    def tensors(self) -> Iterator[np.ndarray]:
        """The planes (scale by scale, in PLANES' order), then weight and bias of each linear layer of each network."""
        for scale in self.planes:
            yield from (scale[name] for name, _, _ in PLANES)
        for network in self.networks.values():
            for weight, bias in network:
                yield weight
                yield bias

    def arrays(self) -> list[np.ndarray]:
        """All arrays in their canonical order, the one in which info --hashes digests the integers among them."""
        return [self.anchor_q, self.mask_increase, self.mask_own, self.attributes, *self.tensors()]


def map_deformation(deformation: Deformation, of_planes, of_weights) -> Deformation:
    """`deformation` with of_planes(name, array) and of_weights(name, array) applied to its arrays."""
    planes = tuple({p: of_planes(f"plane {p}", scale[p]) for p, _, _ in PLANES} for scale in deformation.planes)
    return Deformation(planes, map_networks(deformation.networks, of_weights))


def map_networks(networks: dict[str, Network], function) -> dict[str, Network]:
    """`networks` with function(name, array) applied to every weight and bias."""
    return {
        name: tuple((function(f"{name} weight", w), function(f"{name} bias", b)) for w, b in network)
        for name, network in networks.items()
    }


def quantise_deformation(deformation: Deformation, kind: LayerKind, steps: Steps) -> Deformation:
    """int32 symbols of a deformation's planes and networks under the steps of its layer."""
    assert kind.planes_step is not None
    q_planes, q_weights = getattr(steps, kind.planes_step), getattr(steps, kind.weights_step)
    return map_deformation(
        deformation,
        lambda name, x: quantise(x, q_planes, f"{kind.deformation} {name}"),
        lambda name, x: quantise(x, q_weights, f"{kind.deformation} {name}"),
    )


def dequantise_deformation(deformation: Deformation, kind: LayerKind, steps: Steps) -> Deformation:
    """The float32 deformation of those symbols."""
    assert kind.planes_step is not None
    q_planes, q_weights = getattr(steps, kind.planes_step), getattr(steps, kind.weights_step)
    return map_deformation(
        deformation, lambda name, k: dequantise(k, q_planes), lambda name, k: dequantise(k, q_weights)
    )


def layer_symbols(scene: Scene, index: int, raw_deformation: bool = False) -> LayerSymbols:
    """The symbols of scene.layers[index]. Raises EncodeError for a value that has no symbol."""
    kind = LAYER_KINDS[scene.layers[index]]
    first, last = (scene.rows[index - 1] if index else 0), scene.rows[index]
    codes = scene.mask[index].astype(np.int32)
    before = scene.mask[index - 1].astype(np.int32) if index else codes[:0]
    values = {a.name: getattr(scene, a.name)[first:last] for a in ATTRIBUTES}
    planes, networks, fields, raw = _network_symbols(scene, kind, raw_deformation)
    return LayerSymbols(
        kind=kind,
        anchor_q=scene.anchor_q[first:last],
        mask_increase=codes[:first] - before,
        mask_own=codes[first:],
        attributes=quantise_attributes(values, vars(scene.steps)),
        planes=planes,
        networks={name: networks[name] for name in kind.network_ids if name in networks},
        steps={name: getattr(scene.steps, name) for name in fields},
        raw=raw,
    )


def _network_symbols(
    scene: Scene, kind: LayerKind, raw: bool
) -> tuple[Planes, dict[str, Network], tuple[str, ...], bool]:
    """(planes, networks, fields of Steps they use, whether they are float32 values) of one layer."""
    if kind.deformation is None:
        step = getattr(scene.steps, kind.weights_step)
        networks = map_networks(scene.networks, lambda name, x: quantise(x, step, f"scaffold {name}"))
        return (), networks, (kind.weights_step,), False
    deformation = getattr(scene, kind.deformation)
    if deformation is None:
        return (), {}, (), False
    if not raw:
        deformation = quantise_deformation(deformation, kind, scene.steps)
    assert kind.planes_step is not None
    return deformation.planes, deformation.networks, (kind.planes_step, kind.weights_step), raw


def assemble(info: SceneInfo, attribute_steps: dict[str, float], layers: Sequence[LayerSymbols]) -> Scene:
    """The decoded scene of a prefix of layers (clause "dequantisation"), each of which check_last_layer let pass.

    Steps of absent tensors keep Steps' defaults.
    """
    steps = Steps(**attribute_steps, **{k: v for layer in layers for k, v in layer.steps.items()})
    attributes = np.concatenate([layer.attributes for layer in layers], axis=1)
    values = dequantise_attributes(attributes, attribute_steps)
    masks = _mask_codes(layers)
    tensors = {layer.kind.layer: _dequantised_networks(layer, steps) for layer in layers}
    return Scene(
        info=info,
        steps=steps,
        layers=tuple(layer.kind.layer for layer in layers),
        rows=tuple(m.size for m in masks),
        anchor_q=np.concatenate([layer.anchor_q for layer in layers]),
        feature=values["feature"],
        scaling_log=values["scaling_log"],
        offset=values["offset"],
        mask=tuple(m.astype(np.uint8) for m in masks),
        networks=tensors[0].networks,
        global_deformation=tensors.get(1) if 1 in tensors and tensors[1].networks else None,
        local_deformation=tensors.get(2) if 2 in tensors and tensors[2].networks else None,
    )


def _mask_codes(layers: Sequence[LayerSymbols]) -> list[np.ndarray]:
    """int32 codes of all rows so far, per layer: sums of the rises (clause "masks")."""
    masks: list[np.ndarray] = []
    for layer in layers:
        raised = masks[-1] + layer.mask_increase if masks else layer.mask_increase
        masks.append(np.concatenate([raised, layer.mask_own]))
    return masks


def check_last_layer(layers: Sequence[LayerSymbols], voxel_size: float, attribute_steps: dict[str, float]) -> None:
    """The rules for a layer that its payload alone cannot show broken, given the header and the layers before it.

    Raises Malformed if a mask code is above 255, a voxel is taken, or a reconstructed value would not be finite.
    """
    layer, *before = layers[-1], *layers[:-1]
    codes = _mask_codes(layers)[-1]
    if codes.size and codes.max() > 255:
        raise Malformed(f"layer {layer.kind.layer}: mask code {int(codes.max())}, expected at most 255")
    if len(layer.anchor_q) and any(len(other.anchor_q) for other in before):  # within a layer voxels differ anyway
        row = first_duplicate(np.concatenate([other.anchor_q for other in layers]))
        if row is not None:
            raise Malformed(f"voxel {row.tolist()} holds more than one anchor, expected one")
    if not all(all_finite(k, step) for k, step in _with_steps(layer, voxel_size, attribute_steps)):
        raise Malformed(f"layer {layer.kind.layer}: a reconstructed value is not finite")


def _with_steps(
    layer: LayerSymbols, voxel_size: float, attribute_steps: dict[str, float]
) -> Iterator[tuple[np.ndarray, float]]:
    """(symbols, their step) of everything in `layer` that is dequantised."""
    yield layer.anchor_q, voxel_size
    yield from ((rows, attribute_steps[a.name]) for a, rows in attribute_rows(layer.attributes))
    if not layer.raw:
        planes, steps = len(PLANES) * len(layer.planes), list(layer.steps.values())
        yield from ((k, steps[0 if i < planes else -1]) for i, k in enumerate(layer.tensors()))


def rounded(scene: Scene, raw_deformation: bool = False) -> Scene:
    """The scene that the file of a planned scene decodes to. Raises EncodeError for a value that has no symbol."""
    layers = [layer_symbols(scene, i, raw_deformation) for i in range(len(scene.layers))]
    return assemble(scene.info, {a.name: getattr(scene.steps, a.name) for a in ATTRIBUTES}, layers)


def _dequantised_networks(layer: LayerSymbols, steps: Steps) -> Deformation:
    stored = Deformation(layer.planes, layer.networks)
    if layer.raw or not layer.networks:
        return stored
    if layer.kind.deformation is None:
        step = getattr(steps, layer.kind.weights_step)
        return Deformation((), map_networks(layer.networks, lambda name, k: dequantise(k, step)))
    return dequantise_deformation(stored, layer.kind, steps)


def float_tensors(scene: Scene, index: int) -> list[np.ndarray]:
    """The float32 arrays of scene.layers[index] alone: anchor, attributes in the table's order, planes, networks."""
    kind = LAYER_KINDS[scene.layers[index]]
    own = slice(scene.rows[index - 1] if index else 0, scene.rows[index])
    if kind.deformation is None:
        deformation: Deformation | None = Deformation((), scene.networks)
    else:
        deformation = getattr(scene, kind.deformation)
    arrays = [scene.anchor[own], *(getattr(scene, a.name)[own] for a in ATTRIBUTES)]
    if deformation is not None:
        arrays += [scale[name] for scale in deformation.planes for name, _, _ in PLANES]
        ordered = [deformation.networks[name] for name in kind.network_ids if name in deformation.networks]
        arrays += [a for network in ordered for pair in network for a in pair]
    return arrays


def first_duplicate(anchor_q: np.ndarray) -> np.ndarray | None:
    """A row [3] that occurs more than once in anchor_q [N, 3], or None."""
    ordered = anchor_q[np.lexsort(anchor_q.T)]
    same = np.flatnonzero((ordered[1:] == ordered[:-1]).all(axis=1))
    return ordered[same[0]] if same.size else None
