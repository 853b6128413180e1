"""The arithmetic of explicit Gaussians: harmonics, rotations, the eye's place."""

import numpy as np
import pytest
from tiny import camera_ahead

from pd4dgs_codec.data.view import rotation_matrix
from pd4dgs_codec.interchange.splats import SH_C0, Splats, camera_eye, harmonics, picture, quaternions, unit


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
    np.testing.assert_allclose(camera_eye(camera), (0, 0, -3))
    np.testing.assert_allclose(splats.colors(camera_eye(camera)), [[0.9, 0.7, 0.1]], atol=1e-6)
    np.testing.assert_allclose(splats.colors(np.array([0, 0, 3.0])), [[0.9, 0.3, 0.1]], atol=1e-6)
    image = picture(splats, camera, (0.0, 0.0, 0.0))
    np.testing.assert_allclose(image[11, 15], (0.9, 0.7, 0.1), atol=2e-2)
