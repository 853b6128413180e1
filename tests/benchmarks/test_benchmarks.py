"""All benchmarks on a tiny scene, and the page that they make."""

import json
import re
import subprocess
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import browser
import codec
import common
import numpy as np
import page
import pytest
import quality
import random_scenes
import run
import viewers
from common import QUICK, ROOT, Run, Training
from delivery import share_of_bytes
from PIL import Image
from refining_gif import LIMIT
from strategies import make_scene
from tiny import TINY

from pd4dgs_codec.errors import DataError
from pd4dgs_codec.model.config import PRESETS
from pd4dgs_codec.scene import Camera

#: They start processes or browsers and wait for them.
SLOW = ("latency", "batch", "player")
FAST = [benchmark.name for benchmark in run.ALL if benchmark.name not in SLOW]
PICTURES = {".png", ".jpg", ".gif"}


@pytest.fixture(scope="module")
def made(once) -> Path:
    """The folder of a quick run; tests do not write into it."""

    def make(out: Path) -> None:
        with pytest.MonkeyPatch.context() as patch:
            patch.setitem(PRESETS, "tiny", TINY)
            assert run.main(["--quick", "-o", str(out), "--only", *FAST]) == 0

    return once("benchmarks", make)


def sections(docs: Path) -> dict[str, dict]:
    stored = json.loads((docs / "figures" / "results.json").read_text())
    return {section["name"]: section for section in stored["sections"]}


def shown(markdown: Path) -> set[Path]:
    return {(markdown.parent / name).resolve() for name in re.findall(r"!\[[^]]*\]\(([^)]+)\)", markdown.read_text())}


def check_page(text: str) -> None:
    """Tables have rows, all of as many cells, and lines outside of them are short."""
    for block in text.split("\n\n"):
        if block.startswith("|"):
            rows = [line.strip("|").split(" | ") for line in block.splitlines()]
            assert len(rows) > 2 and len({len(row) for row in rows}) == 1, block
        elif not block.startswith("!["):
            assert all(len(line) <= 120 for line in block.splitlines())


def test_every_benchmark_makes_a_section_with_its_pictures(made):
    docs = made / "docs"
    assert list(sections(docs)) == FAST and all(section["rows"] for section in sections(docs).values())
    text = (docs / "results.md").read_text()
    check_page(text)
    assert [line[3:] for line in text.splitlines() if line.startswith("## ")] == [
        benchmark.title for benchmark in run.ALL if benchmark.name in FAST
    ]
    assert shown(docs / "results.md") == {p for p in (docs / "img").iterdir() if p.name != "refining.gif"}


def test_figures_are_of_the_files_that_were_packed(made):
    found, folder = sections(made / "docs"), made / QUICK.name
    *levels, monolith = found["quality"]["rows"]
    assert [row["level"] for row in levels] == list(range(len(levels)))
    assert monolith["level"] == "monolith" and monolith["bytes"] > 3 * levels[-1]["bytes"]
    assert all(5 < row["mpsnr"] < 60 for row in (*levels, monolith))
    slices = found["slices"]["rows"]
    assert [row["bytes"] for row in slices] == sorted(row["bytes"] for row in slices)
    assert 0.95 < slices[-1]["bytes"] / (folder / "slices.pd4").stat().st_size < 1  # the metadata comes last
    rivals = {row["part"]: row for row in found["rivals"]["rows"]}
    assert rivals["attributes"]["ours"] < rivals["attributes"]["gauss"] and rivals["positions"]["lzma"] > 0


def test_the_share_of_bytes_is_the_median_over_qualities():
    """Most qualities take 60 bytes instead of 120."""
    assert share_of_bytes([(40, 10.0), (60, 28.0), (120, 30.0)], [(80, 12.0), (120, 30.0)]) == 0.5
    assert share_of_bytes([(40, 10.0), (120, 30.0)], [(80, 12.0), (120, 30.0)]) == 1.0


def test_the_animation_has_a_picture_for_every_prefix(made):
    movie = Image.open(made / "docs" / "img" / "refining.gif")
    assert movie.n_frames >= len(sections(made / "docs")["slices"]["rows"])
    assert movie.width == 320 and (made / "docs" / "img" / "refining.gif").stat().st_size <= LIMIT


