"""Inputs as users have them, made by the scripts of a folder `cases` beside the shared data, are read well."""

import re
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pytest
from browser import ELEMENT, TIMEOUT_MS, until
from common import ROOT, SHARED
from PIL import Image
from strategies import assert_same_scene, make_scene

from pd4dgs_codec import decode, encode
from pd4dgs_codec.data.dataset import load
from pd4dgs_codec.data.view import Dataset, View
from pd4dgs_codec.errors import DamageWarning, DataError, Pd4Error
from pd4dgs_codec.interchange.splats import read_splats
from pd4dgs_codec.web.client import SceneClient
from pd4dgs_codec.web.page import page
from pd4dgs_codec.web.server import Server

CASES = SHARED.parent / "cases"
pytestmark = pytest.mark.skipif(not CASES.is_dir(), reason=f"{CASES} is not there (set PD4DGS_SHARED)")
Make = Callable[[int], Path]


@pytest.fixture
def made(tmp_path) -> Make:
    """Makes the inputs of a case; returns their folder."""

    def make(number: int) -> Path:
        command = [sys.executable, str(CASES / f"case{number}.py"), str(tmp_path)]
        subprocess.run(command, check=True, capture_output=True)
        return tmp_path

    return make


def views(data: Dataset) -> dict[str, View]:
    """All views by name."""
    return {view.name: view for view in (*data.train, *data.test)}


def told(data: Dataset) -> str:
    """All lines about a data set."""
    return "\n".join([*data.summary(), *data.remarks()])


def test_1_times_without_time_are_the_numbers_of_the_names(made):
    folder = made(1)
    data = {kind: load(folder / kind) for kind in ("sorted", "shuffled", "timed")}
    times = {kind: {name: view.time for name, view in views(given).items()} for kind, given in data.items()}
    assert times["sorted"] == times["shuffled"] and len(times["timed"]) == 64
    for name, time in times["timed"].items():
        assert times["shuffled"][name] == pytest.approx(time, abs=1e-9)
    assert "from the last number of each name" in told(data["shuffled"]) and "from `time` of" in told(data["timed"])


def test_2_what_is_not_there_is_left_out_and_counted(made):
    folder = made(2)
    no_test = r"no picture of these test frames is there, so that they count as none \(1\): {} of transforms_test\.json"
    for kind, count, remark in (
        ("notest", 16, no_test.format(16)),
        ("emptytest", 16, no_test.format(0)),
        ("gone", 14, r"views left out, as their picture is missing \(2\): train/0005\.png, train/0009\.png"),
        ("pngpng", 16, ""),
    ):
        data = load(folder / kind)
        assert len(views(data)) == count and data.test and re.fullmatch(remark, "\n".join(data.remarks())), kind


def test_3_the_largest_model_is_read(made):
    folder = made(3)
    for kind in ("split", "only1", "empty0"):
        data = load(folder / kind)
        assert len(views(data)) == 21 and "21 of 24 pictures have a pose in sparse/1" in data.summary()[0]
        assert ("sparse/0 with 3 pictures" in told(data)) == (kind == "split")


def test_4_points_that_span_no_volume_are_not_used(made):
    folder = made(4)
    box = load(folder / "nopoints").box
    for kind, flat in {"bin0": 0, "txt0": 0, "ply0": 0, "one": 1, "three": 3, "same": 500, "line": 100}.items():
        data = load(folder / kind)
        assert data.points is None and data.summary()[3] == "start points: 0"
        assert data.remarks() == [f"start points not used: {flat} that span no volume"] * bool(flat)
        np.testing.assert_allclose(data.box, box, atol=1e-5)


