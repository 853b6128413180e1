"""The latency report: its medians and promise, the viewer, files of any size, and the command around them."""

from __future__ import annotations

import contextlib
import json
import math
from dataclasses import replace

import numpy as np
import pytest

from pd4dgs_codec import decode, encode
from pd4dgs_codec.bench import latency, viewer
from pd4dgs_codec.cli import bench
from pd4dgs_codec.draw.warm import warm_up
from pd4dgs_codec.errors import DataError
from pd4dgs_codec.web.server import Server

SIZE = (24, 16)


@contextlib.contextmanager
def serving(folder, data):
    (folder / "scene.pd4").write_bytes(data)
    with Server(folder) as server, server.running():
        yield f"{server.url}scene.pd4"


def test_a_file_is_fetched_drawn_and_drawn_by_a_process_of_its_own(data):
    warm_up()
    rows = latency.times(data, [50e6], 1, SIZE)
    assert [(row.level, row.bytes) for row in rows] == latency.layer_rows(data)
    for row in rows:
        assert row.expected == 8 * row.bytes / 50e6
        assert all(math.isfinite(t) and t > 0 for t in (row.network, row.picture, row.after_last_byte, row.cold))


def test_rows_are_medians_of_the_runs(data, monkeypatch):
    levels = range(3)
    runs = iter([5.0, 1.0, 3.0])
    fake = contextlib.contextmanager(lambda data, rate: iter([f"at {rate}"]))
    monkeypatch.setattr(latency, "served", fake)
    monkeypatch.setattr(latency, "arrivals", lambda url, ends: [next(runs)] * len(ends))
    shown = [viewer.Shown(level, 2.0 + level, 0.5) for level in levels]
    monkeypatch.setattr(latency, "pictures", lambda url, size: iter(shown))
    monkeypatch.setattr(latency, "cold_start", lambda url, size: [9.0, 10.0, 11.0])
    steps = []
    rows = latency.times(data, [1e6], 3, SIZE, lambda: steps.append(1))
    assert [row.network for row in rows] == [3.0] * 3 and [row.picture for row in rows] == [2.0, 3.0, 4.0]
    assert [row.cold for row in rows] == [9.0, 10.0, 11.0] and rows[0].after_last_byte == 0.5 and len(steps) == 9


@pytest.mark.parametrize(("off", "within"), [(0.0, True), (0.0099, True), (0.011, False), (-0.011, False)])
def test_the_promise_is_the_larger_of_a_share_and_of_seconds(off, within):
    times = latency.Times(1e6, 0, 12_500, 0.1, 0.1 + off, 1, 1, 1)
    assert times.within == within
    assert replace(times, expected=10.0, network=10.0 + 20 * off).within == (abs(off) < 0.015)


def test_the_viewer_draws_each_level_with_the_files_own_camera(data, scene, tmp_path):
    ready = []
    with serving(tmp_path, data) as url:
        shown = list(viewer.pictures(url, SIZE, ready=lambda: ready.append(1)))
    assert [picture.level for picture in shown] == [0, 1, 2] and ready == [1, 1, 1]
    assert all(0 < picture.after_last_byte <= picture.seconds for picture in shown)
    blind = encode(replace(scene, info=replace(scene.info, camera=None)), layers=0, effort=1)
    with serving(tmp_path, blind) as url, pytest.raises(DataError, match="camera"):
        list(viewer.pictures(url, SIZE))


def test_another_size_keeps_the_middle_of_the_picture(scene):
    camera = viewer.own_camera(scene.info, (64, 32))
    assert (camera.width, camera.height) == (64, 32)
    np.testing.assert_allclose(camera.K, [[60, 0, 32], [0, 60, 16], [0, 0, 1]])


def test_more_anchors_are_copies_near_their_originals(data, monkeypatch):
    monkeypatch.setattr(latency, "EFFORT", 1)
    original, larger = decode(data, max_layer=0), decode(latency.with_anchors(data, 300), max_layer=0)
    assert (larger.mask[0] > 0).sum() == 300
    known = {tuple(cell) for cell in original.anchor_q[original.mask[0] > 0].tolist()}
    cells = {tuple(cell) for cell in larger.anchor_q.tolist()}
    assert known <= cells and len(cells) == len(larger.anchor_q)
    assert {row.tobytes() for row in larger.feature} <= {row.tobytes() for row in original.feature}
    for count in (5, 40 * 100):
        with pytest.raises(DataError, match="anchors, expected"):
            latency.with_anchors(data, count)


def run(capsys, *argv):
    code = bench.main(["latency", *map(str, argv)])
    done = capsys.readouterr()
    return code, done.out, done.err


def test_the_command_writes_markdown_json_and_a_picture(tmp_path, capsys, data, monkeypatch):
    monkeypatch.setattr(latency, "first_start", lambda data, rate, size: 12.3)  # both would take seconds
    monkeypatch.setattr(latency, "cold_start", lambda url, size: [4.0, 5.0, 6.0])
    (tmp_path / "a.pd4").write_bytes(data)
    plot, report = tmp_path / "p.png", tmp_path / "r.json"
    options = ("--rates", "50M", "--runs", 1, "--size", "24x16", "--plot", plot, "--json", report)
    code, out, _ = run(capsys, tmp_path / "a.pd4", *options)
    assert code == 0 and plot.read_bytes().startswith(b"\x89PNG")
    assert "SC-GS, published" in out and "37.18" in out and "| 50 Mbps | 2 " in out
    result = json.loads(report.read_text())
    assert [row["level"] for row in result["files"][0]["times"]] == [0, 1, 2]
    assert result["files"][0]["first_start"] == 12.3 and result["published_megabytes"]["SC-GS"] == 232.4


@pytest.mark.parametrize(
    ("options", "code", "message"),
    [
        (["--data", "a", "--data", "b"], 2, "found 2 --data for 1 files"),
        (["--plot", "x.gif"], 2, "ends in .png"),
        (["--size", "0x5"], 2, "expected a size"),
        (["--rates", "fast"], 2, "expected a rate"),
        (["--anchors", "1"], 1, "expected"),
    ],
)
def test_bad_usage_is_one_line(tmp_path, capsys, data, options, code, message):
    (tmp_path / "a.pd4").write_bytes(data)
    found, out, err = run(capsys, tmp_path / "a.pd4", *options)
    assert found == code and message in err and err.count("\n") == 1 and not out
