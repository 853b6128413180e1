"""The scene kind "scaffold": anchors that spawn Gaussians by networks of layer 0 (clause 13.2).

Parameters: [G, V], the slots and the bits of the networks that take the view direction.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pd4dgs_codec.errors import Malformed
from pd4dgs_codec.scene import (
    ATTRIBUTES,
    MAX_FEATURE,
    MAX_SLOTS,
    SCAFFOLD_NETWORKS,
    Deformation,
    Network,
    Scene,
    Steps,
    Widths,
)
from pd4dgs_codec.tensors.quantise import RowTable, expect, expect_array
from pd4dgs_codec.tensors.tables import Chain, Kind, Tables, Tensors

NUMBER, NAME = 0, "scaffold"
SCENE, TENSORS = Scene, ATTRIBUTES

#: By layer: the fields of Steps of its grids, None for layer 0, and of its chains.
STEPS = ((None, "weights_scaffold"), ("planes_global", "weights_global"), ("planes_local", "weights_local"))


def step_names(layer: int) -> tuple[str, ...]:
    """Returns the fields of Steps that a layer's grids and chains use."""
    return tuple(name for name in STEPS[layer] if name)


def steps_of(tables: Tables, layer: int) -> dict[str, float]:
    """Returns the steps of a layer's grids and chains, as far as it has any, by the fields of Steps."""
    used = zip(STEPS[layer], (tables.grid_step, tables.chain_step), strict=True)
    return {name: step for name, step in used if name and step}


def kind_of(scene: Scene) -> Kind:
    """Returns the integers of the kind."""
    widths = scene.widths
    return NUMBER, widths.slots, sum(1 << SCAFFOLD_NETWORKS.index(name) for name in widths.viewing)


def widths_of(kind: Kind, table: RowTable) -> Widths:
    """Returns the widths that a header states. Raises Malformed if it breaks the rules of the kind."""
    if len(kind) != 3 or not (1 <= kind[1] <= MAX_SLOTS and kind[2] < 1 << len(SCAFFOLD_NETWORKS)):
        raise Malformed(f"header: kind {list(kind)}, expected [{NUMBER}, 1..{MAX_SLOTS}, 0..7]")
    found = [(tensor.id, tensor.channels) for tensor in table.tensors]
    viewing = tuple(name for i, name in enumerate(SCAFFOLD_NETWORKS) if kind[2] >> i & 1)
    widths = Widths(min(found[0][1], MAX_FEATURE), kind[1], table.graded, viewing)
    expected = list(enumerate(math.prod(shape) for shape in widths.attributes.values()))
    if found != expected:
        raise Malformed(f"header: rows {found} (id, channels), expected {expected}")
    return widths


def check(tables: Tables, widths: Widths) -> None:
    """Raises Malformed if layer 0 breaks the rules of the kind."""
    if tables.grids or tables.kind or tables.rows:
        raise Malformed("layer 0: grids, layer rows or a deformation, expected chains only")
    found = [(chain.id, chain.widths[0], chain.widths[-1]) for chain in tables.chains]
    both = zip(widths.inputs.values(), widths.networks.values(), strict=True)
    expected = [(i, inputs, outputs) for i, (inputs, outputs) in enumerate(both)]
    if found != expected:
        raise Malformed(f"layer 0: chains {found} (id, inputs, outputs), expected {expected}")


def check_arrays(scene: Scene, layer: int, own: str) -> None:
    """Raises EncodeError for rows and networks of other axes, sizes and names than those of a scaffold."""
    for name, axes in (("feature", 2), ("offset", 3)):
        found = scene.attributes[name].shape
        expect(len(found) == axes, f"{name}: an array of {len(found)} axes, expected {axes}")
    widths = scene.widths
    for what, width, limit in (("feature width", widths.feature, MAX_FEATURE), ("slots", widths.slots, MAX_SLOTS)):
        expect(1 <= width <= limit, f"{what}: {width}, expected 1..{limit}")
    for name, shape in widths.attributes.items():
        expect_array(name, scene.attributes[name], np.float32, (scene.rows[-1], *shape))
    check_networks(scene.networks, SCAFFOLD_NETWORKS, SCAFFOLD_NETWORKS, own)


