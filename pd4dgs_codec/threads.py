"""The one policy of threads for the whole process: how many, and how they wait. It imports no numpy, torch or numba.

| pool | threads | how they wait |
|------|---------|---------------|
| torch's operations (OpenMP) | as `configure` is told | asleep |
| numba's kernels | the same | asleep, in the tbb layer |
| the BLAS of numpy | 1 | |

Every command calls `configure` before anything else is imported. As a library, rendering and training call it at the
first kernel, and encoding keeps numpy's BLAS to one thread while it lasts (`one_blas_thread`). Decoding has no threads.

The products of an encoder are small, and OpenBLAS's threads spin between them: beside one other job they made encoding
two to four times slower than one thread. OPENBLAS_NUM_THREADS is read when numpy loads; of a numpy that is loaded
already `threadpoolctl` limits the BLAS, where it is installed.

OpenMP threads that spin while they wait make a training step 5-20 times slower as soon as another process takes a
core; `OMP_WAIT_POLICY=passive` (read when torch loads) and numba's `tbb` layer avoid that. The `tbb` package puts its
library in the environment's lib folder, where the loader does not look, so it is loaded here by path.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

from pd4dgs_codec.errors import RenderError

_tbb: ctypes.CDLL | None = None


def _tbb_candidates() -> list[str]:
    names = ["libtbb.so.12", "libtbb.12.dylib"]
    folders = [Path(sys.prefix) / "lib", Path(sys.base_prefix) / "lib"]
    folders += [Path(p).parents[2] / "lib" for p in sys.path if Path(p).name == "site-packages"]
    files = [str(folder / name) for folder in folders for name in names]
    return [f for f in files if os.path.exists(f)] + names


def load_tbb() -> bool:
    """Make the tbb library findable for numba; False if it is not installed."""
    global _tbb
    for name in _tbb_candidates() if _tbb is None else []:
        try:
            _tbb = ctypes.CDLL(name, mode=ctypes.RTLD_GLOBAL)
            break
        except OSError:
            continue
    return _tbb is not None


def choose_layer() -> None:
    """numba's layer: tbb where it loads, else numba's own order (OpenMP, work queue). A user's choice stays."""
    if not load_tbb() or "NUMBA_THREADING_LAYER" in os.environ:
        return
    os.environ["NUMBA_THREADING_LAYER"] = "tbb"
    if "numba" in sys.modules:
        sys.modules["numba"].config.THREADING_LAYER = "tbb"


def available() -> int:
    """CPUs this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def keep_freed_memory() -> None:
    """Let glibc reuse large blocks instead of returning each to the system; elsewhere this does nothing.

    A training step frees and takes hundreds of megabytes, and the page faults of fresh blocks made element-wise
    operations several times slower.
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
    """Set the wait policy, the threading layer and the number of threads; returns that number.

    threads: 1 .. available CPUs, or None for OMP_NUM_THREADS if set, else all. Best called before numpy, torch and
    numba are imported; afterwards it still sets the threads of torch and numba and, with threadpoolctl, of numpy's
    BLAS, but an OpenMP that is loaded already waits as it did.
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
    choose_layer()
    keep_freed_memory()
    if "numba" not in sys.modules:
        os.environ.setdefault("NUMBA_NUM_THREADS", str(available()))
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


def limit_numba() -> None:
    """Gives numba's parallel kernels, in the calling thread, the number of threads that this module settled."""
    import numba

    numba.set_num_threads(min(kernel_threads(), numba.config.NUMBA_NUM_THREADS))  # type: ignore[attr-defined]


def encoder_threads() -> int:
    """Threads that an encoder may start: as many as the kernels use. It settles nothing."""
    return _asked() if _kernel_threads is None else _kernel_threads


def kernel_threads() -> int:
    """Threads that the CPU kernels use: what `configure` set, else OMP_NUM_THREADS, else all available CPUs."""
    if _kernel_threads is None:
        configure(None)
    assert _kernel_threads is not None
    return _kernel_threads
