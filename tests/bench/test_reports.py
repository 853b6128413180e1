"""The reports codec, render, train and latency: figures by hand, and a tiny model end to end."""

import json
import math
import platform
import shutil
import time
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from tiny import camera_ahead

from pd4dgs_codec import encode
from pd4dgs_codec.bench import latency, report, runtime
from pd4dgs_codec.cli import bench
from pd4dgs_codec.errors import DataError
from pd4dgs_codec.format.info import info
from pd4dgs_codec.model import checkpoint
from pd4dgs_codec.model.model import from_scene
from pd4dgs_codec.web.server import Server


@pytest.fixture
def scene_pd4(data, tmp_path):
    (tmp_path / "scene.pd4").write_bytes(data)
    return tmp_path / "scene.pd4"


# -- common parts ------------------------------------------------------------------------------------------------------


def test_pareto_front_by_hand():
    points = [(1.0, 9.0), (2.0, 5.0), (3.0, 5.0), (2.5, 7.0), (4.0, 1.0), (4.0, 2.0), (1.0, 9.0)]
    assert report.pareto_front(points) == [(1.0, 9.0), (2.0, 5.0), (4.0, 1.0)]
    assert report.pareto_front([]) == []


def test_times_are_medians_with_quartiles_of_repetitions_within_the_budget():
    five = report.summary([4.0, 1.0, 2.0, 3.0, 5.0])
    assert five == {"median": 3.0, "low": 2.0, "high": 4.0, "repeats": 5} and report.quartiles(five) == "3 (2..4)"
    assert report.quartiles(report.summary([2.0])) == "2"
    calls = []
    assert len(report.clock(lambda: calls.append(1), 4, budget=math.inf)[1]) == len(calls) == 4
    assert len(report.clock(lambda: None, 4, budget=0.0)[1]) == 1


def test_the_machine_is_described_without_names_or_paths():
    about = report.machine()
    assert about["cpus"] >= 1 and about["versions"]["numpy"] == np.__version__
    text = report.machine_line(about)
    assert "Python" in text and "/" not in text.replace("n/a", "") and platform.node() not in text


def test_plots_take_zeros_and_many_series_in_black_and_white(tmp_path):
    series = [(f"s{i}", [(1.0 + i, 0.1 / (i + 1)), (2.0 + i, 0.0)]) for i in range(9)]
    panels = [report.Panel("x", series), report.Panel("y", series[:1])]
    report.draw(panels, "error", tmp_path / "p.png")
    with Image.open(tmp_path / "p.png") as image:
        assert image.width > 800
        assert np.ptp(np.asarray(image.convert("RGB")).astype(int), axis=2).max() == 0


# -- codec -------------------------------------------------------------------------------------------------------------


def test_the_error_is_the_rmse_over_all_images():
    expected = [np.full((16, 16, 3), 0.25, np.float32)] * 2
    assert runtime.rmse([expected[0], expected[0] + 0.25], expected) == pytest.approx(0.25 / math.sqrt(2))
    assert runtime.rmse(expected, expected) == 0


def test_a_sweep_of_a_checkpoint(model_pt, tmp_path, capsys):
    options = ["--step-scales", "1,4", "--efforts", "1", "--repeats", "2", "--views", "2"]
    files = ["--json", str(tmp_path / "a.json"), "--plot", str(tmp_path / "a.png")]
    assert bench.main(["codec", str(model_pt), *options, *files]) == 0
    points = json.loads((tmp_path / "a.json").read_text())["points"]
    assert [(p["step_scale"], p["mode"]) for p in points] == [(1, "ans"), (1, "lzma"), (4, "ans"), (4, "lzma")]
    assert all(p["encode"]["repeats"] == p["decode"]["repeats"] == 2 for p in points)
    exact, coarse = points[0], points[2]
    assert exact["error"] < coarse["error"] and exact["bytes"] > coarse["bytes"]
    assert points[0]["error"] == points[1]["error"]  # modes change no value
    assert "| steps x " in capsys.readouterr().out and (tmp_path / "a.png").exists()


def test_a_file_alone_has_bytes_and_times_but_no_error(scene_pd4, tmp_path, capsys):
    assert bench.main(["codec", str(scene_pd4), "--repeats", "1", "--json"]) == 0
    (point,) = json.loads(capsys.readouterr().out)["points"]
    assert point["error"] is None and point["bytes"] == scene_pd4.stat().st_size
    for ignored in (["--plot", str(tmp_path / "p.png")], ["--efforts", "1"], ["--data", "set"], ["--views", "2"]):
        assert bench.main(["codec", str(scene_pd4), *ignored]) == 2
        assert f"{ignored[0]} needs a checkpoint" in capsys.readouterr().err


