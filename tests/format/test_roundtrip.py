"""Scene -> bytes -> Scene: every symbol, every row, every mode."""

from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import RANGES, assert_same_info, assert_same_scene, assert_same_tensors, make_scene, scenes

from pd4dgs_codec.errors import EncodeError
from pd4dgs_codec.format import encoder
from pd4dgs_codec.format.decoder import decode
from pd4dgs_codec.format.options import CHOICES
from pd4dgs_codec.morton import morton_codes
from pd4dgs_codec.scene import Widths

encode, encode_with_report = (partial(f, effort=1) for f in (encoder.encode, encoder.encode_with_report))
MODES = ("ans", "lzma")


def rows_by_voxel(scene):
    """voxel -> (attributes, mask code per layer, 0 where a prefix does not hold the row)."""
    table = {}
    for i, cell in enumerate(scene.anchor_q.tolist()):
        attributes = [scene.feature[i], scene.scaling_log[i], scene.offset[i].ravel()]
        codes = tuple(int(m[i]) if i < len(m) else 0 for m in scene.mask)
        table[tuple(cell)] = (np.concatenate(attributes).tobytes(), codes)
    return table


@given(scenes(), st.sampled_from(MODES), st.sampled_from(("best", "gauss")))
@settings(max_examples=20)
def test_everything_active_comes_back_and_encodes_to_the_same_bytes(scene, mode, priors):
    options = {"mode": mode, "priors": priors, "layers": 2, "omit": "nothing"}
    data = encode(scene, **options)
    decoded = decode(data)
    active = {cell: row for cell, row in rows_by_voxel(scene).items() if row[1][-1] > 0}
    assert rows_by_voxel(decoded) == active
    assert decoded.layers == scene.layers
    assert_same_info(decoded.info, scene.info)
    assert_same_tensors(decoded, scene)
    for index, (first, last) in enumerate(pairwise((0, *decoded.rows))):
        assert (np.diff(morton_codes(decoded.anchor_q[first:last])) > 0).all(), "rows are not in Morton order"
        assert (decoded.mask[index][first:last] >= 3).all(), "a layer has rows that are not active in it"
        if index:
            earlier = decoded.mask[index - 1]
            assert (decoded.mask[index][: len(earlier)] >= earlier).all(), "masks fall"
    assert encode(decoded, **options, verify=False) == data


@pytest.mark.parametrize("kind", RANGES[:3])
def test_the_report_adds_up(kind):
    data, report = encode_with_report(make_scene(2, anchors=40, kind=kind), layers=2)
    report = report.json()
    assert report["bytes"] == len(data) and report["verified"] and report["mode"] == "ans"
    assert sum(row["bytes"] for row in report["layers"]) < len(data)
    for row in report["layers"]:
        streams = {s["name"]: s for s in row["streams"]}
        counted = [streams[name] for name in ("attributes", "planes", "weights") if name in streams]
        assert row["payload_bits"] == sum(s["payload_bits"] for s in counted) > 0
        assert row["rate_bits"] == pytest.approx(sum(s["rate_bits"] for s in counted))
        assert row["symbols"] == sum(s["symbols"] for s in counted)
        told = row["payload_bits"] + row["position_bits"] + streams["masks"]["payload_bits"]
        assert told <= 8 * row["bytes"] <= told + 8 * 300


def test_steps_that_are_no_binary32_values_are_rounded_once():
    scene = make_scene(0)
    scene = replace(scene, steps=replace(scene.steps, feature=0.05))
    data = encode(scene, layers=2)
    assert decode(data).steps.feature == float(np.float32(0.05))
    assert encode(decode(data), layers=2) == data


def broken(name, change, **more):
    return lambda scene: replace(scene, **{name: change(getattr(scene, name))}, **more)


def poisoned(array):
    array = array.copy()
    array.flat[-1] = np.nan
    return array


FAULTS = {
    "feature.*NaN": broken("feature", poisoned),
    "offset.*NaN": broken("offset", poisoned),
    "feature: float64": broken("feature", lambda a: a.astype(np.float64)),
    "scaling_log:.*expected": broken("scaling_log", lambda a: a[:, :5]),
    "anchor_q: voxel index": broken("anchor_q", lambda a: a + np.int32(1 << 22)),
    "holds more than one anchor": broken(
        "anchor_q", lambda a: np.zeros_like(a), mask=tuple(np.full(6, 9, np.uint8) for _ in range(3))
    ),
    "layer 1: a code below 3, expected 0 or 3..255": broken("mask", lambda m: (m[0], np.full_like(m[1], 2), m[2])),
    "mask of layer 2 is below the mask of the layer before": broken(
        "mask", lambda m: (np.full_like(m[0], 9),) * 2 + (np.full_like(m[0], 8),)
    ),
    "scaffold of layer 0: networks .'color'. are missing": broken(
        "networks", lambda n: {k: n[k] for k in n if k != "color"}
    ),
    "layers": broken("layers", lambda _: (0, 2, 1)),
    "step of feature": broken("steps", lambda s: replace(s, feature=0.0)),
    "hexplane of layer 1: layer 1 trunk: 3 inputs, expected 2": broken(
        "global_deformation", lambda d: replace(d, networks={**d.networks, "trunk": d.networks["position"]})
    ),
    "scaffold of layer 0 mlp.color.weight.1: .* expected float32 .30, 4.": broken(
        "networks", lambda n: {**n, "color": (n["color"][0], (np.zeros((30, 5), np.float32), n["color"][1][1]))}
    ),
    "hexplane of layer 2: network trunk: no layers": broken(
        "local_deformation", lambda d: replace(d, networks={**d.networks, "trunk": ()})
    ),
    "2 fills, expected none or one per layer": broken("fills", lambda _: (None, None)),
    "fill .0, 0, 256., expected None or 3 to 4 integers": broken("fills", lambda _: (None, (0, 0, 256), None)),
    "planes.*expected six": broken(
        "local_deformation", lambda d: replace(d, planes=({k: v for k, v in d.planes[0].items() if k != "xt"},))
    ),
    r"scale 0: planes \['xy'\] are empty or do not have 3 axes": broken(
        "global_deformation", lambda d: replace(d, planes=({**d.planes[0], "xy": d.planes[0]["xy"][0]},))
    ),
    "voxel_size": broken("info", lambda i: replace(i, voxel_size=0.0)),
    "info: a value": broken("info", lambda i: replace(i, near=float("inf"))),
}


