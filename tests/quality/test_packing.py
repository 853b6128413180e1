"""pack without pictures is encode; with them slices are ordered by utility and scored."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from explicit import visible_splats
from strategies import by_voxel, make_scene
from tiny import camera_ahead

from pd4dgs_codec.data.view import View, spread
from pd4dgs_codec.draw.player import drawer
from pd4dgs_codec.format.decoder import decode, every_prefix
from pd4dgs_codec.format.encoder import encode, with_metadata
from pd4dgs_codec.format.info import hashes, info, metadata_of
from pd4dgs_codec.format.metadata import Metadata
from pd4dgs_codec.format.options import EncodeOptions
from pd4dgs_codec.format.plan import plan
from pd4dgs_codec.model.sensitivity import utility, without
from pd4dgs_codec.quality import packing, target
from pd4dgs_codec.quality.measure import best_fill, filled, true_psnr
from pd4dgs_codec.quality.packing import Views, pack

FAST = EncodeOptions(mode="lzma", effort=1)


def test_without_pictures_it_is_the_encoder():
    scene = make_scene(3, anchors=30)
    packed = pack(scene, FAST)
    assert packed.data == encode(scene, FAST) and packed.target is None
    ends = {row["layer"]: row["end"] for row in info(packed.data)["layers"]}
    added = packed.report.added_bytes()
    assert {layer: sum(added[lower] for lower in added if lower <= layer) for layer in added} == ends
    for row in packed.json()["layers"]:
        assert row["ratio"] == (row["payload_bits"] / row["rate_bits"] if row["rate_bits"] else None)


def test_steps_are_scaled_once():
    scene = make_scene(3, anchors=30)
    packed = pack(scene, EncodeOptions(mode="lzma", effort=1, step_scale=2.0))
    assert packed.data == encode(scene, FAST, step_scale=2.0) == encode(packed.scene, FAST)
    assert packed.scene.steps == scene.steps.scaled(2.0)


SLICED = EncodeOptions(effort=1, slices=1500)
CAMERA = camera_ahead(3.0, 20.0, 24, 16)


@pytest.fixture(scope="module")
def scene():
    found = make_scene(3, anchors=90)
    return replace(found, info=replace(found.info, camera=CAMERA))


def test_without_a_camera_the_largest_come_first(scene):
    packed = pack(replace(scene, info=replace(scene.info, camera=None)), SLICED)
    assert packed.slices == {"order": "gate times area", "cameras": None, "pictures": 0, "size": 1500}


def test_the_files_own_camera_decides(scene):
    packed = pack(scene, SLICED)
    told = {"order": "rendered gain per byte", "cameras": "the file's own camera", "pictures": 16, "size": 1500}
    assert told.items() <= packed.json()["slices"].items()
    whole, sliced = (decode(data) for data in (pack(scene, replace(SLICED, slices=0)).data, packed.data))
    assert sliced.rows[0] <= whole.rows[0] and sliced.rows[1] < whole.rows[1]  # anchors wait for motion
    np.testing.assert_equal(by_voxel(sliced), by_voxel(whole))
    files = [pack(scene, replace(SLICED, layers=0, slices=size)).data for size in (SLICED.slices, 0)]
    assert len(files[0]) > len(files[1]) and hashes(files[0]) == hashes(files[1])  # nothing moves: all stay
    assert metadata_of(packed.data) is None


def test_cameras_of_a_checkpoint_decide_as_their_dataset_does(scene):
    """The pictures are the scene's own in both: without the dataset nothing but held-out quality is missing."""
    turned = replace(CAMERA, viewmat=CAMERA.viewmat @ np.diag(np.float32([-1, 1, -1, 1])))
    seen = [(camera, time) for time in (0.0, 0.5, 1.0) for camera in (turned, CAMERA)]
    picture = np.full((16, 24, 3), 90, np.uint8)
    views = [View(c.viewmat, c.K, 24, 16, t, picture, None, "", 0) for c, t in seen]
    dataset = SimpleNamespace(train=views, test=())
    remembered = [(view.camera, view.time) for view in spread(views, 32)]
    given, told = (
        pack(scene, SLICED, views=Views.of(dataset, "made up", 16)),
        pack(scene, SLICED, views=Views.remembered(remembered)),
    )
    about = metadata_of(given.data)
    assert with_metadata(told.data, about)[0] == given.data != with_metadata(pack(scene, SLICED).data, about)[0]


