"""The ends of what a file may hold: no anchor and very many, steps near the largest binary32, chunks of other files."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from strategies import assert_same_scene, make_scene
from vectors import blocks

from pd4dgs_codec import decode, encode, open_stream
from pd4dgs_codec.errors import DecodeError, Malformed
from pd4dgs_codec.format.decoder import decode_partial
from pd4dgs_codec.format.encoder import encode_with_report
from pd4dgs_codec.format.info import hashes, info
from pd4dgs_codec.morton import morton_order
from pd4dgs_codec.scene import Widths

MANY = 300_000


# -- chunks of other files ---------------------------------------------------------------------------------------------


def alike(count=3):
    """Encodes of `count` scenes whose chunks have the same lengths, so that the chunk lists show nothing."""
    scenes = [blocks.make_layer(attributes=np.full((68, 1), i, np.int32)) for i in range(count)]
    deformed = blocks.make_layer(1, [[5, 5, i] for i in range(2)], before=1, scales=[blocks.Scale()])
    return [blocks.make_file(scene, deformed) for scene in scenes]


def bytes_of(file):
    """Its header and its chunks."""
    data, starts = file.data(), [file.start(i) for i in range(len(file.chunks) + 1)]
    return [data[: starts[0]], *(data[a:b] for a, b in zip(starts, starts[1:], strict=False))]


def test_a_chunk_of_another_scene_is_refused_by_every_door():
    parts = [bytes_of(file) for file in alike()]
    assert len({tuple(map(len, own)) for own in parts}) == 1
    for place in range(3):
        for i, j in ((0, 1), (1, 0), (1, 2), (2, 0)):
            mixed = [*parts[i]]
            mixed[place] = parts[j][place]
            data = b"".join(mixed)
            for door in (decode, hashes, decode_partial, lambda d: open_stream().feed(d)):
                if place == 2 and door not in (decode, hashes):  # layer 0 stands; layer 1 does not join it
                    continue
                with pytest.raises(Malformed, match="scene"):
                    door(data)
            if place == 2:
                stream = open_stream()
                assert [scene.layers for scene in stream.feed(data)] == [(0,)]
                with pytest.raises(Malformed, match="scene"):
                    stream.finish()


def test_chunks_of_two_encodes_of_one_scene_do_not_mix():
    """Other steps, so that the headers differ, and lengths too."""
    scene = make_scene(3, anchors=9)
    framed = [encode(scene, layers=2, effort=1, step_scale=scale) for scale in (1.0, 0.5)]
    ends = [[0, *(row["end"] for row in info(data)["layers"])] for data in framed]
    for i, j in ((0, 1), (1, 0)):
        data = framed[i][: ends[i][1]] + framed[j][ends[j][1] :]
        with pytest.raises(DecodeError):
            decode(data)


# -- numbers of anchors ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", ["ans", "lzma"])
@pytest.mark.parametrize("layers", [(0,), (0, 1, 2)])
def test_no_anchor(mode, layers):
    scene = make_scene(4, anchors=0, layers=layers)
    data = encode(scene, layers=layers[-1], effort=1, mode=mode)
    got = decode(data)
    assert got.rows == (0,) * len(layers) and got.feature.shape == (0, 32) and got.offset.shape == (0, 10, 3)
    assert_same_scene(open_stream().feed(data)[-1], got)


def many(anchors, widths):
    """A scene of layer 0 with that many anchors on a line through a cube, half of them in step classes above 0."""
    rng, base = np.random.default_rng(0), make_scene(5, layers=(0,), anchors=1, widths=widths, hidden=())
    index = np.arange(anchors)
    cells = np.stack([index % 97, index // 97 % 89, index // (97 * 89)], axis=1).astype(np.int32)
    rows = rng.permutation(anchors)
    shapes = {name: (anchors, *shape) for name, shape in widths.attributes.items()}
    values = {
        name: rng.integers(-3, 4, shape) * np.float32(base.steps.attributes[name]) for name, shape in shapes.items()
    }
    return replace(
        base,
        rows=(anchors,),
        anchor_q=cells[rows],
        mask=(rng.integers(3, 256, anchors).astype(np.uint8),),
        **{name: value.astype(np.float32) for name, value in values.items()},
    )


@pytest.mark.parametrize("slices", [0, pytest.param(200_000, marks=pytest.mark.slow)])
def test_three_hundred_thousand_anchors(slices):
    scene = many(MANY, Widths(1, 1))
    got = decode(encode(scene, layers=0, effort=1, slices=slices, omit="nothing", verify=False))
    assert got.rows == (MANY,)
    order = morton_order(scene.anchor_q)
    for name in ("anchor_q", "feature", "scaling_log", "offset"):
        np.testing.assert_array_equal(getattr(got, name), getattr(scene, name)[order])
    np.testing.assert_array_equal(got.mask[0], scene.mask[0][order])


# -- steps of 1e30 -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("step", [1e30, 3.1e31, 2.0**-126, 1e-37])
def test_declared_error_bounds_hold_at_the_ends_of_binary32(step):
    """In exact arithmetic, value by value, by the bounds that stand in the file."""
    step = float(np.float32(step))
    scene = make_scene(6, anchors=60, with_camera=False)
    scene = replace(scene, steps=replace(scene.steps, feature=step, scaling_log=step, offset=step))
    rng = np.random.default_rng(1)

    def spread(x):
        return (rng.uniform(-9, 9, x.shape) * step).astype(np.float32)

    scene = replace(scene, **{name: spread(value) for name, value in scene.attributes.items()})
    data, report = encode_with_report(scene, layers=2, effort=1, omit="nothing")
    got, declared = decode(data), {row.what: row.bound for row in report.errors}
    assert all(0 < Fraction(declared[name]) < Fraction(step) for name in scene.attributes)
    places = {tuple(q): i for i, q in enumerate(scene.anchor_q.tolist())}
    rows = [places[tuple(q)] for q in got.anchor_q.tolist()]
    assert len(rows) > 20
    for name, given in scene.attributes.items():
        bound = Fraction(declared[name])
        pairs = zip(given[rows].ravel().tolist(), getattr(got, name).ravel().tolist(), strict=True)
        assert all(abs(Fraction(a) - Fraction(b)) <= bound for a, b in pairs)
