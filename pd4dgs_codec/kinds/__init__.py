"""The registry of kinds, by role and number: what gives the tensors of a file their meaning (clauses 13.1 and 17.1).

A kind is a module with its number and name, its rules, and the way between tensors and the parts of a `Scene`. The
modules of `format` know forms only; nothing else in the package lists kinds.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from pd4dgs_codec.errors import DecodeError, Malformed, UnsupportedFeature
from pd4dgs_codec.kinds import hexplane, scaffold, splats, tracks
from pd4dgs_codec.kinds.splats import SplatScene
from pd4dgs_codec.scene import ATTRIBUTES, PLANES, SCAFFOLD_NETWORKS, Grading, Scene, SceneInfo, Steps
from pd4dgs_codec.tensors.quantise import Rows, RowTable, quantise
from pd4dgs_codec.tensors.symbols import Growing
from pd4dgs_codec.tensors.tables import NOTHING, Kind, Tables, Tensors

#: A scene of any kind.
AnyScene = Scene | SplatScene

SCENES = {scaffold.NUMBER: scaffold, splats.NUMBER: splats}
DEFORMATIONS = {hexplane.NUMBER: hexplane, tracks.NUMBER: tracks}
#: The kind of deformation of each kind of scene.
MOVED_BY = {scaffold.NUMBER: hexplane, splats.NUMBER: tracks}

#: By layer: what messages and reports call the grids and chains of a scaffold.
NAMES = ("scaffold", "global_deformation", "local_deformation")
#: By layer: the fields of Steps of its grids, None for layer 0, and of its chains.
STEPS = ((None, "weights_scaffold"), ("planes_global", "weights_global"), ("planes_local", "weights_local"))


def step_names(layer: int) -> tuple[str, ...]:
    """Returns the fields of Steps that a layer's grids and chains use."""
    return tuple(name for name in STEPS[layer] if name)


# -- reading -----------------------------------------------------------------------------------------------------------


def check(kind: Kind, table: RowTable, layers: Mapping[int, Tensors]) -> None:
    """Checks a header's kind and rows and the last of its layers so far. layers: by number, the integers of their
    tensors, or the tables alone.

    Raises UnsupportedFeature for a kind outside the registry, Malformed for tensors that break the rules of theirs.
    """
    widths = _known("scene", kind, SCENES).widths_of(kind, table)
    for layer, own in list(layers.items())[-1:]:
        where, tables = f"layer {layer}", own.tables
        if layer == 0:
            SCENES[kind[0]].check(tables, widths)
        elif tables != NOTHING.tables:
            found = tables.kind and _known(f"{where}: deformation", tables.kind, DEFORMATIONS)
            expected = MOVED_BY[kind[0]]
            if found is not expected:
                stated = found.NAME if found else "without a kind"
                raise Malformed(f"{where}: deformation {stated}, expected {expected.NAME}")
            expected.check(own, {i: other.tables for i, other in layers.items() if 0 < i < layer}, widths, where)


def _known(what: str, kind: Kind, registry: Mapping[int, Any]) -> Any:
    if kind[0] not in registry:
        names = ", ".join(f"{number} ({module.NAME})" for number, module in registry.items())
        raise UnsupportedFeature(f"{what} of kind {kind[0]}, expected {names}")
    return registry[kind[0]]


def scene_of(kind: Kind, table: RowTable, info: SceneInfo, grown: Growing, writeable: bool = True) -> AnyScene:
    """Returns the scene of the slices so far, of at least one, which `check` has let pass. Scenes share their arrays:
    write to at most one of them."""
    (anchor_q, classes, *rows), codes, layer_rows = grown.arrays(writeable)
    common = {
        "info": info,
        "layers": tuple(grown.tensors),
        "rows": tuple(len(own) for own in codes),
        "anchor_q": anchor_q,
        "mask": tuple(codes),
        "grading": Grading(classes, table.centre_values) if table.graded else None,
        "fills": tuple(grown.fills.values()),
    }
    if kind[0] == splats.NUMBER:
        pairs = zip(grown.tensors.items(), layer_rows, strict=True)
        return splats.scene_of(table, common, rows, {i: tracks.tracks_of(own, x) for (i, own), x in pairs if x})
    steps = {ATTRIBUTES[tensor.id]: tensor.step for tensor in table.tensors}
    for layer, tensors in grown.tensors.items():
        steps |= _steps(layer, tensors.tables)
    moved = {i: hexplane.deformation_of(tensors) for i, tensors in grown.tensors.items() if i and tensors.weights}
    networks = scaffold.networks_of(grown.tensors[0])
    return scaffold.scene_of(kind, table, common, rows, Steps(**steps), networks, moved)


