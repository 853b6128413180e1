"""The files in packaging/ that describe the media type to systems, as the programs that read them see them."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from pd4dgs_codec.web.headers import media_type

PACKAGING = Path(__file__).parents[2] / "packaging"
TYPE = media_type("scene.pd4")


@pytest.fixture
def nameless(tmp_path, scene_bytes) -> Path:
    """A scene whose name tells nothing."""
    path = tmp_path / "nameless"
    path.write_bytes(scene_bytes)
    return path


def _says(*command: str | Path, **environment: str) -> str:
    if shutil.which(str(command[0])) is None:
        pytest.skip(f"no {command[0]} on this machine")
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | environment, check=True)
    return done.stdout.strip()


def test_file_knows_scenes_and_their_version(nameless, tmp_path):
    magic = PACKAGING / "pd4.magic"
    assert _says("file", "-bm", magic, nameless) == "PD4 dynamic Gaussian splats, version 5.0"
    assert _says("file", "-bm", magic, "--mime-type", nameless) == TYPE
    (tmp_path / "other").write_bytes(nameless.read_bytes().replace(b"\r\n", b"\n", 1))  # as a text transfer breaks it
    assert "PD4" not in _says("file", "-bm", magic, tmp_path / "other")


def test_desktops_know_scenes_by_content_and_name(nameless, tmp_path):
    data = tmp_path / "share"
    (data / "mime" / "packages").mkdir(parents=True)
    shutil.copy(PACKAGING / "vnd.pd4dgs.xml", data / "mime" / "packages")
    _says("update-mime-database", data / "mime")
    assert f":{TYPE}:*.pd4" in (data / "mime" / "globs2").read_text()
    (tmp_path / "named.pd4").write_bytes(b"cut")
    for path in (nameless, tmp_path / "named.pd4"):
        assert f"content-type: {TYPE}\n" in _says("gio", "info", path, XDG_DATA_HOME=str(data), LANG="C") + "\n"


def test_the_form_names_type_and_signature(scene_bytes):
    form = (PACKAGING / "vnd.pd4dgs.txt").read_text()
    kind, _, name = TYPE.partition("/")
    assert f"Type name: {kind}\n" in form and f"Subtype name: {name}\n" in form
    assert f"Magic number(s): {scene_bytes[:8].hex(' ').upper()} (hexadecimal) at offset 0" in form
    sections = ("Encoding", "Security", "Interoperability", "Fragment identifier")
    assert all(f"{each} considerations:" in form for each in sections)