def test_5_a_scene_is_the_same_in_any_unit_and_at_any_place(made):
    """Relative to its own size and place, on which training depends alone (see `test_units`)."""
    folder = made(5)
    places = {"far": (-1220.8, 10554.5, 16.8), "utm": (465000.0, 5243000.0, 410.0)}
    for form in ("", "_json"):
        usual = load(folder / f"unit{form}")
        for kind, scale in {"x10": 10, "x100": 100, "big": 1000, "tiny": 1e-3, "far": 1, "utm": 1}.items():
            data, place = load(folder / f"{kind}{form}"), np.array(places.get(kind, (0, 0, 0)))
            assert any(data.shift) == (kind in places) == ("the scene is far from 0 and was moved: 0 is" in told(data))
            moved = place - data.shift
            tolerance = 2e-5 if form else 2e-2  # text with 12 and points with 6 digits
            np.testing.assert_allclose((data.box - moved) / scale, usual.box, atol=tolerance)
            for found, expected in zip(data.train, usual.train, strict=True):
                np.testing.assert_allclose(found.viewmat[:3, :3], expected.viewmat[:3, :3], atol=1e-6)
                eyes = [-v.viewmat[:3, :3].T.astype(float) @ v.viewmat[:3, 3] for v in (found, expected)]
                np.testing.assert_allclose((eyes[0] - moved) / scale, eyes[1], atol=2e-5)
            assert form or len(data.points) == len(usual.points)


#: Files that are refused, and how many Gaussians others have, if not 400.
REFUSED = {
    "cloud.ply": "is a point cloud without f_dc_0",
    "surfels.ply": "has no property scale_2",
    "list_in_vertex.ply": "unknown vertex property 'list uchar int neighbours', expected a scalar",
    "empty.ply": "none of 0 Gaussians is finite",
    "cut.ply": "40600 bytes of vertices, expected 41600",
    "packed.ksplat": "is a .ksplat file, expected a PLY, SPZ, SOG, .splat, .splatv or .4dgs file or a checkpoint",
}
DEGREE_0 = {"degree0.ply", "rgb.ply", "packed.splat"}


def test_7_files_of_gaussians_are_known_by_their_content(made):
    folder = made(7)
    names = {path.name for path in folder.iterdir()}
    assert len(names) >= 21 and (names >= REFUSED.keys() | DEGREE_0 or "packed.ply" not in names)
    plain = read_splats(folder / "plain.ply")
    for name in sorted(names):
        if name in REFUSED:
            with pytest.raises(DataError, match=re.escape(REFUSED[name])) as error:
                read_splats(folder / name)
            told = str(error.value).removeprefix(str(folder))
            assert "\n" not in told and "-1" not in told
        elif name == "nanny.ply":
            with pytest.warns(DamageWarning, match="20 of 400 Gaussians are left out"):
                assert len(read_splats(folder / name).means) == 380
        else:
            found = read_splats(folder / name)
            assert len(found.means) == 400 and found.degree == (0 if name in DEGREE_0 else 1), name
            packed = name.startswith("packed")  # rounded, and some in another order
            ordered = (np.sort(s.means, axis=0) if packed else s.means for s in (found, plain))
            np.testing.assert_allclose(*ordered, atol=2e-3 if packed else 1e-6, err_msg=name)


def test_13_masks_of_all_kinds_are_the_same(made):
    folder = made(13)
    expected = load(folder / "png").train[0].mask
    assert 0.8 < expected.mean() < 0.9
    for kind in ("jpg", "alpha", "alpha0", "half", "colmap"):
        data = load(folder / kind)
        agree = np.mean([(view.mask == expected).mean() for view in views(data).values()])
        assert agree == 1 or (kind in ("half", "jpg") and agree > 0.98), (kind, agree)
        assert "masks leave out 16 % of the pixels" in data.summary()[2]
        assert ("masks scaled to 96x96 (16)" in told(data)) == (kind == "half")


def test_15_names_are_found_or_named(made):
    folder = made(15)
    for place in sorted(folder.iterdir()):
        if place.name in ("elsewhere", "windows"):
            with pytest.raises(DataError, match=r"images.+000\.png' is not the name of a file in this folder"):
                load(place)
            continue
        data = load(place, holdout=0)
        files = [path for path in place.rglob("*") if path.is_file() and "images" in path.parts]
        pictures = sorted(np.asarray(Image.open(path).convert("RGB")).tobytes() for path in files)
        assert sorted(view.image.tobytes() for view in data.train) == pictures and len(pictures) == 10, place
        assert ("found under another name (10)" in told(data)) == (place.name in ("case", "wrongext")), place
        told(data).encode()  # no bytes of another encoding
        assert len({view.time for view in data.train}) == (5 if place.name == "rig" else 10)


