"""Splats and tracks: what is written comes back, prefixes render, and Gaussians follow clauses 13.7 and 13.8."""

import math
from dataclasses import replace

import numpy as np
import pytest
import refdec
from explicit import STEPS, assert_same_splats, make_splats, splat_scenes, visible_splats
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import LAYER_SETS, flipped, slice_ends
from test_kind_rules import file_of, zeros

from pd4dgs_codec import decode, encode, open_stream
from pd4dgs_codec.errors import DecodeError, EncodeError, Malformed, Truncated, UnsupportedFeature
from pd4dgs_codec.format.decoder import decode_partial, every_prefix
from pd4dgs_codec.format.encoder import encode_with_report
from pd4dgs_codec.format.info import hashes, info, to_npz_dict
from pd4dgs_codec.format.options import EncodeOptions
from pd4dgs_codec.format.plan import plan
from pd4dgs_codec.format.reader import decode_tensors, read_layers
from pd4dgs_codec.kinds import splats
from pd4dgs_codec.kinds.splats import harmonics
from pd4dgs_codec.kinds.tracks import HEADS, Groups, Head, Tracks
from pd4dgs_codec.tensors.quantise import Rows, RowTable
from pd4dgs_codec.tensors.tables import Chain, Grid

CODINGS = {"ans": {}, "slices": {"slices": 1500}, "lzma": {"mode": "lzma"}}
#: Normalised times of a scene.
TIMES = (0.0, 0.05, 0.4, 1.0)


def by_voxel(scene, coefficients=True):
    """All values of each Gaussian, in an order that no layer decides."""
    order = np.lexsort(scene.anchor_q.T)
    found = {"cells": scene.anchor_q, **scene.tensors, "codes": scene.mask[-1]}
    found |= {"classes": scene.grading.classes} if scene.grading else {}
    for layer, tracks in scene.tracks.items() if coefficients else ():
        whole = tracks.of_rows(np.arange(len(scene.anchor_q)))
        found |= {f"{layer} {name}": head.coefficients for name, head in whole.heads.items()}
    return {name: values[order] for name, values in found.items()}


# -- to bytes and back -------------------------------------------------------------------------------------------------


@given(splat_scenes(), st.sampled_from(sorted(CODINGS)))
@settings(max_examples=25)
def test_what_is_written_comes_back(scene, coding):
    data = encode(scene, layers=2, effort=1, **CODINGS[coding])
    found = decode(data)
    active = np.flatnonzero(scene.mask[-1])
    kept = replace(scene, rows=(len(active),), mask=(scene.mask[-1][active],), **scene.of_anchors(active))
    if found.grading is None:
        kept = replace(kept, grading=None)
    graded = scene.grading is not None
    np.testing.assert_equal(by_voxel(found, not graded), by_voxel(kept, not graded))
    assert found.steps == scene.steps and (found.grading is None or scene.grading is not None)
    for layer, tracks in scene.tracks.items():
        np.testing.assert_array_equal(found.tracks[layer].instants, tracks.instants)
        for name, head in tracks.heads.items():
            np.testing.assert_array_equal(found.tracks[layer].heads[name].bases, head.bases)
    if graded:  # behind a row of a lower class, coefficients lie on another lattice of the same spacing
        for (name, a), b in zip(by_voxel(found).items(), by_voxel(kept).values(), strict=True):
            if name.split()[-1] in HEADS:
                spacing = 2.0 ** by_voxel(kept).get("classes", np.zeros(len(a)))[:, None] / 32
                assert (np.abs(a - b) <= spacing / 2).all()
    assert encode(found, layers=2, effort=1, **CODINGS[coding]) == data


@pytest.mark.parametrize("seed", range(6))
def test_a_decoded_file_keeps_its_predictors(seed):
    """Those of rows with step classes have lattices of their own; another choice, by bytes alone, moved the values."""
    rng = np.random.default_rng(seed)
    scene = make_splats(seed, layers=(0, 2), count=40, graded=True, heads=tuple(HEADS), instants=4, extent=30)
    tracks = scene.tracks[2]
    heads = {
        name: replace(
            head, coefficients=np.cumsum(rng.normal(size=head.coefficients.shape) * 0.3, 0).astype(np.float32)
        )
        for name, head in tracks.heads.items()
    }
    data = encode(replace(scene, tracks={2: replace(tracks, heads=heads)}), effort=1)
    assert encode(decode(data), effort=1) == data


