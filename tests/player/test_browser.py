"""The player in a real browser: Chromium with its software renderer, driven by Playwright.

PD4DGS_BROWSER names the browser, else one is looked for. Where there is none, or no Playwright, these tests are
skipped, unless PD4DGS_REQUIRE_BROWSER is 1.
"""

import functools
import gzip
import http.server
import json
import math
import os
import re
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from browser import (
    ELEMENT,
    PLAYER,
    TIMEOUT_MS,
    call,
    check_packages,
    eyes_of_headset,
    launched,
    pixels,
    screenshot,
    wait_for_level,
)
from pictures import Rasterised, cameras, decibels, resized, shots
from PIL import Image
from strategies import flipped, make_scene
from tiny import random_deformation, random_network

from pd4dgs_codec import decode, encode, show
from pd4dgs_codec import scene as scene_module
from pd4dgs_codec.errors import DataError
from pd4dgs_codec.format.encoder import with_metadata
from pd4dgs_codec.format.info import info
from pd4dgs_codec.format.metadata import Metadata
from pd4dgs_codec.interchange.splats import ply_bytes
from pd4dgs_codec.kinds.splats import TENSORS, Splats
from pd4dgs_codec.kinds.splats import scene as splat_scene
from pd4dgs_codec.kinds.tracks import HEADS, Head, Tracks
from pd4dgs_codec.scene import Camera, Deformation, Scene, SceneInfo, Steps, Widths
from pd4dgs_codec.web.page import Still
from pd4dgs_codec.web.page import page as packed_page
from pd4dgs_codec.web.server import Link, Server

ROOT = Path(__file__).parents[2]

WIDTH, HEIGHT = 96, 72
#: Least PSNR of the player's pictures against the rasteriser's. Rounding to eight bits alone gives 59.
LEAST_DB = 45.0
#: The same for Spark and PlayCanvas, which store Gaussians as half floats and small integers.
SPARK_DB = 40.0


def _missing(reason: str) -> Any:
    if os.environ.get("PD4DGS_REQUIRE_BROWSER") == "1":
        pytest.fail(f"PD4DGS_REQUIRE_BROWSER is 1, but {reason}")
    pytest.skip(reason)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    try:
        with launched() as opened:
            yield opened
    except DataError as error:
        _missing(str(error))


# -- scenes ------------------------------------------------------------------------------------------------------------


