"""Segments as packages, and the client that fetches what a time needs."""

import hashlib
import json
import re
import shutil
import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import numpy as np
import pytest
import segmented
from common import SHARED
from test_package import NAMESPACE, fake_video

from pd4dgs_codec import decode
from pd4dgs_codec.errors import DataError, DeliveryError
from pd4dgs_codec.format.info import info
from pd4dgs_codec.segments import INDEX, parse, read_index
from pd4dgs_codec.web import manifests
from pd4dgs_codec.web.package import package_segments
from pd4dgs_codec.web.segments import SegmentsClient
from pd4dgs_codec.web.server import Server

SCHEMA = SHARED / "dash-schema" / "DASH-MPD.xsd"


@pytest.fixture(scope="module", params=[False, True], ids=["layers only", "with video"])
def packaged(request):
    return dict(package_segments(segmented.folder(), lambda scene, share: fake_video() if request.param else None))


def test_the_index_gives_every_slice_by_its_bytes(packaged):
    folder, index = read_index(segmented.folder())
    content, shown = json.loads(packaged["index.json"]), parse(packaged[INDEX], "it")
    assert (shown.bases, shown.segments, shown.made) == (index.bases, index.segments, {})
    assert len(packaged[INDEX]) < 60 + 180 * len(index.files)  # players fetch it before anything else
    for row in content["bases"] + content["segments"]:
        data = packaged[row["file"]]
        assert data == (folder / row["file"]).read_bytes() and hashlib.sha256(data).hexdigest() == row["sha256"]
        assert b"".join(data[slice(*part["range"])] for part in row["layers"]) == data
        for part in row["layers"]:
            piece = packaged[part["dash"]["file"]][slice(*part["dash"]["range"])]
            *_, mdat = manifests.boxes(piece)
            assert piece[mdat.content : mdat.end] == data[slice(*part["range"])]
    assert content["seconds"] == 4 and content["bytes"] == sum(file.bytes for file in index.files)


def test_periods_share_the_sets_of_their_base(packaged):
    root = ElementTree.fromstring(packaged["scene.mpd"])
    periods = root.findall("d:Period", NAMESPACE)
    assert [p.get("start") for p in periods] == ["PT0S", "PT1S", "PT2S", "PT3S"]
    assert root.get("mediaPresentationDuration") == "PT4S"
    firsts = []
    for period in periods:
        shared, *own = period.findall("d:AdaptationSet[@contentType='application']", NAMESPACE)
        firsts.append(
            ElementTree.tostring(shared.find(".//d:Representation/d:BaseURL", NAMESPACE)) + shared.get("id").encode()
        )
        ids = [s.find("d:Representation", NAMESPACE).get("id") for s in (shared, *own)]
        after = [
            p.get("value")
            for s in own
            for p in s.findall("d:SupplementalProperty", NAMESPACE)
            if "after" in p.get("schemeIdUri")
        ]
        assert ids == ["B0", "L0", "L1"][: len(ids)] and after == ids[:-1]
    assert len(set(firsts)) == 1


def test_periods_and_videos_end_where_the_next_segment_begins(tmp_path):
    shutil.copytree(segmented.folder(), tmp_path / "in")
    _, index = read_index(tmp_path / "in")
    longer = [replace(s, time_range=(s.time_range[0], s.time_range[1] + 0.25)) for s in index.segments]
    (tmp_path / "in" / INDEX).write_bytes(replace(index, segments=tuple(longer)).packed())
    shares = []
    files = dict(package_segments(tmp_path / "in", lambda scene, share: shares.append(share)))
    root = ElementTree.fromstring(files["scene.mpd"])
    assert [p.get("start") for p in root.findall("d:Period", NAMESPACE)] == ["PT0S", "PT1S", "PT2S", "PT3S"]
    assert root.get("mediaPresentationDuration") == "PT4.25S" and shares == [0.8, 0.8, 0.8, 1.0]
    assert parse(files[INDEX], "it").segments[1].time_range == (1.0, 2.25)


@pytest.mark.skipif(not SCHEMA.exists(), reason=f"no {SCHEMA}")
def test_the_manifest_is_valid(packaged):
    etree = pytest.importorskip("lxml.etree")
    schema = etree.XMLSchema(etree.parse(str(SCHEMA)))
    document = etree.fromstring(packaged["scene.mpd"])
    schema.assertValid(document)
    document[1][-1].set("id", "B0")  # the check can fail
    assert not schema.validate(document)


def test_the_playlist_is_discontinuous_between_segments(packaged):
    assert 'URI="index.json"' in packaged["scene.m3u8"].decode()
    if "fallback.m3u8" not in packaged:
        return
    lines = packaged["fallback.m3u8"].decode().splitlines()
    maps = [line for line in lines if line.startswith("#EXT-X-MAP")]
    assert [re.findall(r"fallback-\d+.mp4", line)[0] for line in maps] == [f"fallback-{i:05d}.mp4" for i in range(4)]
    assert lines.count("#EXT-X-DISCONTINUITY") == 3 and lines[-1] == "#EXT-X-ENDLIST"
    assert all(lines[lines.index(line) - 1] == "#EXT-X-DISCONTINUITY" for line in maps[1:])


