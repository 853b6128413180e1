"""encode, decode and info, as their users call them."""

import json
from dataclasses import replace

import numpy as np
import pytest
from strategies import make_scene
from tiny import disc

from pd4dgs_codec.cli import options
from pd4dgs_codec.format.decoder import decode
from pd4dgs_codec.format.encoder import encode
from pd4dgs_codec.format.info import info
from pd4dgs_codec.format.metadata import Metadata
from pd4dgs_codec.model import checkpoint

ENCODE_KEYS = {"mode", "bytes", "verified", "seconds", "layers", "left_out"}
LAYER_KEYS = {"layer", "bytes", "payload_bits", "rate_bits", "position_bits", "symbols", "anchors"}


def test_encode_writes_what_the_codec_encodes(cli, model_pt, scene_pd4, tmp_path):
    output = tmp_path / "s.pd4"
    result = cli("encode", model_pt, "-o", output, "--effort", 1, "--json")
    assert result.code == 0 and result.err == ""
    assert output.read_bytes() == scene_pd4.read_bytes()
    report = result.json
    assert ENCODE_KEYS <= set(report) and report["verified"] is True
    assert report["bytes"] == output.stat().st_size
    assert [row["layer"] for row in report["layers"]] == [0, 1, 2]
    for row in report["layers"]:
        assert LAYER_KEYS <= set(row)
        assert row["ratio"] == pytest.approx(row["payload_bits"] / row["rate_bits"])


def test_encode_options_reach_the_codec(cli, model_pt, tmp_path):
    def size(*options) -> tuple[int, dict]:
        fast = ("-f", "--mode", "lzma", "--effort", 1, "--json")
        report = cli("encode", model_pt, "-o", tmp_path / "s.pd4", *fast, *options).json
        return report["bytes"], report

    plain, _ = size()
    assert size("--step-scale", 3)[0] < plain
    assert size("--mode", "ans")[1]["mode"] == "ans"
    assert [row["layer"] for row in size("--layers", 1)[1]["layers"]] == [0, 1]
    assert size("--no-verify")[1]["verified"] is False


def test_pipes_and_repacking_give_the_same_file(cli, model_pt, scene_pd4):
    piped = cli("encode", "-", "-o", "-", "--effort", 1, stdin=model_pt.read_bytes())
    assert piped.code == 0 and piped.out == scene_pd4.read_bytes()
    again = cli("encode", "-", "-o", "-", "--effort", 1, stdin=piped.out)
    assert again.code == 0 and again.out == piped.out
    summary = cli("decode", "-", "--json", stdin=piped.out)
    assert b", 2 more behind its end" in cli("info", "-", stdin=piped.out + b"no").out
    assert summary.json["complete"] is True and summary.json["bytes"] == len(piped.out)


def test_tables_without_json(cli, model_pt, scene_pd4, tmp_path):
    result = cli("encode", model_pt, "-o", tmp_path / "s.pd4", "--effort", 1)
    assert result.code == 0 and result.out == b"" and "first frame after" in result.err and "payload/ΣR" in result.err
    result = cli("decode", scene_pd4)
    assert result.code == 0 and result.err == "" and b"complete and valid" in result.out


def test_decode_npz_holds_the_decoded_arrays(cli, scene_pd4, tmp_path):
    output = tmp_path / "s.npz"
    assert cli("decode", scene_pd4, "-o", output, "--max-layer", 1, "--symbols").code == 0
    scene, arrays = decode(scene_pd4.read_bytes(), max_layer=1), np.load(output)
    assert np.array_equal(arrays["anchor"], scene.anchor)
    assert np.array_equal(arrays["feature"], scene.feature)
    assert "mask_1" in arrays and "mask_2" not in arrays
    exact = arrays["feature_q"].astype(np.float64) * np.float64(arrays["feature_step"])
    assert np.array_equal(exact.astype(np.float32), scene.feature)
    piped = cli("decode", scene_pd4, "-o", "-", "--max-layer", 1, "--symbols")
    assert piped.out == output.read_bytes()


