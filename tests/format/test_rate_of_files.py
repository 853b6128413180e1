"""The size of files of Gaussian scenes against the rate model, other priors, LZMA, and the trainer's own sum."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from strategies import make_scene

from pd4dgs_codec.format.encoder import Report, encode_with_report
from pd4dgs_codec.scene import Deformation, Scene

VARIANTS = {"best": {}, "gauss": {"priors": "gauss"}, "lzma": {"mode": "lzma"}}
#: Spread of a channel over its step, from nearly constant to seven bits a symbol.
SPREADS = 2.0 ** np.linspace(-0.5, 5.0, 68)

#: Most bits that the hundred priors of a layer take.
PRIOR_BITS = 5_000


@cache
def gaussian_scene() -> Scene:
    """6,000 anchors, a third of them new at each level, all channels Gaussian with means and spreads of their own;
    Gaussian weights, and planes that are Gaussian noise around 1."""
    rng = np.random.default_rng(21)
    scene = make_scene(21, anchors=6_000, extent=500, hidden=(32,), channels=4, sides=(12, 12, 12, 8), width=32)
    n = len(scene.anchor_q)
    step = np.repeat([*scene.steps.attributes.values()], [32, 6, 30])
    values = step * (rng.normal(0, 20, 68) + SPREADS * rng.normal(size=(n, 68)))
    feature, scaling_log, offset = np.split(values.astype(np.float32), [32, 38], axis=1)
    first = rng.integers(0, 3, n)
    own = rng.integers(40, 250, n)
    mask = tuple(np.where(first <= level, own + level, 0).astype(np.uint8) for level in range(3))
    return replace(
        scene,
        feature=feature,
        scaling_log=scaling_log,
        offset=offset.reshape(n, 10, 3),
        mask=mask,
        networks=noise(rng, scene.networks, 0, 6 * scene.steps.weights_scaffold),
        global_deformation=noisy_deformation(rng, scene.global_deformation, scene.steps.planes_global),
        local_deformation=noisy_deformation(rng, scene.local_deformation, scene.steps.planes_local),
    )


def noise(rng: np.random.Generator, arrays: Any, mean: float, spread: float) -> Any:
    """Gaussian noise in place of arrays in dicts and tuples."""
    if isinstance(arrays, dict):
        return {name: noise(rng, value, mean, spread) for name, value in arrays.items()}
    if isinstance(arrays, tuple):
        return tuple(noise(rng, value, mean, spread) for value in arrays)
    return rng.normal(mean, spread, arrays.shape).astype(np.float32)


def noisy_deformation(rng: np.random.Generator, field: Deformation, step: float) -> Deformation:
    return Deformation(noise(rng, field.planes, 1, 4 * step), noise(rng, field.networks, 0, 6 * 2.0**-6))


@cache
def report(variant: str) -> Report:
    return encode_with_report(gaussian_scene(), verify=False, effort=5, **VARIANTS[variant])[1]


def streams(variant: str, layer: int) -> dict[str, int]:
    return {s.name: s.payload_bits for s in report(variant).layers[layer].streams}


@pytest.mark.parametrize("layer", [0, 1, 2])
def test_gaussian_priors_spend_what_the_rate_model_says_and_the_best_never_more(layer):
    row = report("gauss").layers[layer]
    assert row.layer == layer and row.anchors > 1800 and row.rate_bits > 5e5
    assert 0.999 * row.rate_bits <= row.payload_bits <= 1.001 * row.rate_bits + PRIOR_BITS
    best, gauss = streams("best", layer), streams("gauss", layer)
    assert set(best) == set(gauss) and "masks" in best
    assert [name for name in best if best[name] > 1.001 * gauss[name]] == []


def test_ans_beats_lzma_on_the_same_symbols():
    """All channels of a layer, positions and masks too."""
    ans, lzma = (sum(sum(streams(v, layer).values()) for layer in range(3)) for v in ("best", "lzma"))
    assert ans <= 0.97 * lzma
    assert report("best").bytes < report("lzma").bytes


def test_the_modes_report_the_same_symbols_and_rate():
    """A layer's rate counts attributes, planes and weights, whatever the mode."""
    for layer in range(3):
        ans, lzma = report("best").layers[layer], report("lzma").layers[layer]
        assert ans.rate_bits == pytest.approx(report("gauss").layers[layer].rate_bits)
        assert lzma.rate_bits == pytest.approx(ans.rate_bits)
        assert ans.anchors == lzma.anchors and [s.name for s in lzma.streams] == ["symbols"]
        assert sum(s.symbols for s in ans.streams) == lzma.streams[0].symbols


def test_the_trainers_rate_is_the_coders_rate():
    """On values that were never rounded, layer by layer and part by part, within 2 %."""
    pytest.importorskip("torch")
    from trainer_rate import train_rate_bits

    for own, row in zip(train_rate_bits(gaussian_scene()), report("gauss").layers, strict=True):
        assert own["layer"] == row.layer
        coded = {s.name: s.rate_bits for s in row.streams}
        parts = {"attributes"} | ({"planes", "weights"} if row.layer else {"weights"})
        for part in parts:
            assert own[part] == pytest.approx(coded[part], rel=0.02), (row.layer, part)
        assert sum(own[part] for part in parts) == pytest.approx(row.rate_bits, rel=0.02)