@given(splat_scenes(), st.sampled_from(sorted(CODINGS)))
@settings(max_examples=15)
def test_hashes_are_those_of_the_reference_decoder(scene, coding):
    data = encode(scene, layers=2, effort=1, verify=False, **CODINGS[coding])
    assert refdec.hashes(data) == hashes(data)


@given(splat_scenes())
@settings(max_examples=10)
def test_each_prefix_decodes_to_what_max_layer_gives(scene):
    data = encode(scene, layers=2, effort=1, verify=False)
    whole, stream, got = decode(data), open_stream(), []
    for byte in range(0, len(data), 1000):
        got += stream.feed(data[byte : byte + 1000])
    for row, streamed in zip(info(data)["layers"], got, strict=True):
        prefix = decode(data[: row["end"]], max_layer=row["layer"])
        for other in (decode(data, max_layer=row["layer"]), whole.prefix(row["layer"]), streamed):
            assert_same_splats(prefix, other)
        if row["end"] < len(data):
            with pytest.raises(Truncated):
                decode(data[: row["end"]])
            assert_same_splats(decode_partial(data[: row["end"]])[0], prefix)


def test_slices_bring_the_largest_and_most_opaque_first():
    scene = visible_splats(degree=3)
    data = encode(scene, slices=4000, effort=1)
    prefixes = list(every_prefix(data))
    assert len(prefixes) == len(slice_ends(data)) > 6 and prefixes[-1].layers == (0, 1, 2)
    least = [prefix.tensors["scale"].mean() for prefix in prefixes if prefix.layers == (0,)]
    assert least == sorted(least, reverse=True) and least[0] > least[-1] + 0.1
    assert_same_splats(decode(data), decode(encode(scene, effort=1)))


def test_a_caller_may_order_the_slices():
    scene = visible_splats()
    worth = np.random.default_rng(0).permutation(len(scene.anchor_q)).astype(float)
    data, report = encode_with_report(scene, EncodeOptions(slices=4000, effort=1), utility=lambda decoded: worth)
    first, cells = next(every_prefix(data)), decode(data).anchor_q.tolist()
    best = np.argsort(-worth)[: report.layers[0].slices[0].anchors]
    assert sorted(map(tuple, first.anchor_q.tolist())) == sorted(tuple(cells[i]) for i in best)


def test_smooth_coefficients_are_predicted_and_noise_is_not():
    scene, rng = visible_splats(count=3000), np.random.default_rng(2)
    arranged = plan(scene, EncodeOptions(effort=1)).scene
    n = len(arranged.anchor_q)
    heads = {
        "position": np.cumsum(rng.normal(size=(n, 2)), axis=0) * 0.05,  # along the order of the file
        "scale": rng.normal(size=(n, 2)),
    }
    bases = rng.normal(size=(2, 3, 3)).astype(np.float32)
    own = {name: Head(bases, a.astype(np.float32), 1 / 32) for name, a in heads.items()}
    for grading in (None, replace(make_splats(1, graded=True).grading, classes=rng.integers(0, 7, n).astype(np.uint8))):
        if grading:
            grading = replace(grading, centre=np.zeros(22, np.float32))
        moved = replace(arranged, tracks={1: Tracks.of(np.array([0, 0.3, 1]), 1 / 64, own)}, grading=grading)
        _, layers = read_layers(encode(moved, effort=1))
        assert [rows.predictor for rows in layers[1].tensors.tables.rows] == [1, 0]
        found = decode(encode(moved, effort=1)).tracks[1].heads["position"].coefficients
        spacing = 1 / 32 if grading is None else 2.0 ** grading.classes[:, None] / 32
        assert (np.abs(found - own["position"].coefficients) <= spacing / 2 + 1e-6).all()


@pytest.mark.parametrize("times", [[0, 0.25, 1], np.arange(150) / 149, [0, 0.1234567, 0.5, 1]])
def test_instants_are_multiples_of_a_fraction(times):
    tracks = Tracks.of(np.array(times), 1 / 64, {})
    np.testing.assert_allclose(tracks.times, times, atol=1e-5)
    ticks = tracks.instants * 64
    assert (ticks == np.rint(ticks)).all() and ticks[-1] in (4, 149, 65535) or ticks[-1] < 65536


def test_steps_are_scaled_with_what_they_divide():
    scene = visible_splats()
    coarse, fine = (decode(encode(scene, step_scale=s, effort=1)) for s in (4.0, 1.0))
    for layer, tracks in fine.tracks.items():
        np.testing.assert_array_equal(coarse.tracks[layer].times, tracks.times)
    assert coarse.steps == {name: 4 * step for name, step in fine.steps.items()}
    assert len(encode(scene, step_scale=4.0, effort=1)) < 0.8 * len(encode(scene, effort=1))