def lively_scene(
    anchors: int = 700,
    seed: int = 3,
    *,
    hidden: tuple[int, ...] = (16,),
    channels: int = 8,
    scales: int = 2,
    trunk: tuple[int, ...] = (16, 12),
    heads: tuple[dict[str, int], dict[str, int]] | None = None,
    layers: tuple[int, ...] = (0, 1, 2),
    widths: Widths = scene_module.DEFAULT_WIDTHS,
    keys: tuple[int | None, int | None] = (None, None),
) -> Scene:
    """Layers that differ, some thousand Gaussians of all shapes in front of the scene's camera."""
    rng = np.random.default_rng(seed)
    cells = np.unique(rng.integers(-60, 61, (2 * anchors, 3)), axis=0)
    cells = rng.permutation(cells)[:anchors].astype(np.int32)
    viewmat = np.eye(4, dtype=np.float32)
    viewmat[2, 3] = 4
    K = np.array([[80, 0, WIDTH / 2 + 3], [0, 84, HEIGHT / 2 - 2], [0, 0, 1]], np.float32)
    codes = np.sort(rng.choice(np.array([0, 60, 180, 255], np.uint8), (anchors, 3)), axis=1)
    codes[: anchors // 2] = [140, 200, 255]
    planes = dict(resolutions=[(9 << s, 7 << s, 8 << s, 5) for s in range(scales)], channels=channels, spread=0.4)
    fields: dict[int, Deformation] = {}
    for layer, names, key in zip((1, 2), heads or (widths.heads, widths.heads), keys, strict=True):
        if layer in layers and names:
            below = fields[1].channels if fields else 0
            fields[layer] = random_deformation(rng, names, **planes, trunk=trunk, key=key, below=below)
    return Scene(
        info=SceneInfo(
            voxel_size=float(np.float32(1 / 40)),
            box=np.array([[-1.4, -1.6, -1.5], [1.5, 1.3, 1.4]], np.float32),
            time_range=(1.0, 3.0),
            background=(0.25, 0.5, 0.75),
            near=0.125,
            far=64.0,
            up=(0.0, -1.0, 0.0),
            unit=0.0,
            camera=Camera(viewmat, K, WIDTH, HEIGHT),
        ),
        steps=Steps(),
        layers=layers,
        rows=(anchors,) * len(layers),
        anchor_q=cells,
        feature=rng.normal(0, 0.6, (anchors, widths.feature)).astype(np.float32),
        scaling_log=rng.normal(-2.4, 0.5, (anchors, 6)).astype(np.float32),
        offset=rng.normal(0, 0.6, (anchors, widths.slots, 3)).astype(np.float32),
        mask=tuple(codes.T[list(layers)].copy()),
        networks={
            name: random_network(rng, widths.inputs[name], *hidden, width, scale=0.4)
            for name, width in widths.networks.items()
        },
        global_deformation=fields.get(1),
        local_deformation=fields.get(2),
        fills=((26, 204, 51), *[None] * (len(layers) - 1)),
    )


@pytest.fixture(scope="module")
def lively() -> bytes:
    return encode(lively_scene(), layers=2, effort=1)


@pytest.fixture(scope="module")
def small() -> bytes:
    """For tests that compare no pictures."""
    return encode(lively_scene(150), layers=2, effort=1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, lively: bytes, small: bytes) -> Path:
    """The player and scenes beside it."""
    root = tmp_path_factory.mktemp("www")
    shutil.copytree(PLAYER, root / "player", ignore=shutil.ignore_patterns("node_modules", "test"))
    (root / "scene.pd4").write_bytes(lively)
    (root / "small.pd4").write_bytes(small)
    shutil.copy(root / "scene.pd4", root / "player" / "scene.pd4")
    return root


@pytest.fixture(scope="module")
def server(folder: Path) -> Iterator[Server]:
    with Server(folder) as served, served.running():
        yield served


@pytest.fixture(scope="module")
def context(browser: Any) -> Any:
    """What all pages share, since a new one takes seconds of CPU. Nothing here is kept from page to page."""
    context = browser.new_context(viewport={"width": 480, "height": 360})
    context.set_default_timeout(TIMEOUT_MS)
    return context


def _opened(context: Any) -> tuple[Any, list[str]]:
    """A page, and what goes wrong on it from now on."""
    opened = context.new_page()
    errors: list[str] = []
    opened.on("pageerror", lambda error: errors.append(str(error)))
    return opened, errors


def _load_harness(page: Any, server: Server) -> Any:
    page.goto(server.url_of("player/test-browser/harness.html") + "?player")
    page.wait_for_function("!!window.harness")
    return page


@pytest.fixture
def page(context: Any) -> Iterator[Any]:
    """A page on which nothing goes wrong unnoticed."""
    opened, errors = _opened(context)
    yield opened
    opened.close()
    assert not errors


@pytest.fixture(scope="module")
def _shared_harness(context: Any, server: Server) -> Iterator[tuple[Any, list[str]]]:
    opened, errors = _opened(context)
    yield _load_harness(opened, server), errors
    opened.close()


@pytest.fixture
def harness(_shared_harness: tuple[Any, list[str]]) -> Iterator[Any]:
    """The harness, closed again. One page for all, since a new one takes more than a second of CPU."""
    opened, errors = _shared_harness
    errors.clear()
    yield opened
    opened.evaluate("harness.close()")
    assert not errors


def opened(page: Any, url: str, **options: Any) -> list[tuple[str, Any]]:
    """The events of the harness, which has loaded a scene."""
    events: list[tuple[str, Any]] = call(page, "harness.open", url, WIDTH, HEIGHT, options)
    return events


def shoot(page: Any, **state: Any) -> np.ndarray:
    """The harness's settled picture, float [H, W, 3]."""
    return pixels(call(page, "harness.shoot", state), WIDTH, HEIGHT) / 255


# -- evaluation and pictures -------------------------------------------------------------------------------------------


OPACITY_SEES = Widths(5, 4, viewing=("opacity",))
#: Each width, number of layers, absent part and key instant is in one of them; each takes a second to compile shaders.
SHAPES: dict[str, dict[str, Any]] = {
    "usual": {},
    "small, 16 and 4": dict(hidden=(5,), channels=2, scales=1, trunk=(3,), widths=Widths(16, 4)),
    "odd widths, a key instant": dict(hidden=(7,), channels=5, scales=3, trunk=(6, 21), keys=(26_214, None)),
    "many channels": dict(
        hidden=(40,), channels=33, scales=1, heads=({"position": 3, "scaling": 6}, {"position": 3, "offset": 30})
    ),
    "layer 2 does not move": dict(
        anchors=250, hidden=(4,), channels=3, heads=({"feature": 5}, {}), widths=OPACITY_SEES
    ),
    "layer 1 does not move": dict(channels=3, heads=({}, {"scaling": 6}), keys=(None, 500)),
    "no layer 1": dict(layers=(0, 2), heads=({}, {"feature": 32, "offset": 30})),
    "most, two key instants": dict(widths=Widths(64, 16), hidden=(7,), keys=(26_214, 40_000)),
    "least": dict(widths=Widths(1, 1), anchors=700, seed=6),
    "views of color": dict(widths=Widths(viewing=("color",))),
}


@pytest.mark.parametrize("options", SHAPES.values(), ids=SHAPES)
def test_both_evaluators_agree(harness, folder, server, options):
    scene = lively_scene(**{"anchors": 150, **options})
    scene = replace(scene, fills=((0, 0, 0, 24), None, (0, 0, 0, 64))[: len(scene.layers)])  # spreads
    (folder / "agree.pd4").write_bytes(encode(scene, layers=2, effort=1))
    eyes = ([0.0, 0.0, -5.0], [2.0, 1.0, -4.0])
    moments = ((0.0, eyes[0]), (0.4, eyes[0]), (0.4, eyes[1]), (1.0, eyes[1]))
    cases = [dict(level=level, t=t, eye=eye) for level in scene.layers for t, eye in moments]
    result = call(harness, "harness.compare", server.url_of("agree.pd4"), cases, 1 << 8)
    assert result["error"] == 0
    for case, got in zip(cases, result["cases"], strict=True):
        assert got["count"] > 50 and got["lonely"] == 0, (case, got)
        assert all(error < 2e-4 for error in got["worst"].values()), (case, got)  # false for NaN
    if scene.widths.shapes_are_blind:  # another eye changes colours alone
        assert not any(got["moved"] for got in result["cases"][2::4])


@pytest.fixture(scope="module")
def splats() -> bytes:
    """Gaussians of three layers, of which layers 1 and 2 have tracks, with harmonics and windows."""
    rng = np.random.default_rng(7)
    n, times = 900, np.array([0, 0.2, 0.5, 1])
    cells = np.unique(rng.integers(-9, 10, (2 * n, 3)), axis=0)
    cells = rng.permutation(cells)[:n].astype(np.int32)
    sizes = {"offset": 0.3, "color": 0.8, "opacity": 2, "scale": 0.5, "rotation": 0.3, "harmonics": 0.2, "window": 0.3}
    tensors = {
        name: rng.normal(0, size, (n, 24 if name == "harmonics" else TENSORS[name][0])).astype(np.float32)
        for name, size in sizes.items()
    }
    tensors["scale"] -= 2.4
    tensors["window"][:] = np.abs(tensors["window"]) * [2, 0.5, 0] + [0, 0, -2]

    layer = rng.integers(0, 3, n)

    def tracks(of: int, *heads: str) -> Tracks:
        made = {}
        for name in heads:
            bases = rng.normal(0, 0.6, (3, HEADS[name], len(times))).astype(np.float32)
            bases[:, :, 0] = 0
            coefficients = rng.normal(0, 0.6, (n, 3)) * (layer <= of)[:, None]
            made[name] = Head(bases, coefficients.astype(np.float32), 1 / 64)
        return Tracks.of(times, 1 / 256, made)

    made = splat_scene(
        replace(lively_scene(1).info, voxel_size=1 / 8),
        cells,
        tensors,
        {name: 1 / 128 for name in tensors},
        tracks={1: tracks(1, "position", "rotation", "color"), 2: tracks(2, "position", "scale", "opacity")},
        layer=layer,
    )
    return encode(replace(made, fills=((26, 204, 51), None, None)), effort=1)


@pytest.fixture(scope="module")
def narrow() -> bytes:
    """Features of 16 numbers, four Gaussians an anchor, and a key instant."""
    return encode(lively_scene(700, widths=Widths(16, 4), keys=(20_000, 20_000)), layers=2, effort=1)


@pytest.mark.parametrize(
    "kind, evaluator", [("lively", "gpu"), ("narrow", "gpu"), ("narrow", "cpu"), ("splats", "cpu"), ("splats", "gpu")]
)
def test_pictures_are_those_of_the_rasteriser(harness, server, folder, kind, evaluator, request):
    pytest.importorskip("numba")
    data = request.getfixturevalue(kind)
    (folder / f"{kind}.pd4").write_bytes(data)
    scene = decode(data)
    # the scene's own camera, one from the side, and one from nearby that looks past much of the scene
    turns = ((0.9, 0.1), (-2.1, 0.7)) if kind in ("lively", "splats") else ()
    views = [resized(camera, WIDTH, HEIGHT) for camera in cameras(scene, turns)]
    opened(harness, server.url_of(f"{kind}.pd4"), evaluator=evaluator)
    seen = []
    for shot in shots(harness, data, [(views[0], (0.0, 0.37, 1.0)), *((view, (0.37,)) for view in views[1:])]):
        assert np.abs(shot.expected - scene.background(shot.level)).max() > 0.2
        assert decibels(shot.player, shot.expected) > LEAST_DB, (shot.level, shot.t, shot.camera)
        seen.append(shot.player)
    assert len(seen) == 9 + 3 * (len(views) - 1)
    assert decibels(seen[1], seen[2]) < 60 and decibels(seen[2], seen[5]) < 60  # levels and times differ


@pytest.mark.parametrize("evaluator", [None, "gpu"])
def test_another_eye_changes_the_colours_of_splats(harness, server, folder, splats, evaluator):
    pytest.importorskip("numba")
    (folder / "splats.pd4").write_bytes(splats)
    turns = ((0.4, 0), (0.8, 0.1), (-0.5, 0), (0, 0.3))
    views = [(resized(camera, WIDTH, HEIGHT), (0.37,)) for camera in cameras(decode(splats), turns)]
    opened(harness, server.url_of("splats.pd4"), evaluator=evaluator)
    for shot in shots(harness, splats, views, [2]):
        assert decibels(shot.player, shot.expected) > LEAST_DB, shot.camera


@pytest.fixture(scope="module")
def repository() -> Iterator[Server]:
    """Serves the player with the packages of other viewers, if they are installed."""
    with Server(ROOT) as served, served.running():
        yield served


def viewer(page: Any, repository: Server, name: str) -> None:
    """Loads the harness of another viewer."""
    try:
        check_packages(name)
    except DataError as error:
        pytest.skip(str(error))
    page.goto(f"{repository.url_of('player/test-browser/harness.html')}?{name}")
    page.wait_for_function("!!window.harness")


def centred(camera: Camera) -> Camera:
    """The view with square pixels and its axis in the middle of the picture, as PlayCanvas has them."""
    K = np.array([[80, 0, WIDTH / 2], [0, 80, HEIGHT / 2], [0, 0, 1]], np.float32)
    return replace(camera, K=K, width=WIDTH, height=HEIGHT)


@pytest.mark.parametrize("kind", ["lively", "splats"])
@pytest.mark.parametrize("name, seen_by", [("spark", lambda c: resized(c, WIDTH, HEIGHT)), ("playcanvas", centred)])
def test_pictures_through_other_viewers_are_those_of_the_rasteriser(
    page, repository, server, folder, name, seen_by, kind, request
):
    pytest.importorskip("numba")
    viewer(page, repository, name)
    data = request.getfixturevalue(kind)
    (folder / f"{kind}.pd4").write_bytes(data)
    opened(page, server.url_of(f"{kind}.pd4"))
    scene = decode(data)
    views = [seen_by(camera) for camera in cameras(scene, [(0.3, 0.1)])]
    seen = []
    # level 2 has Gaussians larger than the picture or outside of it, which these engines draw otherwise or leave out
    own, aside = [(views[0], (0.0, 1.0))], [(views[1], (0.5,))]
    for shot in (*shots(page, data, own, [0, 1]), *shots(page, data, aside, [1])):
        assert decibels(shot.player, shot.expected) > SPARK_DB, (shot.level, shot.t, shot.camera)
        assert np.abs(shot.expected - scene.background(shot.level)).max() > 0.2
        seen.append(shot.player)
    assert decibels(seen[0], seen[1]) < 60 and decibels(seen[1], seen[3]) < 60  # levels and times differ
    call(page, "harness.close")


@pytest.mark.parametrize("name", ["element", "spark", "playcanvas"])
def test_the_snippets_of_the_documentation_show_the_scene(page, server, repository, folder, name):
    """Each page is what docs/player-and-delivery.md prints, with the import map that it asks for."""
    text = (ROOT / "docs" / "player-and-delivery.md").read_text(encoding="utf-8")
    wanted = "player/element.js" if name == "element" else f'from "pd4-player/{name}"'
    body = next(code for code in re.findall(r"```(?:html|js)\n(.*?)```", text, re.DOTALL) if wanted in code)
    if name != "element":
        try:
            check_packages(name)
        except DataError as error:
            pytest.skip(str(error))
        harness = (PLAYER / "test-browser" / "harness.html").read_text(encoding="utf-8")
        (known,) = re.findall(r'importmap">(.*?)</script>', harness, re.DOTALL)
        places = {
            key: place.replace("..", f"{repository.url}player") for key, place in json.loads(known)["imports"].items()
        }
        places[f"pd4-player/{name}"] = f"./player/{name}.js"
        head = f'<script type="importmap">{json.dumps({"imports": places})}</script>'
        canvas = "<canvas></canvas>" * (name == "playcanvas")
        body = f'{head}{canvas}<script type="module">{body}</script>'
    (folder / "snippet.html").write_text(f"<!doctype html><body style='margin: 0'>{body}", encoding="utf-8")
    page.set_viewport_size({"width": 160, "height": 120})  # these engines draw all the time
    page.goto(server.url_of("snippet.html"))
    end = time.monotonic() + TIMEOUT_MS / 1000
    while np.ptp(screenshot(page)[:70], axis=(0, 1)).min() < 60:  # above the controls of the element
        assert time.monotonic() < end, "the page shows one colour"


def test_supersplat_shows_the_script_in_place_of_a_still(page, repository, server, folder, lively):
    pytest.importorskip("numba")
    viewer(page, repository, "supersplat")
    scene = decode(lively)
    corners = scene.info.box.astype(np.float32)
    white = np.ones((2, 1, 3), np.float32)
    still = Splats(corners, np.eye(4, dtype=np.float32)[[0, 0]], 0 * corners + 0.3, np.float32([1, 1]), white)
    (folder / "still.ply").write_bytes(ply_bytes(still))
    fov = math.degrees(2 * math.atan(WIDTH / 2 / 80))
    look = dict(position=[0.3, 0.2, -4], target=[0, 0, 0], angles=[0, 0, 180], fov=fov, ui=False)
    look |= dict(still=server.url_of("still.ply"), background=scene.info.background)
    opened(page, server.url_of("scene.pd4"), **look)
    seen = []
    for level, t in ((0, 0.0), (1, 0.5)):
        state = call(page, "harness.show", dict(level=level, seconds=1 + 2 * t))
        seen.append(screenshot(page)[:HEIGHT, :WIDTH] / 255)
        viewmat = np.diag([1.0, -1, -1, 1]) @ np.linalg.inv(np.reshape(state["pose"], (4, 4)).T)
        K = np.array([[state["focal"], 0, WIDTH / 2], [0, state["focal"], HEIGHT / 2], [0, 0, 1]], np.float32)
        camera = Camera(viewmat.astype(np.float32), K, WIDTH, HEIGHT)
        shown = replace(decode(lively, max_layer=level), fills=())  # the background is the viewer's
        assert decibels(seen[-1], Rasterised(shown).picture(camera, t)) > SPARK_DB
    assert decibels(*seen) < 60
    call(page, "harness.close")


def test_the_playcanvas_script_plays_and_tells_what_fails(page, repository, server):
    viewer(page, repository, "playcanvas")
    opened(page, server.url_of("scene.pd4"))
    page.evaluate("harness.script.speed = 10; harness.script.loop = false; harness.script.playback.play()")
    page.wait_for_function("harness.script.playback.paused")
    assert page.evaluate("harness.script.playback.time") == 3
    page.evaluate("harness.script.once('error', (error) => (window.told = error.message))")
    page.evaluate("(url) => harness.script.load(url)", server.url_of("absent.pd4"))
    page.wait_for_function("!!window.told")
    assert "404" in page.evaluate("told") and page.evaluate("harness.script.info") is None
    assert page.evaluate("harness.script.entity.gsplat") is None
    page.evaluate("(url) => harness.script.load(url)", server.url_of("scene.pd4"))
    page.wait_for_function("harness.script.playback.settled && harness.script.entity.gsplat.resource.numSplats > 100")
    page.evaluate("harness.script.entity.destroy()")
    page.wait_for_function("!harness.script.playback")
    call(page, "harness.close")


@pytest.mark.parametrize("hidden", [(300,), (), (9, 8)])
def test_networks_that_shaders_do_not_take_are_evaluated_on_the_cpu(harness, folder, server, hidden):
    (folder / "wide.pd4").write_bytes(encode(lively_scene(60, hidden=hidden), layers=2, effort=1))
    pictures = []
    for evaluator in ("gpu", "cpu"):
        opened(harness, server.url_of("wide.pd4"), evaluator=evaluator)
        pictures.append(shoot(harness))
        assert harness.evaluate("harness.player.status.level") == 2
    assert decibels(*pictures) > 60 and np.ptp(pictures[0]) > 0.3


@pytest.mark.parametrize("kind", ["constant", "huge"])
def test_absurd_values_leave_a_picture(harness, folder, server, kind):
    (folder / "absurd.pd4").write_bytes(encode(make_scene(2, anchors=40, kind=kind), layers=2, effort=1))
    events = opened(harness, server.url_of("absurd.pd4"))
    assert "error" not in dict(events)
    for level in (0, 1, 2):
        assert shoot(harness, level=level, seconds=1.1).shape == (HEIGHT, WIDTH, 3)


def test_nothing_is_evaluated_in_vain(harness, server):
    opened(harness, server.url_of("scene.pd4"))

    def after(change: str) -> dict[str, int]:
        return call(
            harness,
            f"""async () => {{
              const {{ player }} = harness;
              await player.settled();
              const before = {{ ...player.counts }};
              {change}
              await player.settled();
              const {{ drawn, evaluated }} = player.counts;
              return {{ drawn: drawn - before.drawn, evaluated: evaluated - before.evaluated }};
            }}""",
        )

    turned = """const [a, b] = [Math.cos(.1), Math.sin(.1)];
      const rows = [a, 0, -b, -4 * b, 0, 1, 0, 0, b, 0, a, 4 * a, 0, 0, 0, 1];
      player.camera = { ...player.camera, viewmat: new Float32Array(rows) };"""
    assert after("") == {"drawn": 0, "evaluated": 0}
    assert after("player.seek(2)")["evaluated"] == 1
    assert after("player.seek(2)")["evaluated"] == 0
    assert after("player.level = 0")["evaluated"] == 1
    assert after("player.seek(1.5)")["evaluated"] == 0  # level 0 stands still
    moved = after(turned)
    assert moved["evaluated"] == 0 and moved["drawn"] >= 1  # about the camera's centre: only the order changes


# -- loading -----------------------------------------------------------------------------------------------------------


def test_the_first_picture_comes_before_the_last_layer(harness, folder, lively):
    ends = [row["end"] for row in info(lively)["layers"]]
    with Server(folder, link=Link(8 * len(lively) / 4)) as slow, slow.running():
        harness.evaluate("(url) => void harness.open(url, 96, 72)", slow.url_of("scene.pd4"))
        harness.wait_for_function("harness.events.some(([name]) => name === 'firstpicture')")
        name, first = harness.evaluate("harness.events[0]")
        assert (name, first["level"]) == ("firstpicture", 0)
        assert 0 < first["arrived"] < first["decoded"] < first["seconds"]
        assert ends[0] <= first["bytes"] < ends[2]
        harness.wait_for_function("harness.player.status.level === 2")
    names = [(name, detail.get("level")) for name, detail in harness.evaluate("harness.events")]
    assert [item for item in names if item[0] != "loaded"] == [("firstpicture", 0), ("upgrade", 1), ("upgrade", 2)]


def test_the_first_picture_comes_before_layer_0_is_whole(harness, folder):
    data = encode(lively_scene(), layers=2, effort=1, slices=12_000)
    ends = {row["layer"]: row["end"] for row in info(data)["layers"]}
    (folder / "slices.pd4").write_bytes(data)
    with Server(folder, link=Link(8 * len(data) / 4)) as slow, slow.running():
        harness.evaluate("(url) => void harness.open(url, 96, 72)", slow.url_of("slices.pd4"))
        harness.wait_for_function("harness.events.some(([name]) => name === 'loaded')")
        call(harness, "() => harness.player.settled()")
    shown = [detail for name, detail in harness.evaluate("harness.events") if name in ("firstpicture", "upgrade")]
    assert shown[0]["bytes"] < ends[0] and shown[0]["level"] == shown[1]["level"] == 0
    assert [detail["level"] for detail in shown][-1] == 2 and len(shown) > 4
    (shot,) = shots(harness, data, [(decode(data).info.camera, (0.37,))], [2])
    assert decibels(shot.player, shot.expected) > LEAST_DB


def test_a_poster_stays_until_more_of_the_file_shows_more(harness, folder, lively):
    ends = [row["end"] for row in info(lively)["layers"]]
    first = "harness.events.find(([name]) => name === 'firstpicture')?.[1]"
    with Server(folder, link=Link(8 * len(lively) / 3)) as slow, slow.running():
        url = slow.url_of("scene.pd4")
        harness.evaluate("([url, held]) => void harness.open(url, 96, 72, { held, autoplay: true })", [url, ends[0]])
        harness.wait_for_function("harness.player._front")
        assert harness.evaluate("[harness.player.status.level, harness.player.paused]") == [None, True]
        harness.wait_for_function(first)
        assert harness.evaluate(first)["consumed"] in ends[1:] and harness.evaluate("!harness.player.paused")

        harness.evaluate("(url) => void harness.open(url, 96, 72, { held: 1e9 })", url)
        harness.wait_for_function("harness.player._front")
        harness.evaluate("harness.player.camera = harness.player.camera")  # as a viewer does
        harness.wait_for_function(first)
        assert harness.evaluate(first)["consumed"] < len(lively)

        opened(harness, url, held=1e9, level=1)  # more does not come
        harness.wait_for_function(first)
        assert harness.evaluate(first)["consumed"] == ends[1]


def test_budgets_are_kept_and_may_be_raised(harness, server, lively):
    ends = [row["end"] for row in info(lively)["layers"]]
    events = opened(harness, server.url_of("scene.pd4"), bytes=ends[1] + 10)
    assert dict(events)["loaded"] == {"bytes": ends[1], "complete": False}
    call(harness, "() => harness.player.settled()")
    assert harness.evaluate("harness.player.status.levels") == [0, 1]

    opened(harness, server.url_of("scene.pd4"), level=0)
    call(harness, "() => harness.player.settled()")
    assert harness.evaluate("harness.player.status.levels") == [0]
    harness.evaluate("harness.player.level = null")
    harness.wait_for_function("harness.player.status.level === 2")


def test_a_level_may_be_raised_while_a_lower_one_loads(harness, folder, lively):
    with Server(folder, link=Link(8 * len(lively) / 2)) as slow, slow.running():
        harness.evaluate("(url) => void harness.open(url, 96, 72, { level: 0 })", slow.url_of("scene.pd4"))
        harness.wait_for_function("harness.player.status.bytes > 0")
        assert harness.evaluate("(harness.player.level = null, harness.player.status.loading)")
        harness.wait_for_function("harness.player.status.level === 2")


def element(page: Any, server: Server, attributes: str, code: Server | None = None, *, policy: str = "") -> Any:
    """A page of `server` with one element. code: the server of the element's code, if it is another one. policy: of the
    content of the page."""
    script = (code or server).url_of("player/element.js")
    html = f"""<!doctype html><title>t</title><meta http-equiv="Content-Security-Policy" content="{policy}">
      <script type="module" src="{script}"></script>
      <pd4-player {attributes} style="width: 320px; height: 240px"></pd4-player>"""
    (server.root / "element.html").write_text(html)
    page.add_init_script(
        """window.seen = [];
        for (const name of ["firstpicture", "upgrade", "error", "progress", "loaded", "statechange"]) {
          document.addEventListener(name, (event) => seen.push([name, event.detail]), true);
        }"""
    )
    page.goto(server.url_of("element.html"))
    return page.locator("pd4-player")


FAULTS: dict[str, tuple[Any, int | None, str]] = {
    "damaged in layer 1": (lambda data, ends: flipped(data, ends[1] - 50, 4), 0, "CRC-32"),
    "cut in layer 2": (lambda data, ends: data[: ends[2] - 20], 1, "truncated"),
    "damaged in layer 0": (lambda data, ends: flipped(data, ends[0] - 50, 4), None, "CRC-32"),
    "foreign": (lambda *_: b"<!doctype html><p>no such scene" * 20, None, "pd4"),
    "absent": (lambda *_: None, None, "404"),
    "hostile": (lambda *_: (ROOT / "spec" / "vectors" / "faulty" / "bomb-most-rows.pd4").read_bytes(), None, "limit"),
}


def test_bad_input_is_one_line_and_keeps_what_was_valid(page, server, folder, small):
    """On one page, where a whole scene follows each."""
    ends = [row["end"] for row in info(small)["layers"]]
    player = element(page, server, "controls")
    alert = player.get_by_role("alert")
    source = f"(url) => {{ seen.length = 0; {ELEMENT}.src = url }}"
    for fault, (make, shown, words) in FAULTS.items():
        name, data = fault.replace(" ", "-") + ".pd4", make(small, ends)
        if data is not None:
            (folder / name).write_bytes(data)
        page.evaluate(source, server.url_of(name))
        alert.wait_for()
        text = alert.inner_text()
        assert words in text and "\n" not in text and len(text) < 300, (fault, text)
        page.wait_for_function("seen.some(([name]) => name === 'error')")
        (error,) = (detail for name, detail in page.evaluate("seen") if name == "error")
        assert error["message"] == text and error["kind"], fault
        if shown is not None:
            wait_for_level(page, shown)
        else:
            assert page.evaluate(f"{ELEMENT}.player.status.level") is None, fault
        page.evaluate(source, server.url_of("small.pd4"))
        wait_for_level(page, 2)
        assert alert.is_hidden(), fault


# -- robustness --------------------------------------------------------------------------------------------------------


def test_a_lost_context_comes_back(page, server):
    _load_harness(page, server)
    opened(page, server.url_of("scene.pd4"), evaluator="gpu")
    before = shoot(page, seconds=1.8)
    call(page, "harness.loseContext")
    after = shoot(page)
    assert decibels(before, after) > 60  # the order of equal depths may be another one
    assert "error" not in dict(page.evaluate("harness.events"))


def test_scenes_opened_and_closed_leave_nothing(page, server):
    _load_harness(page, server)
    pages = len(page.context.pages)
    sizes = call(
        page,
        """async (url) => {
          const sizes = [];
          for (let i = 0; i < 12; i++) {
            await harness.open(url, 96, 72, { level: i % 4 ? 0 : null });
            await harness.player.settled();
            harness.close();
            await new Promise((resolve) => setTimeout(resolve, 30));
            gc();
            sizes.push(performance.memory.usedJSHeapSize);
          }
          return sizes;
        }""",
        server.url_of("scene.pd4"),
    )
    assert page.evaluate("document.querySelectorAll('canvas').length") == 0
    held = 700 * (72 + 3) * 4  # the arrays of one scene
    assert min(sizes[9:]) < min(sizes[2:5]) + held, sizes  # every fourth is loaded in full
    assert len(page.context.pages) == pages and len(page.workers) == 0


def test_a_scene_that_replaces_another_while_it_loads(harness, server):
    seen = call(
        harness,
        """async (url) => {
          harness.open(url, 96, 72);
          const { player } = harness;
          for (let i = 0; i < 5; i++) {
            player.load(url);
            await new Promise((resolve) => setTimeout(resolve, 20 * i));
          }
          await player.load(url);
          await player.settled();
          return harness.events.map(([name]) => name);
        }""",
        server.url_of("scene.pd4"),
    )
    assert "error" not in seen and harness.evaluate("harness.player.status.level") == 2


@pytest.mark.parametrize("arrived", [False, True])
def test_an_evaluation_that_ends_after_its_scene_was_replaced_is_not_shown(harness, server, arrived):
    opened(harness, server.url_of("scene.pd4"))
    events = call(
        harness,
        """async (url, arrived) => {
          const { player } = harness;
          await player.settled();
          const evaluated = player._main._gaussians;
          let release = () => {};
          const held = new Promise((resolve) => (release = resolve));
          const begun = new Promise((resolve) => {
            player._main._gaussians = async (...args) => {
              player._main._gaussians = evaluated;
              resolve();
              const result = await player._main._gaussians(...args);
              await held;
              return result;
            };
          });
          player.seek(2.5);
          await begun;
          const loading = player.load(url);
          if (arrived) await loading;
          release();
          await loading;
          await player.settled();
          return harness.events;
        }""",
        server.url_of("scene.pd4"),
        arrived,
    )
    assert [detail["level"] for name, detail in events if name == "firstpicture"] == [0, 0]
    assert "error" not in dict(events)


# -- element -----------------------------------------------------------------------------------------------------------


def test_controls(page, server):
    player = element(page, server, f'controls src="{server.url_of("small.pd4")}"')
    wait_for_level(page, 2)
    state = f"[...{ELEMENT}.camera.viewmat]"

    slider = player.get_by_role("slider", name="Time")
    slider.fill("2.5")
    assert page.evaluate(f"{ELEMENT}.time") == pytest.approx(2.5, abs=1e-6)
    assert slider.get_attribute("aria-valuetext") == "1.5 / 2.0 s"
    play = f"(button => (button.click(), button.title))({ELEMENT}.shadowRoot.querySelector('.play'))"
    assert page.evaluate(play) == "Pause"  # in one call, as it plays for half a second
    player.get_by_role("button", name="Play").wait_for()  # at the end it stops
    assert page.evaluate(f"{ELEMENT}.time") == 3

    box = player.get_by_role("combobox", name="Highest level")
    box.select_option("1")
    wait_for_level(page, 1)
    assert player.get_attribute("level") == "1"
    box.select_option("")
    assert player.get_attribute("level") is None

    surface = player.get_by_role("application", name="Dynamic scene")
    home = page.evaluate(state)
    surface.focus()
    views = [home]
    for key in ("ArrowLeft", "ArrowUp", "Shift+ArrowRight", "+", "-"):
        page.keyboard.press(key)
        views.append(page.evaluate(state))
        assert views[-1] != views[-2], key
    page.keyboard.press("Home")
    assert page.evaluate(state) == home

    far = np.array(home).reshape(4, 4) + np.array([[0, 0, 0, 50.0]] + 3 * [[0, 0, 0, 0]])
    look = f"(v) => void ({ELEMENT}.camera = {{ ...{ELEMENT}.camera, viewmat: new Float32Array(v) }})"
    page.evaluate(look, far.ravel().tolist())
    page.keyboard.press("ArrowLeft")
    near = np.array(page.evaluate(state)).reshape(4, 4)
    eyes = [-view[:3, :3].T @ view[:3, 3] for view in (far, near)]
    assert 0 < np.linalg.norm(eyes[1] - eyes[0]) < 2  # not about what the camera before looked at
    page.keyboard.press("Home")

    page.evaluate(f"{ELEMENT}.seek(NaN)")
    assert page.evaluate(f"{ELEMENT}.time") == 3
    page.keyboard.press(",")
    assert page.evaluate(f"{ELEMENT}.time") == pytest.approx(3 - 1 / 30)
    changes = "seen.filter(([name]) => name === 'statechange').length"
    before = page.evaluate(changes)
    page.keyboard.press("Space")
    assert page.evaluate(changes) > before
    page.evaluate(f"{ELEMENT}.pause()")

    area = surface.bounding_box()
    x, y = area["x"] + 160, area["y"] + 100
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 40, y + 10)
    page.mouse.up()
    turned = np.array(page.evaluate(state)).reshape(4, 4)
    np.testing.assert_allclose(turned[:3, :3] @ turned[:3, :3].T, np.eye(3), atol=1e-5)
    assert turned.ravel().tolist() != home
    page.mouse.wheel(0, -200)
    page.wait_for_function(f"(before) => {state}.some((v, i) => v !== before[i])", arg=turned.ravel().tolist())
    player.get_by_role("button", name="Reset the view").click()
    assert page.evaluate(state) == home

    page.evaluate(
        """() => {
          const canvas = document.querySelector('pd4-player').player.canvas;
          canvas.setPointerCapture = () => {};
          const fire = (type, pointerId, x, y) =>
            canvas.dispatchEvent(new PointerEvent(type, { pointerId, pointerType: 'touch', clientX: x, clientY: y }));
          fire('pointerdown', 1, 100, 100); fire('pointerdown', 2, 200, 100);
          fire('pointermove', 2, 260, 100); fire('pointerup', 1, 100, 100); fire('pointerup', 2, 260, 100);
        }"""
    )
    pinched = page.evaluate(state)
    assert np.linalg.norm(np.array(pinched)[[3, 7, 11]]) < np.linalg.norm(np.array(home)[[3, 7, 11]])  # closer


