"""Outputs appear whole or not at all, flushed to the disk before they take their name."""

import errno
import os
import signal
import subprocess
import sys
from functools import partial
from itertools import count
from pathlib import Path
from unittest.mock import Mock

import pytest

from pd4dgs_codec import io
from pd4dgs_codec.errors import DataError
from pd4dgs_codec.prepare.stages import check_folder


def test_a_file_that_appears_meanwhile_is_not_replaced(tmp_path):
    target = tmp_path / "x.bin"
    with pytest.raises(DataError, match="exists already"), io.whole_file(target, False) as temporary:
        temporary.write_bytes(b"new")
        target.write_bytes(b"other")
    assert target.read_bytes() == b"other" and os.listdir(tmp_path) == ["x.bin"]


def test_files_appear_together_or_not_at_all(tmp_path):
    names = [str(tmp_path / "out" / f"{i}.png") for i in range(3)]
    with pytest.raises(RuntimeError), io.whole_files(names, False) as temporaries:
        temporaries[0].write_bytes(b"1")
        raise RuntimeError("in the middle")
    assert list(tmp_path.iterdir()) == []
    with io.whole_files(names, False) as temporaries:
        for temporary in temporaries:
            temporary.write_bytes(b"1")
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["0.png", "1.png", "2.png"]