def test_arrays_for_other_readers():
    scene = decode(encode(make_splats(3, graded=True), layers=2, effort=1))
    arrays = to_npz_dict(scene, symbols=True)
    np.testing.assert_array_equal(arrays["anchor"], scene.anchor)
    for name, step in scene.steps.items():
        k = arrays[f"{name}_q"].astype(np.float64) * 2.0 ** arrays["step_class"][:, None]
        np.testing.assert_allclose(k * step + arrays[f"{name}_centre"], arrays[name], atol=1e-6)
    head = scene.tracks[2].heads["rotation"]
    found = arrays["tracks.2.coefficients.rotation_q"] * arrays["tracks.2.coefficients.rotation_step"]
    np.testing.assert_array_equal(found, head.coefficients)
    assert arrays["tracks.1.bases.color"].shape == (6, 1, 4) and "mask_2" in arrays


# -- Gaussians ---------------------------------------------------------------------------------------------------------


def from_group(scene, groups, name, row):
    """What the group of a row adds to its coefficients of a head."""
    group, unit = int(groups.rows[row, 0]), float((scene.info.box[1] - scene.info.box[0]).max()) / 4
    if name not in groups.maps or not 0 <= group < len(groups.centres):
        return np.zeros(len(groups.maps.get(name, np.zeros((1, 4, 9)))[0, 0]))
    at = (scene.anchor_q[row] + scene.tensors["offset"][row].astype(float)) * scene.info.voxel_size
    return np.array([*(at / unit - groups.centres[group]), 1]) @ groups.maps[name][group]


def expected(scene, level, t, eye):
    """One Gaussian after the other by the formulas of 13.7 and 13.8, in binary64; by row."""
    info, layers, found = scene.info, [i for i in scene.layers if i <= level], {}
    codes = scene.mask[len(layers) - 1]
    for row, code in enumerate(codes):
        x = {name: values[row].astype(float) for name, values in scene.tensors.items()}
        added = {name: np.zeros(c) for name, c in HEADS.items()}
        for layer in layers:
            tracks = scene.tracks.get(layer)
            for name, head in tracks.heads.items() if tracks else ():
                for k, a in enumerate(head.coefficients[row] if row < len(head.coefficients) else ()):
                    a += from_group(scene, tracks.groups, name, row)[k] if tracks.groups else 0
                    for c in range(HEADS[name]):
                        added[name][c] += a * np.interp(t, tracks.times, head.bases[k, c])
        mean = (scene.anchor_q[row] + x["offset"]) * info.voxel_size + added["position"]
        rest = np.array([math.sqrt(max(0, 1 - (x["rotation"] ** 2).sum())), *x["rotation"]])
        a, u = 1 + added["rotation"][0], added["rotation"][1:]
        b, v = rest[0], rest[1:]
        quat = np.array([a * b - u @ v, *(a * v + b * u + np.cross(u, v))])
        fade = 1.0
        if "window" in x:
            centre, half, softness = x["window"]
            fade = math.exp(-0.5 * (max(0, abs(t - centre) - half) / math.exp(softness)) ** 2)
        opacity = code / 255 * fade / (1 + math.exp(-x["opacity"][0] - added["opacity"][0]))
        if not code or opacity < 1 / 255:
            continue
        d = (mean - eye) / np.linalg.norm(mean - eye)
        channels = np.concatenate([x["color"] + added["color"], x.get("harmonics", np.zeros(0))]).reshape(-1, 3)
        y, co, cg = (harmonics(d, math.isqrt(len(channels)) - 1) @ channels).T
        color = np.maximum(0, 0.5 + np.array([y - cg + co, y + cg, y - cg - co]))
        size = np.exp(x["scale"] + added["scale"]) * code / 255
        found[row] = (mean, quat / np.linalg.norm(quat), size, opacity, color)
    return found


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("layers", LAYER_SETS)
@pytest.mark.parametrize("window", [False, True])
def test_gaussians_follow_the_formulas(layers, degree, window):
    given_ = make_splats(4, layers=layers, count=40, degree=degree, window=window, groups=3 * window)
    scene = decode(encode(given_, layers=2, effort=1))
    eye, seen = np.array([0.3, -0.2, 4.0]), 0
    for level in range(3):
        for t in TIMES:
            right, found = expected(scene, level, t, eye), scene.gaussians(t, level, eye)
            assert found.slots.tolist() == list(right)
            parts = (found.means, found.quats, found.scales, found.opacities, found.colors)
            for got, values in zip(parts, zip(*right.values(), strict=True), strict=True):
                assert got.dtype == np.float32
                np.testing.assert_allclose(got, np.array(values), rtol=2e-4, atol=2e-5)
            seen += len(right)
    assert seen > 60


