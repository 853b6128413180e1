"""The stability table: what it holds, that its rows can fail, and the command around it."""

import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from pd4dgs_codec.bench.stability import cases, rasteriser, training
from pd4dgs_codec.cli import bench
from pd4dgs_codec.draw import projection
from pd4dgs_codec.entropy import channels
from pd4dgs_codec.errors import DataError, EncodeError
from pd4dgs_codec.format import quantise
from pd4dgs_codec.format import residuals as evaluate
from pd4dgs_codec.model import masks, rate

DOCS = Path(__file__).parents[2] / "docs" / "stability.md"
KEYS = {"case", "group", "fed", "promised", "got", "error", "bound", "status"}
QUICK = ("rate", "fitting", "quantiser", "hexplane", "deformation", "masks", "rasteriser")


@pytest.fixture(autouse=True)
def _one_torch_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def rows_of(name):
    return [cases.judge(case) for case in cases.chosen(name)]


# -- the table ---------------------------------------------------------------------------------------------------------


def test_the_table_has_its_rows_and_no_two_of_one_name():
    every = cases.chosen(None)
    names = [(c.group, c.case) for c in every]
    assert len(every) >= 214 and len(set(names)) == len(names)
    assert set(QUICK) | {"training"} == {c.group for c in every}
    assert all(c.fed and c.promised for c in every)


def test_the_documented_table_is_of_these_cases():
    lines = [line.split(" | ")[0][2:].strip() for line in DOCS.read_text().splitlines() if line.startswith("| ")]
    assert {c.case for c in cases.chosen(None)} <= set(lines)


@pytest.mark.parametrize("group", QUICK)
def test_every_row_holds(group):
    failed = [row for row in rows_of(group) if row.status == cases.FAIL]
    assert failed == []


@pytest.mark.parametrize("case", ["learning rates times 100", "a single Gaussian", "a weight that is not a number"])
def test_runs_that_ought_to_fail_do_not(case):
    (row,) = rows_of(case)
    assert row.status == cases.PASS, row


@pytest.mark.slow
def test_every_run_holds():
    assert [row for row in rows_of("training") if row.status == cases.FAIL] == []


# -- rows can fail -----------------------------------------------------------------------------------------------------


def broken_rows(name):
    """Names of the failed rows; a row that cannot fail would not be among them."""
    return {row.case for row in rows_of(name) if row.status == cases.FAIL}


def naive(a, mu, sigma, q):
    """ln P by the plain difference of two distribution functions."""
    normal = torch.distributions.Normal(torch.zeros((), dtype=a.dtype), 1)
    return torch.log(normal.cdf((a - mu + q / 2) / sigma) - normal.cdf((a - mu - q / 2) / sigma))


def test_the_plain_formula_of_the_rate_fails(monkeypatch):
    monkeypatch.setattr(rate, "log_probability", naive)
    failed = broken_rows("rate")
    assert {"finite, float32", "finite, float64", "gradient beyond the clip, float64"} <= failed
    assert {f"ln P, sigma/Q {band}, float64" for band in ("1e-2..1e2", "1e6..1e8")} <= failed
    assert "a channel without spread" not in failed


def test_a_clip_without_gradient_fails(monkeypatch):
    bits = rate.rate_bits
    monkeypatch.setattr(rate, "rate_bits", lambda *inputs: bits(*inputs).clamp(max=19.9))
    assert {"gradient beyond the clip, float64", "clipped bits, float64"} <= broken_rows("float64")


def test_a_coder_that_loses_an_outlier_fails(monkeypatch):
    decode = channels.decode_channels
    monkeypatch.setattr(channels, "decode_channels", lambda *a: [np.clip(x, -(1 << 23), 1 << 23) for x in decode(*a)])
    failed = broken_rows("lossless")
    assert "lossless: one rare outlier" in failed and "lossless: constant" not in failed


def test_a_quantiser_that_rounds_down_fails(monkeypatch):
    def floor(x, step, name=""):
        if step > 0 and np.isfinite(x).all():
            return np.floor(np.clip(x / step, -1e9, 1e9)).astype(np.int32)
        return np.zeros(x.shape, np.int32)

    monkeypatch.setattr(quantise, "quantise", floor)
    failed = broken_rows("quantiser")
    assert {"step 1", "halves", "negative zero"} <= failed
    assert {"step 0", "value nan at step 1"} <= failed  # accepted where a refusal was promised


def test_time_that_is_not_clamped_fails(monkeypatch):
    sample = evaluate.sample_planes

    def unclamped(planes, box, points, t):
        return sample(planes, box, points, t) * (1 + max(t - 1, 0))

    monkeypatch.setattr(evaluate, "sample_planes", unclamped)
    assert broken_rows("hexplane") == {"time after the range"}


