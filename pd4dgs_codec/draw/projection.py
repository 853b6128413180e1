"""Numba kernels that project Gaussians to image-space ellipses, and the gradient: float64 inside, float32 outside.

Sigma2 = U U^T + EPS2D I with U = J W R S (2x3). Its determinant |u0 x u1|^2 + EPS2D tr + EPS2D^2 (Cauchy-Binet) is
never negative and, unlike p r - q^2, does not cancel for long thin Gaussians.

Compositing evaluates a Gaussian as log2(alpha) = q - t^2 - r^2 with t = sa (dx - k dy), r = sb dy. This completed
square loses no digits in float32 for a long thin Gaussian, and |t|, |r| stay below 3 where it is drawn.
"""

import math
from typing import Any

import numpy as np

from pd4dgs_codec.draw.simd import LANES, Array, Tasks, double, kernel, load, parallel, splat, store
from pd4dgs_codec.scene import MIN_OPACITY

TILE_WIDTH, TILE_HEIGHT = 32, 16  #: pixels
ALPHA_MAX = 0.999  #: alpha is clamped to this (gsplat 1.5.3)
ALPHA_MIN = MIN_OPACITY  #: fainter contributions are skipped
EPS2D = 0.3  #: added to the diagonal of the covariance in the image, square pixels
FAR = 1e10  #: Gaussians beyond this depth are skipped, scene units
REACH_LOG2 = math.log2(255.0)  #: a Gaussian is drawn where log2(opacity) - t^2 - r^2 >= -REACH_LOG2
_F32_MAX = float(np.finfo(np.float32).max)
_LN2 = math.log(2.0)

Quaternion = tuple[float, float, float, float]  #: w, x, y, z
Matrix3 = tuple[float, float, float, float, float, float, float, float, float]  #: 3x3, row-major
Matrix23 = tuple[float, float, float, float, float, float]  #: 2x3, row-major

#: Columns of `geom`, float64 [N, 8]: centre (pixels), shear k, scales of t and r, log2 opacity, 1/sa; one is unused, so
#: that a row is a cache line.
X, Y, K, SA, SB, Q, INV_SA = range(7)
GEOM_COLUMNS = 8
#: Columns of the gradient slots before the colours: sums over pixels of g, g t, g t^2, g r, g r^2, g t r with
#: g = dL / d(ln alpha).
G, GT, GTT, GR, GRR, GTR = range(6)
SLOT_COLOR = 6  #: first of the three columns of colours
SLOTS = SLOT_COLOR + 3


@kernel(inline=True)
def _saturate(value: float) -> Any:
    """Converts `value` to float32, clamped to float32's range; NaN passes."""
    return np.float32(min(max(value, -_F32_MAX), _F32_MAX)) if value == value else np.float32(value)


