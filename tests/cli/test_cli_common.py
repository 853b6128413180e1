"""Options, help, usage errors and the dispatcher."""

import json
import re
import shlex
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import pytest

from pd4dgs_codec import FORMAT_VERSION
from pd4dgs_codec import __main__ as dispatcher
from pd4dgs_codec.cli import common
from pd4dgs_codec.data.synthetic import STAGES

ROOT = Path(__file__).resolve().parents[2]
VERBS = {verb: import_module(f"pd4dgs_codec.cli.{dispatcher.MODULES.get(verb, verb)}") for verb in dispatcher.VERBS}


@pytest.mark.parametrize("verb", VERBS)
def test_help_has_a_summary_an_example_and_exits_0(verb, capsys):
    with pytest.raises(SystemExit) as ended:
        VERBS[verb].main(["--help"])
    out, err = capsys.readouterr()
    assert ended.value.code == 0 and err == ""
    assert out.startswith(f"usage: pd4dgs-{verb} ")
    assert "example" in out and f"  pd4dgs-{verb} " in out and "exit codes" in out
    assert max(map(len, out.splitlines())) <= 120


@pytest.mark.parametrize("verb", ("train", "render", "eval"))
def test_help_lists_every_synthetic_scene(verb):
    text = VERBS[verb].parser().format_help()
    for name in STAGES:
        assert f"synthetic:{name}" in text


def commands() -> Iterator[str]:
    """The command lines of the pages and of the examples of --help."""
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))):
        for block in re.findall(r"^```(?:bash|sh)\n(.*?)^```$", page.read_text("utf-8"), re.DOTALL | re.MULTILINE):
            yield from block.splitlines()
    for module in VERBS.values():
        yield from module.parser().format_help().partition("\nexamples:\n")[2].splitlines()


def test_every_command_that_is_shown_has_options_that_exist(monkeypatch):
    parsed = list[str]()
    monkeypatch.setattr(common, "run", lambda parser, action, argv: parsed.append(parser.parse_args(argv)) or 0)
    for line in commands():
        for part in line.split(" | "):
            words = shlex.split(part, comments=True)
            if words and words[0].startswith("pd4dgs-") and words[-1] != "--help":
                argv = words[1 : words.index(">") if ">" in words else None]
                assert VERBS[words[0].removeprefix("pd4dgs-")].main(argv) == 0, line
    assert len(parsed) > 60


def test_dispatcher_runs_verbs_and_refuses_others(scene_pd4, capsys):
    assert dispatcher.main(["info", str(scene_pd4), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["bytes"] == scene_pd4.stat().st_size
    assert dispatcher.main(["explode"]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert dispatcher.main([]) == 2
    assert dispatcher.main(["--help"]) == 0
    out = capsys.readouterr().out
    assert all(verb in out for verb in VERBS)


def test_version_names_release_and_format(capsys):
    with pytest.raises(SystemExit) as ended:
        VERBS["encode"].main(["--version"])
    out = capsys.readouterr().out
    assert ended.value.code == 0 and out.startswith("pd4dgs-encode ") and out.endswith(f"format {FORMAT_VERSION}\n")


def test_help_and_usage_errors_load_no_heavy_module(python):
    program = (
        "import sys\nfrom importlib import import_module\n"
        f"for name in {[module.__name__ for module in VERBS.values()]}:\n"
        "    module = import_module(name)\n    module.parser().format_help()\n    module.main(['--nothing'])\n"
        "print([m for m in ('torch', 'numba', 'numpy', 'PIL') if m in sys.modules])"
    )
    assert python(program).strip() == "['numpy']"  # by the fields of TrainConfig


@pytest.mark.parametrize(
    "total, says",
    [(3, ["packing: 1 of 3 steps", "packing: 2 of 3 steps"]), (None, ["packing: step 1", "packing: step 2"])],
)
def test_progress_without_a_terminal_is_a_line_now_and_then(monkeypatch, capsys, total, says):
    monkeypatch.setattr(common, "LINE_SECONDS", -1.0)
    with common.progress_bar(total, "steps", "packing") as step:
        step()
        step()
    assert capsys.readouterr().err.splitlines() == says


def test_links_and_other_spellings_name_one_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a").touch()
    (tmp_path / "link").symlink_to("a")
    assert common.same_file("a", str(tmp_path / "a")) and common.same_file("./link", "a")
    assert common.same_file("missing", "./missing") and not common.same_file("a", "b")
    assert not common.same_file("-", "-") and not common.same_file("-", "./-"), "stdin is no file"
