"""The registry of kinds, by role and number: what gives the tensors of a file their meaning (clauses 13.1 and 17.1).

A kind is a module with its number and name, its rules, and the way between tensors and the parts of a `Scene`. The
modules of `format` know forms only; nothing else in the package lists kinds.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Any

from pd4dgs_codec.errors import DecodeError, Malformed, UnsupportedFeature
from pd4dgs_codec.format.quantise import RowTable
from pd4dgs_codec.format.symbols import Growing
from pd4dgs_codec.format.tables import NOTHING, Kind, Tables, Tensors
from pd4dgs_codec.kinds import hexplane, scaffold
from pd4dgs_codec.scene import ATTRIBUTES, PLANES, SCAFFOLD_NETWORKS, Scene, SceneInfo, Steps

SCENES = {scaffold.NUMBER: scaffold}
DEFORMATIONS = {hexplane.NUMBER: hexplane}

#: By layer: what messages and reports call its grids and chains.
NAMES = ("scaffold", "global_deformation", "local_deformation")
#: By layer: the fields of Steps of its grids, None for layer 0, and of its chains.
STEPS = ((None, "weights_scaffold"), ("planes_global", "weights_global"), ("planes_local", "weights_local"))


def step_names(layer: int) -> tuple[str, ...]:
    """Returns the fields of Steps that a layer's grids and chains use."""
    return tuple(name for name in STEPS[layer] if name)


# -- reading -----------------------------------------------------------------------------------------------------------


def check(kind: Kind, table: RowTable, tables: Mapping[int, Tables]) -> None:
    """Checks a header's kind and rows and the last of its layers so far. tables: by layer.

    Raises UnsupportedFeature for a kind outside the registry, Malformed for tensors that break the rules of theirs.
    """
    _known("scene", kind, SCENES)
    widths = scaffold.widths_of(kind, table)
    for layer, own in list(tables.items())[-1:]:
        where = f"layer {layer}"
        if layer == 0:
            scaffold.check(own, widths)
        elif own != NOTHING.tables:
            if own.kind:
                _known(f"{where}: deformation", own.kind, DEFORMATIONS)
            if not (own.kind and own.grids and own.chains) or own.rows:
                raise Malformed(f"{where}: a deformation of rows, or without kind, grids or chains")
            hexplane.check(own, {i: other for i, other in tables.items() if 0 < i < layer}, widths, where)


def _known(what: str, kind: Kind, registry: Mapping[int, Any]) -> None:
    if kind[0] not in registry:
        names = ", ".join(f"{number} ({module.NAME})" for number, module in registry.items())
        raise UnsupportedFeature(f"{what} of kind {kind[0]}, expected {names}")


def scene_of(kind: Kind, table: RowTable, info: SceneInfo, grown: Growing, writeable: bool = True) -> Scene:
    """Returns the scene of the slices so far, of at least one, which `check` has let pass. Scenes share their arrays:
    write to at most one of them."""
    steps = {ATTRIBUTES[tensor.id]: tensor.step for tensor in table.tensors}
    for layer, tensors in grown.tensors.items():
        steps |= _steps(layer, tensors.tables)
    moved = {i: hexplane.deformation_of(tensors) for i, tensors in grown.tensors.items() if i and tensors.weights}
    return scaffold.scene_of(kind, table, info, Steps(**steps), grown, moved, writeable)


def _steps(layer: int, tables: Tables) -> dict[str, float]:
    used = zip(STEPS[layer], (tables.grid_step, tables.chain_step), strict=True)
    return {name: step for name, step in used if name and step}


def json(kind: Kind, table: RowTable) -> dict[str, Any]:
    """Returns the kind and the rows of a header, in the kind's words if it is known and its rules hold."""
    found = {"kind": list(kind), "rows": [[t.id, t.channels, t.step, t.predictor] for t in table.tensors]}
    with suppress(DecodeError):
        check(kind, table, {})
        found |= scaffold.json(kind, table)
    return found


def json_of_layer(kind: Kind, table: RowTable, tables: Mapping[int, Tables]) -> dict[str, Any]:
    """Returns the tables of the last of the layers so far, in the words of its kind as `json` does."""
    (layer, own) = list(tables.items())[-1]
    try:
        check(kind, table, tables)
    except DecodeError:
        return own.json()
    words = hexplane.json_of_layer(own) if layer else scaffold.json_of_layer(own)
    return {"steps": _steps(layer, own), **words}


# -- writing -----------------------------------------------------------------------------------------------------------


def tensors_of(scene: Scene, layer: int) -> Tensors:
    """Returns the values of the grids and chains of a layer."""
    planes, weights = (getattr(scene.steps, name) if name else 0.0 for name in STEPS[layer])
    if layer == 0:
        return scaffold.tensors_of(scene.networks, weights)
    deformation = scene.deformation(layer)
    return NOTHING if deformation is None else hexplane.tensors_of(deformation, planes, weights)


def with_tensors(scene: Scene, layer: int, tensors: Tensors) -> Scene:
    """Returns the scene with these values in a layer; without grids and chains it has no deformation."""
    if layer == 0:
        return replace(scene, networks=scaffold.networks_of(tensors))
    return scene.with_deformation(layer, hexplane.deformation_of(tensors) if tensors.weights else None)


def array_names(layer: int, tables: Tables) -> list[str]:
    """Returns the names of a layer's planes, weights and biases in coding order, such as "planes.0.xy" and
    "mlp.trunk.weight.0"."""
    chains = hexplane.CHAINS if layer else SCAFFOLD_NETWORKS
    planes = [f"planes.{s}.{name}" for s in range(len(tables.grids)) for name, _, _ in PLANES]
    layers = [(chains[chain.id], i) for chain in tables.chains for i in range(len(chain.widths) - 1)]
    return planes + [f"mlp.{name}.{part}.{i}" for name, i in layers for part in ("weight", "bias")]
