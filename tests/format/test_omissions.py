"""What changes no picture is left out, all of it, and no picture changes."""

from dataclasses import replace

import numpy as np
import pytest
from strategies import assert_same_scene, make_scene

from pd4dgs_codec.entropy.bits import entropy_bits
from pd4dgs_codec.errors import EncodeError
from pd4dgs_codec.evaluate import enclosure
from pd4dgs_codec.evaluate import reach as reach_module
from pd4dgs_codec.evaluate.enclosure import Enclosure, Range, Stretch, instants
from pd4dgs_codec.evaluate.reach import global_cells, local_cells, shown_gaussians
from pd4dgs_codec.evaluate.residuals import residuals
from pd4dgs_codec.format import planes as decorrelation
from pd4dgs_codec.format.decoder import decode
from pd4dgs_codec.format.encoder import encode, encode_with_report
from pd4dgs_codec.format.omissions import _Omissions
from pd4dgs_codec.format.options import EncodeOptions
from pd4dgs_codec.format.plan import plan
from pd4dgs_codec.format.plane_choice import fill_plane
from pd4dgs_codec.format.symbols import rounded
from pd4dgs_codec.format.table import Grid, classes_of
from pd4dgs_codec.scene import DEFAULT_WIDTHS, PLANES, Camera, Deformation, Scene, Widths

SIDES = (6, 5, 7, 5)


def reach(scene):
    """(cells of the global planes, of the local ones, Gaussians shown): the whole proof, whatever it takes."""
    shown = shown_gaussians(scene)
    return global_cells(scene), local_cells(scene, shown), shown


def lively_scene(widths: Widths = DEFAULT_WIDTHS) -> Scene:
    """A scene in which every value matters, but for the cells that nothing reaches."""
    options = dict(hidden=(12,), channels=8, sides=SIDES, scales=2, width=8, extent=30, widths=widths)
    scene = make_scene(5, anchors=60, kind="gaussian", **options)
    scaling_log = scene.scaling_log.copy()
    scaling_log[:, :3] = -4  # Gaussians stay near their anchors
    field = scene.global_deformation
    ((weight, bias),) = field.networks["position"]
    heads = {**field.networks, "position": ((weight * np.float32(0.05), bias * np.float32(0.05)),)}
    near_one = tuple({name: 1 + np.clip(plane, -0.25, 0.25) for name, plane in s.items()} for s in field.planes)
    masks = tuple(np.maximum(codes, 77) for codes in scene.mask)
    return replace(scene, mask=masks, scaling_log=scaling_log, global_deformation=Deformation(near_one, heads))


def edited(network, layer, **places):
    """`network` with 0 in rows (of the weight; the bias becomes `bias` there) and columns of one of its layers."""
    layers = [(w.copy(), b.copy()) for w, b in network]
    weight, bias = layers[layer]
    weight[places.get("rows", [])] = 0
    bias[places.get("rows", [])] = places.get("bias", 0)
    weight[:, places.get("columns", [])] = 0
    return tuple(layers)


def dead_scene(widths: Widths = DEFAULT_WIDTHS) -> Scene:
    """lively_scene with dead channels, units and a dead head, and a Gaussian of each anchor that never shows."""
    scene = lively_scene(widths)
    networks = {name: edited(network, 0, columns=[7]) for name, network in scene.networks.items()}  # feature 7: unread
    networks["opacity"] = edited(networks["opacity"], 0, rows=[3], bias=-1)  # a silent unit
    networks["opacity"] = edited(networks["opacity"], 1, columns=[5])  # an unread one
    networks["opacity"] = edited(networks["opacity"], 1, rows=[6], bias=-1)  # a Gaussian that never shows
    feature = scene.feature.copy()
    feature[:, 9] = 0
    field, local = scene.global_deformation, scene.local_deformation
    planes = tuple({name: plane.copy() for name, plane in scale.items()} for scale in field.planes)
    planes[1]["yz"][1] = 0  # channel 1 of scale 1 is a product with 0
    heads = dict(field.networks)
    heads["feature"] = edited(heads["feature"], 0, rows=[9])
    heads["scaling"] = edited(heads["scaling"], 0, rows=list(range(6)))
    heads["trunk"] = edited(heads["trunk"], 0, rows=[2], columns=[4])  # a silent unit; channel 4 of scale 0 is unread
    local_heads = {n: net if n == "trunk" else edited(net, 0, columns=[0]) for n, net in local.networks.items()}
    return replace(
        scene,
        networks=networks,
        feature=feature,
        global_deformation=Deformation(planes, heads),
        local_deformation=Deformation(local.planes, local_heads),
    )


