"""Other coders on the same data: lossless where they say so, no figure where they are not, ratios to ours."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from pages import peers
from strategies import make_scene

from pd4dgs_codec.bench import timing
from pd4dgs_codec.format.decoder import decode_layers
from pd4dgs_codec.format.encoder import encode

RNG = np.random.default_rng(4)


@pytest.fixture(scope="module")
def layers():
    return decode_layers(encode(make_scene(8, anchors=40), layers=2, effort=1))[1]


def test_coders_are_lossless_and_agree_on_what_they_code(layers, monkeypatch):
    monkeypatch.setitem(sys.modules, "torchac", None)  # builds for minutes where it was never used
    symbols = peers.symbols_of(layers)
    assert sum(c.size for c in symbols.channels) > 40 * 68
    rows = peers.coder_rows(symbols, 1, effort=1)
    assert [row.coder for row in rows if row.missing] == ["torchac"]
    assert all(row.bytes and row.error == 0 for row in rows if not row.missing)
    least = symbols.rate_bits / 8
    assert all(row.bytes > 0.3 * least for row in rows if row.bytes)


def test_a_peer_that_loses_a_symbol_gets_no_figure(layers, monkeypatch):
    decoding = peers.decode_channels_lzma
    monkeypatch.setattr(peers, "decode_channels_lzma", lambda *a: [c + 1 for c in decoding(*a)])
    monkeypatch.setitem(sys.modules, "torchac", None)
    (row,) = [r for r in peers.coder_rows(peers.symbols_of(layers), 1, effort=1) if "LZMA" in r.coder]
    assert row.bytes is None and "came back" in (row.missing or "")


def test_positions_beside_draco(layers):
    pytest.importorskip("DracoPy")
    own, draco = peers.position_rows(layers, 1)
    assert own.error == draco.error == 0 and own.bytes and draco.bytes


def test_ply_of_splats_by_hand():
    given = peers.Splats(
        means=RNG.normal(size=(5, 3)).astype(np.float32),
        scales=RNG.uniform(0.1, 1, (5, 3)).astype(np.float32),
        quats=RNG.normal(size=(5, 4)).astype(np.float32),
        opacities=np.array([0.1, 0.5, 0.9, 0.999, 0.004], np.float32),
        colors=RNG.uniform(0, 1, (5, 3)).astype(np.float32),
    )
    data = peers.to_ply(given)
    assert data.startswith(b"ply\nformat binary_little_endian 1.0\nelement vertex 5\nproperty float x\n")
    back = peers.from_ply(data)
    for name, want in vars(given).items():
        np.testing.assert_allclose(getattr(back, name), want, rtol=1e-5, atol=1e-6, err_msg=name)


def test_ratios_are_to_the_first_row_of_a_kind():
    one, two = timing.Timing(1.0, 1.0, 1.0, 1), timing.Timing(2.0, 2.0, 2.0, 1)
    rows = [
        peers.Row("symbols", "this codec", 100, one, two, 0.0),
        peers.Row("symbols", "other", 150, two, one, 0.0),
        peers.Row("positions", "this codec", 10, two, two, 0.0),
        peers.Row("positions", "other", missing="not installed"),
    ]
    cells = [[c.strip() for c in line.split("|")[1:-1]] for line in peers.table(rows, 1600.0).splitlines()]
    assert cells[3][2:7] == ["150", "1.500", "0.7500", "2", "0.5"]
    assert cells[4][3:7] == ["1.000", "-", "1", "1"]
    assert cells[5][2] == "none: not installed"
