"""Hypothesis generators of scenes: all layer sets, with and without heads, from no anchor to a few, all symbol ranges.

Hypothesis draws the shape of a scene and a seed; numpy fills the arrays. Values are multiples of their steps unless
said otherwise, so that a test knows every symbol that must come back.
"""

import math
import tracemalloc
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from functools import cache
from typing import Any

import numpy as np
from hypothesis import strategies as st

from pd4dgs_codec import encode
from pd4dgs_codec.entropy.channels import ChannelReader, ChannelWriter, split
from pd4dgs_codec.entropy.priors import norm_cdf28_of_each, tables_of_each
from pd4dgs_codec.format.info import info as info_of
from pd4dgs_codec.scene import (
    DEFAULT_WIDTHS,
    INSTANTS,
    MAX_CLASS,
    SCAFFOLD_NETWORKS,
    Camera,
    Deformation,
    Grading,
    Network,
    Scene,
    SceneInfo,
    Steps,
    Widths,
    plane_shapes,
)
from pd4dgs_codec.tensors.quantise import NO_CLASSES, Rows, RowTable, dequantise

HUGE = 1 << 23
LAYER_SETS = ((0,), (0, 1), (0, 2), (0, 1, 2))
#: How symbols are drawn: all equal, a few small ones, Gaussian, or spread over the whole range the format allows.
RANGES = ("constant", "small", "gaussian", "huge")


def symbols(rng: np.random.Generator, shape: tuple[int, ...], kind: str) -> np.ndarray:
    """int32 symbols of `shape` drawn as `kind` says."""
    if kind == "constant":
        return np.full(shape, 2, np.int32)
    if kind == "small":
        return rng.integers(-2, 3, shape, dtype=np.int32)
    if kind == "gaussian":
        return np.rint(rng.normal(size=shape) * 20).astype(np.int32)
    return rng.choice(np.array([-HUGE, -1, 0, 1, HUGE], np.int32), shape)


def network(rng: np.random.Generator, widths: tuple[int, ...], step: float, kind: str) -> Network:
    """A network of the given widths (input, hidden ..., output) with quantised weights."""
    pairs = zip(widths[:-1], widths[1:], strict=True)
    return tuple(
        (dequantise(symbols(rng, (b, a), kind), step), dequantise(symbols(rng, (b,), kind), step)) for a, b in pairs
    )


def deformation(
    rng: np.random.Generator,
    heads: dict[str, int],
    steps: tuple[float, float],
    *,
    channels: int = 2,
    sides: tuple[int, ...] = (3, 2, 4, 5),
    scales: int = 1,
    width: int = 3,
    kind: str = "small",
    key: int | None = None,
    below: int = 0,
) -> Deformation:
    """A Deformation with the steps (planes, weights); the sides x, y, z double from scale to scale. below: features of
    the planes of the layer below."""
    planes = []
    for s in range(scales):
        shapes = plane_shapes(channels, [side << s for side in sides[:3]] + [*sides[3:]])
        planes.append({name: dequantise(symbols(rng, shape, kind), steps[0]) for name, shape in shapes.items()})
    networks = {"trunk": network(rng, (below + channels * scales, width), steps[1], kind)}
    for name, outputs in heads.items():
        layers = network(rng, (width, outputs), steps[1], kind)
        weight, bias = layers[-1]
        bias[0] = np.float32(steps[1])
        if not weight.any():  # such a head is not sent where a key instant cancels the bias
            weight[0, 0] = np.float32(steps[1])
        networks[name] = layers
    return Deformation(tuple(planes), networks, key)


def info(rng: np.random.Generator, with_camera: bool = True) -> SceneInfo:
    """Scene information with binary32 reals."""
    camera = None
    if with_camera:
        viewmat = np.eye(4, dtype=np.float32)
        viewmat[:3] = rng.normal(size=(3, 4)).astype(np.float32)
        camera = Camera(viewmat, np.array([[500, 0, 320], [0, 501, 240], [0, 0, 1]], np.float32), 640, 480)
    box = np.array([[-1, -2, -3], [1, 2, 3]], np.float32)
    return SceneInfo(0.0078125, box, (0.5, 3.25), (0.0, 0.5, 1.0), 0.125, 64.0, (0.0, -1.0, 0.0), 1.5, camera)