def test_the_page_is_made_from_its_figures_alone(made, tmp_path):
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "results.json").write_text((made / "docs" / "figures" / "results.json").read_text())
    assert run.main(["--render", "--docs", str(tmp_path)]) == 0
    assert (tmp_path / "results.md").read_text() == (made / "docs" / "results.md").read_text()


def test_a_training_is_kept_for_the_same_command_and_package(made, monkeypatch, tmp_path):
    here = Run(made, tmp_path, quick=True)
    monkeypatch.setattr(common, "command", lambda *words: pytest.fail(f"ran {words}"))
    path, training = here.trained(QUICK)
    assert path.is_file() and training["finished"]
    for options, tree in (((), "another package"), (("--quality", "40"), common.package_tree())):
        monkeypatch.setattr(common, "package_tree", lambda tree=tree: tree)
        with pytest.raises(pytest.fail.Exception, match="'train'"):
            Run(tmp_path, tmp_path, quick=True).trained(QUICK, *options)


def test_a_run_stops_at_the_benchmark_that_fails(made, tmp_path, monkeypatch, capsys):
    bad = common.Benchmark("bad", "Bad", (), Mock(side_effect=DataError("nothing to measure")), str)
    good = common.Benchmark("good", "Good", (), lambda run, scene: [{"n": 1}], lambda rows: f"n is {rows[0]['n']}.")
    monkeypatch.setattr(run, "ALL", (good, bad, good))
    assert run.main(["--quick", "-o", str(tmp_path)]) == 1
    assert "run: error: nothing to measure\n" in capsys.readouterr().err
    assert "## Good\n\nn is 1." in (tmp_path / "docs" / "results.md").read_text()


def test_a_command_that_fails_is_named():
    with pytest.raises(DataError, match="pd4dgs-info nowhere.pd4 --json: exit code 1, expected 0"):
        common.command("info", "nowhere.pd4")
    with pytest.raises(DataError, match=r"pd4dgs-info nowhere.pd4 --json: exit code 1: .*nowhere.pd4"):
        common.command_in_subprocess("info", "nowhere.pd4")


def test_trainings_side_by_side_are_those_that_are_measured(tmp_path, monkeypatch):
    """Each once, in a process of its own, the longest first."""
    ran = []

    def train(name, *words):
        ran.append(words[words.index("--iterations") + 1])
        Path(words[words.index("-o") + 1]).touch()
        return {"finished": True}

    monkeypatch.setattr(common, "command_in_subprocess", train)
    monkeypatch.setattr(common.os, "cpu_count", lambda: 1)
    here, jobs = Run(tmp_path, tmp_path), [Training(QUICK), Training(QUICK, longer=2), Training(QUICK)]
    here.train(jobs)
    assert ran == ["20", "10"]
    here.train(jobs)
    assert here.trained(QUICK)[1]["finished"] and len(ran) == 2


def test_sections_whose_code_has_changed_are_named(tmp_path, monkeypatch):
    """Docstrings and comments do not count. The player's code counts only for the section that opens the player, and
    code in APART only for the section that names it."""
    assert all((ROOT / "pd4dgs_codec" / path).exists() for paths in common.APART.values() for path in paths)
    monkeypatch.setattr(common, "ROOT", tmp_path)

    def commit(name: str, text: str) -> str:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
        git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b"]
        for words in (["init", "-q"], ["add", "-A"], ["commit", "-q", "-m", name]):
            subprocess.run([*git, *words], check=True)
        return common.git("rev-parse", "--short=7", "HEAD")

    def named(section: str, commit: str) -> str:
        return "".join(run.outdated([{"name": section, "commit": commit}]))

    first = commit("pd4dgs_codec/x.py", '"""Adds."""\na = 1\n')
    code = commit("pd4dgs_codec/x.py", '"""Adds."""\na = 2\n')
    words = commit("pd4dgs_codec/x.py", '"""Adds one."""\na = 2  # two\n')
    commit("player/x.js", "1;")
    script = commit("pd4dgs_codec/cli/batch.py", "a = 1\n")
    batches = commit("pd4dgs_codec/cli/batch.py", "a = 2\n")
    for section in ("quality", "player"):
        assert named(section, first).startswith(f"{section}: made at {first}; changed since: pd4dgs_codec/x.py")
        assert named(section, "abcdef1").startswith(f"{section}: made at abcdef1; changed since:")
    assert named("quality", f"{code}, changed") == named("quality", words) == ""
    assert named("player", words) == f"player: made at {words}; changed since: player/x.js"
    assert named("batch", script).startswith("batch: ") and named("batch", batches) == named("player", script) == ""


