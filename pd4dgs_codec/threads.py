"""Number of threads and how they wait, for the whole process. Imports no numpy, torch or numba.

| pool | threads | how they wait |
|------|---------|---------------|
| the kernels (`Sharer`) | as `configure` sets | asleep |
| torch's operations (OpenMP) | the same; 1 in training | asleep |
| the BLAS of numpy | 1 | |

Every command calls `configure` before any other import. In a library, rendering and training call it at the first
kernel, and encoding runs numpy's BLAS on one thread (`one_blas_thread`). Decoding starts no threads.

The encoder's matrix products are small, and OpenBLAS threads spin between them: beside another job, encoding took two
to four times as long as with one thread. numpy reads OPENBLAS_NUM_THREADS when it loads; afterwards `threadpoolctl`, if
installed, sets the limit.

OpenMP threads that spin while they wait make a training step 5 to 20 times slower as soon as another process uses a
core; `OMP_WAIT_POLICY=passive` (read when torch loads) avoids this. torch's operations in training are short: waking
its threads for them made steps of small scenes a tenth slower.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from functools import cache
from importlib import import_module
from time import perf_counter
from typing import TYPE_CHECKING, Any, TypeVar

from pd4dgs_codec.errors import RenderError

if TYPE_CHECKING:
    from concurrent.futures import ThreadPoolExecutor

T = TypeVar("T")
_kernel_threads: int | None = None


def available() -> int:
    """Returns the number of CPUs that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def configure(threads: int | None = None) -> int:
    """Sets the wait policy and the number of threads; returns that number.

    threads: 1 .. available CPUs, or None for OMP_NUM_THREADS if set, else all. Raises RenderError out of this range.
    Call it before numpy and torch are imported: afterwards it still sets the threads of torch, the kernels and, with
    threadpoolctl, numpy's BLAS, but not the wait policy of a loaded OpenMP. Start processes by spawn, not by fork:
    OpenMP kills forked children.
    """
    if threads is None:
        asked = os.environ.get("OMP_NUM_THREADS", "")
        threads = min(int(asked), available()) if asked.isdigit() and int(asked) > 0 else available()
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


def set_kernel_threads(threads: int) -> None:
    """Sets the number of threads of the CPU kernels from their next call on."""
    global _kernel_threads
    _kernel_threads = threads


def kernel_threads() -> int:
    """Returns the number of threads of the CPU kernels; calls `configure` if it has not been set."""
    return configure(None) if _kernel_threads is None else _kernel_threads


def _limit_blas() -> AbstractContextManager[Any]:
    """Limits numpy's BLAS to one thread if threadpoolctl is installed; a `with` block of the result undoes it."""
    try:
        from threadpoolctl import threadpool_limits
    except ImportError:
        return nullcontext()
    limits: AbstractContextManager[Any] = threadpool_limits(1, user_api="blas")
    return limits


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Limits numpy's BLAS to one thread within the block."""
    with _limit_blas():
        yield


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Limits torch's operations to one thread within the block."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def keep_freed_memory() -> None:
    """Lets glibc reuse large blocks instead of returning each to the system; without glibc it does nothing.

    A training step allocates and frees hundreds of megabytes, and the page faults of fresh blocks made element-wise
    operations several times slower. One-off work only takes more memory: 5 % for encoding a million anchors.
    """
    mmap_threshold, trim_threshold = -3, -1  # glibc's M_MMAP_THRESHOLD, M_TRIM_THRESHOLD
    try:
        libc = ctypes.CDLL("libc.so.6")
        libc.mallopt(mmap_threshold, 1 << 30)
        libc.mallopt(trim_threshold, (1 << 31) - 1)
    except (OSError, AttributeError):
        pass


#: Packages that numba imports if installed, for matrix products and code coverage of kernels. Our kernels use neither.
_BESIDE_NUMBA = ("scipy", "coverage")


def load_numba() -> None:
    """Imports numba without scipy and coverage, which take a quarter of a second of the time to the first image.

    For processes that run only our kernels: afterwards numba cannot compile matrix products.
    """
    hidden = [name for name in _BESIDE_NUMBA if name not in sys.modules]
    sys.modules.update(dict.fromkeys(hidden))  # type: ignore[arg-type]  # None: importing it fails
    try:
        import_module("numba.np.arraymath")  # which imports both
    finally:
        for name in hidden:
            del sys.modules[name]


# -- sharing work ------------------------------------------------------------------------------------------------------

#: Most parts per thread into which a kernel's tasks are divided. Threads fetch parts one by one: if another process
#: delays a thread, or its tasks take longer, the others do the rest.
PARTS_PER_THREAD = 4
#: Seconds of all tasks for each further part per thread: after each part a thread waits for the interpreter's lock.
PART_SECONDS = 2e-3
#: Least seconds of all tasks for which helpers are woken, which takes about a tenth of this.
HELPER_SECONDS = 2e-4

Work = Callable[[tuple[int, int]], None]


class Sharer:
    """Runs the tasks of one kernel on all kernel threads, or in the caller alone if they took little time last time.

    Several threads may call it at once. No caller waits for a helper that has not begun: it may be busy elsewhere.
    """

    def __init__(self) -> None:
        self._seconds = 0.0  # per task; the first call, which may compile, is not shared

    def share(self, tasks: int, work: Work) -> None:
        """Calls work((first, end)) for ranges that together cover 0 .. tasks - 1. `work` must release the GIL."""
        threads, begin = min(kernel_threads(), tasks), perf_counter()
        if self._seconds * tasks < HELPER_SECONDS:
            threads = min(threads, 1)
        if threads > 1:
            _share(tasks, threads, min(PARTS_PER_THREAD, 1 + int(self._seconds * tasks / PART_SECONDS)), work)
        else:
            work((0, tasks))
        self._seconds = (perf_counter() - begin) * threads / max(tasks, 1)


def _share(tasks: int, threads: int, parts: int, work: Work) -> None:
    count = min(tasks, parts * threads)
    left = iter([(tasks * part // count, tasks * (part + 1) // count) for part in range(count)])

    def take() -> None:
        for part in left:
            work(part)

    with ExitStack() as helpers:  # waits for all that have begun, whatever is raised
        for _ in range(threads - 1):
            helpers.callback(aside(take))
        take()


def aside(work: Callable[[], T]) -> Callable[[], T]:
    """Begins `work` on a helper thread if kernels have more than one thread. The function returned waits for it and
    returns its result or raises its exception; work that no helper has begun by then runs in the caller.

    Only one thread runs Python at a time, so this helps only work that mostly waits for kernels.
    """
    if kernel_threads() < 2:
        return work
    future = _helpers().submit(work)
    return lambda: work() if future.cancel() else future.result()


def together(works: Sequence[Callable[[], T]]) -> list[T]:
    """Returns the results of all. Helper threads begin with the first, the caller with the last."""
    waiting = [aside(work) for work in works]
    return [wait() for wait in reversed(waiting)][::-1]


@cache
def _helpers() -> ThreadPoolExecutor:
    """Returns the pool of helper threads, which starts them as needed."""
    from concurrent.futures import ThreadPoolExecutor

    return ThreadPoolExecutor(max(1, available() - 1), thread_name_prefix="kernel")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_helpers.cache_clear)  # a child has no threads of its parent