def test_a_checkpoint_may_come_from_a_pipe(cli, model_pt):
    options = ["--step-scales", "1", "--modes", "ans", "--efforts", "1", "--repeats", "1", "--views", "1"]
    report = cli("bench", "codec", "-", *options, "--json", stdin=model_pt.read_bytes()).json
    assert report["points"][0]["error"] > 0


# -- render ------------------------------------------------------------------------------------------------------------


def random_view(n: int = 150) -> runtime.View:
    rng = np.random.default_rng(4)
    splats = {
        "means": rng.uniform(-1.5, 1.5, (n, 3)),
        "quats": rng.normal(size=(n, 4)),
        "scales": rng.uniform(0.02, 0.6, (n, 3)),
        "opacities": rng.uniform(0.0, 1.0, n),
        "colors": rng.uniform(0, 1, (n, 3)),
    }
    tensors = {name: torch.from_numpy(value.astype(np.float32)) for name, value in splats.items()}
    camera = camera_ahead(2.0, 40.0, 50, 35)
    return {**tensors, "camera": camera, "background": (0.2, 0.5, 0.9), "near_plane": 0.1}


def test_rasterisers_are_compared_with_the_reference():
    points = {p["name"]: p for p in runtime.render_points([random_view()], tuple(runtime.BACKENDS), 3)}
    assert points[runtime.ORACLE]["rmse"] == 0
    assert 0 < points[runtime.KERNELS]["rmse"] < 1e-5 and points[runtime.KERNELS]["milliseconds"]["repeats"] == 3
    if not torch.cuda.is_available():
        assert points[runtime.GSPLAT]["missing"] == "found no CUDA device"
    assert len(runtime.render_table(list(points.values())).splitlines()) == 2 + 3


def test_render_report_of_file_and_checkpoint(scene_pd4, model_pt, capsys):
    for path in (scene_pd4, model_pt):
        assert bench.main(["render", str(path), "--only", "kernels", "--repeats", "1", "--views", "1", "--json"]) == 0
        result = json.loads(capsys.readouterr().out)
        assert result["points"][0]["rmse"] < 1e-5 and result["pictures"][0]["gaussians"] > 0


# -- train -------------------------------------------------------------------------------------------------------------


def test_runs_are_reported(model_pt, capsys, tmp_path):
    assert bench.main(["train", str(model_pt), "-o", str(tmp_path / "t.png"), "--json"]) == 0
    (run,) = json.loads(capsys.readouterr().out)["runs"]
    assert run["name"] == "model.pt (tiny)"
    assert [p["rmse"] for p in run["curve"]] == pytest.approx([0.1, 0.01])
    assert run["anchors"] == 40 and (tmp_path / "t.png").exists()


def test_runs_of_one_file_name_are_told_apart(model_pt, tmp_path):
    copy = shutil.copy(model_pt, tmp_path / "model.pt")
    runs = runtime.recorded_runs([str(model_pt), str(copy), str(copy)])
    assert [run["name"] for run in runs] == [f"{model_pt} (tiny)", f"{copy} (tiny)"]


@pytest.mark.parametrize(
    "curve", ['[{"seconds": 1}]', '[{"iteration": 1, "seconds": 1, "psnr": []}]', "[1]", "{", "[]"]
)
def test_a_run_with_a_broken_record_is_refused(scene, tmp_path, curve):
    checkpoint.save(tmp_path / "a.pt", from_scene(scene), {"curve": curve})
    with pytest.raises(DataError, match=r"a\.pt: .* curve of quality"):
        runtime.recorded_runs([str(tmp_path / "a.pt")])


# -- latency -----------------------------------------------------------------------------------------------------------


def test_a_process_prints_text_and_ends_with_its_block():
    program = "import os, time; print(os.environ['WORD'], flush=True); time.sleep(60)"
    with latency.python("-c", program, WORD="ä") as out:
        assert out.readline() == "ä\n"
        start = time.monotonic()
    assert time.monotonic() - start < 30 and out.closed


