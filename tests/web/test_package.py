"""Packages: boxes, manifests and playlists; payloads come back bit for bit."""

import hashlib
import json
import struct
import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import numpy as np
import pytest
from common import ROOT, SHARED
from strategies import LAYER_SETS, make_scene

from pd4dgs_codec import decode, encode
from pd4dgs_codec.cli.package import _still
from pd4dgs_codec.errors import DeliveryError, Malformed, Truncated
from pd4dgs_codec.format import reader
from pd4dgs_codec.format.container import read_preamble, write_chunk, write_preamble
from pd4dgs_codec.format.decoder import every_prefix
from pd4dgs_codec.format.header import pack_header, unpack_header
from pd4dgs_codec.format.info import info
from pd4dgs_codec.web import manifests
from pd4dgs_codec.web.manifests import Video
from pd4dgs_codec.web.package import MPD, PLAYLIST, package

SCHEMA = SHARED / "dash-schema" / "DASH-MPD.xsd"
NAMESPACE = {"d": "urn:mpeg:dash:schema:mpd:2011"}


def fake_video(fps: float = 20.0, samples: tuple[int, ...] = (40, 40, 7)) -> Video:
    """Boxes as an encoder would write them around payloads that no decoder will see."""
    content = manifests.box(b"ftyp", b"iso6\0\0\0\0") + manifests.box(
        b"moov", manifests.box(b"avcC", bytes.fromhex("0164001fff"))
    )
    for i, count in enumerate(samples):
        run = struct.pack(">II", 0x200, count) + struct.pack(">I", 100) * count
        moof = manifests.box(b"moof", manifests.box(b"traf", manifests.box(b"trun", run)))
        content += moof + manifests.box(b"mdat", bytes([i]) * 100 * count)
    return Video(content, 64, 48, fps)


@pytest.fixture(scope="module", params=[False, True], ids=["layers only", "with video"])
def packaged(request, scene_bytes) -> dict[str, bytes]:
    return package(scene_bytes, lambda scene, share: fake_video() if request.param else None)


def _sets(files: dict[str, bytes]) -> list[ElementTree.Element]:
    return ElementTree.fromstring(files[MPD]).findall(".//d:AdaptationSet[@contentType='application']", NAMESPACE)


def _range(text: str) -> slice:
    first, last = map(int, text.split("-"))
    return slice(first, last + 1)


def test_the_segments_give_the_file_back_layer_by_layer(packaged, scene_bytes):
    """A reader that knows boxes and nothing of how these were written."""
    segments, payload, tracks = packaged["scene.mp4"], b"", []
    init, moov = list(manifests.boxes(segments))[:2]
    assert (init.kind, moov.kind) == (b"ftyp", b"moov")
    handlers = manifests.find(segments, b"hdlr", [moov])
    assert [segments[handler.content + 8 : handler.content + 12] for handler in handlers] == [b"meta"] * 3
    for moof in (b for b in manifests.boxes(segments) if b.kind == b"moof"):
        (head,) = manifests.find(segments, b"tfhd", [moof])
        (run,) = manifests.find(segments, b"trun", [moof])
        flags, count, offset, _, size = struct.unpack_from(">IIiII", segments, run.content)
        assert flags == 0x301 and count == 1
        tracks.append(struct.unpack_from(">I", segments, head.content + 4)[0])
        payload += segments[moof.start + offset : moof.start + offset + size]
    assert payload == scene_bytes and tracks == [1, 2, 3]
    overhead = len(segments) - len(scene_bytes)
    assert overhead < 2500


