"""Splats are exported as they are: every number of a PLY, and colours and shapes of a turned world."""

import numpy as np
import pytest
from explicit import visible_splats

from pd4dgs_codec import decode, encode
from pd4dgs_codec.data.view import rotation_matrix
from pd4dgs_codec.draw.player import drawer
from pd4dgs_codec.interchange.export import exported, upright
from pd4dgs_codec.interchange.splats import ply_bytes, read_splats


@pytest.fixture(scope="module")
def scene():
    return decode(encode(visible_splats(degree=3), effort=1))


def test_a_ply_holds_the_gaussians_of_the_file(scene, tmp_path):
    splats, rows = exported(drawer(scene), 0.7, None, 3)
    own, own_rows = scene.splats(0.7)
    np.testing.assert_array_equal(rows, own_rows)
    (tmp_path / "a.ply").write_bytes(ply_bytes(splats))
    found = read_splats(tmp_path / "a.ply")
    np.testing.assert_array_equal(found.means, own.means)
    np.testing.assert_array_equal(found.sh, own.sh)
    for name in ("quats", "scales", "opacities"):
        np.testing.assert_allclose(getattr(found, name), getattr(own, name), rtol=2e-6)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_colours_and_shapes_turn_with_the_world(scene, degree):
    turn, eye = upright(scene.info.up), np.array([0.4, -0.3, -2.7])
    still, _ = exported(drawer(scene), 0.4, None, degree)
    turned, _ = exported(drawer(scene), 0.4, None, degree, turn)
    assert still.degree == turned.degree == degree and np.abs(still.means - turned.means).max() > 0.5
    np.testing.assert_allclose(turned.means, still.means @ turn.T, atol=1e-5)
    np.testing.assert_allclose(turned.colors(turn @ eye), still.colors(eye), atol=2e-5)
    axes = [rotation_matrix(s.quats) * s.scales[:, None] for s in (still, turned)]
    np.testing.assert_allclose(*(turn @ axes[0], axes[1]), atol=1e-5)