@contextmanager
def serving(file: Path) -> Iterator[str]:
    """The URL of the server of cases, which serves a file; lengths at which it cuts fit the file's size."""
    text, size = (CASES / "server.py").read_text(), file.stat().st_size
    for there, length in (("CAP = {}", 20_000), ("[:{}]", 30_000), ("[:{}]", 50_000)):
        assert there.format(length) in text
        text = text.replace(there.format(length), there.format(length * size // 100_000))
    module: dict[str, Any] = {"__name__": "server"}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["server.py", str(file)])
        exec(compile(text, "server.py", "exec"), module)
    with ThreadingHTTPServer(("127.0.0.1", 0), module["H"]) as served:
        served.daemon_threads = True
        served.handle_error = lambda *_: None  # of clients that have left
        threading.Thread(target=served.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{served.server_port}"
        served.shutdown()


@pytest.fixture(scope="module")
def server() -> Iterator[tuple[str, bytes]]:
    """The URL of the server of cases, and the file of 5 kB that it serves."""
    file = ROOT / "spec" / "vectors" / "valid" / "lzma-two-deformations.pd4"
    with serving(file) as url:
        yield url, file.read_bytes()


SIGNED = "signed/a?X-Amz-Credential=AKIA%2F20251129%2Feu%2Fs3&sig=a%2Bb%3D"
WHOLE = "plain/a cap/a capcut/a star/a norange/a norangecut/a http10/a weak/a weak/cut redirect/a".split()


@pytest.mark.parametrize("path", [*WHOLE, SIGNED])
@pytest.mark.parametrize("first", [0, 2])
def test_a_server_as_real_ones_are_gives_the_file(server, path, first):
    """At once, and level 0 before the rest, which is asked for by a range."""
    url, data = server
    with SceneClient(f"{url}/{path}", stall=2) as client:
        shown = [*client.scenes(max_layer=first), *client.scenes(max_layer=2)]
    assert [scene.layers for scene in shown] == [(0,), (0, 1), (0, 1, 2)]
    assert_same_scene(shown[-1], decode(data))


@pytest.mark.parametrize(
    "path, says",
    [
        ("gzip/a", "found Content-Encoding gzip, expected identity"),
        ("gzipslow/a", "found Content-Encoding gzip, expected identity"),
        ("spa/a", "not a .pd4 file: it begins with 3c 21 64 6f 63"),
        ("signed/a?sig=1", "answered 403"),
    ],
)
def test_what_is_no_file_is_one_line(server, path, says):
    with SceneClient(f"{server[0]}/{path}", stall=2) as client, pytest.raises(Pd4Error, match=says) as error:
        list(client.scenes())
    assert "\n" not in str(error.value)


@pytest.fixture(scope="module")
def player(browser, tmp_path_factory) -> Iterator[tuple[Any, str, str]]:
    """A browser, the URL of the player's page, and that of the server of cases, which serves a scene of 18 kB."""
    folder = tmp_path_factory.mktemp("player")
    (folder / "index.html").write_text(page())
    (folder / "a.pd4").write_bytes(encode(make_scene(7, anchors=250, kind="gaussian", extent=20), layers=2, effort=1))
    with Server(folder) as own, own.running(), serving(folder / "a.pd4") as url:
        context = browser.new_context(viewport={"width": 160, "height": 120})
        context.set_default_timeout(TIMEOUT_MS)
        yield context, own.url, url


#: What the player says in Chromium, which unpacks gzip by itself. Of an answer that is cut at once, a browser may lose
#: all, so that the player gives up.
SAYS = {
    "spa/a": "not a .pd4 file: it begins with 3c21646f63",
    "signed/a?sig=1": "answered 403",
    "weak/cut": "connection",
}


@pytest.mark.parametrize("path", [*WHOLE, SIGNED, "gzip/a", "gzipslow/a", "shifted/a", "spa/a", "signed/a?sig=1"])
def test_the_player_plays_from_such_servers_or_says_why_not(player, path):
    context, page_url, url = player
    tab = context.new_page()
    tab.goto(f"{page_url}?src={quote(f'{url}/{path}', safe='')}")
    alert = f"{ELEMENT}.shadowRoot?.querySelector('[role=alert]').innerText"
    until(tab, f"{ELEMENT}.player?.status.level === 2 || {alert}")
    told = tab.evaluate(alert)
    assert (SAYS[path] in told and "\n" not in told) if told else path not in ("spa/a", "signed/a?sig=1")
    tab.close()
