"""The deformation kind "hexplane": planes of space and time, a trunk and a head per residual (clause 13.3).

Parameters: [], or [k] with the code of the key instant.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pd4dgs_codec.errors import Malformed
from pd4dgs_codec.kinds import scaffold
from pd4dgs_codec.scene import INSTANTS, PLANES, TRUNK, Deformation, Scene, Widths, instant, plane_sides
from pd4dgs_codec.tensors.planes import cells_read, fill_plane
from pd4dgs_codec.tensors.quantise import expect
from pd4dgs_codec.tensors.tables import Grid, Kind, Tables, Tensors

NUMBER, NAME = 0, "hexplane"
OF, DEFORMATION = scaffold.NAME, Deformation

#: Chains by id: the trunk, the position, and the residual of each tensor of rows.
CHAINS = (TRUNK, "position", "feature", "scaling", "offset")
MAX_GRIDS = 8  #: of a layer


def check(tensors: Tensors, below: Mapping[int, Tables], widths: Widths, where: str) -> None:
    """Raises Malformed if the tables of a layer break the rules of the kind. below: of the layers before that have a
    deformation."""
    tables = tensors.tables
    if not (tables.grids and tables.chains) or tables.rows:
        raise Malformed(f"{where}: a deformation of rows, or without grids or chains")
    if len(tables.kind) > 2:
        raise Malformed(f"{where}: deformation {list(tables.kind)}, expected [{NUMBER}] or [{NUMBER}, key instant]")
    read = [grid for layer in below.values() for grid in layer.grids]
    for grid in tables.grids:
        channels = (read or tables.grids)[0].channels
        if len(grid.sides) != 4 or grid.channels != channels:
            found = f"{len(grid.sides)} sides and {grid.channels} channels"
            raise Malformed(f"{where} grid {grid.id}: {found}, expected 4 and {channels}")
    if len(tables.grids) > MAX_GRIDS:
        raise Malformed(f"{where}: {len(tables.grids)} grids, expected at most {MAX_GRIDS}")
    ids = [chain.id for chain in tables.chains]
    if not (len(ids) > 1 and ids[0] == 0 and ids[-1] < len(CHAINS)):
        raise Malformed(f"{where}: chains {ids}, expected 0 ({TRUNK}) and at least one of 1..{len(CHAINS) - 1}")
    trunk, *heads = tables.chains
    features = sum(grid.channels for grid in (*read, *tables.grids))
    if trunk.widths[0] != features:
        raise Malformed(f"{where} {TRUNK}: {trunk.widths[0]} inputs, expected {features}")
    for chain in heads:
        name, sides = CHAINS[chain.id], (chain.widths[0], chain.widths[-1])
        expected = trunk.widths[-1], widths.heads[name]
        if sides != expected:
            raise Malformed(f"{where} {name}: inputs and outputs {sides}, expected {expected}")


def check_arrays(scene: Scene, layer: int, own: str) -> None:
    """Raises EncodeError for networks or planes of other names or axes than those of the kind, or another key."""
    given = scene.deformation(layer)
    assert given is not None
    scaffold.check_networks(given.networks, CHAINS, (TRUNK,), own)
    for s, planes in enumerate(given.planes):
        expect(set(planes) == {p for p, _, _ in PLANES}, f"{own} scale {s}: planes {sorted(planes)}, expected six")
        flat = [name for name, plane in planes.items() if plane.ndim != 3 or not plane.size]
        expect(not flat, f"{own} scale {s}: planes {flat} are empty or do not have 3 axes")
    key = given.key
    valid = key is None or (type(key) is int and 0 <= key <= INSTANTS)
    expect(valid, f"{own}: key instant {key!r}, expected None or an integer 0..{INSTANTS}")


def tensors_of(scene: Scene, layer: int) -> Tensors:
    """Returns the grids and chains of a layer."""
    given = scene.deformation(layer)
    assert given is not None
    return tensors_of_parts(given, scene.steps.planes(layer), scene.steps.weights(layer))


def tensors_of_parts(deformation: Deformation, planes_step: float, weights_step: float) -> Tensors:
    """Returns the grids and chains of a deformation, or of some of its parts."""
    grids = [Grid(s, len(scale["xy"]), plane_sides(scale)) for s, scale in enumerate(deformation.planes)]
    networks = {i: deformation.networks[name] for i, name in enumerate(CHAINS) if name in deformation.networks}
    chains, key = scaffold.chains_of(networks, weights_step), deformation.key
    kind: Kind = (NUMBER,) if key is None else (NUMBER, key)
    tables = replace(chains.tables, grids=tuple(grids), grid_step=planes_step if grids else 0.0, kind=kind)
    return Tensors(tables, [scale[name] for scale in deformation.planes for name, _, _ in PLANES], chains.weights)


def array_names(tables: Tables) -> list[str]:
    """Returns the names of planes, weights and biases in coding order."""
    planes = [f"planes.{s}.{name}" for s in range(len(tables.grids)) for name, _, _ in PLANES]
    return planes + scaffold.array_names(tables, CHAINS)


def deformation_of(tensors: Tensors, rows: Sequence[np.ndarray] = ()) -> Deformation:
    """The inverse of `tensors_of_parts`."""
    names = [name for name, _, _ in PLANES]
    planes = tuple(dict(zip(names, own, strict=True)) for own in tensors.grids.values())
    networks = {CHAINS[i]: network for i, network in tensors.chains.items()}
    return Deformation(planes, networks, *tensors.tables.kind[1:])


def json_of_layer(tables: Tables, layer: int) -> dict[str, Any]:
    """As of a scaffold, and key_instant: normalised time, if any."""
    found = scaffold.json_of_layer(tables, layer, CHAINS)
    return found if len(tables.kind) < 2 else found | {"key_instant": instant(tables.kind[1])}


# -- parts without effect ----------------------------------------------------------------------------------------------


def zero_heads(symbols: Deformation) -> list[str]:
    """Returns the heads whose last layer makes the residuals 0 everywhere; a key instant cancels its bias."""
    last = {name: network[-1] for name, network in symbols.networks.items() if name != TRUNK}
    return [n for n, (weight, bias) in last.items() if not weight.any() and (symbols.key is not None or not bias.any())]


def without_unread(symbols: Tensors, unit: np.ndarray) -> tuple[Tensors, str, float]:
    """Gives plane cells that no point reads values of little cost. unit: float32 [n, 3], points in 0..1 of the box.

    Returns (symbols, text with the number of these cells, bits saved by order-0 entropy); `symbols` itself if nothing
    changes.
    """
    axes = [(a, b) for _ in symbols.tables.grids for _, a, b in PLANES]
    pairs = list(zip(symbols.planes, axes, strict=True))
    marks = [cells_read(plane.shape, unit[:, a], unit[:, b] if b < 3 else None) for plane, (a, b) in pairs]
    found = [fill_plane(plane, mark) for plane, mark in zip(symbols.planes, marks, strict=True)]
    if all(np.array_equal(new, old) for (new, _), old in zip(found, symbols.planes, strict=True)):
        return symbols, "", 0.0
    free, cells = sum(int((~mark).sum()) for mark in marks), sum(mark.size for mark in marks)
    saved = max(sum(bits for _, bits in found), 0.0)
    return replace(symbols, planes=[plane for plane, _ in found]), f"{free:,} of {cells:,} plane cells", saved
