"""Scenes of splats and tracks: a Hypothesis generator, and one to look at."""

from dataclasses import replace

import numpy as np
from hypothesis import strategies as st
from strategies import LAYER_SETS, RANGES, info, symbols

from pd4dgs_codec.kinds import splats
from pd4dgs_codec.kinds.splats import TENSORS, SplatScene
from pd4dgs_codec.kinds.tracks import HEADS, NONE, Groups, Head, Tracks
from pd4dgs_codec.scene import MAX_CLASS, Grading, SceneInfo
from pd4dgs_codec.tensors.quantise import dequantise

STEPS = {"offset": 1 / 16, "color": 1 / 32, "opacity": 1 / 4, "scale": 1 / 8, "rotation": 1 / 32, "harmonics": 1 / 32,
         "window": 1 / 64}  # fmt: skip


def make_splats(
    seed: int = 0,
    *,
    layers: tuple[int, ...] = (0, 1, 2),
    count: int = 20,
    kind: str = "small",
    degree: int = 1,
    window: bool = True,
    graded: bool = False,
    heads: tuple[str, ...] = tuple(HEADS),
    instants: int = 4,
    bases: int = 2,
    groups: int = 0,
    extent: int = 8,
) -> SplatScene:
    """A scene as the encoder takes it: Gaussians in random order, some inactive, all values multiples of their steps.
    Layers above 0 have tracks with these heads, without any none, and maps of groups for about half of the heads. Some
    rows have no group, said in two ways."""
    rng = np.random.default_rng(seed)
    cells = rng.permutation(np.unique(rng.integers(-extent, extent + 1, (count, 3), dtype=np.int32), axis=0))
    n = len(cells)
    classes = rng.integers(0, MAX_CLASS + 1, n).astype(np.uint8) if graded else np.zeros(n, np.uint8)
    sizes = {name: channels[0] for name, channels in TENSORS.items()}
    sizes |= {"harmonics": 3 * ((degree + 1) ** 2 - 1), "window": 3 * window}
    tensors, centres = dict[str, np.ndarray](), list[np.ndarray]()
    for name, size in sizes.items():
        if size:
            m = rng.integers(-9, 10, size, dtype=np.int32) if graded else np.zeros(size, np.int32)
            k = symbols(rng, (n, size), kind) >> (classes[:, None] + (5 if graded and kind == "huge" else 0))
            tensors[name] = dequantise((k << classes[:, None]) + m, STEPS[name])
            centres.append(dequantise(m, STEPS[name]))
    codes = np.sort(rng.choice(np.array([0, 0, 3, 77, 255], np.uint8), (n, len(layers))), axis=1)
    tracks = {}
    for index, layer in enumerate(layers):
        if not layer or not heads:
            continue
        moved = {}
        for name in heads:
            a = symbols(rng, (n, bases), "small" if kind == "huge" else kind) << classes[:, None]
            a[codes[:, index] == 0] = 0
            own = dequantise(symbols(rng, (bases, HEADS[name], instants), kind), 1 / 16)
            moved[name] = Head(own, dequantise(a, 1 / 32), 1 / 32)
        own = None
        if groups:
            rows = np.where(codes[:, index : index + 1] > 0, rng.integers(-1, groups + 1, (n, 1)), NONE)
            places = dequantise(symbols(rng, (groups, 3), kind), 1 / 16)
            maps = {name: dequantise(symbols(rng, (groups, 4, bases), kind), 1 / 16) for name in heads[::2]}
            own = Groups(rows.astype(np.float32), places, maps)
        tracks[layer] = Tracks.of(np.linspace(0, 1, instants) ** 2, 1 / 16, moved, own)
    return SplatScene(
        info=info(rng),
        layers=layers,
        rows=(n,) * len(layers),
        anchor_q=cells,
        mask=tuple(codes.T.copy()),
        grading=Grading(classes, np.concatenate(centres)) if graded else None,
        steps={name: STEPS[name] for name in tensors},
        tensors=tensors,
        tracks=tracks,
    )


