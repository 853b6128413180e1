"""Numba kernels that composite projected Gaussians, tile by tile.

`composite` draws. `composite_backward` fills one gradient slot per pair of a Gaussian and a tile, without atomics, so
that results do not depend on the number of threads. In a tile the outer loop runs over the Gaussians, the inner loop
over the unfinished blocks of 8 pixels in a row that the Gaussian's ellipse touches, so that a small Gaussian costs few
lanes. A tile has 64 blocks: one 64-bit word is a set of blocks. With vectors of 16 lanes a block is two rows, named by
the first; the picture has the same bits.
"""

from typing import Any

import numpy as np

from pd4dgs_codec.draw.projection import (
    ALPHA_MAX,
    ALPHA_MIN,
    GEOM_COLUMNS,
    INV_SA,
    REACH_LOG2,
    SA,
    SB,
    SLOTS,
    TILE_HEIGHT,
    TILE_WIDTH,
    K,
    Q,
    X,
    Y,
)
from pd4dgs_codec.draw.simd import (
    LANES,
    WIDE,
    Array,
    Tasks,
    aligned,
    exp2,
    fma,
    fnma,
    folded,
    kernel,
    mask_gt,
    parallel,
    select_gt,
    single,
    spread,
    sqrt,
    store,
    total,
    totals,
    trailing_zeros,
)
from pd4dgs_codec.draw.simd import wide_load as load
from pd4dgs_codec.draw.simd import wide_splat as splat

