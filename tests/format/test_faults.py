"""Faulty files: every one raises the package's own error, in one clear line, and never anything else.

What each rule refuses is in the conformance vectors and their test; here is what holds for all files.
"""

from dataclasses import replace
from pathlib import Path

import pytest
from strategies import memory_below, small_file
from vectors.blocks import ancillary, read_file

from pd4dgs_codec.errors import DecodeError, LimitExceeded
from pd4dgs_codec.format.container import read_chunk, read_preamble
from pd4dgs_codec.format.decoder import decode

VECTORS = Path(__file__).parents[2] / "spec" / "vectors" / "faulty"


def test_a_scene_keeps_its_id_when_chunks_come_and_go():
    file = read_file(small_file())
    extra = [ancillary(99, b"x")] * 20  # a chunk list in its longer form
    others = [replace(file, chunks=chunks) for chunks in (file.chunks[:2], [*file.chunks, *extra])]
    files = [small_file(), *(other.data() for other in others)]
    assert len({read_chunk(data, read_preamble(data).size).scene_id for data in files}) == 1
    many = {**file.header, **{64 + i: i for i in range(10)}}  # a map in its longer form
    assert decode(replace(file, header=many).data()).layers == (0, 1, 2)


#: What one reads of a broken file, by vector: what was found, what was expected, and where.
MESSAGES = {
    "signature-png": "not a .pd4 file: it begins with 89 50 4e 47 0d 0a 1a 0a, expected 89 50 44 34 0d 0a 1a 0a",
    "header-length-over-limit": "a header of 16385 bytes, limit 16384",
    "splice-layer-2": "the chunk belongs to scene .*, this file is",
    "splice-header-steps": "the chunk belongs to scene .*, this file is .*",
    "critical-unknown-last": "critical chunk of unknown type 6",
    "layer-flagged-ancillary": "layer 1 is flagged ancillary, expected a critical chunk",
    "chunk-list-descends": "layer chunks .0, 2, 1., expected layer 0 first and the layers ascending",
    "header-key-63-unknown": "unknown critical key 63",
    "header-key-02-missing": "key 2 is missing",
    "header-list": "header: list, expected a map",
    "header-box-upside-down": "lower corner",
    "header-time-descends": r"time range 1.0..0.0",
    "header-background-above": r"expected 0..1",
    "header-near-is-far": r"near 1.0 and far 1.0",
    "header-unit-negative": r"unit -1.0",
    "camera-fx-zero": "focal lengths",
    "payload-three-bytes": "payload of 3 bytes, expected at least 4",
    "payload-parameters-beyond": "parameters of 6 bytes, expected at most 5",
    "payload-parameters-over-limit": "parameters of 4097 bytes, limit 4096",
    "version-major-before": "format version 4.0, this decoder reads 5.x; drafts before 5.0 are not read any more",
    "rows-sum-over-limit": "header: rows of 513 channels, limit 512",
    "layer-0-codes-beyond": r"codes of \d+ bytes, expected at most \d+",
    "codes-left": "1 bytes of codes behind the last channel",
    "slices-later-grids": "key 4 in a later slice, expected it in the first one only",
    "grids-twice": r"layer 0 grids: ids .5, 5., expected them to ascend",
    "grids-predictors-two": "layer 0 grid 0 predictors: 2 entries, expected 1",
    "grids-step-zero": "layer 0 grids: step 0.0, expected a positive normal binary32 value",
    "chains-id-alone": "layer 0 chain: number of entries: 1, expected at least 3",
    "prior-entries-over-limit": r"tables of \d+ entries in one layer, limit \d+",
    "lzma-voxels-twice": "voxels out of Morton order",
    "samples-over-limit": r"planes of \d+ cells, limit 268435456",
    "positions-index-over-limit": "voxel index 1048577, limit 1048576",
    "mask-code-2": "layer 0: mask code in 2..77, expected 3..255",
    "mask-rise-negative": "rise of a mask code in -1..0",
    "mask-sum-over-255-in-layer-2": "layer 2: mask code 256, expected 0 or 3..255",
    "row-above": "a symbol of a row over 8388608 in magnitude",
    "overflow-rows": "a dequantised value is not finite",
    "voxel-twice": "voxel .1, 0, 0. holds more than one anchor, expected one",
}


@pytest.mark.parametrize("name", MESSAGES)
def test_a_fault_is_one_clear_line(name):
    with pytest.raises(DecodeError, match=MESSAGES[name]) as caught:
        decode((VECTORS / f"{name}.pd4").read_bytes())
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", sorted(p.stem for p in VECTORS.glob("bomb-*.pd4")))
def test_a_few_bytes_cannot_ask_for_gigabytes(name):
    """Constant channels cost nothing to code, so the declared sizes themselves are bounded by the payload."""
    data = (VECTORS / f"{name}.pd4").read_bytes()
    with memory_below(1 << 21), pytest.raises(LimitExceeded):
        decode(data)


def test_the_header_is_small():
    assert len(read_preamble(small_file()).header) < 512