@kernel(inline=True)
def _rotation(w: float, x: float, y: float, z: float) -> tuple[Quaternion, float, Matrix3]:
    """Unit quaternion (w, x, y, z), 1/norm and the 9 entries of R; a zero quaternion is the identity with 1/norm 0."""
    w, x, y, z = np.float64(w), np.float64(x), np.float64(y), np.float64(z)  # float() of a float32 stays one in numba
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    if norm == 0.0:
        w, inverse = 1.0, 0.0
    else:
        inverse = 1.0 / norm
        w, x, y, z = w * inverse, x * inverse, y * inverse, z * inverse
    matrix = (
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip
    return (w, x, y, z), inverse, matrix


@kernel(inline=True)
def _to_camera(means: Array, i: int, camera: Array) -> tuple[float, float, float]:
    """Point i in camera axes. camera: float64 [20] = R (9, row-major), t (3), fx, fy, cx, cy, then the limits of J."""
    a, b, c = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
    return (
        camera[0] * a + camera[1] * b + camera[2] * c + camera[9],
        camera[3] * a + camera[4] * b + camera[5] * c + camera[10],
        camera[6] * a + camera[7] * b + camera[8] * c + camera[11],
    )


@kernel(inline=True)
def _jacobian(x: float, y: float, z: float, camera: Array) -> tuple[float, float, float, Matrix23]:
    """1/z, the ratios x/z and y/z clamped to 1.3 x the field of view (as gsplat), and M = J W, 2x3 row-major."""
    iz = 1.0 / z
    a = min(max(x * iz, camera[16]), camera[17])
    b = min(max(y * iz, camera[18]), camera[19])
    jx, jy = camera[12] * iz, camera[13] * iz
    matrix = (
        jx * (camera[0] - a * camera[6]), jx * (camera[1] - a * camera[7]), jx * (camera[2] - a * camera[8]),
        jy * (camera[3] - b * camera[6]), jy * (camera[4] - b * camera[7]), jy * (camera[5] - b * camera[8]),
    )  # fmt: skip
    return iz, a, b, matrix


@kernel(inline=True)
def _matmul23(m: Matrix23, r: Matrix3) -> Matrix23:
    """(2x3) (3x3), both row-major tuples."""
    return (
        m[0] * r[0] + m[1] * r[3] + m[2] * r[6],
        m[0] * r[1] + m[1] * r[4] + m[2] * r[7],
        m[0] * r[2] + m[1] * r[5] + m[2] * r[8],
        m[3] * r[0] + m[4] * r[3] + m[5] * r[6],
        m[3] * r[1] + m[4] * r[4] + m[5] * r[7],
        m[3] * r[2] + m[4] * r[5] + m[5] * r[8],
    )


@kernel(inline=True)
def _clip_index(value: float, limit: int) -> int:
    """Converts `value` to int, clamped to 0 .. limit in floating point first, so that huge values convert safely."""
    return int(min(max(value, 0.0), float(limit)))


@parallel(lambda means, *_: len(means))
def project(
    tasks: Tasks,
    means: Array,
    quats: Array,
    scales: Array,
    opacities: Array,
    camera: Array,
    size: tuple[int, int],
    near: float,
    visible: Array,
    geom: Array,
    rects: Array,
    radii: Array,
    means2d: Array,
    depths: Array,
) -> None:
    """Fills the outputs per Gaussian; a culled Gaussian has visible = False and zeros elsewhere, except in geom.

    size: (width, height), pixels. Outputs: visible bool [N]; geom [N, GEOM_COLUMNS]; rects int32 [N, 4], the tile
    columns x0, x1 and rows y0, y1, half open; radii int32 [N, 2], half extents, and means2d [N, 2], pixels; depths [N].
    Comparisons are written so that NaN culls.
    """
    width, height = size
    for i in range(tasks[0], tasks[1]):
        visible[i], depths[i] = False, 0.0
        for c in range(2):
            rects[i, c], rects[i, 2 + c], radii[i, c], means2d[i, c] = 0, 0, 0, 0.0
        opacity = np.float64(opacities[i])
        x, y, z = _to_camera(means, i, camera)
        if not (z > near and z <= FAR and opacity > ALPHA_MIN and opacity <= _F32_MAX):
            continue
        _, _, rotation = _rotation(quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3])
        iz, _, _, jw = _jacobian(x, y, z, camera)
        u = _matmul23(jw, rotation)
        s0, s1, s2 = np.float64(scales[i, 0]), np.float64(scales[i, 1]), np.float64(scales[i, 2])
        u0, u1, u2, v0, v1, v2 = u[0] * s0, u[1] * s1, u[2] * s2, u[3] * s0, u[4] * s1, u[5] * s2
        p, q, r = u0 * u0 + u1 * u1 + u2 * u2, u0 * v0 + u1 * v1 + u2 * v2, v0 * v0 + v1 * v1 + v2 * v2
        c0, c1, c2 = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
        det = c0 * c0 + c1 * c1 + c2 * c2 + EPS2D * (p + r) + EPS2D * EPS2D
        p += EPS2D
        r += EPS2D
        if not (det > 0.0 and det < 1e300 and r > 0.0):
            continue
        opacity_log2 = min(math.log2(opacity), 100.0)  # exp2 stays finite
        reach = opacity_log2 + REACH_LOG2
        extent = math.sqrt(2.0 * _LN2 * reach)  # <= 3.33 sigma for opacity <= 1: gsplat's cap never binds there
        half_width, half_height = extent * math.sqrt(p), extent * math.sqrt(r)
        mx, my = camera[12] * x * iz + camera[14], camera[13] * y * iz + camera[15]
        radius_x, radius_y = np.ceil(half_width), np.ceil(half_height)
        seen = radius_x > 0.0 and mx + radius_x > 0.0 and mx - radius_x < width
        if not (seen and my + radius_y > 0.0 and my - radius_y < height):
            continue
        # Slightly too wide, so that the alpha test alone decides which pixels are drawn.
        half_width, half_height = half_width * (1.0 + 1e-5) + 1e-3, half_height * (1.0 + 1e-5) + 1e-3
        left, right = np.ceil(mx - half_width - 0.5), np.floor(mx + half_width - 0.5)
        top, bottom = np.ceil(my - half_height - 0.5), np.floor(my + half_height - 0.5)
        sa = math.sqrt(0.5 / _LN2 * (r / det))
        geom[i, X], geom[i, Y], geom[i, K] = mx, my, q / r
        geom[i, SA], geom[i, SB], geom[i, Q] = sa, math.sqrt(0.5 / (_LN2 * r)), opacity_log2
        geom[i, INV_SA] = 1.0 / sa
        if right >= max(left, 0.0) and left <= width - 1 and bottom >= max(top, 0.0) and top <= height - 1:
            rects[i, 0] = _clip_index(left, width - 1) // TILE_WIDTH
            rects[i, 1] = _clip_index(right, width - 1) // TILE_WIDTH + 1
            rects[i, 2] = _clip_index(top, height - 1) // TILE_HEIGHT
            rects[i, 3] = _clip_index(bottom, height - 1) // TILE_HEIGHT + 1
        radii[i, 0] = int(min(radius_x, 1e9))
        radii[i, 1] = int(min(radius_y, 1e9))
        means2d[i, 0], means2d[i, 1], depths[i] = _saturate(mx), _saturate(my), np.float32(z)
        visible[i] = True