T_MIN = 1e-4  #: a pixel is finished when its transmittance would fall to this
_COLUMNS = TILE_WIDTH // LANES
_ROWS = WIDE // LANES  #: rows of pixels in a block
_FIRST_ROWS = np.uint64(0xFFFFFFFFFFFFFFFF // (2**_ROWS - 1))  #: a bit for the first row of each block
_BLOCKS = _COLUMNS * TILE_HEIGHT
_STATE = 5  #: vectors of state per block
_F = np.float32
_ROW, _ROW64 = np.arange(WIDE, dtype=_F), np.arange(WIDE, dtype=np.float64)  #: row numbers 0 .. WIDE - 1
_LANE = _ROW % LANES
_COLORS = 3  #: colour channels

Bits = Any  #: a uint64 with one bit per block of a tile, at column * TILE_HEIGHT + row


@kernel()
def _coverage(geom: Array, g: int, left: int, top: int) -> Bits:
    """Returns the blocks of the tile that Gaussian g (an offset into flat geom) may touch.

    Each pixel row's chord through the ellipse is taken slightly too wide, to cover float32 rounding.
    """
    shear = geom[g + K]
    dy = top + 0.5 - geom[g + Y]
    zero, far = splat(_F(0.0)), splat(_F(1e9))
    reach = splat(_F(geom[g + Q] + REACH_LOG2 + 1e-4))
    width = splat(_F(min(geom[g + INV_SA], 1e30) * (1.0 + 1e-6)))
    slack = splat(_F(1e-3 + 1e-5 * abs(shear)))
    mask = np.uint64(0)
    for top_row in range(0, TILE_HEIGHT, WIDE):
        row = load(_ROW, 0) + splat(_F(top_row))
        r = fma(row, splat(_F(geom[g + SB])), splat(_F(geom[g + SB] * dy)))
        rest = fnma(r, r, reach)
        centre = fma(row, splat(_F(shear)), splat(_F(geom[g + X] - 0.5 - left + shear * dy)))
        extent = fma(sqrt(select_gt(rest, zero, rest, zero)), width, slack)
        begin, end = select_gt(zero, rest, far, centre - extent), centre + extent
        for column in range(_COLUMNS):
            x = column * LANES
            hit = mask_gt(end, splat(_F(x))) & mask_gt(splat(_F(x + LANES - 1)), begin)
            mask |= hit << np.uint64(column * TILE_HEIGHT + top_row)
    for row_of_block in range(1, _ROWS):
        mask |= mask >> np.uint64(row_of_block)
    return mask & _FIRST_ROWS


@kernel(inline=True)
def _tabulate(ts: Array, rs: Array, rests: Array, geom: Array, g: int, left: int, top: int) -> None:
    """Fills float32 tables of Gaussian g: ts, t at the first pixel of each block of 8; per row of the tile rs, r, and
    rests, q - r^2."""
    dy, sa, sb = top + 0.5 - geom[g + Y], geom[g + SA], geom[g + SB]
    start, step = splat(sa * (left + 0.5 - geom[g + X] - geom[g + K] * dy)), splat(-sa * geom[g + K])
    for first in range(0, TILE_HEIGHT, WIDE):
        row = load(_ROW64, 0) + splat(float(first))
        t, r = start + row * step, splat(sb * dy) + row * splat(sb)
        store(rs, first, single(r))
        store(rests, first, single(splat(geom[g + Q]) - r * r))
        for column in range(_COLUMNS):
            store(ts, column * TILE_HEIGHT + first, single(t + splat(float(column) * (sa * LANES))))


@kernel(inline=True)
def _begin(state: Array, channel: int, left: int, top: int, width: int, height: int) -> Bits:
    """Sets `channel` of the state to 1 inside the image and 0 outside; returns the blocks with a pixel inside."""
    alive = np.uint64(0)
    for block in range(_BLOCKS):
        row, column = block % TILE_HEIGHT, block // TILE_HEIGHT * LANES
        y, x, p = top + row, left + column, _place(column, row) + channel * WIDE
        if y < height and x < width:
            alive |= np.uint64(1) << np.uint64(block)
        for lane in range(LANES):
            state[p + lane] = _F(1.0) if y < height and x + lane < width else _F(0.0)
    return alive & _FIRST_ROWS


@kernel(inline=True)
def _place(x: int, y: int) -> int:
    """Offset in `state` of pixel (x, y) of the tile, in its block's first vector."""
    block = x // LANES * TILE_HEIGHT + y
    return block // _ROWS * _STATE * WIDE + block % _ROWS * LANES + x % LANES


@kernel(inline=True)
def _composite_tile(
    items: Array,
    start: int,
    end: int,
    geom: Array,
    colors: Array,
    left: int,
    top: int,
    width: int,
    height: int,
    state: Array,
) -> None:
    """Blends the tile's Gaussians into `state`, which holds per block the transmittance (0 once finished), 3 colours
    and the last transmittance above T_MIN."""
    alive = _begin(state, 4, left, top, width, height)
    alive = _begin(state, 0, left, top, width, height)
    one = np.uint64(1)
    zero, faintest = splat(_F(0.0)), splat(_F(ALPHA_MIN))
    low, high, t_min, lanes = splat(_F(-9.0)), splat(_F(ALPHA_MAX)), splat(_F(T_MIN)), load(_LANE, 0)
    ts, rs, rests = aligned(_BLOCKS, _F), aligned(TILE_HEIGHT, _F), aligned(TILE_HEIGHT, _F)
    for n in range(start, end):
        if not alive:
            break
        g = np.int64(items[n]) * GEOM_COLUMNS
        mask = _coverage(geom, g, left, top) & alive
        if not mask:
            continue
        _tabulate(ts, rs, rests, geom, g, left, top)
        step = splat(_F(geom[g + SA]))
        c = np.int64(items[n]) * _COLORS
        red, green, blue = splat(colors[c]), splat(colors[c + 1]), splat(colors[c + 2])
        while mask:
            block = trailing_zeros(mask)
            mask &= mask - one
            row = block % TILE_HEIGHT
            t = fma(lanes, step, spread(ts, block))
            exponent = fnma(t, t, spread(rests, row))
            alpha = exp2(select_gt(exponent, low, exponent, low))
            alpha = select_gt(high, alpha, alpha, high)
            alpha = select_gt(faintest, alpha, zero, alpha)
            p = block * (_STATE * LANES)  # `_place` of the block's first pixel
            before = load(state, p)
            weight = alpha * before
            after = before - weight
            weight = select_gt(after, t_min, weight, zero)
            store(state, p + 4 * WIDE, select_gt(after, t_min, after, load(state, p + 4 * WIDE)))
            after = select_gt(after, t_min, after, zero)
            store(state, p, after)
            store(state, p + WIDE, fma(weight, red, load(state, p + WIDE)))
            store(state, p + 2 * WIDE, fma(weight, green, load(state, p + 2 * WIDE)))
            store(state, p + 3 * WIDE, fma(weight, blue, load(state, p + 3 * WIDE)))
            if not mask_gt(after, zero):
                alive &= ~(one << np.uint64(block))


@parallel(lambda items, starts, *_: starts.size - 1)
def composite(
    tasks: Tasks,
    items: Array,
    starts: Array,
    geom: Array,
    colors: Array,
    background: Array,
    picture: Array,
    transmittance: Array,
) -> None:
    """Fills picture [H, W, 3] and transmittance = 1 - alpha [H, W], float32, from colors [N, 3] and background [3].

    Computing 1 - alpha from alpha would lose the digits that the gradient of a nearly hidden background needs.
    """
    height, width = transmittance.shape
    columns = -(-width // TILE_WIDTH)
    flat_geom, flat_colors = geom.reshape(-1), colors.reshape(-1)
    for tile in range(tasks[0], tasks[1]):
        left, top = tile % columns * TILE_WIDTH, tile // columns * TILE_HEIGHT
        if starts[tile] == starts[tile + 1]:
            for y in range(top, min(top + TILE_HEIGHT, height)):
                for x in range(left, min(left + TILE_WIDTH, width)):
                    transmittance[y, x] = 1.0
                    for c in range(_COLORS):
                        picture[y, x, c] = background[c]
            continue
        state = aligned(_BLOCKS * _STATE * LANES, _F)
        _composite_tile(items, starts[tile], starts[tile + 1], flat_geom, flat_colors, left, top, width, height, state)
        for y in range(top, min(top + TILE_HEIGHT, height)):
            for x in range(left, min(left + TILE_WIDTH, width)):
                p = _place(x - left, y - top)
                behind = state[p + 4 * WIDE]
                transmittance[y, x] = behind
                for c in range(_COLORS):
                    back = behind * background[c]
                    picture[y, x, c] = state[p + (1 + c) * WIDE] + back


@kernel(inline=True)
def _composite_tile_backward(
    items: Array,
    slot_of: Array,
    start: int,
    end: int,
    geom: Array,
    colors: Array,
    left: int,
    top: int,
    width: int,
    height: int,
    state: Array,
    slots: Array,
) -> None:
    """Fills the slots of the tile's Gaussians, front to back. `state` holds per block the transmittance, the part of
    the gradient that comes from behind the current Gaussian, and dL/d(3 colours)."""
    alive = _begin(state, 0, left, top, width, height)
    one_bit = np.uint64(1)
    zero, one, faintest = splat(_F(0.0)), splat(_F(1.0)), splat(_F(ALPHA_MIN))
    low, high, t_min, lanes = splat(_F(-9.0)), splat(_F(ALPHA_MAX)), splat(_F(T_MIN)), load(_LANE, 0)
    ts, rs, rests = aligned(_BLOCKS, _F), aligned(TILE_HEIGHT, _F), aligned(TILE_HEIGHT, _F)
    for n in range(start, end):
        g = np.int64(items[n]) * GEOM_COLUMNS
        mask = _coverage(geom, g, left, top) & alive if alive else alive
        if mask:
            _tabulate(ts, rs, rests, geom, g, left, top)
        step = splat(_F(geom[g + SA]))
        c = np.int64(items[n]) * _COLORS
        red, green, blue = splat(colors[c]), splat(colors[c + 1]), splat(colors[c + 2])
        sum_g, sum_gt, sum_gtt, sum_gr, sum_grr, sum_gtr = zero, zero, zero, zero, zero, zero
        sum_red, sum_green, sum_blue = zero, zero, zero
        while mask:
            block = trailing_zeros(mask)
            mask &= mask - one_bit
            row = block % TILE_HEIGHT
            t = fma(lanes, step, spread(ts, block))
            exponent = fnma(t, t, spread(rests, row))
            unclamped = exp2(select_gt(exponent, low, exponent, low))
            alpha = select_gt(high, unclamped, unclamped, high)
            alpha = select_gt(faintest, alpha, zero, alpha)
            p = block * (_STATE * LANES)  # `_place` of the block's first pixel
            before = load(state, p)
            weight = alpha * before
            after = before - weight
            weight = select_gt(after, t_min, weight, zero)
            after = select_gt(after, t_min, after, zero)
            store(state, p, after)
            v_red, v_green, v_blue = load(state, p + 2 * WIDE), load(state, p + 3 * WIDE), load(state, p + 4 * WIDE)
            v = fma(v_red, red, fma(v_green, green, v_blue * blue))
            behind = fnma(weight, v, load(state, p + WIDE))
            store(state, p + WIDE, behind)
            gradient = alpha * (before * v - behind / (one - alpha))
            gradient = select_gt(weight, zero, select_gt(unclamped, high, zero, gradient), zero)
            r = spread(rs, row)
            gt, gr = gradient * t, gradient * r
            sum_g, sum_gt, sum_gr = sum_g + gradient, sum_gt + gt, sum_gr + gr
            sum_gtt, sum_grr, sum_gtr = fma(gt, t, sum_gtt), fma(gr, r, sum_grr), fma(gt, r, sum_gtr)
            sum_red, sum_green = fma(weight, v_red, sum_red), fma(weight, v_green, sum_green)
            sum_blue = fma(weight, v_blue, sum_blue)
            if not mask_gt(after, zero):
                alive &= ~(one_bit << np.uint64(block))
        sums = totals(
            folded(sum_g), folded(sum_gt), folded(sum_gtt), folded(sum_gr), folded(sum_grr), folded(sum_gtr),
            folded(sum_red), folded(sum_green),
        )  # fmt: skip
        slot = np.int64(slot_of[n]) * SLOTS
        store(slots, slot, sums)
        slots[slot + LANES] = total(folded(sum_blue))


@parallel(lambda items, slot_of, starts, *_: starts.size - 1)
def composite_backward(
    tasks: Tasks,
    items: Array,
    slot_of: Array,
    starts: Array,
    geom: Array,
    colors: Array,
    picture: Array,
    transmittance: Array,
    g_picture: Array,
    g_alpha: Array,
    slots: Array,
) -> None:
    """Fills slots float32 [pairs, SLOTS] with each pair's sums of gradients.

    g_picture [H, W, 3] and g_alpha [H, W]: dL/d(picture) and dL/d(1 - transmittance).
    """
    height, width = transmittance.shape
    columns = -(-width // TILE_WIDTH)
    flat_geom, flat_colors, flat_slots = geom.reshape(-1), colors.reshape(-1), slots.reshape(-1)
    for tile in range(tasks[0], tasks[1]):
        if starts[tile] == starts[tile + 1]:
            continue
        left, top = tile % columns * TILE_WIDTH, tile // columns * TILE_HEIGHT
        state = aligned(_BLOCKS * _STATE * LANES, _F)
        for y in range(top, min(top + TILE_HEIGHT, height)):
            for x in range(left, min(left + TILE_WIDTH, width)):
                p = _place(x - left, y - top)
                # Everything behind contributes v.C and, through alpha = 1 - T, -g_alpha T.
                behind = -transmittance[y, x] * g_alpha[y, x]
                for c in range(_COLORS):
                    v = g_picture[y, x, c]
                    behind += v * picture[y, x, c]
                    state[p + (2 + c) * WIDE] = v
                state[p + WIDE] = behind
        _composite_tile_backward(
            items, slot_of, starts[tile], starts[tile + 1], flat_geom, flat_colors, left, top, width, height, state,
            flat_slots,
        )  # fmt: skip