def _steps(layer: int, tables: Tables) -> dict[str, float]:
    used = zip(STEPS[layer], (tables.grid_step, tables.chain_step), strict=True)
    return {name: step for name, step in used if name and step}


def json(kind: Kind, table: RowTable) -> dict[str, Any]:
    """Returns the kind and the rows of a header, in the kind's words if it is known and its rules hold."""
    found = {"kind": list(kind), "rows": [[t.id, t.channels, t.step, t.predictor] for t in table.tensors]}
    with suppress(DecodeError):
        check(kind, table, {})
        found |= SCENES[kind[0]].json(kind, table)
    return found


def json_of_layer(kind: Kind, table: RowTable, layers: Mapping[int, Tables]) -> dict[str, Any]:
    """Returns the tables of the last of the layers so far, in the words of its kind as `json` does."""
    (layer, own) = list(layers.items())[-1]
    try:  # without tables, layer 0 may be one that adds to a base
        found = {number: Tensors(tables) for number, tables in layers.items()}
        check(kind, table, found if layer or own != NOTHING.tables else {})
    except DecodeError:
        return own.json()
    if kind[0] == splats.NUMBER:
        return tracks.json_of_layer(own)
    words = hexplane.json_of_layer(own) if layer else scaffold.json_of_layer(own)
    return {"steps": _steps(layer, own), **words}


# -- writing -----------------------------------------------------------------------------------------------------------


def kind_of(scene: AnyScene) -> Kind:
    """Returns the integers of a scene's kind."""
    return (splats.NUMBER,) if isinstance(scene, SplatScene) else scaffold.kind_of(scene.widths)


def row_table(scene: AnyScene) -> RowTable:
    """Returns the table of a scene's rows. Raises EncodeError for a centre without a symbol."""
    names = list(splats.TENSORS) if isinstance(scene, SplatScene) else ATTRIBUTES
    sizes = {name: math.prod(values.shape[1:]) for name, values in scene.attributes.items()}
    table = RowTable(tuple(Rows(names.index(name), size, scene.row_steps[name]) for name, size in sizes.items()))
    if scene.grading is None:
        return table
    centre = [
        quantise(x, tensor.step, f"centre of {names[tensor.id]}") for tensor, x in table.of_each(scene.grading.centre)
    ]
    return RowTable(table.tensors, np.concatenate(centre))


def layer_name(scene: AnyScene, layer: int) -> str:
    """Returns what messages and reports call the grids and chains of a layer."""
    return f"tracks of layer {layer}" if isinstance(scene, SplatScene) else NAMES[layer]


def utility_of(scene: AnyScene) -> np.ndarray:
    """Estimates each anchor's utility without views, float32 [N]: its mask code in the highest layer, and opacity if
    it has one, times the largest area, relative to other anchors, that its Gaussians may cover."""
    opacity, logs = scene.mask[-1].astype(np.float32), scene.attributes.get("scaling_log")
    if isinstance(scene, SplatScene):
        opacity, logs = opacity * splats.sigmoid(scene.tensors["opacity"][:, 0]), scene.tensors["scale"]
    assert logs is not None
    area = np.sort(logs[:, -3:], axis=1)[:, 1:].sum(axis=1)
    utility: np.ndarray = opacity * np.exp(area - area.max(initial=0))
    return utility


def tensors_of(scene: AnyScene, layer: int) -> Tensors:
    """Returns the values of the grids and chains of a layer."""
    if isinstance(scene, SplatScene):
        own = scene.deformation(layer)
        return NOTHING if own is None else tracks.tensors_of(own)
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
    if tables.kind[:1] == (tracks.NUMBER,):
        return tracks.array_names(tables)
    chains = hexplane.CHAINS if layer else SCAFFOLD_NETWORKS
    planes = [f"planes.{s}.{name}" for s in range(len(tables.grids)) for name, _, _ in PLANES]
    layers = [(chains[chain.id], i) for chain in tables.chains for i in range(len(chain.widths) - 1)]
    return planes + [f"mlp.{name}.{part}.{i}" for name, i in layers for part in ("weight", "bias")]