def test_names_may_carry_digests(tmp_path):
    files = dict(package_segments(segmented.folder(), immutable=True))
    assert all(re.search(r"-[0-9a-f]{16}\.(pd4|mp4)$", name) for name in files if name.endswith((".pd4", ".mp4")))
    assert {file.file for file in parse(files[INDEX], "it").files} < set(files)
    for row in json.loads(files["index.json"])["segments"]:
        assert row["file"] in files and row["layers"][0]["dash"]["file"] in files


def test_the_command_makes_a_page_that_shows_the_index(cli, tmp_path):
    found = cli("package", segmented.folder(), "-o", tmp_path / "out", "--no-video", "--json")
    assert found.code == 0, found.err
    assert f'data-src="{INDEX}"' in (tmp_path / "out" / "index.html").read_text()
    assert {row["name"] for row in found.json["files"]} == {path.name for path in (tmp_path / "out").iterdir()}
    again = cli("package", segmented.folder(), "-o", tmp_path / "out", "--no-video")
    assert again.code == 1 and "exists already" in again.err
    assert (
        "expected another one" in cli("package", segmented.folder(), "-o", segmented.folder(), "-f", "--no-video").err
    )
    assert not (segmented.folder() / "index.html").exists()


def test_a_segment_that_is_damaged_leaves_no_package(cli, tmp_path):
    shutil.copytree(segmented.folder(), tmp_path / "in")
    last = tmp_path / "in" / "00003.pd4"
    last.write_bytes(last.read_bytes()[:-9])
    found = cli("package", tmp_path / "in", "-o", tmp_path / "out", "--no-video")
    assert found.code == 1 and "00003.pd4: has" in found.err
    assert [path.name for path in tmp_path.iterdir()] == ["in"]


# -- the client --------------------------------------------------------------------------------------------------------


@pytest.fixture
def served(tmp_path):
    shutil.copytree(segmented.folder(), tmp_path / "www")
    with Server(tmp_path / "www") as server, server.running():
        yield server


def test_a_seek_fetches_the_base_once_and_one_segment(served):
    folder, index = read_index(served.root)
    client = SegmentsClient(served.url_of(INDEX))
    prefix = info((folder / index.bases[0].file).read_bytes())["layers"][0]["end"]
    for seconds, number in ((2.5, 2), (0, 0), (3.2, 3), (-5, 0), (99, 3)):
        before = client.received
        part = client.at(seconds)
        own = decode(folder / index.segments[number].file, base=folder / index.bases[0].file)
        assert (part.number, part.problem) == (number, "")
        for name, values in own.tensors.items():
            assert np.array_equal(values, part.scene.tensors[name])
        first = prefix + (folder / INDEX).stat().st_size if seconds == 2.5 else 0
        assert client.received - before == first + index.segments[number].bytes
    assert SegmentsClient(served.url_of(INDEX), max_layer=0).at(2.5).scene.layers == (0,)


def test_what_does_not_come_leaves_the_base_and_the_next_one_comes(served, tmp_path):
    root, index = read_index(served.root)
    other = decode(root / "00003.pd4", base=root / "base-0000.pd4")
    (root / "00000.pd4").unlink()
    (root / "00001.pd4").write_bytes((root / "00001.pd4").read_bytes()[:-9] + bytes(9))
    (root / "00002.pd4").write_bytes((root / "base-0000.pd4").read_bytes())  # of another scene
    client = SegmentsClient(served.url_of(INDEX))
    rows = len(decode(root / "base-0000.pd4").anchor_q)
    for seconds, words in ((0.5, "404"), (1.5, "00001.pd4"), (2.5, "00002.pd4: has")):
        part = client.at(seconds)
        assert words in part.problem.replace(served.url_of(""), "") and "\n" not in part.problem, part.problem
        assert len(part.scene.anchor_q) == rows
    part = client.at(3.5)
    assert part.problem == "" and len(part.scene.anchor_q) == len(other.anchor_q)
    (root / "base-0000.pd4").unlink()
    part = SegmentsClient(served.url_of(INDEX)).at(3.5)
    assert part.scene is None and "404" in part.problem


def test_of_two_segments_that_overlap_both_come_or_the_one_that_does(served):
    root, index = read_index(served.root)
    rows = [
        replace(index.segments[k], time_range=times) for k, times in enumerate(((0, 1.5), (1, 2.5), (2, 3.5), (3, 4)))
    ]
    (root / INDEX).write_bytes(replace(index, segments=tuple(rows)).packed())
    (root / "00002.pd4").unlink()
    client = SegmentsClient(served.url_of(INDEX))

    def shown(seconds):
        return [(part.number, weight, bool(part.problem)) for part, weight in client.shown(seconds)]

    assert shown(0.9) == [(0, 1, False)] and shown(1.125) == [(0, 0.75, False), (1, 0.25, False)]
    assert client.at(1.125).number == 0 and client.at(1.4).number == 1
    assert shown(2.375) == [(1, 1, False), (2, 0, True)] and shown(3.25) == [(2, 0, True), (3, 1, False)]
    (root / "00003.pd4").unlink()
    assert shown(3.25) == [(2, 0, True), (3, 1, True)]


def test_an_index_that_is_missing_or_invalid_is_an_error(served):
    with pytest.raises(DeliveryError, match="404"):
        SegmentsClient(served.url_of("none.json")).at(0)
    (served.root / "odd.json").write_text("{}")
    with pytest.raises(DataError, match="segments_version None"):
        SegmentsClient(served.url_of("odd.json")).at(0)
