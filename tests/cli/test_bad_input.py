"""Bad input: one line on stderr, exit 1, no traceback, nothing left behind, and nothing in the input is run."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch


def _listing(folder: Path) -> dict[str, int]:
    return {str(p.relative_to(folder)): p.stat().st_size for p in sorted(folder.rglob("*"))}


@pytest.fixture
def fails(cli, tmp_path):
    """fails(verb, *argv, says=...): the command must fail cleanly, with and without --json."""

    def check(verb: str, *argv: object, says: str = "", stdin: bytes | None = None):
        before = _listing(tmp_path)
        plain = cli(verb, *argv, stdin=stdin)
        assert plain.code == 1 and plain.out == b""
        assert len(plain.error_lines) == 1, plain.err
        assert plain.err.startswith(f"pd4dgs-{verb}: error: ") and "internal error" not in plain.err
        assert says in plain.err
        told = cli(verb, *argv, "--json", stdin=stdin)
        assert told.code == 1 and len(told.error_lines) == 1
        error = told.json["error"]
        assert error["message"] in told.err and error["type"]
        assert _listing(tmp_path) == before
        return error

    return check


# -- datasets ----------------------------------------------------------------------------------------------------------


def test_train_on_a_broken_dataset(fails, dataset, tmp_path):
    """All that can be broken is tested with the readers."""
    (dataset / "001.png").unlink()
    fails("train", dataset, "-o", tmp_path / "m.pt", "--iterations", 3, "--log", tmp_path / "log.jsonl", says="001")


@pytest.mark.parametrize("verb", ["train", "eval", "render"])
@pytest.mark.parametrize("source", ["missing", "empty", "file", "synthetic:nothing"])
def test_sources_that_are_no_dataset(fails, scene_pd4, tmp_path, verb, source):
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("not a folder")
    place = source if ":" in source else tmp_path / source
    argv = {
        "train": [place, "-o", tmp_path / "m.pt"],
        "eval": [scene_pd4, place],
        "render": [scene_pd4, "-o", tmp_path / "a.gif", "--data", place],
    }[verb]
    fails(verb, *argv, says=source)


# -- checkpoints -------------------------------------------------------------------------------------------------------


class _Payload:
    """Pickles as a call that creates a file."""

    def __init__(self, target: Path):
        self.target = target

    def __reduce__(self):
        return os.mkdir, (str(self.target),)


def _poisoned(path: Path, model_pt: Path, value: float) -> None:
    content = torch.load(model_pt, weights_only=True)
    del content["digest"]  # as one of an older release
    content["state"]["feature"][3, 2] = value
    torch.save(content, path)


CHECKPOINT_USERS = {
    "encode": lambda path, out: [path, "-o", out / "s.pd4"],
    "render": lambda path, out: [path, "-o", out / "a.gif"],
    "eval": lambda path, out: [path, "synthetic:static"],
    "train": lambda path, out: ["synthetic:static", "-o", out / "m.pt", "--resume", path],
}


@pytest.fixture(autouse=True)
def _quick_dataset(monkeypatch, shared_dataset):
    """`synthetic:static` takes seconds to make; the faults here lie elsewhere."""
    from pd4dgs_codec.data import dataset
    from pd4dgs_codec.interchange import teacher

    real = dataset.load

    def load(source, **options):
        return real(shared_dataset if source == "synthetic:static" else source, **options)

    for module in (dataset, teacher):  # the second has a name of its own for it
        monkeypatch.setattr(module, "load", load)


@pytest.mark.parametrize("verb", CHECKPOINT_USERS)
def test_a_pickle_that_wants_to_run_code_is_refused_unrun(fails, tmp_path, verb):
    trap = tmp_path / "ran"
    path = tmp_path / "evil.pt"
    torch.save({"format": "pd4dgs-checkpoint", "version": 1, "state": _Payload(trap)}, path)
    fails(verb, *CHECKPOINT_USERS[verb](path, tmp_path), says="evil.pt")
    assert not trap.exists()


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_checkpoint_with_a_number_that_is_not_finite(fails, model_pt, tmp_path, value):
    _poisoned(tmp_path / "bad.pt", model_pt, value)
    fails("encode", tmp_path / "bad.pt", "-o", tmp_path / "s.pd4", says="feature")


def test_a_cut_checkpoint(fails, model_pt, tmp_path):
    (tmp_path / "bad.pt").write_bytes(model_pt.read_bytes()[:-200])
    fails("encode", tmp_path / "bad.pt", "-o", tmp_path / "s.pd4", says="bad.pt")


@pytest.mark.parametrize("verb", ["encode", "decode", "info", "render", "eval"])
def test_missing_input_is_named(fails, tmp_path, verb):
    argv = {
        "encode": ["-o", tmp_path / "s.pd4"],
        "decode": ["-o", tmp_path / "s.npz"],
        "info": [],
        "render": ["-o", tmp_path / "a.gif"],
        "eval": ["synthetic:static"],
    }[verb]
    fails(verb, tmp_path / "absent", *argv, says="absent")


# -- .pd4 files --------------------------------------------------------------------------------------------------------


def _flip(data: bytes, at: int) -> bytes:
    return data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :]


PD4_FAULTS = {
    "empty": (lambda d: b"", "Truncated"),
    "signature only": (lambda d: d[:8], "Truncated"),
    "cut": (lambda d: d[:-1], "Truncated"),
    "not ours": (lambda d: b"PK\x03\x04" + d, "BadSignature"),
    "header bit": (lambda d: _flip(d, 30), "ChecksumMismatch"),
    "payload bit": (lambda d: _flip(d, len(d) // 2), "ChecksumMismatch"),
    "more behind": (lambda d: d + b"x", "Malformed"),
}


@pytest.mark.parametrize("fault", PD4_FAULTS)
def test_damaged_pd4(fails, scene_pd4, tmp_path, fault):
    damage, kind = PD4_FAULTS[fault]
    path = tmp_path / "bad.pd4"
    path.write_bytes(damage(scene_pd4.read_bytes()))
    error = fails("decode", path, "-o", tmp_path / "s.npz", says="bad.pd4")
    assert error["type"] == kind
    assert fails("info", path, "--check", says="bad.pd4")["type"] == kind
    assert fails("decode", "-", says="stdin", stdin=path.read_bytes())["type"] == kind


def test_decode_error_states_its_offset(fails, scene_pd4, tmp_path):
    data = scene_pd4.read_bytes()
    (tmp_path / "bad.pd4").write_bytes(data + b"x")
    assert fails("decode", tmp_path / "bad.pd4")["offset"] == len(data)


@pytest.mark.parametrize("verb", ["render", "eval"])
def test_viewers_refuse_a_damaged_pd4(fails, scene_pd4, tmp_path, verb):
    (tmp_path / "bad.pd4").write_bytes(_flip(scene_pd4.read_bytes(), 400))
    argv = ["-o", tmp_path / "a.gif"] if verb == "render" else ["synthetic:static"]
    fails(verb, tmp_path / "bad.pd4", *argv, says="bad.pd4")


# -- outputs -----------------------------------------------------------------------------------------------------------

WRITERS = {
    "encode": lambda model, scene, out: [model, "-o", out, "--effort", 1],
    "decode": lambda model, scene, out: [scene, "-o", out.with_suffix(".npz")],
    "render": lambda model, scene, out: [scene, "-o", out.with_suffix(".gif"), "--frames", 2],
}


@pytest.mark.parametrize("verb", [*WRITERS, "train"])
def test_an_output_that_exists_is_refused_before_any_work(fails, tmp_path, monkeypatch, verb):
    output = tmp_path / "out.npz"
    if verb in ("render", "train"):
        output = tmp_path / ("out.gif" if verb == "render" else "out.pt")
    output.write_bytes(b"precious")
    argv = ["synthetic:static", "-o", output] if verb == "train" else ["absent.pt", "-o", output]
    fails(verb, *argv, says="exists already")  # and not "absent.pt": the output was looked at first
    assert output.read_bytes() == b"precious"


@pytest.mark.parametrize("verb", WRITERS)
def test_full_disk_leaves_nothing(fails, model_pt, scene_pd4, tmp_path, monkeypatch, verb):
    replace = os.replace

    def full(source, target, **options):
        if str(tmp_path) in str(target):  # numba puts its compiled kernels into place in the same way
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        replace(source, target, **options)

    monkeypatch.setattr("os.replace", full)
    argv = WRITERS[verb](model_pt, scene_pd4, tmp_path / "out.pd4")
    error = fails(verb, *argv, says="No space left")
    assert str(argv[2]) in error["message"]


@pytest.mark.parametrize("kind", ["npz", "pt"])
def test_disk_full_while_writing_leaves_nothing(fails, scene_pd4, tmp_path, monkeypatch, kind):
    def full(*_args, **_kwargs):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("pathlib.Path.write_bytes", full)
    monkeypatch.setattr("torch.save", full)
    error = fails("decode", scene_pd4, "-o", tmp_path / f"out.{kind}", says="No space left")
    assert error["message"].startswith(str(tmp_path / f"out.{kind}"))


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="this system has no /dev/full")
@pytest.mark.parametrize("verb", ["info", "encode"])
def test_full_stdout(scene_pd4, verb):
    argv = [verb, str(scene_pd4)] + (["-o", "-", "--effort", "1"] if verb == "encode" else [])
    with open("/dev/full", "wb") as full:
        done = subprocess.run(
            [sys.executable, "-m", "pd4dgs_codec", *argv], stdout=full, stderr=subprocess.PIPE, text=True, timeout=60
        )
    assert done.returncode == 1
    assert len(done.stderr.splitlines()) == 1 and "No space left" in done.stderr


def test_reader_that_goes_away(scene_pd4):
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run(
        [sys.executable, "-m", "pd4dgs_codec", "info", str(scene_pd4)], stdout=write, stderr=subprocess.PIPE, timeout=60
    )
    os.close(write)
    assert done.returncode == 1 and done.stderr == b""


def test_output_folder_is_missing_or_not_writable(fails, model_pt, tmp_path, monkeypatch):
    fails("encode", model_pt, "-o", tmp_path / "nowhere" / "s.pd4", says="nowhere")
    fails("encode", model_pt, "-o", tmp_path, says="is a folder")
    monkeypatch.setattr("os.access", lambda path, mode: False)
    fails("encode", model_pt, "-o", tmp_path / "s.pd4", says="no permission")


def test_folder_that_refuses_new_files(fails, scene_pd4, tmp_path, monkeypatch):
    def refuse(**_kwargs):
        raise PermissionError(errno.EACCES, "Permission denied", "/some/temporary/name")

    monkeypatch.setattr("tempfile.mkdtemp", refuse)
    error = fails("decode", scene_pd4, "-o", tmp_path / "s.npz", says="Permission denied")
    assert "temporary" not in error["message"]
    error = fails("render", scene_pd4, "-o", tmp_path / "p" / "%02d.png", "--frames", 1, says="Permission denied")
    assert "temporary" not in error["message"]


def test_render_without_a_camera_says_what_to_do(fails, scene, tmp_path):
    from dataclasses import replace

    from pd4dgs_codec.format.encoder import encode

    (tmp_path / "s.pd4").write_bytes(encode(replace(scene, info=replace(scene.info, camera=None)), effort=1))
    fails("render", tmp_path / "s.pd4", "-o", tmp_path / "a.gif", says="--data")


def test_too_many_threads(fails, scene_pd4, tmp_path):
    fails("render", scene_pd4, "-o", tmp_path / "a.gif", "--threads", 100_000, says="100000")


def test_scene_that_is_too_large_for_its_symbols(fails, model_pt, tmp_path):
    content = torch.load(model_pt, weights_only=True)
    del content["digest"]  # as one of an older release
    content["state"]["feature"][0, 0] = 1e20
    torch.save(content, tmp_path / "big.pt")
    fails("encode", tmp_path / "big.pt", "-o", tmp_path / "s.pd4", says="feature")