def test_every_control_has_a_name_and_is_reached_by_key(page, server):
    """A button for a headset is there only if a headset is."""
    player = element(page, server, f'controls src="{server.url_of("small.pd4")}"')
    wait_for_level(page, 2)
    names = []
    for _ in range(6):
        page.keyboard.press("Tab")
        names.append(page.evaluate(f"{ELEMENT}.shadowRoot.activeElement?.getAttribute('aria-label')"))
    assert names == ["Dynamic scene", "Play", "Time", "Highest level", "Reset the view", "Full screen"]
    assert page.evaluate("navigator.xr.isSessionSupported('immersive-vr')") is False
    assert player.get_by_role("button", name="Show in the headset").count() == 0
    status = player.locator("[part=status]").inner_text()
    assert re.fullmatch(r"level 2 of 2, \d+ kB( · [\d.]+ fps)? · (\S+ size: )?no GPU found", status)


def test_a_slow_machine_shows_smaller_pictures_never_a_lower_level(page, server):
    player = element(page, server, f'controls loop src="{server.url_of("small.pd4")}"')
    wait_for_level(page, 2)
    page.evaluate(
        f"""() => {{
          const {{ player }} = {ELEMENT};
          const evaluated = player._main._gaussians;
          player._main._gaussians = async (...args) => {{
            await new Promise((resolve) => setTimeout(resolve, 450)); // more than a level may take, in older players
            return evaluated.apply(player._main, args);
          }};
          player._pace._step = 3;
          player.play();
        }}"""
    )
    page.wait_for_function(f"{ELEMENT}.player.counts.evaluated > 5")
    assert page.evaluate(f"{ELEMENT}.player.status.level") == 2
    assert page.evaluate(f"{ELEMENT}.player.canvas.width") == 107  # a third of the element's
    player.locator("[part=status]", has_text="third size: no GPU found").wait_for()


