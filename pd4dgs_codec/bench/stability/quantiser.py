"""Stability of quantisation: |x - x_hat| <= Q/2 and one float32 rounding, from the smallest step to the largest."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction
from functools import partial

import numpy as np

from pd4dgs_codec.attributes import quantise as q
from pd4dgs_codec.bench.stability.rows import Case, refusal
from pd4dgs_codec.bench.stability.scenes import small_scene
from pd4dgs_codec.codec import decoder, encoder
from pd4dgs_codec.errors import EncodeError

GROUP = "quantiser"
TINY, HUGE = float(np.finfo(np.float32).tiny), float(np.finfo(np.float32).max)
_SUBNORMAL = float(np.float32(1e-45))


def cases() -> Iterator[Case]:
    """Steps from 1e-12 to 1e6 and at binary32's ends; halves, zeros, subnormals and float limits; refusals."""
    for step in (1e-12, 1e-6, 1e-3, 1.0, 1e3, 1e6, TINY, 2.0**104):
        yield Case(
            GROUP, f"step {step:.3g}", "4,000 values up to 2^23 steps, at halves of a step and around them",
            "|x - x_hat| <= Q/2 + half a float32 unit, exactly", 1.0, partial(_error_in_bounds, _binary32(step)),
        )  # fmt: skip
        yield Case(
            GROUP, f"again at step {step:.3g}", "symbols 0, +-1 .. +-2^23",
            "quantising what was dequantised gives the same symbols", 0.0, partial(_changed, _binary32(step)),
        )  # fmt: skip
    halves = [0.5, 1.5, 2.5, -0.5, -1.5, 8388606.5, 4194303.5]
    yield _symbols("halves", halves, 1.0, [0, 2, 2, 0, -2, 8388606, 4194304], "ties go to even")
    yield _symbols("negative zero", [-0.0, -1e-30], 0.5, [0, 0], "symbol 0, value +0")
    yield _symbols("subnormal values", [1e-45, -1e-39, 1e-38], _binary32(1e-12), [0, 0, 0], "symbol 0")
    ends = [TINY / 2, TINY * 0.75, -TINY, _SUBNORMAL]
    yield _symbols("subnormal values at the smallest step", ends, TINY, [0, 1, -1, 0], "ties to even, x_hat kept")
    near = float(np.float32(3.3e38))
    top = [round(Fraction(x) / Fraction(2.0**106)) for x in (near, -near)]
    yield _symbols("values near the float limit", [near, -near], 2.0**106, top, "nearest symbol, x_hat finite")
    for step in (0.0, -0.5, math.nan, math.inf, _SUBNORMAL, 0.1):
        yield refusal(
            GROUP, f"step {step:.3g}", "a step that is no positive normal binary32", EncodeError,
            partial(q.quantise, np.zeros(3, np.float32), step, "feature"),
        )  # fmt: skip
    for value, step, fed in (
        (math.nan, 1.0, "NaN among the values"),
        (math.inf, 1.0, "an infinity among the values"),
        (float(2**23 + 1), 1.0, "a value of 2^23 + 1 steps; the limit is 2^23"),
        (HUGE, 2.0**106, "the largest float32, which would come back as an infinity"),
    ):
        x = np.array([0.0, value], np.float32)
        yield refusal(
            GROUP, f"value {value:.3g} at step {step:.3g}", fed, EncodeError, partial(q.quantise, x, step, "feature")
        )  # fmt: skip
    for scale in (1e-3, 1.0, 1e6, 1e30):
        yield Case(
            GROUP, f"a whole file at steps times {scale:.0e}", "a scene of 40 anchors, encoded and decoded",
            "every attribute within Q/2 and half a float32 unit", 1.0, partial(_file_error_in_bounds, scale),
        )  # fmt: skip
    for scale, fed in (
        (1e-6, "weights of more than 2^23 steps; the limit is 2^23"),
        (1e-38, "steps below binary32's normal range"),
        (1e40, "steps above binary32's range"),
    ):
        yield refusal(
            GROUP, f"a whole file at steps times {scale:.0e}", fed, EncodeError,
            partial(encoder.encode, small_scene(), step_scale=scale),
        )  # fmt: skip
    for value, name in ((math.nan, "NaN"), (math.inf, "infinity")):
        yield refusal(
            GROUP, f"{name} in a scene", f"one {name} among the offsets of a scene", EncodeError,
            partial(_encode_with, value),
        )  # fmt: skip


def _symbols(name: str, values: list[float], step: float, expected: list[int], promised: str) -> Case:
    def measure() -> tuple[str, float]:
        k = q.quantise(np.array(values, np.float32), step)
        restored = q.dequantise(k, step)
        wrong = int((k != np.array(expected)).sum()) + int((~np.isfinite(restored)).sum())
        wrong += int((np.signbit(restored) & (k >= 0)).sum())
        return f"symbols {k.tolist()}", float(wrong)

    fed = f"{', '.join(f'{v:.9g}' for v in values)} at step {step:.3g}"
    return Case(GROUP, name, fed, promised, 0.0, measure)


def _binary32(value: float) -> float:
    return float(np.float32(value))


def _in_bounds(x: np.ndarray, restored: np.ndarray, step: float) -> float:
    """The largest |x - x_hat| / (Q/2 + half a unit in the last place of x_hat), in rationals."""
    worst = Fraction(0)
    units = np.spacing(np.abs(restored))
    for value, back, unit in zip(x.ravel().tolist(), restored.ravel().tolist(), units.ravel().tolist(), strict=True):
        worst = max(worst, abs(Fraction(value) - Fraction(back)) / ((Fraction(step) + Fraction(unit)) / 2))
    return float(worst)


def _error_in_bounds(step: float) -> tuple[str, float]:
    rng = np.random.default_rng(0)
    k = np.rint(rng.choice([-1, 1], 1000) * 2.0 ** rng.uniform(0, 23, 1000))
    positions = np.concatenate([k, k + 0.5, k + 0.49999997, k + rng.uniform(-0.5, 0.5, 1000)])
    x = (np.clip(positions, -q.MAX_SYMBOL, q.MAX_SYMBOL) * step).astype(np.float32)
    error = _in_bounds(x, q.dequantise(q.quantise(x, step), step), step)
    return f"at most {error:.6f} of the bound", error


def _changed(step: float) -> tuple[str, float]:
    powers = 2 ** np.arange(24)
    k = np.concatenate([[0], powers, -powers, powers - 1, 1 - powers]).astype(np.int32)
    wrong = int((q.quantise(q.dequantise(k, step), step) != k).sum())
    return f"{wrong} of {k.size} symbols changed", float(wrong)


def _file_error_in_bounds(scale: float) -> tuple[str, float]:
    scene = small_scene()
    order = np.lexsort(scene.anchor_q.T)
    decoded = decoder.decode(encoder.encode(scene, step_scale=scale, effort=1, omit="nothing"))
    back = np.lexsort(decoded.anchor_q.T)
    errors = {
        name: _in_bounds(getattr(scene, name)[order], getattr(decoded, name)[back], getattr(decoded.steps, name))
        for name in ("feature", "scaling_log", "offset")
    }
    return ", ".join(f"{name} {error:.4f}" for name, error in errors.items()) + " of the bound", max(errors.values())


def _encode_with(value: float) -> bytes:
    scene = small_scene()
    offset = scene.offset.copy()
    offset[3, 2, 1] = value
    return encoder.encode(replace(scene, offset=offset))
