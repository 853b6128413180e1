"""Explicit Gaussians: harmonics, rotations, the eye's place, and exported files through independent readers."""

import io
import os
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from teachers import parameters
from tiny import camera_ahead

from pd4dgs_codec.data.view import rotation_matrix
from pd4dgs_codec.errors import DataError
from pd4dgs_codec.interchange.splats import fourdgs_bytes, glb_bytes, picture, ply_bytes, quaternions, spz_bytes
from pd4dgs_codec.kinds.splats import SH_C0, Splats, harmonics, unit


def test_harmonics_are_the_real_ones_with_the_condon_shortley_phase():
    special = pytest.importorskip("scipy.special")
    directions = unit(np.random.default_rng(0).normal(size=(50, 3)))
    polar, azimuth = np.arccos(directions[:, 2]), np.arctan2(directions[:, 1], directions[:, 0])
    expected = []
    for degree in range(4):
        for order in range(-degree, degree + 1):
            y = special.sph_harm_y(degree, abs(order), polar, azimuth)  # with the phase
            expected.append(y.real if order == 0 else np.sqrt(2) * (y.real if order > 0 else y.imag))
    np.testing.assert_allclose(harmonics(directions, 3), np.stack(expected, axis=1), atol=1e-12)
    np.testing.assert_array_equal(harmonics(directions, 1), harmonics(directions, 3)[:, :4])


def test_quaternions_and_rotations_are_inverse():
    quats = unit(np.random.default_rng(1).normal(size=(200, 4)))
    half_turns = np.eye(4)[1:]
    for q in (quats, half_turns, -quats):
        back = quaternions(rotation_matrix(q))
        np.testing.assert_allclose(np.abs(np.einsum("nd,nd->n", back, q)), 1, atol=1e-12)
    matrices = rotation_matrix(quats)
    np.testing.assert_allclose(
        matrices @ matrices.transpose(0, 2, 1), np.broadcast_to(np.eye(3), (200, 3, 3)), atol=1e-12
    )


def test_a_splat_shows_its_colour_to_the_eye_that_sees_it_along_z():
    sh = np.zeros((1, 4, 3), np.float32)
    sh[0, 0] = (np.array([0.9, 0.5, 0.1]) - 0.5) / SH_C0
    sh[0, 2, 1] = 0.2 / 0.4886025119029199  # 0.2 of green for directions along +z
    one = np.ones(1, np.float32)
    splats = Splats(np.zeros((1, 3), np.float32), np.float32([[1, 0, 0, 0]]), np.full((1, 3), 0.5, np.float32), one, sh)
    camera = camera_ahead(3.0, width=31, height=23)
    np.testing.assert_allclose(camera.eye, (0, 0, -3))
    np.testing.assert_allclose(splats.colors(camera.eye), [[0.9, 0.7, 0.1]], atol=1e-6)
    np.testing.assert_allclose(splats.colors(np.array([0, 0, 3.0])), [[0.9, 0.3, 0.1]], atol=1e-6)
    image = picture(splats, camera, (0.0, 0.0, 0.0))
    np.testing.assert_allclose(image[11, 15], (0.9, 0.7, 0.1), atol=2e-2)


# -- exported files through independent readers ------------------------------------------------------------------------


def make_splats(n: int = 40, degree: int = 3, seed: int = 0) -> Splats:
    rng = np.random.default_rng(seed)
    return Splats(
        rng.normal(size=(n, 3)).astype(np.float32),
        unit(rng.normal(size=(n, 4))).astype(np.float32),
        np.exp(rng.normal(-2, 0.5, (n, 3))).astype(np.float32),
        rng.uniform(0.05, 0.95, n).astype(np.float32),
        rng.normal(0, 0.2, (n, (degree + 1) ** 2, 3)).astype(np.float32),
    )


def gsplat_state(splats: Splats) -> dict[str, torch.Tensor]:
    """The Gaussians in a checkpoint of gsplat, whose quaternions have any length."""
    state = parameters(splats)
    sh = state.pop("sh")
    return state | {"quats": 3 * state["quats"], "sh0": sh[:, :1].clone(), "shN": sh[:, 1:].clone()}