VIEW = f"[...{ELEMENT}.camera.viewmat]"


def test_keys_and_wheel_are_the_pages_unless_the_pointer_says_otherwise(page, server):
    page.goto(server.url_of("player/index.html") + "?autoplay=0")  # which the player fills
    wait_for_level(page, 2)
    home = page.evaluate(VIEW)
    page.keyboard.press("ArrowLeft")  # without a click
    turned = page.evaluate(VIEW)
    assert turned != home
    page.mouse.move(200, 100)
    page.mouse.wheel(0, -100)
    page.wait_for_function(f"(before) => {VIEW}.some((v, i) => v !== before[i])", arg=turned)

    player = element(page, server, f'controls src="{server.url_of("small.pd4")}"')
    wait_for_level(page, 2)
    page.evaluate("document.body.style.height = '2000px'")
    page.mouse.move(460, 350)
    page.keyboard.press("ArrowLeft")
    assert page.evaluate(VIEW) == home
    page.mouse.move(100, 100)
    page.mouse.wheel(0, 20)
    page.wait_for_function("scrollY > 0")
    assert page.evaluate(VIEW) == home
    page.keyboard.press("ArrowLeft")  # over the scene
    assert page.evaluate(VIEW) != home
    page.keyboard.press("Home")
    page.mouse.down()
    page.mouse.up()
    at = page.evaluate("scrollY")
    page.mouse.wheel(0, 20)
    page.wait_for_function(f"(before) => {VIEW}.some((v, i) => v !== before[i])", arg=home)
    assert page.evaluate("scrollY") == at
    play = player.get_by_role("button", name="Play")
    play.focus()
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("Space")  # presses the button, once
    assert player.get_by_role("button", name="Pause").count() == 1


