"""Runs in the layouts of 4DGaussians, Deformable-3DGS and SC-GS, against the plain torch modules of
`benchmarks/teachers.py`, which follow the published formulas."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from teachers import Deformable, FourD, Nodes, ball, fit
from test_splats import make_splats
from tiny import TINY
from torch import nn

from pd4dgs_codec.data.view import rotation_matrix
from pd4dgs_codec.errors import DataError
from pd4dgs_codec.interchange import runs
from pd4dgs_codec.interchange.teacher import load_source, read_model
from pd4dgs_codec.model.config import PRESETS

DEFORMATION, PLY = "point_cloud/iteration_7/deformation.pth", "point_cloud/iteration_7/point_cloud.ply"
TIMES = (0.0, 0.37, 1.0)


def _covariances(quats: np.ndarray, scales: np.ndarray) -> np.ndarray:
    factor = rotation_matrix(quats) * scales[:, None].astype(np.float64)
    return factor @ factor.transpose(0, 2, 1)


def _same(place: Path, model: FourD | Deformable | Nodes) -> None:
    teacher = read_model(str(place), 30)
    assert teacher.times is None and teacher.seconds == 1
    moved = []
    for t in TIMES:
        with torch.no_grad():
            expected = {name: values.numpy() for name, values in model(t).items()}
        found = teacher.splats(t)
        for name in ("means", "opacities", "sh"):
            np.testing.assert_allclose(getattr(found, name), expected[name], atol=1e-4, err_msg=name)
        theirs = _covariances(expected["quats"], expected["scales"])
        np.testing.assert_allclose(_covariances(found.quats, found.scales), theirs, atol=1e-4)
        moved.append(found)
    assert max(np.ptp([getattr(splats, name) for splats in moved], axis=0).max() for name in vars(found)) > 0.01


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"no_do": False, "no_dshs": False, "depth": 0},
        {"no_dx": True, "depth": 3},
        {"no_ds": True, "no_dr": True},
        {"static_mlp": True, "no_do": False, "no_dshs": False},
        {"apply_rotation": True},
        {"no_dx": True, "no_ds": True, "no_dr": True, "no_do": False},
    ],
    ids=lambda options: ",".join(options) or "usual",
)
def test_4dgaussians_follows_the_published_formulas(tmp_path, options, monkeypatch):
    monkeypatch.setattr(runs, "ROWS", 16)  # of 40
    torch.manual_seed(1)
    model = FourD(splats := make_splats(), **options)
    _same(model.save(tmp_path / "run", splats), model)


@pytest.mark.parametrize("is_blender", [False, True])
@pytest.mark.parametrize("is_6dof", [False, True])
def test_deformable_3dgs_follows_the_published_formulas(tmp_path, is_blender, is_6dof):
    torch.manual_seed(2)
    model = Deformable(splats := make_splats(), is_blender, is_6dof)
    _same(model.save(tmp_path / "run", splats), model)
    _same(tmp_path / "run" / "point_cloud" / "iteration_7", model)


@pytest.mark.parametrize(
    "options",
    [
        {"is_blender": True},
        {"local_frame": True, "gs_with_motion_mask": True},
        {"K": 1, "coordinates": 0, "max_d_scale": 1.5},
        {"K": 5, "is_blender": True, "coordinates": 8, "local_frame": True},
    ],
    ids=lambda options: ",".join(options),
)
def test_sc_gs_follows_the_published_formulas(tmp_path, options, monkeypatch):
    monkeypatch.setattr(runs, "ROWS", 16)  # of 40
    torch.manual_seed(3)
    model = Nodes(splats := make_splats(), **options)
    model.network.gaussian_warp.weight.data *= 4
    _same(model.save(tmp_path / "run", splats), model)


def test_the_last_iteration_and_the_background_of_the_run(tmp_path):
    model = Deformable(splats := make_splats(degree=1))
    run = model.save(tmp_path / "run", splats)
    for number in (9, 30):
        for kind, file in (("point_cloud", "point_cloud.ply"), ("deform", "deform.pth")):
            (run / kind / f"iteration_{number}").mkdir()
            (run / kind / f"iteration_{number}" / file).write_bytes((run / kind / "iteration_7" / file).read_bytes())
    (run / "deform" / "iteration_9" / "deform.pth").write_bytes(b"")
    row = {"rotation": np.eye(3).tolist(), "width": 40, "height": 30, "fx": 30, "fy": 30, "position": [0, 0, -4]}
    (run / "cameras.json").write_text(json.dumps([row, row]))
    for place in (run, run / "point_cloud" / "iteration_7"):
        data = load_source(f"teacher:{place}", holdout=0)
        assert data.background == (1.0, 1.0, 1.0) and len(data.train) == 2
    assert load_source(f"teacher:{run}?background=black", holdout=0).background == (0.0, 0.0, 0.0)
    asked = load_source(f"teacher:{run}?background=black", holdout=0, background=(1.0, 0.0, 0.0))
    assert asked.background == (1.0, 0.0, 0.0)
    with pytest.raises(DataError, match="iteration_9/deform.pth: not a zip archive"):
        read_model(str(run / "point_cloud" / "iteration_9"), 30)


def test_gaussians_that_are_not_finite_are_left_out(tmp_path):
    splats = make_splats()
    model = FourD(splats)
    run = model.save(tmp_path / "run", splats)
    splats.means[3, 1] = np.nan
    model.save(run, splats)
    state = torch.load(run / DEFORMATION)
    assert len(read_model(str(run), 30).splats(0.5).means) == 39
    state["deformation_net.pos_deform.3.bias"][:] = 1e9
    state["deformation_net.pos_deform.3.weight"][:] = 1e9
    torch.save(state, run / DEFORMATION)
    with pytest.raises(DataError, match="at 0.5: none of 39 Gaussians is finite"):
        read_model(str(run), 30).splats(0.5)


NET = "deformation_net."
OFF = b"Namespace(no_ds=True, no_dr=True, no_do=True"


#: A tensor of a network, what replaces it (None: it is left out), and a part of the error.
BROKEN = {
    (FourD, DEFORMATION): [
        (NET + "grid.grids.1.0", None, r"feature_out.0.weight has shape \(32, 32\), expected \(any, 16\)"),
        (NET + "grid.grids.1.4", None, "has no tensor deformation_net.grid.grids.1.4"),
        (NET + "grid.grids.1.4", torch.ones(1, 15, 3, 3), r"\(1, 15, 3, 3\), expected \(1, 16, any, any\)"),
        (NET + "grid.grids.0.0", torch.ones(1, 16, 0, 3), "grids.0.0 has shape"),
        (NET + "grid.grids.0.0", torch.ones(1, 2000, 1, 1), "has 2000 features, expected 1024 at most"),
        (NET + "grid.aabb", torch.ones(2, 3), "aabb is flat"),
        (NET + "grid.aabb", torch.tensor([[1, 1, np.nan], [0, 0, 0]]), "aabb holds a NaN"),
        (NET + "feature_out.0.weight", torch.ones(32, 33), r"has shape \(32, 33\), expected \(any, 32\)"),
        (NET + "feature_out.0.weight", torch.ones(1025, 32), "expected 1024 at most"),
        (NET + "pos_deform.1.bias", None, "has no tensor deformation_net.pos_deform.1.bias"),
        (NET + "pos_deform.3.weight", torch.ones(4, 32), r"expected \(3, 32\)"),
        (NET + "scales_deform.3.bias", "bell \x07\u202e", "has no tensor deformation_net.scales_deform.3.bias"),
    ],
    (Deformable, "deform/iteration_7/deform.pth"): [
        ("linear.0.weight", None, "has no tensor linear.0.weight"),
        ("linear.7.weight", None, "linear.4.weight has shape"),  # seven layers have their skip earlier
        ("linear.0.weight", torch.ones(64, 93), r"expected \(any, 84\)"),
        ("timenet.0.weight", torch.ones(256, 21), r"timenet.0.weight has shape \(256, 21\), expected \(any, 13\)"),
        ("gaussian_warp.weight", None, "has no tensor gaussian_warp.weight"),
        ("branch_w.weight", torch.ones(3, 64), "has no tensor branch_w.bias"),
        ("gaussian_rotation.bias", torch.full((4,), np.inf), "gaussian_rotation.bias holds a NaN or"),
    ],
    (Nodes, "deform/iteration_7/deform.pth"): [
        ("nodes", torch.ones(5, 9), r"nodes .5, 9., 2 features in the PLY file, K=3, expected at most 4096, 3 and"),
        ("nodes", torch.ones(5000, 5), r"nodes .5000, 5., 2 features"),
        ("nodes", torch.ones(2, 5), r"nodes .2, 5., 2 features in the PLY file, K=3, expected .* 1 to 2"),
        ("nodes", torch.full((20, 5), torch.nan), "nodes holds a NaN"),
        ("_node_radius", torch.ones(7), r"_node_radius has shape \(7,\), expected \(20\)"),
        ("_node_weight", None, "has no tensor _node_weight"),
        ("network.gaussian_warp.weight", torch.ones(3, 9), r"gaussian_warp.weight has shape \(3, 9\)"),
        ("network.linear.0.weight", None, "has no tensor network.linear.0.weight"),
        ("network.hashgrid.encoding.params", torch.ones(3), "has network.hashgrid.encoding.params, which no published"),
        ("network.gaussian_color.0.weight", torch.ones(3), "has network.gaussian_color.0.weight, which no published"),
    ],
}  # fmt: skip


@pytest.mark.parametrize("kind, file, name, value, message", [(*of, *case) for of in BROKEN for case in BROKEN[of]])
def test_broken_networks_are_one_line(tmp_path, kind, file, name, value, message):
    model = kind(make_splats())
    run = model.save(tmp_path / "run", make_splats())
    state = model.state_dict() | {name: value}
    torch.save({key: tensor for key, tensor in state.items() if tensor is not None}, run / file)
    with pytest.raises(DataError, match=message) as error:
        read_model(str(run), 30)
    assert Path(file).name in str(error.value) and str(error.value).isprintable()


@pytest.mark.parametrize(
    "file, content, message",
    [
        ("cfg_args", None, "cfg_args: no_ds is missing, expected True or False"),
        ("cfg_args", b"Namespace(no_ds=maybe, no_dr=True)", "no_ds is maybe, expected True or False"),
        ("cfg_args", b"Namespace(grid_pe=2, no_ds=True)", "has grid_pe=2, expected 0 or False"),
        ("cfg_args", b"Namespace(empty_voxel=True)", "has empty_voxel=True"),
        ("cfg_args", OFF + b", static_mlp=True)", "has no tensor deformation_net.static_mlp.1.weight"),
        ("cfg_args", OFF + b", no_dshs=False)", r"shs_deform.3.weight has shape \(48, 32\), expected \(12, 32\)"),
        (DEFORMATION, None, "deformation.pth: cannot be read"),
        (DEFORMATION, b"PK\x03\x04", "damaged or cut short"),
        (PLY, b"ply\n", "point_cloud.ply"),
    ],
)  # fmt: skip
def test_broken_runs_are_one_line(tmp_path, file, content, message):
    run = FourD(make_splats()).save(tmp_path / "run", make_splats(degree=1))
    (run / file).unlink()
    if content is not None:
        (run / file).write_bytes(content)
    with pytest.raises(DataError, match=message):
        read_model(str(run), 30)


@pytest.mark.parametrize(
    "options, message",
    [
        (b"K=many", "K is many, expected a number"),
        (b"L=3", "K is missing, expected a number"),
        (b"K=2.5", "K=2.5, expected at most 4096, 3 and the features, 1 to 16"),
        (b"K=1e99", "K=1e.99, expected at most"),
        (b"K=3, max_d_scale=all", "max_d_scale is all, expected a number"),
    ],
)
def test_options_of_sc_gs_that_do_not_fit(tmp_path, options, message):
    run = Nodes(make_splats()).save(tmp_path / "run", make_splats())
    (run / "cfg_args").write_bytes(b"Namespace(" + options + b")")
    with pytest.raises(DataError, match=message):
        read_model(str(run), 30)


def test_options_of_older_runs(tmp_path):
    """They have neither no_dx nor no_dshs, and a static_mlp that only their first stage uses."""
    model = FourD(splats := make_splats())
    run = model.save(tmp_path / "run", splats)
    model.deformation_net.static_mlp = nn.Sequential(nn.ReLU(), nn.Linear(32, 1))
    torch.save(model.state_dict(), run / DEFORMATION)
    (run / "cfg_args").write_text("Namespace(no_ds=False, no_dr=False, no_do=True, no_grid=False)")
    _same(run, model)


@pytest.mark.parametrize("kind", [FourD, Deformable, Nodes])
def test_import_says_how_to_learn_from_them(tmp_path, cli, kind):
    run = kind(make_splats()).save(tmp_path / "run", make_splats())
    result = cli("import_model", run, "-o", tmp_path / "model.pt")
    assert result.code == 1 and len(result.error_lines) == 1 and not (tmp_path / "model.pt").exists()
    assert f"-o FILE.pd4 packs it, pd4dgs-train teacher:{run} learns from it" in result.err


def test_teaching(tmp_path, cli, monkeypatch):
    monkeypatch.setitem(PRESETS, "tiny", TINY)
    torch.manual_seed(0)
    model = FourD(ball(300))
    fit(model, 60)
    source = f"teacher:{model.save(tmp_path / 'run', ball(300))}?views=12&size=40x40"
    made, packed = tmp_path / "model.pt", tmp_path / "scene.pd4"
    assert cli("train", source, "-o", made, "--preset", "tiny", "--iterations", 60).code == 0
    assert cli("encode", made, "-o", packed, "--effort", 1).code == 0
    levels = cli("eval", packed, source, "--json").json["levels"]
    assert levels[-1]["mpsnr"] > 18
    wrong = cli("train", f"teacher:{tmp_path / 'nowhere'}", "-o", tmp_path / "no.pt")
    assert wrong.code == 1 and len(wrong.error_lines) == 1 and not (tmp_path / "no.pt").exists()