def test_levels_are_measured_without_and_with_slices_and_kept_if_asked(scene):
    moved, kept = pack(scene, SLICED), pack(scene, SLICED, keep_levels=True)
    assert moved.slices["against"] == "the model's own pictures" and "levels" not in kept.slices
    rows = moved.slices["levels"]
    assert [row["level"] for row in rows] == [0, 1, 2] and all(row["mpsnr"] > 5 for row in rows)
    change = [row["mpsnr"] - row["mpsnr_unsliced"] for row in rows]
    assert abs(change[1]) > 0.1 and change[2] == pytest.approx(0, abs=0.01)  # layer 1 passes anchors on and has a fill
    whole = decode(pack(scene, replace(SLICED, slices=0)).data)
    assert decode(kept.data).rows == whole.rows
    np.testing.assert_equal(by_voxel(decode(kept.data)), by_voxel(whole))


def test_a_sliced_file_meets_a_size_as_a_whole(scene, monkeypatch):
    monkeypatch.setattr(target, "OCTAVES", (0.0, 1.5, 3.0))
    monkeypatch.setattr(target, "SHARES", (0.0, 0.1, 0.5))
    monkeypatch.setattr(packing, "OWN_PICTURES", 2)
    size = round(0.8 * len(encode(scene, SLICED)))
    packed = pack(scene, SLICED, target_sizes={None: size}, metadata=Metadata(title="with its metadata"))
    (row,) = packed.target["layers"]
    assert 0.95 * size <= len(packed.data) == row["bytes"] <= size and row["layer"] is None
    assert all(part["end"] for layer in info(packed.data)["layers"] for part in layer["slices"])


def test_slices_of_target_sizes_leave_anchors_in_their_layers(scene, monkeypatch):
    monkeypatch.setattr(packing, "OWN_PICTURES", 2)
    sizes = {0: 6000, 1: 3000}
    packed = pack(scene, SLICED, target_sizes=sizes)
    added = packed.report.added_bytes()
    assert all(added[layer] <= most for layer, most in sizes.items())
    assert decode(packed.data).rows == decode(pack(scene, replace(SLICED, slices=0), target_sizes=sizes).data).rows


def test_slices_meet_target_sizes_even_if_they_take_more_than_measured(scene, monkeypatch):
    monkeypatch.setattr(target, "OCTAVES", (0.0, 1.5, 3.0))
    monkeypatch.setattr(target, "SHARES", (0.0, 0.1, 0.5))
    monkeypatch.setattr(packing, "OWN_PICTURES", 2)
    added = target._Layer._added_bytes
    monkeypatch.setattr(target._Layer, "_added_bytes", lambda *args: round(0.9 * added(*args)))
    packed = pack(scene.prefix(0), replace(SLICED, slices=1000), target_sizes={0: 1600}, metadata=Metadata(title="t"))
    (row,) = packed.target["layers"]
    first = info(packed.data)["layers"][0]
    assert row["bytes"] == first["end"] and 0.8 * 1600 <= first["end"] <= 1600 and len(first["slices"]) > 1


def test_views_held_out_are_scored_after_each_slice(scene):
    picture = np.full((16, 24, 3), 90, np.uint8)
    view = View(CAMERA.viewmat, CAMERA.K, 24, 16, 0.5, picture, None, "one", 0)
    packed = pack(scene, SLICED, views=Views("made up", [(CAMERA, 0.5)], (view,)))
    slices = sum(len(row["slices"]) for row in info(packed.data)["layers"])
    levels = packed.slices["levels"]  # of the file; level 0 is that of its first slices
    decoded = true_psnr(decode(packed.data), (0, 1, 2), [view])
    assert {row["level"]: row["mpsnr"] for row in levels} == pytest.approx(decoded, abs=0.01)
    assert packed.slices["against"] == "held-out views" and len({row["mpsnr_unsliced"] for row in levels}) > 1
    assert slices > 3 and len(packed.slices["psnr"]) == slices
    np.testing.assert_allclose(metadata_of(packed.data).slices, packed.slices["psnr"], rtol=1e-6)
    assert packed.report.bytes == len(packed.data) and packed.report.metadata_bytes > 20
    decode(packed.data)


VIEWPOINTS = [(CAMERA, time) for time in (0.0, 0.3, 1.0)]
TWICE = [both for both in VIEWPOINTS for _ in range(2)]  # half of the views decide on fills


def over(scene, color):
    """Pictures of a scene over any colour, which are not clipped."""
    drawn = [drawer(scene).drawn(camera, time) for camera, time in VIEWPOINTS]
    change = np.float32(color) - np.float32(scene.background())
    return [image + (1 - alpha)[:, :, None] * change for image, alpha in drawn]


def error(scene, whole):
    """The squared error of a scene's pictures against `whole`."""
    return sum(np.square(a - b).sum() for a, b in zip(over(scene, scene.background()), whole, strict=True))


