"""A batch in this process: records, finished work, broken lines, options and scans."""

import json
import os
from pathlib import Path
from unittest.mock import Mock

import pytest

from pd4dgs_codec import __version__
from pd4dgs_codec.batch import store
from pd4dgs_codec.batch.job import OPS, Job, Line, arguments, default_output, read_manifest, run_job, scan
from pd4dgs_codec.errors import DataError


def test_outputs_have_a_record_and_are_not_done_twice(library):
    for name in ("a.pt", "b.pt"):
        library.add(name, f"text of {name}", options={"effort": 1})
    first, second = library.run(), library.run()
    assert (first["done"], first["already"], second["done"], second["already"]) == (2, 0, 0, 2)
    assert (library.out / "a.pd4").read_text() == "TEXT OF A.PT"
    record = json.loads((library.out / "a.pd4.done.json").read_text())
    assert record["version"] == __version__ and record["report"] == {"bytes": 12}
    assert record["op"] == "encode" and record["options"] == {"effort": 1} and set(record["inputs"]) == {""}
    assert record["files"][""]["bytes"] == 12
    assert library.made() == ["text of a.pt", "text of b.pt"]


@pytest.mark.parametrize("left", ["no record", "a truncated output"])
def test_what_a_killed_run_left_is_made_again(library, left):
    library.add("a.pt", "text")
    library.run()
    if left == "no record":  # killed between the file and its record
        (library.out / "a.pd4.done.json").unlink()
    else:
        (library.out / "a.pd4").write_text("TE")
    assert library.run()["done"] == 1 and (library.out / "a.pd4").read_text() == "TEXT"
    assert (library.out / "a.pd4.done.json").exists()


def test_foreign_files_stay_without_overwrite(library):
    library.add("a.pt", "text")
    library.out.mkdir()
    (library.out / "a.pd4").write_text("mine")
    assert library.run()["done"] == 0
    assert "--overwrite" in library.outcomes["a.pd4"][0].message and (library.out / "a.pd4").read_text() == "mine"
    assert library.run(overwrite=True)["done"] == 1 and (library.out / "a.pd4").read_text() == "TEXT"


@pytest.mark.parametrize("change", ["source", "options", "version"])
def test_output_of_other_input_is_refused_and_the_others_go_on(library, change):
    library.add("a.pt", "text")
    library.run()
    if change == "source":
        (library.folder / "in" / "a.pt").write_text("other")
    elif change == "options":
        library.lines[0] = library.lines[0].replace("}", ', "options": {"effort": 1}}')
    else:
        path = library.out / "a.pd4.done.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | {"version": "0.0.1"}))
    library.add("b.pt", "more")
    assert library.run()["done"] == 1
    outcome, tries = library.outcomes["a.pd4"]
    assert outcome.final and tries == 1 and "--overwrite" in outcome.message
    assert ("0.0.1" in outcome.message) == (change == "version")
    assert library.run(overwrite=True)["done"] == 1


def test_a_worker_of_another_version_refuses(library):
    library.add("a.pt", "text")
    assert library.run(version="9.9")["done"] == 0
    assert "9.9" in library.outcomes["a.pd4"][0].message and __version__ in library.outcomes["a.pd4"][0].message


def test_failures_are_tried_again_within_a_bound(library):
    library.add("a.pt", f"fail {library.folder}/flag")
    library.add("b.pt", "bad")
    library.add("c.pt", "wrong")
    library.add("d.pt", "fine")
    summary = library.run(retries=1)
    tries = {output: (outcome.state, count) for output, (outcome, count) in library.outcomes.items()}
    assert tries == {"a.pd4": ("done", 2), "b.pd4": ("failed", 2), "c.pd4": ("failed", 1), "d.pd4": ("done", 1)}
    assert summary["retried"] == 2
    assert library.outcomes["b.pd4"][0].message == "pd4dgs-encode: error: never"
    assert library.outcomes["b.pd4"][0].log.startswith("a long story")


