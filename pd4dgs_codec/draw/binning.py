"""Which Gaussians touch which tile, front to back: numba kernels.

Depth order by a radix sort, then a stable counting sort into tiles, parallel over equal chunks of the depth order. The
result does not depend on the number of chunks or threads.
"""

from __future__ import annotations

import numpy as np

from pd4dgs_codec.draw.simd import Tasks, kernel, parallel


@kernel()
def sort(visible: np.ndarray, depths: np.ndarray) -> np.ndarray:
    """Indices int64 of the visible Gaussians, front to back; equal float32 depths in index order.

    A stable radix sort of the depths' bits above the smallest, 12 bits a pass: twice or thrice through the list.
    """
    bits = depths.view(np.int32)
    order, count = np.empty(visible.size, np.int64), 0
    low, high = np.iinfo(np.int32).max, 0
    for i in range(visible.size):
        if visible[i]:
            order[count] = i
            count += 1
            low, high = min(low, bits[i]), max(high, bits[i])
    order, other = order[:count], np.empty(count, np.int64)
    shift = 0
    while count and (high - low) >> shift:
        places = np.zeros(4097, np.int64)
        for n in range(count):
            places[(((bits[order[n]] - low) >> shift) & 4095) + 1] += 1
        for digit in range(4096):
            places[digit + 1] += places[digit]
        for n in range(count):
            digit = ((bits[order[n]] - low) >> shift) & 4095
            other[places[digit]] = order[n]
            places[digit] += 1
        order, other = other, order
        shift += 12
    return order


@parallel(lambda order, rects, columns, counts: len(counts))
def count_tiles(tasks: Tasks, order: np.ndarray, rects: np.ndarray, columns: int, counts: np.ndarray) -> None:
    """counts int64 [chunks, tiles]: how many Gaussians of each equal chunk of `order` touch each tile."""
    chunks = counts.shape[0]
    for chunk in range(tasks[0], tasks[1]):
        counts[chunk, :] = 0
        for n in range(chunk * order.size // chunks, (chunk + 1) * order.size // chunks):
            i = order[n]
            for row in range(rects[i, 2], rects[i, 3]):
                for column in range(rects[i, 0], rects[i, 1]):
                    counts[chunk, row * columns + column] += 1


@kernel()
def offsets(rects: np.ndarray, counts: np.ndarray, starts: np.ndarray, first: np.ndarray) -> None:
    """Exclusive prefix sums, filled: starts [tiles + 1] into items, first [N + 1] into the slots.

    counts becomes the write positions of fill_tiles.
    """
    position = 0
    for tile in range(counts.shape[1]):
        starts[tile] = position
        for chunk in range(counts.shape[0]):
            count = counts[chunk, tile]
            counts[chunk, tile] = position
            position += count
    starts[counts.shape[1]] = position
    position = 0
    for i in range(rects.shape[0]):
        first[i] = position
        position += (rects[i, 1] - rects[i, 0]) * (rects[i, 3] - rects[i, 2])
    first[rects.shape[0]] = position


@parallel(lambda order, rects, columns, positions, *_: len(positions))
def fill_tiles(
    tasks: Tasks,
    order: np.ndarray,
    rects: np.ndarray,
    columns: int,
    positions: np.ndarray,
    first: np.ndarray,
    items: np.ndarray,
    slot_of: np.ndarray,
) -> None:
    """items int32 [pairs]: the Gaussians of each tile, front to back; slot_of int32 [pairs]: the pair's gradient slot.

    Gaussian i has the slots first[i] .. first[i + 1] - 1, so summing them later reads memory in order."""
    chunks = positions.shape[0]
    for chunk in range(tasks[0], tasks[1]):
        for n in range(chunk * order.size // chunks, (chunk + 1) * order.size // chunks):
            i = order[n]
            pair = first[i]
            for row in range(rects[i, 2], rects[i, 3]):
                for column in range(rects[i, 0], rects[i, 1]):
                    tile = row * columns + column
                    place = positions[chunk, tile]
                    positions[chunk, tile] = place + 1
                    items[place] = i
                    slot_of[place] = pair
                    pair += 1