@st.composite
def splat_scenes(draw: st.DrawFn) -> SplatScene:
    """Splats of all layer sets, ranges, degrees and sets of heads, with and without step classes and windows."""
    kind = draw(st.sampled_from(RANGES))
    heads = draw(st.sets(st.sampled_from(sorted(HEADS))))
    return make_splats(
        draw(st.integers(0, 2**32 - 1)),
        layers=draw(st.sampled_from(LAYER_SETS)),
        count=draw(st.sampled_from((0, 1) if kind == "huge" else (0, 1, 2, 5, 40))),
        kind=kind,
        degree=draw(st.integers(0, 3)),
        window=draw(st.booleans()),
        graded=draw(st.booleans()),
        heads=tuple(name for name in HEADS if name in heads),
        instants=draw(st.integers(2, 5)),
        bases=draw(st.integers(1, 3)),
        groups=draw(st.sampled_from((0, 0, 1, 3))),
        extent=draw(st.sampled_from((1, 30, 1 << 19))),
    )


def visible_splats(seed: int = 0, *, count: int = 300, degree: int = 1, moving: bool = True) -> SplatScene:
    """Opaque Gaussians on a sphere of radius 1, seen from (0, 0, -3): at rest in layer 0, turning and changing colour
    with layer 1, and swaying with layer 2, unless they do not move."""
    rng, size = np.random.default_rng(seed), 1 / 16
    points = rng.normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    cells = np.unique(np.rint(points / size).astype(np.int32), axis=0)
    n = len(cells)
    tensors = {
        "offset": rng.uniform(-0.5, 0.5, (n, 3)),
        "color": rng.normal(size=(n, 3)) * 0.4,
        "opacity": np.full((n, 1), 3.0),
        "scale": np.log(0.08) + rng.normal(size=(n, 3)) * 0.3,
        "rotation": rng.uniform(-0.4, 0.4, (n, 3)),
        "harmonics": rng.normal(size=(n, 3 * ((degree + 1) ** 2 - 1))) * 0.2,
    }
    tensors = {name: x.astype(np.float32) for name, x in tensors.items() if x.size}
    times, tracks = np.linspace(0, 1, 5), {}
    for layer, names in ((1, ("position", "rotation", "color")), (2, ("position",))) if moving else ():
        heads = {}
        for name in names:
            bases = np.sin(times * rng.uniform(1, 5, (2, HEADS[name], 1))).astype(np.float32)
            heads[name] = Head(bases, (rng.normal(size=(n, 2)) * 0.3).astype(np.float32), 1 / 64)
        tracks[layer] = Tracks.of(times, 1 / 256, heads)
    box = np.array([[-1.5] * 3, [1.5] * 3], np.float32)
    camera = replace(info(rng)).camera
    assert camera is not None
    viewmat = np.eye(4, dtype=np.float32)
    viewmat[2, 3] = 3
    K = np.array([[60, 0, 24], [0, 60, 20], [0, 0, 1]], np.float32)
    camera = replace(camera, viewmat=viewmat, K=K, width=48, height=40)
    about = SceneInfo(size, box, (0.0, 2.0), (1.0, 1.0, 1.0), 0.1, 100.0, (0.3, -0.8, 0.5), 1.0, camera)
    return splats.scene(about, cells, tensors, STEPS, tracks=tracks)


def assert_same_splats(a: SplatScene, b: SplatScene) -> None:
    """Every array of two scenes is equal, bit for bit."""
    assert (a.layers, a.rows, a.steps, list(a.tensors)) == (b.layers, b.rows, b.steps, list(b.tensors))
    np.testing.assert_array_equal(a.anchor_q, b.anchor_q, strict=True)
    np.testing.assert_equal(a.tensors, b.tensors)
    np.testing.assert_equal(a.mask, b.mask)
    np.testing.assert_equal(*(scene.grading and vars(scene.grading) for scene in (a, b)))
    assert list(a.tracks) == list(b.tracks)
    for layer, tracks in a.tracks.items():
        other = b.tracks[layer]
        assert tracks.step == other.step and list(tracks.heads) == list(other.heads)
        np.testing.assert_array_equal(tracks.instants, other.instants)
        np.testing.assert_equal(*({n: vars(head) for n, head in own.heads.items()} for own in (tracks, other)))
        np.testing.assert_equal(*(own.groups and vars(own.groups) for own in (tracks, other)))