@pytest.mark.parametrize("level", [0, 2])
def test_the_fill_is_the_colour_behind_the_pictures(scene, level):
    shown = plan(scene).symbols.scene().prefix(level)
    own = shown.info.background
    other = replace(shown, fills=((9, 9, 9),) * len(shown.layers))  # of an earlier file
    for fill in ((200, 30, 77), (0, 255, 128)):
        targets = over(shown, np.divide(fill, 255))
        assert best_fill(shown, VIEWPOINTS, targets) == best_fill(other, VIEWPOINTS, targets) == fill
    assert best_fill(shown, VIEWPOINTS, over(shown, (1.7, -0.4, 0.4))) == (255, 0, 102)
    assert best_fill(shown, VIEWPOINTS, over(shown, own)) is None
    noise = np.random.default_rng(0).normal(size=(3, 16, 24, 3)).astype(np.float32)
    faint, clear = (over(shown, np.add(own, np.where(np.array(own) > 0.5, -1, 1) * by)) for by in (0.02, 0.5))
    assert best_fill(shown, VIEWPOINTS, np.stack(faint) + 0.3 * noise) is None
    assert best_fill(shown, VIEWPOINTS, np.stack(clear) + 0.3 * noise) is not None


def test_a_fill_brings_every_prefix_nearer_to_the_pictures_that_order_anchors(scene):
    packed = pack(scene, SLICED, views=Views("made up", TWICE))
    whole, left = over(plan(scene).scene, scene.info.background), list[float]()
    *prefixes, last = every_prefix(packed.data)
    for prefix in (prefix for prefix in prefixes if prefix.fills[-1]):
        left.append(error(prefix, whole) / error(replace(prefix, fills=()), whole))
    assert max(left) < 10 ** (-0.05 / 10) and min(left) < 0.85 and len(left) > 3 and last.fills[-1] is None
    assert info(packed.data)["layers"][0]["slices"][0]["end"] <= SLICED.slices
    rows = [row for layer in packed.json()["layers"] for row in layer["slices"]]
    assert [row["fill"] for row in rows] == [prefix.fills[-1] for prefix in (*prefixes, last)]


def test_a_fill_that_gains_nothing_over_the_background_is_the_background(scene):
    """Its edge would show where the Gaussians end."""
    shown = plan(scene).symbols.scene().prefix(0)
    own = np.array(shown.info.background)
    noise = np.random.default_rng(0).normal(size=(3, 16, 24, 3)).astype(np.float32)
    for apart, alike in ((1, True), (40, False)):
        targets = over(shown, own + np.where(own > 0.5, -apart, apart) / 255)
        color = filled(shown, 8, VIEWPOINTS, np.stack(targets) + 0.1 * noise).color
        assert (color == tuple(np.rint(255 * own))) == alike


@pytest.mark.parametrize("spread", [0, 16, 64])
def test_the_spread_brings_gaussians_nearest_to_the_pictures(scene, spread):
    """Its search goes downhill from that of the slice before."""
    shown = plan(scene).symbols.scene().prefix(0)
    targets = over(replace(shown, fills=((200, 30, 77, spread),)), np.divide((200, 30, 77), 255))
    for before in (None, (1, 2, 3), (1, 2, 3, 32)):
        assert best_fill(shown, VIEWPOINTS, targets, before) == (200, 30, 77, *([spread] if spread else []))


def test_slices_of_splats_have_fills_too():
    scene = visible_splats(count=200, moving=False)
    first, *_, last = every_prefix(pack(scene, SLICED, views=Views("made up", TWICE)).data)
    whole = over(scene, scene.background())
    assert first.fills[-1] and last.fills == (None,)
    assert error(first, whole) < 0.95 * error(replace(first, fills=()), whole)


def test_anchors_that_show_nothing_are_worth_least(scene):
    first = plan(scene).scene.prefix(0)
    dim = replace(first, mask=(np.where(np.arange(first.rows[0]) % 3 == 0, np.uint8(0), first.mask[0]),))
    values = utility(dim, [(CAMERA, 0.0), (CAMERA, 1.0)])
    assert values.shape == first.mask[0].shape and np.isfinite(values).all()
    hidden = dim.mask[0] == 0
    assert hidden.any() and (values > 0).any() and (values[hidden] == 0).all()


def test_without_takes_rows_from_every_array(scene):
    gone = np.array([0, 5, len(scene.anchor_q) - 1])
    fewer = without(scene, gone)
    assert fewer.rows[-1] == scene.rows[-1] - 3 == len(fewer.feature) == len(fewer.mask[-1])
    assert fewer.rows[0] == len(fewer.mask[0]) == scene.rows[0] - (gone < scene.rows[0]).sum()
    np.testing.assert_array_equal(fewer.anchor_q[:4], scene.anchor_q[1:5])
