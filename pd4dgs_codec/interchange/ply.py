"""PLY files of Gaussians, as the reference implementation of 3D Gaussian splatting writes them."""

from __future__ import annotations

import numpy as np

from pd4dgs_codec.interchange.splats import Splats

#: Opacities are stored as logits; nearer to 0 or 1 than this they would be infinite.
LEAST_OPACITY = 1e-6
#: Scales are stored as logarithms.
LEAST_SCALE = 1e-12


def properties(degree: int) -> list[str]:
    """Names of the vertex properties, in their order; all are float."""
    rest = 3 * ((degree + 1) ** 2 - 1)
    return [
        "x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(rest)),
        "opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4)),
    ]  # fmt: skip


def ply_bytes(splats: Splats) -> bytes:
    """A binary PLY: normals 0, f_rest channel by channel, logits of opacities, logarithms of scales, quaternions
    wxyz."""
    n = len(splats.means)
    p = np.clip(splats.opacities.astype(np.float64), LEAST_OPACITY, 1 - LEAST_OPACITY)
    columns = (
        splats.means,
        np.zeros((n, 3)),
        splats.sh[:, 0],
        splats.sh[:, 1:].transpose(0, 2, 1).reshape(n, 3 * (splats.sh.shape[1] - 1)),
        np.log(p / (1 - p))[:, None],
        np.log(np.maximum(splats.scales, LEAST_SCALE)),
        splats.quats,
    )
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {n}"]
    head += [*(f"property float {name}" for name in properties(splats.degree)), "end_header", ""]
    return "\n".join(head).encode() + np.concatenate(columns, axis=1).astype("<f4").tobytes()
