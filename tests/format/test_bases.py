"""Files that add to the layer 0 of another one, their base (clause 5.6)."""

from dataclasses import replace

import numpy as np
import pytest
import refdec
from explicit import make_splats, splat_scenes
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from strategies import flipped, make_scene, scenes, slice_ends, small_file

from pd4dgs_codec import decode, decode_tensors, encode, open_stream, read_base
from pd4dgs_codec.errors import BaseMismatch, BaseMissing, DecodeError, EncodeError, Malformed, Truncated
from pd4dgs_codec.format.container import read_preamble
from pd4dgs_codec.format.decoder import decode_partial, every_prefix
from pd4dgs_codec.format.encoder import with_metadata
from pd4dgs_codec.format.info import hashes, info
from pd4dgs_codec.format.metadata import Metadata
from pd4dgs_codec.kinds import splats
from pd4dgs_codec.kinds.tracks import Head, Tracks
from pd4dgs_codec.scene import Widths

CODINGS = {"ans": {}, "gauss": {"priors": "gauss"}, "lzma": {"mode": "lzma"}, "slices": {"slices": 1000}}


def over_base(scene, count, seed=0, **options):
    """(a file with some anchors of a scene's layer 0, the scene with these anchors first, some of which are hidden in
    layer 0). options: of encoding the base."""
    rng = np.random.default_rng(seed)
    whole = decode(encode(scene, layers=2, verify=False))
    rows = rng.permutation(whole.rows[0])[:count]
    first = replace(whole.prefix(0), rows=(len(rows),), mask=(whole.mask[0][rows],), **whole.of_anchors(rows))
    data = encode(replace(first, **first.of_layers()), verify=False, **options)
    base, places = decode(data), {tuple(voxel): row for row, voxel in enumerate(whole.anchor_q.tolist())}
    rows = [places[tuple(voxel)] for voxel in base.anchor_q.tolist()]
    order = np.array([*rows, *rng.permutation(np.setdiff1d(np.arange(whole.rows[-1]), rows))], np.int64)
    masks = [codes[order] for codes in whole.full_masks()]
    masks[0][: len(rows)][rng.random(len(rows)) < 0.3] = 0
    return data, replace(whole, rows=(len(order),) * len(masks), mask=tuple(masks), **whole.of_anchors(order))


def example(number=0, **options):
    """A base of a scaffold or of splats, and a scene over it."""
    one, two = (make_scene(number, anchors=40, hidden=()), make_splats(number, count=40))
    return over_base((one, two)[number % 2], 15, number, **options)


def assert_same_anchors(found, given, count):
    """The first `count` anchors in their order, then all others, with equal values and masks."""
    places = {tuple(voxel): row for row, voxel in enumerate(given.anchor_q.tolist())}
    rows = [places[tuple(voxel)] for voxel in found.anchor_q.tolist()]
    assert rows[:count] == list(range(count)) and len(rows) == len(set(rows))
    lost = sorted(set(range(len(given.anchor_q))) - set(rows))
    assert not given.full_masks()[-1][lost].any()
    for name, values in found.attributes.items():
        np.testing.assert_array_equal(values, given.attributes[name][rows], err_msg=name, strict=True)
    for layer, codes in zip(found.layers, found.full_masks(), strict=True):
        np.testing.assert_array_equal(codes, given.full_masks()[given.layers.index(layer)][rows])
    if found.grading is not None:
        np.testing.assert_array_equal(found.grading.classes, given.grading.classes[rows])
        np.testing.assert_array_equal(found.grading.centre, given.grading.centre)


# -- what comes back ---------------------------------------------------------------------------------------------------


@given(st.one_of(scenes(), splat_scenes()), st.integers(0, 30), st.sampled_from(sorted(CODINGS)), st.integers(0, 99))
@settings(max_examples=60)
def test_any_scene_comes_back_over_any_part_of_its_layer_0(scene, count, coding, seed):
    data, scene = over_base(scene, count, seed)
    base = read_base(data)
    assume(base.header.table.graded == (scene.grading is not None))  # classes of 0 alone are not written
    file = encode(scene, layers=2, effort=1, base=base, **CODINGS[coding])
    found, alone = decode(file, base=base), decode(data)
    assert base.reference.rows == alone.rows[0]
    assert_same_anchors(found, scene, alone.rows[0])
    assert len(info(file)["layers"]) == len(found.layers) and info(file)["anchors"] == found.rows[-1] - alone.rows[0]
    assert hashes(file, base=data) == refdec.hashes(file, base=data)
    assert encode(found, layers=2, effort=1, base=base, **CODINGS[coding]) == file
    for layer, own in zip(found.layers, decode_tensors(file, base=base), strict=True):
        assert own.layer == layer and len(own.codes) == found.rows[found.layers.index(layer)]
    whole = encode(found, layers=2, effort=1)
    assert decode(whole).rows[-1] == np.count_nonzero(found.mask[-1])


