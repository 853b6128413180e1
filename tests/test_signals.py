"""Signals end a command at any call without a traceback, and leave the old output or the new one and nothing else."""

import os
import signal
import subprocess
import sys
import time
from itertools import count
from pathlib import Path

import pytest
from test_io import _calls_of_the_system

import pd4dgs_codec
from pd4dgs_codec import io
from pd4dgs_codec.signals import ENDING, held, ignore_more, interruptible

pytestmark = pytest.mark.skipif(os.name != "posix", reason="needs POSIX signals")


@pytest.fixture(autouse=True)
def _default_handlers():
    before = {number: signal.getsignal(number) for number in ENDING}
    for number in ENDING:
        signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def _signalled(number, work):
    """Calls work() once for each of its calls of the system, with a signal before that; yields after each end by it."""
    for last in count(1):
        try:
            with interruptible() as ours:
                assert ours
                _calls_of_the_system(lambda at, last=last: signal.raise_signal(number) if at == last else None, work)
        except KeyboardInterrupt:
            io.remove_temporaries()
            yield
        else:
            return


@pytest.mark.parametrize("number", ENDING)
def test_a_signal_at_any_call_leaves_one_whole_file(tmp_path, number):
    target, left = tmp_path / "x.bin", []
    target.write_bytes(b"old")
    for _ in _signalled(number, lambda: io.write_bytes(target, b"new", overwrite=True)):
        assert target.read_bytes() in (b"old", b"new") and os.listdir(tmp_path) == ["x.bin"]
        left.append(target.read_bytes())
        target.write_bytes(b"old")
    assert b"old" in left and len(left) > 7 and target.read_bytes() == b"new"


@pytest.mark.parametrize("number", ENDING)
def test_a_signal_at_any_call_leaves_no_folder(tmp_path, number):
    def work():
        with io.temporary_folder(tmp_path) as folder:
            (folder / "x").write_bytes(b"1")

    left = [os.listdir(tmp_path) for _ in _signalled(number, work)]
    assert len(left) > 3 and not any(left)


def test_files_that_belong_together_are_moved_together(tmp_path, monkeypatch):
    replace, names = os.replace, [str(tmp_path / "out" / f"{i}.png") for i in range(3)]
    monkeypatch.setattr(os, "replace", lambda *paths: (signal.raise_signal(signal.SIGTERM), replace(*paths)))
    with pytest.raises(KeyboardInterrupt), interruptible(), io.whole_files(names, False) as temporaries:
        for temporary in temporaries:
            temporary.write_bytes(b"1")
    assert len(list((tmp_path / "out").iterdir())) == 3 and os.listdir(tmp_path) == ["out"]


def test_handlers_of_others_and_ignored_signals_stay():
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, other := lambda *_: None)
    with interruptible():
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN and signal.getsignal(signal.SIGTERM) is other
        with interruptible() as inner:
            assert not inner
    assert signal.getsignal(signal.SIGHUP) is signal.SIG_DFL


def test_held_signals_wait_and_later_ones_are_ignored():
    steps = []
    with interruptible():
        with pytest.raises(KeyboardInterrupt):
            with held():
                signal.raise_signal(signal.SIGINT)
                steps.append("held")
        ignore_more()
        signal.raise_signal(signal.SIGTERM)
        steps.append("ignored")
    assert steps == ["held", "ignored"]


#: A program of ours, and where in its life a signal comes.
PROGRAM = """
import os, signal, sys
sys.argv = ["pd4dgs-info", "--version"]
signal.signal(signal.SIGINT, signal.default_int_handler)
import pd4dgs_codec.cli
if WHEN == "start":
    os.kill(os.getpid(), NUMBER)
from pd4dgs_codec.cli import common, info
from pd4dgs_codec.cli.options import Parser
def action(args, console):
    os.kill(os.getpid(), NUMBER)
    while True:
        pass
if WHEN == "middle":
    parser = Parser("info", "", "", "")
    parser.add_common()
    sys.exit(common.run(parser, action, []))
try:
    info.main()
except SystemExit:
    os.kill(os.getpid(), NUMBER)
"""


@pytest.mark.parametrize("number", ENDING)
@pytest.mark.parametrize("when", ["start", "middle", "end"])
def test_no_traceback_from_the_first_import_to_the_last_line(when, number):
    script = PROGRAM.replace("WHEN", repr(when)).replace("NUMBER", str(int(number)))
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    if when == "middle":
        told = "pd4dgs-info: error: interrupted; unfinished outputs were removed\n"
        assert done.returncode == 1 and done.stderr == told
    else:
        assert done.returncode == -number and done.stderr == ""


#: Prints which modules a program looks for while a signal would still print a traceback.
WATCHED = """
import _signal, sys
sys.argv = ["/bin/pd4dgs-info"]
_signal.signal(_signal.SIGINT, _signal.default_int_handler)
early = []
def seen(event, args):
    if event == "import" and _signal.getsignal(_signal.SIGINT) is not _signal.SIG_DFL:
        early.append(args[0])
sys.addaudithook(seen)
from pd4dgs_codec.cli.MODULE import main
print(*early)
"""


@pytest.mark.parametrize("module", ["info", "train"])
def test_nothing_but_the_packages_is_loaded_before_the_first_handler(module):
    script = [sys.executable, "-S", "-c", WATCHED.replace("MODULE", module)]  # no site: it may load modules before us
    where = os.pathsep.join([str(Path(pd4dgs_codec.__file__).parents[1]), *filter(None, sys.path)])
    done = subprocess.run(script, env={"PYTHONPATH": where}, capture_output=True, text=True, timeout=120)
    names = {"pd4dgs_codec", "pd4dgs_codec.cli", f"pd4dgs_codec.cli.{module}"}
    assert done.stdout and names.issuperset(done.stdout.split()), done.stdout + done.stderr


def test_a_signal_inside_a_callback_is_not_lost():
    class Ends:
        def __del__(self):
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt), interruptible():
        Ends()
        for _ in range(600):  # not pause(), which waits for ever for a signal that came just before it
            time.sleep(0.1)
