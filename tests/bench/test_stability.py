"""The stability table: its rows hold, they can fail, and the command around them."""

import json
import math
import sys
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from pd4dgs_codec.bench import stability, stable_scenes
from pd4dgs_codec.cli import bench
from pd4dgs_codec.entropy import channels
from pd4dgs_codec.errors import DataError, EncodeError
from pd4dgs_codec.format import quantise
from pd4dgs_codec.model import hexplane, networks, rate, reference
from pd4dgs_codec.threads import one_torch_thread

KEYS = {"case", "group", "fed", "promised", "got", "error", "bound", "status"}
GROUPS = ("rate", "fitting", "quantiser", "masks", "hexplane", "deformation", "rasteriser", "training")


@pytest.fixture(autouse=True)
def _one_torch_thread():
    with one_torch_thread():
        yield


def failed(name):
    """Names of the failed rows."""
    rows = [stability.run_case(*case) for case in stability.chosen(name)]
    return {row["case"] for row in rows if row["status"] == stability.FAIL}


def test_the_table_has_all_groups_and_no_two_rows_of_one_name():
    names = [(promise.group, case) for promise, (case, *_) in stability.chosen(None)]
    assert len(names) >= 120 and len(set(names)) == len(names)
    assert tuple(dict.fromkeys(group for group, _ in names)) == GROUPS


@pytest.mark.parametrize("name", [*GROUPS[:-1], "learning rates", "a single Gaussian", "a NaN weight"])
def test_every_row_holds(name):
    assert failed(name) == set()


@pytest.mark.slow
def test_every_training_run_holds():
    assert failed("training") == set()


# -- rows can fail -----------------------------------------------------------------------------------------------------


def naive(a, mu, sigma, q):
    """ln P by the plain difference of two distribution functions."""
    normal = torch.distributions.Normal(torch.zeros((), dtype=a.dtype), 1)
    return torch.log(normal.cdf((a - mu + q / 2) / sigma) - normal.cdf((a - mu - q / 2) / sigma))


def floor(x, step, name=""):
    if step > 0 and np.isfinite(x).all():
        return np.floor(np.clip(x / step, -1e9, 1e9)).astype(np.int32)
    return np.zeros(x.shape, np.int32)


bits, sample, mask = rate.rate_bits, hexplane.sample_reference, networks.level_mask
read = channels.ChannelReader.read
draw = stable_scenes.rasterization
#: What is broken: (module, name, broken, rows to run, rows that must fail, a row that must not).
FAULTS = {
    "the plain formula of the rate": (
        rate, "log_probability", naive, "rate",
        {"finite, float32", "ln P and gradients, float64", "clipped bits, float64"}, "a channel without spread",
    ),
    "a clip without gradient": (
        rate, "rate_bits", lambda *x: bits(*x).clamp(max=19.9), "float64",
        {"clipped bits, float64"}, "ln P and gradients, float64",
    ),
    "a coder that loses an outlier": (
        channels.ChannelReader, "read", lambda *a: np.clip(read(*a), -(1 << 23), 1 << 23), "lossless",
        {"lossless: one rare outlier"}, "lossless: heavy tails",
    ),
    "a quantiser that rounds down and refuses nothing": (
        quantise, "quantise", floor, "quantiser",
        {"step 1", "halves", "negative zero", "step 0", "value nan"}, "again at step 1",
    ),
    "time that is not clamped": (
        hexplane, "sample_reference", lambda *x: sample(*x) * (1 + max(x[-1] - 1, 0)), "hexplane",
        {"time after the range"}, "time before the range",
    ),
    "masks that fall with the level": (
        networks, "level_mask", lambda logits, level: mask(logits, level) * (1 - 1e-6 * level), "masks",
        {"masks of logits -100..100"}, "codes at 0, 1 and the threshold",
    ),
    "a mask threshold that moved": (
        quantise, "MASK_THRESHOLD", 0.0118, "masks", {"codes at 0, 1 and the threshold"}, "masks of logits -100..100",
    ),
    "a near plane that lets through": (
        stable_scenes, "rasterization", lambda *a, **k: draw(*a, **(k | {"near_plane": 0.0})), "rasteriser",
        {"z = near"}, "behind",
    ),
    "an opacity that is not capped": (
        reference, "ALPHA_MAX", 0.99, "rasteriser", {"64 coincident, opaque", "centre on a pixel"}, "behind",
    ),
    "a picture with a NaN": (
        stable_scenes, "picture_error", lambda model, level, *_: math.nan if level == 2 else 0.0,
        "a single Gaussian", {"a single Gaussian"}, "",
    ),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_fails_its_rows(fault, monkeypatch):
    module, name, broken, rows, must_fail, must_not = FAULTS[fault]
    monkeypatch.setattr(module, name, broken)
    found = failed(rows)
    assert must_fail <= found and must_not not in found


class TwoLines(EncodeError):
    def __str__(self) -> str:
        return "two\nlines"


@pytest.mark.parametrize(
    "measure, refuses, status",
    [
        (lambda: ("fine", 1.0), None, "pass"),
        (lambda: ("too far", 1.1), None, "fail"),
        (lambda: ("nowhere", math.nan), None, "fail"),
        (lambda: 1 / 0, None, "fail"),
        (Mock(side_effect=EncodeError("no")), None, "fail"),
        (Mock(side_effect=EncodeError("no")), EncodeError, "refused"),
        (Mock(side_effect=EncodeError("no")), DataError, "fail"),
        (Mock(side_effect=TwoLines("")), EncodeError, "fail"),
        (lambda: ("fine", 0.0), EncodeError, "fail"),
    ],
)
def test_the_status_of_a_row(measure, refuses, status):
    promise = stability.Promise("group", "promised", measure, (), 1.0, refuses)
    assert stability.run_case(promise, ("name", "fed"))["status"] == status


# -- the command -------------------------------------------------------------------------------------------------------


def test_the_command_prints_a_table_and_writes_json(capsys, tmp_path):
    path = tmp_path / "rows.json"
    assert bench.main(["stability", "--only", "MASK", "--json", str(path)]) == 0
    out, err = capsys.readouterr()
    result = json.loads(path.read_text())
    assert out.startswith("## masks\n\n| case ") and f"\n{len(result['rows'])} rows: " in out
    assert all(set(row) == KEYS for row in result["rows"]) and result["counts"]["fail"] == 0
    assert bench.main(["stability", "--only", "mask nan", "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)["rows"]
    assert row["status"] == "refused" and row["error"] is None and row["bound"] is None


def test_a_failed_row_is_named_and_exits_1(capsys, monkeypatch):
    monkeypatch.setattr(quantise, "MASK_THRESHOLD", 0.0118)
    assert bench.main(["stability", "--only", "codes at 0"]) == 1
    out, err = capsys.readouterr()
    assert "1 fail" in out and "fail: masks: codes at 0, 1 and the threshold" in err


def test_without_mpmath_it_says_what_to_install(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "mpmath", None)
    assert bench.main(["stability"]) == 1
    assert "pip install 'pd4dgs-codec[test]'" in capsys.readouterr().err