def test_decoded_checkpoint_encodes_to_the_same_symbols(cli, scene_pd4, tmp_path):
    checkpoint, again = tmp_path / "d.pt", tmp_path / "again.pd4"
    assert cli("decode", scene_pd4, "-o", checkpoint).code == 0
    assert cli("encode", checkpoint, "-o", again, "--effort", 1).code == 0
    first, second = (cli("info", path, "--hashes", "--json").json["hashes"] for path in (scene_pd4, again))
    assert [row["symbols"] for row in first] == [row["symbols"] for row in second]


@pytest.mark.parametrize("text", ["100000", "100k", "100K", "100kB", "100KB", ".1M", "0.1MB", "100000B", "0.0001G"])
def test_sizes_are_written_with_decimal_units(text):
    assert options.size(text) == 100_000
    assert options.layer_sizes(f"L0={text}") == {0: 100_000}


def test_partial_input_exits_3_only_when_allowed(cli, scene_pd4, tmp_path):
    data = scene_pd4.read_bytes()
    ends = [row["end"] for row in cli("info", scene_pd4, "--json").json["layers"]]
    cut = data[: ends[1] + 5]
    refused = cli("decode", "-", "--json", stdin=cut)
    assert refused.code == 1 and refused.json["error"]["type"] == "Truncated"
    partial = cli("decode", "-", "--allow-partial", "--json", "-o", tmp_path / "p.npz", stdin=cut)
    assert partial.code == 3 and partial.json["complete"] is False
    assert [row["layer"] for row in partial.json["layers"]] == [0, 1]
    assert "mask_1" in np.load(tmp_path / "p.npz")
    assert cli("decode", "-", "--allow-partial", stdin=data).code == 0
    assert cli("decode", "-", "--allow-partial", "--max-layer", 1, stdin=cut).code == 0
    assert cli("decode", "-", "--allow-partial", stdin=data[: ends[0] - 1]).code == 1


def test_info_states_layers_and_first_frame(cli, scene_pd4):
    result = cli("info", scene_pd4, "--json", "--check", "--at", "500k,2M,1G,1e9,64k")
    report, size = result.json, scene_pd4.stat().st_size
    assert report["format_version"] == "5.0" and report["bytes"] == size and report["checked"] is True
    assert report["layers"][-1]["end"] == size
    end = report["layers"][0]["end"]
    rates = {"500k": 5e5, "2M": 2e6, "1G": 1e9, "1e9": 1e9, "64k": 64e3}
    assert report["first_frame_seconds"] == {name: 8 * end / rate for name, rate in rates.items()}
    text = cli("info", scene_pd4).out.decode()
    assert "first frame" in text and f"{size:,} bytes" in text
    details = cli("info", scene_pd4, "-v").error_lines
    for row, line in zip(report["layers"], details, strict=True):
        facts = [f"{key} {row[key]}" for key in ("steps", "planes", "networks", "key_instant") if key in row]
        assert line == f"layer {row['layer']}: {', '.join(facts)}"
    assert "key_instant" in details[1]


def test_info_tells_where_the_bytes_are(cli, scene_pd4):
    report = cli("info", scene_pd4, "--json", "--bytes").json
    assert sum(row["bytes"] for row in report["parts"]) == report["bytes"] == scene_pd4.stat().st_size
    for i, layer in enumerate(report["layers"]):
        header = report["header_bytes"] if i == 0 else 0
        assert sum(row["layers"][i] for row in report["parts"]) == layer["bytes"] + header
    rows = {row["part"]: row for row in report["parts"]}
    assert {"positions", "masks", "attributes", "planes", "weights"} < set(rows)
    assert rows["planes"]["layers"][0] == 0 < rows["planes"]["layers"][1]
    text = cli("info", scene_pd4, "--bytes").out.decode()
    assert f"{rows['attributes']['bytes']:,}" in text and "share" in text
    assert "parts" not in cli("info", scene_pd4, "--json").json
    cut = cli("info", "-", "--bytes", stdin=scene_pd4.read_bytes()[: report["layers"][1]["end"] - 1])
    assert cut.code == 1 and "truncated in a chunk" in cut.err


