"""`pd4dgs-batch` from the command line: what it writes, says and returns."""

import json
import shutil

import pytest

from pd4dgs_codec import decode


@pytest.fixture
def manifest(tmp_path, model_pt, monkeypatch):
    """Writes lines to m.jsonl; models/a.pt and models/b.pt are there."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "models").mkdir()
    for name in "ab":
        shutil.copy(model_pt, tmp_path / "models" / f"{name}.pt")

    def write(*lines: object) -> str:
        (tmp_path / "m.jsonl").write_text("".join((x if isinstance(x, str) else json.dumps(x)) + "\n" for x in lines))
        return "m.jsonl"

    return write


def test_a_folder_is_scanned_and_encoded(cli, tmp_path, manifest, model_pt):
    assert cli("batch", "scan", "models", "-o", "m.jsonl").error_lines == ["2 scenes"]
    lines = [json.loads(line) for line in (tmp_path / "m.jsonl").read_text().splitlines()]
    assert lines == [{"source": f"models/{n}.pt", "output": f"{n}.pd4"} for n in "ab"]
    argv = ("batch", "m.jsonl", "--op", "encode", "-o", "out", "--workers", "0", "--json")
    done = cli(*argv)
    assert done.code == 0, done.err
    assert (done.json["done"], done.json["already"], done.json["failed"]) == (2, 0, 0)
    assert done.json["bytes"] == sum((tmp_path / "out" / f"{n}.pd4").stat().st_size for n in "ab")
    assert cli("encode", model_pt, "-o", "alone.pd4").code == 0
    assert (tmp_path / "out" / "a.pd4").read_bytes() == (tmp_path / "alone.pd4").read_bytes()
    assert cli(*argv).json["already"] == 2


def test_lines_that_fail_are_named_with_their_logs_and_the_others_go_on(cli, tmp_path, manifest):
    (tmp_path / "models" / "b.pt").write_text("not a checkpoint")
    lines = manifest(
        {"source": "models/a.pt", "options": {"effort": 1}},
        {"source": "models/b.pt"},
        {"source": "models/a.pt", "output": "c.pd4", "options": {"effort": 12}},
        "{broken",
        {"source": "models/a.pt", "output": "b.pd4"},
    )
    done = cli("batch", lines, "--op", "encode", "-o", "out", "--workers", "0", "--retries", "1", "--json")
    assert done.code == 1 and done.json["done"] == 1 and done.json["retried"] == 1
    rows = {row["line"]: row for row in done.json["failures"]}
    assert set(rows) == {2, 3, 4, 5} and len(done.error_lines) == 4
    assert "expected a .pd4 file or a pd4dgs-checkpoint" in rows[2]["message"] and "tried 2 times" in rows[2]["message"]
    assert "checkpoint" in (tmp_path / rows[2]["log"]).read_text()
    assert "--effort" in rows[3]["message"] and "invalid JSON" in rows[4]["message"] and "line 2" in rows[5]["message"]
    assert len(decode((tmp_path / "out" / "a.pd4").read_bytes()).layers) == 3
    assert not (tmp_path / "out" / "b.pd4").exists()


def test_what_an_earlier_batch_left_does_not_stand_for_a_need_that_failed(cli, tmp_path, manifest):
    lines = manifest(
        {"source": "models/a.pt", "options": {"slices": "50k"}, "needs": {"data": "base.pd4"}},
        {"source": "missing.pt", "output": "base.pd4"},
    )
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "base.pd4").write_text("of an earlier batch")
    done = cli("batch", lines, "--op", "encode", "-o", "out", "--workers", "0", "--json")
    assert [row["line"] for row in done.json["failures"]] == [2, 1] and done.json["failed"] == 2
    assert done.json["failures"][1]["message"] == "needs base.pd4, which failed"


@pytest.mark.parametrize(
    "op,options,message",
    [
        ("encode", {"views": 4}, "--views needs --data SOURCE"),
        ("encode", {"slices": "50k", "mode": "lzma"}, "slices in mode lzma, expected mode ans or one slice per layer"),
        ("prepare", {"fps": 10}, "--fps needs a folder of frames"),
        ("package", {"no-video": True, "fps": 10}, "--fps has no effect with --no-video"),
        ("train", {"rollout": "all", "key-instant": 0.5}, "--key-instant needs --rollout key"),
    ],
)
def test_options_without_effect_are_named_before_any_job(cli, tmp_path, manifest, op, options, message):
    lines = manifest({"source": "s3://missing/missing.mp4", "options": options})
    done = cli("batch", lines, "--op", op, "-o", "out", "--workers", "0", "--json")
    (row,) = done.json["failures"]
    assert done.code == 1 and row == {"line": 1, "output": None, "message": message, "log": None}


def test_evaluations_and_packages_of_many(cli, tmp_path, manifest, scene_pd4, shared_dataset):
    lines = manifest({"source": str(scene_pd4), "output": "x.json", "options": {"data": str(shared_dataset)}})
    done = cli("batch", lines, "--op", "eval", "-o", "scores", "--workers", "0")
    assert done.code == 0, done.err
    assert len(json.loads((tmp_path / "scores" / "x.json").read_text())["levels"]) == 3
    record = json.loads((tmp_path / "scores" / "x.json.done.json").read_text())
    assert set(record["inputs"]) == {"", "data"}
    lines = manifest({"source": str(scene_pd4), "output": "x", "options": {"no-video": True, "immutable": True}})
    assert cli("batch", lines, "--op", "package", "-o", "site", "--workers", "0").code == 0
    assert (tmp_path / "site" / "x" / "index.html").exists()
    assert cli("package", "site", "-o", "site").code == 0
    assert json.loads((tmp_path / "site" / "library.json").read_text())["scenes"][0]["name"] == "x"


def test_a_manifest_of_broken_lines_leaves_no_folder(cli, tmp_path, manifest):
    done = cli("batch", manifest("{broken"), "--op", "encode", "-o", "out", "--workers", "0")
    assert done.code == 1 and "line 1: invalid JSON" in done.err and not (tmp_path / "out").exists()


def test_a_store_that_refuses_ends_it_before_any_work(cli, tmp_path, manifest):
    (tmp_path / "taken").touch()
    done = cli("batch", manifest({"source": "models/a.pt"}), "--op", "encode", "-o", "taken", "--workers", "0")
    assert done.code == 1 and len(done.error_lines) == 1 and "taken" in done.err