LINES = [
    ("{", "invalid JSON: Expecting property name enclosed in double quotes at character 2"),
    ("nonsense", "at character 1"),
    ("[1]", "found list"),
    ('{"source": "a.pt", "colour": 1}', "colour"),
    ('{"source": ""}', "found source ''"),
    ('{"source": 3}', "found source 3"),
    ('{"source": "a.pt", "options": []}', "options"),
    ('{"source": "a.pt", "output": "../x.pd4"}', "../x.pd4"),
    ('{"source": "a.pt", "output": "/x.pd4"}', "/x.pd4"),
    ('{"source": "a.pt", "output": "x.done.json"}', "x.done.json"),
    ('{"source": "nowhere://a.pt"}', "nowhere"),
    ('{"source": "a.pt", "options": {"data": 5}}', "found 5, expected a path"),
    ('{"source": "a.pt", "options": {"data": [["x"]]}}', "expected a path"),
    ('{"source": "a.pt", "options": {"data": ""}}', "expected a path"),
    ("[" * 100_000, "invalid JSON"),
    ('{"source": 1' + "0" * 5000 + "}", "invalid JSON"),
    ('{"source": "a.pt", "output": "\x1b[2J"}', "invalid JSON"),
    ('{"source": "a.pt", "output": "\\u001b[2J"}', "found output"),
    ('{"source": "a.pt", "output": "\\ud800"}', "found output"),
    ('{"source": "ssh2://a.pt"}', "ssh2"),
]


@pytest.mark.parametrize(("line", "what"), LINES)
def test_a_broken_line_is_named_and_the_others_go_on(library, line, what):
    library.lines.append(line)
    library.add("b.pt", "fine")
    _, ((number, message),) = library.manifest()
    assert number == 1 and what in message
    assert library.run()["done"] == 1


@pytest.mark.parametrize(
    "needs",
    [
        {"a.pd4": "none.pd4"},
        {"a.pd4": "a.pd4"},
        {"a.pd4": "c.pd4", "c.pd4": "a.pd4"},
        {"a.pd4": "c.pd4", "c.pd4": "b.pd4"},
    ],
)
def test_only_outputs_of_lines_that_need_nothing_can_be_needed(library, needs):
    """Not one that is missing, the line's own, or of a cycle or a chain: the lines run at one time."""
    for name in ("a", "b", "c"):
        need = needs.get(f"{name}.pd4")
        library.add(f"{name}.pt", "fine", **({"needs": {"data": need}} if need else {}))
    lines, faults = library.manifest()
    chained = {"b.pd4"} & set(needs.values())
    assert {line.output for line in lines} == {"a.pd4", "b.pd4", "c.pd4"} - set(needs) | (
        {"c.pd4"} if chained else set()
    )
    number, message = faults[0]
    assert number == 1 and f"found needs of {needs['a.pd4']!r}" in message


STORES = ("dir:///", "reference://", "zip://none.zip", "sftp://127.0.0.1:9/x", "simplecache::none", "\0", "a\ud800b")


@pytest.mark.parametrize("place", [*STORES, "file://" + "x" * 5000])
@pytest.mark.parametrize("key", ["source", "data"])
def test_a_place_that_no_store_has_is_a_failure_of_its_line_alone(library, place, key):
    library.add("a.pt", "first", options={"data": place} if key == "data" else {})
    if key == "source":
        library.lines[0] = json.dumps({"source": place, "output": "a.pd4"})
    library.add("b.pt", "fine")
    _, faults = library.manifest()
    assert library.run(retries=0)["done"] == 1 and (library.out / "b.pd4").read_text() == "FINE"
    said = faults[0][1] if faults else library.outcomes["a.pd4"][0].message
    assert said.isprintable() and said


@pytest.mark.parametrize("place", STORES)
def test_a_place_that_no_store_has_holds_no_manifest(place):
    with pytest.raises((DataError, OSError)):
        read_manifest(place, OPS["encode"], lambda source, options: None)