def make_scene(
    seed: int = 0,
    *,
    layers: tuple[int, ...] = (0, 1, 2),
    anchors: int = 6,
    kind: str = "small",
    heads: tuple[dict[str, int] | None, dict[str, int] | None] = (None, None),
    widths: Widths = DEFAULT_WIDTHS,
    with_camera: bool = True,
    extent: int = 8,
    hidden: tuple[int, ...] = (4,),
    key: int | None = None,
    **deformation_options,
) -> Scene:
    """An unplanned scene: every anchor in every layer's prefix, in random order, some of them inactive.

    heads: of layers 1 and 2, with their outputs; None stands for all.
    Steps are powers of two, so that even the largest symbols come back from their float32 values.
    """
    rng = np.random.default_rng(seed)
    of_layer = {i: widths.heads if heads[i - 1] is None else heads[i - 1] for i in (1, 2)}
    steps = Steps(0.0625, 0.03125, 0.125, 0.25, 0.5, 0.0078125, 0.015625, 0.0078125)
    cells = np.unique(rng.integers(-extent, extent + 1, (anchors, 3), dtype=np.int32), axis=0)
    cells = rng.permutation(cells)
    n = len(cells)
    codes = np.sort(rng.choice(np.array([0, 0, 3, 4, 77, 255], np.uint8), (n, len(layers))), axis=1)
    values = [symbols(rng, (n, *shape), kind) for shape in widths.attributes.values()]
    k = np.concatenate([x.reshape(n, math.prod(x.shape[1:])).T for x in values])
    centre, classes, grading = None, NO_CLASSES, None
    if widths.graded:
        classes = rng.integers(0, MAX_CLASS + 1, n).astype(np.int32)
        centre = np.zeros(widths.channels, np.int32)
        if kind == "huge":
            k = k // (1 << classes)
        else:
            centre = rng.integers(-3, 4, widths.channels).astype(np.int32)
    pairs = zip(widths.attributes.values(), steps.attributes.values(), strict=True)
    table = RowTable(tuple(Rows(i, math.prod(shape), step) for i, (shape, step) in enumerate(pairs)), centre)
    if widths.graded:
        grading = Grading(classes.astype(np.uint8), table.centre_values)
    rows = zip(widths.attributes.items(), table.dequantise(table.values(k, classes)), strict=True)
    networks = {
        name: network(rng, (widths.inputs[name], *hidden, outputs), steps.weights_scaffold, kind)
        for name, outputs in widths.networks.items()
    }
    fields: dict[int, Deformation] = {}
    for layer in [layer for layer in layers if of_layer.get(layer)]:
        below = fields[1].channels if layer == 2 and 1 in fields else 0
        own = steps.planes(layer), steps.weights(layer)
        fields[layer] = deformation(rng, of_layer[layer], own, kind=kind, key=key, below=below, **deformation_options)
    return Scene(
        info=info(rng, with_camera),
        steps=steps,
        layers=layers,
        rows=(n,) * len(layers),
        anchor_q=cells,
        **{name: x.reshape(n, *shape) for (name, shape), x in rows},
        grading=grading,
        mask=tuple(codes.T.copy()),
        networks=networks,
        global_deformation=fields.get(1),
        local_deformation=fields.get(2),
    )


def by_voxel(scene: Scene) -> list[np.ndarray]:
    """Voxels, attributes and codes at the highest level of all anchors, in an order that no layer decides."""
    order = np.lexsort(scene.anchor_q.T)
    return [values[order] for values in (scene.anchor_q, *scene.attributes.values(), scene.mask[-1])]


@cache
def small_file(layers: tuple[int, ...] = (0, 1, 2), **options: object) -> bytes:
    """make_scene(7) with twenty anchors as a file, encoded by the first test that asks and not while tests are
    collected."""
    return encode(make_scene(7, layers=layers, anchors=20), **{"layers": 2, "effort": 1, **options})


def flipped(data: bytes, at: int, bits: int = 1) -> bytes:
    """The file with these bits of its byte `at` the other way."""
    changed = bytearray(data)
    changed[at] ^= bits
    return bytes(changed)


