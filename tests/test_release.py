"""What is published: one version, licences, addresses, the npm package, and the Pythons that CI installs on."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import npm_package
import pytest

from pd4dgs_codec import __version__

ROOT = Path(__file__).resolve().parents[1]
URL = "https://example.org/someone/pd4dgs-codec"


def text(name: str, root: Path = ROOT) -> str:
    return (root / name).read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("file", "pattern"),
    [
        ("player/package.json", r'^  "version": "(.*)"'),
        ("CITATION.cff", r"^version: (.*)$"),
        ("packaging/conda/recipe.yaml", r"^  version: (.*)$"),
    ],
)
def test_all_that_is_published_has_the_version_of_the_package(file, pattern):
    assert re.findall(pattern, text(file), flags=re.MULTILINE)[0] == __version__


def test_ci_installs_on_each_python_that_the_package_names():
    named = re.findall(r'"Programming Language :: Python :: (3\.\d+)"', text("pyproject.toml"))
    matrix = re.search(r"python: \[(.*)\]", text(".github/workflows/ci.yml"))
    assert matrix is not None and re.findall(r'"([\d.]+)"', matrix[1]) == named


def test_a_release_has_public_addresses_and_no_dead_links(tmp_path):
    """tools/public_url.py changes a copy of these files."""
    for name in ("pyproject.toml", "CITATION.cff", "README.md", "player/README.md", "player/package.json"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    (tmp_path / "tools").mkdir()
    shutil.copy(ROOT / "tools" / "public_url.py", tmp_path / "tools")
    subprocess.run([sys.executable, tmp_path / "tools" / "public_url.py", URL + "/"], check=True)
    assert f'[project.urls]\nHomepage = "{URL}"\n' in text("pyproject.toml", tmp_path)
    assert json.loads(text("player/package.json", tmp_path))["repository"]["url"] == f"git+{URL}.git"
    assert text("CITATION.cff", tmp_path).endswith(f"repository-code: {URL}\n")
    for name in ("README.md", "player/README.md"):
        links = re.findall(r"\]\(([^)]+)\)", text(name, tmp_path))
        assert links and all(link.startswith(("https:", "#")) for link in links)
    assert f"then finer parts]({URL}/raw/HEAD/docs/img/refining.gif)" in text("README.md", tmp_path)


def test_the_repository_names_no_address_of_its_own():
    assert "project.urls" not in text("pyproject.toml") and "repository" not in json.loads(text("player/package.json"))


@pytest.mark.parametrize("page", ["SECURITY.md", "docs/robustness.md"])
def test_every_promise_names_tests_that_exist(page):
    """Each after its file, perhaps by the beginning of its name."""
    folder, found = ROOT / "tests", 0
    for name in re.findall(r"`((?:[\w/]+\.py)|(?:test_\w+…?))`", text(page)):
        if name.endswith(".py"):
            path = folder / name.removeprefix("tests/")
        else:
            begins = "^def " + (name[:-1] if name.endswith("…") else rf"{name}\(")
            assert re.search(begins, path.read_text(), re.MULTILINE), f"{page}: {path.name} has no {name}"
            found += 1
    assert found > 20


def test_the_npm_package_has_all_that_it_exports(tmp_path):
    package = tmp_path / "package"
    npm_package.main(str(package))
    about = json.loads(text("package.json", package))
    wanted = {entry["default"] for entry in about["exports"].values()} | set(about["files"]) | {"LICENSE"}
    assert all((package / name).exists() for name in wanted if not name.startswith("types/"))
    workers = text("render/workers.js", package)
    assert "import.meta" not in workers and workers.count("addEventListener") >= 3
    assert not list(package.rglob("test*"))


def test_the_wheel_gets_every_package_and_what_the_page_needs():
    listed = set(re.findall(r'^    "(pd4dgs_codec[\w.]*)",$', text("pyproject.toml"), flags=re.MULTILINE))
    rooms = {str(p.parent.relative_to(ROOT)).replace("/", ".") for p in (ROOT / "pd4dgs_codec").rglob("__init__.py")}
    player = {
        ".".join(["pd4dgs_codec", "player", *Path(part).with_suffix("").parts])
        for part in ("decode", "kinds", "render")
    }
    assert listed == rooms | player | {"pd4dgs_codec.player", "pd4dgs_codec.samples"}
