"""Checkpoints: they come back whole, run nothing, and are refused in one line when anything about them is wrong."""

import errno
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from strategies import LAYER_SETS, assert_same_info, flipped, make_scene
from tiny import Trap

from pd4dgs_codec import decode, encode
from pd4dgs_codec.errors import DataError
from pd4dgs_codec.model import checkpoint
from pd4dgs_codec.model.model import from_scene, to_scene
from pd4dgs_codec.morton import MAX_VOXEL


def model(layers=(0, 1, 2), **options):
    scene = make_scene(3, layers=layers, anchors=7, **options)
    return from_scene(replace(scene, mask=tuple(np.maximum(m, 3) for m in scene.mask)))


@pytest.fixture
def path(tmp_path) -> Path:
    """A whole checkpoint."""
    checkpoint.save(tmp_path / "model.pt", model(), {"iteration": 4})
    return tmp_path / "model.pt"


def rewrite(path: Path, change: Callable[[dict], object]) -> None:
    """Changes the content of a checkpoint, which gets the digest that it then has."""
    content = torch.load(path, weights_only=True)
    change(content)
    torch.save(content | {"digest": checkpoint._digest(content)}, path)


def refusal(path: Path, *says: str) -> str:
    """The one line that `load` raises; it names the file and says this."""
    with pytest.raises(DataError) as caught:
        checkpoint.load(path)
    message = str(caught.value)
    assert "\n" not in message
    for text in (str(path), *says):
        assert text in message
    return message


@pytest.mark.parametrize("layers", LAYER_SETS)
@pytest.mark.parametrize("hidden", [(), (4,), (5, 3)])
def test_round_trip(tmp_path, layers, hidden):
    saved = model(layers, hidden=hidden, scales=2)
    training = {"iteration": 4, "state": {"moment": torch.arange(3.0)}, "order": [2, 0, 1]}
    checkpoint.save(tmp_path / "m.pt", saved, training)
    loaded, extra = checkpoint.load(tmp_path / "m.pt")
    expected, got = saved.state_dict(), loaded.state_dict()
    assert list(got) == list(expected)
    assert all(torch.equal(got[k], expected[k]) and got[k].dtype == expected[k].dtype for k in expected)
    assert (loaded.steps, loaded.level) == (saved.steps, saved.level)
    assert_same_info(loaded.info, saved.info)
    assert (extra["iteration"], extra["order"]) == (4, [2, 0, 1])
    assert torch.equal(extra["state"]["moment"], torch.arange(3.0))


def test_training_cameras_are_remembered(tmp_path):
    scene = make_scene(3)
    seen = [(scene.info.camera, 0.25), (replace(scene.info.camera, width=7), 1.0)]
    checkpoint.save(tmp_path / "m.pt", from_scene(scene), {"viewpoints": seen})
    for (camera, time), (saved, then) in zip(checkpoint.load(tmp_path / "m.pt")[1]["viewpoints"], seen, strict=True):
        assert time == then and (camera.width, camera.height) == (saved.width, saved.height)
        assert np.array_equal(camera.viewmat, saved.viewmat) and np.array_equal(camera.K, saved.K)


@pytest.mark.parametrize(
    "change", [{"width": 0}, {"width": 1 << 20}, {"K": [[1.0, 0.0, 0.0]]}, {"viewmat": [float("nan")]}, {"time": 1.5}]
)
def test_training_cameras_that_cannot_be_are_refused(tmp_path, change):
    scene = make_scene(3)
    checkpoint.save(tmp_path / "m.pt", from_scene(scene), {"viewpoints": [(scene.info.camera, 0.5)]})

    def spoil(content):
        camera, time = content["training"]["viewpoints"][0]
        content["training"]["viewpoints"][0] = [
            {k: change.get(k, v) for k, v in camera.items()},
            change.get("time", time),
        ]

    rewrite(tmp_path / "m.pt", spoil)
    refusal(tmp_path / "m.pt", "missing or misshapen content")


def test_no_camera_and_no_anchors(tmp_path):
    scene = make_scene(0, anchors=0, with_camera=False)
    checkpoint.save(tmp_path / "m.pt", from_scene(scene))
    loaded, training = checkpoint.load(tmp_path / "m.pt")
    assert loaded.info.camera is None and len(loaded.anchor_q) == 0 and training == {}


