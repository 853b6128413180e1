"""The pages that the package writes state a policy (CSP), under which they work in Chromium."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from browser import ELEMENT, TIMEOUT_MS, until, wait_for_level

from pd4dgs_codec import show
from pd4dgs_codec.web.package import choice_page, library, package
from pd4dgs_codec.web.page import Still, page, with_policy
from pd4dgs_codec.web.server import Server

#: Notes what a policy forbids.
NOTE = """globalThis.refused = [];
addEventListener("securitypolicyviolation", ({ effectiveDirective: kind, blockedURI }) => {
  refused.push(`${kind} ${blockedURI}`);
});"""
PICTURE = (
    b"GIF89a\1\0\1\0\x80\0\0\0\0\0\xff\xff\xff!\xf9\4\1\0\0\0\0,\0\0\0\0\1\0\1\0\0\2\2D\1\0;"  # browsers go by content
)


@pytest.fixture(scope="module")
def served(scene_bytes, tmp_path_factory) -> Iterator[Server]:
    """A package, its library, a folder to choose from, and pages that hold or name a scene."""
    root = tmp_path_factory.mktemp("pages")
    still = Still(PICTURE, 1.5, 4 / 3, "rgb(1,2,3)")
    (root / "library" / "one").mkdir(parents=True)
    for name, content in package(scene_bytes, draw=lambda scene, prefixes: still).items():
        (root / "library" / "one" / name).write_bytes(content)
    for name, content in library(root / "library").items():
        (root / "library" / name).write_bytes(content)
    (root / "a.pd4").write_bytes(scene_bytes)
    (root / "index.html").write_text(page())
    (root / "choice.html").write_bytes(choice_page({"a.pd4": len(scene_bytes)}))
    (root / "held.html").write_text(show(scene_bytes).page)
    with Server(root) as server, server.running():
        yield server


@pytest.fixture
def tab(browser) -> Iterator[Any]:
    context = browser.new_context(viewport={"width": 320, "height": 240})
    context.set_default_timeout(TIMEOUT_MS)
    context.add_init_script(NOTE)
    yield context.new_page()
    context.close()


@pytest.mark.parametrize("name", ["library/one/", "index.html?src=a.pd4", "held.html", "held.html as a file"])
def test_a_player_works_under_its_policy(tab, served, name):
    file, _, how = name.partition(" ")
    tab.goto((Path(served.root) / file).as_uri() if how else served.url + file)
    wait_for_level(tab, 2)
    assert tab.evaluate("refused") == []
    assert tab.evaluate(f"getComputedStyle({ELEMENT}).position") == "relative"  # of the page's style

    tries = {
        "script-src-elem": "b.append(Object.assign(document.createElement('script'), { text: 'globalThis.ran = 1' }))",
        "style-src-attr": "b.innerHTML += '<p style=\"color: red\">'",
        "img-src": "(new Image()).src = 'http://127.0.0.2:9/'",
        "connect-src": "fetch('http://127.0.0.2:9/').catch(() => {})",
    }
    if name.startswith("index"):
        del tries["connect-src"]  # it plays any address
    for kind, script in tries.items():
        tab.evaluate(f"{{ const b = document.body; {script}; }}")
        until(tab, f"refused.at(-1)?.startsWith('{kind} ')")
    assert len(tab.evaluate("refused")) == len(tries) and tab.evaluate("globalThis.ran") is None


def test_the_library_and_the_choice_work_under_their_policies(tab, served):
    tab.goto(served.url + "library/")
    assert tab.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(17, 17, 17)"
    tab.get_by_role("link").click()
    wait_for_level(tab, 2)
    tab.goto(served.url + "choice.html")
    wait_for_level(tab.frames[1], 2)
    tab.evaluate("document.links[0].removeAttribute('aria-current')")
    tab.get_by_role("link").click()  # the page's script marks it
    assert tab.get_by_role("link").get_attribute("aria-current") == "true"
    assert tab.evaluate("refused") == []


def test_a_package_shows_its_own_scene_alone(tab, served):
    """Whatever the address asks for."""
    asked: list[str] = []
    tab.on("request", lambda request: asked.append(request.url))
    tab.goto(served.url + "library/one/?src=../../a.pd4")
    wait_for_level(tab, 2)
    assert [url for url in asked[1:] if url.endswith(".pd4")] == [served.url + "library/one/scene.pd4"]


def test_a_policy_names_what_is_in_the_page():
    text = '<!doctype html><meta charset="utf-8"><style>a</style><script src="x"></script><script>\nb</script>'
    stated = with_policy(text, img="'self'")
    assert stated.replace("; style-src 'sha256-ypeBEsobvcr6wjGzmiPcTaeG7/gUfE5yuYB3ha/uSLs='", "") != stated
    assert stated.index("Content-Security-Policy") < stated.index("<style") and "img-src 'self'" in stated
    assert stated.count("'sha256-") == 2 and "default-src 'none'" in stated and "unsafe-inline" not in stated
