"""The reports codec, render and train: fronts and tables by hand, the oracle in blocks, and a tiny model end to end."""

from __future__ import annotations

import importlib
import json
import math
import platform
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from tiny import TINY, write_views

from pd4dgs_codec.bench import codec, pictures, render, report, timing, train
from pd4dgs_codec.cli import bench
from pd4dgs_codec.errors import DataError, Pd4Error
from pd4dgs_codec.format.encoder import encode
from pd4dgs_codec.format.options import EncodeOptions
from pd4dgs_codec.format.plan import plan
from pd4dgs_codec.model.config import PRESETS
from pd4dgs_codec.model.rasterization import rasterization
from pd4dgs_codec.quality.frames import Frame
from pd4dgs_codec.scene import Camera

RNG = np.random.default_rng(4)

# -- fronts, times, plots ----------------------------------------------------------------------------------------------


def test_pareto_front_by_hand():
    points = [(1.0, 9.0), (2.0, 5.0), (3.0, 5.0), (2.5, 7.0), (4.0, 1.0), (4.0, 2.0), (1.0, 9.0)]
    assert report.pareto_front(points) == [(1.0, 9.0), (2.0, 5.0), (4.0, 1.0)]
    assert report.pareto_front([]) == []


def test_median_and_quartiles():
    assert timing.summary([4.0, 1.0, 2.0, 3.0, 5.0]) == timing.Timing(3.0, 2.0, 4.0, 5)
    assert timing.summary([2.0]).text() == "2"


def test_work_is_repeated_until_the_budget_is_spent():
    calls = []
    _, found = timing.measure(lambda: calls.append(1), 4, budget=math.inf)
    assert found.repeats == len(calls) == 4
    assert timing.measure(lambda: None, 4, budget=0.0)[1].repeats == 1


def test_a_cold_run_reports_its_own_memory(tmp_path, scene):
    path = tmp_path / "scene.pd4"
    path.write_bytes(encode(scene, effort=1))
    ballast = np.ones(200 << 20, np.uint8)  # a child must not be charged for its parent's memory
    found = timing.cold("decode", [str(path)], 1)
    assert found.seconds.median > 0 and 10 << 20 < found.peak_bytes < ballast.nbytes
    path.write_bytes(b"nothing")
    with pytest.raises(Pd4Error, match=r"^pd4dgs-decode: error: .*scene.pd4"):
        timing.cold("decode", [str(path)], 1)


def test_the_machine_is_described_without_names_or_paths():
    about = timing.machine("numpy", "no-such-package")
    assert about["cpus"] >= 1 and about["versions"]["numpy"] == np.__version__
    assert about["versions"]["no-such-package"] is None
    text = timing.machine_line(about)
    assert "Python" in text and "/" not in text.replace("n/a", "") and platform.node() not in text


def test_plots_take_zeros_and_many_series(tmp_path):
    series = [(f"s{i}", [(1.0 + i, 0.1 / (i + 1)), (2.0 + i, 0.0)]) for i in range(9)]
    panels = [report.Panel("a", "x", series), report.Panel("b", "y", series[:1])]
    report.draw(panels, "error", tmp_path / "p.png")
    with Image.open(tmp_path / "p.png") as image:
        assert image.width > 800
        pixels = np.asarray(image.convert("RGB")).astype(int)
    assert len(set(report.STYLES)) == len(report.STYLES)
    assert np.ptp(pixels, axis=2).max() == 0  # black and white, nothing told by colour


# -- codec -------------------------------------------------------------------------------------------------------------


def test_deviations_by_hand(scene):
    planned, _ = plan(scene, EncodeOptions(layers=2))
    moved = planned.feature.copy()
    moved[0, 0] += 0.5
    found = {v.what: v for v in codec.deviations(planned, replace(planned, feature=moved))}
    assert found["feature"].largest == 0.5 and found["feature"].step == planned.steps.feature
    assert found["feature"].rms == pytest.approx(0.5 / math.sqrt(moved.size))
    assert list(found) == list(vars(planned.steps)) and found["weights_local"].largest == 0


def test_picture_deviations_by_hand():
    class Fake:
        level = 0

        def picture(self, camera, time):
            return np.full((16, 16, 3), 0.25 + time / 4, np.float32)

    frames = [Frame(None, 0.0), Frame(None, 1.0)]
    (found,) = codec.picture_deviations([Fake()], frames, {0: [np.full((16, 16, 3), 0.25, np.float32)] * 2})
    assert found.rmse == pytest.approx(0.25 / math.sqrt(2)) and found.psnr == pytest.approx(15.0515, abs=1e-4)
    want = [np.full((16, 16, 3), 0.25, np.float32)]
    same, above = codec.picture_deviations([Fake()], frames[:1], {0: want, 2: [want[0] + 0.5]})
    assert same.rmse == 0 and same.psnr == math.inf and same.ssim == 1
    assert (above.level, above.rmse) == (2, 0.5)  # the file has no level 2: its picture is that of level 0


