"""Several workers on one scene learn what one process learns, write one checkpoint, and go on in another number."""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from runs import read_log
from tiny import TINY, write_views

from pd4dgs_codec.cli import train
from pd4dgs_codec.errors import TrainError
from pd4dgs_codec.model import checkpoint
from pd4dgs_codec.model.config import PRESETS
from pd4dgs_codec.train import workers

#: Trains the folder given as argument in the tiny size of the tests, so long that anchors grow. No
#: thread that talks to others may be left: one that meets the end of the interpreter aborts the process.
PROGRAM = """
import sys
from pathlib import Path
sys.path[:0] = {folders!r}
from tiny import TINY
from pd4dgs_codec.model.config import PRESETS
PRESETS["tiny"] = TINY
from pd4dgs_codec.cli.train import main
code = main(sys.argv[1:])
left = [name for task in Path("/proc/self/task").glob("*/comm") if "gloo" in (name := task.read_text())]
sys.exit(code or (f"threads left: {{left}}" if left else 0))
"""
STEPS = 60

#: The second worker ends at once; the first says what it hears of it.
LEFT = """
import os
from pd4dgs_codec.errors import TrainError
from pd4dgs_codec.train import workers
try:
    workers.start("cpu", 2)  # fails already if the other one ends meanwhile
    if workers.rank():
        os._exit(0)
    workers.largest(1.0)
except TrainError as error:
    print(error)
"""


@pytest.fixture(scope="module")
def program(once) -> Path:
    """Lies beside the views, and what one process learns from two views a step."""

    def make(folder: Path) -> None:
        (folder / "train.py").write_text(PROGRAM.format(folders=sys.path))
        write_views(folder / "set")
        options = ("--iterations", STEPS, "--views-per-step", 2, "--log", folder / "one.jsonl")
        assert _alone(folder / "train.py", "one.pt", *options) == 0

    return once("workers", make) / "train.py"


def _arguments(folder: Path, output: str, *options: object) -> list[str]:
    paths = [str(folder / "set"), "-o", str(folder / output)]
    return [*paths, "--preset", "tiny", "--device", "cpu", *map(str, options)]


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def _two_workers(*arguments: object) -> list[str]:
    """What each of two workers prints, started without the process of torchrun. None may fail."""
    command = [sys.executable, *map(str, arguments)]
    shared = os.environ | {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(_free_port())}
    both = [subprocess.Popen(command, env=shared | {"RANK": rank}, stdout=subprocess.PIPE, text=True) for rank in "01"]
    told = [worker.communicate(timeout=600)[0] for worker in both]
    assert [worker.returncode for worker in both] == [0, 0]
    return told


def _alone(program: Path, output: str, *options: object) -> int:
    """That of this process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(PRESETS, "tiny", TINY)
        return train.main(_arguments(program.parent, output, *options))


def assert_nearly_same_weights(program, name):
    """The model of `name` is that of one process. Where an anchor is just visible in a view, rounding decides, and Adam
    makes a whole step of the least gradient: one number in a hundred may differ."""
    one, other = (checkpoint.load(program.with_name(own))[0].state_dict() for own in ("one.pt", name))
    assert {key: x.shape for key, x in one.items()} == {key: x.shape for key, x in other.items()}
    near = {key: torch.isclose(x, other[key], rtol=1e-3, atol=1e-4).float().mean() for key, x in one.items()}
    assert min(near.values()) > 0.99, near


def test_two_workers_learn_what_one_process_learns(program):
    launch = ["-m", "torch.distributed.run", "--nproc-per-node=2", f"--master-port={_free_port()}"]
    launch += [f"--log-dir={program.parent}", "--", str(program)]  # else a folder stays in the temporary one
    options = ("--iterations", STEPS, "--views-per-step", 2, "--json", "--log", "two.jsonl")
    command = [sys.executable, *launch, *_arguments(program.parent, "two.pt", *options)]
    done = subprocess.run(command, cwd=program.parent, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)  # the first worker alone speaks
    assert told["iterations"] == STEPS and told["finished"]
    assert_nearly_same_weights(program, "two.pt")
    single, double = (read_log(program.parent / name) for name in ("one.jsonl", "two.jsonl"))
    assert len(double) == STEPS
    assert sum(record.get("grown", 0) for record in single) > 0  # else nothing was decided
    assert [r["anchors"] for r in single] == [r["anchors"] for r in double]


def test_a_run_goes_on_with_another_number_of_workers(program):
    options = ("--iterations", STEPS, "--views-per-step", 2, "--max-seconds", "0.01")
    _two_workers(program, *_arguments(program.parent, "cut.pt", *options))
    begun = int(checkpoint.load(program.parent / "cut.pt")[1]["iteration"])
    assert 0 < begun < STEPS
    assert _alone(program, "cut.pt", "--resume", program.with_name("cut.pt"), "--max-seconds", "1000") == 0
    assert_nearly_same_weights(program, "cut.pt")


def test_a_worker_that_ends_is_missed_in_one_line():
    """Whatever torch calls the broken connection."""
    told, nothing = _two_workers("-c", LEFT)
    assert told.startswith("cannot reach the other workers, or one has ended: ") and told.count("\n") == 1
    assert nothing == ""


@pytest.mark.parametrize(("device", "missing"), [("cpu", "RANK"), ("cuda", "LOCAL_RANK")])
def test_a_variable_of_torchrun_that_is_missing_is_named(device, missing, monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.delenv(missing, raising=False)
    with pytest.raises(TrainError, match=f"cannot reach the other workers.* {missing} expected"):
        workers.start(device, 2)


def test_workers_that_cannot_share_the_views_evenly_are_named(monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "2")
    with pytest.raises(TrainError, match="2 workers.*divides --views-per-step 3"):
        workers.start("cpu", 3)


def test_one_process_talks_to_nobody():
    assert (workers.count(), workers.rank()) == (1, 0)
    assert workers.alike(lambda: 3) == 3 and workers.largest(1.0, 2.0) == (1.0, 2.0)
