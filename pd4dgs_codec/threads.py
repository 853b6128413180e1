"""The one policy of threads for the whole process: how many, and how they wait. It imports no numpy, torch or numba.

| pool | threads | how they wait |
|------|---------|---------------|
| the kernels (`Sharer`) | as `configure` is told | asleep |
| torch's operations (OpenMP) | the same; 1 in training | asleep |
| the BLAS of numpy | 1 | |

Every command calls `configure` before anything else is imported. As a library, rendering and training call it at the
first kernel, and encoding keeps numpy's BLAS to one thread while it lasts (`one_blas_thread`). Decoding has no threads.

The products of an encoder are small, and OpenBLAS's threads spin between them: beside one other job they made encoding
two to four times slower than one thread. OPENBLAS_NUM_THREADS is read when numpy loads; of a numpy that is loaded
already `threadpoolctl` limits the BLAS, where it is installed.

OpenMP threads that spin while they wait make a training step 5-20 times slower as soon as another process takes a
core; `OMP_WAIT_POLICY=passive` (read when torch loads) avoids that. In training the kernels are shared out, and torch's
operations are short: its threads woke for them and pushed ours aside, which made steps of small scenes a tenth slower.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from importlib import import_module
from queue import SimpleQueue
from threading import Lock, Thread
from time import perf_counter
from typing import Any, TypeVar, cast

from pd4dgs_codec.errors import RenderError

T = TypeVar("T")


def available() -> int:
    """CPUs this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def keep_freed_memory() -> None:
    """Let glibc reuse large blocks instead of returning each to the system; elsewhere this does nothing.

    A training step frees and takes hundreds of megabytes, and the page faults of fresh blocks made element-wise
    operations several times slower. What works once only takes more memory for it: a twentieth, encoding a million
    anchors.
    """
    mmap_threshold, trim_threshold = -3, -1  # glibc's M_MMAP_THRESHOLD, M_TRIM_THRESHOLD
    try:
        libc = ctypes.CDLL("libc.so.6")
        libc.mallopt(mmap_threshold, 1 << 30)
        libc.mallopt(trim_threshold, (1 << 31) - 1)
    except (OSError, AttributeError):
        pass


def _asked() -> int:
    """OMP_NUM_THREADS if set, else all."""
    asked = os.environ.get("OMP_NUM_THREADS", "")
    return min(int(asked), available()) if asked.isdigit() and int(asked) > 0 else available()


def configure(threads: int | None = None) -> int:
    """Set the wait policy and the number of threads; returns that number.

    threads: 1 .. available CPUs, or None for OMP_NUM_THREADS if set, else all. Best called before numpy and torch are
    imported; afterwards it still sets the threads of torch and the kernels and, with threadpoolctl, of numpy's BLAS,
    but an OpenMP that is loaded already waits as it did.
    Starting processes: spawn, never fork (OpenMP kills forked children).
    """
    if threads is None:
        threads = _asked()
    if not 1 <= threads <= available():
        raise RenderError(f"threads is {threads}, expected 1 to {available()} (the CPUs this process may use)")
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    os.environ["OMP_NUM_THREADS"] = str(threads)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if "numpy" in sys.modules:
        _limit_blas()
    if torch := sys.modules.get("torch"):
        torch.set_num_threads(threads)
    set_kernel_threads(threads)
    return threads


def _limit_blas() -> Any:
    """numpy's BLAS to one thread; what takes that back, or None without threadpoolctl."""
    try:
        from threadpoolctl import threadpool_limits
    except ImportError:
        return None
    return threadpool_limits(1, user_api="blas")


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Keeps numpy's BLAS to one thread meanwhile; afterwards the caller has the threads it had."""
    limits = _limit_blas()
    try:
        yield
    finally:
        if limits is not None:
            limits.restore_original_limits()


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Keeps torch's operations to one thread meanwhile."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


_kernel_threads: int | None = None


def set_kernel_threads(threads: int) -> None:
    """Threads of the CPU kernels from the next call on."""
    global _kernel_threads
    _kernel_threads = threads


#: What numba loads where it is installed, for the matrix products and the line counts of a kernel. Ours have neither.
_BESIDE_NUMBA = ("scipy", "coverage")


