"""Bad input to every command: one line on stderr, exit 1 or 2, no traceback, nothing written, no code in it run."""

import errno
import io
import json
import os
import shlex
import shutil
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from PIL import Image
from strategies import flipped
from tiny import Trap, write_views

from pd4dgs_codec import encode
from pd4dgs_codec.__main__ import MODULES
from pd4dgs_codec.cli import common
from pd4dgs_codec.errors import DamageWarning, DataError
from pd4dgs_codec.model import checkpoint
from pd4dgs_codec.quality.levels import load_levels

#: Exit code, command line, and a part of the message. SCENE, MODEL and DATA are a .pd4, a checkpoint and a dataset;
#: others are files of `folder`.
CASES = [
    # wrong usage
    (2, "train synthetic:local", "-o"),
    (2, "train synthetic:local -o m.pt --iterations 0", "from 1 to"),
    (2, "train synthetic:local -o m.pt --max-seconds nan", "more than 0"),
    (2, "train synthetic:local -o m.pt --quality 101", "0 to 100"),
    (2, "train synthetic:local -o m.pt --seed 9223372036854775807", "--seed"),
    (2, "train synthetic:local -o m.pt --feature-width 65", "from 1 to 64"),
    *(
        (2, f"{command} -o {name}", "the name of a file or folder")
        for command in (
            "batch m.jsonl --op encode", "export SCENE --to ply", "import set", "package SCENE", "prepare set",
            "train synthetic:local", "view SCENE",
        )
        for name in ("-", "''")
    ),
    (2, "train synthetic:local -o m.pt --log m.pt", "two files"),
    (2, "train synthetic:local -o m.pt -f --resume old.pt --log ./old.pt", "--log and --resume both name old.pt"),
    (2, "train synthetic:local -o m.pt --without rate --rate-scale 0.5", "--without rate"),
    (2, "encode m.pt", "-o"),
    (2, "encode m.pt -o s.pd4 --effort 10", "--effort"),
    (2, "encode m.pt -o s.pd4 --step-scale -1", "a number > 0"),
    (2, "encode m.pt -o s.pd4 --lay 1", "--lay"),
    # options that would be ignored
    *((2, f"encode m.pt -o s.pd4 {option}", "needs --data") for option in ("--holdout 0", "--views 3")),
    (2, "encode m.pt -o s.pd4 --data DATA", "--data needs --slices or --target-size"),
    (2, "encode m.pt -o s.pd4 --downscale 2", "--downscale needs --data"),
    (2, "encode m.pt -o s.pd4 --slices 9k --downscale 2", "--downscale needs --data"),
    (2, "encode m.pt -o s.pd4 --keep-levels", "--keep-levels needs --slices"),
    (2, "encode m.pt -o s.pt", "-o s.pt names a checkpoint, expected a .pd4 file"),
    *((2, f"render s.pd4 -o a.gif {option}", "needs --data") for option in ("--holdout 0", "--split test")),
    (2, "render s.pd4 -o %04d.png --fps 5", "--fps needs a .gif or .mp4"),
    (2, "render s.pd4 -o a.gif --fps 60", "found --fps 60, expected at most 50 for a .gif"),
    (2, "render s.pd4 -o %99999999999999999999d.png", "expected one frame number"),
    *((2, f"export SCENE -o a --to ply {option}", "needs --data or") for option in ("--holdout 0", "--downscale 2")),
    (2, "package SCENE -o out --no-video --fps 5", "--fps has no effect with --no-video"),
    *((2, f"package empty -o empty {option}", "needs a .pd4") for option in ("--fps 5", "--immutable", "--no-video")),
    *(
        (2, f"view s.pd4 -o a.html {option}", "has no effect with -o")
        for option in ("--port 0", "--rate 2M", "--latency 0")
    ),
    *((2, f"batch m.jsonl -o out --op encode {option}", "needs --on") for option in ("--gpus 1", "--address a:1")),
    (2, "batch m.jsonl -o out --op encode --workers 0 --timeout 9s", "--timeout has no effect with --workers 0"),
    (2, "batch m.jsonl -o out --op encode --on ray --slurm cluster=local", "--slurm needs --on slurm"),
    (2, "prepare kept.gif -o out --fps 5", "--fps needs a folder of frames"),
    (2, "prepare empty -o out --fps 1e-300", "a number from 0.01 to 1000"),
    (2, "prepare empty -o out --frames 5", "0 or an integer >= 8"),
    (2, "train synthetic:local -o m.pt --rollout top --key-instant 0", "--key-instant needs --rollout key"),
    *((2, f"encode m.pt -o s.pd4 --source '{text}'", "one line of printable text") for text in ("a\nb", "\udcff")),
    *((2, f"render s.pd4 -o a.gif --fps {fps}", "a number from 0.01 to 1000") for fps in (1e-4, 1e308)),
    *(
        (2, f"encode m.pt -o s.pd4 --target-size={text}", "or sizes of layers such as L0=425k")
        for text in ("k", "-5", "425k,L0=9k", "L3=1k", "L0=1k,L0=2k", "L0=", "L0=-5", "L0=0.5", "L0=1k,")
    ),
    (2, "encode m.pt -o s.pd4 --layers 1 --target-size L0=9k,L2=9k", "--target-size L2 has no effect with --layers 1"),
    *((2, f"encode m.pt -o s.pd4 --slices {option}", "slices ") for option in ("999", "2k --mode lzma")),
    (2, "encode m.pt -o s.pd4 --slices 1e30k", "a size in bytes"),
    (2, "encode m.pt -o s.pd4 --mode lzma --priors gauss", "--priors has no effect with --mode lzma"),
    *(
        (1, f"{line} http://127.0.0.1:9/s.pd4 -o new{suffix}", "looks like a URI, expected a path")
        for line, suffix in (("encode", ".pd4"), ("render", ".gif"), ("export --to ply", ""), ("package", ""))
    ),
    *((2, line, "found an empty name of the output") for line in ("encode m.pt -o ''", "render s.pd4 -o ''")),
    *((2, line, "found an empty name of the input") for line in ("encode '' -o s.pd4", "info ''", "eval '' DATA")),
    (2, "decode s.pd4 -o s.txt", ".npz or .pt"),
    (2, "decode s.pd4 --symbols", "FILE.npz"),
    (2, "decode s.pd4 -o s.pt --symbols", "FILE.npz"),
    (2, "decode s.pd4 --max-layer 3", "argument --max-layer: invalid choice: 3"),
    (2, "render s.pd4 -o a.gif --level 3", "argument --level: invalid choice: 3"),
    (2, "info", "found no FILE, expected one, or --sample"),
    *((2, f"{verb} s.pd4 --sample", "and --sample, expected one of them") for verb in ("info", "view")),
    (2, "info s.pd4 --at 2X", "2M or 500k"),
    (2, "info s.pd4 --at 0M", "2M or 500k"),
    (2, "render s.pd4 -o film.avi", ".gif or .mp4"),
    (2, "render s.pd4 -o %s.png", "%04d"),
    (2, "render s.pd4 -o %04d-%04d.png", "%04d"),
    *(
        (2, f"render s.pd4 -o a.{kind} --{one} --{other}", f"found --{one.split()[0]} and --{other.split()[0]}")
        for kind, one, other in (
            ("gif", "data set", "orbit 3"), ("gif", "data set", "duration 3"), ("png", "data set", "time 0"),
            ("png", "time 0", "orbit 3"), ("png", "time 0", "frames 2"), ("gif", "duration 2s", "frames 2"),
        )
    ),
    (2, "render s.pd4 -o a.gif --time 0.5", "--time needs an image such as a.png as -o"),
    (2, "render s.pd4 -o a.png --duration 2", "--duration needs a .gif or .mp4 as -o"),
    (2, "render SCENE -o a.gif --duration 1e9", "found 20,000,000,000 frames, expected at most 100,000"),
    (2, "render SCENE -o b.png --frames 2", "--time 0.5"),
    (2, "render kept.gif -o kept.gif -f", "-o names the input kept.gif"),
    (2, "eval s.pd4", "SOURCE"),
    (2, "eval s.pd4 set --downscale half", "an integer >= 1"),
    (2, "export SCENE -o out --to obj", "invalid choice: 'obj'"),
    (2, "export SCENE -o out --to ply --time 1.5", "expected a number from 0 to 1"),
    (2, "export SCENE -o out --to ply-seq --time 0.5", "--time needs --to ply, spz or glb"),
    (2, "export SCENE -o out --to ply --fps 5", "--fps needs --to ply-seq or 4dgs"),
    (2, "export SCENE -o out --to ply-seq --fps 1e308", "a number from 0.01 to 1000"),
    (2, "export SCENE -o out --to ply --scale 1e300", "a number from 1e-6 to 1e6"),
    (2, "export SCENE -o SCENE -f --to ply", "-o names the input"),
    (1, "export SCENE -o out --to ply --compare missing", "missing: found nothing, expected a dataset folder"),
    (2, "export SCENE -o a.PLY --to spz", "-o a.PLY ends in .ply, but --to is spz"),
    (2, "export SCENE -o a.pt --to ply", "-o a.pt ends in .pt, but --to is ply"),
    (2, "export SCENE -o frames.spz --to ply-seq", "-o frames.spz ends in .spz, but --to is ply-seq"),
    (2, "export SCENE -o frames", "found -o frames, expected a name that ends in .ply, .spz, "),
    *((2, f"decode s.pd4 --max-bytes {text}", "such as 50k or 1.5MB") for text in ("0", "5kb", "1kBB", "B", "2KiB")),
    (1, "view empty --no-browser", "empty: found no .pd4 file in this folder"),
    (1, "view . --no-browser", "cut.pd4: "),
    *((2, f"serve empty --port {port}", "--port") for port in (65536, -1)),
    *((2, f"serve empty --rate {rate}", "--rate") for rate in ("2X", "0", "nan", "2")),
    (2, "serve empty --latency -1ms", "--latency"),
    (2, "serve empty --host ''", "--host"),
    (1, "serve empty --host 203.0.113.77 --port 0", "cannot listen"),
    (1, "serve notes --port 0", "is not a folder"),
    (2, "batch m.jsonl -o out", "--op"),
    (2, "batch m.jsonl -o out --op explode", "explode"),
    (2, "batch m.jsonl -o out --op encode --slurm partition", "KEY=VALUE"),
    # input that is missing or not what it should be
    *((1, f"{verb} absent -o {out}", "absent") for verb, out in (("encode", "s.pd4"), ("decode", "s.npz"))),
    *((1, f"{verb} absent", "absent") for verb in ("info", "view", "serve", "batch scan -o m.jsonl")),
    (1, "eval absent DATA", "absent"),
    (1, "render absent -o a.gif", "absent"),
    (1, "export absent -o a.ply --to ply", "absent"),
    (1, "import absent -o m.pt", "absent"),
    (1, "package absent -o out", "absent"),
    (1, "batch absent.jsonl --op encode -o out", "absent.jsonl"),
    *((1, f"{verb} MODEL", "(a checkpoint? pd4dgs-encode takes one)") for verb in ("info", "export -o a.ply --to ply")),
    *((1, f"{verb} empty", "is a folder") for verb in ("info", "render -o a.gif", "encode -o s.pd4")),
    (2, "view SCENE -o a.pd4", "ends in .html"),
    (2, "view cut.pd4 -o cut.pd4 -f", "-o names the input"),
    (1, "view notes --no-browser", "checkpoint"),
    (1, "view late.pd4 --no-browser", "CRC"),
    (1, "export cut.pd4 -o a.ply --to ply", "cut.pd4"),
    (1, "render flipped.pd4 -o a.gif", "flipped.pd4"),
    (1, "eval flipped.pd4 DATA", "flipped.pd4"),
    (1, "render blind.pd4 -o a.gif", "--data"),
    *((1, f"render SCENE -o a.{kind} --data sizes --split train", "several sizes") for kind in ("gif", "mp4")),
    *(
        (1, command.format(source), source)
        for source in ("missing", "empty", "notes", "synthetic:nothing")
        for command in ("train {} -o m.pt", "eval SCENE {}", "render SCENE -o a.gif --data {}")
    ),
    (1, "train hole -o m.pt --iterations 3 --log log.jsonl", "image is missing, and so are the others (6 in all)"),
    # checkpoints
    *(
        (1, command, "evil.pt")
        for command in (
            "encode evil.pt -o s.pd4", "render evil.pt -o a.gif", "eval evil.pt DATA",
            "train DATA -o m.pt --resume evil.pt",
        )
    ),
    (1, "encode cut.pt -o s.pd4", "cut.pt"),
    (2, "encode cut.pt -o ./cut.pt -f", "-o names the input cut.pt, expected another file"),
    (1, "encode nan.pt -o s.pd4", "feature"),
    (1, "encode inf.pt -o s.pd4", "feature"),
    (1, "encode huge.pt -o s.pd4", "feature"),
    (1, "encode ends.pt -o s.pd4", "ends.pt: positions span 2097153 voxels on one axis, limit 2097152 in a slice"),
    # outputs
    *(
        (1, command, "exists already")  # not that the input is absent: the output is checked first
        for command in (
            "encode absent -o kept.npz", "decode absent -o kept.npz", "render absent -o kept.gif",
            "train absent -o kept.npz", "train DATA -o m.pt --log kept.npz",
        )
    ),
    (1, "encode MODEL -o nowhere/s.pd4", "nowhere"),
    (1, "view SCENE -o kept.html", "exists already"),
    (1, "view SCENE -o none/a.html", "no folder"),
    (1, "encode MODEL -o empty", "is a folder"),
    (1, "render SCENE -o a.gif --threads 100000", "100000"),
]  # fmt: skip