def test_anchors_beyond_the_limits_of_the_format_are_not_saved(tmp_path):
    """Such a checkpoint replaces none; anchors at a limit come back and are in a file too. Those at both limits of an
    axis are farther apart than in any slice."""
    path, given = tmp_path / "m.pt", model()
    given.anchor_q[1] = MAX_VOXEL
    checkpoint.save(path, given)
    assert decode(encode(to_scene(checkpoint.load(path)[0]), effort=1)).anchor_q.max() == MAX_VOXEL
    before = path.read_bytes()
    for beyond, says in ((1, "anchor_q: voxel index of magnitude 1048577"), (0, "positions span 2097153 voxels")):
        given.anchor_q[1, 0], given.anchor_q[2, 0] = MAX_VOXEL + beyond, -MAX_VOXEL
        with pytest.raises(DataError, match=f"m.pt: the model cannot be stored: {says}"):
            checkpoint.save(path, given)
    assert path.read_bytes() == before and os.listdir(tmp_path) == ["m.pt"]


# -- files that are refused --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("zipped", [True, False])
def test_a_pickle_that_wants_to_run_code_is_refused_unrun(path, tmp_path, zipped):
    target = tmp_path / "ran"
    content = torch.load(path, weights_only=True)
    content["training"] = Trap(target)
    torch.save(content, path, _use_new_zipfile_serialization=zipped)
    refusal(path, "refused" if zipped else "expected a .pd4 file or a pd4dgs-checkpoint")
    assert not target.exists()
    torch.load(path, weights_only=False)  # the trap works
    assert target.exists()


FOREIGN = {
    "a dictionary of weights": ({"weights": torch.zeros(3)}, "weights"),
    "another format": ({"format": "somebody else's", "version": 1}, "format"),
    "a tensor": (torch.zeros(3), "Tensor"),
    "a list": ([1, 2], "list"),
}


@pytest.mark.parametrize("kind", FOREIGN)
def test_checkpoints_of_other_programs(tmp_path, kind):
    content, says = FOREIGN[kind]
    torch.save(content, tmp_path / "m.pt")
    refusal(tmp_path / "m.pt", "not a pd4dgs-checkpoint", says)


@pytest.mark.parametrize("size", [0, 1, 50, 0.3, 0.9, -1])
def test_truncated_files(path, size):
    data = path.read_bytes()
    path.write_bytes(data[: int(size * len(data)) if isinstance(size, float) else size])
    refusal(path)


def same(a, b) -> bool:
    """Whether two checkpoints as `load` gives them hold the same numbers."""
    (first, training), (second, other) = a, b
    left, right = first.state_dict(), second.state_dict()
    return training == other and list(left) == list(right) and all(torch.equal(left[k], right[k]) for k in left)


