"""Draco's kd-tree coder, the rival of our position coder; needs DracoPy."""

from __future__ import annotations

import numpy as np


def draco_encode(cells: np.ndarray) -> bytes:
    """Distinct cells int32 [N, 3], N >= 1, in bytes: lossless (in Draco's own order), at its highest level.

    ImportError where DracoPy is not installed.
    """
    import DracoPy

    offsets = cells - cells.min(axis=0)
    bits = max(1, int(offsets.max()).bit_length())
    data = DracoPy.encode(
        offsets.astype(np.float32),
        quantization_bits=bits,
        compression_level=10,
        quantization_range=float((1 << bits) - 1),
        quantization_origin=[0.0, 0.0, 0.0],
        preserve_order=False,
    )
    return bytes(data)
