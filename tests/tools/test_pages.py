"""The pages that tools write: each is what its figures make it, small enough for git, and its pictures are there."""

from __future__ import annotations

import json
import math
import re
import sys
from functools import partial

import batch
import evaluation
import interchange
import latency
import long_captures
import omissions
import performance
import player_page
import precision
import pytest
import results
import slices
import training_growth
from pages import page, peers, tables
from pages import scenes as places
from pages.page import Page
from pages.paper.tables import TABLES
from tiny import checkpoint_of, filmed_scene, write_views

from pd4dgs_codec.errors import DataError

ROOT = page.ROOT
DOCS = ROOT / "docs"
TOOLS = (results, evaluation, precision, latency, interchange, omissions, performance, player_page, slices)
TOOLS += (batch, long_captures, training_growth)
PAGES = [tool.PAGE for tool in TOOLS]
PAGES += [table.page for table in TABLES.values()]
#: Bytes that a text and a picture may have.
TEXT, PICTURE = 50_000, 300_000
PICTURES = {".png", ".jpg", ".gif"}


@pytest.mark.parametrize("made", PAGES, ids=lambda made: made.name)
def test_a_page_is_what_its_figures_make_it(made):
    rows = made.read(DOCS)
    assert rows and all(re.fullmatch("[0-9a-f]{7}(, changed)?", row["commit"]) for row in rows)
    text = (DOCS / f"{made.name}.md").read_text()
    assert made.text(DOCS, rows) == text and f"`python tools/{made.tool}`" in text


def test_the_readme_shows_a_few_rows_of_the_results():
    text = (ROOT / "README.md").read_text()
    rows = [row for row in results.PAGE.read(DOCS) if row["name"] in results.SHORT]
    block = tables.short_table(rows, results.SHORT)
    assert len(block.splitlines()) == 2 + 3
    assert page.filled(text, "results", "results.py", block, ROOT / "README.md") == text


def test_what_is_generated_is_small():
    for path in DOCS.rglob("*"):
        if path.is_file() and path.parent.name != "api":  # made by the site's tool, not in git
            assert path.stat().st_size <= (PICTURE if path.suffix in PICTURES else TEXT), path


def test_pages_show_the_pictures_that_are_there():
    shown = set()
    for path in [ROOT / "README.md", *DOCS.rglob("*.md")]:
        shown |= {(path.parent / target).resolve() for target in re.findall(r"!\[[^]]*\]\(([^)]+)\)", path.read_text())}
    assert shown == {path for path in DOCS.rglob("*") if path.suffix in PICTURES}


# -- how a page is made ------------------------------------------------------------------------------------------------


def counted(rows) -> str:
    return "\n".join(f"{row['name']}: {row['n']}" for row in rows)


def arguments(tmp_path, *argv):
    return page.options("doc", "abc").parse_args([*argv, "--docs", str(tmp_path), "--out", str(tmp_path)])


def test_a_row_measured_again_leaves_the_others(tmp_path, monkeypatch):
    made, told = Page("numbers", "numbers.py", counted, "Numbers"), iter(range(9))
    monkeypatch.setattr(page, "commit", lambda: "1111111")
    finished = []
    assert page.make(made, "abc", "abc", arguments(tmp_path), lambda name: {"n": next(told)}, finished.append) == 0
    first = (tmp_path / "numbers.md").read_text()
    assert first.startswith("# Numbers\n\nThis page is an artefact. Its figures are of commit `1111111`;")
    assert first.endswith("a: 0\nb: 1\nc: 2\n") and len(finished) == 3
    monkeypatch.setattr(page, "commit", lambda: "2222222, changed")
    assert page.make(made, "abc", "b", arguments(tmp_path, "--only", "b"), lambda name: {"n": next(told)}) == 0
    again = (tmp_path / "numbers.md").read_text()
    assert "`1111111` (a, c) and `2222222, changed` (b)" in again and again.endswith("a: 0\nb: 3\nc: 2\n")
    assert page.make(made, "abc", "", arguments(tmp_path, "--render"), lambda name: {}) == 0
    assert (tmp_path / "numbers.md").read_text() == again


