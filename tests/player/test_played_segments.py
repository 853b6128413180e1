"""The player on a scene that is cut in time: pictures, seeks, what does not come, and what it keeps."""
# ruff: noqa: F811

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import segmented
from browser import ELEMENT, call, until
from pictures import decibels, resized, shoot
from test_browser import (  # noqa: F401 - fixtures
    HEIGHT,
    LEAST_DB,
    PLAYER,
    WIDTH,
    _shared_harness,
    browser,
    context,
    element,
    harness,
    opened,
    page,
)

from pd4dgs_codec import decode, encode
from pd4dgs_codec.draw.player import drawer
from pd4dgs_codec.quality.levels import Timeline
from pd4dgs_codec.scene import Camera
from pd4dgs_codec.segments import INDEX, Segment, file_of, read_index
from pd4dgs_codec.web.server import Server

LAP = 0.5  #: seconds that segments overlap


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """The player, segments, and such of which the second is missing, and the third of another scene."""
    root = tmp_path_factory.mktemp("www")
    shutil.copytree(PLAYER, root / "player", ignore=shutil.ignore_patterns("node_modules", "test"))
    for name in ("whole", "odd"):
        shutil.copytree(segmented.folder(), root / name)
    (root / "odd" / "00001.pd4").unlink()
    base, path = root / "odd" / "base-0000.pd4", root / "odd" / "00002.pd4"
    still, scene = decode(base), decode(path, base=base)
    path.write_bytes(encode(scene, base=encode(replace(still, info=replace(still.info, near=still.info.near / 2)))))
    overlapping(root / "whole", root / "overlapping")
    with Server(root) as served, served.running():
        yield served


def overlapping(source: Path, folder: Path) -> None:
    """Copies segments to ranges that are longer at both ends, and so overlap."""
    shutil.copytree(source, folder)
    _, index = read_index(folder)
    base, parts = folder / index.bases[0].file, []
    for segment in index.segments:
        scene, (start, end) = decode(folder / segment.file, base=base), segment.time_range
        times = (max(start - LAP / 2, 0.0), min(end + LAP / 2, 4.0))
        data = encode(replace(scene, info=replace(scene.info, time_range=times)), base=base)
        (folder / segment.file).write_bytes(data)
        parts.append(Segment(**vars(file_of(segment.file, data)), time_range=times, base=0))
    (folder / INDEX).write_bytes(replace(index, segments=tuple(parts)).packed())


def blended(folder: Path, camera: Camera, seconds: float) -> np.ndarray:
    """The rasteriser's picture of a time, by the rule of overlaps."""
    _, index = read_index(folder)
    pictures, weights = [], []
    for k, segment in enumerate(index.segments):
        start, end = segment.time_range
        if not start <= seconds < end:
            continue
        part = drawer(decode(folder / segment.file, base=folder / index.bases[0].file))
        pictures.append(np.clip(part.picture(camera, (seconds - start) / (end - start)), 0, 1))
        weights.append(min((seconds - start) / LAP, 1.0) if k else 1.0)
    return pictures[0] if len(pictures) == 1 else (1 - weights[1]) * pictures[0] + weights[1] * pictures[1]


def kept(page: Any, player: str) -> list[int]:
    """The numbers of the parts that a player holds, of a base negative."""
    found: list[int] = page.evaluate(f"[...{player}._parts.keys()].sort((a, b) => a - b)")
    return found


def test_pictures_of_all_times_are_those_of_the_rasteriser(harness: Any, server: Server) -> None:
    events = opened(harness, server.url_of(f"whole/{INDEX}"))
    assert [name for name, _ in events].count("error") == 0
    timeline = Timeline(server.root / "whole")
    assert timeline.info.camera is not None
    camera = resized(timeline.info.camera, WIDTH, HEIGHT)
    for seconds in (0.0, 0.6, 3.7, 1.4, 2.0, 4.0):  # seeks, one to a seam
        got = shoot(harness, camera, 2, seconds)
        assert decibels(got, timeline.picture(camera, seconds / 4)) > LEAST_DB, seconds
        k = min(int(seconds), 3)
        assert set(kept(harness, "harness.player")) <= {-1, k, k + 1}
    assert harness.evaluate("harness.player.timeRange") == [0, 4]


def test_pictures_are_blended_where_segments_overlap(harness: Any, server: Server) -> None:
    folder = server.root / "overlapping"
    events = opened(harness, server.url_of(f"overlapping/{INDEX}"))
    assert [name for name, _ in events].count("error") == 0
    info = decode(folder / "00000.pd4", base=folder / "base-0000.pd4").info
    assert info.camera is not None
    camera = resized(info.camera, WIDTH, HEIGHT)
    for seconds in (0.7, 0.8, 0.95, 1.2, 2.0, 3.1, 1.1, 0.5):  # forwards and backwards, from one overlap to others
        got = shoot(harness, camera, 2, seconds)
        assert decibels(got, blended(folder, camera, seconds)) > LEAST_DB, seconds
        assert len(kept(harness, "harness.player")) <= 4
        assert (harness.evaluate("harness.player.fading?.share ?? 0") > 0) == (abs(seconds - round(seconds)) < LAP / 2)


