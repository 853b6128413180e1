"""Converts between `Model`, of torch tensors, and `Scene`, of the numpy arrays that the codec packs."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch

from pd4dgs_codec.errors import DataError
from pd4dgs_codec.format.quantise import mask_codes
from pd4dgs_codec.model.deformation import DeformationField
from pd4dgs_codec.model.model import Model
from pd4dgs_codec.model.networks import MLP, mask_logits
from pd4dgs_codec.scene import MASK_STEP, SCAFFOLD_NETWORKS, Grading, Scene


def check_finite(state: Mapping[str, torch.Tensor]) -> None:
    """Raises DataError naming a tensor that holds a NaN or an infinity."""
    for name, tensor in state.items():
        if not torch.isfinite(tensor).all():
            raise DataError(f"tensor {name} holds a NaN or an infinity; expected finite numbers")


def to_scene(model: Model) -> Scene:
    """Returns an unplanned scene of every anchor of the model: rows (N, ...), masks of inactive anchors 0.

    Raises DataError as `check_finite` does.
    """
    check_finite(model.state_dict())
    deformations = {layer: field.arrays() for layer, field in model.deformations.items()}
    layers = (0, *deformations)
    n = len(model.anchor_q)
    with torch.no_grad():
        masks = tuple(mask_codes(model.masks(layer).cpu().numpy()) for layer in layers)
    return Scene(
        info=model.info,
        steps=model.steps,
        layers=layers,
        rows=(n,) * len(layers),
        anchor_q=_numpy(model.anchor_q),
        feature=_numpy(model.feature),
        scaling_log=_numpy(model.scaling_log),
        offset=_numpy(model.offset),
        mask=masks,
        networks={name: model.network(name).arrays() for name in SCAFFOLD_NETWORKS},
        global_deformation=deformations.get(1),
        local_deformation=deformations.get(2),
        grading=Grading(_numpy(model.step_class), _numpy(model.centre)) if model.step_class.any() else None,
    )


def from_scene(scene: Scene) -> Model:
    """Returns the model that renders `scene`, with anchors in the scene's order.

    A level whose layer is absent equals the level below it; masks are reproduced to within 1e-6.
    """
    n = len(scene.anchor_q)
    masks = np.zeros((n, 3), np.float64)
    for level in range(3):
        present = [i for i, layer in enumerate(scene.layers) if layer <= level]
        codes = scene.mask[present[-1]]
        masks[: len(codes), level] = codes * np.float64(MASK_STEP)
    box = scene.info.box
    fields = (scene.global_deformation, scene.local_deformation)
    global_field, local_field = (None if f is None else DeformationField.from_arrays(f, box) for f in fields)
    return Model(
        scene.info,
        scene.steps,
        torch.from_numpy(scene.anchor_q.astype(np.int32)),
        torch.from_numpy(np.array(scene.feature, np.float32)),
        torch.from_numpy(np.array(scene.scaling_log, np.float32)),
        torch.from_numpy(np.array(scene.offset, np.float32)),
        torch.from_numpy(mask_logits(masks)),
        {name: MLP.from_arrays(net) for name, net in scene.networks.items()},
        global_field,
        local_field,
        *(() if scene.grading is None else map(torch.from_numpy, (scene.grading.classes, scene.grading.centre))),
    )


def _numpy(tensor: torch.Tensor) -> np.ndarray:
    array: np.ndarray = tensor.detach().cpu().numpy().copy()
    return array