def check_networks(given: Mapping[str, Network], known: Sequence[str], required: Sequence[str], own: str) -> None:
    """Raises EncodeError for unknown or missing networks, or other axes than of weight and bias."""
    unknown = [name for name in given if name not in known]
    expect(not unknown, f"{own}: networks {unknown}, expected some of {list(known)}")
    missing = [name for name in required if name not in given]
    expect(not missing, f"{own}: networks {missing} are missing")
    for name, network in given.items():
        axes = {(weight.ndim, bias.ndim) for weight, bias in network}
        expect(axes == {(2, 1)}, f"{own}: network {name}: no layers, or other axes than of weight and bias")


def tensors_of(scene: Scene, layer: int) -> Tensors:
    """Returns the chains of layer 0."""
    found = [scene.networks[name] for name in SCAFFOLD_NETWORKS]
    return chains_of(dict(enumerate(found)), scene.steps.weights_scaffold)


def chains_of(networks: Mapping[int, Network], step: float) -> Tensors:
    """Returns networks by ascending id as chains."""
    chains = [Chain(i, (net[0][0].shape[1], *(len(bias) for _, bias in net))) for i, net in networks.items()]
    weights = [array for net in networks.values() for pair in net for array in pair]
    return Tensors(Tables(chains=tuple(chains), chain_step=step if chains else 0.0), (), weights)


def array_names(tables: Tables, chains: Sequence[str] = SCAFFOLD_NETWORKS) -> list[str]:
    """Returns the names of the weights and biases in coding order. chains: the names of chains by id."""
    layers = [(chains[chain.id], i) for chain in tables.chains for i in range(len(chain.widths) - 1)]
    return [f"mlp.{name}.{part}.{i}" for name, i in layers for part in ("weight", "bias")]


def json(kind: Kind, table: RowTable) -> dict[str, Any]:
    """Returns the header's widths and steps."""
    widths = widths_of(kind, table)
    return {
        "feature_width": widths.feature,
        "slots": widths.slots,
        "view_dependent": list(widths.viewing),
        "steps": {ATTRIBUTES[tensor.id]: tensor.step for tensor in table.tensors},
    }


def json_of_layer(tables: Tables, layer: int, chains: Sequence[str] = SCAFFOLD_NETWORKS) -> dict[str, Any]:
    """planes: [C, x, y, z, t] per scale. networks: output widths by name."""
    return {
        "steps": steps_of(tables, layer),
        "planes": [[grid.channels, *grid.sides] for grid in tables.grids],
        "networks": {chains[chain.id]: list(chain.widths[1:]) for chain in tables.chains},
    }


def scene_of(
    kind: Kind,
    table: RowTable,
    common: Mapping[str, Any],
    rows: Sequence[np.ndarray],
    tensors: Mapping[int, Tensors],
    deformations: Mapping[int, Deformation],
) -> Scene:
    """Returns a scene. common: arguments of `LayeredScene`. rows: float32 [N, C] of each tensor. tensors, deformations:
    by layer."""
    shapes = widths_of(kind, table).attributes.items()
    steps = {ATTRIBUTES[tensor.id]: tensor.step for tensor in table.tensors}
    for layer, own in tensors.items():
        steps |= steps_of(own.tables, layer)
    named: dict[str, Any] = {name: x.reshape(-1, *shape) for (name, shape), x in zip(shapes, rows, strict=True)}
    return Scene(
        **common,
        **named,
        steps=Steps(**steps),
        networks={SCAFFOLD_NETWORKS[i]: network for i, network in tensors[0].chains.items()},
        global_deformation=deformations.get(1),
        local_deformation=deformations.get(2),
    )
