"""Threads: the same bits for any number of them, at once from two callers."""

import threading

import pytest
import torch
from raster_scenes import camera, draw_with_gradients, scene

from pd4dgs_codec import threads

pytestmark = [
    pytest.mark.skipif(threads.available() < 2, reason="needs 2 CPUs"),
    pytest.mark.usefixtures("kernel_threads"),
]


def _draw(count, seed=0):
    threads.set_kernel_threads(count)
    return draw_with_gradients(scene(3000, seed, scale=0.04), camera(150, 110), "cpu")


def _same(a, b):
    return all(torch.equal(a[k], b[k]) for k in a if k != "meta")


def test_one_and_two_threads_give_the_same_bits():
    one, two, again = _draw(1), _draw(2), _draw(2)
    assert _same(one, two) and _same(two, again)
    assert not _same(one, _draw(1, seed=1))


def test_two_callers_at_once():
    expected = [_draw(2, seed) for seed in (0, 1)]
    results = [[], []]

    def work(n):
        for _ in range(5):
            results[n].append(_draw(2, n))

    workers = [threading.Thread(target=work, args=(n,)) for n in (0, 1)]
    for w in workers:
        w.start()
    for w in workers:
        w.join(60)
    assert all(len(r) == 5 for r in results)
    assert all(_same(r, expected[n]) for n in (0, 1) for r in results[n])
