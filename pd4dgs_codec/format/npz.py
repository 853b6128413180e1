"""Converts a scene to a flat dict of arrays under stable names, for numpy.savez and readers without this package."""

import numpy as np

from pd4dgs_codec.format.deformation import arrays_of
from pd4dgs_codec.format.quantise import Grid, attribute_rows, classes_of, quantise
from pd4dgs_codec.format.registry import LAYER_KINDS
from pd4dgs_codec.scene import MASK_STEP, Scene

#: Part of the names of each layer's networks and planes.
OWNERS = {0: "", 1: "global", 2: "local"}


def to_npz_dict(scene: Scene, symbols: bool = False) -> dict[str, np.ndarray]:
    """Returns arrays by key: anchor, feature, scaling_log, offset (float32, one row per anchor); mask_L per layer L
    present (float32 masks of the first rows); mlp.NAME.weight.i and .bias.i with NAME opacity, covariance, color,
    {global,local}.trunk and {global,local}.HEAD; planes.{global,local}.SCALE.PLANE; meta_* for the rest.

    Step classes add step_class (uint8), and NAME_centre (float32) per attribute, whose values are the centre plus
    multiples of 2^step_class steps.

    symbols: adds NAME_q (int32) and NAME_step (float32) for every quantised array; anchor_step is the voxel size.
    """
    arrays, steps = {"anchor": scene.anchor, **scene.attributes}, dict[str, float]()
    if scene.grading is not None:
        arrays["step_class"] = scene.grading.classes
        for name, centre in attribute_rows(scene.grading.centre, scene.widths):
            arrays[f"{name}_centre"] = centre.reshape(scene.widths.attributes[name])
    for kind in LAYER_KINDS:
        for step, name, array in arrays_of(scene.tensors(kind.layer), kind):
            family, rest = name.split(".", 1)
            name = ".".join(filter(None, (family, OWNERS[kind.layer], rest)))
            arrays[name], steps[name] = array, vars(scene.steps)[step]
    if symbols:
        quantised = {name: quantise(arrays[name], step, name) for name, step in steps.items()}
        channels = Grid.of(scene).quantise(scene.attributes, classes_of(scene))
        for name, rows in attribute_rows(channels, scene.widths):
            quantised[name] = rows.T.reshape(arrays[name].shape)
        steps |= scene.steps.attributes
        arrays |= {f"{name}_q": k for name, k in quantised.items()}
        arrays |= {f"{name}_step": np.float32(step) for name, step in steps.items()}
        arrays |= {"anchor_q": scene.anchor_q, "anchor_step": np.float32(scene.info.voxel_size)}
    for layer, codes in zip(scene.layers, scene.mask, strict=True):
        arrays[f"mask_{layer}"] = codes.astype(np.float32) * MASK_STEP
        if symbols:
            arrays |= {f"mask_{layer}_q": codes.astype(np.int32), f"mask_{layer}_step": MASK_STEP}
    return {name: np.asarray(a) for name, a in (arrays | _meta(scene)).items()}


def _meta(scene: Scene) -> dict[str, np.ndarray]:
    info = scene.info
    meta = {
        "layers": np.array(scene.layers, np.int32),
        "rows": np.array(scene.rows, np.int32),
        "voxel_size": np.float32(info.voxel_size),
        "box": info.box,
        "time_range": np.array(info.time_range, np.float32),
        "background": np.array(info.background, np.float32),
        "near_far": np.array([info.near, info.far], np.float32),
        "up": np.array(info.up, np.float32),
        "unit": np.float32(info.unit),
    }
    if info.camera is not None:
        meta |= {"camera_viewmat": info.camera.viewmat, "camera_K": info.camera.K}
        meta["camera_size"] = np.array([info.camera.width, info.camera.height], np.int32)
    return {f"meta_{name}": np.asarray(value) for name, value in meta.items()}