def load_numba() -> None:
    """Imports numba without its idle companions, which take a quarter of a second of a first picture.

    For processes that run nothing but our kernels: afterwards numba compiles no matrix product.
    """
    hidden = [name for name in _BESIDE_NUMBA if name not in sys.modules]
    sys.modules.update(dict.fromkeys(hidden))  # type: ignore[arg-type]  # None: an import of it fails
    try:
        import_module("numba.np.arraymath")  # which looks for both
    finally:
        for name in hidden:
            del sys.modules[name]


def encoder_threads() -> int:
    """Threads that an encoder may start: as many as the kernels use. It settles nothing."""
    return _asked() if _kernel_threads is None else _kernel_threads


def kernel_threads() -> int:
    """Threads that the CPU kernels use: what `configure` set, else OMP_NUM_THREADS, else all available CPUs."""
    if _kernel_threads is None:
        configure(None)
    assert _kernel_threads is not None
    return _kernel_threads


#: Parts of a kernel's tasks for each thread at most, which takes one after the other: one that another process holds
#: up, or whose tasks take longer, leaves the rest to the others.
PARTS_PER_THREAD = 4
#: Seconds that tasks must take together for each part of a thread's beyond the first: who is done with one waits for
#: the interpreter's lock.
WORTH_PART = 2e-3
#: Seconds that tasks must take together before helpers are woken, which takes about a tenth of it.
WORTH_HELP = 2e-4

Work = Callable[[tuple[int, int]], None]


class Sharer:
    """Does the tasks of one kernel on as many threads as kernels have, or alone where they took little of late.

    Any thread may call it, several at once too. Nobody waits for a helper that has not begun: it may be busy elsewhere.
    """

    def __init__(self) -> None:
        self._seconds = 0.0  # of a task; the first call, which may compile, is not shared

    def share(self, tasks: int, work: Work) -> None:
        """Calls work((first, end)) for ranges that make up 0..tasks; `work` lets the interpreter's lock go."""
        threads, begin = min(kernel_threads(), tasks), perf_counter()
        if self._seconds * tasks < WORTH_HELP:
            threads = min(threads, 1)
        if threads > 1:
            _share(tasks, threads, min(PARTS_PER_THREAD, 1 + int(self._seconds * tasks / WORTH_PART)), work)
        else:
            work((0, tasks))
        self._seconds = (perf_counter() - begin) * threads / max(tasks, 1)


def _share(tasks: int, threads: int, parts: int, work: Work) -> None:
    count = min(tasks, parts * threads)
    left = iter([(tasks * part // count, tasks * (part + 1) // count) for part in range(count)])

    def take() -> None:
        for part in left:
            work(part)

    with ExitStack() as helpers:  # all that have begun are waited for, whatever is raised
        for _ in range(threads - 1):
            helpers.callback(aside(take))
        take()


def aside(work: Callable[[], T]) -> Callable[[], T]:
    """Begins `work` on a thread beside the caller's, if kernels have more than one; what is returned waits for it and
    answers what it did, or raises what it raised. Work that no thread has begun by then the caller does.

    Both threads run Python in turns: it pays for work that mostly waits for kernels.
    """
    turn, ends = Lock(), SimpleQueue[tuple[T | None, BaseException | None]]()

    def begin() -> None:
        if turn.acquire(blocking=False):  # once
            try:
                ends.put((work(), None))
            except BaseException as error:
                ends.put((None, error))

    if kernel_threads() > 1:
        _waiting().put(begin)

    def answer() -> T:
        begin()
        found, error = ends.get()
        if error is not None:
            raise error
        return cast(T, found)

    return answer


@cache
def _waiting() -> SimpleQueue[Callable[[], None]]:
    """What the helpers, which it starts, wait for."""
    waiting = SimpleQueue[Callable[[], None]]()

    def stand_by() -> None:
        while True:
            waiting.get()()

    for _ in range(available() - 1):
        Thread(target=stand_by, name="kernel", daemon=True).start()
    return waiting


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_waiting.cache_clear)  # a child has none of its parent's threads
