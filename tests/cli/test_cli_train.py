"""train: what it writes, how it ends and how it goes on."""

import json
import os
import shlex
import shutil
import signal
import subprocess
import sys

import pytest
from runs import assert_same_weights, read_log
from tiny import TINY

from pd4dgs_codec import decode, encode
from pd4dgs_codec.cli.train import _device
from pd4dgs_codec.errors import TrainError
from pd4dgs_codec.model import checkpoint
from pd4dgs_codec.model.config import PRESETS
from pd4dgs_codec.model.model import to_scene
from pd4dgs_codec.scene import Widths
from pd4dgs_codec.train.config import at_quality
from pd4dgs_codec.train.learner import Learner


@pytest.fixture(autouse=True)
def _small_preset(monkeypatch):
    """A preset that takes milliseconds a step."""
    monkeypatch.setitem(PRESETS, "tiny", TINY)


@pytest.fixture
def train(cli, shared_dataset):
    def call(output, *options, iterations=4):
        limit = ("--iterations", iterations) if iterations else ()
        return cli("train", shared_dataset, "-o", output, "--preset", "tiny", "-j", 1, *limit, *options)

    return call


def test_train_reports_and_logs(train, tmp_path, shared_dataset):
    output, log = tmp_path / "m.pt", tmp_path / "run.jsonl"
    result = train(output, "--json", "--log", log)
    assert result.code == 0
    report = result.json
    assert report["iterations"] == report["total"] == 4 and report["finished"] is True
    assert report["phases_not_reached"] == [] and [row["level"] for row in report["levels"]] == [0, 1, 2]
    assert len(read_log(log)) == 4
    training = checkpoint.load(output)[1]
    config = json.loads(training["config"])
    assert config["source"] == str(shared_dataset) and config["downscale"] == 1 and config["holdout"] == 8


def test_options_reach_the_configuration(train, tmp_path):
    options = ("--seed", 7, "--downscale", 2, "--holdout", 3, "--rate-scale", 0.5, "--rollout", "fixed")
    options += ("--without", "noise", "--without", "binary", "--max-layer", 1, "--prune", 0.1)
    options += ("--feature-width", 5, "--slots", 3, "--keep-layers")
    assert train(tmp_path / "m.pt", *options, iterations=1).code == 0
    config = json.loads(checkpoint.load(tmp_path / "m.pt")[1]["config"])
    given = dict(seed=7, downscale=2, holdout=3, rate_scale=0.5, rollout="fixed", max_layer=1, prune=0.1)
    assert given.items() <= config.items() and config["preset"] == "tiny"
    scene = to_scene(checkpoint.load(tmp_path / "m.pt")[0])
    assert scene.widths == decode(encode(scene, effort=1)).widths == Widths(5, 3, viewing=("color",))
    assert not (config["noise"] or config["binary"]) and config["keep_layers"]


def test_the_quality_sets_the_dial_and_single_options_replace_parts_of_it(train, tmp_path):
    first = tmp_path / "m.pt"
    assert train(first, "--quality", 80, "--prune", 0.03, iterations=1).code == 0
    config = json.loads(checkpoint.load(first)[1]["config"])
    expected = at_quality(80) | {"prune": 0.03}
    assert {name: config[name] for name in expected} == expected
    resumed = ("--resume", first, "-f")
    assert train(first, *resumed, "--quality", 80, "--prune", 0.03, iterations=None).code == 0
    other = train(first, *resumed, "--quality", 20, "--prune", 0.03, iterations=None)
    assert other.code == 1 and "--quality with rate_scale" in other.err


def test_an_interrupted_run_says_what_it_lacks_and_how_it_goes_on(cli, train, tmp_path, monkeypatch):
    step = Learner.step

    def interrupted(self):
        if self.iteration == 2:
            signal.raise_signal(signal.SIGINT)
        return step(self)

    monkeypatch.setattr(Learner, "step", interrupted)
    cut = train(tmp_path / "cut one.pt", "--log", tmp_path / "log", iterations=8)
    assert cut.code == 0 and "3 of 8 steps" in cut.err
    assert "phases not reached: " in cut.err and "exact rounding of attributes" in cut.err
    monkeypatch.setattr(Learner, "step", step)
    (command,) = (line.partition("to continue: ")[2] for line in cut.err.splitlines() if "to continue: " in line)
    program, *words = shlex.split(command)
    resumed = cli(program.removeprefix("pd4dgs-"), *words, "--json")
    assert resumed.code == 0 and resumed.json["iterations"] == 8 and resumed.json["finished"] is True
    again = cli("train", *words)
    assert again.code == 0 and "the run is complete; a longer one starts anew" in again.err


def test_a_pd4_file_is_no_checkpoint_to_resume(train, scene_pd4, tmp_path):
    result = train(tmp_path / "m.pt", "--resume", scene_pd4, iterations=None)
    assert result.code == 1 and "found a .pd4 file, which holds no training state, expected" in result.err