def test_levels_add_and_rows_of_later_layers_stay():
    """The tracks of layer 1 move what layer 0 brought; those of layer 2 are added, and move all."""
    scene = make_splats(5, count=60, window=False, heads=("position",), kind="gaussian")
    tensors = scene.tensors | {"opacity": np.full_like(scene.tensors["opacity"], 4.0)}
    scene = decode(encode(replace(scene, tensors=tensors), layers=2, effort=1))
    first, _, last = scene.rows
    assert 0 < first < last
    for t in TIMES:
        still, moved, swayed = (scene.splats(t, level) for level in range(3))
        one, two = (scene.tracks[i].residuals(t)["position"] for i in (1, 2))
        for (splats_, rows), added in ((still, 0 * two), (moved, np.zeros_like(two)), (swayed, two.copy())):
            if splats_ is not still[0]:
                added[: len(one)] += one
            np.testing.assert_allclose(splats_.means, scene.anchor[rows] + added[rows], atol=1e-5)


def test_a_window_shows_a_gaussian_for_a_while():
    n = 3
    tensors = {name: np.zeros((n, 1 if name == "opacity" else 3), np.float32) for name in list(STEPS)[:5]}
    tensors["opacity"] += 4
    box, bell, always = (0.5, 0.2, -12.0), (0.5, 0.0, np.log(0.1)), (0.5, 2.0, -5.0)
    tensors["window"] = np.array([box, bell, always], np.float32)
    cells = np.arange(9, dtype=np.int32).reshape(n, 3)
    scene = splats.scene(make_splats().info, cells, tensors, STEPS | {"window": 2.0**-12})
    scene = decode(encode(scene, effort=1))
    visible = {t: scene.gaussians(t).opacities.tolist() for t in (0.0, 0.29, 0.31, 0.5)}
    full = 1 / (1 + math.exp(-4))
    assert visible[0.0] == pytest.approx([full], rel=1e-5)
    assert visible[0.29] == pytest.approx([full * math.exp(-0.5 * 2.1**2), full], rel=5e-3)
    assert visible[0.31] == pytest.approx([full, full * math.exp(-0.5 * 1.9**2), full], rel=5e-3)
    assert visible[0.5] == pytest.approx([full] * 3, rel=1e-5)


# -- faults ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("coding", CODINGS)
def test_damaged_files_end_in_an_error_of_the_decoder(coding):
    data = encode(visible_splats(count=60), effort=1, **CODINGS[coding])
    for at in range(0, len(data), 31):
        with pytest.raises(DecodeError):
            decode(flipped(data, at, 1 << at % 8))
    for size in range(0, len(data), 97):
        with pytest.raises(Truncated):
            decode(data[:size])


def file_with(header=(), **changes):
    """A small file with another header, kind of the layer 1, grids or layer rows. changes: of the tables of layer 1;
    instants: integers."""
    own, layers = read_layers(encode(visible_splats(count=40), effort=1))
    instants = changes.pop("instants", None)
    tables = replace(layers[1].tensors.tables, **changes)
    values = layers[1].tensors.planes if tables == layers[1].tensors.tables else zeros(tables).planes
    if instants is not None:
        values = [np.array(instants, np.int32)[None, None], *values[1:]]
    n = len(layers[1].rises)
    moved = np.zeros((RowTable(tables.rows).channels, n), np.int32)
    tensors = replace(zeros(tables), planes=values)
    changed = [layers[0], replace(layers[1], tensors=tensors, layer_rows=moved)]
    return file_of(changed, **{name: getattr(own, name) for name in ("info", "table", "kind")} | dict(header))


def grids(*sizes, sides=(5,)):
    return tuple(Grid(i, channels, sides) for i, channels in sizes)


