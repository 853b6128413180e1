"""Checkpoints in the layout of Scaffold-GS, against its published formulas in float64."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny import camera_ahead
from torch import nn

from pd4dgs_codec.errors import DataError
from pd4dgs_codec.format.decoder import decode
from pd4dgs_codec.format.encoder import encode
from pd4dgs_codec.interchange.scaffold_gs import read_scaffold_gs
from pd4dgs_codec.model import checkpoint
from pd4dgs_codec.model.model import from_scene, to_scene

F, K, N, PICTURES, APPEARANCE = 32, 10, 40, 5, 8


class Checkpoint:
    """A checkpoint in memory: anchors on a grid, decoders, perhaps an embedding."""

    def __init__(self, seed: int = 0, appearance: bool = False, distance: bool = False, voxel: float = 0.01):
        rng = np.random.default_rng(seed)
        cells = np.unique(rng.integers(-80, 81, (N, 3)), axis=0)
        self.anchor = (cells * voxel).astype(np.float32)
        n = len(cells)
        self.feature = rng.normal(0, 0.5, (n, F)).astype(np.float32)
        self.offset = rng.normal(0, 0.5, (n, K, 3)).astype(np.float32)
        self.scaling_log = rng.normal(-2, 0.4, (n, 6)).astype(np.float32)
        torch.manual_seed(seed)
        inputs = F + 3 + distance
        self.opacity = nn.Sequential(nn.Linear(inputs, F), nn.ReLU(True), nn.Linear(F, K), nn.Tanh())
        self.cov = nn.Sequential(nn.Linear(inputs, F), nn.ReLU(True), nn.Linear(F, 7 * K))
        extra = APPEARANCE if appearance else 0
        self.color = nn.Sequential(nn.Linear(inputs + extra, F), nn.ReLU(True), nn.Linear(F, 3 * K), nn.Sigmoid())
        self.embedding = rng.normal(size=(PICTURES, APPEARANCE)).astype(np.float32) if appearance else None

    def write(self, folder: Path, *, script: bool = True, omit: str = "") -> Path:
        """The folder of an iteration."""
        place = folder / "point_cloud" / "iteration_300"
        place.mkdir(parents=True, exist_ok=True)
        n = len(self.anchor)
        names = ["x", "y", "z", "nx", "ny", "nz", *(f"f_offset_{i}" for i in range(3 * K))]
        names += [*(f"f_anchor_feat_{i}" for i in range(F)), "opacity", *(f"scale_{i}" for i in range(6))]
        names += [f"rot_{i}" for i in range(4)]
        columns = (
            self.anchor, np.zeros((n, 3)), self.offset.transpose(0, 2, 1).reshape(n, -1), self.feature,
            np.zeros((n, 1)), self.scaling_log, np.tile([1.0, 0, 0, 0], (n, 1)),
        )  # fmt: skip
        table = np.concatenate(columns, axis=1).astype("<f4")
        keep = [i for i, name in enumerate(names) if name != omit]
        head = ["ply", "format binary_little_endian 1.0", f"element vertex {n}"]
        head += [*(f"property float {names[i]}" for i in keep), "end_header", ""]
        (place / "point_cloud.ply").write_bytes("\n".join(head).encode() + table[:, keep].tobytes())
        modules = {"opacity_mlp": self.opacity, "cov_mlp": self.cov, "color_mlp": self.color}
        table = nn.Embedding.from_pretrained(torch.from_numpy(self.embedding)) if self.embedding is not None else None
        if script:
            for name, module in modules.items():
                torch.jit.trace(module.eval(), torch.zeros(1, module[0].in_features)).save(place / f"{name}.pt")
            if table is not None:
                torch.jit.trace(table, torch.zeros(1, dtype=torch.long)).save(place / "embedding_appearance.pt")
        else:
            states = {name: module.state_dict() for name, module in modules.items()}
            torch.save(states | ({"appearance": table.state_dict()} if table else {}), place / "checkpoints.pth")
        return place

    def gaussians(self, eye: np.ndarray, picture: int | None = None) -> dict[str, np.ndarray]:
        """What Scaffold-GS draws, by the formulas of its paper (sections 3.2 and 3.3), float64."""

        def layers(module: nn.Sequential, x: np.ndarray) -> np.ndarray:
            (a, b), (c, d) = (
                (module[i].weight.detach().double().numpy(), module[i].bias.detach().double().numpy()) for i in (0, 2)
            )
            return np.maximum(x @ a.T + b, 0) @ c.T + d

        anchor, n = self.anchor.astype(np.float64), len(self.anchor)
        view = anchor - eye
        inputs = np.concatenate([self.feature, view / np.linalg.norm(view, axis=1, keepdims=True)], axis=1)
        seen = inputs
        if picture is not None:
            seen = np.concatenate([inputs, np.tile(self.embedding[picture], (n, 1))], axis=1)
        shape = layers(self.cov, inputs).reshape(n, K, 7)
        extent = np.exp(self.scaling_log.astype(np.float64))[:, None]
        return {
            "means": anchor[:, None] + self.offset * extent[..., :3],
            "scales": extent[..., 3:] / (1 + np.exp(-shape[..., :3])),
            "quats": shape[..., 3:] / np.linalg.norm(shape[..., 3:], axis=2, keepdims=True),
            "opacities": np.tanh(layers(self.opacity, inputs)),
            "colors": 1 / (1 + np.exp(-layers(self.color, seen).reshape(n, K, 3))),
        }


def _same(model, theirs: Checkpoint, picture: int | None = None) -> None:
    shown = 0
    for x in (-0.4, 0.5):
        camera = camera_ahead(3.0, focal=20.0)
        camera.viewmat[0, 3] = x
        expected = theirs.gaussians(np.array([-x, 0, -3.0]), picture)
        with torch.no_grad():
            found = model.gaussians(0, 0.0, camera)
        cells = np.round(theirs.anchor / model.info.voxel_size)  # rows may be in another order
        order = [int(np.flatnonzero((cells == cell).all(axis=1))[0]) for cell in model.anchor_q.numpy()]
        slots = found.slots.numpy()
        rows, columns = np.array(order)[slots // K], slots % K
        for name, values in expected.items():
            np.testing.assert_allclose(getattr(found, name).numpy(), values[rows, columns], atol=1e-4, err_msg=name)
        drawn = int((expected["opacities"] >= 1 / 255).sum())  # all anchors are in view
        assert abs(len(slots) - drawn) <= 1
        shown += len(slots)
    assert shown > 100


@pytest.mark.parametrize("script", [True, False])
@pytest.mark.parametrize("appearance", [False, True])
def test_imported_gaussians_follow_the_published_formulas(tmp_path, cli, script, appearance):
    theirs = Checkpoint(appearance=appearance)
    theirs.write(tmp_path / "run", script=script)
    out = tmp_path / "model.pt"
    chosen = ("--appearance", 3) if appearance else ()
    result = cli("import_model", tmp_path / "run", "-o", out, "--json", *chosen)
    assert result.code == 0, result.err
    assert result.json["anchors"] == len(theirs.anchor) and result.json["voxel_size"] == pytest.approx(0.01)
    model, _ = checkpoint.load(out)
    _same(model, theirs, 3 if appearance else None)


def test_imported_scene_encodes_and_keeps_its_anchors(tmp_path):
    theirs = Checkpoint(1)
    scene = read_scaffold_gs(theirs.write(tmp_path))
    back = decode(encode(to_scene(from_scene(scene)), layers=0, effort=1))
    assert back.layers == (0,)
    order = np.lexsort(back.anchor.T), np.lexsort(theirs.anchor.T)
    np.testing.assert_allclose(back.anchor[order[0]], theirs.anchor[order[1]], atol=1e-6)


@pytest.mark.parametrize("silent", [False, True])
def test_features_are_whitened(tmp_path, silent):
    """Channels mixed from five sources become independent and take fewer bytes. silent: decoders without weights, which
    leave the features as they are."""
    theirs, rng = Checkpoint(2), np.random.default_rng(2)
    n = len(theirs.anchor)
    mixed = rng.normal(size=(n, 5)) @ rng.normal(size=(5, F)) + rng.normal(size=(n, F)) / 9
    theirs.feature = mixed.astype(np.float32)
    if silent:
        for module in (theirs.opacity, theirs.cov, theirs.color):
            torch.nn.init.zeros_(module[0].weight)
    scene = read_scaffold_gs(theirs.write(tmp_path))
    if silent:
        np.testing.assert_array_equal(np.sort(scene.feature, axis=0), np.sort(theirs.feature, axis=0))
        return
    correlation = np.corrcoef(scene.feature.T) - np.eye(F)
    assert np.abs(correlation).max() < 1e-3 < 0.5 < np.abs(np.corrcoef(theirs.feature.T) - np.eye(F)).max()
    steps = scene.steps.feature
    entropy = [np.log2(1 + feature.std(axis=0) / steps).sum() for feature in (scene.feature, theirs.feature)]
    assert entropy[0] < 0.8 * entropy[1]


def test_run_files_give_voxel_background_and_camera(tmp_path):
    theirs = Checkpoint(voxel=0.02)
    theirs.write(tmp_path)
    text = "Namespace(feat_dim=32, voxel_size=0.005, white_background=True, __import__('os').mkdir('x'))"
    (tmp_path / "cfg_args").write_text(text)
    turn = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    row = {"id": 0, "position": [1, 2, 3], "rotation": turn, "width": 64, "height": 48, "fx": 50.0, "fy": 51.0}
    (tmp_path / "cameras.json").write_text(json.dumps([row]))
    info = read_scaffold_gs(tmp_path).info
    assert info.voxel_size == np.float32(0.005) and info.background == (1.0, 1.0, 1.0) and info.near == np.float32(0.2)
    assert info.up == (0.0, 0.0, 1.0)  # minus the second column of the camera's rotation
    viewmat = info.camera.viewmat.astype(float)
    np.testing.assert_allclose(viewmat @ [1, 2, 3, 1], [0, 0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(viewmat[:3, :3], np.transpose(turn))
    assert (info.camera.width, info.camera.height, info.camera.K[1, 1]) == (64, 48, 51)
    upside_down = row | {"rotation": [[1, 0, 0], [0, 0, -1], [0, 1, 0]]}
    (tmp_path / "cameras.json").write_text(json.dumps([row, upside_down]))
    assert np.linalg.norm(read_scaffold_gs(tmp_path).info.up) == pytest.approx(1)
    for content, message in (
        ("[]", "expected a list of cameras with position"),
        ("[3]", "expected a list of cameras"),
        ("[{}]", "camera 0: rotation is missing"),
        (json.dumps([row, row | {"position": [1, 2]}]), r"camera 1: position has shape \(2,\), expected \(3,\)"),
        (json.dumps([row | {"rotation": [[1, 0, 0], [0, 2, 0], [0, 0, 1]]}]), "camera 0: rotation is not a rotation"),
        (json.dumps([row | {"fx": "wide"}]), "camera 0: fx is 'wide', expected a number > 0"),
        (json.dumps([row | {"width": 70_000}]), "camera 0: width is 70000, expected a number and at most 65535"),
    ):
        (tmp_path / "cameras.json").write_text(content)
        with pytest.raises(DataError, match=f"cameras.json: {message}"):
            read_scaffold_gs(tmp_path)


@pytest.mark.parametrize("voxel", [0.001, 0.37, 1 / 3])
def test_the_grid_is_found_in_the_anchors(tmp_path, voxel):
    assert read_scaffold_gs(Checkpoint(voxel=voxel).write(tmp_path)).info.voxel_size == pytest.approx(voxel)


def _fails(tmp_path: Path, cli, *options: object) -> str:
    out = tmp_path / "model.pt"
    result = cli("import_model", tmp_path / "run", "-o", out, *options)
    assert result.code == 1 and len(result.error_lines) == 1 and not out.exists(), result.err
    return result.err


def test_unsupported_models_are_refused(tmp_path, cli):
    place = Checkpoint(distance=True).write(tmp_path / "run")
    assert "takes the distance as well (36 inputs), expected 35" in _fails(tmp_path, cli)
    (place / "feature_bank_mlp.pt").touch()
    assert "has a bank of features (feature_bank_mlp.pt)" in _fails(tmp_path, cli)


def test_an_appearance_has_to_be_chosen(tmp_path, cli):
    Checkpoint(appearance=True).write(tmp_path / "run")
    assert "choose one of 5 pictures with --appearance 0..4" in _fails(tmp_path, cli)
    assert "--appearance 0..4" in _fails(tmp_path, cli, "--appearance", 5)


EMPTY = b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\nproperty float z\nend_header\n"


def test_broken_plys(tmp_path, cli):
    theirs = Checkpoint()
    for name, message in (
        ("scale_4", "has no property scale_4"),
        ("f_anchor_feat_31", "(35 inputs), expected 34"),
        ("f_offset_29", "29 coordinates of offsets"),
    ):
        theirs.write(tmp_path / "run", omit=name)
        assert message in _fails(tmp_path, cli)
    place = theirs.write(tmp_path / "run")
    assert "voxels off the grid of 0.007" in _fails(tmp_path, cli, "--voxel-size", 0.007)
    assert "voxels of 1e-09 away" in _fails(tmp_path, cli, "--voxel-size", 1e-9)
    for size, held in ((1e39, "inf"), (1e-46, "0")):
        assert f"the voxel size is {held} in binary32" in _fails(tmp_path, cli, "--voxel-size", size)
    assert "several anchors lie in voxel [0, 0, 0] of 1e+30" in _fails(tmp_path, cli, "--voxel-size", 1e30)
    far = Checkpoint(voxel=2**-7)
    far.anchor[:2, 0] = -(2**13), 2**13  # farther apart than in any slice
    far.write(tmp_path / "run")
    assert "model.pt: the model cannot be stored: positions span 2097153 voxels" in _fails(
        tmp_path, cli, "--voxel-size", 2**-7
    )
    theirs.anchor[7] = theirs.anchor[3]  # such a checkpoint could not be encoded
    theirs.write(tmp_path / "run")
    assert "several anchors lie in voxel [" in _fails(tmp_path, cli)
    theirs.anchor[7] += np.float32(1e-7)
    theirs.offset[3, 2, 1] = np.nan
    theirs.write(tmp_path / "run")
    assert "f_offset_* holds a NaN" in _fails(tmp_path, cli)
    (place / "point_cloud.ply").write_bytes(EMPTY)
    assert "holds no anchor" in _fails(tmp_path, cli)


def test_broken_folders(tmp_path, cli):
    assert "found nothing" in _fails(tmp_path, cli)
    (tmp_path / "run").mkdir()
    assert "has no point_cloud.ply" in _fails(tmp_path, cli)
    place = Checkpoint().write(tmp_path / "run")
    (place / "cov_mlp.pt").unlink()
    assert "cov_mlp.pt: cannot be read" in _fails(tmp_path, cli)
    (place / "cov_mlp.pt").write_bytes(b"no archive")
    assert "cov_mlp.pt: not a zip archive of tensors" in _fails(tmp_path, cli)
    torch.jit.trace(nn.Sequential(nn.Linear(35, F), nn.GELU(), nn.Linear(F, 7 * K)), torch.zeros(1, 35)).save(
        place / "cov_mlp.pt"
    )
    assert "layers are Linear, GELU, Linear; expected Linear, ReLU, Linear" in _fails(tmp_path, cli)
