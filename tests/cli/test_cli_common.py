"""Options, help, usage errors and the dispatcher."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib import import_module

import pytest

from pd4dgs_codec import FORMAT_VERSION, io
from pd4dgs_codec import __main__ as dispatcher
from pd4dgs_codec.cli import common, options

VERBS = (
    "prepare", "train", "encode", "decode", "info", "render", "eval", "bench", "package", "serve", "view", "batch",
)  # fmt: skip


@pytest.mark.parametrize("verb", VERBS)
def test_help_has_a_summary_an_example_and_exits_0(verb, capsys):
    with pytest.raises(SystemExit) as ended:
        import_module(f"pd4dgs_codec.cli.{verb}").main(["--help"])
    out, err = capsys.readouterr()
    assert ended.value.code == 0 and err == ""
    assert out.startswith(f"usage: pd4dgs-{verb} ")
    assert "example" in out and f"  pd4dgs-{verb} " in out and "exit codes" in out
    assert max(map(len, out.splitlines())) <= 120


@pytest.mark.parametrize("verb", ("train", "render", "eval"))
def test_help_lists_every_synthetic_scene(verb):
    from pd4dgs_codec.data.synthetic import MOTIONS

    text = import_module(f"pd4dgs_codec.cli.{verb}").parser().format_help()
    for name in MOTIONS:
        assert f"synthetic:{name}" in text


USAGE_ERRORS = [
    ("train", ["synthetic:local"]),
    ("train", ["synthetic:local", "-o", "m.pt", "--iterations", "0"]),
    ("train", ["synthetic:local", "-o", "m.pt", "--max-seconds", "nan"]),
    ("train", ["synthetic:local", "-o", "-"]),
    ("train", ["synthetic:local", "-o", "m.pt", "--seed", str(2**63 - 1)]),
    ("train", ["synthetic:local", "-o", "m.pt", "--log", "m.pt"]),
    ("encode", ["m.pt"]),
    ("encode", ["m.pt", "-o", "-", "--json"]),
    ("encode", ["m.pt", "-o", "s.pd4", "--effort", "10"]),
    ("encode", ["m.pt", "-o", "s.pd4", "--step-scale", "-1"]),
    ("encode", ["m.pt", "-o", "s.pd4", "--lay", "1"]),
    ("decode", ["s.pd4", "-o", "s.txt"]),
    ("decode", ["s.pd4", "--symbols"]),
    ("decode", ["s.pd4", "-o", "s.pt", "--symbols"]),
    ("decode", ["s.pd4", "--max-layer", "3"]),
    ("info", ["s.pd4", "--at", "2X"]),
    ("info", ["s.pd4", "--at", "0M"]),
    ("info", []),
    ("render", ["s.pd4", "-o", "film.avi"]),
    ("render", ["s.pd4", "-o", "%s.png"]),
    ("render", ["s.pd4", "-o", "%04d-%04d.png"]),
    ("render", ["s.pd4", "-o", "a.gif", "--data", "set", "--orbit", "3"]),
    ("batch", ["m.jsonl", "-o", "out"]),
    ("batch", ["m.jsonl", "-o", "out", "--op", "explode"]),
    ("batch", ["m.jsonl", "-o", "out", "--op", "encode", "--slurm", "partition"]),
    ("eval", ["s.pd4"]),
    ("eval", ["s.pd4", "set", "--downscale", "half"]),
]


@pytest.mark.parametrize(("verb", "argv"), USAGE_ERRORS)
def test_usage_errors_exit_2_with_one_line(cli, verb, argv, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = cli(verb, *argv)
    assert result.code == 2
    assert len(result.error_lines) == 1 and result.err.startswith(f"pd4dgs-{verb}: error: ")
    assert f"pd4dgs-{verb} --help" in result.err
    assert list(tmp_path.iterdir()) == []


def test_usage_error_as_json(cli):
    result = cli("info", "--json", "--nothing")
    assert result.code == 2 and result.json["error"]["type"] == "UsageError"
    assert result.json["error"]["message"] in result.err


def test_dispatcher_runs_verbs_and_refuses_others(scene_pd4, capsys):
    assert dispatcher.main(["info", str(scene_pd4), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["bytes"] == scene_pd4.stat().st_size
    assert dispatcher.main(["explode"]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert dispatcher.main([]) == 2
    assert dispatcher.main(["--help"]) == 0
    out = capsys.readouterr().out
    assert all(verb in out for verb in VERBS)


def test_version_names_release_and_format():
    done = subprocess.run(
        [sys.executable, "-m", "pd4dgs_codec", "encode", "--version"], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0 and done.stdout.startswith("pd4dgs-encode ")
    assert done.stdout.endswith(f"format {FORMAT_VERSION}\n")


def test_help_and_usage_errors_load_no_heavy_module():
    program = (
        "import sys\nfrom importlib import import_module\n"
        f"for verb in {VERBS!r}:\n"
        "    module = import_module('pd4dgs_codec.cli.' + verb)\n    module.parser().format_help()\n"
        "    module.main([])\n"
        "print([m for m in ('torch', 'numba', 'numpy', 'PIL') if m in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60, stdin=subprocess.DEVNULL
    )
    # decode without arguments reads stdin, so it alone may load numpy
    assert done.stdout.strip() in ("[]", "['numpy']"), done.stderr


def test_rates_are_bits_per_second():
    assert options.rates("500k,2M,1G,64") == {"500k": 5e5, "2M": 2e6, "1G": 1e9, "64": 64.0}


def test_table_aligns_numbers_right():
    assert common.table(("a", "bb"), [("long", 1), ("x", 100)]).splitlines() == ["a      bb", "long    1", "x     100"]


def test_infinite_and_nan_become_null():
    assert io.finite({"a": [float("inf"), 1.0], "b": (float("nan"), "x")}) == {"a": [None, 1.0], "b": [None, "x"]}


def test_internal_error_is_one_line_and_verbose_shows_where(cli, scene_pd4, monkeypatch):
    def broken(data):
        raise ZeroDivisionError("a fault of ours")

    monkeypatch.setattr("pd4dgs_codec.format.info.info", broken)
    result = cli("info", scene_pd4)
    assert result.code == 1 and len(result.error_lines) == 1 and "internal error" in result.err
    with pytest.raises(ZeroDivisionError):
        cli("info", scene_pd4, "-v")


def test_missing_module_is_named(cli, model_pt, tmp_path, monkeypatch):
    def gone(path):
        raise ModuleNotFoundError("No module named 'torch'", name="torch")

    monkeypatch.setattr("pd4dgs_codec.model.checkpoint.load", gone)
    result = cli("encode", model_pt, "-o", tmp_path / "s.pd4")
    assert result.code == 1 and "torch" in result.err and "pip install" in result.err
    assert list(tmp_path.iterdir()) == []
