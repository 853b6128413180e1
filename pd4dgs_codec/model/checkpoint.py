"""Checkpoints: versioned, self-describing, and read by `archives` as data, so that a file cannot run code.

A checkpoint is a dict {"format", "version", "digest", "info", "steps", "deformations", "state": tensors, "training"}.
Shapes come from the tensors; loading does not need the configuration that made the model. "training" is the state for
resuming and may be empty; its "viewpoints" are a list of some training cameras and times, for packing. "digest" covers
all other entries, since torch reads damaged archives without an error.
"""

from __future__ import annotations

import hashlib
import io
import os
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pd4dgs_codec.archives import read_tensors
from pd4dgs_codec.errors import DataError, EncodeError, one_line
from pd4dgs_codec.format.check import check_info, check_scene
from pd4dgs_codec.io import read_source, write_bytes
from pd4dgs_codec.model.deformation import DeformationField
from pd4dgs_codec.model.model import Model, check_finite, from_scene
from pd4dgs_codec.model.networks import MLP
from pd4dgs_codec.morton import morton_codes
from pd4dgs_codec.scene import SCAFFOLD_NETWORKS, Camera, Deformation, Grading, Scene, SceneInfo, Steps, Viewpoint

FORMAT = "pd4dgs-checkpoint"
VERSION = 1


def save(path: str | Path, model: Model, training: dict[str, Any] | None = None) -> None:
    """Writes the model and `training`, the state for resuming, whole or not at all. Raises DataError, also for a model
    that `load` or, by the places of its anchors, `encode` would refuse. See `target`."""
    real, training = target(path), dict(training or {})
    if viewpoints := training.get("viewpoints"):
        training["viewpoints"] = [[_camera_to_plain(camera), time] for camera, time in viewpoints]
    content: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "info": _info_to_plain(model.info),
        "steps": asdict(model.steps),
        "deformations": {
            name: None if field is None else field.shape()
            for name, field in (("global", model.global_deformation), ("local", model.local_deformation))
        },
        "state": {name: tensor.detach().cpu() for name, tensor in model.state_dict().items()},
        "training": training,
    }
    try:
        check_finite(content["state"])
        morton_codes(_build(content).anchor_q.numpy())  # raises EncodeError for anchors too far apart to be encoded
    except (DataError, EncodeError) as error:
        raise DataError(f"{path}: the model cannot be stored: {error}") from None
    content["digest"] = _digest(content)
    buffer = io.BytesIO()  # torch itself reports a full disk only as "unexpected pos"
    try:
        torch.save(content, buffer)
        write_bytes(real, buffer.getbuffer(), overwrite=True)
    except OSError as error:
        raise DataError(f"{path}: cannot write the checkpoint: {error.strerror or error}") from None


def target(path: str | Path) -> Path:
    """Returns the file that `save` replaces; a symbolic link stays. Raises DataError for a device, pipe or folder."""
    real = Path(os.path.realpath(path))
    if real.exists() and not real.is_file():
        raise DataError(f"{path}: is not a regular file; expected the name of a checkpoint to write")
    return real


def load(path: str | Path) -> tuple[Model, dict[str, Any]]:
    """Reads a checkpoint. Returns (model, training). Raises DataError, of one line, for any other or damaged file."""
    return loads(read_source(path), str(path))


def loads(raw: bytes, path: str) -> tuple[Model, dict[str, Any]]:
    """`load` of the bytes of a file; messages call it `path`."""
    if not raw.startswith(b"PK"):  # a zip archive, as torch writes it
        found = f"a file that begins with {raw[:8]!r}" if raw else "an empty file"
        raise DataError(f"{path}: found {found}, expected a .pd4 file or a {FORMAT}")
    content = read_tensors(raw, path, lambda array: torch.from_numpy(np.array(array)))
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        found = (
            f"dict with keys {sorted(map(str, content))[:4]}" if isinstance(content, dict) else type(content).__name__
        )
        raise DataError(f"{path}: not a {FORMAT}; found a {found}")
    version = content.get("version")
    if type(version) is not int or version != VERSION:  # True is an int too, and equal to 1
        raise DataError(f"{path}: {FORMAT} version {version!r}, expected {VERSION}")
    try:
        if content.get("digest") != _digest(content):
            raise DataError(f"{path}: damaged: its digest does not match its content")
        check_finite(content["state"])
        model, training = _build(content), dict(content["training"])
        if "viewpoints" in training:
            training["viewpoints"] = [_viewpoint(model.info, *row) for row in training["viewpoints"]]
        return model, training
    except Exception as error:  # of many kinds, if the content is inconsistent
        reason = one_line(str(error))  # torch's messages have several lines
        if isinstance(error, DataError) and reason.startswith(f"{path}: damaged"):
            raise
        raise DataError(f"{path}: a {FORMAT} with missing or misshapen content: {reason}") from None


