"""The model rate: the sum of R(a) over a channel's symbols, the figure that payload sizes are compared with."""

from __future__ import annotations

import math

import numpy as np

P_MIN = 1e-6  #: the clip of R(a)
SIGMA_MIN = 2.0**-10  #: in units of Q


def gaussian_bits(symbols: np.ndarray) -> float:
    """Sum of R(a) = -log2(Phi((k + 1/2 - mu) / sigma) - Phi((k - 1/2 - mu) / sigma)) over integer symbols k, in bits.

    mu and sigma are the symbols' mean and standard deviation (units of Q, sigma >= 2**-10), each probability is
    clipped at 1e-6. Written with the upper tail of |k - mu|, so nothing above the clip loses more than 1e-9 of itself.
    """
    symbols = np.asarray(symbols)
    if symbols.size == 0:
        return 0.0
    values, counts = np.unique(symbols, return_counts=True)
    weights = counts / symbols.size
    mu = float(values @ weights)
    sigma = max(math.sqrt(float((values - mu) ** 2 @ weights)), SIGMA_MIN)
    scale = 1.0 / (sigma * math.sqrt(2.0))
    bits = 0.0
    for distance, count in zip(np.abs(values - mu).tolist(), counts.tolist(), strict=True):
        p = 0.5 * (math.erfc((distance - 0.5) * scale) - math.erfc((distance + 0.5) * scale))
        bits -= count * math.log2(max(p, P_MIN))
    return bits
