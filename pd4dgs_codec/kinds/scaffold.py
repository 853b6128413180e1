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
from pd4dgs_codec.tensors.quantise import RowTable
from pd4dgs_codec.tensors.tables import Chain, Kind, Tables, Tensors

NUMBER, NAME = 0, "scaffold"


def kind_of(widths: Widths) -> Kind:
    """Returns the integers of the kind."""
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


def tensors_of(networks: Mapping[str, Network], step: float) -> Tensors:
    """Returns the chains of layer 0."""
    found = [networks[name] for name in SCAFFOLD_NETWORKS]
    return chains_of(dict(enumerate(found)), step)


def chains_of(networks: Mapping[int, Network], step: float) -> Tensors:
    """Returns networks by ascending id as chains."""
    chains = [Chain(i, (net[0][0].shape[1], *(len(bias) for _, bias in net))) for i, net in networks.items()]
    weights = [array for net in networks.values() for pair in net for array in pair]
    return Tensors(Tables(chains=tuple(chains), chain_step=step if chains else 0.0), (), weights)


def networks_of(tensors: Tensors) -> dict[str, Network]:
    """The inverse of `tensors_of`."""
    return {SCAFFOLD_NETWORKS[i]: network for i, network in tensors.chains.items()}


def json(kind: Kind, table: RowTable) -> dict[str, Any]:
    """Returns the header's widths and steps."""
    widths = widths_of(kind, table)
    return {
        "feature_width": widths.feature,
        "slots": widths.slots,
        "view_dependent": list(widths.viewing),
        "steps": {ATTRIBUTES[tensor.id]: tensor.step for tensor in table.tensors},
    }


def json_of_layer(tables: Tables) -> dict[str, Any]:
    """networks: output widths by name. planes: none."""
    return {"planes": [], "networks": {SCAFFOLD_NETWORKS[chain.id]: list(chain.widths[1:]) for chain in tables.chains}}


def scene_of(
    kind: Kind,
    table: RowTable,
    common: Mapping[str, Any],
    rows: Sequence[np.ndarray],
    steps: Steps,
    networks: dict[str, Network],
    deformations: Mapping[int, Deformation],
) -> Scene:
    """Returns a scene. common: arguments of `LayeredScene`. rows: float32 [N, C] of each tensor. deformations: by
    layer."""
    shapes = widths_of(kind, table).attributes.items()
    named: dict[str, Any] = {name: x.reshape(-1, *shape) for (name, shape), x in zip(shapes, rows, strict=True)}
    return Scene(
        **common,
        **named,
        steps=steps,
        networks=networks,
        global_deformation=deformations.get(1),
        local_deformation=deformations.get(2),
    )