def test_each_layer_is_fetched_by_its_ranges(packaged, scene_bytes):
    groups = _sets(packaged)
    assert len(groups) == 3
    index, got = json.loads(packaged["index.json"]), b""
    for i, (group, row) in enumerate(zip(groups, index["layers"], strict=True)):
        (representation,) = group.findall("d:Representation", NAMESPACE)
        assert representation.get("id") == f"L{i}" and row["layer"] == i
        properties = group.findall("d:SupplementalProperty", NAMESPACE)
        after = [p.get("value") for p in properties if p.get("schemeIdUri") == manifests.AFTER_SCHEME]
        assert after == [f"L{j}" for j in range(i)[-1:]] and "dependencyId" not in representation.attrib
        assert row["depends_on"] == list(range(i))
        file = packaged[str(representation.findtext("d:BaseURL", namespaces=NAMESPACE))]
        (init,) = representation.findall(".//d:Initialization", NAMESPACE)
        (segment,) = representation.findall(".//d:SegmentURL", NAMESPACE)
        piece = file[_range(init.attrib["range"])] + file[_range(segment.attrib["mediaRange"])]
        assert [b.kind for b in manifests.boxes(piece)] == [b"ftyp", b"moov", b"moof", b"mdat"]
        assert slice(*row["dash"]["range"]) == _range(segment.attrib["mediaRange"])
        *_, mdat = manifests.boxes(piece)
        part = scene_bytes[slice(*row["range"])]
        assert piece[mdat.content : mdat.end] == part and hashlib.sha256(part).hexdigest() == row["sha256"]
        got += part
        assert decode(got, max_layer=i).layers == tuple(range(i + 1))
        seconds = float(ElementTree.fromstring(packaged[MPD]).attrib["minBufferTime"][2:-1])
        assert int(representation.attrib["bandwidth"]) * seconds >= 8 * (len(got))
    line = '#EXT-X-SESSION-DATA:DATA-ID="org.pd4dgs.layers",URI="index.json"'
    assert line in packaged[PLAYLIST].decode().splitlines()
    assert got == scene_bytes and index["sha256"] == hashlib.sha256(scene_bytes).hexdigest()


@pytest.mark.skipif(not SCHEMA.exists(), reason=f"no {SCHEMA}")
@pytest.mark.parametrize("layers", LAYER_SETS)
@pytest.mark.parametrize("video", [None, fake_video(), fake_video(29.97, (1,))], ids=["none", "three", "one"])
def test_the_manifest_is_valid(layers, video):
    etree = pytest.importorskip("lxml.etree")
    schema = etree.XMLSchema(etree.parse(str(SCHEMA)))
    data = encode(make_scene(3, layers=layers, anchors=3), layers=2, effort=1)
    document = etree.fromstring(package(data, lambda scene, share: video)[MPD])
    schema.assertValid(document)
    document[0][-1][-1].set("codecs", "application/x-pd4")  # the check can fail
    assert not schema.validate(document)


def test_a_manifest_grows_with_the_slices_and_no_faster():
    """1,023 slices once took 5.2 MB: each named all those before it."""
    data = (ROOT / "spec" / "vectors" / "uncommon" / "slices-1024.pd4").read_bytes()
    files = package(data)
    count = len(json.loads(files["index.json"])["layers"])
    assert count > 1000 and len(files[MPD]) < 1000 * count and len(_sets(files)) == count


def test_the_video_is_listed_fragment_by_fragment(scene_bytes):
    video = fake_video()
    files = package(scene_bytes, lambda scene, share: video)
    init, pieces = manifests.fragments(video.data)
    assert [piece.samples for piece in pieces] == [40, 40, 7]
    playlist = files["fallback.m3u8"].decode().splitlines()
    assert f'#EXT-X-MAP:URI="fallback.mp4",BYTERANGE="{init}@0"' in playlist and playlist[-1] == "#EXT-X-ENDLIST"
    ranges = [line.split(":")[1].split("@") for line in playlist if line.startswith("#EXT-X-BYTERANGE")]
    assert [(int(at), int(at) + int(size)) for size, at in ranges] == [piece[:2] for piece in pieces]
    lengths = [float(line[8:-1]) for line in playlist if line.startswith("#EXTINF:")]
    assert lengths == [2.0, 2.0, 0.35]
    master = files[PLAYLIST].decode()
    assert 'CODECS="avc1.64001f",RESOLUTION=64x48' in master and master.splitlines()[-1] == "fallback.m3u8"
    (group,) = ElementTree.fromstring(files[MPD]).findall(".//d:AdaptationSet[@contentType='video']", NAMESPACE)
    segments = [s.attrib["mediaRange"] for s in group.findall(".//d:SegmentURL", NAMESPACE)]
    assert segments == [f"{piece.start}-{piece.end - 1}" for piece in pieces]