def test_a_moved_folder_is_resumed_and_another_one_at_its_place_is_not(cli, train, tmp_path, dataset):
    path, moved = tmp_path / "m.pt", tmp_path / "elsewhere"
    options = ("-o", path, "--preset", "tiny", "-j", 1)
    assert cli("train", dataset, *options, "--iterations", 2).code == 0
    shutil.copytree(dataset, moved)
    assert cli("train", moved, "-o", path, "--resume", path).code == 0
    assert json.loads(checkpoint.load(path)[1]["config"])["source"] == str(moved)
    for name in ("000.png", "003.png"):
        shutil.copyfile(moved / "005.png", moved / name)
    result = cli("train", moved, "-o", path, "--resume", path)
    assert result.code == 1 and "other pictures or cameras" in result.err and len(result.error_lines) == 2


def test_resume_refuses_contradictions_and_replaces_no_other_file(cli, train, tmp_path, shared_dataset):
    first, second = tmp_path / "m.pt", tmp_path / "n.pt"
    assert train(first, iterations=2).code == 0
    before = first.read_bytes()
    contradictions = {
        "--seed": ("--seed", 5),
        "--downscale": ("--downscale", 2),
        "--holdout": ("--holdout", 0),
        "--iterations": ("--iterations", 9),
        "--preset": ("--preset", "small"),
        "--without noise": ("--without", "noise"),
        "--max-layer": ("--max-layer", 1),
        "--keep-layers": ("--keep-layers",),
        "--background": ("--background", "white"),
        "--feature-width": ("--feature-width", 16),
    }
    for what, options in contradictions.items():
        result = cli("train", shared_dataset, "-o", first, "--resume", first, *options)
        assert result.code == 1 and what in result.err and len(result.error_lines) == 1
    second.write_bytes(b"precious")
    assert cli("train", shared_dataset, "-o", second, "--resume", first).code == 1
    assert (first.read_bytes(), second.read_bytes()) == (before, b"precious")


def test_resume_needs_training_state(cli, model_pt, shared_dataset, tmp_path):
    bare = tmp_path / "bare.pt"
    checkpoint.save(bare, checkpoint.load(model_pt)[0])
    result = cli("train", shared_dataset, "-o", tmp_path / "n.pt", "--resume", bare)
    assert result.code == 1 and "no training state" in result.err


def test_time_limit_ends_cleanly_and_must_grow_on_resume(cli, train, tmp_path, shared_dataset, monkeypatch):
    slow = iter(range(1000))
    step = Learner.step

    def late(self):
        record = step(self)
        if next(slow) == 2:
            monkeypatch.setattr("pd4dgs_codec.train.loop.time.monotonic", lambda: 1e9)
        return record

    monkeypatch.setattr(Learner, "step", late)
    first = tmp_path / "m.pt"
    result = train(first, "--max-seconds", 1000, "--json", iterations=50)
    monkeypatch.undo()
    report = result.json
    assert result.code == 0 and report["iterations"] == 3 and report["finished"] is False
    assert "rate and mask terms" in report["phases_not_reached"]
    assert "--max-seconds 2000" in report["resume"]
    refused = cli("train", tmp_path / "absent", "-o", first, "--resume", first)  # before any data are read
    assert refused.code == 1 and "higher --max-seconds" in refused.err


def test_a_time_limit_on_resumption_leaves_the_schedule_of_the_preset(cli, train, tmp_path, monkeypatch):
    step, path = Learner.step, tmp_path / "m.pt"
    monkeypatch.setattr(Learner, "step", lambda self: signal.raise_signal(signal.SIGINT) or step(self))
    assert train(path, iterations=None).code == 0  # one step of the preset's number
    resumed = ("--resume", path, "--max-seconds", 1000, "--json", "--log", tmp_path / "log")
    report = train(path, *resumed, iterations=None).json
    assert report["iterations"] == 2 and report["total"] == TINY.iterations > 2
    assert "position" not in read_log(tmp_path / "log")[0], "of a timed run"


def test_missing_held_out_frames_are_noted(train, tmp_path):
    result = train(tmp_path / "m.pt", "--holdout", 0, iterations=2)
    assert result.code == 0 and "none held out" in result.err and "training-view PSNR" in result.err