def test_a_sweep_of_a_checkpoint(model_pt, tmp_path, capsys, monkeypatch):
    fresh = []

    def cold(verb, arguments, repeats):  # the same commands, but not in processes of their own
        assert importlib.import_module(f"pd4dgs_codec.cli.{verb}").main(arguments) == 0
        fresh.append(verb)
        return timing.Cold(timing.summary([1.0] * repeats), 1 << 20)

    monkeypatch.setattr(codec, "cold", cold)
    options = ["--step-scales", "1,4", "--efforts", "1", "--repeats", "2", "--cold", "1", "--views", "2"]
    files = ["--json", str(tmp_path / "a.json"), "--plot", str(tmp_path / "a.png")]
    assert bench.main(["codec", str(model_pt), *options, *files]) == 0
    result = json.loads((tmp_path / "a.json").read_text())
    points = result["points"]
    assert [(p["step_scale"], p["mode"]) for p in points] == [(1, "ans"), (1, "lzma"), (4, "ans"), (4, "lzma")]
    for p in points:
        assert sum(p["layer_bytes"]) < p["bytes"] and p["encode"]["repeats"] == p["decode"]["repeats"] == 2
        assert (p["encode_cold"] is not None) == (p["decode_cold"] is not None) == (p["step_scale"] == 1)
        assert len(p["pictures"]) == 3 and p["coded_bits"] > 0
    assert fresh == ["decode", "encode"] * 2
    exact, coarse = points[0], points[2]
    assert all(v["largest"] == 0 for v in exact["values"])  # the scene lies on its steps
    assert max(v["largest"] / v["step"] for v in coarse["values"]) == pytest.approx(0.5)
    assert len(coarse["layer_bytes"]) == 1  # its deformations vanish, which its highest level must pay for
    assert exact["error"] < coarse["error"] and "bytes" in points[3]["fronts"]
    assert points[0]["pictures"] == points[1]["pictures"]
    out = capsys.readouterr().out
    assert out.count("\n| 1 ") == 2 + 8 and "share of opacity" in out and "CPUs" in out
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")


def test_a_file_alone_has_bytes_and_times(data, tmp_path, capsys):
    path = tmp_path / "scene.pd4"
    path.write_bytes(data)
    assert bench.main(["codec", str(path), "--quick", "--json"]) == 0
    (point,) = json.loads(capsys.readouterr().out)["points"]
    assert point["bytes"] == len(data) and point["values"] == [] and point["error"] is None


# -- render ------------------------------------------------------------------------------------------------------------


def random_view(n=60, width=37, height=21):
    viewmat = np.eye(4, dtype=np.float32)
    viewmat[2, 3] = 3.0
    K = np.array([[30, 0, width / 2], [0, 30, height / 2], [0, 0, 1]], np.float32)
    return {
        "means": RNG.uniform(-1.5, 1.5, (n, 3)).astype(np.float32),
        "quats": RNG.normal(size=(n, 4)).astype(np.float32),
        "scales": RNG.uniform(0.02, 0.6, (n, 3)).astype(np.float32),
        "opacities": RNG.uniform(0.0, 1.0, n).astype(np.float32),
        "colors": RNG.uniform(0, 1, (n, 3)).astype(np.float32),
        "viewmat": viewmat,
        "K": K,
        "width": width,
        "height": height,
        "near": 0.1,
        "background": np.array([0.2, 0.5, 0.9], np.float32),
    }


def test_the_oracle_in_blocks_is_the_dense_oracle():
    view = random_view()
    given = {k: torch.from_numpy(v) if isinstance(v, np.ndarray) else v for k, v in view.items()}
    names = ("means", "quats", "scales", "opacities", "colors")
    dense = rasterization(
        *(given[name] for name in names), Camera(view["viewmat"], view["K"], view["width"], view["height"]),
        view["background"], near_plane=0.1, backend="reference",
    )[0]  # fmt: skip
    np.testing.assert_allclose(pictures.oracle(view), dense.numpy(), rtol=0, atol=1e-12)


def test_ways_to_draw_against_the_oracle(tmp_path):
    names = (render.ORACLE, render.TEXTBOOK, render.KERNELS, render.GSPLAT)
    points = {p.name: p for p in render.sweep([random_view()], names, 3, tmp_path)}
    assert points[render.ORACLE].rmse == 0
    assert 0 < points[render.TEXTBOOK].rmse < 1e-5 and 0 < points[render.KERNELS].rmse < 1e-5
    assert points[render.KERNELS].milliseconds.repeats == 3
    if not torch.cuda.is_available():
        assert points[render.GSPLAT].missing == "there is no CUDA device"
    rows = render.table(list(points.values())).splitlines()
    assert len(rows) == 2 + 4 and all(row.count("|") == 8 for row in rows)