def test_masks_that_fall_or_a_threshold_that_moves_fail(monkeypatch):
    mask = masks.level_mask
    monkeypatch.setattr(masks, "level_mask", lambda logits, level: mask(logits, level) * (1 - 1e-6 * level))
    monkeypatch.setattr(quantise, "MASK_THRESHOLD", 0.0118)
    assert {"masks of logits -100..100", "codes at 0, 1 and the threshold"} <= broken_rows("masks")


def test_a_near_plane_that_lets_through_fails(monkeypatch):
    draw = rasteriser.rasterization
    monkeypatch.setattr(rasteriser, "rasterization", lambda *a, **k: draw(*a, **(k | {"near_plane": 0.0})))
    assert "z = near" in broken_rows("rasteriser")


def test_an_opacity_that_is_not_capped_fails(monkeypatch):
    from pd4dgs_codec.model import reference

    monkeypatch.setattr(reference, "ALPHA_MAX", 0.99)
    assert projection.ALPHA_MAX == 0.999
    assert {"64 coincident, opaque", "centre on a pixel"} <= broken_rows("rasteriser")


def test_a_picture_with_a_nan_fails(monkeypatch):
    monkeypatch.setattr(training, "picture_error", lambda model, level, *_: math.nan if level == 2 else 0.0)
    assert broken_rows("as it should be") == {"as it should be"}


def case_of(measure, refuses=None):
    return cases.Case("group", "name", "fed", "promised", 1.0, measure, refuses)


class TwoLines(EncodeError):
    """What no error of ours says, for each makes one line of its message."""

    def __str__(self) -> str:
        return "two\nlines"


def refuse(error):
    raise error if isinstance(error, EncodeError) else EncodeError(error)


@pytest.mark.parametrize(
    "case, status",
    [
        (case_of(lambda: ("fine", 1.0)), "pass"),
        (case_of(lambda: ("too far", 1.1)), "fail"),
        (case_of(lambda: ("nowhere", math.nan)), "fail"),
        (case_of(lambda: 1 / 0), "fail"),
        (case_of(lambda: refuse("no")), "fail"),
        (case_of(lambda: refuse("no"), EncodeError), "refused"),
        (case_of(lambda: refuse("no"), DataError), "fail"),
        (case_of(lambda: refuse(TwoLines("")), EncodeError), "fail"),
        (case_of(lambda: ("fine", 0.0), EncodeError), "fail"),
    ],
)
def test_judgement(case, status):
    assert cases.judge(case).status == status


# -- the command -------------------------------------------------------------------------------------------------------


def test_the_command_prints_a_table_and_writes_json(capsys, tmp_path):
    path = tmp_path / "rows.json"
    assert bench.main(["stability", "--only", "MASK", "--json", str(path)]) == 0
    out, err = capsys.readouterr()
    result = json.loads(path.read_text())
    assert out.startswith("## masks\n\n| case ") and f"\n{len(result['rows'])} rows: " in out
    assert all(set(row) == KEYS for row in result["rows"]) and result["counts"]["fail"] == 0
    assert bench.main(["stability", "--only", "masks", "--json", str(path)]) == 1
    assert "exists already" in capsys.readouterr().err
    assert bench.main(["stability", "--only", "mask nan", "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)["rows"]
    assert row["status"] == "refused" and row["error"] is None and row["bound"] is None


def test_its_help_has_examples(capsys):
    with pytest.raises(SystemExit):
        bench.main(["stability", "--help"])
    out = capsys.readouterr().out
    assert out.startswith("usage: pd4dgs-bench stability ") and "[FILE]" in out and "--only rasteriser" in out
    assert max(map(len, out.splitlines())) <= 120


def test_a_failed_row_is_told_and_exits_1(capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(quantise, "MASK_THRESHOLD", 0.0118)
    assert bench.main(["stability", "--only", "codes at 0"]) == 1
    out, err = capsys.readouterr()
    assert "1 fail" in out and "fail: masks: codes at 0, 1 and the threshold" in err


@pytest.mark.parametrize(
    "argv, word",
    [
        (["stability", "--only", "no such case"], "no such case"),
        (["--json", "stability"], "the report first"),
        (["stabilty"], "stabilty"),
        ([], "REPORT"),
    ],
)
def test_usage_errors(argv, word, capsys):
    assert bench.main(argv) == 2
    assert word in capsys.readouterr().err


def test_without_mpmath_it_says_what_to_install(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "mpmath", None)
    assert bench.main(["stability"]) == 1
    assert "pip install 'pd4dgs-codec[test]'" in capsys.readouterr().err