def test_several_seeds_are_shown_with_their_spread():
    row = {"scene": "discs", "level": 0, "mssim": 0.9, "anchors": 7, "minutes": 1.0}
    rows = [
        row | {"seed": i, "bytes": n, "mpsnr": db}
        for i, (n, db) in enumerate([(1000, 20.0), (1200, 21.0), (900, 23.0)])
    ]
    cells = [cell.strip() for cell in quality.text(rows).splitlines()[-1].strip("|").split("|")]
    assert "moving dB" not in quality.text(rows)
    rows += [row | {"scene": "cube", "seed": 0, "bytes": 9, "mpsnr": 30.0, "moving_mpsnr": 21.5}]
    assert [line.split(" | ")[5] for line in quality.text(rows).splitlines()[-4:]] == ["moving dB", "-", "-", "21.50"]
    assert cells[:5] == ["discs", "0", "1,000 (900 to 1,200)", "0.00", "21.00 (20.00 to 23.00)"]


def test_official_scenes_stand_beside_what_is_published():
    """In a table of their own, by its protocol: unmasked metrics, the published rows below those of their scene."""
    row = {"level": 1, "seed": 0, "bytes": 9e5, "mpsnr": 30.0, "mssim": 0.9, "anchors": 7, "minutes": 1.0}
    official = row | {"psnr": 40.0, "ssim": 0.99}
    rows = [official | {"scene": "mutant"}, official | {"scene": "basketball", "moving_mpsnr": 20.0}]
    _, what, ours, told, theirs = quality.text([row | {"scene": "shelf-hand"}, *rows]).split("\n\n")
    assert "`mutant --preset small --iterations 10000`" in what and len(what.splitlines()) == 5
    assert "mPSNR dB" in ours and len(ours.splitlines()) == 3 and "--protocol 3dgs" in told
    head, _, *cells = (line.strip("| ").split(" | ") for line in theirs.splitlines())
    assert head[4:7] == ["PSNR dB", "moving dB", "SSIM"] and {len(line) for line in cells} == {len(head)}
    assert [line[0] for line in cells] == ["mutant"] * 6 + ["basketball"] * 2
    assert cells[0][2:7] == ["900,000", "3.60", "40.00", "-", "0.9900"] and cells[6][5] == "20.00"
    assert cells[1][1:7] == ["P-4DGS", "930,000", "3.72", "41.12", "-", "0.993"]
    assert all(common.SCENES[name].protocol == "3dgs" for name in quality.PUBLISHED)


def test_other_coders_take_about_the_entropy_of_their_symbols():
    rng = np.random.default_rng(0)
    channel = rng.normal(0, 5, 50_000).round().astype(np.int32)
    bits = 0.5 * np.log2(2 * np.pi * np.e * 25)
    assert codec.gauss_bytes([channel]) == pytest.approx(50_000 * bits / 8, rel=0.01)
    assert codec.gauss_bytes([np.full(100, 3, np.int32)]) == codec.GAUSS_PARAMETERS
    assert codec.lzma_bytes([channel]) > 50_000 * bits / 8
    pytest.importorskip("DracoPy")
    cells = np.unique(rng.integers(-50, 50, (3000, 3), dtype=np.int32), axis=0)
    assert 2 * len(cells) < 8 * codec.draco_bytes(cells) < 21 * len(cells)


def test_pictures_of_viewers_say_what_is_missing(monkeypatch, tmp_path):
    monkeypatch.setattr(browser, "PLAYER", tmp_path)
    with pytest.raises(DataError, match=r"spark: three is not installed \(npm install"):
        viewers.draw(b"", tmp_path / "img")
    assert not (tmp_path / "img").exists()


@pytest.mark.parametrize("up, places", [((0, 1, 0), [1, 2, 3]), ((0, -1, 0), [1, -2, -3]), ((0, 0, 1), [1, 3, -2])])
def test_a_scene_is_upright_in_the_viewer_of_supersplat(up, places):
    scene = make_scene(1, anchors=4)
    viewmat = np.eye(4, dtype=np.float32)
    viewmat[:3, 3] = -1, -2, -3
    camera = Camera(viewmat, np.diag([40, 40, 1]).astype(np.float32), 80, 60)
    look = viewers.supersplat(replace(scene, info=replace(scene.info, up=up, camera=camera)), camera)
    np.testing.assert_allclose(look["position"], places, atol=1e-6)
    assert abs(look["angles"][0]) == pytest.approx({1: 0, -1: 180, 0: 90}[up[1]]) and look["fov"] == 90


