"""Reads a checkpoint of Scaffold-GS (Lu et al. 2024) as a scene with layer 0 only.

A folder `point_cloud/iteration_N` holds the anchors in `point_cloud.ply` and the decoders in `opacity_mlp.pt`,
`cov_mlp.pt` and `color_mlp.pt` (TorchScript) or in `checkpoints.pth` (a dict of state dicts). The formulas of
Scaffold-GS equal clause 13.4 if no decoder takes the distance and there is no feature bank. An appearance embedding
enters the colour decoder's first layer linearly, so for one picture it is part of the bias. Two folders up, `cfg_args`
and `cameras.json` give voxel size, background and cameras; both are parsed as text.
"""

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pd4dgs_codec.archives import Module
from pd4dgs_codec.data.files import LARGEST, read_vertices
from pd4dgs_codec.data.view import points_box
from pd4dgs_codec.errors import DataError
from pd4dgs_codec.interchange.runs import PLY, Config, State, iteration, network_of, read_cameras, read_torch, run_of
from pd4dgs_codec.model.sensitivity import whitening_transform
from pd4dgs_codec.morton import MAX_VOXEL
from pd4dgs_codec.scene import MAX_FEATURE, MAX_SLOTS, SCALING_DIM, Network, Scene, SceneInfo, Steps, Widths

#: The decoders' names here and in Scaffold-GS.
DECODERS = {"opacity": "opacity_mlp", "covariance": "cov_mlp", "color": "color_mlp"}
#: Files and keys of feature banks, which the format cannot hold, and of the appearance embedding.
BANKS = ("feature_bank_mlp.pt", "mlp_feature_bank", "feature_bank_mlp")
EMBEDDING = "embedding_appearance.pt"
#: Near plane of Scaffold-GS's rasteriser and far plane of its cameras, scene units.
NEAR, FAR = 0.2, 100.0
UP = (0.0, -1.0, 0.0)  #: up direction of a run without cameras.json
#: Anchors may lie OFF_GRID voxels plus ULPS units in the last place of the coordinate off the grid.
OFF_GRID, ULPS = 1e-3, 8
DEPTH = 4  #: most levels of nested modules
#: The layers of each decoder, as TorchScript names them.
LAYERS = {
    "opacity": "Linear, ReLU, Linear, Tanh",
    "covariance": "Linear, ReLU, Linear",
    "color": "Linear, ReLU, Linear, Sigmoid",
}


def read_scaffold_gs(folder: Path, appearance: int | None = None, voxel_size: float | None = None) -> Scene:
    """Reads a scene with anchors in voxels, whitened features and all else as it is. Raises DataError for unsupported
    models.

    appearance: index of the picture whose embedding is used. voxel_size: scene units, None to derive it.
    """
    place = _iteration(folder)
    run = run_of(place)
    config = Config.of(run)
    ply = place / PLY
    table = _columns(ply)
    decoders, embedding = _decoders(place)
    widths = Widths(table["feature"].shape[1], table["offset"].shape[1])
    networks = {
        name: _network(name, decoder, place / f"{DECODERS[name]}.pt", widths, embedding, appearance)
        for name, decoder in decoders.items()
    }
    feature, networks = _whitened(table["feature"], networks)
    anchor = table["anchor"]
    voxel = voxel_size or _voxel_size(config)
    with np.errstate(over="ignore"):
        voxel = float(np.float32(voxel if voxel > 0 else _grid(anchor, ply)))
    camera, up = None, UP
    if (run / "cameras.json").is_file():
        (camera, *_), up = read_cameras(run / "cameras.json")
    box, depth = points_box(anchor).astype(np.float32), (float(np.float32(NEAR)), FAR)
    return Scene(
        info=SceneInfo(voxel, box, (0.0, 1.0), config.background, *depth, up, 0.0, camera),
        steps=Steps().scaled(1.0),
        layers=(0,),
        rows=(len(anchor),),
        anchor_q=_cells(anchor, voxel, ply),
        feature=feature,
        scaling_log=table["scaling_log"],
        offset=table["offset"],
        mask=(np.full(len(anchor), 255, np.uint8),),
        networks=networks,
    )


def _iteration(folder: Path) -> Path:
    """Finds the folder of the iteration. Raises DataError unless it holds static Gaussians."""
    if not folder.is_dir():
        raise DataError(f"{folder}: found {'a file' if folder.exists() else 'nothing'}, expected a folder")
    place = iteration(folder)
    if place is None:
        what = f"{PLY}, here or in point_cloud/iteration_N"
        raise DataError(f"{folder}: has no {what}; expected a checkpoint of Scaffold-GS")
    if network := network_of(place):
        how = f"-o FILE.pd4 packs it, pd4dgs-train teacher:{folder} learns from it"
        raise DataError(f"{folder}: {network.name} moves its Gaussians, expected a checkpoint of Scaffold-GS; {how}")
    return place


