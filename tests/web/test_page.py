"""The player packed: code stays as it is, files stand alone, and a notebook gets a frame."""

from __future__ import annotations

import html
import re

import pytest
from strategies import make_scene

from pd4dgs_codec import encode, show
from pd4dgs_codec.errors import DataError, DecodeError, DeliveryError
from pd4dgs_codec.web import page


def test_a_page_asks_for_nothing_but_a_scene():
    text = page.page()
    asked = re.findall(r'(?:\b(?:import|from)|URL\(|import\() ?"([^"]+)"', text) + re.findall(
        r' (?:src|href)="([^"]+)"', text
    )
    assert set(asked) <= {"data:,"} and not re.search(r"https?://", text)


def test_a_notebook_gets_a_frame_that_holds_everything(tmp_path):
    scene = make_scene(0)
    data = encode(scene, effort=1)
    (tmp_path / "scene.pd4").write_bytes(data)
    pages = [show(given).page for given in (data, tmp_path / "scene.pd4", str(tmp_path / "scene.pd4"), scene)]
    assert pages[0] == pages[1] == pages[2] and "import.meta" not in pages[0]
    assert len(re.findall("</script", pages[0])) == 3  # scene, workers and player
    frame = show(data, width='50%" x="', height=200)._repr_html_()
    (source,) = re.findall(r'srcdoc="([^"]*)"', frame)
    assert html.unescape(source) == pages[0] and "height:200px" in frame and 'x="' not in frame
    remote = show('https://example.org/a.pd4?b=">').page
    assert 'data-src="https://example.org/a.pd4?b=&quot;&gt;"' in remote and len(remote) < len(pages[0])


@pytest.mark.parametrize("cut", [0, 100, -1])
def test_a_notebook_shows_no_damaged_scene(cut):
    with pytest.raises(DecodeError):
        show(encode(make_scene(0), effort=1)[:cut])


def test_a_player_that_is_nowhere_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(page, "__file__", str(tmp_path / "a" / "b" / "page.py"))
    with pytest.raises(DataError, match="holds no player"):
        page.page()


@pytest.mark.parametrize(
    ("source", "packed"),
    [
        ("let a = 1; // one\n\n  /* two */ let b = 2;\n", "let a = 1;\nlet b = 2;\n"),
        ("const s = \"// no\" + '/* no */'; // yes", "const s = \"// no\" + '/* no */';\n"),
        (
            "f(`  // no\n  ${ {a: `/* ${x} */`}.a /* yes */ }\n  b`);",
            "f(`  // no\n  ${ {a: `/* ${x} */`}.a  }\n  b`);\n",
        ),
        ("x = a / b; // c / d\ny = /[/]\\/'/.test(z);\n", "x = a / b;\ny = /[/]\\/'/.test(z);\n"),
    ],
)
def test_packing_leaves_code_as_it_is(source, packed):
    assert page.strip(source) == packed


@pytest.mark.parametrize(
    "source", ["export default 1;\n", 'import * as x from "./y.js";\n', "/* no end", "`${", "'\n'"]
)
def test_packing_refuses_what_it_does_not_know(tmp_path, source):
    (tmp_path / "a.js").write_text(source)
    with pytest.raises(DeliveryError):
        page.bundle(tmp_path, "a.js")


def test_packing_keeps_names_apart_and_finds_circles(tmp_path):
    (tmp_path / "a.js").write_text('import { x as y } from "./b.js";\nconst z = y;\nexport const x = z + 1;\n')
    (tmp_path / "b.js").write_text("const z = 1;\nexport const x = z;\n")
    packed = page.bundle(tmp_path, "a.js")
    assert packed.index("const z = 1") < packed.index("const {x:y}=m0") < packed.index("export{x}")
    (tmp_path / "b.js").write_text('import { x } from "./a.js";\n')
    with pytest.raises(DeliveryError, match="imports itself"):
        page.bundle(tmp_path, "a.js")