@pytest.fixture(scope="module")
def bad_files(tmp_path_factory, model_pt, scene_pd4, scene):
    """The files that CASES name."""
    folder = tmp_path_factory.mktemp("bad")
    data = scene_pd4.read_bytes()
    (folder / "cut.pd4").write_bytes(data[:-10])
    (folder / "flipped.pd4").write_bytes(flipped(data, 400))
    (folder / "late.pd4").write_bytes(flipped(data, -30))
    (folder / "blind.pd4").write_bytes(encode(replace(scene, info=replace(scene.info, camera=None)), effort=1))
    spoilt = {"nan": ("feature", float("nan")), "inf": ("feature", float("inf")), "huge": ("feature", 1e20)}
    for name, (key, value) in (spoilt | {"ends": ("anchor_q", 1 << 20)}).items():
        content = torch.load(model_pt, weights_only=True)
        content["state"][key][3, 2] = value
        content["state"][key][4, 2] = -value
        content["digest"] = checkpoint._digest(content)
        torch.save(content, folder / f"{name}.pt")
    torch.save({"format": "pd4dgs-checkpoint", "version": 1, "state": Trap(folder / "ran")}, folder / "evil.pt")
    (folder / "cut.pt").write_bytes(model_pt.read_bytes()[:-200])
    for name in ("kept.npz", "kept.gif", "kept.html", "notes"):
        (folder / name).write_text("precious")
    (folder / "empty").mkdir()
    views = json.loads((write_views(folder / "sizes") / "transforms.json").read_text())
    views["frames"][1] |= {"w": 8, "h": 6}
    (folder / "sizes" / "transforms.json").write_text(json.dumps(views))
    Image.new("RGB", (8, 6)).save(folder / "sizes" / "001.png")
    for picture in write_views(folder / "hole").glob("*.png"):
        picture.unlink()
    return folder


