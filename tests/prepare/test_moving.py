"""Epipolar residuals, and moving features found by them."""

import numpy as np
import pytest
from rooms import FOCAL, WIDTH, pose

from pd4dgs_codec.prepare.poses import Features, count_off, sampson


@pytest.fixture(scope="module")
def scene():
    """Normalised places of 200 points in 8 pictures; the last 50 lie together and move up by .2 a picture."""
    rng = np.random.default_rng(1)
    points = np.concatenate(
        [rng.uniform((-2, -1, 4), (2, 1.5, 7), (150, 3)), rng.uniform((1, 0, 4), (1.2, 0.2, 4.1), (50, 3))]
    )
    poses, places = {}, {}
    for k in range(8):
        poses[k] = pose(k / 7)[:3]
        moved = points - np.outer(np.arange(200) >= 150, [0, 0.2 * k, 0])
        seen = moved @ poses[k][:, :3].T + poses[k][:, 3]
        places[k] = seen[:, :2] / seen[:, 2:]
    return poses, places


def test_static_points_have_no_residual_and_moving_ones_the_sampson_distance(scene):
    poses, places = scene
    rotation = poses[3][:, :3] @ poses[0][:, :3].T
    relative = np.column_stack([rotation, poses[3][:, 3] - rotation @ poses[0][:, 3]])
    found = sampson(places[0], places[3], relative)
    assert found[:150].max() < 1e-9 and found[150:].min() > 0.01
    # the Sampson distance is, to first order, how far a match is from the nearest pair that fits
    shifted = places[3][:150] + 1e-5 * np.array([0, 1])
    inverse = np.column_stack([rotation.T, -rotation.T @ relative[:, 3]])
    there_and_back = sampson(places[0][:150], shifted, relative), sampson(shifted, places[0][:150], inverse)
    np.testing.assert_allclose(*there_and_back, rtol=1e-6)
    assert there_and_back[0].max() <= 1e-5


def test_moving_features_are_found(scene):
    poses, places = scene
    rng = np.random.default_rng(2)
    features = {k: Features(p * FOCAL + WIDTH / 2) for k, p in places.items()}
    index = np.stack([np.arange(200)] * 2, axis=1)
    wrong = index.copy()
    wrong[:20, 1] = rng.permutation(150)[:20]  # a tenth of the matches are wrong
    listed = [(i, j, wrong if (i + j) % 5 == 0 else index) for i in poses for j in poses if i < j]
    count_off(features, places, poses, FOCAL, WIDTH, listed)
    for each in features.values():
        moving = each.moving(WIDTH)
        assert moving[150:].all() and moving[:150].sum() <= 3


def test_pictures_without_pose_and_features_without_matches_do_not_count(scene):
    poses, places = scene
    features = {k: Features(p * FOCAL) for k, p in places.items()}
    index = np.stack([np.arange(200)] * 2, axis=1)
    count_off(features, places, {0: poses[0]}, FOCAL, WIDTH, [(0, 1, index), (0, 0, index[:0])])
    assert not features[0].matched.any() and not features[0].moving(WIDTH).any()