@contextmanager
def memory_below(limit: int) -> Iterator[None]:
    """Checks that Python allocates fewer bytes at once in this block."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < limit
    finally:
        tracemalloc.stop()


def _subset(heads: dict[str, int]) -> st.SearchStrategy[dict[str, int]]:
    return st.sets(st.sampled_from(sorted(heads))).map(lambda names: {k: v for k, v in heads.items() if k in names})


@st.composite
def scenes(draw: st.DrawFn) -> Scene:
    """Scenes of all layer sets, ranges, head sets and small plane sizes, empty ones and planes of side 1 included.

    Fitting priors to a channel over the whole range takes some 20 ms, so those scenes have at most one anchor.
    """
    kind = draw(st.sampled_from(RANGES))
    graded = draw(st.booleans())
    viewing = tuple(name for name in SCAFFOLD_NETWORKS if draw(st.booleans()))
    widths = draw(st.sampled_from((Widths(), Widths(1, 1), Widths(5, 2), Widths(64, 16))))
    widths = replace(widths, graded=graded, viewing=viewing)
    return make_scene(
        draw(st.integers(0, 2**32 - 1)),
        layers=draw(st.sampled_from(LAYER_SETS)),
        anchors=draw(st.sampled_from((0, 1) if kind == "huge" else (0, 1, 2, 5, 40))),
        kind=kind,
        heads=(draw(_subset(widths.heads)), draw(_subset(widths.heads))),
        key=draw(st.none() | st.integers(0, INSTANTS)),
        widths=widths,
        with_camera=draw(st.booleans()),
        extent=draw(st.sampled_from((1, 30, 1 << 19))),
        hidden=draw(st.sampled_from(((), (1,), (5, 2)))),
        channels=draw(st.integers(1, 3)),
        sides=draw(st.tuples(*[st.integers(1, 4)] * 4)),
        scales=draw(st.integers(1, 2)),
        width=draw(st.integers(1, 4)),
    )


def assert_same_scene(a: Scene, b: Scene) -> None:
    """Every array of two scenes is equal, bit for bit."""
    assert (a.layers, a.rows, a.widths) == (b.layers, b.rows, b.widths)
    for name in ("anchor_q", "feature", "scaling_log", "offset"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name, strict=True)
    np.testing.assert_equal(*(scene.grading and asdict(scene.grading) for scene in (a, b)))
    np.testing.assert_equal(a.mask, b.mask)
    assert_same_tensors(a, b)


def assert_same_tensors(a: Scene, b: Scene) -> None:
    """Equal networks, planes and key instants, the planes in one order."""
    np.testing.assert_equal(a.networks, b.networks)
    for layer in (1, 2):
        fields = [scene.deformation(layer) for scene in (a, b)]
        np.testing.assert_equal(*(f and (f.key, f.networks, [list(s.items()) for s in f.planes]) for f in fields))


def assert_same_info(a: SceneInfo, b: SceneInfo) -> None:
    """What the header says beside the steps."""
    np.testing.assert_equal(asdict(a), asdict(b))


def assert_same_symbols(found: Sequence[np.ndarray], expected: Sequence[np.ndarray]) -> None:
    """As many arrays, each int32 and equal."""
    for a, b in zip(found, expected, strict=True):
        assert a.dtype == np.int32
        np.testing.assert_array_equal(a, b)


def coded(channels: Sequence[np.ndarray], **options: Any) -> tuple[bytes, bytes]:
    """(codes, stream) of channels in one batch. options: of ChannelWriter."""
    writer = ChannelWriter(**options)
    writer.write(channels)
    return writer.finish()[:2]


def decoded(codes: bytes, stream: bytes, counts: Sequence[int]) -> list[np.ndarray]:
    """The channels of these lengths, the inverse of `coded`."""
    reader = ChannelReader(codes, stream, sum(counts))
    symbols = reader.read(counts)
    reader.finish()
    return split(symbols, counts)


def slice_ends(data: bytes) -> list[int]:
    """Where each slice of a file ends, as `info` says."""
    return [part["end"] for layer in info_of(data)["layers"] for part in layer["slices"]]


def busy(shape: tuple[int, int, int], rng: np.random.Generator) -> np.ndarray:
    """Residuals int32 [C, H, W] that are large in some blocks of 5 by 5 cells, in all channels."""
    _, h, w = shape
    loudness = np.kron(np.exp(rng.normal(size=(h // 5 + 1, w // 5 + 1)) * 2), np.ones((5, 5)))[:h, :w]
    return np.rint(rng.normal(size=shape) * loudness).astype(np.int32)


def norm_table(n: int, mu8: int, si: int) -> np.ndarray:
    """NormTable v1 of one quantised Gaussian over symbols 0 .. n - 1: cum int64 [n + 1]."""
    sizes, mu8s, sis = (np.array([v]) for v in (n, mu8, si))
    return tables_of_each(norm_cdf28_of_each(sizes, mu8s, sis), sizes)