def test_metadata_is_written_shown_and_kept(cli, scene_pd4, tmp_path):
    told, again = tmp_path / "told.pd4", tmp_path / "again.pd4"
    fast = ("--effort", 1, "--no-verify", "--omit", "nothing")
    assert cli("encode", scene_pd4, "-o", told, "--title", "Kitchen", "--licence", "CC BY 4.0", *fast).code == 0
    assert cli("encode", told, "-o", again, "--title", "Hall", *fast).code == 0
    assert cli("info", told, "--json").json["metadata"] == {"title": "Kitchen", "licence": "CC BY 4.0"}
    assert {"title: Hall", "licence: CC BY 4.0"} <= set(cli("info", again).out.decode().splitlines())
    measured = Metadata(title="Kitchen", quality={0: 30.0}, slices=(20.0, 25.0, 30.0))
    told.write_bytes(encode(decode(scene_pd4.read_bytes()), effort=1, metadata=measured))
    assert cli("info", told, "--json").json["metadata"].keys() == {"title", "quality", "slices"}
    assert cli("encode", told, "-o", again, "-f", *fast).code == 0
    assert cli("info", again, "--json").json["metadata"] == {"title": "Kitchen"}, "measured on the other file"


def test_info_names_what_is_left_out(cli, model_pt, tmp_path):
    output = tmp_path / "s.pd4"
    assert cli("encode", model_pt, "-o", output, "--layers", 1, "--effort", 1).code == 0
    assert [row["what"] for row in cli("info", output, "--json").json["left_out"]] == ["layer 2"]
    decoded = cli("decode", output, "--max-layer", 2)
    assert decoded.code == 0 and b"no layer 2: level 2 equals level 1" in decoded.out
    assert cli("decode", output, "--max-layer", 1, "--json").json["absent"] == []


def test_decoding_needs_no_torch_no_numba_and_for_a_local_file_no_network(scene_pd4, python):
    program = (
        "import sys; sys.modules['torch'] = sys.modules['numba'] = None\n"
        "from pd4dgs_codec.__main__ import main\n"
        f"code = main(['decode', {str(scene_pd4)!r}, '--json']) or main(['info', {str(scene_pd4)!r}])\n"
        "assert not {'http', 'ssl', 'email'} & set(sys.modules)\nsys.exit(code)"
    )
    assert json.loads(python(program).splitlines()[0])["complete"] is True


def test_max_bytes_and_a_truncated_file_stop_at_a_slice(cli, tmp_path):
    data, path = encode(make_scene(3, anchors=200), slices=2000, effort=1), tmp_path / "scene.pd4"
    path.write_bytes(data)
    ends = [part["end"] for row in info(data)["layers"] for part in row["slices"]]
    done = cli("decode", path, "--max-bytes", str(ends[1] + 3), "--json")
    assert (done.code, done.json["layers"][-1]["end"], done.json["complete"]) == (0, ends[1], True)
    assert done.json["anchors"] == len(decode(data, max_bytes=ends[1]).anchor_q)
    done = cli("decode", "-", "--allow-partial", "--json", stdin=data[: ends[0] + 3])
    assert (done.code, done.json["layers"][-1]["end"], done.json["complete"]) == (3, ends[0], False)
    done = cli("decode", path, "--max-bytes", str(ends[0] - 1))
    assert done.code == 1 and f"{ends[0] - 1} bytes end before the first slice" in done.err
    assert f"{ends[1]:,}".encode() in cli("info", path).out


def test_a_file_says_where_the_0_of_a_moved_scene_lies(cli, model_pt, tmp_path):
    moved, out, again = tmp_path / "moved.pt", tmp_path / "m.pd4", tmp_path / "again.pd4"
    shift, mine = (465000.0, 5243000.0, 0.0), ("--source", "a square")
    place = replace(disc(), shift=shift).place
    assert place == "0 is 465000, 5243000, 0 of the data"
    checkpoint.save(moved, checkpoint.load(model_pt)[0], {"place": place})
    for source, file, given, told in (
        (moved, out, mine, f"a square; {place}"),
        (moved, out, (), place),
        (out, again, (), place),
        (out, again, mine, f"a square; {place}"),  # encoded again
        (again, out, ("--source", "a park"), f"a park; {place}"),
    ):
        assert cli("encode", source, "-o", file, "-f", "--effort", 1, *given).code == 0
        assert cli("info", file, "--json").json["metadata"]["source"] == told
