"""info from a file's first bytes, digests of its contents, and the npz keys."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from strategies import make_scene, small_file
from vectors.blocks import ancillary, read_file

from pd4dgs_codec import FORMAT_VERSION
from pd4dgs_codec.errors import DecodeError, EncodeError, Truncated
from pd4dgs_codec.format import encoder
from pd4dgs_codec.format.decoder import decode
from pd4dgs_codec.format.encoder import encode, encode_with_report
from pd4dgs_codec.format.info import hashes, info, metadata_of, to_npz_dict
from pd4dgs_codec.format.metadata import Metadata

VECTORS = Path(__file__).parents[2] / "spec" / "vectors" / "uncommon"
SCENE = make_scene(7, anchors=20)


def test_info_needs_the_header_alone():
    data = small_file(omit="nothing")
    whole = info(data)
    first = info(data[: whole["header_bytes"]])
    with pytest.raises(Truncated):
        info(data[: whole["header_bytes"] - 1])
    assert whole["format_version"] == FORMAT_VERSION == "5.0"
    assert whole["bytes"] == first["bytes"] == len(data)
    place = ("layer", "offset", "bytes", "end")
    before, after = ([{k: row[k] for k in place} for row in found["layers"]] for found in (first, whole))
    assert before == after and all(set(row) == {*place, "slices"} for row in first["layers"])
    ends = [whole["header_bytes"], *(row["end"] for row in whole["layers"])]
    assert [row["offset"] for row in whole["layers"]] == ends[:-1] and ends[-1] == len(data)
    decoded = decode(data)
    assert [row["anchors"] for row in whole["layers"]] == np.diff([0, *decoded.rows]).tolist()
    assert whole["anchors"] == len(decoded.anchor_q) and first["anchors"] is None
    assert whole["steps"]["feature"] == SCENE.steps.feature
    assert whole["layers"][2]["steps"] == {"planes_local": 0.5, "weights_local": SCENE.steps.weights_local}
    assert whole["layers"][1]["planes"] == [[2, 3, 2, 4, 5]]


def test_a_layer_without_its_last_slice_has_only_its_place():
    data = encode(make_scene(3, anchors=300, key=5), effort=1, slices=1700)
    slices = info(data)["layers"][1]["slices"]
    assert len(slices) > 1 and "key_instant" in info(data)["layers"][1]
    cut = info(data[: slices[-1]["offset"]])
    assert "anchors" in cut["layers"][1]["slices"][-2] and "anchors" not in cut["layers"][1]["slices"][-1]
    assert set(cut["layers"][1]) == {"layer", "offset", "bytes", "end", "slices"}


def test_hashes_name_the_contents_not_the_coding():
    data = small_file(omit="nothing")
    lzma = encode(SCENE, layers=2, mode="lzma", effort=1, omit="nothing")
    assert lzma != data and hashes(lzma) == hashes(data)
    assert hashes(encode(SCENE, layers=1, effort=1, omit="nothing")) == hashes(data)[:2]


def test_npz_keys_and_symbols():
    scene = decode(small_file(omit="nothing"))
    arrays, plain = to_npz_dict(scene, symbols=True), to_npz_dict(scene)
    assert {"anchor", "feature", "scaling_log", "offset", "mask_0", "mask_1", "mask_2"} <= set(plain)
    assert {"mlp.opacity.weight.0", "mlp.color.bias.1"} <= set(plain)
    assert {"mlp.global.trunk.weight.0", "mlp.local.position.bias.0"} <= set(plain)
    assert {"planes.global.0.xy", "planes.local.0.zt"} <= set(plain)
    assert not any(name.endswith(("_q", "_step")) for name in plain)
    tensors = [name for name in plain if not name.startswith("meta_")]
    for name in tensors:
        k, step = arrays[f"{name}_q"], arrays[f"{name}_step"]
        assert k.dtype == np.int32 and plain[name].dtype == np.float32 == step.dtype
        value = (k.astype(np.float64) * np.float64(step)).astype(np.float32)
        np.testing.assert_array_equal(value, plain[name], err_msg=name)
    assert set(arrays) - set(plain) == {f"{name}_{end}" for name in tensors for end in ("q", "step")}
    assert tuple(arrays["meta_rows"]) == scene.rows and arrays["meta_camera_K"].shape == (3, 3)


def test_info_names_chunks_it_does_not_know():
    data = small_file(omit="nothing")
    file = read_file(data)
    longer = replace(file, chunks=[*file.chunks, ancillary(99, b"a preview")]).data()
    assert info(longer)["chunks"] == [{"type": 99, "offset": len(longer) - 29, "bytes": 29, "end": len(longer)}]
    assert [row["layer"] for row in info(longer)["layers"]] == [0, 1, 2] and hashes(longer) == hashes(data)


def test_metadata_is_written_shown_and_skipped():
    scene, about = make_scene(3, anchors=4), Metadata("Kitchen", licence="CC BY 4.0", quality={1: 24.5})
    plain, (told, report) = encode(scene, effort=1), encode_with_report(scene, effort=1, metadata=about)
    assert info(plain)["metadata"] is None and metadata_of(plain) is None
    assert metadata_of(told) == about
    assert info(told)["metadata"] == {"title": "Kitchen", "licence": "CC BY 4.0", "quality": {"1": 24.5}}
    assert info(told[:-1])["metadata"] is None  # not all of it is here
    assert hashes(told) == hashes(plain)
    assert report.metadata_bytes == info(told)["chunks"][0]["bytes"]
    assert sum(report.added_bytes().values()) == len(told) - report.metadata_bytes


def test_a_file_of_the_most_chunks_takes_no_metadata(monkeypatch):
    data = encode(SCENE, effort=1, slices=1000)
    monkeypatch.setattr(encoder, "MAX_CHUNKS", sum(len(layer["slices"]) for layer in info(data)["layers"]))
    with pytest.raises(EncodeError, match="let slices take more bytes"):
        encoder.with_metadata(data, Metadata("Kitchen"))
    monkeypatch.setattr(encoder, "MAX_CHUNKS", encoder.MAX_CHUNKS + 1)
    told, size = encoder.with_metadata(data, Metadata("Kitchen"))
    assert metadata_of(told) == Metadata("Kitchen") and size == info(told)["chunks"][0]["bytes"]


@pytest.mark.parametrize("name", ["metadata-cut", "metadata-bomb"])
def test_a_fault_in_metadata_is_told_and_the_layers_decode(name):
    data = (VECTORS / f"{name}.pd4").read_bytes()
    assert [row["layer"] for row in hashes(data)] == [0, 1, 2]
    assert set(info(data)["metadata"]) == {"fault"}
    with pytest.raises(DecodeError):
        metadata_of(data)


def test_a_scene_without_a_camera_has_no_camera_keys():
    scene = decode(encode(make_scene(7, anchors=2, with_camera=False), layers=2, effort=1))
    assert not any("camera" in name for name in to_npz_dict(scene))