@pytest.mark.parametrize("number", [0, 1])
def test_all_that_a_scene_has_comes_back(number):
    data, scene = example(number)
    file = encode(scene, layers=2, base=data)
    found = decode(file, base=data)
    for layer in (1, 2):
        given, own = scene.deformation(layer), found.deformation(layer)
        if number:
            rows = [tuple(v) for v in scene.anchor_q.tolist()]
            order = [rows.index(tuple(v)) for v in found.anchor_q[: found.rows[layer]].tolist()]
            given = given.of_rows(np.array(order))
            for name, head in own.heads.items():
                np.testing.assert_array_equal(head.coefficients, given.heads[name].coefficients)
                np.testing.assert_array_equal(head.bases, given.heads[name].bases)
        else:
            np.testing.assert_equal(own.networks, given.networks)
            np.testing.assert_equal(own.planes, given.planes)
    if not number:
        np.testing.assert_equal(found.networks, scene.networks)


def test_what_stands_still_is_in_the_base_once():
    """10,000 still Gaussians, and 200 that move by 20 bases."""
    rng, n = np.random.default_rng(0), 10_000
    cells = np.stack(np.unravel_index(rng.permutation(40**3)[: n + 200], (40,) * 3), axis=1).astype(np.int32)
    sizes = {name: channels[0] for name, channels in splats.TENSORS.items() if name not in splats.OPTIONAL}
    tensors = {name: rng.integers(-9, 10, (len(cells), size)).astype(np.float32) for name, size in sizes.items()}
    one = replace(make_splats(0), tensors=tensors).info
    steps = dict.fromkeys(tensors, 1.0)
    data = encode(splats.scene(one, cells[:n], {k: x[:n] for k, x in tensors.items()}, steps))
    still = decode(data)
    assert np.array_equal(still.mask[0], np.full(n, 255))
    joined = {name: np.concatenate([still.tensors[name], x[n:]]) for name, x in tensors.items()}
    moving = np.zeros((n + 200, 20), np.float32)
    moving[n:] = rng.integers(-20, 21, (200, 20))
    bases = rng.integers(-9, 10, (20, 3, 10)).astype(np.float32)
    tracks = {1: Tracks.of(np.linspace(0, 1, 10), 1.0, {"position": Head(bases, moving, 1.0)})}
    voxels = np.concatenate([still.anchor_q, cells[n:]])
    file = encode(splats.scene(one, voxels, joined, steps, tracks=tracks), base=data)
    own = np.arange(n, n + 200)
    own_rows, own_tracks = {name: x[own] for name, x in joined.items()}, {1: tracks[1].of_rows(own)}
    alone = splats.scene(one, voxels[own], own_rows, steps, tracks=own_tracks)
    assert decode(file, base=data).rows == (n + 200, n + 200)
    assert len(file) < len(encode(alone)) + 250  # a key of the header, a slice, a byte or two for each channel


# -- prefixes, streams and cuts ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", [0, 1])
def test_every_prefix_decodes_over_the_base(number):
    data, scene = example(number)
    file, count = encode(scene, layers=2, slices=1000, base=data), decode(data).rows[0]
    ends = slice_ends(file)
    nothing = decode(file, max_bytes=ends[0] - 1, base=data)
    assert nothing.rows == (count,) and nothing.info.time_range == scene.info.time_range
    np.testing.assert_equal(nothing.attributes, decode(data).attributes)
    np.testing.assert_equal(nothing.mask, decode(data).mask)
    prefixes = list(every_prefix(file, data))
    assert len(prefixes) == len(ends) >= 3
    for end, prefix in zip(ends, prefixes, strict=True):
        found, complete = decode_partial(file[: end + 5], base=data)
        assert found.rows == prefix.rows and complete == (end == ends[-1])
        np.testing.assert_array_equal(found.anchor_q[:count], nothing.anchor_q)
        np.testing.assert_array_equal(np.sort(found.anchor_q, axis=0), np.sort(prefix.anchor_q, axis=0))
        for mask, other in zip(found.mask[:-1], prefix.mask[:-1], strict=True):
            np.testing.assert_array_equal(mask, other)


@given(st.integers(0, 1), st.lists(st.integers(0, 5000), max_size=5))
@settings(max_examples=25)
def test_a_stream_yields_the_same_in_any_pieces(number, cuts):
    data, scene = example(number)
    file, base = encode(scene, layers=2, effort=1, slices=1000, base=data), read_base(data)
    stream, found = open_stream(base), []
    cuts = [0, *sorted(cut % len(file) for cut in cuts), len(file)]
    for a, b in zip(cuts, cuts[1:], strict=False):
        found += stream.feed(file[a:b])
    stream.finish()
    np.testing.assert_equal(found[-1].anchor_q, decode(file, base=data).anchor_q)
    np.testing.assert_equal(found[-1].attributes, decode(file, base=data).attributes)
    np.testing.assert_equal(base.grown.arrays()[0][0], decode(data).anchor_q)


def test_a_cut_file_is_truncated_at_every_byte():
    data, scene = example()
    file, base = encode(scene, layers=2, effort=1, base=data), read_base(data)
    for end in range(0, len(file), 7):
        with pytest.raises(Truncated):
            decode(file[:end], base=base)