@pytest.mark.slow
def test_the_benchmarks_that_wait_for_processes(made, tmp_path):
    assert run.main(["--quick", "-o", str(made), "--docs", str(tmp_path), "--only", "latency", "batch"]) == 0
    check_page((tmp_path / "results.md").read_text())


# -- docs/ -------------------------------------------------------------------------------------------------------------


def test_the_results_in_git_are_what_their_figures_make_them():
    figures = ROOT / "docs" / "figures" / "results.json"
    if not figures.is_file():
        pytest.skip("there are no figures yet")
    text = (ROOT / "docs" / "results.md").read_text()
    assert page.text(run.ALL, json.loads(figures.read_text())) == text and len(text.splitlines()) <= 330
    check_page(text)


def test_pages_show_the_pictures_in_git_which_are_small():
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    pictures = {path for path in (ROOT / "docs").rglob("*") if path.suffix in PICTURES}
    assert set().union(*map(shown, pages)) == pictures
    assert all(path.stat().st_size <= (LIMIT if path.suffix == ".gif" else 300_000) for path in pictures)


# -- random scenes -----------------------------------------------------------------------------------------------------


def test_random_scenes_are_trained_once_and_measured(tmp_path, monkeypatch, capsys):
    """A second run trains nothing. A body that the file shows no better than a picture without it is not kept."""
    trained = []

    def command(tree, name, *words):
        trained.append(words[0]) if name == "train" else None
        return common.command(name, *words)

    monkeypatch.setitem(PRESETS, "tiny", TINY)
    monkeypatch.setattr(random_scenes, "in_tree", command)
    words = ["5-6", "-o", str(tmp_path / "rows.jsonl"), "--frames", "4", "--side", "24", "--iterations", "3"]
    random_scenes.main(words)
    first = capsys.readouterr().out
    assert random_scenes.main([*words, "--sheet", str(tmp_path / "worst.png")]) == 0
    assert capsys.readouterr().out == first and trained == [
        f"synthetic:random?seed={seed}&frames=4&size=24x24" for seed in (5, 6)
    ]
    rows = [json.loads(line) for line in (tmp_path / "rows.jsonl").read_text().splitlines()]
    assert [row["seed"] for row in rows] == [5, 6] and all(row["bytes"] > 500 for row in rows)
    for row, line in zip(rows, first.splitlines()[2:], strict=False):
        (kept, counted), (others, slow) = random_scenes.kept(row), random_scenes.kept(row, counts=False)
        assert counted + slow == len(row["bodies"]) > 0 == kept + others == random_scenes.kept(row, "seen")[0]
        assert f"{kept} of {counted}" in line
    strips = Image.open(tmp_path / "worst.png").height // 24
    assert strips == sum(1 + len(row["db"]) for row in rows)


def test_a_truth_keeps_its_bodies():
    """The views themselves are far above the views without a body; those are at 0 dB above themselves."""
    source = "synthetic:random?seed=6&frames=5&size=32x32"
    views = random_scenes.load(source).test
    by_place = {(v.viewmat.tobytes(), v.time): v.image for v in views}
    level = Mock(picture=lambda camera, time: by_place[camera.viewmat.tobytes(), time] / 255)
    assert all(body["gain"] > 30 for body in random_scenes.gains(source, level, views))
    (ball,) = random_scenes.movers(source, views)
    by_place = dict(zip(by_place, ball.without, strict=True))
    assert [body["gain"] for body in random_scenes.gains(source, level, views)] == [pytest.approx(0, abs=1e-9)]


def test_what_a_log_says_of_time_and_decisions():
    """A step takes a second; the fifth has a trial of nine seconds before it, and the first one compiles."""
    seconds = 60 + np.arange(30) + 9 * (np.arange(30) >= 5)
    records = [{"loss": 1.0, "seconds": float(s)} for s in seconds]
    records[5]["predicted_gain"] = 2.5
    steps, others = random_scenes.split_seconds(records)
    assert (steps, others) == (28 + random_scenes.USUAL, 10 - random_scenes.USUAL)
    assert random_scenes.decisions(records) == {"predicted_gain": 2.5}
