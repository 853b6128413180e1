"""Closed, full and broken standard streams: an exit code, at most one line, and never a traceback."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from pd4dgs_codec.__main__ import VERBS

pytestmark = pytest.mark.skipif(not os.path.exists("/dev/full"), reason="a device that is always full, as Linux has")

#: Arguments (FILE is a whole file), redirections of the shell, exit code, and a part of the message on stderr.
CASES = {
    "stdout is closed": ("info FILE", ">&-", 1, "stdout: Bad file descriptor"),
    "stdout is full": ("info FILE", ">/dev/full", 1, "stdout: No space left on device"),
    "stdout is full, JSON": ("info FILE --json", ">/dev/full", 1, "stdout: No space left on device"),
    "stderr is closed": ("info FILE", "2>&-", 0, ""),
    "stderr is closed, an error": ("info none", "2>&-", 1, ""),
    "all are closed": ("info none", "<&- >&- 2>&-", 1, ""),
    "stdin is closed": ("info -", "<&-", 2, "stdin is a terminal"),
    "no stream at all, and the file is whole": ("decode FILE -o OUT.npz", "<&- >&- 2>&-", 0, ""),
    "array data to a full stdout": ("decode FILE -o -", ">/dev/full", 1, "stdout: No space left on device"),
    "array data to a reader that goes": ("decode FILE -o -", "| true", 1, ""),
    "help to a full stdout": ("info --help", ">/dev/full", 1, "stdout: No space left on device"),
    "the list of verbs to a full stdout": ("--help", ">/dev/full", 1, "stdout: No space left on device"),
    "the version to a full stdout": ("info --version", ">/dev/full", 1, "stdout: No space left on device"),
    "a verb that is none, stderr closed": ("nothing", "2>&-", 2, ""),
}


def _run(arguments: str, streams: str, folder: Path) -> tuple[int, str]:
    """The exit code of a command and what it says on stderr."""
    script = f"{{ '{sys.executable}' -m pd4dgs_codec {arguments}; echo $? >'{folder}/code'; }} {streams}"
    command, nothing = ["sh", "-c", script], subprocess.DEVNULL
    done = subprocess.run(command, stdin=nothing, capture_output=True, text=True, timeout=120)
    return int((folder / "code").read_text()), done.stderr


@pytest.mark.parametrize("name", CASES)
def test_streams(name, scene_pd4, tmp_path):
    arguments, streams, code, says = CASES[name]
    arguments = arguments.replace("FILE", f"'{scene_pd4}'").replace("OUT", str(tmp_path / "out"))
    found, told = _run(arguments, streams, tmp_path)
    assert found == code, told
    assert says in told and "Traceback" not in told
    assert code == 0 or len(told.splitlines()) == bool(says)
    if "OUT" in CASES[name][0]:
        import numpy as np

        assert len(np.load(tmp_path / "out.npz").files) > 5


@pytest.mark.slow
@pytest.mark.parametrize("streams", [">&-", ">/dev/full", "| true", "<&- >&- 2>&-"])
@pytest.mark.parametrize("verb", VERBS)
def test_help_and_errors_of_every_command(verb, streams, tmp_path):
    for arguments in ("--help", f"none -o '{tmp_path}/none/out'"):
        code, told = _run(f"{verb} {arguments}", streams, tmp_path)
        assert code in (0, 1, 2) and "Traceback" not in told and len(told.splitlines()) < 2, told
        assert code or arguments == "--help"
