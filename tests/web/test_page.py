"""The one-file page: it needs nothing else, and a notebook gets it in a frame."""

import base64
import gzip
import html
import re
import shutil
import subprocess

import pytest
from strategies import make_scene, small_file

from pd4dgs_codec import encode, show
from pd4dgs_codec.errors import DataError, DecodeError, DeliveryError
from pd4dgs_codec.web import page


def code_of(text: str) -> str:
    """The player's code in a page."""
    parts = re.findall(r'class="code">([^<]*)<', text)
    return gzip.decompress(b"".join(map(base64.b64decode, parts))).decode()


def test_a_page_asks_for_nothing_but_a_scene():
    text = page.page()
    text += code_of(text)
    asked = re.findall(r'(?:\b(?:import|from)|URL\(|import\() ?"([^"]+)"', text) + re.findall(
        r' (?:src|href)="([^"]+)"', text
    )
    assert set(asked) <= {"data:,"} and not re.search(r"https?://", text)


def test_a_notebook_gets_a_frame_that_holds_everything(tmp_path):
    scene = make_scene(0)
    data = encode(scene, effort=1)
    (tmp_path / "scene.pd4").write_bytes(data)
    pages = [show(given).page for given in (data, tmp_path / "scene.pd4", str(tmp_path / "scene.pd4"), scene)]
    assert pages[0] == pages[1] == pages[2] and "import.meta" not in code_of(pages[0])
    assert len(re.findall("</script", pages[0])) == 4  # scene, code in two parts, what unpacks it
    frame = show(data, width='50%" x="', height=200)._repr_html_()
    (source,) = re.findall(r'srcdoc="([^"]*)"', frame)
    assert html.unescape(source) == pages[0] and "height:200px" in frame and 'x="' not in frame
    remote = show('https://example.org/a.pd4?b=">').page
    assert 'data-src="https://example.org/a.pd4?b=&quot;&gt;"' in remote and len(remote) < len(pages[0])


def test_a_page_begins_with_its_picture():
    """Then comes the loader, and the player without what it says twice."""
    text = page.page("a.pd4", still=page.Still(b"RIFF" + bytes(2900), 1.8, 4 / 3, "rgb(1,2,3)"))
    picture, loader, last = text.index("</pd4-player>"), text.index("new Worker("), text.rindex('class="code"')
    assert picture < 6000 and picture < loader < last and len(text) < 102_000 and "background:rgb(1,2,3)" in text
    code = code_of(text)
    assert len(re.findall(r"^class DecodeError", code, re.MULTILINE)) == 1


@pytest.mark.parametrize("cut", [0, 100, -1])
def test_a_notebook_shows_no_damaged_scene(cut):
    with pytest.raises(DecodeError):
        show(small_file()[:cut])


def test_a_player_that_is_nowhere_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(page, "__file__", str(tmp_path / "a" / "b" / "page.py"))
    with pytest.raises(DataError, match="found no player"):
        page.page()


def test_a_bundle_runs_like_its_modules(tmp_path):
    """Comments and indentation go; names of one module stay apart from those of another."""
    (tmp_path / "a.js").write_text(
        """// A module.
import { x as y, twice } from "./b.js";
export { twice } from "./b.js";

/** Documented. @type {number} */
const z = 1;
console.log(twice(y) + /** @type {number} */ (z), "a // b", `c // ${ "d" }`);
"""
    )
    (tmp_path / "b.js").write_text(
        "const z = 20;\nexport const x = z; // same\n/** Twice. */\nexport function twice(n) {\n  return 2 * n;\n}\n"
    )
    bundled = page.bundle(tmp_path, "a.js")
    assert not any(gone in bundled for gone in ("Twice.", "A module", "same", "\n  return"))
    node = shutil.which("node")
    if node is not None:
        done = subprocess.run([node, "-e", bundled], capture_output=True, text=True, timeout=60, check=True)
        assert done.stdout == "41 a // b c // d\n"


@pytest.mark.parametrize("source", ["export default 1;\n", 'import * as x from "./y.js";\n'])
def test_other_forms_of_import_and_export_are_refused(tmp_path, source):
    (tmp_path / "a.js").write_text(source)
    with pytest.raises(DeliveryError, match="cannot bundle"):
        page.bundle(tmp_path, "a.js")
