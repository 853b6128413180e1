"""Threads: how kernels share their tasks, the same bits for any number, at once from two callers."""

import os
import subprocess
import sys
import threading
import time

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from raster_scenes import camera, draw_with_gradients, scene

from pd4dgs_codec import threads
from pd4dgs_codec.errors import RenderError

needs_two = pytest.mark.skipif(threads.available() < 2, reason="needs 2 CPUs")


def _shared(tasks, work):
    sharer = threads.Sharer()
    sharer._seconds = 1.0
    sharer.share(tasks, work)


@given(tasks=st.integers(0, 100), count=st.integers(1, 9))
def test_shares_make_up_the_whole(tasks, count):
    before, done = threads.kernel_threads(), []
    threads.set_kernel_threads(count)
    try:
        _shared(tasks, lambda own: done.extend(range(*own)))
    finally:
        threads.set_kernel_threads(before)
    assert sorted(done) == list(range(tasks))


@needs_two
def test_what_a_share_raises_reaches_the_caller():
    def fail_elsewhere(own):
        if threading.current_thread() is not threading.main_thread():
            raise RenderError("a share failed")
        time.sleep(0.05)  # long enough for the helper to take its part

    threads.set_kernel_threads(2)
    with pytest.raises(RenderError, match="a share failed"):
        _shared(8, fail_elsewhere)


def test_nobody_waits_for_helpers_that_are_busy():
    go, done = threading.Event(), []
    for _ in range(threads.available()):
        threads._helpers().submit(go.wait, 60)
    threads.set_kernel_threads(2)
    try:
        _shared(8, done.append)
        assert len(done) == 8 and not go.is_set()
    finally:
        go.set()


def test_what_takes_little_is_not_shared():
    sharer, parts = threads.Sharer(), []
    threads.set_kernel_threads(2)
    for seconds in (0.0, 0.0, 1e-3, *[0.0] * 20):
        parts.append(0)

        def work(own, seconds=seconds):
            parts[-1] += 1
            if seconds:
                time.sleep(seconds * (own[1] - own[0]))

        sharer.share(8, work)
    assert parts[:4] == [1, 1, 1, 8] and parts[-1] == 1  # by what the call before took


@pytest.mark.parametrize("count", [1, pytest.param(2, marks=needs_two)])
def test_what_goes_aside_is_done_once_beside_the_caller_where_there_are_threads(count):
    threads.set_kernel_threads(count)
    started, done = threading.Event(), []

    def work():
        started.set()
        done.append(threading.current_thread() is threading.main_thread())
        return 7

    answer = threads.aside(work)
    assert count == 1 or started.wait(60)
    assert answer() == 7 and done == [count == 1]


def test_what_goes_aside_while_all_threads_are_busy_the_caller_does():
    go = threading.Event()
    for _ in range(threads.available()):
        threads._helpers().submit(go.wait, 60)
    threads.set_kernel_threads(2)
    try:
        assert threads.aside(threading.current_thread)() is threading.main_thread()
    finally:
        go.set()


@pytest.mark.parametrize("count", [1, pytest.param(2, marks=needs_two)])
def test_what_is_raised_aside_reaches_the_caller(count):
    threads.set_kernel_threads(count)
    with pytest.raises(ZeroDivisionError):
        threads.aside(lambda: 1 // 0)()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_forked_child_shares_with_helpers_of_its_own():
    code = "import os, threading; from pd4dgs_codec import threads; threads.set_kernel_threads(2); "
    code += "threads._share(8, 2, 1, print); pid = os.fork(); threads._share(8, 2, 1, lambda own: None); "
    code += "print(threading.active_count() == 2) if pid == 0 else os.waitpid(pid, 0)"
    assert _run(code)[-1] == "True"


def _draw(count, seed=0):
    threads.set_kernel_threads(count)
    return draw_with_gradients(scene(3000, seed, scale=0.04), camera(150, 110), "cpu")


def _same(a, b):
    return all(torch.equal(a[k], b[k]) for k in a if k != "meta")


@needs_two
def test_one_and_two_threads_give_the_same_bits():
    one, two, again = _draw(1), _draw(2), _draw(2)
    assert _same(one, two) and _same(two, again)
    assert not _same(one, _draw(1, seed=1))


@needs_two
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


@pytest.mark.parametrize("count", [0, -1, 10_000])
def test_impossible_counts_are_refused(count):
    with pytest.raises(RenderError, match="expected 1 to"):
        threads.configure(count)


def test_configure_sets_torch_and_the_kernels():
    assert threads.configure(1) == 1
    assert threads.kernel_threads() == 1 and torch.get_num_threads() == 1


def _run(code, **variables):
    environment = {k: v for k, v in os.environ.items() if not k.startswith("OMP_")} | variables
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


_CHILD = """
import sys
from pd4dgs_codec import threads
assert not {"torch", "numba"} & set(sys.modules)
threads.configure(1)
import os, numpy as np
from pd4dgs_codec.draw.rasteriser import draw
from pd4dgs_codec.scene import Camera
camera = Camera(np.eye(4), np.array([[30.0, 0, 15], [0, 30, 15], [0, 0, 1]]), 30, 30)
g = [np.random.default_rng(1).random((50, n) if n else 50) for n in (3, 4, 3, 0, 3)]
g[0][:, 2] += 2
draw(*g, camera)
print(threads.kernel_threads(), os.environ["OMP_WAIT_POLICY"])
"""


def test_before_torch_in_a_new_process():
    assert _run(_CHILD + "import torch; print(torch.get_num_threads())") == ["1", "passive", "1"]


@pytest.mark.skipif(not os.path.isdir("/proc/self/task"), reason="needs Linux to count threads")
def test_numpy_imported_afterwards_starts_no_threads_of_its_own():
    code = "from pd4dgs_codec import threads; threads.configure(1); import numpy, os; "
    code += "a = numpy.ones((900, 900)); a @ a; print(len(os.listdir('/proc/self/task')))"
    assert _run(code) == ["1"]


def test_a_users_choice_of_policy_stays():
    assert _run(_CHILD, OMP_WAIT_POLICY="active") == ["1", "active"]


def test_numba_loads_without_its_companions_where_a_command_asks():
    code = "import sys; before = set(sys.modules); from pd4dgs_codec.threads import load_numba; load_numba(); "
    code += "load_numba(); new = set(sys.modules) - before; print('numba' in new, {'scipy', 'coverage'} & new, "
    code += "None in sys.modules.values())"
    assert _run(code) == ["True", "set()", "False"]
