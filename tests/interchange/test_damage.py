"""Imported files with bytes changed, cut out or repeated are read or raise DataError."""

import random
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from teachers import Deformable, FourD, Nodes
from test_kinds import splat_bytes
from test_polynomials import checkpoint, splatv
from test_sog import archive, made
from test_splats import gsplat_state, make_splats

from pd4dgs_codec.errors import DataError
from pd4dgs_codec.interchange.runs import read_cameras, read_torch
from pd4dgs_codec.interchange.splats import fourdgs_bytes, ply_bytes, read_splats, spz_bytes
from pd4dgs_codec.interchange.teacher import PARTS, load_source, read_model
from pd4dgs_codec.kinds.splats import Splats

CASES = 150
SPLATS = make_splats(4, 1)


def damaged(data: bytes, rng: random.Random) -> bytes:
    """A few bytes changed, the end cut off, or a stretch taken out or written twice."""
    found, kind = bytearray(data), rng.randrange(4)
    a, b = sorted(rng.randrange(len(data) + 1) for _ in range(2))
    if kind == 0:
        for _ in range(rng.randint(1, 8)):
            found[rng.randrange(len(found))] = rng.choice((0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)))
    elif kind == 1:
        del found[a:]
    elif kind == 2:
        del found[a : min(b, a + 40)]
    else:
        found[a:a] = found[a : min(b, a + 40)]
    return bytes(found)


def _script(path: Path) -> None:
    layer = torch.nn.Sequential(torch.nn.Linear(3, 2), torch.nn.Tanh())
    torch.jit.trace(layer, torch.zeros(1, 3)).save(path)


def _fourdgs(path: Path) -> None:
    path.write_bytes(fourdgs_bytes([(t, SPLATS, np.arange(4)) for t in (0.0, 0.5)], 1.0))


def _cameras(path: Path) -> None:
    row = (
        '{"position": [0, 0, -4], "rotation": [[1,0,0],[0,1,0],[0,0,1]], "width": 80, "height": 60, "fx": 70, "fy": 7}'
    )
    path.write_text(f"[{row}, {row}]")


def _model(path: Path) -> Splats:
    return read_model(str(path), 30).splats(0.5)


def _run(path: Path) -> Splats:
    """Of the run that a network belongs to."""
    return _model(path.parents[2])


@pytest.mark.parametrize(
    "name, make, read",
    [
        ("ckpt.pt", lambda path: torch.save({"splats": gsplat_state(SPLATS)}, path), _model),
        ("mlp.pt", _script, read_torch),
        ("run/point_cloud/iteration_7/deformation.pth", lambda path: FourD(SPLATS).save(path.parents[2], SPLATS), _run),
        ("run/deform/iteration_7/deform.pth", lambda path: Deformable(SPLATS).save(path.parents[2], SPLATS), _run),
        ("nodes/deform/iteration_7/deform.pth", lambda path: Nodes(SPLATS, 4).save(path.parents[2], SPLATS), _run),
        ("nodes/point_cloud/iteration_7/point_cloud.ply", lambda p: Nodes(SPLATS, 4).save(p.parents[2], SPLATS), _run),
        ("chkpnt7.pth", lambda path: checkpoint(path, 9), _model),
        ("a.splatv", lambda path: path.write_bytes(splatv(9)[0]), _model),
        ("a.sog", lambda path: path.write_bytes(archive(*made(1)[:2])), read_splats),
        ("a.ply", lambda path: path.write_bytes(ply_bytes(SPLATS)), read_splats),
        ("a.splat", lambda path: path.write_bytes(splat_bytes(SPLATS)), read_splats),
        ("a.spz", lambda path: path.write_bytes(spz_bytes(SPLATS)), read_splats),
        ("a.4dgs", _fourdgs, _model),
        ("cameras.json", _cameras, read_cameras),
    ],
)
def test_damaged_files(tmp_path, name: str, make: Callable[[Path], None], read: Callable[[Path], object]):
    path = tmp_path / name
    path.parent.mkdir(parents=True, exist_ok=True)
    make(path)
    whole = path.read_bytes()
    read(path)
    refused = 0
    for seed in range(CASES):
        path.write_bytes(damaged(whole, random.Random(seed)))
        try:
            with np.errstate(all="raise", under="ignore"):
                read(path)
        except DataError as error:
            assert str(path.name) in str(error) and "\n" not in str(error)
            refused += 1
    assert refused > CASES / 4


def test_a_few_bytes_that_stand_for_many_numbers_are_refused(tmp_path):
    """A small file may hold any number of equal Gaussians, for each of which fourdgs takes 350 bytes of memory."""
    splats = make_splats(1, 0)
    many = Splats(**{name: np.repeat(getattr(splats, name), 200_000, axis=0) for name in PARTS})
    path = tmp_path / "a.4dgs"
    path.write_bytes(fourdgs_bytes([(0.0, many, np.arange(len(many.means)))], 1.0))
    assert path.stat().st_size < 2000
    with pytest.raises(DataError, match="a.4dgs: more than 1,0.* numbers in "):
        read_model(str(path), 30)


@pytest.mark.parametrize("seconds, expected", [(1e300, None), (0.0, (0.0, 1.0)), (1e-320, (0.0, 1.0))])
def test_a_duration_that_no_file_holds_is_found_before_training(tmp_path, seconds, expected):
    """A .pd4 file holds its time range in binary32; training failed only at its end."""
    path, one = tmp_path / "a.4dgs", struct.pack("<d", 1.0)
    _fourdgs(path)
    path.write_bytes(path.read_bytes().replace(one, struct.pack("<d", seconds)))
    source = f"teacher:{path}?views=2&size=24x20"
    if expected:
        assert load_source(source).time_range == expected
    else:
        with pytest.raises(DataError, match=r"times from 0 to 1e\+300"):
            load_source(source)