@kernel(inline=True)
def _rotation_gradient(unit: Quaternion, inverse_norm: float, g: Matrix3) -> Quaternion:
    """Returns d/d(unnormalised quaternion) from g = d/dR (9, row-major)."""
    w, x, y, z = unit
    gw = 2.0 * (x * (g[7] - g[5]) + y * (g[2] - g[6]) + z * (g[3] - g[1]))
    gx = 2.0 * (y * (g[3] + g[1]) + z * (g[6] + g[2]) + w * (g[7] - g[5]) - 2.0 * x * (g[4] + g[8]))
    gy = 2.0 * (x * (g[3] + g[1]) + z * (g[7] + g[5]) + w * (g[2] - g[6]) - 2.0 * y * (g[0] + g[8]))
    gz = 2.0 * (x * (g[6] + g[2]) + y * (g[7] + g[5]) + w * (g[3] - g[1]) - 2.0 * z * (g[0] + g[4]))
    along = gw * w + gx * x + gy * y + gz * z
    return (
        (gw - along * w) * inverse_norm,
        (gx - along * x) * inverse_norm,
        (gy - along * y) * inverse_norm,
        (gz - along * z) * inverse_norm,
    )


@kernel(inline=True)
def _image_gradient(
    sum_t: float, sum_tt: float, sum_r: float, sum_rr: float, sum_tr: float, k: float, sa: float, sb: float
) -> tuple[float, float, float, float, float]:
    """Returns d/d(mean2d) and the symmetric M = d/d(Sigma2) = 1/2 sum g n n^T, from the slot sums.

    n = Sigma2^-1 delta = 2 ln2 (sa t, sb r - k sa t).
    """
    t, r = 2.0 * _LN2 * sa, 2.0 * _LN2 * sb
    gx = t * sum_t
    gy = r * sum_r - k * gx
    mxx = 0.5 * t * t * sum_tt
    cross = 0.5 * t * r * sum_tr
    mxy = cross - k * mxx
    myy = 0.5 * r * r * sum_rr - 2.0 * k * cross + k * k * mxx
    return gx, gy, mxx, mxy, myy