ROWS = tuple(Rows(i, 2, 1 / 64) for i in (0, 1, 4))
GROUPS = Rows(5, 1, 1.0)
MAPPED = (*grids((0, 1), (1, 6), (2, 8), (5, 6)), Grid(6, 3, (3,)), Grid(8, 8, (3,)))
#: Rule -> (what is other in the tables of layer 1, what the error says).
BROKEN = {
    "a parameter": ({"kind": (1, 0)}, r"layer 1: deformation \[1, 0\], expected \[1\]"),
    "no kind": ({"kind": ()}, "layer 1: deformation without a kind, expected tracks"),
    "the kind of a scaffold": ({"kind": (0,)}, "layer 1: deformation hexplane, expected tracks"),
    "chains": ({"chains": (Chain(0, (1, 1)),), "chain_step": 1.0}, "tracks, expected grids and layer rows of heads"),
    "no grids": ({"grids": (), "grid_step": 0.0}, "tracks, expected grids and layer rows"),
    "no layer rows": ({"rows": ()}, "tracks, expected grids and layer rows"),
    "two axes": ({"grids": grids((0, 1), (1, 6), (2, 8), (5, 6), sides=(5, 2))}, r"grids of sides \[\[5, 2\]"),
    "one instant": ({"grids": grids((0, 1), (1, 6), (2, 8), (5, 6), sides=(1,))}, "expected one of 2"),
    "other sides": ({"grids": (Grid(0, 1, (4,)), *grids((1, 6), (2, 8), (5, 6)))}, r"sides \[\[4\], \[5\]"),
    "a head without bases": ({"grids": grids((0, 1), (1, 6), (2, 8))}, r"expected \[\(0, 1\), \(1, 6\), \(2, 8\), \(5"),
    "bases without a head": ({"rows": ROWS[:2]}, r"expected \[\(0, 1\), \(1, 6\), \(2, 8\)\]"),
    "bases of other components": ({"grids": grids((0, 1), (1, 6), (2, 6), (5, 6))}, r"\(2, 6\).*expected .*\(2, 8\)"),
    "a head of no meaning": ({"rows": (*ROWS, Rows(6, 1, 1.0))}, r"layer rows 6, expected 0\.\.5"),
    "groups alone": ({"rows": (GROUPS,), "grids": grids((0, 1), (6, 3))}, "tracks, expected grids and layer rows of"),
    "groups of two channels": ({"rows": (*ROWS, Rows(5, 2, 1.0)), "grids": MAPPED}, r"layer rows 5 of \[\(2, 1.0\)"),
    "groups of another step": ({"rows": (*ROWS, Rows(5, 1, 0.5)), "grids": MAPPED}, r"layer rows 5 of \[\(1, 0.5\)"),
    "groups without centres": ({"rows": (*ROWS, GROUPS)}, r"expected \[.*\(6, 3\)\]"),
    "centres without groups": ({"grids": MAPPED[:5]}, r"expected \[\(0, 1\), \(1, 6\), \(2, 8\), \(5, 6\)\]"),
    "centres of two axes": ({"rows": (*ROWS, GROUPS), "grids": (*MAPPED[:4], Grid(6, 3, (2, 2)))}, r"\[\[2, 2\]\]"),
    "maps of other groups": ({"rows": (*ROWS, GROUPS), "grids": (*MAPPED[:5], Grid(8, 8, (2,)))}, r"\[\[3\], \[2\]\]"),
    "maps of other bases": ({"rows": (*ROWS, GROUPS), "grids": (*MAPPED[:5], Grid(8, 4, (3,)))}, r"\(8, 4\).*\(8, 8\)"),
    "maps without a head": ({"rows": (*ROWS, GROUPS), "grids": (*MAPPED[:5], Grid(9, 8, (3,)))}, r"\(9, 8\).*expected"),
    "two instants at once": ({"instants": [0, 1, 1, 2, 3]}, "layer 1: instants do not ascend from 0"),
    "instants from 1": ({"instants": [1, 2, 3, 4, 5]}, "layer 1: instants do not ascend from 0"),
}  # fmt: skip


@pytest.mark.parametrize("rule", BROKEN)
def test_a_broken_rule_of_tracks_is_malformed_at_its_slice(rule):
    changes, says = BROKEN[rule]
    data = file_with(**changes)
    assert len(decode_tensors(data)) == 2 and decode(data, max_layer=0).level == 0
    with pytest.raises(Malformed, match=says) as caught:
        decode(data)
    assert caught.value.chunk == 1 and "\n" not in str(caught.value)
    assert info(data)["layers"][1]["anchors"] == 0