def _voxel_size(config: Config) -> float:
    """Returns the voxel size in scene units, 0 if unknown."""
    found = config.get("voxel_size") or "0"
    try:
        return float(found)
    except ValueError:
        raise DataError(f"{config.path}: voxel_size is {found!r}, expected a number") from None


def _columns(path: Path) -> dict[str, np.ndarray]:
    """Reads anchor [N, 3], feature [N, F], scaling_log [N, 6], offset [N, K, 3], float32 and finite."""
    vertices = read_vertices(path)
    names = set(vertices.dtype.names or ())

    def stack(prefix: str, places: Iterable[object]) -> np.ndarray:
        wanted = [f"{prefix}{place}" for place in places] or [f"{prefix}0"]
        if missing := [name for name in wanted if name not in names]:
            raise DataError(f"{path}: has no property {missing[0]}; expected those of Scaffold-GS")
        columns = np.stack([vertices[name] for name in wanted], axis=1).astype(np.float32)
        if not (np.abs(columns) <= LARGEST).all():  # also true of NaN
            raise DataError(f"{path}: {prefix or 'xyz'}* holds a NaN or a number over {LARGEST:g}")
        return columns

    def numbered(prefix: str) -> np.ndarray:
        return stack(prefix, range(sum(re.fullmatch(rf"{prefix}\d+", name) is not None for name in names)))

    if not len(vertices):
        raise DataError(f"{path}: holds no anchor, expected one at least")
    offsets, feature = numbered("f_offset_"), numbered("f_anchor_feat_")
    slots, rest = divmod(offsets.shape[1], 3)
    if rest or slots > MAX_SLOTS or feature.shape[1] > MAX_FEATURE:
        found = f"{feature.shape[1]} features and {offsets.shape[1]} coordinates of offsets per anchor"
        raise DataError(f"{path}: has {found}, expected at most {MAX_FEATURE} and {MAX_SLOTS} times 3")
    return {
        "anchor": stack("", "xyz"),
        "feature": feature,
        "scaling_log": stack("scale_", range(SCALING_DIM)),
        "offset": np.ascontiguousarray(offsets.reshape(-1, 3, slots).transpose(0, 2, 1)),  # stored axis by axis
    }


def _decoders(place: Path) -> tuple[dict[str, Any], np.ndarray | None]:
    """Reads (content of each decoder's file or key, appearance embedding [pictures, A] or None)."""
    united = place / "checkpoints.pth"
    if united.is_file():
        content = read_torch(united)
        if not isinstance(content, dict):
            raise DataError(f"{united}: holds a {type(content).__name__}, expected a dict of state dicts")
        bank, embedding = next((key for key in BANKS if key in content), None), content.get("appearance")
        found, where = {name: content.get(key) for name, key in DECODERS.items()}, united
    else:
        bank = next((name for name in BANKS if (place / name).exists()), None)
        found = {name: read_torch(place / f"{key}.pt") for name, key in DECODERS.items()}
        where = place / EMBEDDING
        embedding = read_torch(where) if where.exists() else None
    if bank:
        raise DataError(f"{place}: has a bank of features ({bank}), expected a model without one")
    if missing := [DECODERS[name] for name, decoder in found.items() if decoder is None]:
        raise DataError(f"{united}: has no {missing[0]}, expected Scaffold-GS's three decoders")
    if embedding is None:
        return found, None
    tables = list(_tensors(embedding).values())
    if len(tables) != 1 or tables[0].ndim != 2 or not len(tables[0]) or not np.isfinite(tables[0]).all():
        raise DataError(f"{where}: expected one embedding of finite numbers, pictures x dimensions")
    return found, tables[0].astype(np.float64)


def _tensors(content: Any) -> dict[str, np.ndarray]:
    """Collects the tensors of modules and dicts nested up to DEPTH deep, under dotted names as in a state dict."""
    found: dict[str, np.ndarray] = {}
    waiting = [("", content)]
    while waiting:
        name, value = waiting.pop()
        members = value.members if isinstance(value, Module) else value
        if isinstance(value, np.ndarray):
            found[name] = value
        elif isinstance(members, dict) and name.count(".") < DEPTH:
            waiting += [(f"{name}.{key}" if name else str(key), part) for key, part in members.items()]
    return found


