"""The latency report: its times, its table of faults, that its rows can fail, and the command around it."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from strategies import make_scene

torch = pytest.importorskip("torch")
pytest.importorskip("numba")

from pd4dgs_codec import decode, encode  # noqa: E402
from pd4dgs_codec.bench.latency import enlarge, faults, measure, viewer  # noqa: E402
from pd4dgs_codec.cli import bench  # noqa: E402
from pd4dgs_codec.delivery.faulty import Fault, FaultyServer  # noqa: E402
from pd4dgs_codec.errors import DataError  # noqa: E402
from pd4dgs_codec.model.warm import warm_up  # noqa: E402
from pd4dgs_codec.scene import Camera  # noqa: E402

SIZE = (24, 16)


@pytest.fixture(scope="module")
def scene():
    plain = make_scene(7, anchors=250, kind="gaussian", extent=20)
    K = np.array([[30, 0, 16], [0, 30, 12], [0, 0, 1]], np.float32)
    return replace(plain, info=replace(plain.info, camera=Camera(np.eye(4, dtype=np.float32), K, 32, 24)))


@pytest.fixture(scope="module")
def data(scene) -> bytes:
    return encode(scene, layers=2, effort=1)


@pytest.fixture(scope="module")
def file(data) -> faults.File:
    return faults.File(data)


@pytest.fixture(autouse=True)
def _quick(monkeypatch):
    monkeypatch.setattr(faults, "STALL_SECONDS", 0.3)
    monkeypatch.setattr(faults, "SLUMP_SECONDS", 0.2)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")


def test_every_scenario_ends_as_it_must(file):
    rows = faults.run_all(file, faults.scenarios(file))
    assert [row.name for row in rows if not row.kept] == []
    by_name = {row.name: row for row in rows}
    whole = by_name["nothing"]
    assert [shown[:2] for shown in whole.shown] == file.levels() and whole.sent == len(file.data)
    assert by_name["another file after a cut"].changes == 1


def test_a_link_that_collapses_takes_as_long_as_it_must(file):
    rate = 1e6
    slump = faults.run(file, faults.scenarios(file, rate)[1], rate)
    assert slump.kept and slump.requests == 1
    lost = faults.SLUMP_SECONDS * (1 - faults.SLUMP)
    assert slump.seconds > 8 * len(file.data) / rate + lost - 0.05  # what the link may catch up


def test_a_row_fails_if_a_wrong_scene_is_shown_or_the_end_is_another(file):
    scenario = faults.scenarios(file)[0]
    assert faults.run(file, scenario).kept
    for wrong in (
        replace(scenario, content=file.other),
        replace(scenario, expected=file.levels()[:-1]),
        replace(scenario, error=DataError),
        replace(scenario, faults=[Fault(status=404)]),
    ):
        assert not faults.run(file, wrong).kept
    stranger = encode(make_scene(9, anchors=30), layers=2, effort=1)
    assert {shown[0] for shown in faults.run(file, replace(scenario, content=stranger)).shown} == {"?"}


def test_digests_tell_every_array_apart(file):
    assert len(file.digests) == 6  # three levels of two files
    scene = decode(file.data)
    assert faults.digest(scene) == faults.digest(decode(file.data))
    feature = scene.feature.copy()
    feature[-1, -1] += 1
    assert faults.digest(scene) != faults.digest(replace(scene, feature=feature))


@pytest.mark.parametrize("cuts", [40, pytest.param(1000, marks=pytest.mark.slow)])
def test_random_cuts_give_the_same_pictures(file, cuts):
    found = faults.random_cuts(file, cuts)
    assert found.cuts >= cuts and found.wrong == 0
    strange = faults.File(file.data)
    strange.digests = {}
    assert faults.random_cuts(strange, 1).wrong == 1  # it can fail


def test_64_clients_at_once_get_every_byte(file):
    found = measure.crowd(file.data)
    assert found.clients == 64 and found.errors == []
    assert found.seconds >= 0.9 * found.expected


def test_times_of_a_link_that_is_much_slower_than_everything_else(data):
    warm_up()
    size = measure.layer_rows(data)[0][1]
    (base, *_, last) = measure.times(data, [8 * size / 0.5], 1, SIZE)
    assert base.bytes == size and base.expected == pytest.approx(0.5)
    assert 0.5 <= base.network < 1.5 and last.network > base.network
    assert base.picture >= base.network - 0.05 and 0 < base.after_last_byte < base.picture
    assert base.cold > base.picture


@pytest.mark.parametrize(("off", "within"), [(0.0, True), (0.0099, True), (0.011, False), (-0.011, False)])
def test_the_promise_is_the_larger_of_a_share_and_of_seconds(off, within):
    times = measure.Times(1e6, 0, 12_500, 0.1, 0.1 + off, 1, 1, 1)
    assert times.within == within
    assert replace(times, expected=10.0, network=10.0 + 20 * off).within == (abs(off) < 0.015)


def test_the_viewer_draws_each_level_with_the_files_own_camera(data, scene):
    ready = []
    with FaultyServer(data) as server:
        shown = list(viewer.pictures(server.url, SIZE, ready=lambda: ready.append(1)))
    assert [picture.level for picture in shown] == [0, 1, 2] and ready == [1, 1, 1]
    assert all(0 < picture.after_last_byte <= picture.seconds for picture in shown)
    with FaultyServer(encode(replace(scene, info=replace(scene.info, camera=None)), layers=0, effort=1)) as server:
        with pytest.raises(DataError, match="camera"):
            list(viewer.pictures(server.url, SIZE))


def test_another_size_keeps_the_middle_of_the_picture(scene):
    camera = viewer.own_camera(scene.info, (64, 32))
    assert (camera.width, camera.height) == (64, 32)
    np.testing.assert_allclose(camera.K, [[60, 0, 32], [0, 60, 16], [0, 0, 1]])


def test_more_anchors_are_copies_near_their_originals(data, monkeypatch):
    monkeypatch.setattr(enlarge, "EFFORT", 1)
    original, larger = decode(data, max_layer=0), decode(enlarge.with_anchors(data, 600), max_layer=0)
    assert (larger.mask[0] > 0).sum() == 600
    known = {tuple(cell) for cell in original.anchor_q[original.mask[0] > 0].tolist()}
    cells = {tuple(cell) for cell in larger.anchor_q.tolist()}
    assert known <= cells and len(cells) == len(larger.anchor_q)
    assert {row.tobytes() for row in larger.feature} <= {row.tobytes() for row in original.feature}
    for count in (5, 250 * 100):
        with pytest.raises(DataError, match="anchors, expected"):
            enlarge.with_anchors(data, count)


def run(capsys, *argv):
    code = bench.main(["latency", *map(str, argv)])
    done = capsys.readouterr()
    return code, done.out, done.err


def test_the_command_writes_markdown_json_and_a_picture(tmp_path, capsys, data, monkeypatch):
    monkeypatch.setattr(measure, "first_start", lambda data, rate, size: 12.3)  # both would take seconds
    monkeypatch.setattr(measure, "cold_start", lambda url, size: [4.0, 5.0, 6.0])
    (tmp_path / "a.pd4").write_bytes(data)
    plot, report = tmp_path / "p.png", tmp_path / "r.json"
    options = ("--rates", "50M", "--runs", 1, "--size", "24x16", "--only", "times", "--plot", plot, "--json", report)
    code, out, _ = run(capsys, tmp_path / "a.pd4", *options)
    assert code == 0 and plot.read_bytes().startswith(b"\x89PNG")
    assert "SC-GS, published" in out and "37.18" in out and "| 50 Mbps | 2 " in out
    result = json.loads(report.read_text())
    assert [row["level"] for row in result["files"][0]["times"]] == [0, 1, 2]
    assert result["files"][0]["first_start"] == 12.3 and result["faults"] == []


def test_the_command_fails_where_a_picture_is_wrong(tmp_path, capsys, data, monkeypatch):
    (tmp_path / "a.pd4").write_bytes(data)
    monkeypatch.setattr(faults, "scenarios", lambda file: [])
    monkeypatch.setattr(measure, "crowd", lambda data: measure.Crowd(64, 1e6, 10, 1.0, 1.0, ["OSError: x"]))
    code, out, err = run(capsys, tmp_path / "a.pd4", "--only", "faults", "--cuts", 0)
    assert code == 1 and "fail: 64 clients at once" in err and "1 errors: OSError: x" in out


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