def test_the_view_of_a_place_stays_near_its_camera(page, server):
    """One whose picture cuts through the anchors; a thing that lies within its picture is free."""
    scene = lively_scene(150)
    camera = scene.info.camera
    for name, zoom in (("place", 3), ("thing", 0.4)):
        K = camera.K * np.array([[zoom, 1, 1], [1, zoom, 1], [1, 1, 1]], np.float32)
        seen = replace(scene, info=replace(scene.info, camera=replace(camera, K=K)))
        (server.root / f"{name}.pd4").write_bytes(encode(seen, layers=2, effort=1))
    element(page, server, f'controls src="{server.url_of("place.pd4")}"')
    wait_for_level(page, 2)
    turned = f"""(keys) => {{
      const {{ _orbit: orbit }} = {ELEMENT};
      const press = (key) => orbit.key(new KeyboardEvent("keydown", {{ key }}));
      orbit.reset();
      const home = {ELEMENT}.camera.viewmat;
      for (const key of keys) for (let i = 0; i < 30; i++) press(key);
      const {{ viewmat: v }} = {ELEMENT}.camera;
      return {{ angle: Math.acos(v[8] * home[8] + v[9] * home[9] + v[10] * home[10]), back: v[11] - home[11] }};
    }}"""
    limited = page.evaluate(turned, ["ArrowLeft", "ArrowUp"])
    assert 0.3 < limited["angle"] <= 0.5
    assert 0 < page.evaluate(turned, ["-"])["back"] < 1
    page.evaluate(f"{ELEMENT}.setAttribute('free', '')")
    assert page.evaluate(turned, ["ArrowLeft"])["angle"] > 1
    assert page.evaluate(turned, ["-"])["back"] > 3
    page.evaluate(f"{ELEMENT}.removeAttribute('free'), {ELEMENT}.load('{server.url_of('thing.pd4')}')")
    wait_for_level(page, 2)
    assert page.evaluate(turned, ["ArrowLeft"])["angle"] > 1