def read_glb(path: Path) -> tuple[Any, dict[str, np.ndarray]]:
    """By pygltflib: the document of a glTF file, and the attributes of its Gaussians by name, float32 [n, width]."""
    document, attributes = pytest.importorskip("pygltflib").GLTF2().load(str(path)), {}
    for name, index in vars(document.meshes[0].primitives[0].attributes).items():
        if index is not None and name != "COLOR_0":  # for viewers that know no splats
            row = document.accessors[index]
            view = document.bufferViews[row.bufferView]
            width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[row.type]
            start = view.byteOffset + (row.byteOffset or 0)
            values = np.frombuffer(document.binary_blob(), "<f4", row.count * width, start)
            attributes[name] = values.reshape(-1, width)
    return document, attributes


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_plyfile_reads_the_layout_of_3d_gaussian_splatting(degree):
    plyfile = pytest.importorskip("plyfile")
    splats = make_splats(degree=degree)
    vertices = plyfile.PlyData.read(io.BytesIO(ply_bytes(splats)))["vertex"].data
    rest = 3 * ((degree + 1) ** 2 - 1)
    assert len(vertices) == 40 and len(vertices.dtype.names) == 17 + rest
    assert vertices.dtype.names[:9] == ("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2")

    def columns(*names):
        return np.stack([vertices[name] for name in names], axis=1)

    np.testing.assert_array_equal(columns("x", "y", "z"), splats.means)
    np.testing.assert_array_equal(columns("f_dc_0", "f_dc_1", "f_dc_2"), splats.sh[:, 0])
    for channel in range(3):  # all coefficients of red, then of green, then of blue
        for j in range(1, (degree + 1) ** 2):
            np.testing.assert_array_equal(vertices[f"f_rest_{channel * rest // 3 + j - 1}"], splats.sh[:, j, channel])
    np.testing.assert_allclose(1 / (1 + np.exp(-vertices["opacity"])), splats.opacities, rtol=1e-5)
    np.testing.assert_allclose(np.exp(columns("scale_0", "scale_1", "scale_2")), splats.scales, rtol=1e-5)
    np.testing.assert_array_equal(columns("rot_0", "rot_1", "rot_2", "rot_3"), splats.quats)


def test_opacities_of_0_and_1_and_flat_gaussians_are_finite_in_a_ply():
    plyfile = pytest.importorskip("plyfile")
    splats = make_splats(2)
    splats.opacities[:] = 0, 1
    splats.scales[0, 0] = 0
    vertices = plyfile.PlyData.read(io.BytesIO(ply_bytes(splats)))["vertex"].data
    assert all(np.isfinite(vertices[name]).all() for name in vertices.dtype.names)


@pytest.mark.parametrize("degree", [0, 2])
def test_pygltflib_and_fourdgs_read_the_glb(tmp_path, degree):
    pygltflib, fourdgs = pytest.importorskip("pygltflib"), pytest.importorskip("fourdgs")
    splats, path = make_splats(degree=degree), tmp_path / "scene.glb"
    path.write_bytes(glb_bytes(splats))
    document, found = read_glb(path)
    (primitive,) = document.meshes[0].primitives
    assert document.extensionsUsed == ["KHR_gaussian_splatting"] and primitive.mode == pygltflib.POINTS
    assert primitive.extensions["KHR_gaussian_splatting"]["kernel"] == "ellipse"

    prefix = "KHR_gaussian_splatting:"
    np.testing.assert_array_equal(found["POSITION"], splats.means)
    np.testing.assert_array_equal(found[prefix + "SCALE"], splats.scales)
    np.testing.assert_array_equal(found[prefix + "OPACITY"][:, 0], splats.opacities)
    np.testing.assert_array_equal(found[prefix + "ROTATION"][:, [3, 0, 1, 2]], splats.quats)
    names = [f"SH_DEGREE_{l}_COEF_{i}" for l in range(degree + 1) for i in range(2 * l + 1)]
    for j, name in enumerate(names):
        np.testing.assert_array_equal(found[prefix + name], splats.sh[:, j])
    row = document.accessors[primitive.attributes.POSITION]
    np.testing.assert_array_equal([row.min, row.max], [splats.means.min(axis=0), splats.means.max(axis=0)])

    other = fourdgs.from_gltf(str(path)).gaussians
    np.testing.assert_allclose(other.positions, splats.means, atol=1e-6)
    np.testing.assert_allclose(other.scales, splats.scales, rtol=1e-6)
    np.testing.assert_allclose(other.rotations[:, [3, 0, 1, 2]], splats.quats, atol=1e-6)
    np.testing.assert_allclose(other.colors[:, 3], splats.opacities, atol=1e-6)
    assert other.sh_degree == degree


def test_gaussforge_reads_the_spz_back(capfdbinary):
    gaussforge = pytest.importorskip("gaussforge")
    splats = make_splats()
    data = spz_bytes(splats)
    assert capfdbinary.readouterr().out == b""
    ir = gaussforge.GaussForge().read(data, "spz")["data"]
    names = ("positions", "scales", "rotations", "alphas", "colors", "sh")
    fields = {name: np.frombuffer(ir[name], "<f4") for name in names}
    np.testing.assert_allclose(fields["positions"].reshape(-1, 3), splats.means, atol=1 / 4096)
    np.testing.assert_allclose(np.exp(fields["scales"].reshape(-1, 3)), splats.scales, rtol=0.04)
    dots = np.einsum("nd,nd->n", fields["rotations"].reshape(-1, 4), splats.quats)
    assert np.abs(dots).min() > 0.999
    np.testing.assert_allclose(1 / (1 + np.exp(-fields["alphas"])), splats.opacities, atol=1 / 255)
    np.testing.assert_allclose(fields["colors"].reshape(-1, 3), splats.sh[:, 0], atol=0.03)
    np.testing.assert_allclose(fields["sh"].reshape(-1, 15, 3), splats.sh[:, 1:], atol=0.07)