# -- bases -------------------------------------------------------------------------------------------------------------


def test_no_base_another_one_and_one_that_is_not_needed():
    data, scene = example()
    file = encode(scene, layers=2, base=data)
    for read in (decode, decode_tensors, hashes):
        with pytest.raises(BaseMissing, match="adds to layer 0 of scene [0-9a-f]{16}: give this file"):
            read(file)
        with pytest.raises(BaseMismatch, match="its base is scene [0-9a-f]{16}"):
            read(file, base=small_file())
    with pytest.raises(BaseMissing):
        open_stream().feed(file)
    with pytest.raises(Malformed, match="the base: the base names a base itself"):
        decode(file, base=file)
    with pytest.raises(Malformed, match="names a base itself"):
        read_base(file)
    with pytest.raises(BaseMismatch, match="the base: truncated"):
        open_stream(data[:-1]).feed(file)
    assert hashes(data, base=file) == hashes(data)
    assert info(file)["base"]["rows"] == decode(data).rows[0] and info(data)["base"] is None


def test_a_base_may_gain_metadata_and_upper_layers_and_be_a_path(tmp_path):
    data, scene = example()
    upper = encode(decode(encode(scene, layers=2, base=data), base=data), layers=2)
    file = encode(scene, layers=2, base=data)
    path = tmp_path / "base.pd4"
    path.write_bytes(with_metadata(data, Metadata(title="a base"))[0])
    assert hashes(file, base=path) == hashes(file, base=data)
    with pytest.raises(BaseMismatch):
        decode(file, base=upper)
    whole = decode(upper)
    again = encode(whole, layers=2, base=upper)  # over a file that has layers of its own
    assert hashes(again, base=upper[: slice_ends(upper)[0]])[1:] == hashes(upper)[1:]


@given(st.integers(0, 10**6), st.integers(0, 7), st.booleans())
@settings(max_examples=150)
def test_a_flipped_bit_of_file_or_base_never_decodes(at, bit, of_base):
    data, scene = example()
    file = encode(scene, layers=2, effort=1, base=data, verify=False)
    parts = [file, data]
    parts[of_base] = flipped(parts[of_base], at % len(parts[of_base]), 1 << bit)
    if of_base and 8 <= at % len(data) < 12:
        return  # its minor version, and the major one, which another test flips
    with pytest.raises(DecodeError):
        hashes(parts[0], base=parts[1])


def test_many_files_share_a_base_that_none_changes():
    data, scene = example(1)
    base, first = read_base(data), decode(data)
    assert read_base(base) is base
    for _ in range(3):
        found = decode(encode(scene, layers=2, effort=1, base=base), base=base)
        for values in found.tensors.values():
            values[:] = 7
        found.mask[0][:] = 9
        np.testing.assert_equal(decode(encode(first, effort=1, base=base), base=base).tensors, first.tensors)


# -- encoding ----------------------------------------------------------------------------------------------------------


def changed(scene, **changes):
    """The scene, with the first value of an array one step higher."""
    for name, step in changes.items():
        values = getattr(scene, name).copy()
        values[0] += np.asarray(step, values.dtype)
        scene = replace(scene, **{name: values})
    return scene


REFUSED = {
    "anchor_q of the first 10 anchors": lambda scene: changed(scene, anchor_q=1000),
    "feature of the first 10 anchors": lambda scene: changed(scene, feature=scene.steps.feature),
    "offset of the first 10 anchors": lambda scene: changed(scene, offset=scene.steps.offset),
    "mask of layer 0": lambda scene: replace(scene, mask=(np.full_like(scene.mask[0], 5), *[scene.mask[-1] | 128] * 2)),
    "networks of layer 0": lambda scene: replace(
        scene, networks=scene.networks | {"color": tuple((w * 2, b) for w, b in scene.networks["color"])}
    ),
    "kind, widths, steps": lambda scene: scene.scaled(2.0),
    "expected those of the base": lambda scene: replace(scene, info=replace(scene.info, voxel_size=0.5)),
}


@pytest.mark.parametrize("message", REFUSED)
def test_a_scene_that_is_not_over_the_base_is_refused(message):
    data, scene = example()
    with pytest.raises(EncodeError, match=message):
        encode(REFUSED[message](scene), layers=2, base=data)


def test_a_scene_of_other_widths_or_fewer_anchors_than_the_base_is_refused():
    data, scene = example()
    fewer = replace(scene, rows=(3,) * 3, mask=tuple(codes[:3] for codes in scene.mask), **scene.of_anchors(slice(3)))
    for other in (make_scene(0, widths=Widths(5, 2)), make_splats(0), fewer):
        with pytest.raises(EncodeError, match="expected those of the base"):
            encode(other, base=data)


def test_a_base_may_be_of_the_other_mode():
    data, scene = example(1, mode="lzma")
    file = encode(scene, layers=2, base=data)
    assert read_preamble(file).header[-60:] != read_preamble(data).header[-60:]
    assert hashes(file, base=data) == refdec.hashes(file, base=data)