@pytest.mark.parametrize("name", ["s3:", "s3:x", "s3:/x/y.pd4", "s3://x/y.pd4", "https://host/x.pd4", "Ftp:/x", "x.y:"])
def test_a_uri_is_no_output(tmp_path, monkeypatch, name):
    """`s3:` became the name of a folder."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(DataError, match="looks like a URI"):
        io.write_bytes(name, b"", False)
    with pytest.raises(DataError, match="looks like a URI"), io.whole_files([f"{name}/1.png"], False):
        pass
    with pytest.raises(DataError, match="looks like a URI"):
        check_folder(Path(name), False)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["12:30.pd4", "run:2.pd4", "c:", "./s3:"])
def test_a_name_with_a_colon_is_an_output(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    io.write_bytes(name, b"1", False)
    assert Path(name).read_bytes() == b"1"


def test_bytes_reach_the_disk_before_the_name(tmp_path, monkeypatch):
    events = []
    fsync, replace = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda file: (events.append(os.fstat(file).st_size), fsync(file)))
    monkeypatch.setattr(os, "replace", lambda *paths: (events.append(paths[1].name), replace(*paths)))
    io.write_bytes(tmp_path / "x.bin", b"12345", overwrite=False)
    assert events == [5, "x.bin"] and (tmp_path / "x.bin").read_bytes() == b"12345"


@pytest.mark.skipif(os.name != "posix", reason="links and devices")
def test_a_link_stays_one_and_a_device_is_written_to(tmp_path):
    (tmp_path / "x.bin").write_bytes(b"old")
    (tmp_path / "link").symlink_to("x.bin")
    io.write_bytes(tmp_path / "link", b"new", overwrite=True)
    assert (tmp_path / "link").is_symlink() and (tmp_path / "x.bin").read_bytes() == b"new"
    io.write_bytes("/dev/null", b"gone", overwrite=False)
    assert not os.path.isfile("/dev/null")
    if os.path.exists("/dev/full"):
        with pytest.raises(OSError) as caught:
            io.write_bytes("/dev/full", b"new", overwrite=False)
        assert caught.value.filename == "/dev/full"


@pytest.mark.skipif(os.name != "posix", reason="modes")
@pytest.mark.parametrize("mode", [0o600, 0o640, 0o755])
def test_an_output_keeps_its_mode(tmp_path, mode):
    names = [str(tmp_path / "a"), str(tmp_path / "b")]
    for name in names:
        open(name, "w").close()
        os.chmod(name, mode)
    io.write_bytes(names[0], b"new", overwrite=True)
    with io.whole_files(names, True) as temporaries:
        for temporary in temporaries:
            temporary.write_bytes(b"new")
    assert [os.stat(name).st_mode & 0o777 for name in names] == [mode] * 2


def test_leftovers_of_a_killed_process_are_found_by_the_file_they_hold(tmp_path):
    mine = tmp_path / ".pd4dgs-ab_3xyz9" / "m.pt"
    others = [tmp_path / name for name in ("m.pt", ".pd4dgs-cd_3xyz9/other.pt", "folder/m.pt")]
    for file in (mine, *others):
        file.parent.mkdir(exist_ok=True)
        file.write_bytes(b"x")
    io.remove_leftovers(tmp_path / "m.pt")
    assert not mine.parent.exists() and all(file.exists() for file in others)


@pytest.mark.skipif(os.name != "posix", reason="needs processes that can be asked for")
def test_what_another_process_is_writing_is_no_leftover(tmp_path):
    """A second run on one output removed the folder into which the first was saving."""
    with io.whole_file(tmp_path / "m.pt", False) as temporary:
        temporary.write_bytes(b"first")
        io.remove_leftovers(tmp_path / "m.pt")
    assert (tmp_path / "m.pt").read_bytes() == b"first"
    ended = subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, check=True)
    for number in (int(ended.stdout), 10**30):
        left = tmp_path / f"{io.PREFIX}{number}-abc" / "m.pt"
        left.parent.mkdir()
        left.write_bytes(b"x")
        io.remove_leftovers(tmp_path / "m.pt")
        assert not left.parent.exists()


def test_of_two_writers_of_new_files_one_succeeds(tmp_path):
    names = [str(tmp_path / "out" / f"{i}.png") for i in range(2)]
    with pytest.raises(DataError, match="exists already"), io.whole_files(names, False) as late:
        with io.whole_files(names, False) as early:
            for temporary in early:
                temporary.write_bytes(b"early")
        for temporary in late:
            temporary.write_bytes(b"late")
    assert [Path(name).read_bytes() for name in names] == [b"early"] * 2 and os.listdir(tmp_path) == ["out"]


#: What a save asks of the system, as far as it can be cut short between two of them.
STEPS = {"open", "write", "fsync", "replace", "mkdir", "rmdir", "unlink", "close", "flush", "fileno", "stat", "lstat"}


def _calls_of_the_system(act, save):
    """Calls save(), and act(number) before each call of a built-in function in STEPS."""
    numbers = count(1)

    def see(frame, event, function):
        if event == "c_call" and function.__name__ in STEPS:
            act(next(numbers))

    sys.setprofile(see)
    try:
        save()
    finally:
        sys.setprofile(None)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork and SIGKILL")
def test_a_process_killed_at_any_call_leaves_the_old_file_or_the_new_one(tmp_path):
    target, old, new = tmp_path / "x.bin", b"old" * 9000, b"new" * 9001
    left = set()
    for last in count(1):
        io.write_bytes(target, old, overwrite=True)
        process = os.fork()
        if not process:  # the child: it ends by the signal or, if it is not killed, without pytest's clearing up
            kill = partial(os.kill, os.getpid(), signal.SIGKILL)
            _calls_of_the_system(
                lambda number, last=last, kill=kill: kill() if number == last else None,
                lambda: io.write_bytes(target, new, overwrite=True),
            )
            os._exit(0)
        _, status = os.waitpid(process, 0)
        if os.WIFEXITED(status):  # all of its calls were made
            break
        assert os.WTERMSIG(status) == signal.SIGKILL
        assert target.read_bytes() in (old, new)
        left.add(target.read_bytes())
        io.remove_leftovers(target)
    assert left == {old, new} and last > 8 and target.read_bytes() == new


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO, errno.EDQUOT])
@pytest.mark.parametrize("name", ["fsync", "replace", "mkdir"])
def test_a_call_that_fails_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch, name, code):
    target = tmp_path / "x.bin"
    target.write_bytes(b"old")
    monkeypatch.setattr(os, name, Mock(side_effect=OSError(code, os.strerror(code), "a name that nobody knows")))
    with pytest.raises(OSError, match=os.strerror(code)) as caught:
        io.write_bytes(target, b"new", overwrite=True)
    monkeypatch.undo()
    assert caught.value.filename == str(target)
    assert target.read_bytes() == b"old" and os.listdir(tmp_path) == ["x.bin"]