def _listing(folder: Path) -> dict[str, int]:
    return {str(p.relative_to(folder)): p.stat().st_size for p in sorted(folder.rglob("*"))}


def _errors(result) -> list[str]:
    """The lines on stderr but remarks on what was read."""
    return [line for line in result.error_lines if not line.startswith("note: ")]


def _check(result, verb: str, code: int, says: str) -> None:
    assert result.code == code and result.out == b""
    (error,) = _errors(result)
    assert error.startswith(f"pd4dgs-{verb}: error: ") and "internal error" not in error
    assert says in error and (code == 1 or "--help" in result.err)


@pytest.mark.parametrize("code, line, says", CASES, ids=[line for _, line, _ in CASES])
def test_bad_input(cli, bad_files, model_pt, scene_pd4, shared_dataset, monkeypatch, code, line, says):
    monkeypatch.chdir(bad_files)
    before = _listing(bad_files)
    for word, path in (("SCENE", scene_pd4), ("MODEL", model_pt), ("DATA", shared_dataset)):
        line = line.replace(word, str(path))
    verb, *argv = shlex.split(line)
    shown, module = "batch scan" if argv[:1] == ["scan"] else verb, MODULES.get(verb, verb)
    _check(cli(module, *argv), shown, code, says)
    told = cli(module, *argv, "--json")
    assert told.code == code and len(_errors(told)) == 1
    assert told.json["error"]["message"] in told.err and (told.json["error"]["type"] == "UsageError") == (code == 2)
    assert _listing(bad_files) == before