def test_spz_refuses_positions_out_of_range():
    pytest.importorskip("gaussforge")
    with pytest.raises(DataError, match="a Gaussian lies .* units from 0, expected less than 2048"):
        spz_bytes(make_splats().scaled(1e4))
    splats = make_splats()
    with pytest.raises(DataError, match="a Gaussian lies"):  # which rounding would bring to the other end
        spz_bytes(splats.scaled(2047.9999 / float(np.abs(splats.means).max())))


def test_fourdgs_reads_moving_gaussians():
    fourdgs = pytest.importorskip("fourdgs")
    first, second = make_splats(30, 1, 1), make_splats(20, 1, 1)
    second = replace(second, means=first.means[:20] + np.float32(0.1))
    data = fourdgs_bytes([(0.0, first, np.arange(30)), (0.5, second, np.arange(20))], 1.0)
    back = fourdgs.read(data)
    assert back.header.duration_sec == 1.0 and back.gaussians.sh_degree == 1
    for t, expected, moved in ((0.0, first, 0.0), (0.25, first, 0.05), (0.75, second, 0.0)):
        centres = back.gaussians.state_at(t)["centers"]
        assert len(centres) == len(expected.means)
        goal = expected.means.copy()
        goal[:20] += np.float32(moved)
        distance = np.abs(centres[:, None] - goal[None]).max(axis=2)
        assert distance.min(axis=0).max() < 0.01 and distance.min(axis=1).max() < 0.01


@pytest.mark.parametrize("fps", [24, 30, 240])
def test_fast_gaussians_are_where_they_should_be_in_a_4dgs_file(fps):
    """fourdgs rounds to 4 ms the instant that a moving Gaussian's position is of."""
    fourdgs = pytest.importorskip("fourdgs")
    still, speed, slots = make_splats(60, 0), np.float32([20, -9, 4]), np.arange(60)
    frames = [(i / fps, replace(still, means=still.means + speed * np.float32(i / fps)), slots) for i in range(8)]
    back = fourdgs.read(fourdgs_bytes(frames, 8 / fps))
    for t in (0, 0.5 / fps, 3 / fps, 6.99 / fps):
        difference = (still.means + speed * np.float32(t))[:, None] - back.state_at(t)["centers"]
        assert np.abs(difference).max(axis=2).min(axis=1).max() < 0.015  # 2 ms are 0.04


def test_harmonics_that_are_0_stay_0_in_a_4dgs_file():
    fourdgs = pytest.importorskip("fourdgs")
    splats = make_splats(10, 3)
    for degree in (3, 2, 1, 0):
        splats.sh[:, (degree + 1) ** 2 :] = 0.015  # of all bytes, the nearest is further away than 0
        back = fourdgs.read(fourdgs_bytes([(0.0, splats, np.arange(10))], 1.0))
        assert back.gaussians.sh_degree == degree
        if degree:
            stored = np.sort(back.gaussians.sh.reshape(10, 3, -1) * (8 / 255) - 4, axis=0)
            goal = np.sort(splats.sh[:, 1 : (degree + 1) ** 2].transpose(0, 2, 1), axis=0)
            np.testing.assert_allclose(stored, goal, atol=4 / 255 + 1e-6)
    assert back.gaussians.sh is None
    assert back.header.attributes == {"color_space": "srgb-rec709-display", "visibility_profile": "box"}


#: Of `npm install --ignore-scripts @playcanvas/splat-transform@3.7.0`, by default in the checkout's root.
MODULES = Path(os.environ.get("PD4DGS_NODE_MODULES", Path(__file__).parents[2] / "node_modules"))
PROGRAM = MODULES / "@playcanvas" / "splat-transform" / "bin" / "cli.mjs"


@pytest.mark.skipif(not (shutil.which("node") and PROGRAM.is_file()), reason=f"node and {PROGRAM} are needed")
def test_splat_transform_writes_the_same_glb(tmp_path):
    """It turns a PLY half around z, for +y to be up. Each attribute is that of ours, turned by hand."""
    splats, ours, theirs = make_splats(), tmp_path / "ours.glb", tmp_path / "theirs.glb"
    (tmp_path / "scene.ply").write_bytes(ply_bytes(splats))
    command = ["node", PROGRAM, "-w", tmp_path / "scene.ply", theirs]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0 and theirs.is_file(), done.stdout + done.stderr
    w, x, y, z = splats.quats.T
    direction = unit(np.array([[0.3, 0.5, 0.7]]))
    before, after = (harmonics(d, 3)[0] for d in (direction, direction * (-1, -1, 1)))
    turned = Splats(
        splats.means * np.float32([-1, -1, 1]), np.stack([-z, -y, x, w], axis=1), splats.scales, splats.opacities,
        (splats.sh * np.sign(before * after)[:, None]).astype(np.float32),
    )  # fmt: skip
    ours.write_bytes(glb_bytes(turned))

    (_, mine), (_, others) = map(read_glb, (ours, theirs))
    assert mine.keys() == others.keys() and len(mine) == 4 + 16
    for name, values in mine.items():
        if name.endswith("ROTATION"):
            assert np.abs(np.einsum("nd,nd->n", values, others[name])).min() > 1 - 1e-6
        else:
            np.testing.assert_allclose(values, others[name], atol=1e-5, err_msg=name)