@pytest.mark.parametrize("raw_deformation", [False, True])
def test_edits_of_the_scene_and_of_its_decoded_twin_are_alike(raw_deformation):
    planned, _ = plan(dead_scene(), EncodeOptions(layers=2, omit="nothing"))
    omissions = _Omissions(planned, raw_deformation)
    while omissions.simplify_networks():
        pass
    omissions.free_offsets_and_cells(price=0)
    assert len(omissions.found) > 8
    assert_same_scene(omissions.decoded, rounded(omissions.scene, raw_deformation))


def test_hidden_offsets_take_the_commonest_symbol_of_their_step_class_where_that_is_cheaper():
    planned, _ = plan(dead_scene(replace(DEFAULT_WIDTHS, graded=True)), EncodeOptions(layers=2, omit="nothing"))
    omissions = _Omissions(planned, raw_deformation=False)

    def coded() -> list[float]:
        classes = classes_of(omissions.decoded)
        symbols = Grid.of(omissions.decoded).symbols_of("offset", omissions.decoded.offset, classes)
        return [entropy_bits(channel[classes == k]) for k in np.unique(classes) for channel in symbols]

    before = coded()
    omissions.free_offsets_and_cells(price=0)
    after = coded()
    assert len(before) > 30 and all(a <= b for a, b in zip(after, before, strict=True)) and sum(after) < sum(before)


def test_every_dead_part_is_found_and_costs_less():
    scene = dead_scene()
    whole, _ = encode_with_report(scene, layers=2, effort=9, omit="nothing")
    data, report = encode_with_report(scene, layers=2, effort=9)
    found = {row["what"]: row["bytes"] for row in report.left_out}
    expected = [
        "global_deformation head scaling",
        "1 feature channels",
        "global_deformation feature: rows of weights",
        *(f"scaffold {name}: columns of weights" for name in scene.networks),
        "global_deformation trunk: columns of weights",
        "global_deformation: 2 plane channels",
        "scaffold opacity: 2 units of layer 1",
        "global_deformation trunk: 1 units of layer 1",
        "local_deformation trunk: 1 units of layer 1",
    ]
    assert set(expected) <= set(found)
    (hidden,) = [int(what.split()[2]) for what in found if what.startswith("offsets of")]
    assert hidden >= len(scene.anchor_q)  # the one in ten that was made so
    assert [what.split(":")[0] for what in found if "cells" in what] == ["global_deformation", "local_deformation"]
    assert sum(found.values()) > 1000 < len(whole) - len(data) + 500
    got = decode(data)
    assert not got.networks["opacity"][0][0][[3, 5]].any() and not got.networks["opacity"][1][0][:, [3, 5]].any()
    assert not got.feature[:, 7].any() and not got.global_deformation.planes[0]["xy"][4].any()
    assert set(got.global_deformation.networks) == {"trunk", "position", "feature", "offset"}
    assert encode(got, layers=2, effort=9) == data


def test_no_pixel_changes():
    pytest.importorskip("torch")
    pytest.importorskip("numba")
    from pd4dgs_codec.model.convert import from_scene
    from pd4dgs_codec.model.picture import render_image

    whole, less = (
        from_scene(decode(encode(dead_scene(), layers=2, effort=1, omit=o))) for o in ("nothing", "lossless")
    )
    K = np.array([[40, 0, 24], [0, 40, 18], [0, 0, 1]], np.float32)
    rng = np.random.default_rng(3)
    seen = 0.0
    for level in (0, 1, 2):
        for _ in range(4):
            rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
            viewmat = np.eye(4, dtype=np.float32)
            viewmat[:3, :3] = rotation * np.sign(np.linalg.det(rotation))
            viewmat[2, 3] = 8
            t = float(rng.random())
            a, b = (render_image(model, level, t, Camera(viewmat, K, 48, 36)) for model in (whole, less))
            np.testing.assert_array_equal(a, b)
            seen += float(np.ptp(a))
    assert seen > 1, "the pictures show something"


