"""The player's decoder, in Node: its own tests and its command. tests/fuzz holds it against the package.

Types are checked where `npm install --no-package-lock` was called in player/.
"""

import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from strategies import flipped, small_file
from vectors.blocks import later, line, make_file, make_layer, pattern

ROOT = Path(__file__).parents[2]
PLAYER = ROOT / "player"
NODE = shutil.which("node")
TSC = PLAYER / "node_modules" / ".bin" / "tsc"
OLDEST = 20
#: What a module names by its path.
IMPORTS = re.compile(r'(?:from|import|URL\()\s*"(\.[^"]+)"')

pytestmark = pytest.mark.skipif(NODE is None, reason="no node on this machine")


@pytest.fixture(autouse=True, scope="module")
def recent_node():
    version = subprocess.run([str(NODE), "--version"], capture_output=True, text=True, timeout=60).stdout
    if int(re.match(r"v(\d+)", version)[1]) < OLDEST:
        pytest.skip(f"node {version.strip()}, the player's tests need {OLDEST} or later")


def run_node(*arguments: object, **options) -> subprocess.CompletedProcess[str]:
    command = [str(NODE), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=280, cwd=PLAYER, **options)


def test_the_decoders_own_tests_pass():
    done = run_node("--test", "--test-reporter=tap", *sorted((PLAYER / "test").glob("*.test.mjs")))
    failed = [line for line in done.stdout.splitlines() if line.lstrip().startswith("not ok")]
    assert done.returncode == 0, "\n".join([*failed[:20], done.stderr[-2000:]])
    assert int(re.search(r"^# pass (\d+)$", done.stdout, flags=re.M)[1]) > 50


def test_any_split_of_a_stream_costs_what_decoding_does(tmp_path):
    """One scene per slice once took 1.6 GiB for 13 kB, and a source twelve seconds."""
    rows, slices, widths = 9, 500, (32, 6, 30)
    k = np.resize(pattern(68, 7), (68, rows))
    rest = [later(0, line(rows, z=7 * i % slices), widths=widths, rows=k) for i in range(1, slices)]
    path = tmp_path / "many.pd4"
    path.write_bytes(make_file(make_layer(0, line(rows, z=slices), widths=widths, rows=k), *rest).data())
    for way, found in json.loads(run_node("testing/streams.mjs", path).stdout).items():
        assert found["time"] <= 3, way
        # all scenes together: decoding holds 2.25 times its scene, rows as they came, with room for more, and in order
        assert found["memory"] <= 1.5 * 2.25, way
        assert found["scenes"] == (1 if way == "whole" else slices)


@pytest.mark.skipif(not TSC.exists(), reason="no typescript: npm install --no-package-lock in player/")
def test_the_types_are_right():
    done = subprocess.run([str(TSC), "-p", "tsconfig.json"], cwd=PLAYER, capture_output=True, text=True, timeout=280)
    assert done.returncode == 0, done.stdout


@pytest.mark.skipif(shutil.which("npm") is None, reason="no npm on this machine")
def test_the_npm_package_holds_what_it_exports_and_runs_nothing_when_it_is_installed():
    told = json.loads((PLAYER / "package.json").read_text())
    command = ["npm", "pack", "--dry-run", "--ignore-scripts", "--json"]
    done = subprocess.run(command, cwd=PLAYER, capture_output=True, text=True, timeout=280)
    assert done.returncode == 0, done.stderr
    packed = {entry["path"] for entry in json.loads(done.stdout)[0]["files"]}
    assert {entry["default"].removeprefix("./") for entry in told["exports"].values()} <= packed
    modules = [PLAYER / name for name in packed if name.endswith("js")]
    imported = [(m.parent / target).resolve() for m in modules for target in IMPORTS.findall(m.read_text())]
    assert len(imported) > 100 and {str(path.relative_to(PLAYER)) for path in imported} <= packed
    assert not {"preinstall", "install", "postinstall"} & set(told["scripts"]) and "dependencies" not in told


def test_the_command_prints_the_hashes_of_the_package(cli, tmp_path):
    path = tmp_path / "scene.pd4"
    path.write_bytes(small_file())
    expected = cli("info", path, "--hashes", "--json").json["hashes"]
    for done in (
        run_node(PLAYER / "cli.mjs", "hashes", path),
        run_node(PLAYER / "cli.mjs", "hashes", "-", stdin=path.open()),
    ):
        assert (done.returncode, done.stderr, json.loads(done.stdout)) == (0, "", expected)


def test_the_command_refuses_a_damaged_file_a_missing_one_and_other_arguments(tmp_path):
    path = tmp_path / "scene.pd4"
    path.write_bytes(flipped(small_file(), -9, 4))
    for file, says in ((path, "ChecksumMismatch: "), (tmp_path / "none.pd4", "no such file")):
        done = run_node(PLAYER / "cli.mjs", "hashes", file)
        assert (done.returncode, done.stdout) == (1, "")
        assert re.fullmatch(rf"pd4-player: [^\n]*{says}[^\n]*\n", done.stderr)
    for arguments in ([], ["hashes"], ["dance", path], ["hashes", path, path, "-n"]):
        done = run_node(PLAYER / "cli.mjs", *arguments)
        assert (done.returncode, done.stdout) == (2, "") and done.stderr.startswith("usage: ")