def test_cuda_that_is_absent_is_refused(train, tmp_path, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    result = train(tmp_path / "m.pt", "--device", "cuda")
    assert result.code == 1 and "--device cpu" in result.err


def test_a_gpu_that_gsplat_cannot_use_is_left_alone(monkeypatch, capsys):
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    monkeypatch.setitem(sys.modules, "gsplat", None)
    assert _device("auto") == "cpu" and "training on the CPU: gsplat" in capsys.readouterr().err
    with pytest.raises(TrainError, match="--device cuda: gsplat"):
        _device("cuda")
    monkeypatch.setattr("pd4dgs_codec.model.picture.check_gsplat", lambda: None)
    assert _device("auto") == _device("cuda") == "cuda"


def test_a_run_that_learnt_nothing_fails(train, tmp_path, monkeypatch):
    monkeypatch.setattr(Learner, "_learn", lambda *_: False)
    result = train(tmp_path / "m.pt")
    assert result.code == 1 and "not finite in all 4 steps" in result.error_lines[-1]


def test_a_second_interrupt_is_one_line(train, tmp_path, monkeypatch):
    monkeypatch.setattr(Learner, "step", lambda self: [signal.raise_signal(signal.SIGINT) for _ in range(2)])
    result = train(tmp_path / "m.pt")
    assert result.code == 1 and "interrupted twice" in result.error_lines[-1] and not (tmp_path / "m.pt").exists()


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="needs SIGHUP")
def test_a_terminal_that_closes_loses_no_step(train, tmp_path, monkeypatch):
    """The shell and the kernel each send a signal."""
    step, path = Learner.step, tmp_path / "m.pt"

    def signalled(self):
        for _ in range(2):
            signal.raise_signal(signal.SIGHUP)
        return step(self)

    monkeypatch.setattr(Learner, "step", signalled)
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)  # else ignored, if these tests run under nohup
    try:
        assert train(path).code == 0 and checkpoint.load(path)[1]["iteration"] == 1
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.skipif(os.name != "posix", reason="links, pipes and /dev/null")
def test_links_and_devices_stay_what_they_are(train, tmp_path):
    log, output = tmp_path / "log", tmp_path / "link.pt"
    log.symlink_to("/dev/null")
    output.symlink_to("real.pt")
    assert train(output, "--log", log, iterations=1).code == 0
    assert log.is_symlink() and output.is_symlink() and (tmp_path / "real.pt").is_file()
    os.mkfifo(tmp_path / "pipe")
    result = train(tmp_path / "pipe", iterations=1)
    assert result.code == 1 and "not a regular file" in result.err and (tmp_path / "pipe").is_fifo()


KILLED = """
import json, os, signal, sys
from tiny import TINY
from pd4dgs_codec.model.config import PRESETS
from pd4dgs_codec.train.loop import Trainer
from pd4dgs_codec.cli.train import main

PRESETS["tiny"] = TINY
run, replace, saves = Trainer.run, os.replace, []

def replace_or_die(*paths):
    if str(paths[1]).endswith(".pt"):  # numba puts its compiled kernels into place in the same way
        saves.append(paths)
        if len(saves) == 5:
            os.kill(os.getpid(), signal.SIGKILL)
    replace(*paths)

os.replace = replace_or_die
Trainer.run = lambda self, *args, **options: run(self, *args, **options, save_every=0.0)  # a save after each step
main(json.loads(sys.argv[1]))
"""


@pytest.mark.skipif(os.name != "posix", reason="needs SIGKILL")
def test_a_run_killed_while_saving_resumes_to_the_same_result(train, tmp_path, shared_dataset):
    whole, killed, log = tmp_path / "whole.pt", tmp_path / "killed.pt", tmp_path / "log.jsonl"
    arguments = [shared_dataset, "-j", 1, "-o", killed, "--preset", "tiny", "--iterations", 10, "--log", log]
    command = [sys.executable, "-c", KILLED, json.dumps([str(a) for a in arguments])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(command, stderr=subprocess.DEVNULL, timeout=600, env=environment)
    assert done.returncode == -signal.SIGKILL
    assert checkpoint.load(killed)[1]["iteration"] == 4 and len(log.read_text().splitlines()) == 5
    assert len(list(tmp_path.glob(".pd4dgs-*/killed.pt"))) == 1  # what it was writing
    with log.open("a") as stream:
        stream.write('{"iteration": 2')  # a line cut in its middle
    assert train(killed, "--resume", killed, "--log", log, iterations=None).code == 0
    assert train(whole, iterations=10).code == 0
    assert_same_weights(whole, killed)
    assert [record["iteration"] for record in read_log(log)] == list(range(10))
    assert not list(tmp_path.glob(".pd4dgs-*/killed.pt"))


def test_scarce_data_are_noted(cli, dataset, tmp_path):
    path = dataset / "transforms.json"
    content = json.loads(path.read_text())
    content["frames"] = content["frames"][:1]
    path.write_text(json.dumps(content))
    result = cli("train", dataset, "-o", tmp_path / "m.pt", "--preset", "tiny", "--iterations", 2, "-j", 1)
    assert result.code == 0
    notes = [line for line in result.error_lines if line.startswith("note: ")]
    assert len(notes) == 2 and "one instant" in notes[0] and "one viewpoint" in notes[1]