def _digest(content: dict[str, Any]) -> str:
    """Returns the SHA-256, in hexadecimal, of all entries but "digest": nested containers of tensors and scalars."""
    hasher = hashlib.sha256()

    def walk(value: Any) -> None:
        if isinstance(value, torch.Tensor):
            array = value.detach().cpu().contiguous().numpy()
            hasher.update(f"tensor {array.dtype.str} {array.shape} ".encode())
            hasher.update(array.data if array.size else b"")
        elif isinstance(value, dict):
            hasher.update(f"dict {len(value)} ".encode())
            for key, item in value.items():
                walk(key)
                walk(item)
        elif isinstance(value, (list, tuple)):
            hasher.update(f"{type(value).__name__} {len(value)} ".encode())
            for item in value:
                walk(item)
        else:
            text = repr(value).encode()
            hasher.update(f"{type(value).__name__} {len(text)} ".encode() + text)

    walk({key: item for key, item in content.items() if key != "digest"})
    return hasher.hexdigest()


def _build(content: dict[str, Any]) -> Model:
    """Builds the model from a scene of the same shapes, which `check_scene` checks, then loads the state."""
    state = {name: tensor.numpy() for name, tensor in content["state"].items()}
    n = len(state["anchor_q"])

    def deformation(name: str) -> Deformation | None:
        shape, prefix = content["deformations"][name], f"{name}_deformation."
        own = {key.removeprefix(prefix): value for key, value in state.items() if key.startswith(prefix)}
        return None if shape is None else DeformationField.arrays_of_state(shape, own)

    scene = Scene(
        info=_info_from_plain(content["info"]),
        steps=Steps(**content["steps"]),
        layers=(0, 1, 2),
        rows=(n, n, n),
        anchor_q=state["anchor_q"],
        feature=np.zeros(state["feature"].shape, np.float32),
        scaling_log=np.zeros(state["scaling_log"].shape, np.float32),
        offset=np.zeros(state["offset"].shape, np.float32),
        mask=(np.full(n, 255, np.uint8),) * 3,
        networks={name: MLP.arrays_of_state(state, f"networks.{name}") for name in SCAFFOLD_NETWORKS},
        global_deformation=deformation("global"),
        local_deformation=deformation("local"),
        grading=Grading(state["step_class"], state["centre"]),
    )
    check_scene(replace(scene, steps=scene.steps.scaled(1.0)))
    model = from_scene(scene)
    model.load_state_dict(content["state"])
    return model


def _info_to_plain(info: SceneInfo) -> dict[str, Any]:
    plain = dict(info.__dict__, box=info.box.tolist())
    if info.camera is not None:
        plain["camera"] = _camera_to_plain(info.camera)
    return plain


def _camera_to_plain(camera: Camera) -> dict[str, Any]:
    return dict(camera.__dict__, viewmat=camera.viewmat.tolist(), K=camera.K.tolist())


def _camera_from_plain(plain: dict[str, Any]) -> Camera:
    return Camera(**dict(plain, viewmat=np.array(plain["viewmat"], np.float32), K=np.array(plain["K"], np.float32)))


def _viewpoint(info: SceneInfo, plain: dict[str, Any], time: float) -> Viewpoint:
    """Reads a camera and a time. Raises an exception of any type if either is not possible."""
    camera = _camera_from_plain(plain)
    check_info(replace(info, camera=camera))
    if not 0 <= time <= 1:
        raise ValueError(f"a viewpoint at time {time}, expected 0..1")
    return camera, time


def _info_from_plain(plain: dict[str, Any]) -> SceneInfo:
    camera = plain["camera"]
    if camera is not None:
        camera = _camera_from_plain(camera)
    tuples = {k: tuple(plain[k]) for k in ("time_range", "background", "up")}
    return SceneInfo(**dict(plain, box=np.array(plain["box"], np.float32), camera=camera, **tuples))