def test_latency_of_a_file(scene_pd4, data, capsys, monkeypatch):
    monkeypatch.setattr(latency, "first_start", lambda data, rate: 12.3)  # takes seconds to compile the kernels
    assert bench.main(["latency", str(scene_pd4), "--rates", "50M", "--runs", "1", "--json"]) == 0
    (found,) = json.loads(capsys.readouterr().out)["files"]
    layers = [(row["layer"], row["end"]) for row in info(data)["layers"]]
    assert [(row["level"], row["bytes"]) for row in found["times"]] == layers
    assert found["first_start"] == 12.3
    for row in found["times"]:
        assert row["expected"] == 8 * row["bytes"] / 50e6
        assert 0 < row["after_last_byte"] <= row["picture"] and 0 < row["network"] and 0 < row["cold"]


def test_the_image_of_a_sliced_level_is_that_with_all_its_slices(scene):
    data = encode(scene, effort=1, slices=1000)
    first, *_, last = info(data)["layers"]
    assert len(first["slices"]) > 1  # so the third image is not of level 2
    rate = 8 * len(data) / 1.5
    rows = latency.times(data, rate, 1)
    assert [row["level"] for row in rows] == [0, 1, 2] and rows[2]["bytes"] == last["end"]
    for row in rows:
        assert min(row["network"], row["picture"], row["cold"]) > 0.9 * row["expected"]


def test_a_file_without_a_camera_cannot_be_rendered(scene, tmp_path):
    blind = encode(replace(scene, info=replace(scene.info, camera=None)), layers=0, effort=1)
    (tmp_path / "scene.pd4").write_bytes(blind)
    with Server(tmp_path) as server, server.running(), pytest.raises(DataError, match="camera"):
        list(latency.pictures(f"{server.url}scene.pd4"))
    assert bench.main(["latency", str(tmp_path / "scene.pd4")]) == 1


# -- the player --------------------------------------------------------------------------------------------------------


@pytest.mark.skipif(shutil.which("node") is None, reason="needs Node.js")
def test_the_player_is_measured_in_node(scene_pd4, tmp_path, capsys):
    assert bench.main(["player", str(scene_pd4), "--pictures", "3", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["gaussians"] > 0 and {"decode", "evaluate", "sort"} < found["steps"].keys()
    assert all(ms > 0 for ms in found["steps"].values())
    (tmp_path / "junk.pd4").write_bytes(b"junk")
    assert bench.main(["player", str(tmp_path / "junk.pd4")]) == 1
    assert "DecodeError: not a .pd4 file" in capsys.readouterr().err


# -- the command -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("report", bench.REPORTS)
def test_help_has_examples(report, capsys):
    with pytest.raises(SystemExit):
        bench.main([report, "--help"])
    out = capsys.readouterr().out
    assert out.startswith(f"usage: pd4dgs-bench {report} ") and f"pd4dgs-bench {report} " in out.split("examples:")[1]
    assert max(map(len, out.splitlines())) <= 120


@pytest.mark.parametrize(
    "argv, code, word",
    [
        ("codec none.pt", 1, "none.pt"),
        ("codec none.pt --efforts 1,12", 2, "from 1 to 9"),
        ("codec none.pt --modes ans,zip", 2, "ans, lzma"),
        ("codec none.pt --plot p.gif", 2, "ends in .png"),
        ("codec --json none.pt", 2, "ends in .json"),
        ("latency --json none.pd4 other.pd4 -f", 2, "ends in .json"),
        ("render none.pd4 --only kernel", 2, "kernels"),
        ("render none.pd4 --holdout 0", 2, "--holdout needs --data"),
        ("train", 2, "FILE"),
        ("latency none.pd4 --rates fast", 2, "expected a rate"),
        ("--json codec", 2, "the report first"),
        ("codek", 2, "codek"),
        ("", 2, "REPORT"),
    ],
)
def test_bad_input_is_one_line(argv, code, word, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert bench.main(argv.split()) == code
    out, err = capsys.readouterr()
    assert word in err and len(err.splitlines()) == 1 and not list(tmp_path.iterdir())


def test_outputs_that_exist_are_refused_before_any_work(tmp_path, capsys):
    (tmp_path / "p.png").write_bytes(b"kept")
    assert bench.main(["codec", "none.pt", "--plot", str(tmp_path / "p.png")]) == 1
    assert "exists already" in capsys.readouterr().err and (tmp_path / "p.png").read_bytes() == b"kept"