def test_ancillary_chunks_travel_along(scene_bytes):
    preamble = read_preamble(scene_bytes)
    header = unpack_header(preamble.header)
    first = info(scene_bytes)["layers"][0]
    scene_id = scene_bytes[first["offset"] + 8 : first["offset"] + 16]  # chunks behind layer 0 do not change it
    extra = write_chunk(40000, 1, scene_id, b"notes")
    chunks = (header.chunks[0], (40000, 5), *header.chunks[1:], (40000, 5))
    head = write_preamble(pack_header(replace(header, chunks=chunks)))
    data = head + scene_bytes[preamble.size : first["end"]] + extra + scene_bytes[first["end"] :] + extra
    rows = json.loads(package(data)["index.json"])["layers"]
    assert b"".join(data[slice(*row["range"])] for row in rows) == data
    assert rows[1]["range"][0] == first["end"] + len(head) - preamble.size


def test_only_whole_files_of_a_time_that_dash_can_tell(scene_bytes):
    with pytest.raises(Truncated):
        package(scene_bytes[:-1])
    with pytest.raises(Malformed):
        package(scene_bytes + b"x")
    scene = make_scene(3, layers=(0,), anchors=3)
    for time_range, seconds in (((2.0, 2.0), "PT1S"), ((0.0, 0.5), "PT0.5S")):
        files = package(encode(replace(scene, info=replace(scene.info, time_range=time_range)), effort=1))
        assert f'mediaPresentationDuration="{seconds}"'.encode() in files[MPD]
    with pytest.raises(DeliveryError, match="a scene of 1e"):
        package(encode(replace(scene, info=replace(scene.info, time_range=(0.0, 1e10))), effort=1))


def test_another_reader_of_boxes_finds_the_layers(scene_bytes):
    parser, construct = pytest.importorskip("pymp4.parser"), pytest.importorskip("construct")
    boxes = construct.GreedyRange(parser.Box).parse(package(scene_bytes)["scene.mp4"])
    assert [box.type for box in boxes] == [b"ftyp", b"moov", *[b"moof", b"mdat"] * 3]
    assert b"".join(box.data for box in boxes if box.type == b"mdat") == scene_bytes
    assert len([box for box in boxes[1].children if box.type == b"trak"]) == 3


@pytest.mark.parametrize(
    "data",
    [b"\0\0\0\x09ftyp", b"abc", b"\0\0\0\x07ftyp", b"\0\0\0\x01mdat\0\0\0\0\0\0\0\x09", manifests.box(b"ftyp", b"x")],
)
def test_broken_mp4_files_are_refused(data):
    with pytest.raises(DeliveryError):
        manifests.fragments(data)


def test_large_boxes_are_read():
    data = struct.pack(">I4sQ", 1, b"mdat", 20) + b"1234"
    assert list(manifests.boxes(data)) == [manifests.Box(b"mdat", 0, 16, 20)]


# -- the command -------------------------------------------------------------------------------------------------------


def test_the_command_writes_the_folder_whole_or_not_at_all(cli, folder, tmp_path, scene_bytes):
    output = tmp_path / "deep" / "out"
    done = cli("package", folder / "scene.pd4", "-o", output, "--no-video", "--json")
    assert done.code == 0 and done.err == ""
    told = done.json
    assert {row["name"]: row["bytes"] for row in told["files"]} == {p.name: p.stat().st_size for p in output.iterdir()}
    assert (output / "scene.pd4").read_bytes() == scene_bytes and told["video"] is False
    assert cli("package", folder / "scene.pd4", "-o", output, "--no-video").code == 1
    assert cli("package", folder / "scene.pd4", "-o", output, "--no-video", "-f").code == 0
    (folder / "cut.pd4").write_bytes(scene_bytes[:-1])
    done = cli("package", folder / "cut.pd4", "-o", tmp_path / "other")
    assert done.code == 1 and len(done.err.splitlines()) == 1 and not (tmp_path / "other").exists()


def test_without_a_renderer_there_is_a_clear_word(cli, folder, tmp_path, monkeypatch):
    def gone(*_):
        raise ModuleNotFoundError("No module named 'torch'", name="torch")

    monkeypatch.setattr("pd4dgs_codec.cli.package._render", gone)
    done = cli("package", folder / "scene.pd4", "-o", tmp_path / "out")
    assert done.code == 0 and "no 2D video: the module torch" in done.err
    done = cli("package", folder / "scene.pd4", "-o", tmp_path / "other", "-j", 100_000)
    assert done.code == 1 and "threads is 100000" in done.err and not (tmp_path / "other").exists()