def test_text_around_the_markers_stays(tmp_path):
    made, path = Page("numbers", "numbers.py", counted), tmp_path / "numbers.md"
    path.write_text("# By hand\n\n<!-- numbers: written by tools/numbers.py -->\n<!-- end of numbers -->\nBelow.\n")
    made.write(tmp_path, [{"name": "a", "commit": "1111111", "n": 1 / 3}])
    assert path.read_text().startswith("# By hand\n\n<!--") and path.read_text().endswith("-->\nBelow.\n")
    assert "a: 0.33333333\n" in path.read_text()  # as in the figures
    path.write_text("# Without markers\n")
    with pytest.raises(DataError, match="numbers.md: expected each of these lines once"):
        made.write(tmp_path, [])


def test_failures_are_one_line(tmp_path, capsys):
    def fail(name):
        raise DataError("is broken")

    made = Page("numbers", "numbers.py", counted, "Numbers")
    assert page.make(made, "abc", "a", arguments(tmp_path), fail) == 1
    assert page.make(made, "abc", "", arguments(tmp_path), fail) == 1
    assert capsys.readouterr().err == "numbers: error: is broken\nnumbers: error: none of a, b, c is there\n"
    assert not (tmp_path / "numbers.md").exists()


def test_json_stands_on_lines_and_comes_back():
    value = [{"name": "ä", "levels": [{"level": i, "mpsnr": 1.5} for i in range(9)]}, {}, [], None]
    text = page.dumps(value)
    assert json.loads(text) == value and max(map(len, text.splitlines())) <= page.WIDTH + 2
    with pytest.raises(ValueError, match="not JSON compliant"):
        page.dumps(math.nan)


def test_unpadded_tables_keep_their_cells():
    assert page.unpadded("a\n| x    | y \\| z |\n|------|--------|\n| long |        |") == (
        "a\n| x | y \\| z |\n| - | - |\n| long |  |"
    )


def test_scenes_that_are_not_there_are_named(tmp_path, capsys, monkeypatch):
    gone = places.Scene("gone", str(tmp_path / "gone"))
    monkeypatch.setattr(places, "SCENES", {"gone": gone, "synthetic-fast": places.SCENES["synthetic-fast"]})
    found = places.present(arguments(tmp_path), ["gone", "synthetic-fast"])
    assert [scene.name for scene in found] == ["synthetic-fast"]
    assert capsys.readouterr().out == f"gone: {tmp_path / 'gone'} is not there, left out\n"


def test_the_reports_printed_are_those_of_the_page(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "torchac", None)  # builds for minutes where it was never used
    monkeypatch.setattr(peers, "coder_rows", partial(peers.coder_rows, effort=1))
    monkeypatch.setattr(precision, "PEER_RUNS", 1)
    monkeypatch.setattr(precision, "CODEC", ("--modes", "ans,lzma", "--repeats", "1", "--views", "1"))
    monkeypatch.setattr(precision, "FULL", ("--step-scales", "1,4", "--efforts", "1", "--cold", "0"))
    monkeypatch.setattr(precision, "WAYS_ALL", "oracle float64,kernels,gsplat")
    (tmp_path / "shelf-hand").mkdir()
    checkpoint_of(filmed_scene(), tmp_path / "shelf-hand" / "model.pt")
    scene = places.Scene("shelf-hand", str(write_views(tmp_path)))
    row = precision.measure(scene, tmp_path, tmp_path / "docs")
    printed = page.unpadded(capsys.readouterr().out).splitlines()
    text = precision.render([page.shortened({"name": "shelf-hand", **row})])
    rows = [line for line in text.splitlines() if line.startswith("|")]
    coders = rows.index(
        "| what | coder | bytes | bytes / ours | bytes / ΣR | encode / ours | decode / ours | picture RMSE |"
    )
    of_coders = rows[coders : coders + 2 + 6 + 2 + 4]
    assert of_coders[2].startswith("| symbols | this codec |") and "| none: not installed |" in "".join(of_coders)
    reports = rows[:coders] + rows[coders + len(of_coders) :]
    assert reports == [line for line in printed if line.startswith("|")] and len(reports) > 20