@pytest.mark.slow
def test_every_variant_of_the_kernels(tmp_path):
    view = random_view(n=400)  # so dense that every threshold decides some pixel
    points = {p.name: p for p in render.sweep([view], (render.KERNELS, *render.VARIANTS), 2, tmp_path)}
    own = points[render.KERNELS].rmse
    assert points["tile 16x16"].rmse == points["tile 8x16"].rmse == own  # tiles decide no pixel
    assert own < points["T > 1e-3"].rmse < points["T > 1e-2"].rmse
    assert own < points["alpha >= 1/128"].rmse < points["alpha >= 1/64"].rmse


# -- train -------------------------------------------------------------------------------------------------------------


def test_runs_that_exist(model_pt, tmp_path, capsys):
    log = tmp_path / "run.jsonl"
    records = [{"seconds": 1.0}, {"seconds": 3.0, "held_out_psnr": [20.0], "anchors": 7}]
    log.write_text("".join(json.dumps(r) + "\n" for r in records))
    assert bench.main(["train", "--from", str(model_pt), str(log), "--json"]) == 0
    first, second = json.loads(capsys.readouterr().out)["runs"]
    assert first["name"].endswith("model.pt (tiny)") and second["anchors"] == 7
    assert [p["rmse"] for p in first["curve"]] == pytest.approx([0.1, 0.01])
    assert [p["front"] for p in first["curve"]] == [True, True] and second["curve"][0]["front"] is False


def test_a_run_without_evaluations_or_records_is_refused(tmp_path):
    log = tmp_path / "run.jsonl"
    log.write_text('{"seconds": 1.0}\n')
    with pytest.raises(DataError, match="no held-out quality"):
        train.of_file(str(log))
    log.write_text('{"seconds": 1.0}\nnothing\n')
    with pytest.raises(DataError, match="line 2"):
        train.of_file(str(log))


def test_presets_are_trained_and_compared(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(PRESETS, "tiny", TINY)
    argv = ["train", str(write_views(tmp_path)), "--holdout", "2", "--presets", "tiny", "--iterations", "4"]
    assert bench.main([*argv, "--plot", str(tmp_path / "t.png"), "--json"]) == 0
    (run,) = json.loads(capsys.readouterr().out)["runs"]
    assert run["name"] == "tiny" and run["anchors"] > 0 and len(run["curve"]) >= 2
    assert all(p["rmse"] == pytest.approx(10 ** (-p["psnr"][-1] / 20)) for p in run["curve"])
    assert (tmp_path / "t.png").exists()


# -- the commands ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("report", ["codec", "render", "train"])
def test_help_has_examples(report, capsys):
    with pytest.raises(SystemExit):
        bench.main([report, "--help"])
    out = capsys.readouterr().out
    assert f"pd4dgs-bench {report} " in out.split("examples:")[1]
    assert max(map(len, out.splitlines())) <= 120


@pytest.mark.parametrize(
    "argv, code, word",
    [
        (["codec", "none.pt"], 1, "none.pt"),
        (["codec", "none.pt", "--efforts", "1,12"], 2, "from 1 to 9"),
        (["codec", "none.pt", "--modes", "ans,zip"], 2, "ans, lzma"),
        (["render", "none.pd4", "--only", "kernel"], 2, "kernels"),
        (["train"], 2, "--from"),
        (["train", "synthetic:static", "--from", "a.pt"], 2, "no SOURCE"),
        (["train", "synthetic:static", "--seconds", "3", "--iterations", "3"], 2, "one of them"),
    ],
)
def test_usage_errors(argv, code, word, capsys):
    assert bench.main(argv) == code
    err = capsys.readouterr().err
    assert word in err and len(err.splitlines()) == 1


def test_outputs_that_exist_are_refused_before_any_work(tmp_path, capsys):
    (tmp_path / "p.png").write_bytes(b"kept")
    assert bench.main(["codec", "none.pt", "--plot", str(tmp_path / "p.png")]) == 1
    assert "exists already" in capsys.readouterr().err and (tmp_path / "p.png").read_bytes() == b"kept"


def test_a_file_alone_has_nothing_to_plot(tmp_path, capsys, scene):
    (tmp_path / "scene.pd4").write_bytes(encode(scene, effort=1))
    assert bench.main(["codec", str(tmp_path / "scene.pd4"), "--plot", str(tmp_path / "p.png")]) == 2
    assert "no error to plot" in capsys.readouterr().err


def test_spread_takes_the_middle_of_each_share():
    assert pictures.spread(range(10), 2) == [2, 7] and pictures.spread([1, 2], 5) == [1, 2]
