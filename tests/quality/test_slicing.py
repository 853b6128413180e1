"""The order of a sliced file: anchors pass to the layer whose motion should come before them."""

from dataclasses import replace

import numpy as np
import pytest
from strategies import by_voxel, make_scene
from tiny import camera_ahead

from pd4dgs_codec.format.options import EncodeOptions
from pd4dgs_codec.format.plan import plan
from pd4dgs_codec.model.model import from_scene
from pd4dgs_codec.model.sensitivity import utility
from pd4dgs_codec.quality.measure import in_order, pictures

VIEWPOINTS = [(camera_ahead(3.0, 20.0, 24, 16), time) for time in (0.0, 0.5, 1.0)]
OPTIONS = EncodeOptions(effort=1)


def ordered(scene, **options):
    whole = pictures(from_scene(scene), scene.level, VIEWPOINTS)
    return in_order(scene, VIEWPOINTS, whole, OPTIONS, **options)


def planned(seed=3, **options):
    return plan(make_scene(seed, anchors=90, **options), OPTIONS).scene


def moving(by):
    """A scene of two layers whose anchors are visible at both; layer 1 moves them by `by` along each axis."""
    scene = planned(layers=(0, 1), heads=({"position": 3}, None))
    n = scene.rows[-1]
    field = scene.global_deformation
    ((weight, bias),) = field.networks["position"]
    networks = field.networks | {"position": ((weight * 0, np.full_like(bias, by)),)}
    masks = np.full((2, n), 255, np.uint8)
    return replace(scene, rows=(n, n), mask=tuple(masks), global_deformation=replace(field, networks=networks))


@pytest.mark.parametrize("seed", range(3))
def test_the_highest_level_stays_and_masks_rise(seed):
    scene = planned(seed)
    found, values = ordered(scene)
    assert values.shape == scene.anchor_q.shape[:1] and found.rows[-1] == scene.rows[-1]
    np.testing.assert_equal(by_voxel(found), by_voxel(scene))
    assert (np.diff(np.stack(found.full_masks()).astype(int), axis=0) >= 0).all()
    assert list(found.rows) == sorted(found.rows) and found.rows[0] > 0
    assert all(after <= before for before, after in zip(scene.rows, found.rows, strict=True))
    rearranged = plan(found, OPTIONS).scene  # as a file has them
    assert rearranged.rows == found.rows
    np.testing.assert_array_equal(rearranged.anchor_q, found.anchor_q)


def test_values_belong_to_the_anchors_in_the_order_of_a_file():
    """Morton order depends on which anchors a layer has."""
    scene = moving(3.0)
    found, values = ordered(scene)
    assert 0 < found.rows[0] < 0.3 * scene.rows[0], "motion of everything comes before most anchors"
    of_voxel = dict(zip(map(tuple, scene.anchor_q.tolist()), utility(scene.prefix(0), VIEWPOINTS), strict=True))
    own = [of_voxel[voxel] for voxel in map(tuple, found.anchor_q[: found.rows[0]].tolist())]
    np.testing.assert_array_equal(values[: found.rows[0]], own)
    assert sorted(own) == sorted(of_voxel.values())[-len(own) :]
    np.testing.assert_array_equal(values[found.rows[0] :], utility(found, VIEWPOINTS))


def test_motion_of_nothing_comes_after_all_anchors():
    still = moving(0.0)
    assert ordered(still)[0].rows == still.rows


def test_anchors_stay_where_they_may_not_pass():
    scene = moving(3.0)
    found, _ = ordered(scene, passing=False)
    assert found is scene