@pytest.mark.parametrize("output", ["out", "s3://films/out"])
def test_outputs_are_checked_before_a_video_is_rendered(cli, folder, tmp_path, monkeypatch, output):
    monkeypatch.chdir(tmp_path)
    assert cli("package", folder / "scene.pd4", "-o", "out", "--no-video").code == 0
    monkeypatch.setattr("pd4dgs_codec.cli.package._render", lambda *_: pytest.fail("renders a video"))
    done = cli("package", folder / "scene.pd4", "-o", output)
    assert done.code == 1 and ("exists already" in done.err or "looks like a URI" in done.err)


@pytest.mark.parametrize(
    ("time_range", "camera", "says"), [((0.0, 2.0), False, "no camera"), ((0.0, 1e5), True, "2,000,000 frames")]
)
def test_scenes_that_make_no_video(cli, tmp_path, time_range, camera, says):
    pytest.importorskip("torch")
    scene = make_scene(7, layers=(0,), anchors=3, with_camera=camera)
    (tmp_path / "s.pd4").write_bytes(encode(replace(scene, info=replace(scene.info, time_range=time_range)), effort=1))
    done = cli("package", tmp_path / "s.pd4", "-o", tmp_path / "out", "--json")
    told = done.json
    assert done.code == 0 and told["video"] is False and says in told["why_no_video"] and says in done.err
    assert not (tmp_path / "out" / "fallback.mp4").exists()


def test_a_picture_is_worth_the_bytes_that_show_less():
    """It is compared with what each prefix shows, and leaves before the first of those that all show more."""
    pytest.importorskip("numba")
    data = (ROOT / "pd4dgs_codec" / "samples" / "dancer.pd4").read_bytes()
    first, *_, whole = every_prefix(data)
    prefixes = [(10, whole), (20, first), (30, whole)]
    assert [_still(whole, iter(prefixes[:n])).worth for n in (1, 3)] == [0, 20]


def test_a_rendered_video_is_packaged(cli, folder, tmp_path, monkeypatch):
    pytest.importorskip("torch")
    pytest.importorskip("imageio_ffmpeg")
    grey = np.full((48, 65, 3), 0.5, np.float32)  # in place of seconds of compiling kernels
    monkeypatch.setattr("pd4dgs_codec.model.picture.render_image", lambda *_: grey)
    scene = make_scene(7, layers=(0, 1, 2), anchors=40)
    camera = scene.info.camera
    K = camera.K * [[0.1], [0.1], [1]]
    small = replace(camera, width=65, height=48, K=K.astype("float32"))
    (folder / "small.pd4").write_bytes(encode(replace(scene, info=replace(scene.info, camera=small)), effort=1))
    read_slice, read = reader.read_slice, []
    monkeypatch.setattr(reader, "read_slice", lambda *args: read.append(args[1]) or read_slice(*args))
    done = cli("package", folder / "small.pd4", "-o", tmp_path / "out", "--fps", 10, "--json")
    assert done.code == 0 and done.json["video"] is True, done.err
    assert read == 2 * [0, 1, 2]  # for check and video, and for what prefixes show beside the page's picture
    init, pieces = manifests.fragments((tmp_path / "out" / "fallback.mp4").read_bytes())
    low, high = scene.info.time_range
    assert sum(piece.samples for piece in pieces) == round((high - low) * 10) and len(pieces) == 2
    index = json.loads((tmp_path / "out" / "index.json").read_text())
    assert index["video"] == {"file": "fallback.mp4", "width": 64, "height": 48, "fps": 10.0}
    still = replace(make_scene(7, layers=(0,)).info, camera=small, time_range=(1.0, 1.0))
    (folder / "still.pd4").write_bytes(encode(replace(make_scene(7, layers=(0,)), info=still), effort=1))
    assert cli("package", folder / "still.pd4", "-o", tmp_path / "still", "--fps", 10).code == 0
    _, pieces = manifests.fragments((tmp_path / "still" / "fallback.mp4").read_bytes())
    duration = ElementTree.fromstring((tmp_path / "still" / MPD).read_text()).attrib["mediaPresentationDuration"]
    assert sum(piece.samples for piece in pieces) == 10 and duration == "PT1S"