@pytest.mark.parametrize(
    "place", ["dir:///", "reference://", "github://", "", "file:", "file://", "file://host/x", "s3:", "s3:/x", "s3:x"]
)
def test_a_place_that_no_store_has_takes_no_output(place, tmp_path, monkeypatch):
    """The last slashes belong to a place: without them a URI would name a folder, and / the working folder."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(DataError) as caught:
        store.Root(place).check()
    assert str(caught.value).isprintable() and not list(tmp_path.iterdir())
    root, memory, folder = map(store.Root, ("/", "memory://", f"file://{tmp_path}/"))
    assert (root.path, memory.local, folder.local) == ("/", False, True)


def test_what_no_check_foresaw_is_a_failure_of_its_line_alone(library):
    def check(source, options):
        if options:
            raise ZeroDivisionError("never\n\x1b[2J")

    library.add("a.pt", "first", options={"effort": 1})
    library.add("b.pt", "fine")
    library.manifest()
    lines, faults = read_manifest(str(library.folder / "m.jsonl"), OPS["encode"], check)
    assert faults == [(1, "ZeroDivisionError: never \\x1b[2J")] and [line.number for line in lines] == [2]


def test_two_lines_with_one_output_are_named(library):
    library.add("a.pt", "first", output="x.pd4")
    library.add("b.pt", "second", output="x.pd4")
    _, ((number, message),) = library.manifest()
    assert number == 2 and "'x.pd4'" in message and "line 1" in message
    assert library.run()["done"] == 1 and (library.out / "x.pd4").read_text() == "FIRST"


@pytest.mark.parametrize(
    "put, says",
    [
        (lambda path: None, "a.pt: No such file"),
        (os.mkfifo, "a.pt: is a pipe or a device, expected a file"),
        (lambda path: path.symlink_to("/dev/zero"), "a.pt: is a pipe or a device, expected a file"),
    ],
    ids=["nothing", "pipe", "device"],
)
def test_a_source_that_is_not_there_or_for_which_a_reader_would_wait_is_named(library, put, says):
    library.add("a.pt", "x")
    (library.folder / "in" / "a.pt").unlink()
    put(library.folder / "in" / "a.pt")
    library.add("b.pt", "y")
    assert library.run()["done"] == 1
    outcome, tries = library.outcomes["a.pd4"]
    assert tries == 1 and says in outcome.message


def test_a_manifest_for_which_a_reader_would_wait_is_named():
    with pytest.raises(DataError, match="is a device"):
        read_manifest("/dev/zero", OPS["encode"], lambda source, options: None)


@pytest.mark.parametrize("options", [{"output": "x"}, {"threads": 3}, {"-o": "x"}, {"a b": 1}, {"effort": {"a": 1}}])
def test_options_that_a_line_cannot_set_are_named(options):
    with pytest.raises(DataError, match="option"):
        arguments("encode", "a.pt", "a.pd4", options)


def test_options_become_a_command_line():
    options = {"effort": 3, "no-verify": True, "mode": "ans", "lossy": False, "without": ["rate", "noise"]}
    expected = "a.pt --output a.pd4 --effort=3 --no-verify --mode=ans --without=rate --without=noise"
    assert arguments("encode", "a.pt", "a.pd4", options) == expected.split()
    assert arguments("eval", "a.pd4", "", {"data": "set"}) == ["a.pd4", "set"]


def test_scan_finds_sources_of_one_kind(tmp_path):
    for name in ("a/x.pt", "b.pt", ".hidden/c.pt", "notes.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    lines = list(scan(str(tmp_path), None))
    assert lines == [
        {"source": f"{tmp_path}/a/x.pt", "output": "a/x.pd4"},
        {"source": f"{tmp_path}/b.pt", "output": "b.pd4"},
    ]
    (tmp_path / "set/camera").mkdir(parents=True)
    (tmp_path / "set/camera/0.json").touch()
    with pytest.raises(DataError, match="train and encode, expected --op"):
        list(scan(str(tmp_path), None))
    assert [line["output"] for line in scan(str(tmp_path), "train")] == ["set.pt"]
    with pytest.raises(DataError, match="found no sources"):
        list(scan(str(tmp_path), "prepare"))


@pytest.mark.parametrize("op", ["prepare", "train", "encode", "package"])
@pytest.mark.parametrize("root", ["{}", ".", "file://{}"])
def test_scan_writes_only_lines_that_a_batch_takes(tmp_path, monkeypatch, op, root):
    """Of sources whose names are not printable, are not UTF-8, or differ in their suffix alone."""
    end = (OPS[op].finds or ("",))[0]
    names = [
        b"a\\b",
        b"new\nline",
        b"esc\x1b[2J",
        b"esc\x1b[2K",
        "厨房".encode("gbk"),
        "\u202e".encode(),
        b"x.done.json",
    ]
    names += [b"a::b"] * (root[0] != "f") + [b"-dash", b"s3:x", b"12:30", b"q?x=1"]
    twice = f"twice{end}".encode(), f"twice{end.upper() or '.2'}".encode()
    for name in (*(name + end.encode() for name in names), *twice):
        path = Path(os.fsdecode(bytes(tmp_path) + b"/" + name))
        if op == "train":
            path.mkdir()
            path = path / "transforms.json"
        path.touch()
    monkeypatch.chdir(tmp_path)
    lines = list(scan(root.format(tmp_path), op))
    assert len(lines) == len(names) + 2 and all(line["output"].isprintable() for line in lines)
    manifest = tmp_path.parent / f"{tmp_path.name}.jsonl"
    manifest.write_text("".join(json.dumps(line) + "\n" for line in lines))
    found, faults = read_manifest(str(manifest), OPS[op], lambda source, options: None)
    assert len(found) == len(lines) and not faults
    for line in found:
        assert store.stamp(line.source, dataset=op == "train") and store.fetch(line.source, tmp_path).exists()


def test_a_folder_that_is_no_dataset_is_refused_before_its_files_are_listed(tmp_path, monkeypatch):
    from fsspec.implementations.local import LocalFileSystem

    (tmp_path / "x" / "y").mkdir(parents=True)
    (tmp_path / "x" / "y" / "z").touch()
    monkeypatch.setattr(LocalFileSystem, "walk", Mock(side_effect=AssertionError("walked")))
    with pytest.raises(DataError, match="found a folder that holds no dataset"):
        store.stamp(str(tmp_path), dataset=True)
    monkeypatch.undo()
    before = store.stamp(str(tmp_path))
    (tmp_path / "x" / "y" / "z").write_bytes(b"deeper")
    assert store.stamp(str(tmp_path)) == before


def test_outputs_are_named_after_their_sources():
    names = {
        "a/kitchen.pt": "kitchen.pd4", "clip 12:30:05.pt": "clip 12:30:05.pd4", "what?.pt": "what?.pd4",
        "s3://bucket/a.pt?version=3": "a.pd4", "synthetic:fast?seed=1": "fast.pd4", "set/": "set.pd4",
    }  # fmt: skip
    assert {source: default_output(source, OPS["encode"]) for source in names} == names


def test_uris_of_fsspec_are_sources_and_outputs(library):
    import fsspec

    memory = fsspec.filesystem("memory")
    memory.pipe_file("/films/a.pt", b"text")
    library.lines.append(json.dumps({"source": "memory://films/a.pt"}))
    assert library.run(root="memory://made/here")["done"] == 1
    assert memory.cat_file("/made/here/a.pd4") == b"TEXT"
    record = json.loads(memory.cat_file("/made/here/a.pd4.done.json"))
    assert record["source"] == "memory://films/a.pt"
    assert library.run(root="memory://made/here")["already"] == 1
    assert library.made() == ["text"]


def test_a_copy_whose_name_begins_with_a_dash_is_no_option(tmp_path):
    import fsspec

    fsspec.filesystem("memory").pipe_file("/films/-a.pt", b"text")
    asked = []

    def command(verb, argv):
        asked.append((argv[0], Path(argv[0]).read_bytes()))
        return 1, "", "enough"

    run_job(Job(Line(1, "memory://films/-a.pt", "a.pd4"), "encode", str(tmp_path), 1), command)
    assert asked == [("./-a.pt", b"text")]


@pytest.mark.parametrize("schemes, name", [(("s3", "s3a"), "ContentType"), (("gs", "gcs"), "content_type")])
def test_stores_and_records_hold_media_types(library, monkeypatch, schemes, name):
    from fsspec.implementations.memory import MemoryFileSystem

    told = {}

    def pipe_file(self, path, value, **options):
        told[path.rpartition("/")[2]] = options
        whole(self, path, value)

    whole = MemoryFileSystem.pipe_file
    monkeypatch.setattr(MemoryFileSystem, "pipe_file", pipe_file)
    monkeypatch.setattr(MemoryFileSystem, "protocol", schemes)
    library.add("a.pt", "text")
    assert library.run(root=f"memory://typed-{name}")["done"] == 1
    assert told == {"a.pd4": {name: "model/vnd.pd4dgs"}, "a.pd4.done.json": {name: "application/json"}}
    record = json.loads(MemoryFileSystem().cat_file(f"/typed-{name}/a.pd4.done.json"))
    assert record["files"][""]["type"] == "model/vnd.pd4dgs"


def test_read_only_store_is_named_before_any_work(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(DataError, match="file: cannot write: File exists"):
        store.Root(str(tmp_path / "file")).check()
    store.Root(str(tmp_path / "folder")).check()
    assert not list((tmp_path / "folder").iterdir())


@pytest.mark.parametrize("files", [None, 5, {"": 5}, {"": {}}, {"": {"bytes": "x"}}, {"": None}])
def test_a_damaged_record_is_named_and_can_be_overwritten(library, files):
    library.add("a.pt", "text")
    library.run()
    path = library.out / "a.pd4.done.json"
    path.write_text("garbage" if files is None else json.dumps(json.loads(path.read_text()) | {"files": files}))
    assert library.run()["done"] == 0
    outcome, tries = library.outcomes["a.pd4"]
    assert tries == 1 and "a.pd4.done.json" in outcome.message and "--overwrite" in outcome.message
    assert library.run(overwrite=True)["done"] == 1 and library.run()["already"] == 1


def test_a_manifest_without_lines_is_named(library):
    with pytest.raises(DataError, match="is empty"):
        library.manifest()