def test_a_proof_that_does_not_pay_is_not_made():
    """It costs bytes and no picture: all Gaussians count as shown, and all cells as read."""
    scene, _ = plan(dead_scene(), EncodeOptions(layers=2, omit="nothing"))
    asked = []

    def pays(known, evaluations):
        asked.append((known, evaluations))
        return False

    assert shown_gaussians(scene, pays).all() and not shown_gaussians(scene).all()
    assert local_cells(scene, np.ones((len(scene.anchor), 10), bool), pays) is None
    certain, evaluations = asked[0]
    assert not certain[:, 6].any() and evaluations > 0
    sizes = [len(encode(dead_scene(), layers=2, effort=effort)) for effort in (1, 9)]
    assert sizes[1] < sizes[0]


def test_in_a_large_scene_the_proof_goes_on_while_what_it_found_pays(monkeypatch):
    """Anchors that were not looked at count as shown, those before keep what was proven of them."""
    scene, _ = plan(dead_scene(), EncodeOptions(layers=2, omit="nothing"))
    whole, asked = shown_gaussians(scene), []
    monkeypatch.setattr(reach_module, "CHUNK", 1)
    monkeypatch.setattr(reach_module, "SAMPLE", 2)

    def pays(known, evaluations):
        asked.append(evaluations)
        return len(asked) < 3  # before all chunks, the second, the fourth

    shown = shown_gaussians(scene, pays)
    assert len(asked) == 3 and min(asked[1:]) >= asked[0], "less is found than the first question hoped for"
    assert (shown | whole == shown).all() and (shown != whole).any() and not shown.all()
    monkeypatch.undo()
    assert (shown_gaussians(scene) == whole).all()


def test_nothing_that_matters_goes():
    """Of a scene without dead parts only cells that nothing reaches go, and what is kept stays as given."""
    scene = lively_scene()
    planned = decode(encode(scene, layers=2, effort=1))
    _, left_out = plan(scene, EncodeOptions(layers=2))
    assert all("cells" in item.what or "offsets" in item.what for item in left_out)
    untouched = decode(encode(scene, layers=2, effort=1, omit="nothing"))
    read = reach(untouched)
    for kind, cells in (("global_deformation", read[0]), ("local_deformation", read[1])):
        for marks, given, got in zip(
            cells, getattr(untouched, kind).planes, getattr(planned, kind).planes, strict=True
        ):
            for name, _, _ in PLANES:
                assert np.array_equal(given[name][:, marks[name]], got[name][:, marks[name]])


def test_cells_that_any_instant_reads_are_marked():
    """Against sampling: residuals lie in their ranges, and every cell that a sampled Gaussian reads is reached."""
    scene, _ = plan(lively_scene(), EncodeOptions(layers=2, omit="nothing"))
    field, box = scene.global_deformation, scene.info.box
    enclosed = Enclosure(field, box, scene.anchor)
    heads = [name for name in field.networks if name != "trunk"]
    grid = instants(field)
    assert len(grid) == SIDES[3] and grid[0] == 0 and grid[-1] == 1
    _, reached, shown = reach(scene)
    rng = np.random.default_rng(1)
    some = np.array([1, 5, 30])
    for start, end in zip(grid[:-1], grid[1:], strict=True):
        ranges = enclosed.ranges(start, end, heads)
        for name, found in enclosed.ranges(start, end, heads, some).items():
            np.testing.assert_allclose(found, np.array(ranges[name])[:, some], rtol=1e-4, atol=1e-5)
        for t in (start, end, *rng.uniform(start, end, 3)):
            moved = residuals(field, box, scene.anchor, float(t))
            assert set(ranges) == set(heads)
            for name, (middle, low, high) in ranges.items():
                assert (low <= middle).all() and (middle <= high).all()
                assert (low <= moved[name]).all() and (moved[name] <= high).all(), name
            spread = np.exp(scene.scaling_log + moved["scaling"])[:, None, :3]
            means = (scene.anchor + moved["position"])[:, None]
            means = (means + (scene.offset + moved["offset"].reshape(-1, 10, 3)) * spread)[shown]
            unit = np.clip((means - box[0]) / (box[1] - box[0]), 0, 1)
            for scale, marks in enumerate(reached):
                at = unit * (np.array([side << scale for side in SIDES[:3]]) - 1)
                for name, a, b in PLANES[:2]:
                    assert marks[name][np.floor(at[:, b]).astype(int), np.floor(at[:, a]).astype(int)].all()


