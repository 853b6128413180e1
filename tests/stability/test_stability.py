"""The stability table: its rows hold, and they can fail. `pytest tests/stability --table` prints it."""

import math
from unittest.mock import Mock

import numpy as np
import pytest
import stable_scenes
import stable_symbols
import torch
from promises import FAIL, Promise, run_case

from pd4dgs_codec.entropy import channels
from pd4dgs_codec.errors import DataError, EncodeError
from pd4dgs_codec.model import hexplane, networks, rate, reference
from pd4dgs_codec.tensors import quantise
from pd4dgs_codec.threads import one_torch_thread

CASES = [
    (promise, given)
    for module in (stable_symbols, stable_scenes)
    for promise in module.PROMISES
    for given in promise.inputs
]
NAMES = [f"{promise.group}: {case}" for promise, (case, *_) in CASES]
#: Of the trainings, those that every run of the tests repeats.
USUAL = ("learning rates times 1e4", "a single Gaussian", "a NaN weight")


@pytest.fixture(autouse=True)
def _one_torch_thread():
    with one_torch_thread():
        yield


def slow(promise, case):
    return [pytest.mark.slow] if promise.group == "training" and case not in USUAL else []


def test_no_two_rows_have_one_name():
    assert len(set(NAMES)) == len(NAMES) >= 120


@pytest.mark.parametrize(
    "promise, given",
    [pytest.param(*case, id=name, marks=slow(case[0], case[1][0])) for case, name in zip(CASES, NAMES, strict=True)],
)
def test_every_row_holds(promise, given, record_property):
    row = run_case(promise, given)
    record_property("row", row)
    assert row["status"] != FAIL, row


# -- rows can fail -----------------------------------------------------------------------------------------------------


def naive(bits, by_value, by_sigma, values, rows, classes, mu, sigma, step, *limits):
    """R by the plain difference of two distribution functions."""
    low, high = (torch.from_numpy((values + side - mu) / sigma) for side in (-step / 2, step / 2))
    bits[:] = -(torch.special.ndtr(high) - torch.special.ndtr(low)).log2()[:, 0]
    by_value[:] = by_sigma[:] = 0


def unreached(bits, by_value, *given):
    """R without a gradient beyond the clip."""
    scalar_bits(bits, by_value, *given)
    by_value[bits >= given[-2]] = 0


def floor(x, step, name=""):
    if step > 0 and np.isfinite(x).all():
        return np.floor(np.clip(x / step, -1e9, 1e9)).astype(np.int32)
    return np.zeros(x.shape, np.int32)


scalar_bits, mask, sample = rate.scalar_bits, networks.level_mask, hexplane.sample_reference
read, draw = channels.ChannelReader.read, stable_scenes.rasterization
#: What is broken: (module, name, broken, cases that must fail, a case that must not).
FAULTS = {
    "the plain formula of the rate": (
        rate, "scalar_bits", naive,
        {"finite, float32", "ln P and gradients, float64", "clipped bits, float64"}, "a channel without spread",
    ),
    "a clip without gradient": (
        rate, "scalar_bits", unreached, {"clipped bits, float64"}, "ln P and gradients, float64",
    ),
    "a coder that loses an outlier": (
        channels.ChannelReader, "read", lambda *a: np.clip(read(*a), -(1 << 23), 1 << 23),
        {"lossless: one rare outlier"}, "lossless: heavy tails",
    ),
    "a quantiser that rounds down and refuses nothing": (
        quantise, "quantise", floor,
        {"step 1", "halves", "negative zero", "step 0", "value nan"}, "again at step 1",
    ),
    "time that is not clamped": (
        hexplane, "sample_reference", lambda *x: sample(*x) * (1 + max(x[-1] - 1, 0)),
        {"time after the range"}, "time before the range",
    ),
    "masks that fall with the level": (
        networks, "level_mask", lambda logits, level: mask(logits, level) * (1 - 1e-6 * level),
        {"masks of logits -100..100"}, "codes at 0, 1 and the threshold",
    ),
    "a mask threshold that moved": (
        quantise, "MASK_THRESHOLD", 0.0118, {"codes at 0, 1 and the threshold"}, "masks of logits -100..100",
    ),
    "a near plane that lets through": (
        stable_scenes, "rasterization", lambda *a, **k: draw(*a, **(k | {"near_plane": 0.0})),
        {"z = near"}, "behind",
    ),
    "an opacity that is not capped": (
        reference, "ALPHA_MAX", 0.99, {"64 coincident, opaque", "centre on a pixel"}, "behind",
    ),
    "a picture with a NaN": (
        stable_scenes, "picture_error", lambda model, level, *_: math.nan if level == 2 else 0.0,
        {"a single Gaussian"}, "",
    ),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_fails_its_rows(fault, monkeypatch):
    module, name, broken, must_fail, must_not = FAULTS[fault]
    monkeypatch.setattr(module, name, broken)
    tested = [run_case(promise, given) for promise, given in CASES if given[0] in must_fail | {must_not}]
    assert {row["case"] for row in tested if row["status"] == FAIL} == must_fail
    assert not must_not or len(tested) == len(must_fail) + 1


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
    promise = Promise("group", "promised", measure, (), 1.0, refuses)
    assert run_case(promise, ("name", "fed"))["status"] == status