@parallel(lambda means, *_: len(means))
def project_backward(
    tasks: Tasks,
    means: Array,
    quats: Array,
    scales: Array,
    opacities: Array,
    camera: Array,
    geom: Array,
    first: Array,
    slots: Array,
    g_means: Array,
    g_quats: Array,
    g_scales: Array,
    g_opacities: Array,
    g_colors: Array,
    g_means2d: Array,
) -> None:
    """Sums each Gaussian's slots in float64, in a fixed order, and backpropagates the sums to the inputs: fills g_*,
    given zeroed. slots[first[i] : first[i + 1]] belong to Gaussian i.
    """
    sums = np.empty(SLOTS)
    for i in range(tasks[0], tasks[1]):
        begin, end = first[i], first[i + 1]
        if begin == end:
            continue
        together, last = splat(0.0), 0.0
        for n in range(begin, end):
            together = together + double(load(slots, n * SLOTS))
            last += slots[n, LANES]
        store(sums, 0, together)
        sums[LANES] = last
        for c in range(3):
            g_colors[i, c] = _saturate(sums[SLOT_COLOR + c])
        g_opacities[i] = _saturate(sums[G] / np.float64(opacities[i]))
        gx, gy, mxx, mxy, myy = _image_gradient(
            sums[GT], sums[GTT], sums[GR], sums[GRR], sums[GTR], geom[i, K], geom[i, SA], geom[i, SB]
        )
        g_means2d[i, 0] = _saturate(gx)
        g_means2d[i, 1] = _saturate(gy)

        x, y, z = _to_camera(means, i, camera)
        iz, a, b, jw = _jacobian(x, y, z, camera)
        unit, inverse_norm, rotation = _rotation(quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3])
        m = _matmul23(jw, rotation)
        s0, s1, s2 = np.float64(scales[i, 0]), np.float64(scales[i, 1]), np.float64(scales[i, 2])
        # dL/dU = 2 M U with U = m diag(s); dL/dm = dL/dU diag(s).
        d0 = 2.0 * (mxx * m[0] + mxy * m[3]), 2.0 * (mxx * m[1] + mxy * m[4]), 2.0 * (mxx * m[2] + mxy * m[5])
        d1 = 2.0 * (mxy * m[0] + myy * m[3]), 2.0 * (mxy * m[1] + myy * m[4]), 2.0 * (mxy * m[2] + myy * m[5])
        g_scales[i, 0] = _saturate(s0 * (d0[0] * m[0] + d1[0] * m[3]))
        g_scales[i, 1] = _saturate(s1 * (d0[1] * m[1] + d1[1] * m[4]))
        g_scales[i, 2] = _saturate(s2 * (d0[2] * m[2] + d1[2] * m[5]))
        e = s0 * s0, s1 * s1, s2 * s2
        p0, p1, p2 = d0[0] * e[0], d0[1] * e[1], d0[2] * e[2]
        p3, p4, p5 = d1[0] * e[0], d1[1] * e[1], d1[2] * e[2]
        g_rotation = (
            jw[0] * p0 + jw[3] * p3, jw[0] * p1 + jw[3] * p4, jw[0] * p2 + jw[3] * p5,
            jw[1] * p0 + jw[4] * p3, jw[1] * p1 + jw[4] * p4, jw[1] * p2 + jw[4] * p5,
            jw[2] * p0 + jw[5] * p3, jw[2] * p1 + jw[5] * p4, jw[2] * p2 + jw[5] * p5,
        )  # fmt: skip
        gq = _rotation_gradient(unit, inverse_norm, g_rotation)
        for c in range(4):
            g_quats[i, c] = _saturate(gq[c])
        # dL/d(JW) = dL/dm R^T, row by row; J = [[fx/z, 0, -fx a/z], [0, fy/z, -fy b/z]].
        w0 = (
            p0 * rotation[0] + p1 * rotation[1] + p2 * rotation[2],
            p0 * rotation[3] + p1 * rotation[4] + p2 * rotation[5],
            p0 * rotation[6] + p1 * rotation[7] + p2 * rotation[8],
        )
        w1 = (
            p3 * rotation[0] + p4 * rotation[1] + p5 * rotation[2],
            p3 * rotation[3] + p4 * rotation[4] + p5 * rotation[5],
            p3 * rotation[6] + p4 * rotation[7] + p5 * rotation[8],
        )
        jx, jy = camera[12] * iz, camera[13] * iz
        gz = -iz * (w0[0] * jw[0] + w0[1] * jw[1] + w0[2] * jw[2] + w1[0] * jw[3] + w1[1] * jw[4] + w1[2] * jw[5])
        ga = -jx * (w0[0] * camera[6] + w0[1] * camera[7] + w0[2] * camera[8])
        gb = -jy * (w1[0] * camera[6] + w1[1] * camera[7] + w1[2] * camera[8])
        if not (camera[16] <= x * iz <= camera[17]):
            ga = 0.0
        if not (camera[18] <= y * iz <= camera[19]):
            gb = 0.0
        ga += camera[12] * gx
        gb += camera[13] * gy
        gz -= (ga * x + gb * y) * iz * iz
        gx, gy = ga * iz, gb * iz
        for c in range(3):
            g_means[i, c] = _saturate(camera[c] * gx + camera[3 + c] * gy + camera[6 + c] * gz)
