"""The numba kernel of temporal mask consistency: neighbouring anchors that differ, and the gradient."""

from __future__ import annotations

import numpy as np

from pd4dgs_codec.draw.simd import kernel


@kernel()
def smooth(
    slope: np.ndarray, mask: np.ndarray, order: np.ndarray, weights: np.ndarray, away: np.ndarray
) -> tuple[float, int]:
    """(the sum of w_ij |m_i - m_j|, the number of pairs); slope [N], given zeroed, becomes the sum's gradient.

    Pairs are those of places i and i + away[i] of the curve order int64 [N] that both are on it; weights [N, REACH] of
    each, by away - 1.
    """
    total, pairs = 0.0, 0
    for i in range(len(order)):
        if i + away[i] < len(order):
            first, second, weight = order[i], order[i + away[i]], weights[i, away[i] - 1]
            jump = mask[first] - mask[second]
            pairs += 1
            total += weight * abs(jump)
            if jump > 0:
                slope[first] += weight
                slope[second] -= weight
            elif jump < 0:
                slope[first] -= weight
                slope[second] += weight
    return total, pairs