@pytest.mark.parametrize("missing", [1, 2])
def test_a_segment_that_is_missing_leaves_the_other_one_of_an_overlap(page: Any, server: Server, missing: int) -> None:
    page.route(f"**/{missing:05d}.pd4", lambda route: route.fulfill(status=404))
    player = element(page, server, f'src="overlapping/{INDEX}" controls')
    until(page, f"{ELEMENT}?.player?.scene?.layers.length === 2")
    page.evaluate(f"{ELEMENT}.seek(2)")
    until(page, f"{ELEMENT}.player.problem.includes('404') && {ELEMENT}.player.awaited === null")
    assert not player.get_by_role("alert").is_hidden()
    there = 3 - missing
    assert page.evaluate(f"{ELEMENT}.player.scene === {ELEMENT}.player._parts.get({there})")
    assert page.evaluate(f"{ELEMENT}.player.fading") is None


def test_playing_fetches_each_file_once_and_holds_two_segments(page: Any, server: Server) -> None:
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url.rsplit("/", 1)[1]))
    element(page, server, f'src="whole/{INDEX}" controls autoplay speed="4"')
    most = 0
    while page.evaluate(f"({ELEMENT}.player?.time ?? 0) < 4"):
        most = max(most, len(kept(page, f"{ELEMENT}.player")) if page.evaluate(f"!!{ELEMENT}.player") else 0)
    files = [name for name in asked if name.endswith(".pd4")]
    assert files == ["base-0000.pd4", *(f"{i:05d}.pd4" for i in range(4))] and 2 <= most <= 3
    assert page.evaluate(f"{ELEMENT}.paused") and page.evaluate("seen.every(([name]) => name !== 'error')")


def test_a_segment_that_does_not_come_leaves_the_base_and_the_next_one_plays(
    page: Any,
    server: Server,
) -> None:
    player = element(page, server, f'src="odd/{INDEX}" controls')
    until(page, f"{ELEMENT}?.player?.scene?.layers.length === 2")
    alert, rows = player.get_by_role("alert"), page.evaluate(f"{ELEMENT}.player.scene.rows[0]")
    assert alert.is_hidden()
    _, index = read_index(server.root / "odd")
    for seconds, words in ((1.5, "404"), (2.5, "scene")):
        page.evaluate(f"{ELEMENT}.seek({seconds})")
        alert.wait_for()
        until(page, f"{ELEMENT}.player.problem.includes('{words}') && {ELEMENT}.player.scene.layers.length === 1")
        assert page.evaluate(f"{ELEMENT}.player.scene.rows[0]") < rows and "\n" not in alert.inner_text()
    page.evaluate(f"{ELEMENT}.seek(3.5)")
    until(page, f"{ELEMENT}.player.scene.layers.length === 2")
    alert.wait_for(state="hidden")
    page.evaluate(f"{ELEMENT}.seek(0.9)")
    page.evaluate(f"{ELEMENT}.play()")  # past both
    until(page, f"{ELEMENT}.time === 4 && {ELEMENT}.player.scene.layers.length === 2")
    assert alert.is_hidden()


def test_a_damaged_segment_leaves_the_base_and_the_next_one_is_shown(page: Any, server: Server) -> None:
    data = bytearray((server.root / "whole" / "00001.pd4").read_bytes())
    data[len(data) // 2] ^= 1
    page.route("**/00001.pd4", lambda route: route.fulfill(body=bytes(data)))
    player = element(page, server, f'src="whole/{INDEX}" controls')
    until(page, f"{ELEMENT}?.player?.scene?.layers.length === 2")
    alert = player.get_by_role("alert")
    page.evaluate(f"{ELEMENT}.seek(1.5)")
    alert.wait_for()
    assert "00001.pd4" in alert.inner_text()
    until(page, f"{ELEMENT}.player.scene.layers.length === 1")
    page.evaluate(f"{ELEMENT}.seek(2.5)")
    alert.wait_for(state="hidden")
    until(page, f"{ELEMENT}.player.scene.layers.length === 2")


def test_a_late_segment_is_waited_for_before_its_base(page: Any, server: Server) -> None:
    held: list[Any] = []
    page.route("**/00003.pd4", lambda route: held.append(route))
    player = element(page, server, f'src="whole/{INDEX}" controls')
    until(page, f"{ELEMENT}?.player?.scene?.layers.length === 2")
    page.evaluate(f"{ELEMENT}.seek(3.25)")
    until(page, f"{ELEMENT}.player.scene.layers.length === 1")
    player.get_by_text("waiting for 3.0 to 4.0 s").wait_for()
    assert player.get_by_role("alert").is_hidden()
    for route in held:
        route.continue_()
    until(page, f"{ELEMENT}.player.scene.layers.length === 2 && {ELEMENT}.player.awaited === null")


def test_the_next_segment_waits_for_its_budget(harness: Any, server: Server) -> None:
    _, index = read_index(server.root / "whole")
    budget = index.bases[0].bytes + index.segments[0].bytes
    opened(harness, server.url_of(f"whole/{INDEX}"), bytes=budget)
    assert kept(harness, "harness.player") == [-1, 0]
    call(harness, "harness.shoot", {"seconds": 2.5})
    assert kept(harness, "harness.player") == [-1, 2]


def test_an_index_that_is_invalid_is_one_line(page: Any, server: Server) -> None:
    (server.root / "odd.json").write_text('{"segments_version": 2}')
    player = element(page, server, 'src="odd.json" controls')
    alert = player.get_by_role("alert")
    alert.wait_for()
    assert "expected segments_version 1" in alert.inner_text() and np.isfinite(page.evaluate(f"{ELEMENT}.time"))