def test_no_flipped_bit_changes_what_is_loaded(path):
    data, whole = path.read_bytes(), checkpoint.load(path)
    refused = 0
    places = np.random.default_rng(5).integers(0, 8 * len(data), 60)
    for place in places:  # a bit of padding or of a file's date changes nothing
        path.write_bytes(flipped(data, place // 8, 1 << place % 8))
        try:
            loaded = checkpoint.load(path)
        except DataError as error:
            assert "\n" not in str(error)
            refused += 1
        else:
            assert same(loaded, whole)
    assert refused > 5


def test_a_flipped_bit_of_a_tensor_is_named_damage(path):
    feature = checkpoint.load(path)[0].state_dict()["feature"].numpy().tobytes()
    data = path.read_bytes()
    path.write_bytes(flipped(data, data.index(feature) + 2, 4))
    refusal(path, "Bad CRC-32")


def test_content_that_is_not_what_was_saved_is_named_damage(path):
    content = torch.load(path, weights_only=True)
    content["info"]["near"] *= 2
    torch.save(content, path)
    refusal(path, "damaged: its digest")


HOSTILE = {
    "a tensor of 2^45 numbers of one": lambda c: c["state"].update(feature=torch.zeros(1).expand(1 << 45)),
    "a number of 600 digits": lambda c: c.update(training={"iteration": 10**600}),
    "a tensor for a dict": lambda c: c.update(info=torch.zeros(3)),
    "names that are numbers": lambda c: c.update(state={1: torch.zeros(2)}),
    "complex numbers": lambda c: c["state"].update(feature=torch.zeros(3, dtype=torch.complex64)),
    "halves": lambda c: c["state"].update(feature=c["state"]["feature"].half()),
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_what_costs_more_than_it_weighs_is_refused_in_one_line(path, kind):
    content = torch.load(path, weights_only=True)
    HOSTILE[kind](content)
    torch.save(content | {"digest": "0" * 64}, path, _use_new_zipfile_serialization=True)
    refusal(path)


def test_missing_files_and_folders(tmp_path):
    refusal(tmp_path / "none.pt", "No such")
    (tmp_path / "folder.pt").mkdir()
    refusal(tmp_path / "folder.pt")


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize("name", ["feature", "networks.color.linears.0.bias", "local_deformation.planes.grid"])
def test_numbers_that_are_not_finite(path, name, value):
    rewrite(path, lambda content: content["state"][name].view(-1)[-1].fill_(value))
    refusal(path, name, "finite")


def reshaped(name, change):
    return lambda content: content["state"].update({name: change(content["state"][name])})


LAST_OF_POSITION = tuple(f"local_deformation.heads.position.linears.0.{part}" for part in ("weight", "bias"))
MISSHAPEN = {
    **{
        f"no {name}": lambda content, name=name: content.pop(name)
        for name in ("state", "info", "steps", "deformations", "training")
    },
    **{
        f"no {name}": lambda content, name=name: content["state"].pop(name)
        for name in (
            "anchor_q", "offset", "mask_logits", "networks.opacity.linears.0.bias",
            "global_deformation.trunk.linears.0.weight", "local_deformation.planes.grid",
        )
    },
    "an unknown step": lambda content: content["steps"].update(color=1.0),
    "an info without box": lambda content: content["info"].pop("box"),
    "state is a list": lambda content: content.update(state=[1, 2]),
    "no colour network": lambda c: [c["state"].pop(k) for k in list(c["state"]) if k.startswith("networks.color.")],
    "an unknown tensor": lambda content: content["state"].update(extra=torch.zeros(2)),
    "a row too few": reshaped("feature", lambda a: a[:-1]),
    "a column too many": reshaped("feature", lambda a: torch.cat([a, a[:, :1]], dim=1)),
    "two offsets short": reshaped("offset", lambda a: a[:, :8]),
    "two mask levels": reshaped("mask_logits", lambda a: a[:, :2]),
    "planes too short": reshaped("global_deformation.planes.grid", lambda a: a[:-1]),
    "a flat weight": reshaped("networks.color.linears.0.weight", lambda a: a.flatten()),
    "a bias too long": reshaped("networks.color.linears.1.bias", lambda a: torch.cat([a, a])),
    "a number for a tensor": reshaped("feature", lambda a: 3.0),
    "training is a list": lambda content: content.update(training=[1]),
    "cells of two coordinates": reshaped("anchor_q", lambda a: a[:, :2]),
    "cells between the cells": reshaped("anchor_q", lambda a: a + 0.5),
    "cells beyond int32": reshaped("anchor_q", lambda a: a.long() + 2**33),
    "a weight too wide": reshaped("networks.color.linears.0.weight", lambda a: torch.cat([a, a[:, :1]], dim=1)),
    "an output short": lambda c: [c["state"].update({k: c["state"][k][1:]}) for k in LAST_OF_POSITION],
    "planes of another resolution": lambda content: content["deformations"].update(local=[[60_000, 60_000, 1, 1]]),
    "a step of zero": lambda content: content["steps"].update(feature=0.0),
    "a step in words": lambda content: content["steps"].update(feature="fine"),
    "a NaN voxel": lambda content: content["info"].update(voxel_size=float("nan")),
    "an infinite near": lambda content: content["info"].update(near=float("inf")),
    "a box upside down": lambda content: content["info"].update(box=content["info"]["box"][::-1]),
    "a camera of 2 x 2": lambda content: content["info"]["camera"].update(K=[[1.0, 0.0], [0.0, 1.0]]),
}  # fmt: skip


@pytest.mark.parametrize("fault", MISSHAPEN)
def test_missing_and_misshapen_content(path, fault):
    rewrite(path, MISSHAPEN[fault])
    refusal(path, "missing or misshapen")


@pytest.mark.parametrize("version", [0, 2, "1", True, 1.0, None, torch.zeros(2)])
def test_other_versions(path, version):
    rewrite(path, lambda content: content.update(version=version))
    refusal(path, f"version {version!r}", "expected 1")


def test_text_is_not_called_pickled_code(tmp_path):
    (tmp_path / "m.pt").write_text("hello")
    assert "pickled" not in refusal(tmp_path / "m.pt", "found a file that begins with")


# -- writing -----------------------------------------------------------------------------------------------------------


def test_a_folder_that_is_not_there(tmp_path):
    with pytest.raises(DataError, match="none"):
        checkpoint.save(tmp_path / "none" / "m.pt", model())


def test_a_file_that_may_not_grow_ends_in_the_systems_own_words(path, tmp_path):
    """A real write that stops half-way."""
    resource = pytest.importorskip("resource")
    before, limits = path.read_bytes(), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) // 2, limits[1]))  # Python ignores SIGXFSZ
    try:
        with pytest.raises(DataError, match=f"cannot write the checkpoint: {os.strerror(errno.EFBIG)}"):
            checkpoint.save(path, model())
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert path.read_bytes() == before and os.listdir(tmp_path) == ["model.pt"]