def test_lines_through_a_relu_enclose_it():
    rng = np.random.default_rng(4)
    value, slope = rng.normal(size=(2, 50, 40)).astype(np.float32)
    radius = np.abs(rng.normal(size=(50, 40)).astype(np.float32))
    after = Stretch(value, slope, radius).relu()
    for u in np.linspace(-1, 1, 7, dtype=np.float32):
        for off in (-1, 0, 1):
            x = np.maximum(value + slope * u + off * radius, 0)
            assert (np.abs(x - after.value - after.slope * u) <= after.radius + 1e-5).all()


def test_compiled_loops_prove_the_same(monkeypatch):
    pytest.importorskip("numba")
    scene, _ = plan(lively_scene(), EncodeOptions(layers=2, omit="nothing"))
    rng = np.random.default_rng(5)
    quantity = Stretch(*rng.normal(size=(3, 30, 8)).astype(np.float32))
    found, through = reach(scene), quantity.relu()
    for module in (enclosure, reach_module):
        monkeypatch.setattr(module, "kernels", lambda: None)
    expected, plain = reach(scene), quantity.relu()
    for name in ("value", "slope", "radius"):
        np.testing.assert_array_equal(getattr(through, name), getattr(plain, name))
    for cells, others in zip(found[:2], expected[:2], strict=True):
        for scale, other in zip(cells, others, strict=True):
            for name in scale:
                np.testing.assert_array_equal(scale[name], other[name])
                assert 0 < scale[name].mean()
    np.testing.assert_array_equal(found[2], expected[2])


def test_compiled_loops_see_overflows_as_numpy_does(monkeypatch):
    """Products of 0 and infinity are NaN, which stands for anywhere; the log scalings of a thousand overflow."""
    pytest.importorskip("numba")
    scene, rng = lively_scene(), np.random.default_rng(6)
    rows, widths = np.arange(0, 60, 2), {"position": 3, "offset": 30, "scaling": 6}
    ranges = {}
    for name, width in widths.items():
        ends = np.sort(rng.choice(np.float32([-np.inf, -1e3, -1, 0, 0.1, 1e3, np.inf]), (3, len(rows), width)), axis=0)
        ranges[name] = Range(ends[1], ends[0], ends[2])
    taken, finest = rng.random((len(rows), 10)) < 0.2, np.float32([5, 4, 6])

    def found(ranges):
        out = np.full((3, len(rows), 10, 3), 7, np.float32)
        reach_module._mean_ranges(out, scene, scene.anchor[rows], rows, ranges)
        return out, reach_module._wide(out[1], out[2], taken, finest)

    compiled = [found(given) for given in (ranges, {})]
    monkeypatch.setattr(reach_module, "kernels", lambda: None)
    for own, plain in zip(compiled, [found(given) for given in (ranges, {})], strict=True):
        np.testing.assert_array_equal(own[0], plain[0])
        np.testing.assert_array_equal(own[1], plain[1])
        assert 0 < own[1].mean() < 1 or own is compiled[1]


def test_a_filled_plane_keeps_what_is_given_and_costs_less():
    rng = np.random.default_rng(2)
    plane = rng.integers(-9, 10, (3, 12, 10), dtype=np.int32)
    given = rng.random((12, 10)) < 0.5
    filled = fill_plane(plane, given)
    assert np.array_equal(filled[:, given], plane[:, given])
    assert np.array_equal(fill_plane(filled, given), filled)
    zeros = [(decorrelation.residual(p, filled)[:, ~given] == 0).all() for p in decorrelation.PREDICTORS]
    assert any(zeros)
    assert np.array_equal(fill_plane(plane, np.ones_like(given)), plane)
    assert not fill_plane(plane, np.zeros_like(given)).any()


def test_an_unknown_wish_is_refused():
    with pytest.raises(EncodeError, match="omit 'much', expected one of"):
        encode(lively_scene(), omit="much")