@pytest.mark.parametrize("message", FAULTS)
def test_scenes_that_cannot_be_written_are_refused_in_one_line(message):
    scene = make_scene(0, anchors=6, extent=60)
    assert len(scene.anchor_q) == 6
    with pytest.raises(EncodeError, match=message) as caught:
        encode(FAULTS[message](scene), layers=2)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "name, value",
    [
        *((name, "other") for name in CHOICES),
        *(("step_scale", scale) for scale in (0, 0.0, -1.0, float("inf"), float("nan"))),
        *(("layers", 3), ("layers", "2"), ("effort", 0)),
    ],
)
def test_options_out_of_range_are_named(name, value):
    with pytest.raises(EncodeError, match=f"^{name} {value!r}, expected (one of|a positive number)"):
        encode(make_scene(0), **{name: value})


@pytest.mark.filterwarnings("error")
def test_numbers_may_be_those_of_numpy():
    scene = make_scene(0)
    voxel, feature = np.float32(scene.info.voxel_size), np.float32(scene.steps.feature)
    same = replace(scene, info=replace(scene.info, voxel_size=voxel), steps=replace(scene.steps, feature=feature))
    assert encode(same, layers=2) == encode(scene, layers=2)


def test_sizes_over_the_format_limits_are_refused_without_verification():
    scene = make_scene(0, channels=1, sides=(4097, 1, 1, 1))
    with pytest.raises(EncodeError, match="limit"):
        encode(scene, layers=2, verify=False)


def test_verification_notices_a_changed_symbol(monkeypatch):
    def write_wrong(symbols, coding):
        changed = symbols.rows.copy()
        changed[5, 0] += 1
        return original(replace(symbols, rows=changed), coding)

    original = encoder.write_slice
    monkeypatch.setattr(encoder, "write_slice", write_wrong)
    scene = make_scene(0, layers=(0,))
    with pytest.raises(EncodeError, match="verification: layer 0"):
        encode(scene)
    assert encode(scene, verify=False)


def test_verification_notices_a_file_that_does_not_decode(monkeypatch):
    monkeypatch.setattr(encoder, "scene_id_of", lambda header: bytes(8))
    with pytest.raises(EncodeError, match="verification: the file does not decode"):
        encode(make_scene(0, layers=(0,)))


def test_verification_notices_another_header_and_a_lost_layer(monkeypatch):
    read = encoder.read_layers
    for message, change in (
        ("the header decodes to other values", lambda header, found: (replace(header, mode="lzma"), found)),
        ("decodes to 1 layers, expected 3", lambda header, found: (header, found[:1])),
    ):
        monkeypatch.setattr(encoder, "read_layers", lambda data, base, change=change: change(*read(data)))
        with pytest.raises(EncodeError, match=f"verification: .*{message}"):
            encode(make_scene(0), layers=2)


@pytest.mark.parametrize("verify", [True, False])
def test_positions_that_overflow_are_refused_verified_or_not(verify):
    scene = make_scene(7, layers=(0,), anchors=20)
    with pytest.raises(EncodeError, match="anchor_q: a position is infinite"):
        encode(replace(scene, info=replace(scene.info, voxel_size=2.0**127)), verify=verify)


@given(st.integers(0, 2**32 - 1), st.sampled_from(("best", "gauss")), st.sampled_from(("ans", "lzma")))
@settings(max_examples=10)
def test_step_classes_and_centres_come_back(seed, priors, mode):
    """Values off the grid of their class are rounded to it, those on it stay, and steps may be scaled meanwhile."""
    given = make_scene(seed % 50, anchors=40, kind="gaussian", widths=Widths(4, 2, graded=True))
    options = {"layers": 2, "effort": 1, "priors": priors, "mode": mode, "omit": "nothing"}
    rng = np.random.default_rng(seed)
    noisy = replace(given, feature=(given.feature + rng.normal(size=given.feature.shape) / 50).astype(np.float32))
    data = encode(noisy, **options)
    scene = decode(data)
    assert scene.grading is not None and scene.grading.classes.max() > 0
    assert encode(scene, **options, verify=False) == data
    scaled = decode(encode(noisy, step_scale=1.5, **options))
    assert_same_scene(scaled, decode(encode(scaled, **options, verify=False)))
    for step, found in ((1.0, scene), (1.5, scaled)):
        sent = noisy.feature[noisy.mask[-1] > 0]
        error = np.abs(np.sort(found.feature.ravel()) - np.sort(sent.ravel())).max()
        assert error <= 2.0**6 * 0.0625 * step / 2 * 1.001
