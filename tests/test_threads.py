"""The policy of threads: how kernels share tasks, what goes aside, and numpy's BLAS in commands and library calls."""

import os
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pd4dgs_codec import threads
from pd4dgs_codec.errors import RenderError

ROOT = Path(__file__).parents[1]
needs_two = pytest.mark.skipif(threads.available() < 2, reason="needs 2 CPUs")
pytestmark = pytest.mark.usefixtures("kernel_threads")


def _run(code: str, **variables: str) -> list[str]:
    """The words that `code` prints in a process of its own, in which no number of threads is asked for."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("OMP_", "OPENBLAS_"))} | variables
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


# -- kernels -----------------------------------------------------------------------------------------------------------


def _shared(tasks, work):
    sharer = threads.Sharer()
    sharer._seconds = 1.0
    sharer.share(tasks, work)


@given(tasks=st.integers(0, 100), count=st.integers(1, 9))
def test_shares_make_up_the_whole(tasks, count):
    done = []
    threads.set_kernel_threads(count)
    _shared(tasks, lambda own: done.extend(range(*own)))
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


@pytest.fixture
def busy(kernel_threads):
    """All helpers wait for this event, until the test ends."""
    go = threading.Event()
    for _ in range(threads.available()):
        threads._helpers().submit(go.wait, 60)
    kernel_threads(2)
    yield go
    go.set()


def test_nobody_waits_for_helpers_that_are_busy(busy):
    done = []
    _shared(8, done.append)
    assert len(done) == 8 and not busy.is_set()


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


@pytest.mark.usefixtures("busy")
def test_what_goes_aside_while_all_threads_are_busy_the_caller_does():
    assert threads.aside(threading.current_thread)() is threading.main_thread()


@needs_two
def test_two_parts_run_at_once_and_results_keep_their_order():
    threads.set_kernel_threads(2)
    both = threading.Barrier(2)

    def work(i):
        both.wait(60)
        return i

    assert threads.together([partial(work, i) for i in range(2)]) == [0, 1]


@pytest.mark.parametrize("count", [1, pytest.param(2, marks=needs_two)])
def test_what_is_raised_aside_reaches_the_caller(count):
    threads.set_kernel_threads(count)
    with pytest.raises(ZeroDivisionError):
        threads.aside(lambda: 1 // 0)()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_forked_child_shares_with_helpers_of_its_own():
    code = "import os, threading; from pd4dgs_codec import threads; threads.set_kernel_threads(2); "
    code += "threads._share(8, 2, 1, lambda own: None); pid = os.fork(); threads._share(8, 2, 1, lambda own: None); "
    code += "print(threading.active_count() == 2) if pid == 0 else os.waitpid(pid, 0)"
    assert _run(code)[-1] == "True"


@pytest.mark.parametrize("count", [0, -1, 10_000])
def test_impossible_counts_are_refused(count):
    with pytest.raises(RenderError, match="expected 1 to"):
        threads.configure(count)


def test_configure_sets_torch_and_the_kernels():
    torch = pytest.importorskip("torch")
    before = torch.get_num_threads()
    assert threads.configure(1) == 1
    assert threads.kernel_threads() == 1 and torch.get_num_threads() == 1
    torch.set_num_threads(before)


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
    pytest.importorskip("torch")
    assert _run(_CHILD + "import torch; print(torch.get_num_threads())") == ["1", "passive", "1"]


@pytest.mark.skipif(not os.path.isdir("/proc/self/task"), reason="needs Linux to count threads")
def test_numpy_imported_afterwards_starts_no_threads_of_its_own():
    code = "from pd4dgs_codec import threads; threads.configure(1); import numpy, os; "
    code += "a = numpy.ones((900, 900)); a @ a; print(len(os.listdir('/proc/self/task')))"
    assert _run(code) == ["1"]


def test_numba_loads_without_its_companions_where_a_command_asks():
    code = "import sys; before = set(sys.modules); from pd4dgs_codec.threads import load_numba; load_numba(); "
    code += "load_numba(); new = set(sys.modules) - before; print('numba' in new, {'scipy', 'coverage'} & new, "
    code += "None in sys.modules.values())"
    assert _run(code) == ["True", "set()", "False"]


# -- numpy's BLAS ------------------------------------------------------------------------------------------------------

COMMAND = """
import os, sys
from pd4dgs_codec.cli import common, options
def action(args, console):
    assert "numpy" not in sys.modules
    print(os.environ["OPENBLAS_NUM_THREADS"], os.environ["OMP_WAIT_POLICY"])
    return 0
parser = options.Parser("encode", "", "", "")
parser.add_common()
common.run(parser, action, [])
"""


def test_a_command_settles_the_policy_before_numpy_is_there():
    assert _run(COMMAND) == ["1", "passive"]
    assert _run(COMMAND, OPENBLAS_NUM_THREADS="2", OMP_WAIT_POLICY="active") == ["2", "active"]  # a user's choice stays


LIBRARY = """
import numpy
from threadpoolctl import threadpool_info
from pd4dgs_codec import decode
from pd4dgs_codec.format import encoder

def threads():
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}

seen, check = [], encoder.check_scene
encoder.check_scene = lambda scene: (seen.append(threads()), check(scene))
before = threads()
with open("spec/vectors/valid/layers-0-1-2.pd4", "rb") as file:
    encoder.encode(decode(file.read()), effort=1)
assert seen == [{1}], seen
assert threads() == before
print(max(before))
"""


def test_encoding_keeps_the_blas_of_a_loaded_numpy_to_one_thread_meanwhile():
    pytest.importorskip("threadpoolctl")
    assert _run(LIBRARY, OPENBLAS_NUM_THREADS="2") == ["2"]