def test_fit_speed_and_label(page, server):
    attributes = 'controls speed="4" fit="cover" label="Two balls"'
    player = element(page, server, f'{attributes} src="{server.url_of("small.pd4")}"')
    player.get_by_role("application", name="Two balls").wait_for()
    wait_for_level(page, 2)
    shown = f"""() => {{
      const {{ player }} = {ELEMENT};
      let seen;
      const {{ draw }} = player._painter;
      player._painter.draw = (splats, [view]) => (seen = view);
      player._draw();
      player._painter.draw = draw;
      return [seen.K[0] / player.camera.K[0], seen.width, seen.height];
    }}"""
    page.evaluate(f"{ELEMENT}.style.height = '480px'")
    page.wait_for_function(f"{ELEMENT}.player.canvas.height > {ELEMENT}.player.canvas.width")
    scale, _, height = page.evaluate(shown)
    assert scale == pytest.approx(height / HEIGHT)
    page.evaluate(f"{ELEMENT}.removeAttribute('fit')")
    scale, width, _ = page.evaluate(shown)
    assert scale == pytest.approx(width / WIDTH)
    page.evaluate(f"(player => (player._playing = true, player._advance(0.1), player.pause()))({ELEMENT}.player)")
    assert page.evaluate(f"{ELEMENT}.time") == pytest.approx(1.4)


def test_text_of_controls_is_legible_on_a_white_scene(page, server):
    scene = lively_scene(20)
    white = replace(scene, info=replace(scene.info, background=(1.0, 1.0, 1.0)))
    (server.root / "white.pd4").write_bytes(encode(white, layers=2, effort=1))
    player = element(page, server, f'controls src="{server.url_of("white.pd4")}"')
    wait_for_level(page, 2)
    page.evaluate(f"{ELEMENT}.player.settled()")
    at_rest = re.compile(r"^level 2 of 2, \d+ kB( · no GPU found)?$")  # else the line still changes its width
    player.locator("[part=status]", has_text=at_rest).wait_for()
    picture = screenshot(page) / 255
    for part in ("[part=status]", "select"):
        box = player.locator(part).bounding_box()
        x, y, w, h = (round(box[key]) for key in ("x", "y", "width", "height"))
        linear = np.where(picture <= 0.04045, picture / 12.92, ((picture + 0.055) / 1.055) ** 2.4)
        light = (linear @ [0.2126, 0.7152, 0.0722])[y + 3 : y + h - 3, x + 3 : x + w - 3]
        assert (light.max() + 0.05) / (np.median(light) + 0.05) >= 4.5, part


def test_what_the_element_contains_covers_it_until_the_first_picture(page, server):
    element(page, server, "")
    page.evaluate(f"{ELEMENT}.innerHTML = '<p style=\"height: 100px; margin: 0; background: #f00\">text</p>'")
    page.evaluate(f"{ELEMENT}.style.background = '#00f', {ELEMENT}.player._startGpu()")  # whose canvas is opaque
    colours = screenshot(page)[[50, 200], 200]
    assert colours.tolist() == [[255, 0, 0], [0, 0, 255]]
    page.evaluate(f"{ELEMENT}.load('{server.url_of('small.pd4')}')")
    wait_for_level(page, 2)
    assert abs(screenshot(page)[[50, 200], 200] - colours.astype(int)).max(axis=1).min() > 60
    page.evaluate(f"document.body.append({ELEMENT})")  # where it begins anew
    assert screenshot(page)[50, 200].tolist() == [255, 0, 0]


def test_a_page_that_is_opened_as_a_file_says_why_it_is_empty(page):
    page.goto((PLAYER / "index.html").as_uri())
    assert page.locator("#note").bounding_box()["y"] < 50


def test_the_metadata_name_the_page(page, server, small):
    (server.root / "named.html").write_text(packed_page(with_metadata(small, Metadata(title="Two <b>balls"))[0]))
    page.goto(server.url_of("named.html"))
    page.get_by_role("application", name="Two <b>balls").wait_for()
    assert page.title() == "Two <b>balls"


