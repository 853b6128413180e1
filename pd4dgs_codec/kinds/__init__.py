"""The registry of kinds, by role and number: what gives the tensors of a file their meaning (clauses 13.1 and 17.1).

Every module of this package with a NUMBER and a NAME is a kind, and nothing else lists kinds. Errors are those that the
functions here document.

Both roles have `check`, of the tensors of a file, `check_arrays`, of those that users give, `tensors_of`, `array_names`
and `json_of_layer`. A kind of scene also has SCENE, its class; TENSORS, the names of rows by number; `widths_of` a
header, `kind_of`, `scene_of` and `json`; without tensors in layer 0, neither `check_arrays`, `tensors_of` nor
`array_names`. A kind of deformation also has OF, the name of the scenes that it moves; DEFORMATION, its class;
`deformation_of` and, if it has layer rows, `rows_of`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from importlib import import_module
from pkgutil import iter_modules
from types import ModuleType
from typing import Any

import numpy as np

from pd4dgs_codec.errors import DecodeError, Malformed, UnsupportedFeature
from pd4dgs_codec.scene import Grading, LayeredScene, SceneInfo
from pd4dgs_codec.tensors.quantise import Rows, RowTable, quantise
from pd4dgs_codec.tensors.symbols import Growing
from pd4dgs_codec.tensors.tables import NOTHING, Kind, Tables, Tensors

#: A scene of any kind.
AnyScene = LayeredScene


def _registry(role: str) -> dict[int, ModuleType]:
    """Returns the modules that have an attribute `role`, by ascending number."""
    modules = [import_module(f"{__name__}.{found.name}") for found in iter_modules(__path__)]
    return dict(sorted((module.NUMBER, module) for module in modules if hasattr(module, role)))


SCENES, DEFORMATIONS = _registry("SCENE"), _registry("OF")


def _of(scene: AnyScene) -> ModuleType:
    return next(kind for kind in SCENES.values() if isinstance(scene, kind.SCENE))


# -- reading -----------------------------------------------------------------------------------------------------------


def check(kind: Kind, table: RowTable, layers: Mapping[int, Tensors]) -> None:
    """Checks a header's kind and rows and the last of its layers so far. layers: by number, the integers of their
    tensors, or the tables alone.

    Raises UnsupportedFeature for a kind outside the registry, Malformed for tensors that break the rules of theirs.
    """
    of = _known("scene", kind, SCENES)
    widths = of.widths_of(kind, table)
    for layer, own in list(layers.items())[-1:]:
        where, tables = f"layer {layer}", own.tables
        if layer == 0:
            of.check(tables, widths)
        elif tables != NOTHING.tables:
            moves = tables.kind and _known(f"{where}: deformation", tables.kind, DEFORMATIONS)
            if not moves or moves.OF != of.NAME:
                expected = " or ".join(own.NAME for own in DEFORMATIONS.values() if own.OF == of.NAME)
                stated = moves.NAME if moves else "without a kind"
                raise Malformed(f"{where}: deformation {stated}, expected {expected}")
            moves.check(own, {i: other.tables for i, other in layers.items() if 0 < i < layer}, widths, where)


def _known(what: str, kind: Kind, registry: Mapping[int, ModuleType]) -> ModuleType:
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
    pairs = zip(grown.tensors.items(), layer_rows, strict=True)
    moved = {
        layer: DEFORMATIONS[own.tables.kind[0]].deformation_of(own, x) for (layer, own), x in pairs if own.tables.kind
    }
    scene: AnyScene = SCENES[kind[0]].scene_of(kind, table, common, rows, grown.tensors, moved)
    return scene


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
    words: dict[str, Any] = (DEFORMATIONS[own.kind[0]] if own.kind else SCENES[kind[0]]).json_of_layer(own, layer)
    return words


# -- writing -----------------------------------------------------------------------------------------------------------


def kind_of(scene: AnyScene) -> Kind:
    """Returns the integers of a scene's kind."""
    kind: Kind = _of(scene).kind_of(scene)
    return kind


def row_table(scene: AnyScene) -> RowTable:
    """Returns the table of a scene's rows. Raises EncodeError for a centre without a symbol."""
    names = list(_of(scene).TENSORS)
    sizes = {name: math.prod(values.shape[1:]) for name, values in scene.attributes.items()}
    table = RowTable(tuple(Rows(names.index(name), size, scene.row_steps[name]) for name, size in sizes.items()))
    if scene.grading is None:
        return table
    centre = [
        quantise(x, tensor.step, f"centre of {names[tensor.id]}") for tensor, x in table.of_each(scene.grading.centre)
    ]
    return RowTable(table.tensors, np.concatenate(centre))


def _part(scene: AnyScene, layer: int) -> ModuleType | None:
    """Returns the kind of what a layer has besides masks and rows, None if it has nothing."""
    if layer == 0:
        return _of(scene) if hasattr(_of(scene), "tensors_of") else None
    given = scene.deformation(layer)
    return next((kind for kind in DEFORMATIONS.values() if isinstance(given, kind.DEFORMATION)), None)


def layer_name(scene: AnyScene, layer: int) -> str:
    """Returns what messages and reports call the grids and chains of a layer."""
    return f"{(_part(scene, layer) or _of(scene)).NAME} of layer {layer}"


def check_arrays(scene: AnyScene, layer: int) -> None:
    """Raises EncodeError for an array of a layer of another shape, dtype or value than its kind documents, as far as
    the tables that follow from it do not tell."""
    if part := _part(scene, layer):
        part.check_arrays(scene, layer, layer_name(scene, layer))


def tensors_of(scene: AnyScene, layer: int) -> Tensors:
    """Returns the values of the grids and chains of a layer."""
    part = _part(scene, layer)
    tensors: Tensors = part.tensors_of(scene, layer) if part else NOTHING
    return tensors


def rows_of(scene: AnyScene, layer: int, count: int) -> dict[str, np.ndarray]:
    """Returns the layer rows of the scene's first `count` rows, float32 [count, K] by name in coding order, of a layer
    whose tables have some. Raises EncodeError if later rows are not 0."""
    part = _part(scene, layer)
    assert part is not None
    rows: dict[str, np.ndarray] = part.rows_of(scene, layer, count)
    return rows


def array_names(scene: AnyScene, layer: int, tables: Tables) -> list[str]:
    """Returns the names of a layer's planes, weights and biases in coding order, such as "planes.0.xy" and
    "mlp.trunk.weight.0"."""
    part = _part(scene, layer)
    names: list[str] = part.array_names(tables) if part else []
    return names