PD4_FAULTS = {
    "empty": (lambda d: b"", "Truncated"),
    "signature only": (lambda d: d[:8], "Truncated"),
    "cut": (lambda d: d[:-1], "Truncated"),
    "not ours": (lambda d: b"PK\x03\x04" + d, "BadSignature"),
    "header bit": (lambda d: flipped(d, 30), "ChecksumMismatch"),
    "payload bit": (lambda d: flipped(d, len(d) // 2), "ChecksumMismatch"),
    "more behind": (lambda d: d + b"x", "Malformed"),
}


@pytest.mark.parametrize("fault", PD4_FAULTS)
def test_a_damaged_pd4(cli, scene_pd4, tmp_path, fault):
    damage, kind = PD4_FAULTS[fault]
    data, path = damage(scene_pd4.read_bytes()), tmp_path / "bad.pd4"
    path.write_bytes(data)
    for name, argv, stdin in (
        ("bad.pd4", ("decode", path, "-o", tmp_path / "s.npz"), None),
        ("bad.pd4", ("info", path, "--check"), None),
        ("stdin", ("decode", "-"), data),
    ):
        _check(cli(*argv, stdin=stdin), argv[0], 1, name)
        error = cli(*argv, "--json", stdin=stdin).json["error"]
        assert error["type"] == kind and (fault != "more behind" or error["offset"] == len(data) - 1)
    assert list(tmp_path.iterdir()) == [path]


WRITERS = (
    "encode MODEL -o out.pd4 --effort 1",
    "decode SCENE -o out.npz",
    "decode SCENE -o out.pt",
    "render SCENE -o out.gif --frames 2",
    "render SCENE -o p/%02d.png --frames 1",
)


@pytest.mark.parametrize("command", WRITERS)
@pytest.mark.parametrize("call", ["os.replace", "tempfile.mkdtemp", "write"])
def test_a_disk_that_refuses_leaves_nothing(cli, model_pt, scene_pd4, tmp_path, monkeypatch, command, call):
    original = os.replace

    def full(*paths, **options):
        if call == "os.replace" and str(tmp_path) not in str(paths[1]):  # numba caches its kernels in the same way
            return original(*paths, **options)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "/some/temporary/name")

    if call == "write" and "out.gif" in command:
        pytest.skip("imageio writes the file")
    for name in ("pathlib.Path.write_bytes", "PIL.Image.Image.save") if call == "write" else (call,):
        monkeypatch.setattr(name, full)
    verb, *argv = command.replace("MODEL", str(model_pt)).replace("SCENE", str(scene_pd4)).split()
    argv[2] = str(tmp_path / argv[2])
    result = cli(verb, *argv)
    _check(result, verb, 1, "No space left")
    assert f"error: {argv[2]}: " in result.err
    assert not [p for p in tmp_path.rglob("*") if p.is_file()]


def test_a_folder_without_write_permission(cli, model_pt, tmp_path, monkeypatch):
    monkeypatch.setattr("os.access", lambda path, mode: False)
    _check(cli("encode", model_pt, "-o", tmp_path / "s.pd4"), "encode", 1, "no permission")


@pytest.mark.parametrize("kind, package", [("spz", "gaussforge"), ("4dgs", "fourdgs")])
def test_a_missing_package_is_named(cli, scene_pd4, tmp_path, monkeypatch, kind, package):
    monkeypatch.setitem(sys.modules, package, None)
    result = cli("export", scene_pd4, "-o", tmp_path / "out", "--to", kind)
    _check(result, "export", 1, f"need the package {package}")
    assert "pip install 'pd4dgs-codec[interchange]'" in result.err


def test_missing_torch_and_faults_of_ours_are_one_line(cli, model_pt, scene_pd4, tmp_path, monkeypatch):
    def gone(*_):
        raise ModuleNotFoundError("No module named 'torch'", name="torch")

    def broken(data):
        raise ZeroDivisionError("a fault of ours")

    monkeypatch.setattr("pd4dgs_codec.model.checkpoint.loads", gone)
    _check(cli("encode", model_pt, "-o", tmp_path / "s.pd4"), "encode", 1, "pip install 'pd4dgs-codec[train]'")
    monkeypatch.setattr("pd4dgs_codec.format.info.info", broken)
    result = cli("info", scene_pd4)
    assert result.code == 1 and len(result.error_lines) == 1 and "internal error" in result.err
    assert "ZeroDivisionError" in cli("info", scene_pd4, "-v").error_lines[-2]


@pytest.mark.parametrize("engine, module", [("ray", "ray"), ("slurm", "submitit")])
def test_an_engine_that_is_not_installed_names_its_extra(cli, tmp_path, monkeypatch, engine, module):
    monkeypatch.setitem(sys.modules, module, None)
    (tmp_path / "m.jsonl").write_text('{"source": "synthetic:local"}\n')
    result = cli("batch", tmp_path / "m.jsonl", "-o", tmp_path / "out", "--op", "train", "--on", engine)
    line = f"the module {module} is not installed: pip install 'pd4dgs-codec[cluster]'"
    _check(result, "batch", 1, line)


EVIL = "\x1b]0;title\x07\n\x9b2J\u202e"


def test_names_of_files_and_titles_cannot_move_the_cursor(cli, scene_pd4, tmp_path):
    for path in (tmp_path / EVIL, tmp_path / (EVIL * 30), tmp_path / f"{EVIL}\udcff.pd4"):
        result = cli("info", path)
        assert result.code == 1 and result.err.rstrip("\n").isprintable() and "x1b]0;title" in result.err
    shutil.copy(scene_pd4, tmp_path / f"{EVIL}.pd4")
    assert "\x1b" not in cli("info", tmp_path / f"{EVIL}.pd4").out.decode()


def test_a_terminal_without_the_letters_of_a_text_gets_escapes(monkeypatch):
    stream = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr("sys.stdout", stream)
    common.open_streams()
    common.show("Ein Flügel \udcff\x1b[2J")
    assert stream.buffer.getvalue() == b"Ein Fl\\xfcgel \\udcff\\x1b[2J\n"


def test_warnings_are_one_line(cli, scene_pd4, monkeypatch):
    def info(data):
        warnings.simplefilter("always")
        warnings.warn(DamageWarning(f"x.mp4: is damaged:\n{EVIL}"), stacklevel=1)
        raise DataError("no")

    monkeypatch.setattr("pd4dgs_codec.format.info.info", info)
    first, second = cli("info", scene_pd4).error_lines
    assert first.startswith("pd4dgs-info: warning: x.mp4: is damaged: \\x1b") and second == "pd4dgs-info: error: no"


def test_a_full_disk_behind_a_library_is_not_called_stdout(cli, scene_pd4, monkeypatch):
    def full(data):
        raise OSError(errno.EFBIG, os.strerror(errno.EFBIG))

    monkeypatch.setattr("pd4dgs_codec.format.info.info", full)
    _check(cli("info", scene_pd4), "info", 1, "a cache or a temporary file: File too large")


def test_a_film_on_a_full_disk_is_one_line_and_no_file(cli, scene_pd4, tmp_path):
    resource = pytest.importorskip("resource")
    arguments = (scene_pd4, "-o", tmp_path / "x.mp4", "--frames", 8)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    assert cli("render", *arguments).code == 0
    (tmp_path / "x.mp4").unlink()
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
    try:
        result = cli("render", *arguments)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    _check(result, "render", 1, "x.mp4: ffmpeg cannot write it: ")
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="needs a device without an end")
@pytest.mark.parametrize("read", [common.read_bytes, checkpoint.load, load_levels])
def test_a_device_is_no_source(read):
    with pytest.raises(DataError, match="/dev/zero: is a device, expected a file"):
        read("/dev/zero")


@pytest.mark.parametrize("read", [checkpoint.load, load_levels])
def test_a_name_that_no_file_can_have(read):
    with pytest.raises(DataError, match="cannot be read"):
        read("a\0b.pd4")