# -- in other people's pages -------------------------------------------------------------------------------------------


def test_a_page_of_many_players_shows_those_in_view(page, server):
    """More than the browser has contexts for."""
    shutil.copy(ROOT / "spec" / "vectors" / "valid" / "layers-0-1-2.pd4", server.root / "tiny.pd4")
    one = f'<pd4-player src="{server.url_of("tiny.pd4")}" style="width: 80px; margin-bottom: 400px"></pd4-player>'
    script = f'<script type="module" src="{server.url_of("player/element.js")}"></script>'
    (server.root / "many.html").write_text(f"<!doctype html><title>t</title>{script}{18 * one}")
    page.goto(server.url_of("many.html"))
    drawn = "(i) => !!document.querySelectorAll('pd4-player')[i].player?._isSettled()"
    for number in (0, 9, 17, 0):  # whose context has been given up meanwhile
        page.evaluate("(i) => document.querySelectorAll('pd4-player')[i].scrollIntoView()", number)
        page.wait_for_function(drawn, arg=number)
    equipped = "[...document.querySelectorAll('pd4-player')].filter(({ player }) => player._gpu).length"
    assert page.evaluate(equipped) <= 8


def test_a_context_that_the_browser_took_for_good_is_told(page, server):
    player = element(page, server, f'src="{server.url_of("small.pd4")}"')
    wait_for_level(page, 2)
    page.evaluate(f"{ELEMENT}.player.canvas.getContext('webgl2').getExtension('WEBGL_lose_context').loseContext()")
    assert "no more scenes at once" in player.get_by_role("alert").inner_text(timeout=TIMEOUT_MS)


LAYOUTS = {
    "row": '<div style="display: flex">{}</div>',
    "beside text": '<div style="display: flex"><p style="flex: none; width: 100px">text</p>{}</div>',
    "centred column": '<div style="display: flex; flex-direction: column; align-items: center">{}</div>',
    "grid": '<div style="display: grid; justify-items: center">{}</div>',
    "float": '<div style="float: left">{}</div>',
    "low column": '<div style="display: flex; flex-direction: column; height: 200px">{}<p>text</p></div>',
}


def test_the_element_has_a_size_in_every_layout(page, server):
    element(page, server, "")
    body = "".join(layout.format("<pd4-player></pd4-player>") for layout in LAYOUTS.values())
    page.evaluate("(html) => (document.body.innerHTML = html)", body)
    sizes = page.evaluate("[...document.querySelectorAll('pd4-player')].map((e) => [e.clientWidth, e.clientHeight])")
    for name, (width, height) in zip(LAYOUTS, sizes, strict=True):
        assert 140 <= width <= 480 and 100 <= height <= 360, (name, width, height)


#: Policies of a page that has the player's files, and what the player says.
POLICIES = {
    "default-src 'none'; script-src 'self'; connect-src 'self'": "level 2 of 2",
    "worker-src 'none'": "(Content-Security-Policy: worker-src)",
}


@pytest.mark.parametrize("policy, words", POLICIES.items(), ids=["strict", "no workers"])
def test_a_page_with_a_policy_plays_or_says_why_not(page, server, policy, words):
    player = element(page, server, f'controls src="{server.url_of("small.pd4")}"', policy=policy)
    player.get_by_text(words).wait_for()


def test_a_sandboxed_frame_is_not_blank(page, server):
    """Its origin is none, so that no worker may come from the server."""
    element(page, server, f'controls src="{server.url_of("small.pd4")}"')
    frame = '<iframe sandbox="allow-scripts" src="element.html" width="400" height="300"></iframe>'
    page.evaluate("(html) => (document.body.innerHTML = html)", frame)
    page.frame_locator("iframe").get_by_role("alert").wait_for()


def test_a_page_without_workers_says_so(page, server):
    page.add_init_script("window.Worker = class { constructor() { throw new DOMException('no', 'SecurityError') } }")
    player = element(page, server, f'src="{server.url_of("small.pd4")}"')
    player.get_by_text("this page may start no worker: no").wait_for()


def eye_camera(scene: Scene, pose: dict[str, Any], eye: Sequence[float]) -> Camera:
    """What an eye of the headset sees, whose head was at the scene's camera when it came on. pose, eye: as in
    test-browser/headset.js."""
    right, left_side, right_side, low, high = eye
    cosine, sine = np.cos(pose["turn"]), np.sin(pose["turn"])
    head = np.eye(4)
    head[:3, :3] = [[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]]
    head[:3, 3] = pose["place"]
    moved = np.eye(4)
    moved[0, 3] = right
    axes, metres = np.diag([1.0, -1, -1, 1]), np.diag([*3 * [scene.info.unit], 1])
    viewmat = np.linalg.inv(metres) @ axes @ np.linalg.inv(head @ moved) @ axes @ metres @ scene.info.camera.viewmat
    fx, fy = WIDTH / (right_side - left_side), HEIGHT / (high - low)
    K = np.array([[fx, 0, -left_side * fx], [0, fy, high * fy], [0, 0, 1]], np.float32)
    return Camera(viewmat.astype(np.float32), K, WIDTH, HEIGHT)


def test_a_headset_shows_each_eye_its_picture(page, server, folder):
    pytest.importorskip("numba")
    scene = lively_scene()
    scene = replace(scene, info=replace(scene.info, unit=0.5))
    data = encode(scene, layers=2, effort=1)
    (folder / "vr.pd4").write_bytes(data)
    page.add_init_script(path=PLAYER / "test-browser" / "headset.js")
    player = element(page, server, f'controls time="2" src="{server.url_of("vr.pd4")}"')
    wait_for_level(page, 2)
    before = page.evaluate(f"[...{ELEMENT}.camera.viewmat]")
    eyes = np.split(eyes_of_headset(page, 2 * WIDTH, HEIGHT) / 255, 2, axis=1)
    pose, seen = page.evaluate("[headset.pose, Object.values(headset.eyes)]")
    for eye, picture in zip(seen, eyes, strict=True):
        expected = Rasterised(decode(data)).picture(eye_camera(scene, pose, eye), 0.5)
        assert decibels(picture, expected) > LEAST_DB
    assert decibels(*eyes) < 40
    on_canvas = page.evaluate(f"{ELEMENT}.player.counts.drawn")
    page.evaluate("headset.session.dispatchEvent(new Event('select'))")
    page.wait_for_function(f"{ELEMENT}.time > 2.02 && !{ELEMENT}.paused")
    page.evaluate("headset.session.dispatchEvent(new Event('select'))")
    assert page.evaluate(f"{ELEMENT}.player.counts.drawn") == on_canvas  # which stands still meanwhile
    page.evaluate("headset.session.end()")
    page.wait_for_function(f"(drawn) => {ELEMENT}.player.counts.drawn > drawn", arg=on_canvas)
    assert page.evaluate(f"[...{ELEMENT}.camera.viewmat]") == before
    player.get_by_role("button", name="Show in the headset").click()
    page.evaluate(f"{ELEMENT}.remove()")
    page.wait_for_function("headset.session.ended")  # with the element


def test_a_headset_that_fails_is_one_line(page, server):
    page.add_init_script(path=PLAYER / "test-browser" / "headset.js")
    player = element(page, server, f'controls src="{server.url_of("small.pd4")}"')
    wait_for_level(page, 2)
    page.evaluate("void (XRWebGLLayer = class { constructor() { throw Error('no') } })")
    player.get_by_role("button", name="Show in the headset").click()
    page.wait_for_function("headset.session?.ended")
    assert player.get_by_role("alert").inner_text() == "no"