def test_the_files_of_the_rules_are_whole():
    assert decode(file_with()).tracks[1].heads.keys() == {"position", "rotation", "color"}
    groups = decode(file_with(rows=(*ROWS, GROUPS), grids=MAPPED, instants=range(5))).tracks[1].groups
    assert groups.maps.keys() == {"rotation"} and len(groups.centres) == 3


@pytest.mark.parametrize(
    "sizes", [{}, {5: 10}, {5: 48}, {6: 2}, {2: 3}, {4: 4}, {7: 1}], ids=lambda sizes: f"rows {sizes}"
)
def test_a_header_that_breaks_the_rules_of_splats(sizes):
    own = {0: 3, 1: 3, 2: 1, 3: 3, 4: 3} | sizes
    if not sizes:
        del own[3]
    table = RowTable(tuple(Rows(i, c, 0.5) for i, c in sorted(own.items())))
    _, layers = read_layers(encode(visible_splats(count=40), effort=1))
    empty = replace(layers[0], table=table, rows=np.zeros((table.channels, len(layers[0].codes)), np.int32))
    data = file_of([empty], kind=(1,), table=table)
    assert len(decode_tensors(data)) == 1
    with pytest.raises(Malformed, match="header: rows"):
        decode(data)
    with pytest.raises(Malformed, match=r"header: kind \[1, 0\], expected \[1\]"):
        decode(file_of([empty], kind=(1, 0), table=table))


def test_an_unknown_deformation_of_splats_ends_the_scene_at_its_layer():
    data = file_with(kind=(9,))
    assert len(decode_tensors(data)) == 2
    with pytest.raises(UnsupportedFeature, match=r"layer 1: deformation of kind 9, expected .* 1 \(tracks\)"):
        decode(data)


def without_bases(head):
    return replace(head, bases=head.bases[:0], coefficients=head.coefficients[:, :0])


@pytest.mark.parametrize(
    "change, says",
    [
        (lambda t: replace(t, heads={"spin": t.heads["position"]}), r"heads \['spin'\], expected some of"),
        (lambda t: replace(t, heads={"position": without_bases(t.heads["position"])}), "no bases of position"),
        (lambda t: replace(t, heads={"color": replace(t.heads["color"], step=0.0)}), "step of color: 0.0, expected a"),
        (
            lambda t: replace(t, heads={"opacity": t.heads["position"]}),
            r"bases of opacity: .* float32 \(2, 1",
        ),
        (lambda t: replace(t, instants=t.instants[::-1].copy()), "instants do not ascend from 0"),
        (lambda t: replace(t, heads={}), "tracks, expected grids and layer rows"),
        (lambda t: replace(t, groups=Groups(np.zeros((9, 1)), t.heads["color"].bases[0, :1], {})), "groups: float64"),
        (
            lambda t: replace(
                t, groups=Groups(np.zeros((9, 1), np.float32), np.zeros((2, 3), np.float32), {"scale": 0})
            ),
            "maps of .'scale'., expected some of",
        ),
        (
            lambda t: replace(t, heads={"color": replace(t.heads["color"], coefficients=t.heads["color"].bases)}),
            "coefficients of color",
        ),
    ],
)
def test_tracks_that_cannot_be_written_are_named(change, says):
    scene = visible_splats(count=40)
    with pytest.raises(EncodeError, match=f"tracks of layer 1.*{says}"):
        encode(replace(scene, tracks={1: change(scene.tracks[1])}))


def test_coefficients_of_later_layers_are_not_lost_silently():
    scene = visible_splats(count=40)
    later = np.zeros(len(scene.anchor_q), np.uint8)
    later[3] = 2
    moved = splats.scene(scene.info, scene.anchor_q, scene.tensors, STEPS, tracks=scene.tracks, layer=later)
    with pytest.raises(EncodeError, match=r"tracks of layer 1: \['position', .* of a later layer, expected 0"):
        encode(moved)
    assert moved.rows == (len(later),) * 3 and [codes[3] for codes in moved.mask] == [0, 0, 255]
    for head in moved.tracks[1].heads.values():
        head.coefficients[3] = 0
    rows, maps = np.zeros((len(later), 1), np.float32), {"color": np.ones((1, 4, 2), np.float32)}
    grouped = replace(moved.tracks[1], groups=Groups(rows, np.zeros((1, 3), np.float32), maps))
    with pytest.raises(EncodeError, match=r"tracks of layer 1: \['groups'\] of anchors of a later layer"):
        encode(replace(moved, tracks={**moved.tracks, 1: grouped}))
    assert decode(encode(moved)).rows == (len(later) - 1, len(later) - 1, len(later))
