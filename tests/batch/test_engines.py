"""The engines: dying and slow workers, failing stores, equal outputs."""

import json
import random
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from pd4dgs_codec.batch.run import Settings, Slurm, _follow_parent
from pd4dgs_codec.batch.store import Root
from pd4dgs_codec.errors import DataError
from pd4dgs_codec.io import temporary_folder

TEXTS = {f"{n}.pt": f"text {n}" for n in range(8)}


def _outputs(library) -> dict[str, str]:
    return {path.name: path.read_text() for path in library.out.glob("*.pd4")}


WANTED = {f"{n}.pd4": f"TEXT {n}" for n in range(8)}


@pytest.fixture
def filled(library):
    for name, text in TEXTS.items():
        library.add(name, text)
    return library


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    """The folder for temporary files. At the end it must be empty."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setenv("TMPDIR", str(folder))
    monkeypatch.setattr("tempfile.tempdir", None)
    yield folder
    assert list(folder.iterdir()) == []


def test_a_pool_makes_what_one_process_makes(filled):
    assert filled.run(workers=2)["done"] == 8
    assert _outputs(filled) == WANTED and filled.made() == sorted(TEXTS.values())
    assert filled.run(workers=2)["already"] == 8 and len(filled.made()) == 8


def test_a_job_whose_worker_dies_is_tried_again(filled, temporary):
    filled.add("z.pt", f"die {filled.folder}/flag")
    summary = filled.run(workers=2)
    assert (summary["done"], summary["retried"]) == (9, 1)
    assert len(filled.made()) == 9


@pytest.mark.parametrize("text, tries, says", [("die", 2, "worker"), ("die no-such-folder/flag", 1, "no-such-folder")])
def test_a_job_that_always_kills_its_worker_or_raises_is_named(filled, temporary, text, tries, says):
    """Making a flag in a missing folder raises an error."""
    filled.add("z.pt", text)
    assert filled.run(workers=1, retries=1)["done"] == 8
    outcome, found = filled.outcomes["z.pd4"]
    assert outcome.state == "failed" and found == tries and says in outcome.message


def test_slow_job_is_ended_and_tried_again(filled, temporary):
    filled.add("z.pt", f"dawdle {filled.folder}/flag")
    summary = filled.run(workers=2, timeout=5.0)
    assert summary["done"] == 9 and summary["retried"] >= 1


def test_timed_out_job_names_its_limit(library):
    for n in range(2):
        library.add(f"{n}.pt", f"dawdle {library.folder}/flag{n}")
    summary = library.run(workers=2, timeout=0.5, retries=0)
    assert summary["done"] == 0
    assert "0.5 s" in library.outcomes["0.pd4"][0].message


def test_workers_end_with_a_parent_that_was_killed(filled, tmp_path, temporary):
    """A killed batch leaves no process behind, and the next one finishes what is left."""
    filled.add("a.pt", f"dawdle {filled.folder}/flag")
    program = (
        "from pathlib import Path\nimport conftest\n"
        "if __name__ == '__main__':\n"
        f"    library = conftest.Library(Path({str(filled.folder)!r}))\n"
        f"    library.lines = {filled.lines!r}\n"
        "    library.run(workers=1)\n"
    )
    path = tmp_path / "batch.py"
    path.write_text(program)
    process = subprocess.Popen([sys.executable, str(path)])
    while not (filled.folder / "flag").exists():
        assert process.poll() is None
        time.sleep(0.05)
    (children,) = [p.read_text().split() for p in Path(f"/proc/{process.pid}/task").glob("*/children") if p.read_text()]
    process.kill()
    process.wait()
    for child in children:
        for _ in range(200):
            if not Path(f"/proc/{child}").exists():
                break
            time.sleep(0.05)
        else:
            pytest.fail("a worker outlived its parent")
    before = len(filled.made())
    summary = filled.run(workers=1)
    assert summary["already"] == before and summary["done"] == 9 - before and len(filled.made()) == 9


def test_a_worker_whose_parent_is_gone_removes_what_it_was_writing(tmp_path, monkeypatch):
    ended = threading.Event()
    monkeypatch.setattr("multiprocessing.parent_process", lambda: SimpleNamespace(join=lambda: None))
    monkeypatch.setattr("os._exit", lambda code: ended.set())
    monkeypatch.setattr("signal.signal", lambda *_: None)
    monkeypatch.setattr("tempfile.tempdir", None)
    with temporary_folder(tmp_path) as folder:
        _follow_parent(str(tmp_path / "own"))
        assert ended.wait(60) and not folder.exists()


def test_a_store_that_fails_now_and_then_gets_every_output_once(filled, monkeypatch):
    """A tenth of the calls fail, before they do anything or after, as if the answer was lost."""
    from fsspec.implementations.memory import MemoryFileSystem

    rng = random.Random(1)

    def flaky(name: str):
        whole = getattr(MemoryFileSystem, name)

        def call(*args, **named):
            fails, before = rng.random() < 0.1, rng.random() < 0.5
            if fails and before:
                raise OSError("the store is busy")
            result = whole(*args, **named)
            if fails:
                raise OSError("the store gave no answer")
            return result

        return call

    for name in ("info", "cat_file", "pipe_file"):
        monkeypatch.setattr(MemoryFileSystem, name, flaky(name))
    summary = filled.run(root="memory://flaky", retries=5)
    assert summary["done"] + summary["already"] == 8 and summary["retried"] > 0
    assert filled.run(root="memory://flaky", retries=5)["already"] == 8
    monkeypatch.undo()
    store = MemoryFileSystem()
    assert {name: store.cat_file(f"/flaky/{name}").decode() for name in WANTED} == WANTED


def test_slurm_jobs_by_the_local_executor_of_submitit(library):
    pytest.importorskip("submitit", reason="needs submitit (the extra `cluster`)")
    library.add("a.pt", "text")
    library.add("b.pt", "bad")
    library.add("c.pt", f"die {library.folder}/flag")
    folder, slurm = library.folder / "slurm", {"cluster": "local"}
    summary = library.run("slurm", workers=3, retries=1, folder=folder, slurm=slurm)
    assert summary["done"] == 2
    assert library.outcomes["b.pd4"][0].message.endswith("never")
    assert library.outcomes["c.pd4"][1] == 2


def test_slurm_gets_whole_minutes_and_gpus_that_suffice(monkeypatch):
    told: dict[str, Any] = {}
    executor = SimpleNamespace(update_parameters=lambda **parameters: told.update(parameters))
    stub = SimpleNamespace(AutoExecutor=lambda **_: executor)
    monkeypatch.setitem(sys.modules, "submitit", stub)
    Slurm(lambda job: None, Settings(1, timeout=150, gpus=0.5))
    assert (told["timeout_min"], told["gpus_per_node"]) == (3, 1)


def test_parameters_that_submitit_does_not_know_are_named(library):
    pytest.importorskip("submitit", reason="needs submitit (the extra `cluster`)")
    library.add("a.pt", "text")
    with pytest.raises(DataError, match="submitit.*colour"):
        library.run("slurm", workers=1, slurm={"cluster": "local", "colour": "red"}, folder=library.folder / "slurm")


@pytest.fixture
def ray_cluster(monkeypatch):
    ray = pytest.importorskip("ray", reason="needs ray (the extra `cluster`)")
    monkeypatch.setenv("RAY_ENABLE_UV_RUN_RUNTIME_ENV", "0")
    yield ray
    ray.shutdown()


def test_ray_makes_what_one_process_makes_though_a_worker_dies(filled, ray_cluster, capsys):
    filled.add("z.pt", f"die {filled.folder}/flag")
    filled.add("bad.pt", "bad")
    summary = filled.run("ray", workers=2, retries=1, address="local")
    assert summary["done"] == 9 and filled.outcomes["z.pd4"][1] == 2 and filled.outcomes["bad.pd4"][1] == 2
    assert {name: text for name, text in _outputs(filled).items() if name in WANTED} == WANTED
    assert filled.run("ray", workers=2, retries=0, address="local")["already"] == 9
    with pytest.raises(DataError, match="no node .* with the 999 CPU"):
        filled.run("ray", address="local", threads=999)
    assert capsys.readouterr().out == ""  # where Ray tells of workers that died


def test_a_cluster_that_is_not_there_is_named(filled, ray_cluster):
    with pytest.raises(DataError, match="127.0.0.1:1"):
        filled.run("ray", address="127.0.0.1:1")
    assert filled.made() == []


def test_outputs_on_an_s3_server(filled, monkeypatch):
    pytest.importorskip("s3fs", reason="needs s3fs (the extra `cluster`)")
    moto = pytest.importorskip("moto.server", reason="needs moto[server]")
    server = moto.ThreadedMotoServer("127.0.0.1", port=0)
    server.start()
    host, port = server.get_host_and_port()
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "test")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    try:
        import s3fs

        s3 = s3fs.S3FileSystem()
        s3.mkdir("library")
        s3.pipe_file("library/in/s.pt", b"from s3")
        filled.lines.append(json.dumps({"source": "s3://library/in/s.pt"}))
        assert filled.run(workers=2, root="s3://library/out")["done"] == 9
        s3.invalidate_cache()
        found = {n.rpartition("/")[2]: s3.cat_file(n).decode() for n in s3.find("library/out") if n.endswith(".pd4")}
        assert found == WANTED | {"s.pd4": "FROM S3"}
        assert filled.run(workers=2, root="s3://library/out")["already"] == 9
        with pytest.raises(DataError, match="nowhere"):
            Root("s3://nowhere/out").check()
    finally:
        server.stop()