def test_attributes_and_removal(page, server):
    attributes = f'src="{server.url_of("small.pd4")}" time="2" level="1" autoplay loop poster="data:,"'
    player = element(page, server, attributes)
    assert player.locator("img").count() == 1
    wait_for_level(page, 1)
    player.locator("img").wait_for(state="hidden")  # it fades
    assert player.get_by_role("group").is_hidden()
    assert page.evaluate(f"{ELEMENT}.player.canvas.tabIndex") == -1  # no key does anything
    page.wait_for_function(f"{ELEMENT}.time < 2")  # it plays, and begins anew
    names = [name for name, _ in page.evaluate("seen")]
    assert names.count("firstpicture") == 1 and names.count("upgrade") <= 1 and "progress" in names
    page.evaluate(f"{ELEMENT}.removeAttribute('loop')")
    page.wait_for_function(f"{ELEMENT}.paused")  # at the end
    assert page.evaluate(f"{ELEMENT}.time") == 3
    page.evaluate(f"{ELEMENT}.removeAttribute('autoplay')")
    page.evaluate(f"{ELEMENT}.setAttribute('time', '2.5'), {ELEMENT}.load({ELEMENT}.src)")  # as they are now
    page.wait_for_function(f"{ELEMENT}.player.status.level === 1 && {ELEMENT}.time === 2.5 && {ELEMENT}.paused")
    page.evaluate(f"window.player = {ELEMENT}; player.remove()")
    assert page.evaluate("player.player") is None
    page.evaluate("document.body.append(player)")
    page.wait_for_function("player.player.status.level === 1")


def test_code_and_scene_may_come_from_other_servers(page, server, folder):
    with Server(folder) as other, other.running():
        element(page, server, f'src="{other.url_of("small.pd4")}"', other)
        wait_for_level(page, 2)


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What pip would install: the files of the wheel."""
    root = tmp_path_factory.mktemp("wheel")
    for name in ("pd4dgs_codec", "player"):
        shutil.copytree(ROOT / name, root / name, ignore=shutil.ignore_patterns("__pycache__", "node_modules"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, root / name)
    build = "from setuptools.build_meta import build_wheel; build_wheel('dist')"
    done = subprocess.run([sys.executable, "-c", build], cwd=root, capture_output=True, text=True, timeout=280)
    if "bdist_wheel" in done.stderr or "No module named 'setuptools'" in done.stderr:
        _missing("setuptools is too old to build a wheel (pip install setuptools)")
    assert done.returncode == 0, done.stderr
    (wheel,) = (root / "dist").glob("*.whl")
    shutil.unpack_archive(wheel, root / "site", "zip")
    return root / "site"


def test_a_package_by_the_installed_wheel_plays_from_any_web_server(page, installed, folder, tmp_path):
    command = ["-m", "pd4dgs_codec", "package", folder / "scene.pd4", "-o", tmp_path / "out", "--no-video"]
    environment = os.environ | {"PYTHONPATH": str(installed)}
    subprocess.run([sys.executable, *map(str, command)], cwd=installed, env=environment, check=True, timeout=280)
    (tmp_path / "out").rename(tmp_path / "moved")
    assert len(gzip.compress((tmp_path / "moved" / "index.html").read_bytes(), 9)) <= 77_000
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=str(tmp_path))  # knows no ranges
    handler.log_message = lambda *_: None  # type: ignore[attr-defined]
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as plain:
        threading.Thread(target=plain.serve_forever, daemon=True).start()
        page.goto(f"http://127.0.0.1:{plain.server_port}/moved/?autoplay=0")
        wait_for_level(page, 2)
        plain.shutdown()
    assert [Path(urlsplit(url).path).name for url in asked if url.startswith("http")] == ["moved", "scene.pd4"]


def test_the_scene_is_asked_for_while_the_page_arrives(page, folder, small):
    """It is asked for once, and the page shows that answer."""
    (folder / "packed").mkdir()
    (folder / "packed" / "index.html").write_text(packed_page())
    (folder / "packed" / "scene.pd4").write_bytes(small)
    asked: list[float] = []
    log = lambda line: asked.append(time.time()) if "scene.pd4" in line else None  # noqa: E731
    with Server(folder, link=Link(2e5), log=log) as slow, slow.running():
        page.goto(slow.url_of("packed/index.html"))
        wait_for_level(page, 2)
    arrived = page.evaluate("performance.timeOrigin + performance.getEntriesByType('navigation')[0].responseEnd")
    assert len(asked) == 1 and asked[0] < arrived / 1000


def test_a_page_shows_its_scene_before_any_script(browser, lively, tmp_path):
    """What the player then draws is the same picture in the same place, also beside what the camera saw."""
    window = (520, 300)
    (tmp_path / "scene.pd4").write_bytes(lively)
    done = subprocess.run(
        [sys.executable, "-m", "pd4dgs_codec", "package", tmp_path / "scene.pd4", "-o", tmp_path / "out", "--no-video"],
        capture_output=True, text=True, timeout=280,
    )  # fmt: skip
    assert done.returncode == 0 and "no picture" not in done.stderr, done.stderr
    shown = {}
    with Server(tmp_path / "out") as server, server.running():
        for scripts in (False, True):
            size = {"width": window[0], "height": window[1]}
            context = browser.new_context(viewport=size, java_script_enabled=scripts)
            page = context.new_page()
            page.set_default_timeout(TIMEOUT_MS)
            page.goto(f"{server.url}?controls=0&autoplay=0")
            if scripts:
                wait_for_level(page, 2)
                page.evaluate(f"{ELEMENT}.player.settled()")
            shown[scripts] = screenshot(page) / 255
            context.close()
    smaller = np.array(Image.fromarray((255 * shown[False]).astype(np.uint8)).resize((window[0] * 9 // 10, window[1])))
    moved = np.pad(smaller / 255, ((0, 0), (0, window[0] - smaller.shape[1]), (0, 0)), mode="edge")
    there, elsewhere = decibels(shown[True], shown[False]), decibels(shown[True], moved)
    assert there > 20 and there > elsewhere + 3, (there, elsewhere)


def test_the_picture_of_a_page_is_as_large_as_its_scene(page, server):
    """The window is 480 x 360, the camera's picture two units wide and one high."""
    file = BytesIO()
    Image.new("RGB", (200, 100)).save(file, "webp")
    still = Still(file.getvalue(), 1.5, 2.0, "rgb(0,0,0)")
    (server.root / "begun.html").write_text(packed_page("missing.pd4", still=still))
    for fit, width in (("contain", 1.5 * 480), ("cover", 1.5 * 720)):
        page.goto(server.url_of("begun.html") + f"?fit={fit}")
        page.wait_for_selector("[role=alert]:visible")
        assert page.locator("pd4-player > img").first.bounding_box()["width"] == pytest.approx(width, abs=1)


@pytest.mark.parametrize("place", ["notebook", "file"])
def test_one_page_holds_player_and_scene(page, server, small, place):
    shown = show(small, height=240)
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url.split(":")[0]))
    if place == "notebook":
        (server.root / "cell.html").write_text(f"<!doctype html><title>t</title>{shown._repr_html_()}")
        page.goto(server.url_of("cell.html"))
        frame = page.frames[1]
        assert page.locator("iframe").bounding_box()["height"] == 240
    else:
        (server.root / "alone.html").write_text(shown.page)
        page.goto((server.root / "alone.html").as_uri())
        frame = page
    wait_for_level(frame, 2)
    assert frame.get_by_role("main").get_by_role("application").count() == 1
    assert frame.get_by_role("heading", level=1).inner_text() == "Dynamic scene"
    assert asked[1:].count("http") + asked[1:].count("https") + asked[1:].count("file") == 0


def test_the_page_asks_nobody_else_and_measures_itself(page, server):
    hosts: set[str] = set()
    page.on("request", lambda request: hosts.add(request.url.split("/player/")[0]))
    page.goto(server.url_of("player/index.html"))
    wait_for_level(page, 2)
    assert not page.evaluate(f"{ELEMENT}.paused")
    assert page.get_by_role("main").get_by_role("heading", level=1).count() == 1
    page.goto(server.url_of("player/index.html") + "?bench&src=scene.pd4&sizes=48x36")
    page.wait_for_function("!!window.benchResult")
    rows = page.evaluate("benchResult.rows")
    assert [row["level"] for row in rows] == [0, 1, 2]
    assert all(row["moving"] > 0 for row in rows) and all(row["playing"] > 0 for row in rows[1:])
    assert {host for host in hosts if not host.startswith(("blob:", "data:"))} == {server.url.rstrip("/")}