def _network(
    name: str, decoder: Any, path: Path, widths: Widths, embedding: np.ndarray | None, appearance: int | None
) -> Network:
    """Reads a decoder's two linear layers and adds the embedding of the chosen picture to the first bias."""
    if isinstance(decoder, Module):  # state dicts do not name the kinds of layers
        parts = [part for key, part in decoder.members.items() if key.isdigit() and isinstance(part, Module)]
        kinds = ", ".join(part.kind for part in parts)
        if kinds != LAYERS[name]:
            raise DataError(f"{path}: layers are {kinds[:120]}; expected {LAYERS[name]}")
    tensors = _tensors(decoder)
    expected = ("0.bias", "0.weight", "2.bias", "2.weight")
    if tuple(sorted(tensors)) != expected:
        raise DataError(f"{path}: has tensors {', '.join(sorted(tensors))[:120]}, expected {', '.join(expected)}")
    outputs, state = widths.networks[name], State(path, tensors)
    w1, b1 = (part.astype(np.float64) for part in state.linear("0"))
    w2, b2 = state.linear("2", len(b1), outputs)
    inputs, usual = w1.shape[1], widths.inputs[name]
    taken = 0 if embedding is None or name != "color" else embedding.shape[1]
    if inputs != usual + taken:
        found = f"{inputs} inputs" if inputs != usual + taken + 1 else f"the distance as well ({inputs} inputs)"
        expects = f"{usual + taken}: {widths.feature} features and a direction"
        raise DataError(f"{path}: takes {found}, expected {expects}")
    if embedding is not None and taken:
        if appearance is None or not 0 <= appearance < len(embedding):
            how = f"choose one of {len(embedding)} pictures with --appearance 0..{len(embedding) - 1}"
            raise DataError(f"{path.parent}: colours depend on the picture; {how}")
        w1, b1 = w1[:, :usual], b1 + w1[:, usual:] @ embedding[appearance]
    return (w1.astype(np.float32), b1.astype(np.float32)), (w2, b2)


def _whitened(feature: np.ndarray, networks: dict[str, Network]) -> tuple[np.ndarray, dict[str, Network]]:
    """Transforms features [N, D] so that they cost fewer bits at the same error, and the networks' first layers, which
    undo it. The errors by direction are those of the first layers."""
    width = feature.shape[1]
    reads = np.concatenate([first[0][:, :width] for first, _ in networks.values()]).astype(np.float64)
    covariance = np.cov(feature.T.astype(np.float64), bias=True).reshape(width, width)
    if not reads.any():
        return feature, networks
    transform = whitening_transform(torch.from_numpy(reads.T @ reads), torch.from_numpy(covariance)).numpy()
    back = np.linalg.inv(transform)
    white = dict[str, Network]()
    for name, ((weights, bias), second) in networks.items():
        read = np.concatenate([weights[:, :width] @ back, weights[:, width:]], axis=1)
        white[name] = (read.astype(np.float32), bias), second
    return (feature @ transform.T).astype(np.float32), white


def _grid(anchor: np.ndarray, path: Path) -> float:
    """Finds the largest voxel size of which all coordinates are multiples."""
    values = np.unique(np.abs(anchor.astype(np.float64)))
    tolerance = ULPS * np.spacing(np.abs(anchor).max()).astype(np.float64)
    gaps = np.diff(np.concatenate([[0.0], values]))
    gaps = gaps[gaps > 4 * tolerance]
    if not gaps.size:
        raise DataError(f"{path}: the anchors do not determine the voxel size, expected --voxel-size")
    voxel = float(gaps.min())
    for limit in np.geomspace(16, MAX_VOXEL, 24):  # a better estimate reaches farther
        near = values[values <= limit * voxel]
        cells = np.round(near / voxel)
        if cells.any():
            voxel = float((cells @ near) / (cells @ cells))
    return voxel


def _cells(anchor: np.ndarray, voxel: float, path: Path) -> np.ndarray:
    """Returns the anchors in voxels, int32 [N, 3]. Raises DataError if they are not multiples of `voxel`."""
    if not 0 < voxel < np.inf:
        raise DataError(f"{path}: the voxel size is {voxel:g} in binary32, expected a positive number")
    exact = anchor.astype(np.float64) / voxel
    cells = np.round(exact)
    if (most := np.abs(cells).max()) > MAX_VOXEL:
        raise DataError(f"{path}: an anchor lies {most:.3g} voxels of {voxel:g} away, expected {MAX_VOXEL} at most")
    off = np.abs(exact - cells) - ULPS * np.spacing(np.abs(anchor)).astype(np.float64) / voxel
    if off.max() > OFF_GRID:
        found = f"anchors lie up to {off.max():.3g} voxels off the grid of {voxel:g}"
        raise DataError(f"{path}: {found}, expected multiples of it; --voxel-size sets another")
    voxels, counts = np.unique(cells.astype(np.int32), axis=0, return_counts=True)
    if counts.max() > 1:
        found = f"several anchors lie in voxel {voxels[counts.argmax()].tolist()} of {voxel:g}"
        raise DataError(f"{path}: {found}, expected one; --voxel-size sets a smaller one")
    return cells.astype(np.int32)
